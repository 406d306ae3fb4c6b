# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The file of the typical values of a fleet, by model of sensor."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from .plain_yaml import list_at, read_plain
from ..calibrate import FleetPrior
from ..disk import write_atomically
from ..effects import MODELS, parameter_names
from ..errors import InputError
from ..estimate import Prior

_FORMAT = 1
_NAMES = parameter_names(MODELS['10'])


def write_priors(path: Path, priors: Mapping[str, FleetPrior]) -> None:
    """Write typical values as YAML; raise OSError if the file cannot be written."""
    content = {'format': _FORMAT, 'values_of': 'model 10 at |force| = 1 g',
               'unit': 'g', 'models': [_plain(each) for each in priors.values()]}
    write_atomically(path, lambda file: yaml.safe_dump(content, file, sort_keys=False,
                                                       allow_unicode=True, width=99))


def _plain(fleet: FleetPrior) -> dict[str, Any]:
    prior = fleet.prior
    return {'model': fleet.model, 'sensors': fleet.sensors, 'names': list(_NAMES),
            'mean': prior.mean.tolist(), 'sd': np.sqrt(np.diag(prior.covariance)).tolist(),
            'covariance': prior.covariance.tolist()}


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
        found = [_fleet_of(each) for each in list_at(content, 'models')]
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
    mean, covariance = np.array(content['mean'], float), np.array(content['covariance'], float)
    if mean.shape != (size,) or covariance.shape != (size, size):
        raise ValueError(f'mean and covariance have shapes {mean.shape} and {covariance.shape}, '
                         f'expected ({size},) and ({size}, {size})')
    if not (np.all(np.isfinite(mean)) and np.allclose(covariance, covariance.T)):
        raise ValueError('mean or covariance are not finite and symmetric')
    prior = Prior(mean, covariance)
    _ = prior.whitening  # raises LinAlgError unless it is positive definite
    return FleetPrior(str(content['model']), int(content['sensors']), prior)
