# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A part of the seeded cases of fuzz.py: every file ends in a result or in one line."""

from importlib.util import find_spec

from faults.fuzz import KINDS, outcomes
from faults.sample import FACTOR
import pytest

CASES = 30 * FACTOR
_NEEDED = {'ulg': 'pyulog', 'bin': 'pymavlink'}


@pytest.mark.parametrize('kind', KINDS)
def test_a_damaged_file_ends_in_a_result_or_in_one_line(kind: str) -> None:
    if kind in _NEEDED and find_spec(_NEEDED[kind]) is None:
        pytest.skip(f'{_NEEDED[kind]} is not installed')
    found = dict(outcomes(kind, CASES, seed=5))
    assert not {case: each for case, each in found.items() if each not in ('read', 'refused')}
    assert {*found.values()} == {'read', 'refused'}
