# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Inputs of fuzz.py: small sound files of every kind, and random tables, trees and messages."""

from collections.abc import Callable, Mapping, Sequence
import copy
from dataclasses import dataclass
import datetime
from functools import cache
import json
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import accel_calib as ac
from accel_calib.errors import AccelCalibError
from accel_calib.logs import write_table
from accel_calib.stored import write_calibration
import bag_files as bags
from inside import read_log
import numpy as np
from shared import LOG_CORPUS, LOGS, table
import yaml

STORED = Path(__file__).parents[1] / 'data'
BAGS = {'mcap': ('mcap', 'mcap without chunks', 'mcap without summary', 'mcap folder'),
        'sqlite3': ('sqlite3',),
        'compressed': ('mcap lz4', 'mcap zstd', 'sqlite3 messages', 'mcap file'),
        'ros1': ('ros1', 'ros1 bz2', 'ros1 lz4')}
"""Kinds of bags, and their names in bag_files.py."""

EXTREME = (b'1e300', b'-1e308', b'1e29', b'-2e-29', b'nan', b'inf', b'9' * 400, b'0x_', b'', b'"',
           b"'", b'\x00', b'\x1b[31m', b',', b';', b'\n', b'&a', b'*a', b'1:30', b'2026-01-01',
           b'\xff\xfe', b'[', b'- ', b'{', b'!!x', b'---')

VALUES = (None, 1, -1, 0, 10**400, -10**30, 1.5, float('nan'), float('inf'), 1e300, 1e-300, 1e29,
          True, '', 'x', 3000 * 'x', [], {}, [[]], [1], {'a': 1}, datetime.date(2001, 1, 1), b'ab',
          'm/s2', 'g', 'native', '12', 'ideal', 'algebraic')

Rng = np.random.Generator
T = TypeVar('T')


@dataclass(frozen=True)
class Files:
    """Files by their path below a folder, and the name of the file or folder to read."""

    name: str
    content: Mapping[str, bytes]

    def write(self, folder: Path) -> Path:
        """Write the files, and return the path to read."""
        for name, data in self.content.items():
            path = folder / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(data)
        return folder / self.name


def files_at(path: Path) -> Files:
    """Return the content of a file, or of the files in a folder."""
    found = sorted(path.iterdir()) if path.is_dir() else [path]
    return Files(path.name, {str(each.relative_to(path.parent)): each.read_bytes()
                             for each in found})


# --------------------------------------------------------------------------------- sound files

def sound(kind: str) -> list[Files]:
    """Return small sound files of a kind."""
    with TemporaryDirectory() as name:
        folder = Path(name)
        if kind in BAGS:
            return [_bag(make, folder) for make in BAGS[kind]]
        if kind == 'yaml':
            return _calibrations(folder)
        if kind == 'poses':
            return _tables(folder)
        if kind == 'container':  # packed text, arrays, archives and sheets
            return [*map(files_at, sorted((LOG_CORPUS / 'containers').iterdir())), *(
                files_at(path) for path in sorted((LOG_CORPUS / 'formats').iterdir())
                if path.suffix not in ('.json', '.jsonl', '.log', '.lp', '.txt', '.csv')),
                files_at(LOGS / 'phyphox' / 'export.xls')]
        suffixes = {'csv': ('.csv', '.log', '.txt'), 'ulg': ('.ulg',), 'bin': ('.bin',)}[kind]
        paths = sorted(path for path in LOGS.rglob('*') if path.suffix in suffixes)
        return [_beginning(path, folder) if kind == 'csv' else files_at(path) for path in paths]


def _bag(make: str, folder: Path) -> Files:
    (folder / make).mkdir()
    return files_at(bags.MAKES[make](folder / make))


def _calibrations(folder: Path) -> list[Files]:
    poses = ac.simulate({'offset': [0.02, -0.01, 0.03]}, poses=20, seed=1)
    write_calibration(folder / 'c.yaml', ac.fit(poses))
    return [files_at(path) for path in (folder / 'c.yaml', *sorted(STORED.glob('*.yaml')))]


def _tables(folder: Path) -> list[Files]:
    made = {'warm': ac.simulate({}, poses=20, temperature=(20, 30), seed=1),
            'known': ac.simulate({'offset': 0.02}, poses=16, reference=True, seed=2),
            'counts': ac.simulate({'axis_gain': 0.02}, poses=18, units='native', seed=3)}
    for name, poses in made.items():
        write_table(folder / f'{name}.csv', poses)
    return [files_at(folder / f'{name}.csv') for name in made]


def _beginning(path: Path, folder: Path) -> Files:
    """Return the first lines of a log, as few as make a log that ends like the whole."""
    lines, whole, count = path.read_bytes().splitlines(keepends=True), _ends_in(path), 64
    cut = folder / path.name
    while count < len(lines):
        cut.write_bytes(b''.join(lines[:count]))
        if _ends_in(cut) == whole:
            return files_at(cut)
        count *= 2
    return files_at(path)


def _ends_in(path: Path) -> str:
    """Return the columns of a log, or the start of the error."""
    try:
        return ' '.join(read_log(path).table.columns)
    except AccelCalibError:
        return 'refused'


# ------------------------------------------------------------------------------ random inputs

_OF_TABLES = table('random_tables')
"""Names of columns, and comments."""

_SCALES = (1.0, 9.80665, 1000.0, 16384.0, 1e-5, 1e150)
_CODES = ('utf-8', 'utf-8-sig', 'utf-16', 'utf-16-le', 'cp1252')


def random_table(rng: Rng) -> Files:
    """Return a table of a random dialect, with random columns, and with some random cells."""
    delimiter = one(rng, (',', ',', ';', '\t', ' ', '|', ', '))
    header = _header(rng)
    rows = [_row(rng, header, k) for k in range(int(one(rng, (0, 1, 3, 12, 24, 60))))]
    wild = float(one(rng, (0.0, 0.0, 0.003, 0.1)))
    cells = [[_wild(rng) if rng.random() < wild else cell for cell in row] for row in rows]
    if rng.random() < 0.1 and cells:
        one(rng, cells).append('1')
    if rng.random() < 0.9:
        cells.insert(0, list(header))
    if rng.random() < 0.15:
        cells = [[f'"{cell}"' for cell in row] for row in cells]
    if rng.random() < 0.15:
        cells = [[cell.replace('.', ',') for cell in row] for row in cells]
    lines = [delimiter.join(row) for row in cells]
    for _ in range(int(one(rng, (0, 0, 0, 1, 3)))):
        lines.insert(int(rng.integers(len(lines) + 1)) if rng.random() < 0.3 else 0,
                     one(rng, _OF_TABLES['comments']))
    end = one(rng, ('\n', '\n', '\r\n', '\r'))
    text = end.join(lines) + (end if rng.random() < 0.8 else '')
    data = text.encode(one(rng, _CODES) if rng.random() < 0.2 else 'utf-8', errors='replace')
    return Files('table.csv', {'table.csv': data})


def _header(rng: Rng) -> list[str]:
    """Return random names of columns, those of an accelerometer among them."""
    header = list(one(rng, _OF_TABLES['accelerometers']))
    if rng.random() < 0.6:
        header.append(one(rng, _OF_TABLES['times']))
    count = int(one(rng, (0, 0, 1, 3, 8)))
    header += [str(each) for each in rng.choice(_OF_TABLES['others'], count)]
    if rng.random() < 0.5:
        rng.shuffle(header)
    return header


def _row(rng: Rng, header: list[str], k: int) -> list[str]:
    """Return the cells of a pose or a sample."""
    force = rng.normal(size=3)
    force *= _SCALES[len(header) % len(_SCALES)] / np.linalg.norm(force)
    number, cells = iter(force.tolist()), []
    for name in header:
        if name in _OF_TABLES['times']:
            cells.append(f'2026-01-01T00:00:{k % 60:02}.5' if name == 'date' else f'{0.25 * k}')
        elif name in ('count', 'orientation'):
            cells.append(str(1 + k))
        else:
            cells.append(f'{next(number, 20.0 + 0.01 * k):.8g}')
    return cells


def _wild(rng: Rng) -> str:
    """Return the text of a random cell."""
    kind = rng.integers(4)
    if kind == 0:
        return one(rng, EXTREME).decode('latin-1')
    if kind == 1:
        return f'{rng.normal() * 10.0 ** float(rng.integers(-320, 308)):.17g}'
    if kind == 2:
        return str(int(rng.integers(-10**6, 10**6)))
    return rng.bytes(int(rng.integers(1, 6))).decode('latin-1')


_HOSTILE = ('a', 'ß', '\n', '\r\n1\t', '\u2028', '\x85', '\x1b[31m', '\x00', '\ud800', '*/', '/*',
            '??/', '\\', '"', '#', '\u202e', '<script>', '{{ x }}', '%s', '\n1: ', 900 * 'x')


def hostile(rng: Rng) -> str:
    """Return text that would end a comment, a line or a file, if it were written as it is."""
    return ''.join(one(rng, _HOSTILE) for _ in range(int(rng.integers(1, 8))))


def hostile_json(rng: Rng, content: Any) -> str:
    """Return JSON in which values are hostile, or which has many levels."""
    if rng.random() < 0.1:
        return '[' * int(rng.integers(1, 10**6))
    if isinstance(content, dict):
        for key in content:
            if rng.random() < 0.1:
                content[key] = one(rng, (*VALUES, hostile(rng), 10 ** int(rng.integers(400))))
    return json.dumps(content, default=str, ensure_ascii=bool(rng.integers(2)))


def hostile_table(rng: Rng) -> Files:
    """Return a sound pose table with hostile comments, labels and names of columns."""
    place = {'firmware': one(rng, ('px4', 'ardupilot')), 'instance': 1, 'corrected': hostile(rng),
             'device_id': one(rng, (7, 2**32, 10**400))}
    sensor = hostile_json(rng, one(rng, (hostile(rng), hostile(rng), 5000 * 'x')))
    name = json.dumps(hostile(rng).replace('"', ''), ensure_ascii=False)
    poses = ac.simulate({'offset': 0.02}, poses=12, seed=1).reading.tolist()
    rows = [f'{x},{y},{z},"{hostile(rng) if k == 3 else k}",{k}'
            for k, (x, y, z) in enumerate(poses)]
    text = '\n'.join((f'# sensor: {sensor}', f'# autopilot: {hostile_json(rng, place)}',
                      f'ax,ay,az,label,{name}', *rows, ''))
    return Files('poses.csv', {'poses.csv': text.encode(errors='replace')})


def hostile_noise(rng: Rng) -> Files:
    """Return figures of the noise, some of which are no figures of a sensor."""
    figures = {f'{sensor}_{figure}': 1e-3 for sensor in ('accelerometer', 'gyroscope')
               for figure in ('noise_density', 'random_walk')}
    text = hostile_json(rng, {
        **figures, 'update_rate': 200.0, 'gyroscope_random_walk_axes_upper': [1e-3],
        'gyroscope_random_walk_reason': hostile(rng)})
    return Files('noise.json', {'noise.json': text.encode(errors='replace')})


@cache
def intact() -> tuple[str, ...]:
    """Return texts of stored calibrations."""
    return tuple(path.read_text() for path in sorted(STORED.glob('calibration_*.yaml')))


def random_trees() -> Callable[[Rng], Files]:
    """Return the maker of calibrations with values of wrong types, missing and added keys."""
    contents = [yaml.safe_load(each) for each in sorted(intact(), key=len)[:-1]]

    def make(rng: Rng) -> Files:
        content = copy.deepcopy(one(rng, contents))
        for _ in range(int(rng.integers(1, 4))):
            _change(rng, content)
        text = yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True)
        return Files('c.yaml', {'c.yaml': text.encode()})
    return make


class _Dumper(yaml.CSafeDumper):
    def ignore_aliases(self, data: object) -> bool:
        """Write repeated values in full."""
        return True


def _change(rng: Rng, content: Any) -> None:
    """Replace, remove, repeat or rename a random value of nested lists and mappings."""
    node, key = content, one(rng, list(content))
    while isinstance(node[key], (dict, list)) and node[key] and rng.random() < 0.75:
        node = node[key]
        key = one(rng, list(node) if isinstance(node, dict) else range(len(node)))
    kind, value = rng.integers(5), node[key]
    if kind == 0:
        del node[key]
    elif kind == 1 and isinstance(value, float):
        node[key] = value * 10.0 ** float(rng.integers(-200, 200))
    elif kind == 2 and isinstance(value, list):
        value.extend(copy.deepcopy(value[:int(rng.integers(1, 4))]))
    elif kind == 3 and isinstance(node, dict):
        node[str(one(rng, list(content)))] = node.pop(key)
    else:
        node[key] = copy.deepcopy(one(rng, VALUES))


def random_messages() -> Callable[[Rng], Files]:
    """Return the maker of sound bags with damaged messages, times and names of topics."""
    made = bags.raw_messages()
    words = ('/imu', '', '/imu\x1b[31m', 'imu', '/' + 300 * 'a', '/temperature', '/ä')

    def make(rng: Rng) -> Files:
        content = list(made)
        for _ in range(int(rng.integers(1, 5))):
            k = int(rng.integers(len(content)))
            topic, stamp, data = content[k]
            if rng.random() < 0.2:
                stamp = int(rng.integers(1 << 63))
            content[k] = (topic, stamp, _changed(rng, bytearray(data)))
        topics = [(one(rng, words) if rng.random() < 0.05 else name, kind)
                  for name, kind in bags.TOPICS]
        with TemporaryDirectory() as name:
            path = bags.McapFile(topics).write(Path(name) / 'bag.mcap', content)
            return files_at(path)
    return make


def _changed(rng: Rng, data: bytearray) -> bytes:
    """Return a message with another number, other bytes, or another length."""
    kind, at = rng.integers(4), int(rng.integers(len(data) + 1))
    if kind == 0:
        at = max(at - at % 8 - 4, 0)
        number = one(rng, (np.nan, np.inf, 1e300, -1e-300, 0.0, float(rng.normal())))
        data[at:at + 8] = np.float64(number).tobytes()
    elif kind == 1:
        data[at:at + 1] = rng.bytes(1)
    elif kind == 2:
        del data[at:]
    else:
        data[at:at] = rng.bytes(int(rng.integers(1, 20)))
    return bytes(data)


def one(rng: Rng, values: Sequence[T]) -> T:
    """Return one of some values."""
    return values[int(rng.integers(len(values)))]
