# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Golden screens of ``accel-calib watch``."""

from dataclasses import replace
import io
import math
from typing import Any

from accel_calib.geometry import unit
from accel_calib.session import Progress
from inside import changes, plain_handler, screen, state, words_of
import numpy as np
from rich.console import Console

NODE = '/left/calibrator'
START = Progress(
    still=True, stillness=0.5, dwell=0.6, min_dwell=1.0, poses=0, total=12, coverage=0.0,
    accuracy=math.inf, step='poses', advice='turn the sensor so that the top side points up',
    command='', direction=(0.0, 0.0, 1.0))
MIDDLE = replace(START, poses=7, coverage=0.35, direction=(0.58, 0.58, -0.58),
                 advice='turn the sensor so that the front left bottom corner points up')
ENOUGH = replace(START, poses=20, coverage=1.0, accuracy=0.0003, step='fit', command='fit',
                 advice='more poses no longer help: call ~/fit', direction=())
FITTED = replace(MIDDLE, step='done', advice='use the calibration', command='', direction=())
SEEN = replace(MIDDLE, up=(0.6, 0.0, 0.8), length=1.0213, corrected=1.0002, temperature=-3.5)


def _drawn(progress: Progress, width: int, height: int, encoding: str) -> list[str]:
    """Return the lines that a terminal of this size shows, without colours."""
    raw = io.BytesIO()
    file = io.TextIOWrapper(raw, encoding, plain_handler())
    console = Console(file=file, width=width, height=height, highlight=False)
    console.print(screen(NODE, progress))
    file.flush()
    return raw.getvalue().decode(encoding).splitlines()


def _towards(*signs: float) -> Progress:
    direction = np.array(signs)
    return replace(START, direction=tuple(unit(direction[np.newaxis])[0].tolist()),
                   advice=f'turn the sensor so that {words_of(direction)} points up')


def screens() -> Any:
    """Return the screens for all steps, sizes and encodings, and the lines of a log."""
    shown = {'start': START, 'middle': MIDDLE, 'enough': ENOUGH, 'seen': SEEN, 'moving': replace(
        MIDDLE, still=False, stillness=1.5), 'edge': _towards(1.0, -1.0, 0.0),
        'corner': _towards(-1.0, 1.0, -1.0), **{step: replace(FITTED, step=step) for step in (
            'refine', 'level', 'accept', 'done')}}
    return [{name: [_drawn(each, *size) for size in (
        (80, 24, 'utf-8'), (40, 24, 'utf-8'), (80, 14, 'utf-8'), (80, 24, 'ascii'))]
        for name, each in shown.items()},
        [list(changes(NODE, MIDDLE, each)) for each in shown.values()],
        [list(state(NODE, each)) for each in shown.values()]]
