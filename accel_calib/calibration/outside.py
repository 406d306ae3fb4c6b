# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The context of samples, compared with the range of the poses of a calibration."""

from dataclasses import dataclass, replace

import numpy as np

from .calibration import Calibration
from ..effects import Context, context_of_samples, entry_of, thermal_stream, variable_of
from ..units import over_axes


@dataclass(frozen=True)
class Outside:
    """
    A column of the context, compared with the range of a calibration.

    `count` of all `samples` are outside of the range `low` to `high` of the poses. All samples
    range from `least` to `most`.

    """

    key: str
    count: int
    samples: int
    low: float
    high: float
    least: float
    most: float


def outside(calibration: Calibration, known: Context) -> dict[str, Outside]:
    """Return the comparison of each column that has a range; ``count`` is 0 if all are inside."""
    found, ranges = {}, dict(calibration.ranges)
    ends = [values[-2:] for name, values in calibration.model.values.items()
            if variable_of(name) == 'std']
    if ends:  # empirical curves over the vibration
        ranges['std'] = float(np.max(ends, axis=0)[0]), float(np.min(ends, axis=0)[1])
    for key, (low, high) in ranges.items():
        values = over_axes(known[key]) if key in known else np.zeros(0)
        values = values[np.isfinite(values)]
        if len(values):
            count = int(np.sum((values < low) | (values > high)))
            found[key] = Outside(key, count, len(values), low=low, high=high,
                                 least=float(np.min(values)), most=float(np.max(values)))
    return found


class SampleContext:
    """The context of the samples of a log, block by block, and what leaves its ranges."""

    def __init__(self, calibration: Calibration) -> None:
        self._calibration = calibration
        self._thermal = thermal_stream(calibration.model)
        self._compared: dict[str, Outside] = {}
        self.lacking = ''

    def of(self, known: Context, count: int) -> Context:
        """Return the context of the next block as `context_of_samples` does."""
        model = self._calibration.model
        context = context_of_samples(known, count, model, self._thermal)
        self.lacking = ''
        if lacking := [key for key in model.neutral if key not in known]:
            names = [str(each) for each in model.effects if {*entry_of(each).needs} & {*lacking}]
            self.lacking = (f'the samples have no {" and ".join(lacking)}: {" and ".join(names)} '
                            f'{"is" if len(names) == 1 else "are"} not corrected')
        for key, block in outside(self._calibration, context).items():
            before = self._compared.get(key)
            self._compared[key] = block if before is None else replace(
                block, count=before.count + block.count, samples=before.samples + block.samples,
                least=min(before.least, block.least), most=max(before.most, block.most))
        return context

    @property
    def left(self) -> list[Outside]:
        """Return the quantities that have left the range of the calibration so far."""
        return [each for each in self._compared.values() if each.count]
