# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Stored calibrations, and typical values of a fleet: readable, versioned YAML.

The reader bounds size and nesting (`.plain_yaml`) and checks every value. The calibration then
passes the same gate as a fit (`accel_calib.calibration.gated`). The writer reads its own bytes, so
that it stores nothing that the reader refuses. The last line of a file is a checksum of the text
before it; it reveals a file that was edited by hand.

"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, fields, replace
import hashlib
from pathlib import Path
import re
from typing import Any, get_args, TypeVar

import numpy as np
from numpy.typing import NDArray
import yaml

from .plain_yaml import (
    array_at, beginning_of, choice_at, decoded, MOST_BYTES, number_at, read_plain, shown, value_at,
    values_at)
from .. import __version__
from ..calibration import (
    Calibration, FleetPrior, gated, GyroBias, in_g, LARGEST_OFFSET_G, Quality, Rejected,
    RejectedKind, SampleNoise, STORED_METHODS)
from ..disk import BEFORE, FIRST_LINE, FORMAT, write_atomically
from ..effects import (
    add_history, CHANGES, effect_named, EffectKey, entry_of, factors_of, Model, MODELS, OwnEffect,
    parameter_names, PROCESSES)
from ..errors import (
    AccelCalibError, DamagedCalibrationError, InputError, OwnEffectError, RefusedFitError,
    StoredCalibrationError)
from ..estimate import Prior
from ..finding import Finding, KINDS, LEVELS, without
from ..findings import mounting_figures
from ..statistics import rms
from ..table import Autopilot, check_values, COLUMNS, Floats, is_quantity, LARGEST, Poses
from ..text import counted, LONGEST_NAME, plain, some
from ..units import FRAMES, MODEL_NAMES, UNIT_NAMES, Units

# The first is eight times as fast, but not in every build of PyYAML.
SafeDumper: Any = getattr(yaml, 'CSafeDumper', yaml.SafeDumper)

T = TypeVar('T')

_VERSION = 3
"""The only version that is read; earlier ones were never released."""

CORRECTION = ('force = transpose(rotation) matrix (reading - offset), plus the effects other than '
              'offset and gain')
OF_FILE = {
    'edited': Finding('edited', 'the file was edited by hand since it was stored',
                      'verify it on new poses, or fit again', 'USABLE'),
    'correction_in_file': Finding('correction_in_file', 'the correction in the file is not that '
                                  'of its effects', 'the effects are used')}
"""Findings about a file that does not match its checksum, which are not stored."""

_EQUATION = 'reading = V + W u + effects, u = ΔR force, |force| = 1 g at rest; values in g'
_SAME = 1e-9
"""A stated correction may differ by this share from that of the effects."""

_SAME_OWN = 1e-6
"""The contribution of an own effect may differ by this share from that when it was fitted."""

_CHECKSUM = '\nchecksum: sha256 '
_NAMES = (*(name for name in MODEL_NAMES if name != 'auto'), 'ideal')

_PER_G: Mapping[str, tuple[float, float]] = {
    'm/s2': (0.1, 100.0), 'g': (1.0, 1.0), 'native': (1.0 / LARGEST, LARGEST)}
"""Range of 1 g, by unit; for m/s² gravity on planets and moons."""

_MOST_LETTERS = MOST_BYTES
"""Most characters of all labels, of which each takes as much memory as the longest one."""

_MAPPINGS = ('units', 'quality', 'gyro_bias', 'noise', 'correction', 'poses')
_NOT_ALWAYS = ('autopilot', 'mounting', 'gyro_bias', 'noise', 'checksum')
"""Keys of mappings with known keys, and keys that not every file has."""


def calibration_bytes(calibration: Calibration) -> bytes:
    """
    Return the content of the file of a calibration, which passes the gate and the reader.

    Raises
    ------
    RefusedFitError
        If the calibration is not plausible.
    InputError
        If the reader refuses it, such as more poses than a file can hold.

    """
    text: str = yaml.dump(_content(gated(calibration)), Dumper=SafeDumper, sort_keys=False,
                          allow_unicode=True, width=99, default_flow_style=None).rstrip()
    data = f'{text}{_CHECKSUM}{hashlib.sha256(text.encode()).hexdigest()}\n'.encode()
    try:
        calibration_from(data, 'its file', [
            each for each in calibration.model.effects if isinstance(each, OwnEffect)])
    except DamagedCalibrationError as err:
        raise InputError(f'the calibration of {counted(len(calibration.poses), "pose")} cannot be '
                         f'stored: {err.message}', 'fit fewer poses, or shorten their texts'
                         ) from err
    return data


def _content(calibration: Calibration) -> dict[str, Any]:
    model, units, poses = calibration.model, calibration.units, calibration.poses
    gyro, noise = calibration.gyro, calibration.noise
    return {
        'format': FORMAT, 'version': _VERSION, 'package_version': __version__,
        'equation': _EQUATION, 'sensor': calibration.sensor, 'stream': calibration.stream,
        'date': calibration.date,
        **({} if poses.autopilot is None else {'autopilot': asdict(poses.autopilot)}),
        'units': {'readings': units.name, 'per_g': float(units.per_g)},
        'model': calibration.name, 'method': calibration.method, 'reason': calibration.reason,
        'effects': {str(key): {'what': effect.words, 'unit': effect.unit, **effect.shown(values),
                               **({'own_rms': _own_rms(calibration, key)} if effect.own else {})}
                    for (key, values), effect in zip(model.values.items(), model.terms.effects,
                                                     strict=True)},
        'frame': calibration.frame, 'rotation': model.rotation.tolist(),
        # For users of the file: what follows from the other values.
        **({'mounting': mounting_figures(calibration.rotation, calibration.sensor)}
           if calibration.is_levelled else {}),
        'correction': {'equation': f'{CORRECTION}; offset in the unit of the readings',
                       'matrix': calibration.matrix.tolist(),
                       'offset': calibration.offset.tolist()},
        'covariance': calibration.covariance[np.ix_(model.stated, model.stated)].tolist(),
        'quality': asdict(calibration.quality),
        **({} if gyro is None else {'gyro_bias': {
            'unit': 'rad/s, slope in rad/s/°C, temperatures in °C', **{
                name: plain(getattr(gyro, name)) for name in (
                    'bias', 'sd', 'slope', 'temperature', 'temperatures', 'rests')}}}),
        **({} if noise is None else {'noise': {
            'what': 'standard deviation of one sample; force in the unit of the readings, rate in '
                    'rad/s', **plain(asdict(noise))}}),
        'rejected': [asdict(rejected) for rejected in calibration.rejected],
        'findings': [each.stated for each in without(calibration.noted, *OF_FILE)],
        'poses': {'row': poses.row.tolist(),
                  **{key: poses[key].tolist() for key, column in COLUMNS.items()
                     if key in poses and not column.made},
                  **({'quantities': {key: poses[key].tolist() for key in poses.quantities}}
                     if poses.quantities else {})},
    }


def _own_rms(calibration: Calibration, own: EffectKey) -> float:
    """Return the RMS over the poses of what the values of an own effect are multiplied by."""
    shape = entry_of(own).split(calibration.model.values[own])[1]
    poses_g = add_history(in_g(calibration.poses, calibration.units), calibration.model)
    return rms(factors_of(own, [shape], poses_g.columns))


def calibration_from(data: bytes, name: str, own: Sequence[OwnEffect] = ()) -> Calibration:
    """
    Return the calibration in a file; with ``edited`` if its checksum does not match.

    It may have effects of the user that are among `own`.

    """
    try:
        return _checked(data, name, own)
    except (StoredCalibrationError, OwnEffectError):
        raise
    except RefusedFitError as err:
        raise DamagedCalibrationError(f'{name} contains an implausible calibration: {err.message}',
                                      err.advice) from err
    except (AccelCalibError, KeyError, TypeError, ValueError, OverflowError,
            AttributeError) as err:
        what = (err.message if isinstance(err, AccelCalibError) else
                f'{err.args[0]} is missing' if isinstance(err, KeyError) else str(err))
        raise DamagedCalibrationError(f'{name} is damaged ({" ".join(what.split())}), expected a '
                                      'whole calibration',
                                      'fit again, or use the previous file (.before)') from err


def _checked(data: bytes, name: str, own: Sequence[OwnEffect]) -> Calibration:
    """Return the calibration in a file after all checks; other errors are those of damage."""
    if not data.strip(b'\0 \t\r\n'):
        raise ValueError('it is empty')
    if not re.match(BEFORE + FIRST_LINE.encode(), data):
        raise StoredCalibrationError(f'{name} is not a calibration of accel_calib, expected the '
                                     f'first line "{FIRST_LINE}"', 'use a file that fit wrote')
    text = decoded(data)
    content = read_plain(text)
    if not isinstance(content, Mapping):
        raise ValueError('it is not a YAML mapping')
    version = content.get('version')
    if not isinstance(version, int) or isinstance(version, bool) or version < 1:
        raise ValueError(f'its version is {shown(version)}')
    if version != _VERSION:
        raise StoredCalibrationError(f'{name} has version {version}, expected {_VERSION}',
                                     'fit the poses again' if version < _VERSION else
                                     'update accel_calib, or fit the poses again')
    with np.errstate(all='ignore'):  # the checks refuse what is not finite
        calibration = gated(_calibration(content, name, own))
    for each, effect in zip(calibration.model.effects, calibration.model.terms.effects,
                            strict=True):
        if effect.own and not np.isclose(
                _own_rms(calibration, each),
                number_at(content['effects'][str(each)], 'own_rms'), _SAME_OWN, 0.0):
            raise StoredCalibrationError(
                f'{name} needs the effect {shown(str(each))} as it was when it was fitted, found '
                'another definition', 'use that definition, or refine again')
    body, found, digest = text.rpartition(_CHECKSUM)
    if not found:
        raise ValueError('its last line, the checksum, is missing')
    if digest.strip() != hashlib.sha256(body.rstrip().encode()).hexdigest():
        return _edited(calibration, content)
    return calibration


def _edited(calibration: Calibration, content: Mapping[str, Any]) -> Calibration:
    """Return the calibration of a file that was changed, with what does not match as findings."""
    noted = [*calibration.noted, OF_FILE['edited']]
    if content.get('correction') is not None:
        try:
            stated = value_at(content, 'correction', dict)
            offset, matrix = array_at(stated, 'offset', (3,)), array_at(stated, 'matrix', (3, 3))
        except (KeyError, ValueError) as err:
            raise ValueError(f'correction: {err}') from err
        scale = float(np.max(np.abs(calibration.matrix)))
        if not (np.allclose(offset, calibration.offset, 0.0, _SAME * calibration.units.per_g)
                and np.allclose(matrix, calibration.matrix, 0.0, _SAME * scale)):
            noted.append(OF_FILE['correction_in_file'])
    # Unknown keys are refused: a damaged key would be ignored.
    written = {**dict.fromkeys(_NOT_ALWAYS), **_content(calibration)}
    for place, found, known in (('', content, written), *(
            (f'of {key} ', content.get(key), written[key]) for key in _MAPPINGS)):
        for key in found or ():
            if key not in (known or ()):
                raise ValueError(f'the key {shown(key)} {place}is not known, expected one of '
                                 f'{", ".join(known or ())}')
    return replace(calibration, noted=tuple(noted))


def _calibration(content: Mapping[str, Any], file: str, own: Sequence[OwnEffect]) -> Calibration:
    model = Model(_effects(value_at(content, 'effects', dict), file, own),
                  array_at(content, 'rotation', (3, 3)))
    stated: dict[str, Any] = value_at(content, 'units', dict)
    unit, per_g = choice_at(stated, 'readings', UNIT_NAMES), number_at(stated, 'per_g')
    low, high = _PER_G[unit]
    if not low <= per_g <= high:
        expected = f'{low:g}' if low == high else f'{low:g} to {high:g}'
        raise ValueError(f'per_g is {shown(per_g)}, expected {expected} for {unit}')
    stated, size = value_at(content, 'quality', dict), int(np.sum(model.stated))
    quality: dict[str, Any] = {
        each.name: None if stated[each.name] is None and each.name in (
            'held_out_rms_mg', 'noise_floor_mg', 'chi2_per_dof') else number_at(stated, each.name)
        for each in fields(Quality)}
    rejected = tuple(Rejected(value_at(each, 'row', int), value_at(each, 'reason', str),
                              choice_at(each, 'kind', get_args(RejectedKind)))
                     for each in values_at(content, 'rejected', dict))
    return Calibration(
        name=choice_at(content, 'model', _NAMES),
        method=choice_at(content, 'method', STORED_METHODS), model=model,
        units=Units(unit, per_g), frame=choice_at(content, 'frame', FRAMES),
        **{key: value_at(content, key, str) for key in ('sensor', 'stream', 'date', 'reason')},
        covariance=array_at(content, 'covariance', (size, size), finite=False, most=LARGEST),
        quality=Quality(**quality), rejected=rejected,
        poses=_poses(value_at(content, 'poses', dict), _optional(
            content, 'autopilot', lambda stated: Autopilot(**stated))),
        noted=tuple(Finding(
            rows=tuple(values_at(each, 'rows', int)), kind=choice_at(each, 'kind', tuple(KINDS)),
            text=value_at(each, 'text', str), advice=value_at(each, 'advice', str),
            level=choice_at(each, 'level', LEVELS))
            for each in values_at(content, 'findings', dict)),
        gyro=_optional(content, 'gyro_bias', lambda stated: GyroBias(
            **{key: array_at(stated, key, (3,)) for key in ('bias', 'sd', 'slope')},
            temperature=(np.nan if stated['temperature'] is None else
                         number_at(stated, 'temperature')),
            temperatures=tuple(array_at(stated, 'temperatures', (
                len(value_at(stated, 'temperatures', list)),)).tolist()),
            rests=value_at(stated, 'rests', int))),
        noise=_optional(content, 'noise', lambda stated: SampleNoise(*(
            array_at(stated, key, (3,), finite=False) for key in ('force', 'rate')))))


def _optional(content: Mapping[str, Any], key: str, make: Callable[[dict[str, Any]], T]
              ) -> T | None:
    """Return the record made from a mapping that not every file has, or None."""
    return None if content.get(key) is None else make(value_at(content, key, dict))


def _effects(stated: Mapping[str, Any], file: str, own: Sequence[OwnEffect]
             ) -> dict[EffectKey, Floats]:
    """
    Return the values of effects; shape constants that are not stated are the usual ones.

    An effect of the user that is not among `own` is refused.

    """
    known, found = {each.name for each in own}, dict[EffectKey, Floats]()
    for name, values in stated.items():
        if isinstance(values, Mapping) and 'own_rms' in values and name not in known:
            raise StoredCalibrationError(
                f'{file} needs the effect {shown(name)} of the user ({shown(values.get("what"))}),'
                ' expected its definition', 'use --also FILE.py with the file that defines it, '
                'the parameter also of the node, or also=[effect] in Python')
        try:
            key = effect_named(name[:LONGEST_NAME + 1], own)
        except KeyError:
            key = ''
        if len(name) > LONGEST_NAME or key in ('', *CHANGES, *PROCESSES):
            raise ValueError(f'effect {shown(name)} is not in the catalogue')
        effect, values = entry_of(key), value_at(stated, name, dict)
        for part in values:
            if part not in (*effect.values, 'what', 'unit', *(('own_rms',) if effect.own else ())):
                raise ValueError(f'the key {shown(part)} of an effect is not known, expected one '
                                 f'of {", ".join(effect.values)}')
        values = {**dict(zip(effect.shape, effect.usual)), **values}
        found[key] = np.array([number_at(values, part, LARGEST) for part in effect.values])
    return found


def _poses(stated: Mapping[str, Any], autopilot: Autopilot | None) -> Poses:
    rows = np.array(values_at(stated, 'row', int), np.int64)
    columns: dict[str, Any] = {}
    for key, column in COLUMNS.items():
        if key in stated and not column.made:
            shape = (len(rows), len(column.names))
            columns[key] = _labels(stated) if key == 'label' else array_at(
                stated, key, shape if shape[1] > 1 else shape[:1])
    for key in value_at({'quantities': {}, **stated}, 'quantities', dict):
        if not is_quantity(key):
            raise ValueError(f'the key {shown(key)} of quantities is not that of a quantity')
        columns[key] = array_at(stated['quantities'], key, (len(rows),))
    check_values(columns, 'poses')
    return Poses(columns, rows, autopilot=autopilot)


def _labels(stated: Mapping[str, Any]) -> NDArray[Any]:
    labels = value_at(stated, 'label', list)
    for label in labels:
        if isinstance(label, list | Mapping):
            raise ValueError(f'label contains {shown(label)}, expected text')
    texts = [str(label) for label in labels]
    longest = max(map(len, texts), default=0)
    if len(texts) * longest > _MOST_LETTERS:
        raise ValueError(f'the longest label has {longest} characters, expected '
                         f'{_MOST_LETTERS // len(texts)} or less')
    return np.array(texts, dtype=str)


def read_calibration(path: Path, own: Sequence[OwnEffect] = ()) -> Calibration:
    """
    Read a stored calibration, which may have effects of the user that are among `own`.

    Raises
    ------
    InputError
        If the path is a folder, a pipe, a socket or a device.
    StoredCalibrationError
        If the file is damaged, has another version, or has implausible values.
    OSError
        If the file cannot be read.

    """
    return calibration_from(beginning_of(path), str(path), own)


def write_calibration(path: Path, calibration: Calibration, *, keep_before: bool = True) -> None:
    """
    Write a calibration; the previous file is kept as ``<name>.before`` unless excluded.

    Raises
    ------
    RefusedFitError, InputError
        As `calibration_bytes`.
    OSError
        If the file cannot be written. The stored file is then unchanged.

    """
    data = calibration_bytes(calibration)
    write_atomically(path, lambda file: file.buffer.write(data), keep_before=keep_before)


# ------------------------------------------------------------- typical values of a fleet

_PRIORS = 1
"""Format of a file of typical values."""

_PRIOR_NAMES = parameter_names(MODELS['10'].effects)
_MOST_SENSORS = 10**9


def write_priors(path: Path, priors: Mapping[str, FleetPrior]) -> None:
    """Write typical values as YAML; OSError if that fails, InputError if the reader refuses it."""
    models = [{'model': fleet.model, 'sensors': fleet.sensors, 'names': [*map(str, _PRIOR_NAMES)],
               'mean': fleet.prior.mean.tolist(),
               'sd': np.sqrt(np.diag(fleet.prior.covariance)).tolist(),
               'covariance': fleet.prior.covariance.tolist()} for fleet in priors.values()]
    content = {'format': _PRIORS, 'values_of': 'model 10 at |force| = 1 g', 'unit': 'g',
               'models': models}
    text: str = yaml.safe_dump(content, sort_keys=False, allow_unicode=True, width=99)
    _fleets_in(text.encode(), path)
    write_atomically(path, lambda file: file.write(text))


def read_prior(path: Path, model: str = '') -> FleetPrior:
    """
    Read the typical values of one model of sensor.

    Parameters
    ----------
    path : Path
        File as `write_priors` writes it.
    model : str
        Model of the sensor; empty: the only one in the file.

    Raises
    ------
    InputError
        If the file is damaged, is newer, or has not this model.
    OSError
        If the file cannot be read.

    """
    found = _fleets_in(beginning_of(path), path)
    chosen = [each for each in found if each.model == model or (not model and len(found) == 1)]
    if not chosen:
        names = some(each.model or "''" for each in found) or 'no model'
        raise InputError(f'{path} has {names}, expected the model {model!r}',
                         'set --sensor-model to a model in the file')
    return chosen[0]


def _fleets_in(data: bytes, path: Path) -> list[FleetPrior]:
    """Return the typical values in the data of a file, of all models."""
    try:
        content = read_plain(decoded(data))
        if content['format'] != _PRIORS:
            raise InputError(f'{path} has format {shown(content["format"])}, expected {_PRIORS}',
                             'update accel_calib, or make the file again')
        size, found = len(_PRIOR_NAMES), list[FleetPrior]()
        for each in values_at(content, 'models', dict):
            if tuple(names := values_at(each, 'names', str)) != _PRIOR_NAMES:
                raise ValueError(f'names are {some(names)}, expected {some(_PRIOR_NAMES)}')
            covariance = array_at(each, 'covariance', (size, size), most=LARGEST_OFFSET_G)
            if not np.allclose(covariance, covariance.T):
                raise ValueError('covariance is not symmetric')
            prior = Prior(array_at(each, 'mean', (size,), most=LARGEST_OFFSET_G), covariance)
            _ = prior.root  # raises LinAlgError unless it is positive definite
            if not 1 <= (sensors := value_at(each, 'sensors', int)) <= _MOST_SENSORS:
                raise ValueError(f'sensors is {shown(sensors)}, expected 1 to {_MOST_SENSORS}')
            found.append(FleetPrior(str(each['model']), sensors, prior))
        return found
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as err:
        raise InputError(f'{path} has no typical values of a fleet: {err}',
                         'use fleet.yaml of accel-calib fleet') from err
