# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Draw the pictures of the documentation: ``python docs/pictures.py``.

The poses are those that the calibrator asks for. The terminals are commands that this script runs
on simulated data; the times of their lines are kept. A test runs the commands again and compares
the text. The pictures of the pages need Chromium, and are left as they are without it.

"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from html import escape
from importlib.util import find_spec
import io
import os
from pathlib import Path
import re
import shlex
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory
from time import monotonic

HERE = Path(__file__).resolve().parent
sys.path[:0] = [str(HERE.parent)]

from accel_calib.api import simulate  # noqa: E402
from accel_calib.calibration import next_pose  # noqa: E402
from accel_calib.findings import request_words  # noqa: E402
from accel_calib.logs import write_table  # noqa: E402
from accel_calib.table import Floats  # noqa: E402
import numpy as np  # noqa: E402
from rich.console import Console  # noqa: E402
from rich.terminal_theme import SVG_EXPORT_THEME  # noqa: E402
from rich.text import Text  # noqa: E402

FOLDER = HERE / 'pictures'
POSES = 12

_SENSOR = ' '.join(('--effect offset=0.03,-0.02,0.04', '--effect axis_gain=0.01,-0.02,0.005',
                    '--effect cross_axis=0.004,0.002,-0.003', '--mounting 2 -4 0'))
TERMINALS: dict[str, tuple[str, ...]] = {
    'calibrate': (
        'accel-calib calibrate recording.csv -o calibration.yaml --flat 1',
    ),
    'verify': (
        'accel-calib verify other_poses.csv -c calibration.yaml',
    ),
    'export': (
        'accel-calib export calibration.yaml --to c -o calibration.h',
        'accel-calib export calibration.yaml --to px4 -o calibration.params',
    ),
    'refine': (
        'accel-calib refine many_poses.csv -o refined.yaml',
    ),
}
"""Commands of each picture of a terminal, in the order in which they run."""

_FILES = (
    f'simulate -o recording.csv --recording --poses 14 --seed 1 {_SENSOR}',
    f'simulate -o other_poses.csv --poses 10 --seed 2 {_SENSOR}',
    f'simulate -o many_poses.csv --poses 40 --seed 3 {_SENSOR} '
    '--effect quadratic=0.004,-0.003,0.0035',
)
"""Commands that write the files of the pictures."""

_COLUMNS = 80
_LONGEST_WAIT = 1.2
"""Longest time between two lines of a recording [s]."""


# The poses

_HALF = np.array([0.75, 0.55, 0.3])
"""Half the size of the drawn sensor along x, y and z."""

_FACES = (('front', 0, 1), ('back', 0, -1), ('left', 1, 1), ('right', 1, -1), ('top', 2, 1),
          ('bottom', 2, -1))
_COLOURS = {'front': '#e4572e', 'back': '#f0a58e', 'left': '#2f9e63', 'right': '#9fd3b6',
            'top': '#3b6fd4', 'bottom': '#a9c1ee'}
_VIEW_AZIMUTH, _VIEW_ELEVATION = np.radians(32.0), np.radians(24.0)
_CELL, _SCALE = (168, 176), 52.0

_STYLE = """\
<style>
text { font: 13px system-ui, sans-serif; fill: #222; text-anchor: middle; }
.face { font-size: 0.3px; fill: #fff; dominant-baseline: central; font-weight: 600; }
.number { font-weight: 700; }
.ground { fill: #000; opacity: 0.12; }
.up { stroke: #222; stroke-width: 2; fill: none; }
.paper { fill: #fff; }
</style>"""


def asked_poses(count: int = POSES) -> Iterator[tuple[Floats, str]]:
    """Yield the directions to point up, and their names, as the calibrator asks for them."""
    taken = np.empty((0, 3))
    for _ in range(count):
        asked = next_pose(taken)
        if asked.direction is None:
            return
        words = request_words(asked).removeprefix('turn the sensor so that the ')
        words = words.replace(' points up', '')
        yield asked.direction, words
        taken = np.vstack([taken, asked.direction])


def poses_svg() -> str:
    """Return the picture of the poses."""
    poses = list(asked_poses())
    width, height = 4 * _CELL[0], -(-len(poses) // 4) * _CELL[1]
    names = '; '.join(f'{k}: {words} up' for k, (_, words) in enumerate(poses, 1))
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 {width} {height}" role="img" '
             f'aria-labelledby="title"><title id="title">{len(poses)} poses of the sensor. '
             f'{escape(names)}</title>', _STYLE,
             f'<rect class="paper" width="{width}" height="{height}" rx="8"/>']
    for k, (direction, words) in enumerate(poses):
        parts.append(f'<g transform="translate({k % 4 * _CELL[0] + _CELL[0] // 2} '
                     f'{k // 4 * _CELL[1] + 72})">')
        parts.extend(_sensor(direction))
        name, _, axes = words.partition(' (')
        parts.append(f'<text y="74"><tspan class="number">{k + 1}</tspan> {name}</text>'
                     f'<text y="91">{axes.rstrip(")")} up</text></g>')
    return '\n'.join([*parts, '</svg>', ''])


def _sensor(up: Floats) -> Iterator[str]:
    """Yield the shapes of a sensor with this direction up, around (0, 0)."""
    mat_ws = _attitude(up)
    yield '<ellipse class="ground" cx="0" cy="50" rx="52" ry="11"/>'
    for name, axis, sign in _FACES:
        normal = mat_ws[:, axis] * sign
        if normal @ _viewer() > 1e-6:
            yield from _face(name, axis, sign, mat_ws)
    yield '<path class="up" d="M-68 24V-24m-5 9l5-9l5 9"/>'


def _face(name: str, axis: int, sign: int, mat_ws: Floats) -> Iterator[str]:
    """Yield a visible face with its name."""
    across, along = (axis + 1) % 3, (axis + 2) % 3
    if axis == 1 or axis == 0:
        across, along = (1 - axis, 2)
    middle = np.zeros(3)
    middle[axis] = sign * _HALF[axis]
    corners = []
    for u, v in ((-1, -1), (1, -1), (1, 1), (-1, 1)):
        corner = middle.copy()
        corner[across], corner[along] = u * _HALF[across], v * _HALF[along]
        corners.append(_seen(mat_ws @ corner))
    points = ' '.join(f'{x:.1f},{y:.1f}' for x, y in corners)
    yield (f'<polygon points="{points}" fill="{_COLOURS[name]}" stroke="#fff" '
           'stroke-width="1" stroke-linejoin="round"/>')
    right, down = np.zeros(3), np.zeros(3)
    right[across], down[along] = 1.0, -1.0
    x_axis, y_axis, at = (_seen(mat_ws @ vector) for vector in (right, down, middle))
    if x_axis[0] * y_axis[1] - x_axis[1] * y_axis[0] < 0:  # not in mirror writing
        x_axis = -x_axis
    if x_axis[0] < 0:  # not upside down
        x_axis, y_axis = -x_axis, -y_axis
    numbers = ' '.join(f'{number:.2f}' for number in (*x_axis, *y_axis, *at))
    yield f'<text class="face" transform="matrix({numbers})">{name}</text>'


def _attitude(up: Floats) -> Floats:
    """Return the (3, 3) rotation from the sensor to the room that shows most of the front."""
    first = np.cross(up, [0.0, 0.0, 1.0] if abs(up[2]) < 0.9 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    level = np.array([first, np.cross(up, first), up])
    angles = np.radians(np.arange(0.0, 360.0, 5.0))
    turned = [np.array([[np.cos(angle), -np.sin(angle), 0.0], [np.sin(angle), np.cos(angle), 0.0],
                        [0.0, 0.0, 1.0]]) @ level for angle in angles]
    return max(turned, key=lambda mat_ws: round(_shown(mat_ws), 9))


def _shown(mat_ws: Floats) -> float:
    """Return how well the viewer sees front, left and top, the positive sides."""
    return float(np.array([1.0, 0.8, 0.6]) @ (mat_ws.T @ _viewer()))


def _viewer() -> Floats:
    """Return the (3,) direction to the viewer in the room, whose z axis is up."""
    level = np.cos(_VIEW_ELEVATION)
    return np.array([level * np.cos(_VIEW_AZIMUTH), level * np.sin(_VIEW_AZIMUTH),
                     np.sin(_VIEW_ELEVATION)])


def _seen(point: Floats) -> Floats:
    """Return where a point of the room is in the picture, x right and y down."""
    viewer = _viewer()
    right = np.array([-np.sin(_VIEW_AZIMUTH), np.cos(_VIEW_AZIMUTH), 0.0])
    return _SCALE * np.array([point @ right, -point @ np.cross(viewer, right)])


# The terminals

_WINDOW = """\
<svg class="rich-terminal" viewBox="0 0 {width} {height}" xmlns="http://www.w3.org/2000/svg"
 role="img" aria-label="{label}">
<style>
.{unique_id}-matrix {{ font-family: ui-monospace, Menlo, Consolas, 'DejaVu Sans Mono', monospace;
 font-size: {char_height}px; line-height: {line_height}px; font-variant-east-asian: full-width; }}
.{unique_id}-title {{ font-size: 18px; font-weight: bold; font-family: system-ui, sans-serif; }}
{styles}
@keyframes appear {{ from {{ opacity: 0.3; }} to {{ opacity: 1; }} }}
.line {{ animation: appear 0.1s both; }}
@media (prefers-reduced-motion: reduce) {{ .line {{ animation: none; }} }}
</style>
<defs>
<clipPath id="{unique_id}-clip-terminal"><rect x="0" y="0" width="{terminal_width}"
 height="{terminal_height}"/></clipPath>
{lines}
</defs>
{chrome}
<g transform="translate({terminal_x}, {terminal_y})" clip-path="url(#{unique_id}-clip-terminal)">
{backgrounds}
<g class="{unique_id}-matrix">
{matrix}
</g>
</g>
</svg>
"""


@dataclass(frozen=True)
class Line:
    """A line of a terminal: its text with colours, and when it appears [s]."""

    text: str
    at: float


def prepare(folder: Path) -> None:
    """Write the files that the commands read."""
    for command in _FILES:
        list(_lines_of(f'accel-calib {command}', folder))


def recorded(commands: Iterable[str], folder: Path) -> list[Line]:
    """Run commands in a folder, and return what the terminal shows."""
    shown: list[Line] = []
    for command in commands:
        start = shown[-1].at + 1.0 if shown else 0.5
        shown.append(Line(f'\x1b[1m$ {command}\x1b[0m', start))
        last, now = 0.0, start + 0.7
        for line in _lines_of(command, folder):
            now += min(line.at - last, _LONGEST_WAIT)
            last = line.at
            shown.append(Line(line.text, now))
    return shown


def _lines_of(command: str, folder: Path) -> Iterator[Line]:
    """Run a command as in a terminal, and yield its lines with their times."""
    environment = os.environ | {
        'PYTHONPATH': str(HERE.parent), 'COLUMNS': str(_COLUMNS), 'FORCE_COLOR': '1',
        'TERM': 'xterm-256color', 'TTY_INTERACTIVE': '0', 'PYTHONIOENCODING': 'utf-8',
        'PYTHONUNBUFFERED': '1'}
    words = shlex.split(command)
    start = monotonic()
    with subprocess.Popen(
            [sys.executable, '-m', 'accel_calib.cli.main', *words[1:]], cwd=folder,
            env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            encoding='utf-8') as process:
        assert process.stdout is not None
        for line in process.stdout:
            yield Line(line.rstrip('\n'), monotonic() - start)
    if process.returncode:
        raise SystemExit(f'{command}: exit status {process.returncode}')


def terminal_svg(name: str, lines: Sequence[Line]) -> str:
    """Return the picture of a terminal whose lines appear one after the other."""
    console = Console(record=True, width=_COLUMNS, file=io.StringIO(), force_terminal=True,
                      color_system='truecolor', legacy_windows=False)
    times = []
    for line in lines:
        rows = Text.from_ansi(line.text).wrap(console, _COLUMNS)
        for row in rows or [Text()]:
            console.print(row, soft_wrap=True, highlight=False)
            times.append(line.at)
    commands = ', '.join(TERMINALS[name])
    made = console.export_svg(title=name, theme=SVG_EXPORT_THEME, unique_id=name,
                              code_format=_WINDOW.replace('{label}', f'A terminal: {commands}'))
    return '\n'.join(row.rstrip() for row in _timed(made, name, times).splitlines()) + '\n'


def _timed(svg: str, name: str, times: Sequence[float]) -> str:
    """Return a picture whose lines appear at these times."""
    def delayed(found: re.Match[str]) -> str:
        at = times[min(int(found.group(2)), len(times) - 1)]
        return f'<text class="line {found.group(1)}" style="animation-delay:{at:.2f}s"'

    return re.sub(rf'<text class="([\w-]+)"(?=[^>]*clip-path="url\(#{name}-line-(\d+)\)")',
                  delayed, svg)


def shown_text(svg: str) -> str:
    """Return the text in the picture of a terminal, without spaces and the title."""
    rows = re.findall(r'<text class="line [^>]*>([^<]*)</text>', svg)
    return re.sub(r'(\s|&#160;)+', '', ''.join(rows))


# The page

def screenshot(page: Path, picture: Path) -> None:
    """Take a picture of the top of a page, if there is a Chromium."""
    browser = shutil.which('chromium') or shutil.which('google-chrome')
    if browser is None:
        sys.stdout.write(f'no Chromium: {picture.name} stays as it is\n')
        return
    subprocess.run([browser, '--headless', '--no-sandbox', '--hide-scrollbars',
                    '--window-size=1280,1000', f'--screenshot={picture}', page.as_uri()],
                   check=True, capture_output=True, timeout=120)


# The page of a fleet

_ROBOTS, _MONTHS = 40, 8


def fleet_picture(folder: Path) -> None:
    """Calibrate a simulated fleet with an odd sensor, and take a picture of its page."""
    rng = np.random.default_rng(1)
    for robot in range(_ROBOTS):
        offset = rng.normal((0.01, -0.015, 0.03), 0.02)
        gain = rng.normal((0.01, 0.012, -0.02), 0.008)
        offset[2] += 0.25 * (robot == 17)
        for month in range(1, _MONTHS + 1):
            later = np.array([0.002 * month, 0.012 * (robot == 3 and month > 4), 0.0])
            poses = simulate({'offset': offset + later, 'axis_gain': gain}, poses=14,
                             units='g', seed=100 * robot + month)
            path = folder / 'fleet' / f'robot_{robot}' / f'2026-{month:02d}-03.csv'
            path.parent.mkdir(parents=True, exist_ok=True)
            write_table(path, poses)
    command = 'accel-calib fleet fleet -o results --no-refine --units g'
    for _ in _lines_of(command, folder):
        pass
    screenshot(folder / 'results' / 'fleet.html', FOLDER / 'fleet.png')


# The live page

def live_pictures(folder: Path) -> None:
    """Take pictures of the live page, on a phone in a turn and on a desk after a fit."""
    from playwright.sync_api import expect
    sys.path[:0] = [str(HERE.parent / 'test')]
    import live_bench as bench

    with bench.chromium() as browser, bench.live_page(folder, speed=2.0) as live:
        viewers = bench.Viewers(browser)
        phone = viewers.visit(live.link, (360, 740))
        live.follow(phone, 5)
        live.turn_half(phone)
        phone.screenshot(path=FOLDER / 'live_phone.png')
        desk = viewers.visit(live.link, (1280, 860), color_scheme='dark')
        live.follow(desk)
        desk.locator('[data-command=fit]').click()
        expect(desk.locator('#verdict strong')).not_to_be_empty(timeout=bench.PATIENCE)
        desk.evaluate('scrollTo(0, 0)')
        desk.wait_for_timeout(5000.0)  # some corrected readings
        desk.screenshot(path=FOLDER / 'live_desk.png')


def main() -> None:
    """Draw all pictures."""
    FOLDER.mkdir(exist_ok=True)
    (FOLDER / 'poses.svg').write_text(poses_svg(), encoding='utf-8')
    with TemporaryDirectory() as name:
        folder = Path(name)
        prepare(folder)
        for terminal, commands in TERMINALS.items():
            svg = terminal_svg(terminal, recorded(commands, folder))
            (FOLDER / f'{terminal}.svg').write_text(svg, encoding='utf-8')
        page = folder / 'calibration.html'
        if page.exists():
            screenshot(page, FOLDER / 'page.png')
        if find_spec('distributed') is not None:
            fleet_picture(folder)
        if shutil.which('chromium'):
            live_pictures(folder)


if __name__ == '__main__':
    main()
