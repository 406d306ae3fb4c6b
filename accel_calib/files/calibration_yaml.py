# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Stored calibrations: readable, versioned YAML.

The text is made and read by `format_calibration` and `parse_calibration`; disk is touched only
in `write_calibration` and `read_calibration`.

"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any, cast

import numpy as np
import yaml

from .atomic import write_atomically
from .. import __version__
from ..calibrate import Calibration, FRAMES, Quality, Rejected
from ..effects import EFFECTS
from ..errors import StoredCalibrationError
from ..model import Model
from ..table import COLUMNS, Floats, Poses
from ..units import UnitName, Units

try:  # eight times as fast, where PyYAML was built with it
    from yaml import CSafeDumper as SafeDumper
    from yaml import CSafeLoader as SafeLoader
except ImportError:
    from yaml import SafeDumper, SafeLoader  # type: ignore[assignment]

FORMAT = 'accel_calib calibration'
VERSION = 1
_EQUATION = 'reading = V + W u + effects, u = ΔR force, |force| = 1 g at rest; values in g'


def format_calibration(calibration: Calibration) -> str:
    """Give the text of a stored calibration."""
    model, units = calibration.model, calibration.units
    content = {
        'format': FORMAT, 'version': VERSION, 'package_version': __version__,
        'equation': _EQUATION, 'sensor': calibration.sensor, 'date': calibration.date,
        'units': {'readings': units.name, 'per_g': float(units.per_g)},
        'model': calibration.name, 'method': calibration.method, 'reason': calibration.reason,
        'effects': {name: {'what': EFFECTS[name].words, 'unit': EFFECTS[name].unit,
                           **dict(zip(EFFECTS[name].values, values.tolist(), strict=True))}
                    for name, values in model.values.items()},
        'frame': calibration.frame, 'rotation': model.rotation.tolist(),
        'covariance': calibration.covariance.tolist(),
        'quality': asdict(calibration.quality),
        'rejected': [asdict(rejected) for rejected in calibration.rejected],
        'warnings': list(calibration.warnings),
        'poses': {'row': calibration.poses.row.tolist(),
                  **{key: calibration.poses[key].tolist() for key in COLUMNS
                     if key in calibration.poses}},
    }
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=99,
                     default_flow_style=None)


class _Dumper(SafeDumper):
    """The safe dumper without anchors: two equal lists are written out twice."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def parse_calibration(text: str, name: str) -> Calibration:
    """
    Read the text of a stored calibration.

    Parameters
    ----------
    text : str
        YAML.
    name : str
        What to call it in messages.

    Raises
    ------
    StoredCalibrationError
        If it is damaged or newer than this package.

    """
    try:
        content = yaml.load(text, Loader=SafeLoader)
    except yaml.YAMLError as err:
        raise _damaged(name, 'it is not YAML') from err
    _check_version(content, name)
    try:
        return _calibration(content)
    except (KeyError, TypeError, ValueError, AttributeError) as err:
        raise _damaged(name, f'{type(err).__name__}: {err}') from err


def _damaged(name: str, what: str) -> StoredCalibrationError:
    return StoredCalibrationError(f'{name} is not a whole calibration ({what})',
                                  'fit again, or use the file kept as .before')


def _check_version(content: Any, name: str) -> None:
    """Refuse what is no calibration, or a newer one. Older versions would be converted here."""
    if not isinstance(content, Mapping) or content.get('format') != FORMAT:
        raise StoredCalibrationError(f'{name} is not a calibration of accel_calib, whose first '
                                     f'line is "format: {FORMAT}"', 'give a file that fit wrote')
    version = content.get('version')
    if not isinstance(version, int) or version < 1:
        raise _damaged(name, f'its version is {version!r}')
    if version > VERSION:
        raise StoredCalibrationError(f'{name} has version {version}, this package reads up to '
                                     f'{VERSION}', 'update accel_calib, or fit again')


def _calibration(content: Mapping[str, Any]) -> Calibration:
    """Make the record from the content of a file."""
    if content['frame'] not in FRAMES:
        raise ValueError(f'frame {content["frame"]!r} is none of {", ".join(FRAMES)}')
    values = {name: np.array([float(effect[part]) for part in EFFECTS[name].values])
              for name, effect in content['effects'].items()}
    rotation = _finite(content['rotation'])
    if rotation.shape != (3, 3) or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-6):
        raise ValueError('rotation is not a rotation matrix')
    if not all(np.all(np.isfinite(part)) for part in values.values()):
        raise ValueError('an effect has a value that is not finite')
    units = content['units']
    return Calibration(
        name=str(content['model']), method=str(content['method']), model=Model(values, rotation),
        units=Units(cast(UnitName, units['readings']), float(units['per_g'])),
        sensor=str(content['sensor']), frame=content['frame'], date=str(content['date']),
        covariance=np.array(content['covariance'], float).reshape(2 * (_size(values),)),
        quality=Quality(**{field.name: content['quality'][field.name]
                           for field in fields(Quality)}),
        poses=_poses(content['poses']),
        rejected=tuple(Rejected(**rejected) for rejected in content['rejected']),
        reason=str(content['reason']), warnings=tuple(content['warnings']))


def _size(values: Mapping[str, Floats]) -> int:
    return sum(len(part) for part in values.values())


def _finite(values: Any) -> Floats:
    array = np.array(values, float)
    if not np.all(np.isfinite(array)):
        raise ValueError('a number is not finite')
    return array


def _poses(content: Mapping[str, Any]) -> Poses:
    columns = {key: np.array(content[key]) if key == 'label' else _finite(content[key])
               for key in COLUMNS if key in content}
    return Poses(columns, np.array(content['row'], np.int64))


def read_calibration(path: Path) -> Calibration:
    """
    Read a stored calibration.

    Raises
    ------
    StoredCalibrationError
        If it is damaged or newer than this package.
    OSError
        If it cannot be read.

    """
    try:
        text = path.read_text(encoding='utf-8')
    except UnicodeDecodeError as err:
        raise _damaged(str(path), 'it is not text') from err
    return parse_calibration(text, str(path))


def write_calibration(path: Path, calibration: Calibration) -> None:
    """
    Store a calibration; the one before is kept as ``<name>.before``.

    Raises
    ------
    OSError
        If it cannot be written; what was stored is then as it was.

    """
    text = format_calibration(calibration)
    write_atomically(path, lambda file: file.write(text), keep_before=True)


def check_sensor(calibration: Calibration, sensor: str) -> None:
    """
    Make sure that a calibration is of this sensor; an empty name matches any.

    Raises
    ------
    StoredCalibrationError
        If it is of another.

    """
    if calibration.sensor and sensor and calibration.sensor != sensor:
        raise StoredCalibrationError(f'the calibration is of sensor {calibration.sensor!r}, the '
                                     f'readings come from {sensor!r}',
                                     'give the calibration of this sensor, or fit it')
