# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Stored calibrations: readable, versioned YAML.

`format_calibration` and `parse_calibration` convert text. Only `write_calibration` and
`read_calibration` access the disk. The reader checks every value, and the calibration then passes
the same gate as a fit (`accel_calib.calibrate.gate`). The last line of a file is a checksum of the
text before it; it reveals a file that was edited by hand.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .atomic import write_atomically
from .. import __version__
from ..calibrate import (
    Calibration,
    EDITED,
    FRAMES,
    gated,
    GyroBias,
    in_g,
    MODEL_NAMES,
    Quality,
    Rejected,
    SampleNoise,
    STORED_METHODS,
)
from ..calibrate.mounting import mounting_figures
from ..effects import CHANGES, Effect, effect_named, is_effect, PROCESSES
from ..errors import DamagedCalibrationError, RefusedFitError, StoredCalibrationError
from ..estimate.fit import judge
from ..model import Model
from ..table import COLUMNS, Floats, Poses
from ..units import UNIT_NAMES, Units

try:  # eight times as fast, but not in every build of PyYAML
    from yaml import CSafeDumper as SafeDumper
    from yaml import CSafeLoader as SafeLoader
except ImportError:
    from yaml import SafeDumper, SafeLoader  # type: ignore[assignment]

FORMAT = 'accel_calib calibration'
_FIRST_LINE = f'format: {FORMAT}'
VERSION = 2
"""Version 1 had no stream and no checksum, and NaN for an undetermined covariance."""

_CORRECTION = ('force = transpose(rotation) matrix (reading - offset), plus the effects other '
               'than offset and gain; offset in the unit of the readings')
OTHER_CORRECTION = 'the correction in the file is not that of its effects; the effects are used'
"""Warning of a calibration whose file was edited by hand in one of the two."""

_EQUATION = 'reading = V + W u + effects, u = ΔR force, |force| = 1 g at rest; values in g'
_SAME = 1e-9
"""A stated correction may differ by this share from that of the effects."""

_CHECKSUM = '\nchecksum: sha256 '
_NAMES = (*(name for name in MODEL_NAMES if name != 'auto'), 'ideal')


def format_calibration(calibration: Calibration) -> str:
    """Return the text of a stored calibration."""
    model, units = calibration.model, calibration.units
    content = {
        'format': FORMAT, 'version': VERSION, 'package_version': __version__,
        'equation': _EQUATION, 'sensor': calibration.sensor, 'stream': calibration.stream,
        'date': calibration.date,
        'units': {'readings': units.name, 'per_g': float(units.per_g)},
        'model': calibration.name, 'method': calibration.method, 'reason': calibration.reason,
        'effects': {name: {'what': effect.words, 'unit': effect.unit, **effect.shown(values)}
                    for (name, values), effect in zip(model.values.items(), model.terms.effects,
                                                      strict=True)},
        'frame': calibration.frame, 'rotation': model.rotation.tolist(),
        **_derived(calibration),
        'covariance': calibration.covariance[np.ix_(model.stated, model.stated)].tolist(),
        'quality': asdict(calibration.quality), **_rest_noise(calibration),
        'rejected': [asdict(rejected) for rejected in calibration.rejected],
        'warnings': [line for line in calibration.warnings
                     if line not in (EDITED, OTHER_CORRECTION)],
        'poses': {'row': calibration.poses.row.tolist(),
                  **{key: calibration.poses[key].tolist() for key, column in COLUMNS.items()
                     if key in calibration.poses and not column.made}},
    }
    text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=99,
                     default_flow_style=None)
    return f'{text.rstrip()}{_CHECKSUM}{_digest(text.rstrip())}\n'


def _derived(calibration: Calibration) -> dict[str, Any]:
    """Return what follows from the other values, for users of the file: mounting, W⁻¹ and V."""
    correction = {'equation': _CORRECTION, 'matrix': calibration.matrix.tolist(),
                  'offset': calibration.offset.tolist()}
    if not calibration.is_levelled:
        return {'correction': correction}
    return {'mounting': mounting_figures(calibration.rotation, calibration.sensor),
            'correction': correction}


def _rest_noise(calibration: Calibration) -> dict[str, Any]:
    """Return the gyro bias and the noise of a sample, where they are known; null for NaN."""
    gyro, noise, content = calibration.gyro, calibration.noise, {}
    if gyro is not None:
        content['gyro_bias'] = {
            'unit': 'rad/s, slope in rad/s/°C, temperatures in °C', 'bias': gyro.bias.tolist(),
            'sd': gyro.sd.tolist(), 'slope': gyro.slope.tolist(),
            'temperature': None if np.isnan(gyro.temperature) else float(gyro.temperature),
            'temperatures': [float(each) for each in gyro.temperatures], 'rests': int(gyro.rests)}
    if noise is not None:
        content['noise'] = {
            'what': 'standard deviation of one sample; force in the unit of the readings, rate in '
                    'rad/s',
            **{name: [None if np.isnan(each) else float(each) for each in getattr(noise, name)]
               for name in ('force', 'rate')}}
    return content


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode()).hexdigest()


class _Dumper(SafeDumper):
    """The safe dumper without anchors: equal lists are written in full."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def parse_calibration(text: str, name: str) -> Calibration:
    """
    Return the calibration in the text of a file.

    Parameters
    ----------
    text : str
        Text in YAML.
    name : str
        Name of the file for error messages.

    Returns
    -------
    Calibration
        The calibration, with the warning `EDITED` if the checksum does not match.

    Raises
    ------
    StoredCalibrationError
        If the text is damaged, is newer than this package, or has implausible values.

    """
    if not text.startswith(_FIRST_LINE):
        raise StoredCalibrationError(f'{name} is not a calibration of accel_calib, expected the '
                                     f'first line "{_FIRST_LINE}"', 'use a file that fit wrote')
    try:
        content = yaml.load(text, Loader=SafeLoader)
    except (yaml.YAMLError, ValueError, OverflowError, RecursionError) as err:
        raise _damaged(name, 'it is not YAML') from err
    _check_version(content, name)
    try:
        calibration = _calibration(content)
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as err:
        what = f'{err.args[0]} is missing' if isinstance(err, KeyError) else str(err)
        raise _damaged(name, what) from err
    try:
        calibration = gated(calibration)
    except RefusedFitError as err:
        raise DamagedCalibrationError(f'{name} contains an implausible calibration: {err.message}',
                                      err.advice) from err
    if content['version'] == 1:
        return calibration
    body, found, digest = text.rpartition(_CHECKSUM)
    if not found:
        raise _damaged(name, 'its last line, the checksum, is missing')
    if digest.strip() == _digest(body.rstrip()):
        return calibration
    other = _other_correction(content, calibration, name)
    return replace(calibration, warnings=(*calibration.warnings, EDITED, *other))


def _other_correction(content: Mapping[str, Any], calibration: Calibration, name: str
                      ) -> tuple[str, ...]:
    """Return a warning if a file states a correction that is not that of its effects."""
    if content.get('correction') is None:
        return ()
    try:
        stated = _mapping(content, 'correction')
        pairs = ((_array(stated, 'offset', (3,)), calibration.offset, calibration.units.per_g),
                 (_array(stated, 'matrix', (3, 3)), calibration.matrix,
                  float(np.max(np.abs(calibration.matrix)))))
    except (KeyError, TypeError, ValueError) as err:
        raise _damaged(name, f'correction: {err}') from err
    same = all(np.allclose(found, own, rtol=0.0, atol=_SAME * size) for found, own, size in pairs)
    return () if same else (OTHER_CORRECTION,)


def _damaged(name: str, what: str) -> DamagedCalibrationError:
    return DamagedCalibrationError(f'{name} is damaged ({" ".join(what.split())}), expected a '
                                   'whole calibration',
                                   'fit again, or use the previous file (.before)')


def _check_version(content: Any, name: str) -> None:
    """Refuse a calibration of a newer version."""
    if not isinstance(content, Mapping):
        raise _damaged(name, 'it is not a YAML mapping')
    version = content.get('version')
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise _damaged(name, f'its version is {version!r}')
    if version > VERSION:
        raise StoredCalibrationError(f'{name} has version {version}, expected {VERSION} or less',
                                     'update accel_calib, or fit again')


def _calibration(content: Mapping[str, Any]) -> Calibration:
    """Return the record with the content of a file; raise ValueError for an unexpected value."""
    values = {str(name): _values(effect_named(name), effect)
              for name, effect in _known_effects(content).items()}
    model = Model(values, _array(content, 'rotation', (3, 3)))
    size = int(np.sum(model.stated))
    units = _mapping(content, 'units')
    rejected = [Rejected(_whole(each, 'row'), _text(each, 'reason'))
                for each in _list(content, 'rejected')]
    calibration = Calibration(
        name=_one_of(content, 'model', _NAMES), method=_one_of(content, 'method', STORED_METHODS),
        model=model,
        units=Units(_one_of(units, 'readings', UNIT_NAMES), _number(units, 'per_g')),
        sensor=_text(content, 'sensor'), stream=str(content.get('stream', '')),
        frame=_one_of(content, 'frame', FRAMES), date=_text(content, 'date'),
        covariance=_array(content, 'covariance', (size, size), finite=False),
        quality=_quality(_mapping(content, 'quality')), poses=_poses(_mapping(content, 'poses')),
        rejected=tuple(rejected), reason=_text(content, 'reason'),
        warnings=tuple(_text({'warning': line}, 'warning') for line in _list(content, 'warnings')),
        gyro=_gyro_bias(content), noise=_sample_noise(content))
    return _from_version_1(calibration) if content['version'] == 1 else calibration


def _values(effect: Effect, stated: Mapping[str, Any]) -> Floats:
    """Return the values of an effect; shape constants that are not stated are the usual ones."""
    known = {**dict(zip(effect.shape, effect.usual)), **stated}
    return np.array([_number(known, part) for part in effect.values])


def _from_version_1(calibration: Calibration) -> Calibration:
    """Return the calibration with a finite covariance if version 1 stored NaN."""
    if np.all(np.isfinite(calibration.covariance)) or not len(calibration.used_poses):
        return calibration
    fit = judge(Model(calibration.model.values), in_g(calibration.used_poses, calibration.units))
    return replace(calibration, covariance=fit.covariance)


def _known_effects(content: Mapping[str, Any]) -> Mapping[str, Any]:
    effects = _mapping(content, 'effects')
    for name, effect in effects.items():
        if not is_effect(str(name)) or name in CHANGES or name in PROCESSES:
            raise ValueError(f'effect {name!r} is not in the catalogue')
        if not isinstance(effect, Mapping):
            raise ValueError(f'effect {name} is {_short(effect)}, expected names with values')
    return effects


def _quality(content: Mapping[str, Any]) -> Quality:
    optional = ('held_out_rms_mg', 'noise_floor_mg', 'chi2_per_dof')
    figures: dict[str, Any] = {
        each.name: None if each.name in optional and content[each.name] is None
        else _number(content, each.name) for each in fields(Quality)}
    return Quality(**figures)


def _gyro_bias(content: Mapping[str, Any]) -> GyroBias | None:
    """Return the gyro bias; None for files without it, such as those of earlier releases."""
    if content.get('gyro_bias') is None:
        return None
    known = _mapping(content, 'gyro_bias')
    bias, sd, slope = (_array(known, key, (3,)) for key in ('bias', 'sd', 'slope'))
    temperature = np.nan if known['temperature'] is None else _number(known, 'temperature')
    limits = tuple(_number({'temperatures': each}, 'temperatures')
                   for each in _list(known, 'temperatures'))
    return GyroBias(bias, sd, _whole(known, 'rests'), float(temperature), slope, limits)


def _sample_noise(content: Mapping[str, Any]) -> SampleNoise | None:
    """Return the noise of a sample; None for files without it."""
    if content.get('noise') is None:
        return None
    known = _mapping(content, 'noise')
    return SampleNoise(*(_array(known, key, (3,), finite=False) for key in ('force', 'rate')))


def _poses(content: Mapping[str, Any]) -> Poses:
    rows = np.array([_whole({'row': row}, 'row') for row in _list(content, 'row')], np.int64)
    columns: dict[str, Any] = {}
    for key, column in COLUMNS.items():
        if key in content and not column.made:
            width = len(column.names)
            shape = (len(rows),) if width == 1 else (len(rows), width)
            columns[key] = (np.array([str(each) for each in _list(content, key)], dtype=str)
                            if key == 'label' else _array(content, key, shape))
    return Poses(columns, rows)


def _mapping(content: Mapping[str, Any], key: str) -> Mapping[str, Any]:
    if not isinstance(content[key], Mapping):
        raise ValueError(f'{key} is {_short(content[key])}, expected names with values')
    return content[key]


def _list(content: Mapping[str, Any], key: str) -> list[Any]:
    if not isinstance(content[key], list):
        raise ValueError(f'{key} is {_short(content[key])}, expected a list')
    return content[key]


def _text(content: Mapping[str, Any], key: str) -> str:
    if not isinstance(content[key], str):
        raise ValueError(f'{key} is {_short(content[key])}, expected text')
    return content[key]


def _one_of(content: Mapping[str, Any], key: str, choices: tuple[str, ...]) -> Any:
    if content[key] not in choices:
        raise ValueError(f'{key} is {_short(content[key])}, expected one of {", ".join(choices)}')
    return content[key]


def _number(content: Mapping[str, Any], key: str) -> float:
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise ValueError(f'{key} is {_short(value)}, expected a finite number')
    return float(value)


def _whole(content: Mapping[str, Any], key: str) -> int:
    value = content[key]
    if isinstance(value, bool) or not isinstance(value, int):
        raise ValueError(f'{key} is {_short(value)}, expected a whole number')
    return value


def _array(content: Mapping[str, Any], key: str, shape: tuple[int, ...], *, finite: bool = True
           ) -> Floats:
    """Return nested lists of numbers as an array of this shape."""
    values = _list(content, key)
    array = np.array(values, float).reshape(shape) if not values else np.array(values, float)
    if array.shape != shape:
        raise ValueError(f'{key} has shape {array.shape}, expected {shape}')
    if finite and not np.all(np.isfinite(array)):
        raise ValueError(f'{key} contains a number that is not finite')
    return array


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) < 60 else f'{text[:60]}…'


def read_calibration(path: Path) -> Calibration:
    """
    Read a stored calibration.

    Raises
    ------
    StoredCalibrationError
        If the file is damaged, is newer than this package, or has implausible values.
    OSError
        If the file cannot be read.

    """
    try:
        text = path.read_text(encoding='utf-8')
    except UnicodeDecodeError as err:
        raise StoredCalibrationError(f'{path} is not a text file, expected a calibration (YAML)',
                                     'use a file that fit wrote') from err
    return parse_calibration(text, str(path))


def write_calibration(path: Path, calibration: Calibration, *, keep_before: bool = True) -> None:
    """
    Write a calibration; the previous file is kept as ``<name>.before`` unless excluded.

    Raises
    ------
    RefusedFitError
        If the calibration is not plausible.
    OSError
        If the file cannot be written. The stored file is then unchanged.

    """
    text = format_calibration(gated(calibration))
    write_atomically(path, lambda file: file.write(text), keep_before=keep_before)
