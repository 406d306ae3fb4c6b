# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The computations of a session, and texts about their results.

**Worker process.** A separate process for computations: fits with their files, refinements and the
next pose.

In a thread of the node, the computations would share the interpreter with the stream, and messages
would wait up to 5 ms. The process has its own interpreter and runs only while the processor is
idle. A nice value is not enough, because the scheduler lets a nice process that was asleep finish
its slice of 3 ms. If the process gets too little time, it is restarted with normal priority.

Functions, arguments and results are pickled between the processes and never stored. The process
ends with the node in all cases, because its standard input is then closed. If the process cannot
be started or dies, the node does the computation itself.

"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from importlib import import_module
import os
import pickle
from queue import SimpleQueue
from select import select
import signal
import subprocess
import sys
from threading import Thread
from typing import Any, BinaryIO, TypeVar

import numpy as np

from .settings import CalibratorSettings
from ..calibrate import (
    Calibration,
    directions_of,
    fit_poses,
    level,
    next_pose,
    NextPose,
)
from ..calibrate.mounting import flat_direction
from ..effects import Context
from ..errors import counted, InputError, listed, RefusedFitError
from ..estimate.geometry import pose_noise
from ..model import Model
from ..refine import refine, Refinement
from ..table import Floats, Poses
from ..units import Units
from ..words import now, residual_words, verdict_words

_FEWEST_NATIVE = 4
"""Smallest number of poses to estimate the centre of native readings."""


def fitted(poses: Poses, units: Units, settings: CalibratorSettings, sensor: str,
           before: Calibration | None, context: Context) -> Calibration:
    """
    Return a fit with the mounting of the previous calibration.

    Parameters
    ----------
    poses : Poses
        All poses.
    units : Units
        Unit of the readings.
    settings : CalibratorSettings
        Model and method.
    sensor : str
        Name of the sensor.
    before : Calibration or None
        The previous calibration; its levelled frame is kept.
    context : mapping of str to array
        Columns that its effects need, one row.

    Raises
    ------
    RefusedFitError
        If the poses do not determine the model; the advice is how to turn the sensor next.
    InputError
        If the readings are clearly in another unit.

    """
    calibration = fit_poses(poses, units, model=settings.model, method=settings.method,
                            sensor=sensor, date=now())
    if before is None or not before.is_levelled:
        return calibration
    flat = flat_direction(before.frame) * before.force_per_g
    reading = before.predict(flat[np.newaxis], context)[0]
    headed = replace(calibration, model=Model(calibration.model.values, before.rotation),
                     frame=before.frame)
    return level(headed, reading, before.frame, context)


def refined(poses: Poses, units: Units, sensor: str, before: Calibration | None) -> Refinement:
    """
    Return the refinement of a calibration.

    Parameters
    ----------
    poses : Poses
        All poses.
    units : Units
        Unit of the readings.
    sensor : str
        Name of the sensor.
    before : Calibration or None
        The calibration in use; None: the model that a fit would select.

    Raises
    ------
    RefusedFitError
        If there are too few poses.
    InputError
        If the readings are clearly in another unit.

    """
    return refine(poses, units, base='auto' if before is None else before, sensor=sensor,
                  date=now())


def poses_up(poses: Poses, units: Units) -> Floats:
    """
    Return the approximate direction of up in each pose, before a fit.

    Returns
    -------
    (n, 3) array
        Unit vectors; n = 0 if the centre of native readings is not known.

    """
    if units.name == 'native' and len(poses) < _FEWEST_NATIVE:
        return np.zeros((0, 3))
    try:
        return directions_of(poses, units)
    except RefusedFitError:
        return np.zeros((0, 3))


def asked_for(poses: Poses, units: Units, model: str) -> NextPose:
    """Return the next pose, or that more poses no longer help."""
    up = poses_up(poses, units)
    noise = pose_noise(poses.noise, up)
    noise_g = None
    if noise is not None and units.name != 'native':
        noise_g = float(np.median(units.to_g(noise)))
    return next_pose(up, '10' if model == 'auto' else model, noise, noise_g=noise_g)


def next_action(asked: NextPose) -> str:
    """Return a text about the next action of the user."""
    if asked.direction is None:
        return f'{asked.words}; call ~/fit'
    return asked.words if np.isinf(asked.error) else f'{asked.words}, or call ~/fit'


def summary(calibration: Calibration) -> str:
    """Return the quality of a fit as one line."""
    quality = calibration.quality
    floor = ('' if quality.noise_floor_mg is None
             else f', noise floor {quality.noise_floor_mg:.3f} mg')
    words = [f'model {calibration.name} from {len(calibration.used_poses)} of '
             f'{counted(len(calibration.poses), "pose")}: residual {quality.rms_before_mg:.2f} mg '
             f'before, {quality.rms_after_mg:.3f} mg after{floor}']
    words += [f'pose {rejected.row} left out: {rejected.reason}'
              for rejected in calibration.rejected]
    return '; '.join([*words, *calibration.warnings])


def story(refinement: Refinement) -> str:
    """Return the result of a refinement as one line."""
    lines = [f'{verdict_words(refinement).rstrip(".")}; {residual_words(refinement)}']
    for step in refinement.steps:
        rivals = f' (or {", ".join(step.rivals)})' if step.rivals else ''
        lines.append(f'{step.effect}{rivals} {step.gap_before_mg:.3f} to '
                     f'{step.gap_after_mg:.3f} mg, {step.where}')
    if refinement.disturbed_poses:
        lines.append(f'left out: {listed("pose", refinement.disturbed_poses)}')
    return '; '.join([*lines, *refinement.calibration.warnings, *refinement.advice])


def title(calibration: Calibration) -> str:
    """Return a short description of a calibration."""
    return (f'model {calibration.name} of {calibration.date or "unknown date"}, '
            f'{calibration.quality.rms_after_mg:.3f} mg, '
            f'{"levelled" if calibration.is_levelled else "not levelled"}')


Found = TypeVar('Found')

_PATIENCE = 10.0
"""Time without an answer after which the process is restarted with normal priority [s]."""

_IDLE = 'idle'
"""Command line argument for a process that runs only while the processor is idle."""

_ONE_THREAD = ('OMP_NUM_THREADS', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')
"""Limits of the number of threads: arrays are small, so more threads would only wait."""

_IMPORTED = ('accel_calib.refine', 'scipy.linalg', 'scipy.special')
"""Modules imported at the start, so that the first fit is as fast as later ones."""


class WorkerProcess:
    """The interface of the node to the process; for one thread at a time."""

    def __init__(self) -> None:
        self._process: subprocess.Popen[bytes] | None = None
        self._closed = False
        self._idle = True

    def start(self) -> None:
        """Start the process unless it is running, without waiting for it."""
        if self._closed or (self._process is not None and self._process.poll() is None):
            return
        command = [sys.executable, '-m', __name__, *([_IDLE] if self._idle else [])]
        path = os.pathsep.join(filter(None, sys.path))
        environment = {**os.environ, 'PYTHONPATH': path, **dict.fromkeys(_ONE_THREAD, '1')}
        try:
            # In its own session it does not receive the Ctrl-C of a terminal.
            self._process = subprocess.Popen(
                command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                start_new_session=True)
        except OSError:
            self._process = None

    def call(self, function: Callable[..., Found], *given: Any) -> Found:
        """
        Call a function in the process and wait for its result.

        Parameters
        ----------
        function : callable
            A module-level function, which can be imported by name.
        *given
            Arguments that can be pickled.

        Returns
        -------
        object
            The result of the function. An error of the function is raised here, too.

        Raises
        ------
        InputError
            If the node is ending.

        """
        self.start()
        try:
            good, found = self._ask(function, given)
        except (OSError, EOFError, pickle.UnpicklingError):
            if self._closed:
                raise InputError('the node is shutting down', 'start it again') from None
            self._end()
            return function(*given)
        if not good:
            raise found
        return found

    def _ask(self, function: Callable[..., Any], given: tuple[Any, ...]) -> tuple[bool, Any]:
        process = self._process
        if process is None or process.stdin is None or process.stdout is None:
            raise EOFError
        process.stdin.write(pickle.dumps((function, given)))
        process.stdin.flush()
        if self._idle and not select([process.stdout], [], [], _PATIENCE)[0]:
            self._idle = False  # raising the priority needs privileges, so restart it
            self._end()
            self.start()
            return self._ask(function, given)
        answer: tuple[bool, Any] = pickle.load(process.stdout)
        return answer

    def close(self) -> None:
        """End the process; a waiting call raises InputError."""
        self._closed = True
        self._end()

    def _end(self) -> None:
        if self._process is not None:
            self._process.kill()
            self._process.wait()


def main() -> None:
    """Answer calls until standard input is closed; the main function of the process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    if _IDLE in sys.argv:
        os.sched_setscheduler(0, os.SCHED_IDLE, os.sched_param(0))
    answers = os.fdopen(os.dup(sys.stdout.fileno()), 'wb')
    os.dup2(sys.stderr.fileno(), sys.stdout.fileno())  # printed text must not mix with answers
    calls: SimpleQueue[Any] = SimpleQueue()
    Thread(target=_read, args=(sys.stdin.buffer, calls), daemon=True).start()
    for name in _IMPORTED:
        import_module(name)
    while True:
        answers.write(pickle.dumps(_answer(calls.get())))
        answers.flush()


def _read(stream: BinaryIO, calls: SimpleQueue[Any]) -> None:
    """Read calls; end the process when the node ends, even during a computation."""
    try:
        while True:
            calls.put(pickle.load(stream))
    finally:
        os._exit(0)


def _answer(call: Any) -> tuple[bool, Any]:
    function, given = call
    try:
        return True, function(*given)
    except Exception as error:  # raised again in the node, by `call`
        return False, error


if __name__ == '__main__':
    main()
