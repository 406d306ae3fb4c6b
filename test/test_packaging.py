# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The metadata of the package are consistent, and all files are shipped."""

import importlib
import os
import re
import runpy
from typing import Any
from xml.etree import ElementTree

import accel_calib
from accel_calib.logs import FORMATS
import pytest
from shared import ROOT, table

EXECUTABLES = ('accel-calib', 'calibrator', 'calibrator_lifecycle', 'simulator')


@pytest.fixture
def setup_py(monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Return the arguments of setup.py for setuptools."""
    setuptools = pytest.importorskip('setuptools')
    given: dict[str, Any] = {}
    monkeypatch.setattr(setuptools, 'setup', lambda **keywords: given.update(keywords))
    with monkeypatch.context() as changed:
        changed.chdir(ROOT)
        runpy.run_path('setup.py')
    return given


@pytest.fixture
def package_xml() -> ElementTree.Element:
    return ElementTree.parse(ROOT / 'package.xml').getroot()


def texts(element: ElementTree.Element, tag: str) -> list[str]:
    return [' '.join((child.text or '').split()) for child in element.findall(tag)]


def sources(folder: str = '') -> list[str]:
    """Return the texts of all modules in a folder of the package."""
    return [path.read_text(encoding='utf-8')
            for path in (ROOT / 'accel_calib' / folder).rglob('*.py')]


def distributions(requirements: list[str]) -> set[str]:
    return {re.split(r'[^\w.-]', requirement)[0] for requirement in requirements}


def test_package_xml_and_setup_py_agree(
        setup_py: dict[str, Any], package_xml: ElementTree.Element) -> None:
    for tag in ('name', 'version', 'description', 'license', 'maintainer'):
        assert texts(package_xml, tag) == [setup_py[tag]]
    assert setup_py['version'] == accel_calib.__version__
    assert package_xml.find('maintainer').get('email') == setup_py['maintainer_email']
    urls = {element.get('type'): element.text for element in package_xml.findall('url')}
    assert urls == {'website': setup_py['url'],
                    'repository': setup_py['project_urls']['Repository'],
                    'bugtracker': setup_py['project_urls']['Bug Tracker']}


def test_the_version_stands_in_one_place(package_xml: ElementTree.Element) -> None:
    (version,) = texts(package_xml, 'version')
    files = [ROOT / 'setup.py', *ROOT.glob('*.md'), *(
        path for folder in ('accel_calib', 'docs', 'launch', 'scripts')
        for path in (ROOT / folder).rglob('*') if path.suffix in ('.py', '.md', '.rst'))]
    assert len(files) > 100
    assert not [path for path in files
                if re.search(rf'\b{re.escape(version)}\b', path.read_text(encoding='utf-8'))]


def test_the_page_about_installation_lists_every_part_and_the_readme_those_that_it_uses(
        setup_py: dict[str, Any]) -> None:
    page = (ROOT / 'docs' / 'install.md').read_text(encoding='utf-8')
    assert {*setup_py['extras_require']} <= {*re.findall(r'`([\w-]+)`', page)}
    text = (ROOT / 'README.md').read_text(encoding='utf-8')
    parts = re.findall(r"pip install './accel_calib\[([\w,]+)\]'", text)[0].split(',')
    used = {'live': 'accel-calib live', 'logs': '.ulg', 'report': 'pictures/page.png',
            'notebook': 'to_dataframe'}
    assert set(parts) <= {*setup_py['extras_require']}
    assert {part for part, mark in used.items() if mark in text} == set(parts)


def test_messages_name_packages_of_the_index(setup_py: dict[str, Any]) -> None:
    asked = {name for source in sources() for names in re.findall(r"needing\('([^']+)'", source)
             for name in names.split()} | {each.needs for each in FORMATS} - {''}
    parts = [setup_py['install_requires'], *setup_py['extras_require'].values()]
    known = {name for part in parts for name in distributions(part)}
    assert {'aiohttp', 'dask', 'pandas', 'pyulog'} <= asked <= known
    assert not [each for each in sources() if re.search(r'pip install .{0,4}accel_calib', each)]


def test_package_xml_lists_each_requirement_and_all_imports_of_the_nodes(
        setup_py: dict[str, Any], package_xml: ElementTree.Element) -> None:
    extras, listed = setup_py['extras_require'], {*texts(package_xml, 'exec_depend')}
    required = setup_py['install_requires'] + extras['report'] + extras['live']
    wanted = {table('rosdep_keys')[name] for name in distributions(required)} - {''}
    assert wanted == {key for key in listed if key.startswith('python3-')}
    pattern = re.compile(r'^\s*(?:from|import) (rclpy|\w+_(?:msgs|srvs|interfaces))\b', re.M)
    assert {name for source in sources('ros') for name in pattern.findall(source)} <= listed


def test_all_shipped_files_exist(setup_py: dict[str, Any]) -> None:
    shipped = {path for _, paths in setup_py['data_files'] for path in paths}
    assert {'resource/accel_calib', 'package.xml', 'config/calibrator.yaml',
            *(str(path.relative_to(ROOT)) for path in (ROOT / 'launch').glob('*.launch.py')),
            *(f'scripts/{name}' for name in EXECUTABLES)} <= shipped
    assert not [path for path in shipped if not (ROOT / path).is_file()]


def test_every_file_that_is_not_code_is_installed(setup_py: dict[str, Any]) -> None:
    package = ROOT / 'accel_calib'
    patterns = setup_py['package_data']['accel_calib']
    installed = {path for pattern in patterns for path in package.glob(pattern)}
    assert {package / 'report' / 'page' / name for name in ('style.css', 'script.js')} < installed
    assert installed == {path for path in package.rglob('*') if path.is_file()
                         and path.suffix not in ('.py', '.pyc')}


def test_every_folder_with_code_is_a_package(setup_py: dict[str, Any]) -> None:
    folders = {path.parent for path in (ROOT / 'accel_calib').rglob('*.py')}
    assert {'.'.join(path.relative_to(ROOT).parts) for path in folders} == set(
        setup_py['packages'])


def test_every_entry_point_is_an_executable_of_the_package(setup_py: dict[str, Any]) -> None:
    scripts = setup_py['entry_points']['console_scripts']
    assert [script.partition('=')[0].strip() for script in scripts] == [*EXECUTABLES]


@pytest.mark.parametrize('name', EXECUTABLES)
def test_scripts_run_the_function_of_the_entry_point(name: str, setup_py: dict[str, Any]) -> None:
    script, = (script for script in setup_py['entry_points']['console_scripts']
               if script.split()[0] == name)
    path = ROOT / 'scripts' / name
    assert os.access(path, os.X_OK)
    module, function = re.search(r'^from (\S+) import (\S+)$', path.read_text(), re.M).groups()
    assert script.partition('=')[2].strip() == f'{module}:{function}'
    if '.ros.' in module:
        pytest.importorskip('rclpy')
    assert callable(getattr(importlib.import_module(module), function))
