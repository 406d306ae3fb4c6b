# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Values of programs that correct with a matrix and an offset.

For each of them the same calibration is written in its own parameters:

    force = M raw - c = M (raw - V),   M = A diag(s),   M = inv(K R),   M = Q L

A has columns of length 1, which is the rotation of the axes where the gains are those of each axis
(Fusion). K is diagonal, and R has rows of length 1 (imucal). Q is a rotation, and L is lower
triangular with a positive diagonal (OpenVINS, as Kalibr has it). For a model with more than offset
and gain, M and c are the least-squares fit of `made.affine_fit`.

"""

from dataclasses import replace

import numpy as np

from .made import affine_fit, frame_words, Made, unit_in_ascii
from ..calibration import Calibration
from ..units import STANDARD_GRAVITY


def affine(calibration: Calibration, force_per_g: float | None = None, levelled: bool = True,
           notes: tuple[str, ...] = ()) -> Made:
    """
    Return a calibration as M, c and the other parameters above.

    The force is in the unit of `Calibration.apply`, or has this many units per g. What is not
    `levelled` leaves the mounting out.

    """
    calibration = calibration if levelled else calibration.in_sensor_frame
    unit, gyro = force_per_g or calibration.force_per_g, calibration.gyro
    bias = np.zeros(3) if gyro is None else gyro.bias
    unknown = [] if gyro else ['the bias of the gyro is not known: it is 0']
    matrix, constant = (each * unit for each in affine_fit(calibration))
    sensitivity, inverse = np.linalg.norm(matrix, axis=0), np.linalg.inv(matrix)
    gain = np.linalg.norm(inverse, axis=1)
    orthogonal, triangular = (part[..., ::-1] for part in np.linalg.qr(matrix[:, ::-1]))
    triangular, signs = triangular[::-1], np.sign(np.diag(triangular[::-1]))
    turn = calibration.rotation.T
    values = {
        'M': matrix, 'c': constant, 'V': inverse @ constant,
        'A': matrix / sensitivity, 's': sensitivity, 'K': np.diag(gain),
        'R': inverse / gain[:, np.newaxis], 'Q': orthogonal * signs,
        'inverse_of_L': np.linalg.inv(signs[:, np.newaxis] * triangular), 'turn': turn,
        'gyro': bias, 'turned_gyro': turn @ bias, 'unknown': unknown}
    return Made(values, lambda reading, temperature: (reading @ matrix.T - constant) / unit,
                levelled, (f'force: {frame_words(calibration)}',), notes)


def imucal(calibration: Calibration) -> Made:
    """Return the values of FerrarisCalibrationInfo, in m/s² for native readings."""
    units = calibration.units
    made = affine(calibration, STANDARD_GRAVITY if units.is_native else None)
    return replace(made, values={
        **made.values, 'unit': 'm/s^2' if units.is_native else unit_in_ascii(units, ''),
        'from_unit': unit_in_ascii(units, 'a.u.')})
