# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Rules of the project that linters do not check: imports between parts."""

import ast
from collections.abc import Iterator
from pathlib import Path
import re

import pytest

ROOT = Path(__file__).parent.parent
PACKAGE = ROOT / 'accel_calib'

LAYERS = (
    ('crash', 'errors', 'html_table', 'significant', 'units'),
    ('table',),
    ('sphere', 'rotations', 'thermal'),
    ('effects',),
    ('model',),
    ('capture', 'estimate', 'simulate'),
    ('allan', 'calibrate'),
    ('one_reading', 'refine'),
    ('compare', 'monitor'),
    ('messages',),
    ('files', 'words'),
    ('rating',),
    ('intake', 'pipeline', 'report'),
    ('api', 'fleet', 'session'),
    ('live',),
    ('ros',),
    ('cli',),
)
"""Parts of the package, lowest first. Each part imports only from lower parts and itself."""

RANKS = {part: rank for rank, layer in enumerate(LAYERS) for part in layer}
ROS = re.compile(r'rclpy|ament_\w+|launch(_\w+)?|tf2_\w+|rosidl_\w+|\w+_(msgs|srvs|interfaces)')


def name_of(path: Path) -> str:
    return str(path.relative_to(ROOT))


def imports_of(path: Path) -> Iterator[str]:
    """Yield the full names that a module imports, including those for types."""
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


@pytest.mark.parametrize('path', MODULES, ids=name_of)
def test_imports_point_one_way(path: Path) -> None:
    part = part_of(path)
    if part == '__init__':
        return  # imports the public names only for types
    assert part in RANKS, f'add {part} to LAYERS'
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
