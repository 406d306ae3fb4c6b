# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The residual of each pose before and after a calibration, and its figures.

**Sphere map.** Two hemispheres in Lambert's equal-area projection. A direction u is at the radius
√(1 - |u_z|) from the pole. Equal areas of the sphere have equal areas on the map.

"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .sheet import (
    ACCENT, add_bar, AFTER, BEFORE, check_matplotlib, DISC, DIVERGING, Drawing, drawn, EDGE, FAINT,
    HEIGHT_INCHES, INK, legend_below, Mark, Marks, PAPER, RIM, SEQUENTIAL)
from ..calibration import Calibration, directions_in, errors_after, errors_before, in_g
from ..effects import (
    acting_temperature, add_history, AXES, EffectKey, entry_of, rate_at, sensor_force)
from ..geometry import uncovered, unit
from ..refinement import Refinement
from ..statistics import over_axes, rms
from ..table import column_of, Floats, Poses
from ..text import milli, short, with_minus
from ..units import MG

_CONTEXT = ('temperature', 'time', 'supply_voltage', 'std', 'rate')

_LABELS = {
    'temperature': ('temperature [°C]', 1.0),
    'temperature_of_offset': ('temperature that acts on the offset [°C]', 1.0),
    'temperature_of_gain': ('temperature that acts on the gain [°C]', 1.0),
    'temperature_rate': ('rate of temperature [°C/min]', 60.0),
    'supply_voltage': ('supply [V]', 1.0), 'std': ('standard deviation of the samples [mg]', MG),
    'rate': ('angular rate [rad/s]', 1.0), 'force': ('force along the axis [g]', 1.0)}
"""Label and factor of each variable."""

_PANELS = 3
"""Largest number of variables in one figure."""

_SPANS = (('h', 3600.0), ('min', 60.0), ('s', 1.0))
"""Units of time [s]; a range of more than three of a unit is drawn in it."""


@dataclass(frozen=True)
class Variable:
    """
    A variable for the horizontal axis, with its (n,) values, one per pose.

    `unit_range` is whether the range is -1 to 1 by definition.

    """

    label: str
    values: Floats
    unit_range: bool = False


def variables_of(effect: EffectKey, poses_g: Poses, force: Floats, shape: Floats | None = None
                 ) -> list[Variable]:
    """
    Return the variables that an effect depends on: one variable, or one per axis.

    `force` is the (n, 3) force of the poses [g], and `shape` the (s,) shape of the effect, such as
    a lag; by default zeros.

    """
    found = entry_of(effect)
    shape = np.zeros(len(found.shape)) if shape is None else shape
    known = with_thermal(poses_g, found.lagged, shape)
    key = next((name for name in found.over_of(shape) if name in known), None)
    if key == 'previous':
        return [Variable(f'from the previous pose, {axis}', known[key][:, k], True)
                for k, axis in enumerate(AXES)]
    if key is None:
        axes = sorted({term.axis for term in found.terms}) or [0, 1, 2]
        return [Variable(f'force along {AXES[k]} [g]', force[:, k], True) for k in axes]
    return [variable_of(key, known[key])]


def with_thermal(poses_g: Poses, lagged: str, shape: Floats) -> Poses:
    """Return poses with the rate of the temperature and the temperature that acts, if known."""
    if 'time' not in poses_g or 'temperature' not in poses_g:
        return poses_g
    found = {'temperature_rate': rate_at(poses_g.columns)}
    if lagged and shape[0]:
        found[lagged] = acting_temperature(poses_g.columns, lagged, shape[0], bool(shape[1]))
    return poses_g.with_columns(**found)


def variable_of(key: str, values: Floats) -> Variable:
    """Return a variable for the horizontal axis: (n,) values, or the (n, 3) ones of a vector."""
    if key == 'time':
        since = values - np.min(values)
        name, size = next((each for each in _SPANS if np.max(since) > 3.0 * each[1]), _SPANS[-1])
        return Variable(f'time since the first pose [{name}]', since / size)
    if values.ndim > 1:
        values = over_axes(values) if key == 'std' else np.linalg.norm(values, axis=1)
    label, factor = _LABELS.get(key) or (column_of(key).meaning, 1.0)
    return Variable(label, values * factor)


@dataclass(frozen=True)
class Residuals:
    """
    The residuals of poses.

    Parameters
    ----------
    poses_g : Poses
        The n poses that are evaluated, in g.
    force : (n, 3) array
        Direction of up in each pose, in the sensor axes.
    before_mg, after_mg : (n,) array
        Residual without and with the calibration [mg], signed if only |force| is known.
    left_out : Poses
        The d poses that are left out, in the unit of the readings.
    left_out_force : (d, 3) array
        Their directions.
    reasons : mapping of int to str
        Reason by row for the poses left out.
    signed : bool
        Whether `after_mg` is signed.

    """

    poses_g: Poses
    force: Floats
    before_mg: Floats
    after_mg: Floats
    left_out: Poses
    left_out_force: Floats
    reasons: Mapping[int, str]
    signed: bool


def residuals_of(calibration: Calibration, poses: Poses | None = None) -> Residuals:
    """Return the residuals of a calibration on poses in its unit, by default on its own."""
    own = calibration.poses if poses is None else poses
    model, units = calibration.model, calibration.units
    poses_g = calibration.held(add_history(in_g(own, units), model))
    reasons = {each.row: each.reason for each in calibration.rejected if poses is None}
    out = np.isin(own.row, list(reasons))
    kept = poses_g.take(~out)
    force = sensor_force(model, poses_g.reading, poses_g.columns)
    vectors = calibration.form.known_orientation and 'reference' in own
    before = errors_before(kept, units, vectors=vectors)
    after = errors_after(model, kept, vectors=vectors)
    return Residuals(kept, unit(force[~out]), before * MG, after * MG, left_out=own.take(out),
                     left_out_force=unit(force[out]), reasons=reasons, signed=not vectors)


def residuals_of_refinement(result: Refinement) -> Residuals:
    """Return the residuals of the poses that a refinement kept."""
    calibration = result.calibration
    own = calibration.poses
    out = own.take(np.isin(own.row, result.disturbed_poses))
    reasons = {each.row: each.reason for each in calibration.rejected}
    signed = any(bool(np.any(stage.residual_mg < 0.0)) for stage in result.stages)
    before = errors_before(result.poses_g, calibration.units,
                           vectors=not signed and 'reference' in result.poses_g)
    return Residuals(
        result.poses_g, result.force, before * MG, result.stages[-1].residual_mg, left_out=out,
        left_out_force=directions_in(out, calibration), signed=signed, reasons={
            row: reasons.get(row, 'disagrees with the other poses') for row in out.row.tolist()})


# ----------------------------------------------------------------------------- figures

_INK_PER_POSE = 3500.0
"""Total area of the markers [points²]; markers are larger for fewer poses."""


def limit_mg(*residuals: Residuals) -> float:
    """Return the end of a scale for residuals, 8 % beyond the largest [mg]."""
    largest = max(float(np.max(np.abs(found.after_mg))) for found in residuals)
    return max(largest, 1e-9) * 1.08


def of_remainder(residuals: Residuals, prefix: str = 'remaining') -> Iterator[Drawing]:
    """Yield figures of the final residuals, over the sphere and against the context."""
    limit = limit_mg(residuals)
    title = f'Remaining residual: {short(rms(residuals.after_mg))} mg RMS'
    yield from sphere_map(residuals, f'{prefix}_sphere', title, limit, more=', by direction')
    poses_g = residuals.poses_g
    recorded = [variable_of(key, poses_g[key]) for key in (*_CONTEXT, *poses_g.quantities)
                if key in poses_g]
    variables = ([variable for variable in recorded if np.ptp(variable.values) > 0.0]
                 or variables_of('quadratic', poses_g, residuals.force))
    for k in range(0, len(variables), _PANELS):
        yield against(residuals, variables[k:k + _PANELS], f'{prefix}_variables{k or ""}', title,
                      limit, colour=AFTER)


def sphere_map(residuals: Residuals, name: str, title: str, limit: float, *, more: str = ''
               ) -> Iterator[Drawing]:
    """
    Yield residuals over the sphere, if the poses have 6 different directions or more.

    `limit` is the end of the colour scale [mg].

    """
    force, values, signed = residuals.force, residuals.after_mg, residuals.signed
    if len(np.unique(np.round(force, 1), axis=0)) < 6:
        return
    marks, hover = _marks(residuals), dict[str, Marks]()
    with drawn(HEIGHT_INCHES, title, columns=2, grid='') as (figure, discs):
        for disc, half, up in _hemispheres(discs):
            here, places = _on_map(force, up)
            order = np.argsort(np.abs(values[here]))
            here = here[order]
            scattered = disc.scatter(
                *places[order].T, c=values[here], edgecolors=INK, linewidths=0.5,
                s=min(_INK_PER_POSE / max(len(force), 12), 130.0), gid=half, zorder=3,
                cmap=DIVERGING if signed else SEQUENTIAL,
                vmin=-limit if signed else 0.0, vmax=limit)
            hover[half] = tuple(marks[k] for k in here)
            out, places = _on_map(residuals.left_out_force, up)
            rows = residuals.left_out.row[out]
            disc.plot(*places.T, linestyle='none', marker='s', markersize=8, fillstyle='none',
                      color=ACCENT, zorder=4, gid=f'out_{half}')
            for place, row in zip(places, rows, strict=True):
                disc.annotate(str(row), place, (5, 4), textcoords='offset points', fontsize=8.5,
                              color=ACCENT, zorder=4)
            hover[f'out_{half}'] = tuple(Mark(f'row {row}, left out', int(row)) for row in rows)
        add_bar(figure, scattered, discs, _label(signed=signed), orientation='horizontal',
                shrink=0.8, pad=0.03)
    yield Drawing(name, f'{title}{more}', figure, hover)


def _hemispheres(discs: Sequence[Any]) -> Iterator[tuple[Any, str, bool]]:
    """
    Yield the map and the name of each hemisphere, and whether its pole is +z.

    The map has the rim, the circle at 45° and the sensor axes.

    """
    angle = np.linspace(0.0, 2.0 * np.pi, 181)
    circle = np.array([np.cos(angle), np.sin(angle)])
    middle = np.sqrt(1.0 - np.sqrt(0.5))
    for disc, name, pole in zip(discs, ('up', 'down'), ('+z up', '−z up'), strict=True):
        disc.fill(*circle, facecolor=DISC, edgecolor=RIM, zorder=0)
        disc.plot(*(middle * circle), color=FAINT, linewidth=0.8, zorder=1)
        disc.plot([-1, 1], [0, 0], [0, 0], [-1, 1], color=FAINT, linewidth=0.8, zorder=1)
        for axis, x, y in (('+x', 1, 0), ('-x', -1, 0), ('+y', 0, 1), ('-y', 0, -1)):
            disc.text(1.13 * x, 1.12 * y, with_minus(axis), ha='center', va='center', fontsize=8.5)
        disc.text(-1.22, 1.08, pole, fontsize=9.5)
        disc.set(xlim=(-1.24, 1.24), ylim=(-1.22, 1.22), aspect='equal')
        disc.axis('off')
        yield disc, name, name == 'up'


def _on_map(force: Floats, up: bool) -> tuple[NDArray[np.intp], Floats]:
    """Return the indices of the directions in a hemisphere, and their (k, 2) places on its map."""
    here = np.flatnonzero((force[:, 2] >= 0.0) == up)
    towards = unit(force[here])
    return here, unit(towards[:, :2]) * np.sqrt(1.0 - np.abs(towards[:, 2:]))


def against(residuals: Residuals, variables: Sequence[Variable], name: str, title: str,
            limit: float, *, colour: str) -> Drawing:
    """Draw residuals against variables, one panel per variable; `limit` is of the axis [mg]."""
    values, signed, count = residuals.after_mg, residuals.signed, len(variables)
    size = float(np.clip(5.5 - len(values) / 80.0, 2.5, 5.5))
    height = 1.0 + 1.45 * count + (0.8 if count == 1 else 0.0)
    with drawn(height, title, count, sharey=True) as (figure, panels):
        for k, (panel, variable) in enumerate(zip(panels, variables, strict=True)):
            panel.axhline(0.0, color=ACCENT, linewidth=1.0)
            panel.plot(variable.values, values, 'o', color=colour, markersize=size,
                       gid=f'panel{k}', **EDGE)
            panel.set_xlabel(variable.label)
            if variable.unit_range:
                panel.set(xlim=(-1.06, 1.06), xticks=(-1.0, -0.5, 0.0, 0.5, 1.0))
            panel.set_ylim(-limit if signed else -0.04 * limit, limit)
        figure.supylabel(_label(signed=signed), fontsize=10.0)
    along = ' and '.join(variable.label for variable in variables)
    return Drawing(name, f'{title}, against {along}', figure,
                   dict.fromkeys((f'panel{k}' for k in range(count)), _marks(residuals)))


def of_coverage(residuals: Residuals, share: float, next_pose: Floats | None) -> Drawing:
    """Draw the poses over the sphere, the directions that they do not cover, and the next pose."""
    title = f'{100.0 * share:.0f} % of the sphere is within 45° of a pose'
    force, marks, hover = residuals.force, _marks(residuals), dict[str, Marks]()
    open_ = uncovered(force)
    with drawn(HEIGHT_INCHES, title, columns=2, grid='') as (figure, discs):
        for disc, half, up in _hemispheres(discs):
            here, places = _on_map(force, up)
            hover[half] = tuple(marks[k] for k in here)
            disc.plot(*_on_map(open_, up)[1].T, 'x', color=ACCENT, markersize=3.5,
                      label='not covered', zorder=2)
            disc.plot(*places.T, 'o', color=AFTER, markeredgecolor=PAPER, markersize=7,
                      label='pose', zorder=3, gid=half)
            if next_pose is not None:
                disc.plot(*_on_map(next_pose[np.newaxis], up)[1].T, '*', color=ACCENT,
                          markersize=14, label='next pose', zorder=4)
        legend_below(figure, 3, *discs[0].get_legend_handles_labels())
    return Drawing('coverage', title, figure, hover)


def of_before_after(residuals: Residuals, floor_mg: float | None) -> Drawing:
    """Draw the size of the residual of each pose without and with the calibration."""
    title = _before_after_title(residuals)
    with drawn(HEIGHT_INCHES, title, grid='y') as (figure, (panel,)):
        _draw_before_after(panel, residuals, floor_mg)
        legend_below(figure, 3)
    return Drawing('before_after', title, figure, {
        'before': _marks(residuals, residuals.before_mg), 'after': _marks(residuals)})


def _before_after_title(residuals: Residuals) -> str:
    before, after = rms(residuals.before_mg), rms(residuals.after_mg)
    return f'Each pose before and after: {short(before)} and {short(after)} mg RMS'


def _draw_before_after(panel: Any, residuals: Residuals, floor_mg: float | None) -> None:
    for name, values, colour in (('before', residuals.before_mg, BEFORE),
                                 ('after', residuals.after_mg, AFTER)):
        # A logarithmic axis has no 0.
        panel.plot(residuals.poses_g.row, np.maximum(np.abs(values), 1e-3), 'o',
                   color=colour, gid=name, label=name, **EDGE,
                   markersize=float(np.clip(7.0 - len(values) / 60.0, 3.0, 7.0)))
    if floor_mg:
        panel.axhline(floor_mg, color=ACCENT, linestyle=(0, (5, 3)), label='noise floor')
    panel.set_yscale('log')
    panel.yaxis.set_major_formatter(lambda value, _: f'{value:g}')
    panel.locator_params(axis='x', integer=True)
    panel.margins(y=0.1)
    panel.set(xlabel='row of the pose', ylabel=(
        'size of |force| − 1 g [mg]' if residuals.signed else _label(signed=False)))


def plot_residuals(calibration: Calibration, axes: Any = None) -> Any:
    """Draw the poses before and after into axes of matplotlib, by default new ones of pyplot."""
    check_matplotlib()
    from matplotlib import pyplot

    residuals = residuals_of(calibration)
    panel = pyplot.subplots()[1] if axes is None else axes
    panel.grid(visible=True, axis='y')
    _draw_before_after(panel, residuals, calibration.quality.noise_floor_mg)
    panel.set_title(_before_after_title(residuals))
    panel.legend()
    return panel


def _label(*, signed: bool) -> str:
    """Return the label of the axis of residuals."""
    return '|force| − 1 g [mg]' if signed else 'size of the vector error [mg]'


def _marks(residuals: Residuals, values: Floats | None = None) -> Marks:
    """Return row, residual and temperature of each pose, such as ``row 11, +0.4 mg, 31 °C``."""
    poses = residuals.poses_g
    values = residuals.after_mg if values is None else values
    warm = poses.columns.get('temperature', np.full(len(poses), np.nan))
    return tuple(Mark(
        f'row {row}, {milli(value, signed=residuals.signed)} mg'
        + (with_minus(f', {degrees:.0f} °C') if np.isfinite(degrees) else ''), int(row))
        for row, value, degrees in zip(poses.row, values, warm, strict=True))
