# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Effects that the poses cannot show, and the data to record for them."""

from __future__ import annotations

from collections.abc import Mapping

from .candidates import Candidate
from ..effects import EFFECTS, PROCESSES
from ..estimate.equations import kinds
from ..table import COLUMNS, Poses

_LEAST_VISIBLE = 0.1
"""Smallest visible change of the residuals by an effect of typical size, relative to the noise."""


def not_testable(poses_g: Poses, testable: Mapping[str, Candidate], present: tuple[str, ...]
                 ) -> list[tuple[str, str]]:
    """
    Return the effects that these poses cannot show, with the data to record.

    Parameters
    ----------
    poses_g : Poses
        Poses in g.
    testable : mapping of str to Candidate
        Effects that the poses distinguish from the model.
    present : tuple of str
        Effects of the model and their rivals.

    """
    missing = []
    known = kinds(poses_g)[0]
    for name, effect in {**EFFECTS, **PROCESSES}.items():
        if name in present or effect.output is not None:
            continue
        if name in testable and (effect.needs or testable[name].visible > _LEAST_VISIBLE):
            continue
        if name in ('gain', 'axis_gain') and {'gain', 'axis_gain'} & set(present):
            continue
        lacking = [', '.join(COLUMNS[key].names) for key in effect.needs if key not in poses_g]
        if lacking:
            missing.append((name, ' and '.join(lacking)))
        elif name == 'misalignment' and not len(known):
            missing.append((name, 'ref_x, ref_y, ref_z (known orientation)'))
        elif name in PROCESSES:
            continue
        elif effect.needs:
            missing.append((name, 'poses with a larger change of this quantity: '
                            f'{COLUMNS[effect.needs[0]].meaning}'))
        else:
            missing.append((name, 'more poses in more directions'))
    return missing
