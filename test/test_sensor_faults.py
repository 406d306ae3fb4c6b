# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Faults of sensors are named, and never calibrated; `benchmarks/sensor_faults.py` counts them."""

from pathlib import Path

import pytest
from sensor_faults import counted, FAULTS, OF_TEXT, SURFACES

CASES = [(name, surface) for k, name in enumerate(FAULTS) for j, surface in enumerate(SURFACES)
         if j in (k % 4, (k + 1) % 4) and not (name in OF_TEXT and surface in ('bag', 'node'))]


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
