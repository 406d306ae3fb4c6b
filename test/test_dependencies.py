# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Requirements are bounded by what was tested, and the lock file is within the bounds."""

from __future__ import annotations

from pathlib import Path
import re
from typing import Any

import pytest
import test_packaging

requirements = pytest.importorskip('packaging.requirements')
Requirement = requirements.Requirement
setup_py = test_packaging.setup_py

ROOT = Path(__file__).parent.parent
PINNED = '.ci/ubuntu-24.04.txt', 'requirements-dev.txt'

FOR_USERS = ('report', 'logs', 'noise', 'completion')
"""Extras that users install. Exact versions of ROS are in the extra `ros`."""


def normal(name: str) -> str:
    """Return the normal form of the name of a distribution."""
    return re.sub(r'[-_.]+', '-', name).lower()


def pins(path: str) -> dict[str, str]:
    """Return the version by name of a file with exact versions."""
    lines = (ROOT / path).read_text(encoding='utf-8').splitlines()
    found = [line.split('==') for line in lines if line and not line.startswith('#')]
    return {normal(name): version for name, version in found}


def all_of(given: dict[str, Any], *extras: str) -> list[Any]:
    """Return the requirements of the package and of these extras."""
    texts = [*given['install_requires'], *(
        text for extra in extras for text in given['extras_require'][extra])]
    return [Requirement(text) for text in texts]


def test_requirements_of_users_have_an_upper_bound(setup_py: dict[str, Any]) -> None:
    for requirement in all_of(setup_py, *FOR_USERS):
        assert any(each.operator == '<' for each in requirement.specifier), str(requirement)


@pytest.mark.parametrize('path', PINNED)
def test_tested_versions_are_within_the_bounds(
        path: str, setup_py: dict[str, Any]) -> None:
    known = pins(path)
    for requirement in all_of(setup_py, *setup_py['extras_require']):
        version = known.get(normal(requirement.name))
        assert version is None or requirement.specifier.contains(version), str(requirement)


def test_lock_file_has_every_requirement(setup_py: dict[str, Any]) -> None:
    known = pins('requirements-dev.txt')
    assert not {normal(each.name) for each in all_of(
        setup_py, *setup_py['extras_require'])} - {*known}


def test_upper_bounds_exclude_versions_above_those_of_the_lock_file(
        setup_py: dict[str, Any]) -> None:
    known = pins('requirements-dev.txt')
    for requirement in all_of(setup_py, *FOR_USERS):
        major = int(known[normal(requirement.name)].split('.')[0])
        assert not requirement.specifier.contains(f'{major + 1}.0'), str(requirement)
