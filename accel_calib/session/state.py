# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The state of a session, as its topics and pages show it."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from .guidance import Progress
from .health import Health
from .sensor import title
from .stream import Newest, SILENT
from .work import is_partial
from ..calibrate import mounting_words, Outside, outside
from ..messages.one_reading import Triple

if TYPE_CHECKING:
    from .session import Session


def progress(session: Session, reading: Triple | None = None) -> Progress:
    """
    Return the progress of the calibration.

    Parameters
    ----------
    session : Session
        The session.
    reading : (float, float, float), optional
        The newest reading; by default the last one that was pushed.

    """
    sensor, statistics = session.sensor, session.statistics
    plan, silent = sensor.guide.plan, statistics.age > SILENT
    newest = Newest() if silent else _newest(session, reading)
    direction = None if plan is None or sensor.all_fitted else plan.asked.direction
    return Progress(
        still=session.still and not silent,
        stillness=math.nan if silent else sensor.stillness(statistics),
        dwell=statistics.stamp - session.still_since if session.still else 0.0,
        min_dwell=session.settings.min_dwell, poses=sensor.guide.poses,
        total=0 if plan is None else plan.asked.total,
        coverage=0.0 if plan is None else plan.coverage,
        accuracy=math.nan if plan is None else plan.asked.error * plan.noise_g,
        advice=sensor.advice, direction=() if direction is None else tuple(direction.tolist()),
        up=newest.up, length=newest.length, corrected=newest.corrected,
        temperature=statistics.temperature)


def _newest(session: Session, reading: Triple | None) -> Newest:
    """Return direction and length of the newest reading; the parameter is as in `progress`."""
    sensor, statistics = session.sensor, session.statistics
    if reading is None:
        if statistics.newest is None:
            return Newest()
        reading = tuple(statistics.newest.tolist())
    calibration, plan, known = sensor.present, sensor.guide.plan, statistics.context
    if calibration is not None:
        known = {**sensor.temperatures.columns_of(calibration.model), **known}
    return sensor.newest.described(reading, calibration, known,
                                   () if plan is None else plan.zero)


def health(session: Session) -> Health:
    """Return the state for the diagnostics."""
    sensor, statistics, store = session.sensor, session.statistics, session.files.store
    detector, poses = sensor.live.detector, sensor.live.book.poses()
    calibration, breaks = sensor.calibration, detector.interruptions
    rest_ago = math.nan
    if sensor.rest is not None:
        rest_ago = 0.0 if sensor.live.still else max(0.0, statistics.stamp - sensor.rest.end)
    return Health(
        sensor=session.name, state=_state(session), problem=session.problem, topic=session.topic,
        publishers=session.publishers, mismatches=session.mismatches,
        calibration='' if calibration is None else title(calibration),
        outside='; '.join(each.words for key, each in limits_left(session).items()
                          if key != 'std'),
        file='' if store is None else str(store.calibration),
        writable=store is None or store.is_writable(), statistics=statistics,
        length=statistics.length_g(session.units), rest_ago=rest_ago, residual=sensor.residual,
        drift=sensor.drift, poses=len(poses),
        doubtful=int(np.sum(poses['doubtful'])) if 'doubtful' in poses else 0,
        interruptions=len(breaks),
        last_interruption=f'{breaks[-1].kind}, {breaks[-1].seconds:.2f} s' if breaks else '',
        threshold=detector.threshold, next_pose=sensor.advice,
        mounting='' if calibration is None or not calibration.is_levelled else mounting_words(
            calibration.rotation, session.frame_id or '', session.settings.base_frame),
        gyro=sensor.gyro, noise=sensor.noise)


def limits_left(session: Session) -> dict[str, Outside]:
    """Return the quantities that are outside of the range of the calibration now."""
    sensor = session.sensor
    if sensor.calibration is None:
        return {}
    known = {**session.statistics.context, 'std': np.zeros(3), **sensor.temperatures.columns}
    now = {key: np.array([value]) for key, value in known.items()}
    return {key: each for key, each in outside(sensor.calibration, now).items() if each.count}


def _state(session: Session) -> str:
    sensor = session.sensor
    if session.files.problem:
        return 'another node uses the files, nothing is published'
    if not session.enabled:
        return 'correction switched off, raw messages are published'
    if sensor.offered is not None:
        return 'a new calibration waits for ~/save or ~/undo'
    if sensor.calibration is not None:
        return ('correcting, with a calibration of a part of the orientations'
                if is_partial(sensor.calibration) else 'correcting')
    if not session.statistics.messages:
        return 'waiting for the first message'
    return ('no calibration, raw messages are published' if session.settings.passthrough
            else 'no calibration, nothing is published')
