# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What is imported is required, and requirements are bounded by what was tested."""

from importlib.metadata import packages_distributions
import re
import sys
from typing import Any
from xml.etree import ElementTree

import pytest
from shared import ROOT
import test_packaging
from test_style import imports_of

requirements = pytest.importorskip('packaging.requirements')
Requirement = requirements.Requirement
package_xml, setup_py = test_packaging.package_xml, test_packaging.setup_py

PINNED = '.ci/ubuntu-24.04.txt', 'requirements-dev.txt'

FOR_DEVELOPERS = {'dev', 'docs', 'test', 'test-fleet'}
"""Extras that users do not install. The extra `ros` has exact versions."""

WITHOUT_DISTRIBUTION = {'_typeshed', 'compression', 'backports'}
"""Modules that only type checkers have, or newer versions of Python; rosbags needs the last."""


def normal(name: str) -> str:
    """Return the normal form of the name of a distribution."""
    return re.sub(r'[-_.]+', '-', name).lower()


def pins(path: str) -> dict[str, str]:
    """Return the version by name of a file with exact versions."""
    lines = (ROOT / path).read_text(encoding='utf-8').splitlines()
    found = [line.partition(' --hash=sha256:')[0].split('==') for line in lines
             if line and not line.startswith('#')]
    return {normal(name): version for name, version in found}


def for_users(given: dict[str, Any]) -> list[Any]:
    """Return the requirements of the package and of the extras that users install."""
    return all_of(given, *given['extras_require'].keys() - FOR_DEVELOPERS - {'ros'})


def all_of(given: dict[str, Any], *extras: str) -> list[Any]:
    """Return the requirements of the package and of these extras."""
    texts = [*given['install_requires'], *(
        text for extra in extras for text in given['extras_require'][extra])]
    return [Requirement(text) for text in texts]


def test_what_is_imported_is_required(
        setup_py: dict[str, Any], package_xml: ElementTree.Element) -> None:
    required = {normal(each.name) for each in for_users(setup_py)}
    of_ros = set(test_packaging.texts(package_xml, 'exec_depend'))
    distributions = packages_distributions()
    paths = (*(ROOT / 'accel_calib').rglob('*.py'), *(ROOT / 'launch').glob('*.py'))
    imported = {name.partition('.')[0] for path in paths for name in imports_of(path)}
    others = imported - sys.stdlib_module_names - WITHOUT_DISTRIBUTION - of_ros - {'accel_calib'}
    assert {'numpy', 'rosbags'} < others
    assert not [module for module in others if not required & {
        normal(each) for each in distributions.get(module, ())}]


def test_requirements_of_users_have_bounds(setup_py: dict[str, Any]) -> None:
    for requirement in for_users(setup_py):
        assert {'<', '>='} <= {each.operator for each in requirement.specifier}, str(requirement)


def test_a_package_has_the_same_bounds_in_all_extras(setup_py: dict[str, Any]) -> None:
    bounds: dict[str, str] = {}
    for requirement in all_of(setup_py, *setup_py['extras_require']):
        stated = str(requirement.specifier)
        assert bounds.setdefault(normal(requirement.name), stated) == stated, str(requirement)


@pytest.mark.parametrize('path', PINNED)
def test_tested_versions_are_within_the_bounds(path: str, setup_py: dict[str, Any]) -> None:
    known = pins(path)
    for requirement in all_of(setup_py, *setup_py['extras_require']):
        version = known.get(normal(requirement.name))
        assert version is None or requirement.specifier.contains(version), str(requirement)


def test_lock_file_has_every_requirement(setup_py: dict[str, Any]) -> None:
    known, lock = pins('requirements-dev.txt'), ROOT / 'requirements-dev.txt'
    assert len(re.findall(r'==\S+ --hash=sha256:[0-9a-f]{64}\n', lock.read_text())) == len(known)
    assert not {normal(each.name) for each in all_of(
        setup_py, *setup_py['extras_require'])} - {*known}
