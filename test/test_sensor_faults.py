# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of sensors are named, and never calibrated; `benchmarks/sensor_faults.py` counts them."""

from pathlib import Path

from faults.sample import FACTOR
import pytest
from sensor_faults import counted, FAULTS, OF_TEXT, SURFACES

CASES = []
for k, fault in enumerate(FAULTS):
    known = [each for each in SURFACES if fault not in OF_TEXT or each not in ('bag', 'node')]
    CASES += [(fault, each) for each in (known if FACTOR > 1 else [known[k % len(known)]])]
"""Each fault on one of the surfaces where it can be; on all in a long series."""


@pytest.mark.parametrize(('name', 'surface'), CASES)
def test_a_fault_is_named_and_never_calibrated_as_it_is(
        name: str, surface: str, tmp_path: Path) -> None:
    found = counted(name, surface, 1, 7, tmp_path)
    signs_of_messages = name == 'lost sign' and surface in ('bag', 'node')
    assert found['named'] == 1
    assert found['wrong'] == 0
    assert found['calibrated'] == (FAULTS[name].right and not signs_of_messages) or (
        name == 'clipped')  # the poses inside the limit may be enough
    assert found['false'] == 0 or name != 'none'
