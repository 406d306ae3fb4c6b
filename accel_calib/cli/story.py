# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What a refinement is in JSON, in a table and in a line."""

from __future__ import annotations

from dataclasses import asdict
from typing import Any, TYPE_CHECKING

from ..report.words import base_words, chance, effect_words, short

if TYPE_CHECKING:
    from rich.table import Table

    from ..refine import Refinement


def refine_result(result: Refinement) -> dict[str, Any]:
    """Give the result in the names of the documentation."""
    return {
        'verdict': result.verdict, 'base': result.calibration.name,
        'poses_used': len(result.poses_g), 'noise_floor_mg': result.noise_floor_mg,
        'gap_mg': result.gap_mg,
        'steps': [{**asdict(step), 'words': effect_words(step.effect)} for step in result.steps],
        'remaining_gap_mg': result.remaining_gap_mg,
        'disturbed_poses': result.disturbed_poses,
        'not_testable': [{'effect': effect, 'needs': needs}
                         for effect, needs in result.not_testable],
        'advice': result.advice}


def in_a_line(result: dict[str, Any]) -> str:
    """Give a result of several in a line."""
    if 'error' in result:
        return f'{result["error"]}; {result["advice"]}'
    names = ' + '.join([result['base'], *(step['effect'] for step in result['steps'])])
    return (f'{result["verdict"]}: {names}, {short(result["gap_mg"])} -> '
            f'{short(result["remaining_gap_mg"])} mg')


def steps_table(result: Refinement) -> Table:
    """Give the steps as a table for a person."""
    from rich.table import Table

    table = Table(title=f'From {base_words(result)}: gaps in mg, of poses held out in brackets',
                  show_lines=True)
    table.add_column('', justify='right')
    table.add_column('effect, and where it was seen', min_width=24, overflow='fold')
    for name in ('gap', 'how sure'):
        table.add_column(name, no_wrap=True)
    table.add_column('rivals', overflow='fold')
    for number, step in enumerate(result.steps, 1):
        gap = (f'{short(step.gap_before_mg)} -> {short(step.gap_after_mg)}\n'
               f'({short(step.held_out_before_mg)} -> {short(step.held_out_after_mg)})')
        effect = f'{step.effect}\n{effect_words(step.effect)}\n{step.where}'
        table.add_row(str(number), effect, gap, chance(step.p_value),
                      '\n'.join(step.rivals) or 'none')
    return table
