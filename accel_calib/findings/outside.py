# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The words of a context outside of the range of a calibration."""

from ..calibration import Outside
from ..table import column_of
from ..text import counted
from ..units import MG

USES_LIMIT = 'the correction uses the limit of the range'

_QUANTITIES: dict[str, tuple[str, str, float]] = {
    'time': ('time since the start of the calibration', 'h', 1.0 / 3600.0),
    'temperature_rate': ('rate of temperature', '°C/min', 60.0),
    'std': ('vibration', 'mg', MG)}
"""Name, unit and factor of the quantities that are not shown as in `accel_calib.table`."""


def outside_words(found: Outside) -> str:
    """Return what was found, and the range of the calibration; times from the first pose."""
    name, unit, factor = _QUANTITIES.get(found.key) or (
        found.key.replace('_', ' '), column_of(found.key).unit, 1.0)
    start, shown = found.low if found.key == 'time' else 0.0, []
    for low, high in ((found.least, found.most), (found.low, found.high)):
        first, last = (f'{(value - start) * factor:.4g}' for value in (low, high))
        shown.append(f'{first if first == last else f"{first} to {last}"} {unit}'.rstrip())
    return f'{name} is {shown[0]}, but the range of the calibration is {shown[1]}'


def outside_line(found: Outside) -> str:
    """Return a line about a recording."""
    return (f'{found.count} of {counted(found.samples, "sample")} are outside of the range of '
            f'the calibration: {outside_words(found)}; {USES_LIMIT}')
