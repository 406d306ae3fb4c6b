# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Calibrate an accelerometer in place, from nothing but the fact that gravity is 1 g.

Two lines cross the package:

1. Imu -> still pose -> fit -> stored calibration -> corrected Imu
2. poses + calibration -> gap -> named effect -> larger model -> report

The measurement equation
------------------------
There is one, from true specific force to reading, and every part of the package calls it::

    u       = ΔR force
    reading = V + W u + sum of effects(u, context)
    force   = ΔRᵀ u,  with u found from the reading; without effects u = W⁻¹ (reading - V)

The symbols are those of NXP AN5286: V is the zero-g offset, W the gain (sensitivity and
cross-axis), ΔR the mounting: it takes a vector in the levelled frame to the sensor frame.

Units
-----
Specific force and readings are in units of local gravity (g) inside the package, as IEEE 1293
and AN5286 have them, so that a still sensor measures |force| = 1 and a gain has no dimension.
`accel_calib.units` converts at the edge (m/s2, g, or native counts and volts). All else is SI:
seconds, rad/s, rad; temperature is in °C.

Sign and frames
---------------
Specific force, REP-145: a sensor lying flat and still reads +1 g on the axis that points up.
The default levelled frame is that of REP-103 (x forward, y left, z up); see
`accel_calib.calibrate.mounting` for the others.

Arrays are (n, 3): one row a pose or a sample, columns x, y, z. A vector in frame a is `vec_a`;
`mat_ab` takes frame b to a.

"""

__version__ = '0.1.0'
