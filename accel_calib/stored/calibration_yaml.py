# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Stored calibrations: readable, versioned YAML.

`format_calibration` and `parse_calibration` convert text. Only `write_calibration` and
`read_calibration` access the disk. The reader bounds size and nesting (`.plain_yaml`) and checks
every value, and the calibration then passes the same gate as a fit (`accel_calib.calibrate.gate`).
The last line of a file is a checksum of the text before it; it reveals a file that was edited by
hand.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields, replace
import hashlib
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray
import yaml

from .plain_yaml import (
    array_at,
    choice_at,
    list_at,
    mapping_at,
    MOST_BYTES,
    MOST_VALUES,
    number_at,
    read_plain,
    shown,
    text_at,
    whole_at,
)
from .. import __version__
from ..calibrate import (
    Calibration,
    FRAMES,
    gated,
    GyroBias,
    in_g,
    MODEL_NAMES,
    mounting_figures,
    Quality,
    Rejected,
    RejectedKind,
    SampleNoise,
    STORED_METHODS,
)
from ..disk import check_regular, write_atomically
from ..effects import CHANGES, Effect, effect_named, is_effect, Model, PROCESSES
from ..errors import (
    AccelCalibError,
    DamagedCalibrationError,
    InputError,
    RefusedFitError,
    StoredCalibrationError,
)
from ..estimate import judge
from ..finding import Finding, KINDS, LEVELS, without
from ..table import check_values, COLUMNS, Floats, LARGEST, Poses
from ..units import UNIT_NAMES, Units

try:  # eight times as fast, but not in every build of PyYAML
    from yaml import CSafeDumper as SafeDumper
except ImportError:
    from yaml import SafeDumper  # type: ignore[assignment]

FORMAT = 'accel_calib calibration'
_FIRST_LINE = f'format: {FORMAT}'
VERSION = 3
"""Version 1 had no stream and no checksum, and NaN for an undetermined covariance; version 2 had
findings as text, and no kinds of rejected poses."""

_CORRECTION = ('force = transpose(rotation) matrix (reading - offset), plus the effects other '
               'than offset and gain; offset in the unit of the readings')
OF_FILE = {
    'edited': Finding('edited', 'the file was edited by hand since it was stored',
                      'verify it on new poses, or fit again', 'USABLE'),
    'correction_in_file': Finding('correction_in_file', 'the correction in the file is not that '
                                  'of its effects', 'the effects are used')}
"""Findings about a file that does not match its checksum, which are not stored."""

_EQUATION = 'reading = V + W u + effects, u = ΔR force, |force| = 1 g at rest; values in g'
_SAME = 1e-9
"""A stated correction may differ by this share from that of the effects."""

_CHECKSUM = '\nchecksum: sha256 '
_NAMES = (*(name for name in MODEL_NAMES if name != 'auto'), 'ideal')

_OTHERS = 10_000
"""More values than a calibration has beside its poses."""

_PER_G: Mapping[str, tuple[float, float]] = {
    'm/s2': (0.1, 100.0), 'g': (1.0, 1.0), 'native': (1.0 / LARGEST, LARGEST)}
"""Range of 1 g, by unit; for m/s² gravity on planets and moons."""

_LONGEST_NAME = 4096
"""Longest name of an effect, a sensor or a topic, which messages repeat."""

_ABOUT_EFFECT = ('what', 'unit')
_KEYS: Mapping[str, tuple[str, ...]] = {
    '': ('format', 'version', 'package_version', 'equation', 'sensor', 'stream', 'date', 'units',
         'model', 'method', 'reason', 'effects', 'frame', 'rotation', 'mounting', 'correction',
         'covariance', 'quality', 'gyro_bias', 'noise', 'rejected', 'findings', 'poses',
         'checksum'),
    'units': ('readings', 'per_g'),
    'quality': tuple(each.name for each in fields(Quality)),
    'gyro_bias': ('unit', *(each.name for each in fields(GyroBias))),
    'noise': ('what', *(each.name for each in fields(SampleNoise))),
    'correction': ('equation', 'matrix', 'offset'),
    'poses': ('row', *(key for key, column in COLUMNS.items() if not column.made)),
}
"""Keys of a file, and of the mappings in it."""


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
        'findings': [each.stated for each in without(calibration.noted, *OF_FILE)],
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
        The calibration, with the finding ``edited`` if the checksum does not match.

    Raises
    ------
    StoredCalibrationError
        If the text is damaged, is newer than this package, or has implausible values.

    """
    if not text.startswith(_FIRST_LINE):
        raise _other_file(name)
    try:
        content = read_plain(text)
    except ValueError as err:
        raise _damaged(name, str(err)) from err
    _check_version(content, name)
    calibration = _checked(content, name)
    body, found, digest = text.rpartition(_CHECKSUM)
    if not found and content['version'] == 1:
        return calibration
    if not found:
        raise _damaged(name, 'its last line, the checksum, is missing')
    if digest.strip() == _digest(body.rstrip()):
        return calibration
    other = _other_correction(content, calibration, name)
    _check_keys(content, name)
    return replace(calibration, noted=(
        *calibration.noted, OF_FILE['edited'], *other))


def _checked(content: Mapping[str, Any], name: str) -> Calibration:
    """Return the calibration with the content of a file, after all checks."""
    try:
        with np.errstate(all='ignore'):  # the checks refuse what is not finite
            return gated(_calibration(content))
    except RefusedFitError as err:
        raise DamagedCalibrationError(f'{name} contains an implausible calibration: {err.message}',
                                      err.advice) from err
    except AccelCalibError as err:
        raise _damaged(name, err.message) from err
    except (KeyError, TypeError, ValueError, OverflowError, AttributeError) as err:
        what = f'{err.args[0]} is missing' if isinstance(err, KeyError) else str(err)
        raise _damaged(name, what) from err


def _check_keys(content: Mapping[str, Any], name: str) -> None:
    """Refuse unknown keys in a file that was changed: a damaged key would be ignored."""
    for place, known in _KEYS.items():
        found = content.get(place) if place else content
        for key in found if isinstance(found, Mapping) else ():
            if key not in known:
                raise _damaged(name, f'the key {shown(key)} {f"of {place} " if place else ""}is '
                                     f'not known, expected one of {", ".join(known)}')


def _other_correction(content: Mapping[str, Any], calibration: Calibration, name: str
                      ) -> tuple[Finding, ...]:
    """Return a finding if a file states a correction that is not that of its effects."""
    if content.get('correction') is None:
        return ()
    try:
        stated = mapping_at(content, 'correction')
        pairs = ((array_at(stated, 'offset', (3,)), calibration.offset, calibration.units.per_g),
                 (array_at(stated, 'matrix', (3, 3)), calibration.matrix,
                  float(np.max(np.abs(calibration.matrix)))))
    except (KeyError, TypeError, ValueError) as err:
        raise _damaged(name, f'correction: {err}') from err
    same = all(np.allclose(found, own, rtol=0.0, atol=_SAME * size) for found, own, size in pairs)
    return () if same else (OF_FILE['correction_in_file'],)


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
        raise _damaged(name, f'its version is {shown(version)}')
    if version > VERSION:
        raise StoredCalibrationError(f'{name} has version {version}, expected {VERSION} or less',
                                     'update accel_calib, or fit again')


def _units(content: Mapping[str, Any]) -> Units:
    """Return the unit of the readings; raise ValueError if 1 g in it is implausible."""
    name, per_g = choice_at(content, 'readings', UNIT_NAMES), number_at(content, 'per_g')
    low, high = _PER_G[name]
    if not low <= per_g <= high:
        expected = f'{low:g}' if low == high else f'{low:g} to {high:g}'
        raise ValueError(f'per_g is {shown(per_g)}, expected {expected} for {name}')
    return Units(name, per_g)


def _calibration(content: Mapping[str, Any]) -> Calibration:
    """Return the record with the content of a file; raise ValueError for an unexpected value."""
    values = {name: _values(effect_named(name), effect)
              for name, effect in _known_effects(content).items()}
    model = Model(values, array_at(content, 'rotation', (3, 3)))
    size = int(np.sum(model.stated))
    content = _from_version_2(content)
    units = mapping_at(content, 'units')
    rejected = [mapping_at({'rejected': each}, 'rejected')
                for each in list_at(content, 'rejected')]
    calibration = Calibration(
        name=choice_at(content, 'model', _NAMES),
        method=choice_at(content, 'method', STORED_METHODS), model=model,
        units=_units(units),
        sensor=text_at(content, 'sensor', _LONGEST_NAME),
        stream=text_at({'stream': '', **content}, 'stream', _LONGEST_NAME),
        frame=choice_at(content, 'frame', FRAMES), date=text_at(content, 'date', _LONGEST_NAME),
        covariance=array_at(content, 'covariance', (size, size), finite=False, most=LARGEST),
        quality=_quality(mapping_at(content, 'quality')),
        poses=_poses(mapping_at(content, 'poses')),
        rejected=tuple(Rejected(whole_at(each, 'row'), text_at(each, 'reason'),
                                choice_at(each, 'kind', get_args(RejectedKind)))
                       for each in rejected),
        reason=text_at(content, 'reason'),
        noted=tuple(_finding(mapping_at({'finding': each}, 'finding'))
                    for each in list_at(content, 'findings')),
        gyro=_gyro_bias(content), noise=_sample_noise(content))
    return _from_version_1(calibration) if content['version'] == 1 else calibration


def _values(effect: Effect, stated: Mapping[str, Any]) -> Floats:
    """Return the values of an effect; shape constants that are not stated are the usual ones."""
    known = {**dict(zip(effect.shape, effect.usual)), **stated}
    for key in stated:
        if key not in effect.values and key not in _ABOUT_EFFECT:
            raise ValueError(f'the key {shown(key)} of an effect is not known, expected one of '
                             f'{", ".join(effect.values)}')
    return np.array([number_at(known, part, LARGEST) for part in effect.values])


def _finding(stated: Mapping[str, Any]) -> Finding:
    """Return a finding of a file."""
    rows = array_at(stated, 'rows', (len(list_at(stated, 'rows')),)).astype(int).tolist()
    return Finding(choice_at(stated, 'kind', tuple(KINDS)), text_at(stated, 'text'),
                   text_at(stated, 'advice'), choice_at(stated, 'level', LEVELS), tuple(rows))


def _from_version_2(content: Mapping[str, Any]) -> Mapping[str, Any]:
    """Return the content of a file with records in place of the texts of earlier versions."""
    if 'findings' in content:
        return content
    texts = [text_at({'warning': each}, 'warning') for each in list_at(content, 'warnings')]
    rejected = [mapping_at({'rejected': each}, 'rejected')
                for each in list_at(content, 'rejected')]
    return {**content, 'findings': [Finding('note', text).stated for text in texts],
            'rejected': [{**each, 'kind': 'outlier' if text_at(each, 'reason')[:7] == 'outlier'
                          else 'implausible'} for each in rejected]}


def _from_version_1(calibration: Calibration) -> Calibration:
    """Return the calibration with a finite covariance if version 1 stored NaN."""
    if np.all(np.isfinite(calibration.covariance)) or not len(calibration.used_poses):
        return calibration
    fit = judge(Model(calibration.model.values), in_g(calibration.used_poses, calibration.units))
    return replace(calibration, covariance=fit.covariance)


def _known_effects(content: Mapping[str, Any]) -> Mapping[str, Any]:
    effects = mapping_at(content, 'effects')
    for name, effect in effects.items():
        if (len(name) > _LONGEST_NAME or not is_effect(name) or name in CHANGES
                or name in PROCESSES):
            raise ValueError(f'effect {shown(name)} is not in the catalogue')
        if not isinstance(effect, Mapping):
            raise ValueError(f'effect {name} is {shown(effect)}, expected names with values')
    return effects


def _quality(content: Mapping[str, Any]) -> Quality:
    optional = ('held_out_rms_mg', 'noise_floor_mg', 'chi2_per_dof')
    figures: dict[str, Any] = {
        each.name: None if each.name in optional and content[each.name] is None
        else number_at(content, each.name) for each in fields(Quality)}
    return Quality(**figures)


def _gyro_bias(content: Mapping[str, Any]) -> GyroBias | None:
    """Return the gyro bias; None for files without it, such as those of earlier releases."""
    if content.get('gyro_bias') is None:
        return None
    known = mapping_at(content, 'gyro_bias')
    bias, sd, slope = (array_at(known, key, (3,)) for key in ('bias', 'sd', 'slope'))
    temperature = np.nan if known['temperature'] is None else number_at(known, 'temperature')
    limits = tuple(number_at({'temperatures': each}, 'temperatures')
                   for each in list_at(known, 'temperatures'))
    return GyroBias(bias, sd, whole_at(known, 'rests'), float(temperature), slope, limits)


def _sample_noise(content: Mapping[str, Any]) -> SampleNoise | None:
    """Return the noise of a sample; None for files without it."""
    if content.get('noise') is None:
        return None
    known = mapping_at(content, 'noise')
    return SampleNoise(*(array_at(known, key, (3,), finite=False) for key in ('force', 'rate')))


def _poses(content: Mapping[str, Any]) -> Poses:
    rows = np.array([whole_at({'row': row}, 'row') for row in list_at(content, 'row')], np.int64)
    columns: dict[str, Any] = {}
    for key, column in COLUMNS.items():
        if key in content and not column.made:
            width = len(column.names)
            shape = (len(rows),) if width == 1 else (len(rows), width)
            columns[key] = (_labels(content) if key == 'label'
                            else array_at(content, key, shape))
    check_values(columns, 'poses')
    return Poses(columns, rows)


def _labels(content: Mapping[str, Any]) -> NDArray[Any]:
    """Return the labels; all take as much memory as the longest one."""
    labels = list_at(content, 'label')
    for label in labels:
        if isinstance(label, list | Mapping):
            raise ValueError(f'label contains {shown(label)}, expected text')
    texts = [str(label) for label in labels]
    if len(texts) * max(map(len, texts), default=0) > MOST_BYTES:
        raise ValueError(f'the longest label has {max(map(len, texts))} characters, expected '
                         f'{MOST_BYTES // len(texts)} or less')
    return np.array(texts, dtype=str)


def read_calibration(path: Path) -> Calibration:
    """
    Read a stored calibration.

    Raises
    ------
    InputError
        If the path is a folder, a pipe, a socket or a device.
    StoredCalibrationError
        If the file is damaged, is newer than this package, or has implausible values.
    OSError
        If the file cannot be read.

    """
    check_regular(path)
    with path.open('rb') as file:
        data = file.read(MOST_BYTES + 1)
    if not data.strip(b'\0 \t\r\n'):
        raise _damaged(str(path), 'it is empty')
    if not data.startswith(_FIRST_LINE.encode()):
        raise _other_file(str(path))
    if len(data) > MOST_BYTES:
        raise _damaged(str(path), f'it has more than {MOST_BYTES} bytes')
    try:
        text = data.decode()
    except UnicodeDecodeError as err:
        line = 1 + data.count(b'\n', 0, err.start)
        raise _damaged(str(path), f'line {line} is not text in UTF-8') from err
    return parse_calibration(text.replace('\r\n', '\n').replace('\r', '\n'), str(path))


def _other_file(name: str) -> StoredCalibrationError:
    return StoredCalibrationError(f'{name} is not a calibration of accel_calib, expected the '
                                  f'first line "{_FIRST_LINE}"', 'use a file that fit wrote')


def write_calibration(path: Path, calibration: Calibration, *, keep_before: bool = True) -> None:
    """
    Write a calibration; the previous file is kept as ``<name>.before`` unless excluded.

    Raises
    ------
    RefusedFitError
        If the calibration is not plausible.
    InputError
        If it has more poses than a file can hold.
    OSError
        If the file cannot be written. The stored file is then unchanged.

    """
    text = format_calibration(gated(calibration))
    if len(text.encode()) > MOST_BYTES or _values_in(calibration) > MOST_VALUES:
        raise InputError(f'the calibration has {len(calibration.poses)} poses, which is more than '
                         'its file can hold', 'fit fewer poses')
    write_atomically(path, lambda file: file.write(text), keep_before=keep_before)


def _values_in(calibration: Calibration) -> int:
    """Return an upper limit of the number of values and keys in the file of a calibration."""
    poses = calibration.poses
    cells = sum(1 + len(column.names) for key, column in COLUMNS.items() if key in poses)
    return _OTHERS + (1 + cells) * len(poses) + 5 * len(calibration.rejected)
