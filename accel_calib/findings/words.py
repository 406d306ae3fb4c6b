# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The words of poses and plans, refinements and mountings, and of a context out of range."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
import math
from typing import Any, TYPE_CHECKING

import numpy as np

from ..calibration import (
    Calibration, Combination, ENOUGH, NextPose, Outside, PlannedPose, PosePlan)
from ..effects import (
    CHANGES, EffectKey, entry_of, shown_name, TO_SEPARATE, unit_of, value_unit, variable_words)
from ..geometry import angle_of, attitude_words, axes_of_signs, quaternion_of, rpy_of, words_of
from ..table import column_of, Floats, is_quantity
from ..text import counted, listed, with_minus, with_sd
from ..units import MG

if TYPE_CHECKING:
    from ..refinement import Refinement, Step

NOTHING_TO_PLAN = (f'there is nothing to separate: no named effect has a rival that leaves it a '
                   f'probability below {100.0 * ENOUGH:.0f} %')
"""The line of an empty plan."""


def request_words(asked: NextPose) -> str:
    """Return what to do for the next pose, or that more poses no longer help."""
    up, planned = asked.direction, asked.planned
    if up is None:
        certain = (f'{asked.error * asked.noise_g * MG:.2g} mg' if asked.noise_g is not None
                   else f'{asked.error:.2g} times the noise of a pose')
        return (f'more poses no longer help: {asked.total} poses determine |a| to within '
                f'{certain}')
    if planned is None:
        return f'turn the sensor so that {words_of(up)} points up ({axes_of_signs(up)})'
    where = ' '.join(filter(None, [attitude_words(up), condition_words(planned)]))
    return f'hold {where}, to separate {versus(planned.separates)}'


def combination_words(combination: Combination) -> str:
    """Return a combination of parameters, such as ``0.71 offset.z - 0.70 axis_gain.z``."""
    if len(combination.main) == 1:
        return next(iter(combination.main))
    first, *others = (f'{"-" if weight < 0 else "+"} {abs(weight):.2f} {name}'
                      for name, weight in combination.main.items())
    return ' '.join([first.removeprefix('+ '), *others])


def condition_words(pose: PlannedPose) -> str:
    """Return the context of a planned pose; empty if it can be taken at once."""
    context, parts = pose.context, list[str]()
    if 'temperature' in context:
        parts.append(f'at {context["temperature"]:.0f} °C')
    if 'supply_voltage' in context:
        parts.append(f'at {context["supply_voltage"]:.2f} V')
    if 'std' in context:
        parts.append(f'with {1e3 * context["std"]:.2g} mg of vibration')
    parts += [f'at {key} {value:.4g}' for key, value in context.items() if is_quantity(key)]
    if (wait := context.get('time', 0.0)) > 0.0:
        duration = (f'{wait:.0f} s' if wait < 120.0 else
                    f'{wait / 60.0:.0f} min' if wait < 7200.0 else f'{wait / 3600.0:.1f} h')
        parts.append(f'{duration} after the last pose')
    return ' '.join(parts)


def plan_lines(plan: PosePlan) -> tuple[str, ...]:
    """
    Return a plan in words.

    The poses of a rivalry have one line for each condition; conditions with the same directions
    share a line.

    """
    lines: list[str] = []
    for rivalry in plan.rivalries:
        odds = ', '.join(map(percent, rivalry.probabilities))
        what = f'to separate {versus(rivalry.names)} ({odds})'
        end = f'the expected probability of the right one is then {percent(rivalry.expected)}'
        attitudes: dict[str, list[str]] = {}
        for pose in plan.poses:
            if pose.separates == rivalry.names:
                attitudes.setdefault(condition_words(pose), []).append(
                    attitude_words(np.array(pose.up)))
        conditions: dict[str, list[str]] = {}
        for condition, words in attitudes.items():
            conditions.setdefault('; '.join(
                text if count == 1 else f'{text} ({count} poses)'
                for text, count in Counter(words).items()), []).append(condition)
        if conditions:
            lines.append(f'{what}, take these poses:')
            for hold, several in conditions.items():
                where = ' and '.join(filter(None, several))
                lines.append(f'{where + ": " if where else ""}hold {hold}')
            lines.append(end)
        elif rivalry.expected >= ENOUGH:
            lines.append(f'{what}, the same poses are enough: {end}')
        else:
            lines.append(f'{what}, poses at 1 g do not help; apply other forces (a centrifuge)')
    return tuple(lines) or (NOTHING_TO_PLAN,)


def versus(names: Sequence[EffectKey]) -> str:
    """Return a named effect and its rivals."""
    first, *others = map(shown_name, names)
    return f'{first} from {", ".join(others)}'


def percent(probability: float) -> str:
    """Return a probability as text; only certainty is 0 or 100 %."""
    if 0.0 < probability < 0.005:
        return '< 1 %'
    return '> 99 %' if 0.995 <= probability < 1.0 else f'{100.0 * probability:.0f} %'


# ----------------------------------------------------------------------------- refinements

_VERDICTS = {
    'no_gap': 'No gap beyond the noise: these poses support no further effect.',
    'explained': 'The gap is explained: only noise remains beyond the named effects.',
    'described': 'The gap is described, not explained: only noise remains beyond an empirical '
                 'curve, but its cause is not known.',
    'drifts': 'The offset drifts: only noise remains beside a slow change of the offset, which no '
              'calibration corrects.',
    'unexplained': 'A gap remains that no effect of the catalogue explains.',
}

_APART = 0.05
"""Difference of two probabilities above which both are stated."""

_LEAST_P = 1e-16


def verdict_words(result: Refinement) -> str:
    """Return the verdict as a sentence."""
    words = _VERDICTS[result.verdict]
    if result.undecided and result.refusal:
        words = ('The gap is not explained, because the refined calibration is refused: '
                 f'{result.refusal[0]}.')
    elif result.undecided:
        if result.one_curve:
            one, other = result.one_curve
            why = (f'{one} and {other} are in the same proportion on each axis, as parts of one '
                   'curve are' if other in {step.effect for step in result.steps} else
                   f'beside {one}, {other} shows in the same proportion on each axis, as parts of '
                   'one curve do')
        else:
            most = max(result.steps, key=lambda step: len(step.rivals))
            why = f'{len(most.rivals)} others explain it about as well as {most.effect}'
        words = f'Not enough poses: they cannot tell what explains the gap, because {why}.'
    elif result.verdict == 'unexplained' and result.steps:
        words = ('A gap remains beyond the named effects, and no effect of the catalogue explains '
                 'it.')
    if result.noise_floor_mg is None:
        words += (' The noise of the poses is not known (no std and count), so their scatter is '
                  'taken as the noise.')
    return words


def short_verdict(result: Refinement) -> str:
    """Return the verdict as a part of a sentence, with the effects and their rivals."""
    if result.undecided:
        return ('the refined calibration is refused' if result.refusal else
                'too few poses to tell what explains the gap')
    names = [shown_name(step.name) + (f' (or {", ".join(rival_words(step))})' if step.rivals
                                      else '') for step in result.steps]
    found, verb = ' and '.join(names), 's' if len(names) == 1 else ''
    return {'no_gap': 'no gap beyond the noise', 'explained': f'{found} explain{verb} the gap',
            'described': f'{found} describe{verb} the gap', 'drifts': 'the offset drifts',
            'unexplained': f'a gap remains beyond {found}' if names else
            'a gap remains that no effect explains'}[result.verdict]


def base_words(result: Refinement) -> str:
    """Return the name of the base."""
    name = result.calibration.name
    return 'ideal sensor' if name == 'ideal' else f'model {name}'


def chance_words(p_value: float) -> str:
    """Return the probability that noise alone explains a step."""
    return f'p < {_LEAST_P:.0e}' if p_value < _LEAST_P else f'p = {p_value:.1g}'


def value_words(step: Step) -> list[tuple[str, str]]:
    """
    Return name and text of each value of a step, ± its deviation; values in g are in mg.

    A curve that has a formula is stated by that.

    """
    if step.formula:
        return [('', step.formula)]
    parameters, values = entry_of(step.name).parameters, []
    for name, value in step.parameters.items():
        unit_name, scale = value_unit(step.name, name)
        sd = step.parameters_sd.get(name, 0.0)
        words = with_sd(value * scale, sd * scale) if sd else f'{value * scale:.5g}'
        sign = '+' if name in parameters and value >= 0.0 else ''
        values.append((name, with_minus(f'{sign}{words} {unit_name}'.rstrip())))
    return values


def odds_words(step: Step) -> dict[str, str]:
    """Return the probability of each rival, and that by the data alone if it differs much."""
    found = {}
    for rival in step.rivals:
        whole, alone = step.odds(rival)
        by_data = f', by the data alone {percent(alone)}' if abs(alone - whole) > _APART else ''
        found[rival] = f'{percent(whole)}{by_data}'
    return found


def rival_words(step: Step) -> list[str]:
    """Return the rivals with their probabilities, such as ``quadratic (11 %)``."""
    return [f'{name} ({odds})' for name, odds in odds_words(step).items()]


def place_words(step: Step) -> str:
    """Return where an effect acts; for a change of a stored calibration, also the change."""
    figures = step.place.figures
    words = _PLACES[step.place.kind](figures)
    if 'change' not in figures:
        return words
    effect = entry_of(step.name)
    scale, unit_name = (1e3, 'mg') if effect.is_offset else (100.0, '%')
    shown = ', '.join(f'{"+" if value > 0.0 else ""}{with_sd(value * scale, sd * scale)}'
                      for value, sd in figures['change'])
    since = f' since {figures["date"][:10]}' if figures['date'] else ''
    return f'the {effect.words} has changed by ({shown}) {unit_name}{since}; {words}'


def _curve_words(figures: Mapping[str, Any]) -> str:
    carrier, part, variable = (figures[key] for key in ('carrier', 'part', 'variable'))
    what = 'size of the force' if carrier == 'force' else carrier.replace('_', '-')
    words = (f'the {what}{f" of {part}" if part else ""} changes with '
             f'{variable_words(variable)} by up to {figures["most_mg"]:.2g} mg')
    if figures['between']:
        low, high = figures['between']
        words += f', most between {low:.4g} and {high:.4g} {unit_of(variable)}'.rstrip()
    nearest = [f'{effect} (leaves {left:.2g} mg)' for effect, left in figures['nearest'].items()]
    return words + (f'; the nearest known effects are {", ".join(nearest)}' if nearest else '')


_PLACES: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    'curve': _curve_words,
    'range': lambda of: (
        f'over {of["column"].replace("_", " ")} '
        + '{:.4g} to {:.4g}'.format(*of['range']) + f' {unit_of(of["column"])}'.rstrip()
        + ': {:.2g} mg RMS in the lowest fifth of the poses, {:.2g} mg in the highest'.format(
            *of['ends_mg'])),
    'instant': lambda of: (
        'between {:.6g} and {:.6g} s (rows {} and {})'.format(*of['times'], *of['rows'])),
    'directions': lambda of: 'with ' + ', '.join(
        f'{axes_of_signs(signs)} up ({mean:+.2g} mg over {count} of {of["poses"]} poses)'
        for signs, mean, count in of['directions']),
    'limit': lambda of: (f'in {listed("row", of["rows"])}: an axis reads {of["limit_g"]:.4g} g '
                         'and its samples hardly scatter'),
    'grid': lambda of: (f'pose means are multiples of {of["step_mg"]:.3g} mg, which causes '
                        f'{of["step_mg"] / np.sqrt(12.0):.2g} mg RMS per axis')}
"""Texts by kind of a place."""


def advice_lines(result: Refinement) -> tuple[str, ...]:
    """Return advice for the user, one line each; the last one is about the first planned pose."""
    lines = [_REMARKS[each.kind](each.figures) for each in result.remarks]
    if poses := result.plan.poses:
        where = ', '.join(filter(None, [attitude_words(np.array(poses[0].up)),
                                        condition_words(poses[0])]))
        lines.append(f'next pose to separate {versus(poses[0].separates)}: {where} (1 of '
                     f'{len(poses)} poses, with which the expected probability of the right one '
                     f'is {percent(poses[-1].expected)})')
    return tuple(lines)


_REMARKS: Mapping[str, Callable[[Mapping[str, Any]], str]] = {
    'other_sensor': lambda of: (
        f'this is probably another sensor: its {CHANGES[of["effect"]].base} differs from the '
        f'stored one by {of["change"]:.2g} {CHANGES[of["effect"]].unit}, which is too much for '
        'one sensor; fit a new calibration from its own poses'),
    'left_out': lambda of: f'{counted(of["poses"], "pose")} ' + (
        'was left out; take it again' if of['poses'] == 1 else 'were left out; take them again'),
    'gap': lambda of: (
        'a gap remains that no effect testable with these data explains{}: check what differs '
        'between the poses, and repeat some of them').format(
        f'; {", ".join(of["taken_back"])} would explain only a part' if of['taken_back'] else ''),
    'mount_not_seen': lambda of: (
        'a mount that has turned since the calibration cannot show: only |force| = 1 g is known; '
        'take poses of known orientation (ref_x, ref_y, ref_z) with both'),
    'rivals': lambda of: (
        f'{of["effect"]} cannot be distinguished from {", ".join(of["rivals"])} here: '
        f'{TO_SEPARATE[of["family"]]}'),
    'at_bound': lambda of: (
        f'{of["effect"]} is not used, because its constant {of["constant"]} ends at its bound '
        f'{of["value"]:.4g}: widen the bounds in its definition, or use another function'),
    'unusual': lambda of: (
        f'{of["effect"]} is {of["size"]:.2g} {of["unit"]}, typical parts have about '
        f'{of["typical"]:.2g}: check that the sensor causes it, and not the setup'),
    'one_curve': lambda of: (
        f'{" and ".join(of["effects"])} may be parts of one curve: take more poses in all '
        'directions, which show its form'),
    'few': lambda of: (
        f'{counted(of["poses"], "pose")} leave {counted(of["dof"], "degree")} of freedom, which '
        'is too few to detect most effects: take 24 poses or more'),
    'cause': lambda of: f'the gap may have this cause: {of["advice"]}',
    'scatter': lambda of: (
        f'poses repeat {of["ratio"]:.1f} times worse than their samples, and no effect describes '
        'how: clamp the sensor, let it settle longer, check the unit of std, and count, or record '
        'what else differs between the poses'),
    'record': lambda of: (
        f'record {"; ".join(of["columns"])}: their effects cannot be tested yet'),
    'not_searched': lambda of: (
        f'no effects were searched: {of["message"]}; the result is the fit with the fleet'),
    'refusal': lambda of: str(of['advice'])}
"""Texts by kind of a remark."""


# ----------------------------------------------------------------------------- mountings

_DIGITS = 9


def mounting_figures(rotation: Floats, sensor: str, base: str = '') -> dict[str, Any]:
    """
    Return a mounting as numbers and as the lines for the URDF and for TF.

    The numbers are ``roll``, ``pitch`` and ``yaw`` [rad] of the sensor in the levelled frame, and
    ``quaternion`` (x, y, z, w). The lines are for the frame_id `sensor` (if empty ``imu_link``)
    and the frame `base` (if empty ``base_link``).

    """
    roll, pitch, yaw = (round(angle, _DIGITS) + 0.0 for angle in rpy_of(rotation.T))
    quaternion = [round(part, _DIGITS) + 0.0 for part in quaternion_of(rotation.T)]
    return {'roll': roll, 'pitch': pitch, 'yaw': yaw, 'quaternion': quaternion,
            'urdf': f'<origin xyz="0 0 0" rpy="{roll} {pitch} {yaw}"/>',
            'static_transform_publisher':
                f'ros2 run tf2_ros static_transform_publisher --roll {roll} --pitch {pitch} '
                f'--yaw {yaw} --frame-id {base or "base_link"} --child-frame-id '
                f'{sensor or "imu_link"}'}


def mounting_words(rotation: Floats, sensor: str, base: str = '') -> str:
    """Return `mounting_figures` as one line."""
    found = mounting_figures(rotation, sensor, base)
    quaternion = ', '.join(f'{part:.6f}' for part in found['quaternion'])
    return (f'mounting of the sensor: {angle_words(rotation)}; quaternion ({quaternion}); URDF '
            f'{found["urdf"]}; or {found["static_transform_publisher"]}')


def angle_words(rotation: Floats) -> str:
    """Return roll, pitch and yaw of the sensor in words."""
    found = mounting_figures(rotation, '')
    return ', '.join(f'{name} {math.degrees(found[name]):.2f}°' for name in (
        'roll', 'pitch', 'yaw'))


def difference_words(before: Calibration | None, after: Calibration) -> str:
    """Return what changes with a new calibration, as one line; empty without an earlier one."""
    if before is None:
        return ''
    offset = after.units.to_g(after.offset - before.offset) * MG
    gain = 100.0 * (np.linalg.solve(before.gain, after.gain) - np.eye(3))
    angle = angle_of(before.rotation.T @ after.rotation)
    effects = set(before.model.effects) ^ set(after.model.effects)
    words = [f'offset by ({", ".join(f"{part:+.2f}" for part in offset)}) mg',
             f'gain by up to {np.max(np.abs(gain)):.3f} %', f'mounting by {angle:.2f}°']
    words += [f'{"with" if name in after.model.effects else "without"} {name}'
              for name in sorted(effects, key=str)]
    return f'changes {", ".join(words)}'


# ----------------------------------------------------------------------------- ranges

USES_LIMIT = 'the correction uses the limit of the range'

_QUANTITIES: dict[str, tuple[str, str, float]] = {
    'time': ('time since the start of the calibration', 'h', 1.0 / 3600.0),
    'temperature_rate': ('rate of temperature', '°C/min', 60.0),
    'std': ('vibration', 'mg', MG)}
"""Name, unit and factor of the quantities that are not shown as in `accel_calib.table`."""


def outside_words(found: Outside) -> str:
    """Return what was found, and the range of the calibration; times from the first pose."""
    name, unit, factor = _QUANTITIES.get(found.key) or (
        found.key.replace('_', ' '), column_of(found.key).unit, 1.0)
    start, shown = found.low if found.key == 'time' else 0.0, []
    for low, high in ((found.least, found.most), (found.low, found.high)):
        first, last = (f'{(value - start) * factor:.4g}' for value in (low, high))
        shown.append(f'{first if first == last else f"{first} to {last}"} {unit}'.rstrip())
    return f'{name} is {shown[0]}, but the range of the calibration is {shown[1]}'
