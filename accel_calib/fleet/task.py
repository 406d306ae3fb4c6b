# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
One recording to one row: capture, fit, refine, rate.

`calibrated_row` runs on a worker. It needs bounded memory: a log is read in blocks, and the row
has a bounded size. Errors that belong to the recording are part of the row. Errors of the store,
such as a full disk, are raised: they concern all recordings.

"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
import hashlib
import json
import os
from pathlib import Path
import time
from typing import Any

import numpy as np

from .inputs import as_folder, content_hash, date_of, Input, matched, on_disk, sensor_of, UNKNOWN
from .store import Row, Store
from .. import __version__
from ..calibrate import Calibration, determines, directions_of, fit_poses
from ..compare import NAMES, rotation_free
from ..disk import write_atomically
from ..effects import MODELS
from ..errors import AccelCalibError, crash_words, RefusedFitError, system_error
from ..findings import residual_figures
from ..intake import Intake, poses_of
from ..logs import LogOptions
from ..pipeline import calibrated, Outcome, Plan
from ..stored import write_calibration
from ..stored.exports import export
from ..table import Poses

RESULTS = 2
"""Version of the rows. Another version makes all recordings be calibrated again."""

STATUS = ('ok', 'error', 'unread', 'skipped')
"""What can happen to a recording; unread: it could not be read, and is tried again."""

_WHOLE_MODEL = '10'


@dataclass(frozen=True)
class Options:
    """
    How the recordings of a fleet are calibrated.

    Parameters
    ----------
    sensor_from, model_from : str
        Regular expressions for the name of the sensor in the path, and for its model in its name.
    log : LogOptions
        How to read the logs.
    settings : dict
        Fields of `accel_calib.capture.CaptureSettings`.
    refined : bool
        Look for effects beyond offset, gain and cross-axis.
    exports : tuple of str
        Formats of `accel_calib.stored.exports.FORMATS` to write beside each calibration.

    """

    sensor_from: str = ''
    model_from: str = ''
    log: LogOptions = LogOptions()
    settings: dict[str, Any] = field(default_factory=dict)
    refined: bool = True
    exports: tuple[str, ...] = ()


@dataclass(frozen=True)
class Done:
    """
    What a worker returns to the program: little, whatever the recording.

    Parameters
    ----------
    key : str
        Key of the result; empty if the recording could not be read.
    status : str
        What happened, one of `STATUS`.
    row : dict or None
        The row, if it is not in the store: for a recording that could not be read.

    """

    key: str
    status: str
    row: Row | None = None


def calibrate_recording(found: Input, options: Options, store: Store) -> Done:
    """
    Calibrate one recording, and add the result to the store.

    Parameters
    ----------
    found : Input
        The recording.
    options : Options
        How to calibrate it.
    store : Store
        Where results are written.

    Returns
    -------
    Done
        What happened.

    Raises
    ------
    OSError
        If the result cannot be written.

    """
    begin = time.perf_counter()
    try:
        with on_disk(found.path) as path:
            content = content_hash(path)
            key = key_of(content, found, options)
            if store.has(key):
                return Done(key, 'skipped')
            row, calibration = _result(found, path, options)
    except (OSError, EOFError) as err:
        error = system_error(err if isinstance(err, OSError) else OSError(str(err)))
        return Done('', 'unread', unread_row(found, options, error))
    except AccelCalibError as err:  # an address without its package, or a missing match
        return Done('', 'unread', unread_row(found, options, err))
    row |= {'key': key, 'content': content, 'seconds': time.perf_counter() - begin}
    if calibration is not None:
        name = f'calibrations/{as_folder(row["sensor"])}/{key}.yaml'
        (store.folder / name).parent.mkdir(parents=True, exist_ok=True)
        write_calibration(store.folder / name, calibration, keep_before=False)
        row['calibration'] = name
        row['warnings'] += _exported(calibration, store.folder / name, options.exports)
    store.add(row)
    return Done(key, row['status'])


def _exported(calibration: Calibration, path: Path, formats: Sequence[str]) -> list[str]:
    """Write exports beside a calibration; return what they do not hold, or why there is none."""
    found = []
    for name in formats:
        try:
            made = export(calibration, name)
        except AccelCalibError as err:
            found.append(f'no export to {name}: {err}')
            continue
        end = Path(made.suffix).suffix or made.suffix  # two formats have the same suffix
        write_atomically(path.with_name(f'{path.stem}_{name}{end}'), made.write)
        found += [f'{name}: {line}' for line in made.losses]
    return found


def key_of(content: str, found: Input, options: Options) -> str:
    """Return the key of a result: content, name from the path, version and options."""
    try:
        place = sensor_of(found, '', options.sensor_from)
    except AccelCalibError as err:
        place = str(err)
    about = json.dumps([content, place, __version__, RESULTS, asdict(options)], default=str,
                       sort_keys=True)
    return hashlib.blake2b(about.encode(), digest_size=16).hexdigest()


def _result(found: Input, path: Path, options: Options) -> tuple[Row, Calibration | None]:
    """Return the row of a recording, and its calibration unless it is BAD or failed."""
    row = _about(found, options, None, path)
    try:
        intake = poses_of(path, options.log, options.settings)
        row = _about(found, options, intake.poses, path)
        outcome = calibrated(intake.poses, intake.units, Plan(
            sensor=row['sensor'], refined=options.refined))
    except OSError:
        raise  # it may be possible to read it later
    except AccelCalibError as err:
        return {**row, **failed(err, {str(path): found.path})}, None
    except Exception as err:  # a defect of this program must not stop the other recordings
        return {**row, 'status': 'error', 'error': crash_words(err),
                'advice': 'report it, with the recording'}, None
    calibration = replace(outcome.calibration, date=row['date'])
    stored = outcome.rating.name != 'BAD'
    return {**row, **_figures(intake, outcome)}, calibration if stored else None


def failed(error: AccelCalibError, names: Mapping[str, str] = {}) -> Row:
    """Return the columns of an error, with these names for those of temporary copies."""
    message = error.message
    for local, name in names.items():
        message = message.replace(local, name)
    return {'status': 'error', 'error': message, 'advice': error.advice}


def unread_row(found: Input, options: Options, error: AccelCalibError) -> Row:
    """Return the row of a recording that could not be read."""
    return {**_about(found, options, None, None), **failed(error), 'status': 'unread'}


def _about(found: Input, options: Options, poses: Poses | None, path: Path | None) -> Row:
    """Return the columns about a recording: sensor, model and date."""
    row: Row = {'recording': found.path, 'version': __version__, 'sensor': UNKNOWN}
    row['date'], row['date_from'] = date_of(
        found, poses, os.stat(path).st_mtime if path and '://' not in found.path else None)
    row['sensor_model'] = ''
    try:
        row['sensor'] = sensor_of(found, poses.sensor if poses else '', options.sensor_from)
        if options.model_from:
            row['sensor_model'] = matched(options.model_from, row['sensor'], '--model-from')
    except AccelCalibError:
        if poses is not None:
            raise
    return row


def _figures(intake: Intake, outcome: Outcome) -> Row:
    """Return the columns of a calibration and its rating."""
    calibration, quality = outcome.calibration, outcome.calibration.quality
    poses = calibration.used_poses
    warm = float(np.median(poses['temperature'])) if 'temperature' in poses else None
    deviation = np.sqrt(np.diag(calibration.covariance))
    return {
        'status': 'ok', 'rating': outcome.rating.name, 'rating_reason': outcome.rating.reason,
        'model': calibration.name, 'effects': list(calibration.model.effects),
        'refined': outcome.line, 'units': intake.units.name, 'poses': len(calibration.poses),
        'poses_used': len(poses), 'coverage': quality.coverage,
        **{figure.key: figure.value for figure in residual_figures(quality)},
        'temperature': warm, 'warnings': list(calibration.warnings),
        'determined': determines(_WHOLE_MODEL, directions_of(poses, intake.units)),
        'parameters': [{'name': name, 'value': value, 'sd': sd} for name, value, sd in zip(
            calibration.parameters, calibration.model.vector.tolist(), deviation.tolist(),
            strict=True)],
        **_linear(calibration), **_for_prior(intake, calibration)}


def _linear(calibration: Calibration) -> Row:
    """Return V and S with their standard deviations, at the middle of the context."""
    free = rotation_free(calibration, calibration.typical_context(1), calibration.units.per_g)
    variance = np.einsum('tp,pq,tq->t', free.slope, calibration.covariance, free.slope)
    return {column: float(value) for k, name in enumerate(NAMES) for column, value in (
        (name, free.values[k]), (f'{name}.sd', np.sqrt(max(variance[k], 0.0))))}


def _for_prior(intake: Intake, found: Calibration) -> Row:
    """Return values and covariance of model 10, if the poses determine it."""
    if intake.units.is_native:
        return {}
    if found.model.effects != MODELS[_WHOLE_MODEL].effects:
        try:
            found = fit_poses(intake.poses, intake.units, model=_WHOLE_MODEL)
        except RefusedFitError:
            return {}
    return {'prior_values': found.model.vector.tolist(),
            'prior_covariance': found.covariance.ravel().tolist()}
