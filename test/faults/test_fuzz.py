# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A part of the seeded damage of fuzz.py: every file ends in a result or in one line."""

from importlib.util import find_spec

from faults.fuzz import outcomes, READERS
import pytest

_CASES = {'ulg': 60, 'bin': 60}
_NEEDED = {'ulg': 'pyulog', 'bin': 'pymavlink'}


@pytest.mark.parametrize('kind', READERS)
def test_a_damaged_file_ends_in_a_result_or_in_one_line(kind: str) -> None:
    if kind in _NEEDED and find_spec(_NEEDED[kind]) is None:
        pytest.skip(f'{_NEEDED[kind]} is not installed')
    for case, outcome in outcomes(kind, _CASES.get(kind, 250), seed=5):
        assert outcome in ('read', 'refused'), f'case {case}: {outcome}'
