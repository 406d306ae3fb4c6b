# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Show how the error falls from model to model, over all orientations.

Like figures 1 to 4 of NXP AN5286: the error of |force| over roll and pitch, raw and after
calibrations with 4, 7 and 10 parameters. The sensor is simulated. A part of its error, the square
and the cube of the force, is in none of the three models and remains.

    python3 examples/error_surfaces.py                     # the numbers
    python3 examples/error_surfaces.py surfaces.svg a.png  # the figures (matplotlib)

"""

from pathlib import Path
import sys

import accel_calib as ac
import numpy as np

SENSOR = {
    'offset': [0.026, -0.014, 0.012],          # g
    'axis_gain': [0.0150, 0.0035, 0.0080],     # g/g
    'cross_axis': [0.0020, -0.0014, 0.0010],   # g/g
    'quadratic': [0.0034, -0.0030, 0.0026],    # g/g²
    'cubic': [0.0034, -0.0024, 0.0032],        # g/g³
}
MODELS = {'4': 'offset and one gain', '7': 'a gain for each axis', '10': 'cross-axis, too'}
ROLL, PITCH = np.meshgrid(np.linspace(-180.0, 180.0, 73), np.linspace(-90.0, 90.0, 37))  # °


def up_of(roll: np.ndarray, pitch: np.ndarray) -> np.ndarray:
    """Return the direction of up in the axes of a sensor with this attitude (x forward)."""
    return np.stack([-np.sin(pitch), np.cos(pitch) * np.sin(roll),
                     np.cos(pitch) * np.cos(roll)], axis=-1)


def surfaces() -> dict[str, np.ndarray]:
    """Return the error of |force| over roll and pitch by title [mg]."""
    poses = ac.simulate(SENSOR, poses=60, noise=0.002, units='g', seed=1)
    up = up_of(np.radians(ROLL), np.radians(PITCH)).reshape(-1, 3)
    readings = ac.simulate(SENSOR, directions=up, noise=0.0, units='g').reading
    forces = {'raw': readings}
    for model, adds in MODELS.items():
        calibration = ac.fit(poses, model=model, method='algebraic')
        forces[f'{model} parameters: {adds}'] = calibration.apply(readings)
    return {title: (np.linalg.norm(force, axis=1).reshape(ROLL.shape) - 1.0) * 1e3
            for title, force in forces.items()}


def draw(found: dict[str, np.ndarray], paths: list[Path]) -> None:
    """Draw one surface per model, each with its own scale, and write the figure."""
    from matplotlib import rcParams
    from matplotlib.figure import Figure

    rcParams['svg.hashsalt'] = 'error_surfaces'  # equal files from run to run
    figure = Figure(figsize=(8.4, 7.0), layout='constrained')
    panels = figure.subplots(2, 2, subplot_kw={'projection': '3d'}).ravel()
    for panel, (title, error) in zip(panels, found.items(), strict=True):
        largest = np.max(np.abs(error))
        panel.plot_surface(ROLL, PITCH, error, cmap='RdBu_r', vmin=-largest, vmax=largest,
                           rstride=1, cstride=1, linewidth=0.0, rasterized=True)
        panel.set(xlabel='roll [°]', ylabel='pitch [°]', zlim=(-largest, largest),
                  xticks=(-180, -90, 0, 90, 180), yticks=(-90, -45, 0, 45, 90))
        panel.set_title(f'{title}\nlargest error {largest:.1f} mg', fontsize=10.5)
        panel.tick_params(labelsize=8)
        panel.view_init(elev=28.0, azim=-60.0)
        panel.set_box_aspect((1.2, 1.0, 0.75), zoom=0.95)
    figure.suptitle('|force| − 1 g [mg] over all orientations', fontsize=12)
    for path in paths:
        figure.savefig(path, dpi=130, facecolor='white', bbox_inches='tight',
                       metadata={'Date': None} if path.suffix == '.svg' else None)


def main() -> None:
    """Print the largest and the RMS error of each model, and write the figures asked for."""
    found = surfaces()
    weight = np.cos(np.radians(PITCH))
    for title, error in found.items():
        rms = np.sqrt(np.sum(weight * error ** 2) / np.sum(weight))
        print(f'{title}: largest error {np.max(np.abs(error)):.1f} mg, RMS {rms:.1f} mg')
    paths = [Path(name) for name in sys.argv[1:]]
    if paths:
        draw(found, paths)


if __name__ == '__main__':
    main()
