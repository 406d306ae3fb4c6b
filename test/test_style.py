# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The rules of the house that no linter knows: licence headers, and the way of the imports."""

import ast
from collections.abc import Iterator
from itertools import chain
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / 'accel_calib'

LAYERS = (
    ('errors',),
    ('table',),
    ('sphere', 'units'),
    ('effects',),
    ('model',),
    ('calibrate', 'capture', 'simulate'),
    ('refine',),
    ('imu', 'plain_effects'),
    ('plain',),
    ('plain_spread',),
    ('files',),
    ('report',),
    ('ros',),
    ('cli',),
)
"""Parts of the package, lowest first; each imports from those below it and from itself."""

RANKS = {part: rank for rank, layer in enumerate(LAYERS) for part in layer}
ROS = re.compile(r'rclpy|ament_\w+|launch(_\w+)?|tf2_\w+|rosidl_\w+|\w+_(msgs|srvs|interfaces)')


def python_files() -> list[Path]:
    """Give the Python files that are ours: not those in .venv, build and the like."""
    folders = ('accel_calib', 'benchmarks', 'docs', 'examples', 'launch', 'test', '.ci')
    found = chain.from_iterable((ROOT / folder).rglob('*.py') for folder in folders)
    return sorted([ROOT / 'setup.py', *found])


def other_files() -> list[Path]:
    """Give the files that run and are not Python."""
    scripts = sorted((ROOT / 'scripts').iterdir())
    return [ROOT / 'Makefile', ROOT / '.ci' / 'run', ROOT / 'pyproject.toml', *scripts]


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imports_of(path: Path) -> Iterator[str]:
    """Give the full names of what a module imports, wherever in it, for types alone too."""
    package = path.parent.relative_to(ROOT).parts
    for node in ast.walk(ast.parse(path.read_text(encoding='utf-8'))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            above = package[:len(package) + 1 - node.level] if node.level else ()
            module = '.'.join((*above, *filter(None, [node.module])))
            yield from (f'{module}.{alias.name}' for alias in node.names)


def part_of(path: Path) -> str:
    return path.relative_to(PACKAGE).with_suffix('').parts[0]


MODULES = sorted(PACKAGE.rglob('*.py'))


@pytest.mark.parametrize('path', [*python_files(), *other_files()], ids=name_of)
def test_each_file_has_the_licence_header(path: Path) -> None:
    header = (PACKAGE / 'errors.py').read_text(encoding='utf-8').split('\n\n')[0]
    text = path.read_text(encoding='utf-8')
    without_shebang = re.sub(r'\A#!.*\n', '', text)
    assert without_shebang.startswith(f'{header}\n')


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_imports_point_one_way(path: Path) -> None:
    part = part_of(path)
    if part == '__init__':
        assert not [name for name in imports_of(path) if name.startswith('accel_calib')]
        return
    assert part in RANKS, f'say in LAYERS where {part} belongs'
    inside = [name for name in imports_of(path) if name.startswith('accel_calib.')]
    others = {name.split('.')[1] for name in inside} - {part, '__version__'}
    wrong = {other for other in others if RANKS.get(other, len(LAYERS)) >= RANKS[part]}
    assert not wrong, f'{part} imports {wrong}, which is not below it'


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_only_the_nodes_import_ros(path: Path) -> None:
    ros = {name for name in imports_of(path) if ROS.fullmatch(name.split('.')[0])}
    assert part_of(path) == 'ros' or not ros


@pytest.mark.parametrize('linter', ['ament_flake8', 'ament_pep257'])
def test_linters_of_ament_find_nothing(linter: str) -> None:
    main = pytest.importorskip(f'{linter}.main', reason='not on PyPI').main
    paths = [ROOT / name for name in ('accel_calib', 'launch', 'setup.py', 'test')]
    assert main([str(path) for path in paths]) == 0
