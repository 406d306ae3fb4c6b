# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Rules of the project that linters do not check: imports between parts, and those of tests."""

import ast
from collections.abc import Iterator
from functools import cache
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / 'accel_calib'

LAYERS = (
    'text units < errors statistics < disk finding < table < geometry < effects '
    '< logs < stillness estimate < calibration < refinement < comparison noise < findings '
    '< stored < pipeline < messages < report < api session < fleet live < ros < cli')
"""Parts of the package, lowest first. Each part imports only from lower parts and itself."""

RANKS = {part: rank for rank, layer in enumerate(LAYERS.split('<')) for part in layer.split()}
ROS = re.compile(r'rclpy|ament_\w+|launch(_\w+)?|tf2_\w+|rosidl_\w+|\w+_(msgs|srvs|interfaces)')

MODULES = sorted(PACKAGE.rglob('*.py'))
BASE = {f'accel_calib.{name}' for name in (
    'disk', 'errors', 'finding', 'geometry', 'statistics', 'table', 'text', 'units')}
"""Modules that tests import from directly."""

FACES = {'accel_calib', *(f'accel_calib.{each.parent.name}'
                          for each in PACKAGE.glob('*/__init__.py'))}
"""The package and its folders; tests import what they export."""

GATHERED = [ROOT / 'test' / name for name in ('inside.py', 'inside_ros.py')]
TESTS = sorted({*(ROOT / 'test').rglob('*.py')} - {*GATHERED})


@cache
def nodes_of(path: Path) -> list[ast.AST]:
    """Return the nodes of the syntax tree of a module, the module itself first."""
    return [*ast.walk(ast.parse(path.read_text(encoding='utf-8')))]


def imports_of(path: Path) -> Iterator[str]:
    """Yield the full names that a module imports, including those for types."""
    package = path.parent.relative_to(ROOT).parts
    for node in nodes_of(path):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[:len(package) + 1 - node.level] if node.level else ()
            module = '.'.join((*above, *filter(None, [node.module])))
            yield from (f'{module}.{alias.name}' for alias in node.names)


def test_imports_point_one_way_and_only_the_nodes_import_ros() -> None:
    for path in MODULES:
        part, names = path.relative_to(PACKAGE).with_suffix('').parts[0], [*imports_of(path)]
        ros = {name for name in names if ROS.fullmatch(name.split('.')[0])}
        assert part == 'ros' or not ros, path
        if part == '__init__':
            continue  # imports the public names only for types
        inside = {name.split('.')[1] for name in names if name.startswith('accel_calib.')}
        above = {other for other in inside - {part, '__version__'}
                 if other not in RANKS or RANKS[other] >= RANKS[part]}
        assert not above, f'{path} imports {above}, which is not below it in LAYERS'


def test_no_constant_stands_in_two_files() -> None:
    """Sizes of buffers, which are powers of two, and their largest number may be equal."""
    found: dict[float, set[Path]] = {}
    for path in MODULES:
        for node in nodes_of(path):
            if isinstance(node, ast.Constant) and type(node.value) in (int, float):
                digits = repr(node.value).partition('e')[0].replace('.', '').strip('0')
                whole = node.value == int(node.value) and int(node.value)
                if len(digits) > 3 and not (whole and (
                        whole & (whole - 1) == 0 or whole & (whole + 1) == 0)):
                    found.setdefault(node.value, set()).add(path)
    assert not {value: paths for value, paths in found.items() if len(paths) > 1}


def module_of(name: str) -> str:
    """Return the module of a full name: its longest part that is a file or a folder."""
    path = ROOT / name.replace('.', '/')
    known = path.is_dir() or path.with_suffix('.py').is_file()
    return name if known else module_of(name.rpartition('.')[0])


def is_on_a_face(name: str) -> bool:
    """Return whether a full name is a base module or a face, or is exported by one."""
    module, _, what = name.rpartition('.')
    face = imports_of(PACKAGE.joinpath(*module.split('.')[1:], '__init__.py'))
    return name in BASE | FACES or module in BASE or (module in FACES and any(
        each.startswith('accel_calib.') and each.endswith(f'.{what}') for each in face))


def strings_of(path: Path) -> Iterator[str]:
    """Yield the full names of modules in the strings of a test."""
    for node in nodes_of(path):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            text = re.sub(r'from (accel_calib[\w.]*) import (\w+)', r'\1.\2', node.value)
            yield from map(module_of, re.findall(r'accel_calib(?:\.\w+)*', text))


def test_tests_name_no_file_of_the_package() -> None:
    for path in TESTS:
        imported = [name for name in imports_of(path) if name.split('.')[0] == 'accel_calib']
        wrong = [name for name in (*imported, *strings_of(path)) if not is_on_a_face(name)]
        assert not wrong, f'{path}: import {wrong} through a face or {GATHERED[0].name}'


@pytest.mark.parametrize('path', GATHERED)
def test_names_are_gathered_only_for_tests_that_use_them(path: Path) -> None:
    nodes = nodes_of(path)
    of_classes = {each for node in nodes if isinstance(node, ast.ClassDef)
                  for each in ast.walk(node)}
    imported = {each.asname or each.name for node in nodes if isinstance(node, ast.ImportFrom)
                for each in node.names}
    names = [node for node in nodes if isinstance(node, ast.Name)]
    here = {node.id for node in names if isinstance(node.ctx, ast.Load)}
    made = {node.id for node in names if node not in of_classes} - here
    used = {name.removeprefix(f'{path.stem}.') for test in TESTS for name in imports_of(test)}
    unused = (imported | made) - here - used
    assert imported
    assert not unused, f'remove {unused}'


@pytest.mark.parametrize('linter', ['ament_flake8', 'ament_pep257'])
def test_linters_of_ament_find_nothing(linter: str) -> None:
    main = pytest.importorskip(f'{linter}.main', reason='not on PyPI').main
    paths = [ROOT / name for name in ('accel_calib', 'launch', 'setup.py', 'test')]
    assert main([str(path) for path in paths]) == 0
