# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Noise figures for JSON, with the names and units of Kalibr."""

from __future__ import annotations

from typing import Any

from .records import AxisNoise, FIGURES, Kind, NoiseFigures

_NATIVE_REASON = {
    'accelerometer': 'the readings are in native units; state the unit, or apply a calibration',
    'gyroscope': 'the rates are not in rad/s; convert them'}


def to_json(found: NoiseFigures) -> dict[str, Any]:
    """
    Return the figures for JSON.

    ``accelerometer_noise_density`` [m/s²/√Hz], ``accelerometer_random_walk`` [m/s³/√Hz],
    ``gyroscope_noise_density`` [rad/s/√Hz], ``gyroscope_random_walk`` [rad/s²/√Hz] and
    ``update_rate`` [Hz] have the names and units of Kalibr's imu.yaml. NaN, which is null in JSON,
    is a figure that is not seen; ``…_reason`` is then the reason.

    """
    result: dict[str, Any] = {
        'update_rate': found.rate,
        'rest': {'start': found.start, 'seconds': found.seconds, 'samples': found.samples},
        'temperature': found.temperature, 'notes': found.notes}
    for kind in ('accelerometer', 'gyroscope'):
        axes = found.of(kind)
        result[f'{kind}_unit'] = axes[0].unit if axes else None
        for figure in FIGURES:
            result.update(_figure_json(found, kind, figure))
    result['curves'] = [_curve_json(axis) for axis in found.axes]
    return result


def _figure_json(found: NoiseFigures, kind: Kind, figure: str) -> dict[str, Any]:
    """Return one figure of one sensor for JSON."""
    axes = {axis.axis: axis.figures[figure] for axis in found.of(kind)}
    every = [axes.get(axis) for axis in 'xyz'] if axes else []
    native = any(axis.unit == 'native' for axis in found.of(kind))
    value, sd = (None, None) if native else found.common(kind, figure)
    reason = found.needs.get((kind, figure))
    if native:
        reason = _NATIVE_REASON[kind]
    elif not axes:
        reason = f'the recording has no {kind} with noise'
    name = f'{kind}_{figure}'
    return {name: value, f'{name}_sd': sd,
            f'{name}_axes': [each and each.value for each in every],
            f'{name}_axes_sd': [each and each.sd for each in every],
            f'{name}_axes_interval': [each and each.interval for each in every],
            f'{name}_axes_upper': [each and each.upper for each in every],
            f'{name}_reason': reason}


def _curve_json(axis: AxisNoise) -> dict[str, Any]:
    return {'sensor': axis.kind, 'axis': axis.axis, 'unit': axis.unit, 'tau': axis.tau,
            'deviation': axis.deviation, 'low': axis.low, 'high': axis.high,
            'model': axis.model, 'slope': axis.slope, 'slope_sd': axis.slope_sd,
            'used': axis.used, 'p_value': axis.p_value}
