# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
A demonstration of ``~/refine``: the simulated sensor hides an effect, and the node finds it.

The sensor turns through poses while its temperature swings. After the fit, the corrected topic
still differs from the truth, because the fitted model lacks the effect. ``~/refine`` adds it, and
the next rests show what remains.

"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass
from functools import partial
from pathlib import Path
import tempfile
import time

import numpy as np

from .demo import at_least, call, rests_of, rms, running, set_environment, Spin, User, user_of
from ..files import read_calibration
from ..table import Floats
from ..units import MG


@dataclass(frozen=True)
class Hidden:
    """An effect that the simulated sensor hides: its name, and the effect as a parameter."""

    effect: str
    parameter: str


HIDDEN = {
    'temperature': Hidden('offset_temperature', 'offset_temperature=4e-4,-3e-4,5e-4'),
    'temperature-lag': Hidden('offset_temperature', 'offset_temperature=8e-4,-6e-4,1e-3,12,0'),
    'gain-temperature': Hidden('gain_temperature', 'gain_temperature=5e-4,-4e-4,6e-4'),
    'quadratic': Hidden('quadratic', 'quadratic=0.004,-0.003,0.005')}
"""What the sensor can hide. A lag is that of the die, 12 s."""

_KNOWN = ['offset=0.03,-0.02,0.04', 'axis_gain=0.012,-0.015,0.008',
          'cross_axis=0.006,-0.004,0.003']
_FITTED, _CHECKED, _POSES = 16, 10, 48
_SIMULATOR = {
    'poses': _POSES, 'mixed': True, 'dwell': 1.2, 'turn': 0.4, 'temperature': [17.0, 33.0],
    'temperature_period': 40.0, 'wait': 10.0}
_NODE = {'sensor': 'demo', 'still_window': 0.25, 'min_dwell': 0.6}


@dataclass(frozen=True)
class HiddenOutcome:
    """
    What ``~/refine`` found, and the errors of the corrected topic before and after.

    Parameters
    ----------
    hidden : str
        The hidden effect.
    found : tuple of str
        The effects of the refined calibration that the fit did not contain.
    lag_s : float
        Lag of the found effect [s]; 0: none.
    rests : int
        Number of rests before, and after.
    rms_before_mg, rms_after_mg : float
        RMS of the difference between ``imu/data_calibrated`` and the truth [mg].
    seconds : float
        Duration of the demonstration.

    """

    hidden: str
    found: tuple[str, ...]
    lag_s: float
    rests: int
    rms_before_mg: float
    rms_after_mg: float
    seconds: float

    @property
    def succeeded(self) -> bool:
        """Return whether the effect is found and the error is smaller."""
        return self.hidden in self.found and self.rms_after_mg < self.rms_before_mg


def demonstrate_hidden(hidden: str, report: Callable[[str], None]) -> HiddenOutcome:
    """
    Run the demonstration.

    Parameters
    ----------
    hidden : str
        A key of `HIDDEN`.
    report : callable
        Function that is called with a line for each step.

    Raises
    ------
    DemoError
        If a step takes too long, or a service refuses.

    """
    began, given = time.monotonic(), HIDDEN[hidden]
    with tempfile.TemporaryDirectory(prefix='accel_calib_demo_') as folder, ExitStack() as stack:
        set_environment(Path(folder))
        report(f'starting the calibrator node and a simulated Imu that hides {given.parameter}')
        processes = [stack.enter_context(running('node', _NODE)),
                     stack.enter_context(running('simulator', {
                         **_SIMULATOR, 'effects': [*_KNOWN, given.parameter]}))]
        user, spin = stack.enter_context(user_of(processes))
        spin(lambda: user.poses > 0, 'the first pose')
        for count in range(4, _FITTED + 1, 4):
            spin(partial(at_least, user, count), f'{count} poses')
            report(f'captured {count} poses')
        report(f'~/fit: {call(user, spin, "fit")}')
        stored = Path(folder) / 'accel_calib' / 'demo.yaml'
        fitted = read_calibration(stored).model
        before = _errors(user, spin, report)
        report(f'~/refine: {call(user, spin, "refine")}')
        refined = read_calibration(stored).model
        after = _errors(user, spin, report)
        lag = refined.lags.get('temperature_of_offset')
        return HiddenOutcome(
            given.effect, tuple(name for name in refined.effects if name not in fitted.effects),
            0.0 if lag is None else lag.seconds, _CHECKED, rms(before), rms(after),
            time.monotonic() - began)


def _has_rested(user: User, count: int) -> bool:
    return len(rests_of(user)) > count


def _errors(user: User, spin: Spin, report: Callable[[str], None]) -> Floats:
    """Return the error of the corrected topic at the next rests [mg], and report each."""
    for messages in user.messages.values():
        messages.clear()
    errors = []
    for count in range(_CHECKED):
        spin(partial(_has_rested, user, count + 2), 'the next rest')
        rest = rests_of(user)[count + 1]
        errors.append(float(np.linalg.norm(rest['corrected'] - rest['truth'])) * MG)
        report(f'  rest {count + 1:2d} of {_CHECKED}, now {user.temperature:.1f} °C: '
               f'imu/data_calibrated is {errors[-1]:5.2f} mg from the truth')
    return np.array(errors)
