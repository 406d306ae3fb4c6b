# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Two small files: the typical values of a fleet as YAML, and a plan of poses as CSV.

Typical values are stored by model of sensor. A plan has its words as ``#`` comments, and one row
per pose.

"""

from __future__ import annotations

from collections.abc import Mapping
import csv
from pathlib import Path
from typing import Any, TextIO, TYPE_CHECKING

import numpy as np
import yaml

from .plain_yaml import array_at, read_plain, value_at, values_at
from ..calibrate import FleetPrior, LARGEST_OFFSET_G
from ..disk import write_atomically
from ..effects import MODELS, parameter_names
from ..errors import InputError
from ..estimate import Prior
from ..units import STANDARD_GRAVITY

if TYPE_CHECKING:
    from ..refine import PosePlan

_FORMAT = 1
_NAMES = parameter_names(MODELS['10'].effects)
_LARGEST = LARGEST_OFFSET_G
"""Largest offset [g], deviation of a gain from 1, and variance of them."""


_CONTEXT = {'temperature': ('temperature', 1.0), 'supply_voltage': ('supply_voltage', 1.0),
            'std': ('vibration', STANDARD_GRAVITY), 'time': ('wait', 1.0)}
"""Column of the plan and its unit, by column of the poses: °C, V, m/s², s after the last pose.
Quantities keep their name."""


def write_priors(path: Path, priors: Mapping[str, FleetPrior]) -> None:
    """Write typical values as YAML; raise OSError if the file cannot be written."""
    models = [{'model': fleet.model, 'sensors': fleet.sensors, 'names': list(_NAMES),
               'mean': fleet.prior.mean.tolist(),
               'sd': np.sqrt(np.diag(fleet.prior.covariance)).tolist(),
               'covariance': fleet.prior.covariance.tolist()} for fleet in priors.values()]
    content = {'format': _FORMAT, 'values_of': 'model 10 at |force| = 1 g', 'unit': 'g',
               'models': models}
    write_atomically(path, lambda file: yaml.safe_dump(content, file, sort_keys=False,
                                                       allow_unicode=True, width=99))


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
    try:
        content = read_plain(path.read_text(encoding='utf-8'))
        if content['format'] != _FORMAT:
            raise InputError(f'{path} has format {content["format"]}, expected {_FORMAT}',
                             'update accel_calib, or make the file again')
        found = [_fleet_of(each) for each in values_at(content, 'models', dict)]
    except (KeyError, TypeError, ValueError, np.linalg.LinAlgError) as err:
        raise InputError(f'{path} has no typical values of a fleet: {err}',
                         'use fleet.yaml of accel-calib fleet') from err
    chosen = [each for each in found if each.model == model or (not model and len(found) == 1)]
    if not chosen:
        names = ', '.join(each.model or "''" for each in found) or 'no model'
        raise InputError(f'{path} has {names}, expected the model {model!r}',
                         'set --sensor-model to a model in the file')
    return chosen[0]


def _fleet_of(content: Mapping[str, Any]) -> FleetPrior:
    """Return typical values from their mapping; raise ValueError if they are not sound."""
    size = len(_NAMES)
    if tuple(content['names']) != _NAMES:
        raise ValueError(f'names are {content["names"]}, expected {list(_NAMES)}')
    covariance = array_at(content, 'covariance', (size, size), most=_LARGEST)
    if not np.allclose(covariance, covariance.T):
        raise ValueError('covariance is not symmetric')
    prior = Prior(array_at(content, 'mean', (size,), most=_LARGEST), covariance)
    _ = prior.whitening  # raises LinAlgError unless it is positive definite
    if (sensors := value_at(content, 'sensors', int)) < 1:
        raise ValueError(f'sensors is {sensors}, expected 1 or more')
    return FleetPrior(str(content['model']), sensors, prior)


def write_plan(path: Path, plan: PosePlan) -> None:
    """
    Write the poses of a plan; the direction that points up is a unit vector in the sensor axes.

    Raises
    ------
    OSError
        If the file cannot be written. An earlier file is then unchanged.

    """
    columns = {**{key: (key, 1.0) for pose in plan.poses for key in pose.context}, **_CONTEXT}

    def write(file: TextIO) -> None:
        file.writelines(f'# {line}\n' for line in plan.lines)
        writer = csv.writer(file, lineterminator='\n')
        writer.writerow(['pose', 'up_x', 'up_y', 'up_z', 'attitude',
                         *(name for name, _ in columns.values()), 'separates',
                         'expected_probability'])
        for number, pose in enumerate(plan.poses, 1):
            context = [format(pose.context[key] * scale, '.6g') if key in pose.context else ''
                       for key, (_, scale) in columns.items()]
            writer.writerow([number, *(f'{part:.6f}' for part in pose.up), pose.words, *context,
                             ' / '.join(pose.separates), f'{pose.expected:.4f}'])

    write_atomically(path, write)
