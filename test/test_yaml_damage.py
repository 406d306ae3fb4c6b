# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Damaged and hostile calibration files end in a calibration or in one line.

``python test/test_yaml_damage.py CASES [SEED]`` tries more damage and prints the outcomes.

"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
import copy
from dataclasses import replace
import datetime
from functools import cache
import os
from pathlib import Path
import subprocess
import sys
import tempfile
import time
from typing import Any
import warnings

from accel_calib.calibrate import Calibration, EDITED, Rejected
from accel_calib.errors import DamagedCalibrationError, InputError, StoredCalibrationError
from accel_calib.files import calibration_yaml, plain_yaml, read_calibration, write_calibration
from accel_calib.files.calibration_yaml import format_calibration, parse_calibration
from accel_calib.files.plain_yaml import MOST_BYTES, read_plain
import numpy as np
import pytest
import yaml

STORED = Path(__file__).parent / 'data'
CASES = 500
LONGEST_LINE = 700
FIRST = 'format: accel_calib calibration\n'
WORDS = ('1' + 400 * '0', '0x_', '2001-99-99', '2001-01-01', '.nan', '-.inf', '1e400', '-1e308',
         '1e300', '1e29', '1e-320', '0', '-1', 'null', 'true', '[]', '{}', '[[]]', '""', '1_0',
         '0b1', '010', '1:30', '<<', '!!python/object/apply:os.system [x]', '&a 1', '*a',
         '[1, [2, [3]]]', '{a: {b: 1}}', '', '"\\x1b[31m"', '|\n  text', '"\\0"', '[[[[[[[[[[[[',
         '- 1', '? a', f'"{5000 * "y"}"')
VALUES = (None, 1, -1, 0, 10**400, -10**30, 1.5, float('nan'), float('inf'), 1e300, 1e-300, 1e29,
          True, '', 'x', 3000 * 'x', [], {}, [[]], [1], {'a': 1}, datetime.date(2001, 1, 1), b'ab',
          'm/s2', 'g', 'native', '12', 'ideal', 'algebraic')
SYNTAX = b'[]{}:,-?&*!|>\'"%@`# \n\t0e.'


@cache
def intact() -> tuple[str, ...]:
    """Return texts of stored calibrations, of both versions."""
    old = [path.read_text() for path in sorted(STORED.glob('calibration_1*.yaml'))]
    return (*old, *(format_calibration(parse_calibration(text, 'x.yaml')) for text in old))


def damaged(rng: np.random.Generator) -> bytes:
    """Return a stored calibration with damaged bytes, with a damaged line, or a damaged value."""
    text = intact()[rng.integers(len(intact()))]
    kind = rng.integers(4)
    if kind < 2:
        return _bytes(rng, bytearray(text.encode()), int(rng.integers(1, 4)))
    return (_line(rng, text.split('\n')) if kind == 2 else _tree(rng, text)).encode()


def _bytes(rng: np.random.Generator, data: bytearray, count: int) -> bytes:
    for _ in range(count):
        place, kind = int(rng.integers(len(data))), rng.integers(4)
        if kind == 0:
            data[place] ^= 1 << int(rng.integers(8))
        elif kind == 1:
            data[place] = int(rng.integers(256))
        elif kind == 2:
            del data[place:place + int(rng.integers(1, 40))]
        else:
            data[place:place] = bytes(rng.choice(list(SYNTAX), int(rng.integers(1, 4))).tolist())
    return bytes(data)


def _line(rng: np.random.Generator, lines: list[str]) -> str:
    one, other = (int(each) for each in rng.integers(len(lines), size=2))
    kind = rng.integers(5)
    if kind == 0:
        del lines[one]
    elif kind == 1:
        lines.insert(one, lines[other])
    elif kind == 2:
        lines[one] = lines[one][:int(rng.integers(len(lines[one]) + 1))]
    elif kind == 3:
        lines[one], lines[other] = lines[other], lines[one]
    else:
        lines[one] = f'{lines[one].split(":")[0]}: {WORDS[rng.integers(len(WORDS))]}'
    return '\n'.join(lines)


def _paths(node: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Yield the paths of all values below a node."""
    for key in node if isinstance(node, dict) else (
            range(len(node)) if isinstance(node, list) else ()):
        yield (*path, key)
        yield from _paths(node[key], (*path, key))


class _Dumper(yaml.SafeDumper):
    def ignore_aliases(self, data: Any) -> bool:
        return True


def _tree(rng: np.random.Generator, text: str) -> str:
    content = yaml.safe_load(text)
    most = rng.integers(1, 5)
    paths = [path for path in _paths(content) if len(path) <= most]
    path, other = (paths[k] for k in rng.integers(len(paths), size=2))
    node = _at(content, path[:-1])
    kind, value = rng.integers(5), node[path[-1]]
    if kind == 0:
        node[path[-1]] = VALUES[rng.integers(len(VALUES))]
    elif kind == 1:
        del node[path[-1]]
    elif kind == 2:
        node[path[-1]] = copy.deepcopy(_at(content, other))
    elif isinstance(value, float):
        node[path[-1]] = value * 10.0 ** float(rng.integers(-200, 200))
    elif isinstance(value, list):
        value.append(copy.deepcopy(value[0]) if value else 1)
    elif isinstance(node, dict):
        node[f'{path[-1]}x'] = node.pop(path[-1])
    return yaml.dump(content, Dumper=_Dumper, sort_keys=False, allow_unicode=True)


def _at(content: Any, path: tuple[Any, ...]) -> Any:
    for key in path:
        content = content[key]
    return content


def outcome(path: Path) -> str:
    """Read a file, use it, and return whether it was changed, or refused in one line."""
    try:
        found = read_calibration(path)
    except StoredCalibrationError as error:
        line = str(error)
        assert line.isprintable(), line
        assert len(line) <= LONGEST_LINE, line
        return 'one line'
    context = {key: np.ones((1, 3) if key in ('std', 'rate', 'previous') else 1)
               for key in found.model.needs}
    force = found.correct(np.array([[0.3, -0.4, 0.8]]) * found.units.per_g, context)
    assert np.all(np.isfinite([*force, found.offset, found.offset_sd]))
    assert np.all(np.isfinite([found.gain, found.gain_sd]))
    again = parse_calibration(format_calibration(found), 'again.yaml')
    np.testing.assert_array_equal(again.model.vector, found.model.vector)
    return 'edited' if EDITED in found.warnings else 'clean'


def trials(cases: int, seed: int) -> Counter[str]:
    """Return the number of each outcome of damaged files; raise what `outcome` raises."""
    found: Counter[str] = Counter()
    with tempfile.TemporaryDirectory() as folder, warnings.catch_warnings():
        warnings.simplefilter('error')
        path = Path(folder) / 'calibration.yaml'
        for case in range(cases):
            data = damaged(np.random.default_rng([seed, case]))
            path.write_bytes(data)
            try:
                found[outcome(path)] += 1
            except Exception as error:
                raise AssertionError(f'case {case} of seed {seed}: {error!r}') from error
    return found


def test_damage_ends_in_a_calibration_or_in_one_line() -> None:
    found = trials(CASES, 1)
    assert found.total() == CASES
    assert min(found['one line'], found['edited'], found['clean']) > 10, found


def test_intact_files_have_no_warning_about_damage() -> None:
    for text in intact():
        assert EDITED not in parse_calibration(text, 'x.yaml').warnings


# Bombs


def nested(opening: str) -> str:
    return f'{FIRST}x: {opening * 100_000}\n'


BOMBS: dict[str, tuple[str, str]] = {
    'lists': (nested('['), 'more than 8 levels'),
    'mappings': (nested('{a: '), 'more than 8 levels'),
    'compact lists': (f'{FIRST}x:\n{"- " * 100_000}1\n', 'more than 8 levels'),
    'compact keys': (f'{FIRST}{"? " * 100_000}1\n', 'a key is a mapping or a list'),
    'indented': (FIRST + ''.join(f'{" " * k}a:\n' for k in range(3000)), 'more than 8 levels'),
    'aliases': (FIRST + ''.join(f'x{k}: &x{k} [{", ".join(9 * [f"*x{k - 1}" if k else "1"])}]\n'
                                for k in range(12)), "the anchor 'x0'"),
    'alias of itself': (f'{FIRST}x: &x [*x]\n', "the anchor 'x'"),
    'alias alone': (f'{FIRST}x: *y\n', "the alias 'y'"),
    'merged keys': (f'{FIRST}a: {{<<: *y}}\n', "the alias 'y'"),
    'code': (f'{FIRST}x: !!python/object/apply:os.system [exit]\n', 'the tag .*os.system'),
    'second file': (f'{FIRST}---\nx: 1\n', 'a second document starts'),
    'twice': (f'{FIRST}date: 1\ndate: 2\n', "line 3, the key 'date' is stated twice"),
    'date': (f'{FIRST}date: 2001-99-99\n', "at date, line 2, the value is '2001-99-99'"),
    'no digits': (f'{FIRST}x:\n  y: 0x_\n', "at x.y, line 3, the value is '0x_'"),
    'octal': (f'{FIRST}x: 010\n', "the value is '010', expected a decimal number"),
    'minutes': (f'{FIRST}x: 1:30\n', "the value is '1:30', expected a decimal number"),
    'huge': (f'{FIRST}version: 1{400 * "0"}\n', "its version is '1000"),
    'large': (f'{FIRST}version: {30 * "9"}\n', "the value is '9999"),
    'escape': (f'{FIRST}version: "\\e[31m"\n', r"version is '\\x1b\[31m'"),
    'zero byte': (f'{FIRST}x: \0\n', 'control characters'),
}


@pytest.mark.parametrize('name', BOMBS)
def test_a_bomb_is_refused_at_once_in_one_line(name: str) -> None:
    text, words = BOMBS[name]
    began = time.process_time()
    with pytest.raises(DamagedCalibrationError, match=words) as refusal:
        parse_calibration(text, 'x.yaml')
    assert time.process_time() - began < 1.0
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) <= LONGEST_LINE


def test_the_number_of_values_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plain_yaml, 'MOST_VALUES', 1000)
    assert len(read_plain(f'[{"a," * 999}]')) == 999
    for text in (f'[{"a," * 1000}]', f'[{"[]," * 1000}]',
                 '{' + ''.join(f'{k}: 1,' for k in range(501)) + '}'):
        with pytest.raises(ValueError, match='more than 1000 values'):
            read_plain(text)


def test_the_size_of_a_file_is_bounded_before_it_is_parsed(tmp_path: Path) -> None:
    path = tmp_path / 'calibration.yaml'
    path.write_text(FIRST)
    os.truncate(path, 2**40)  # without blocks on the disk
    began = time.process_time()
    with pytest.raises(DamagedCalibrationError, match=f'more than {MOST_BYTES} bytes'):
        read_calibration(path)
    assert time.process_time() - began < 2.0


def with_poses(count: int) -> Calibration:
    """Return a calibration with this number of poses, most of which it does not use."""
    calibration = parse_calibration(intact()[-1], 'x.yaml')
    own = len(calibration.poses)
    poses = calibration.poses.take(np.resize(np.arange(own), count))
    return replace(calibration, poses=replace(poses, row=np.arange(1, count + 1)), rejected=tuple(
        Rejected(row, 'the reading is not plausible') for row in range(own + 1, count + 1)))


def test_what_is_written_is_within_the_limits_of_the_reader(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = with_poses(2000)
    text = format_calibration(calibration)
    most = calibration_yaml._values_in(calibration)
    monkeypatch.setattr(plain_yaml, 'MOST_VALUES', most)
    assert len(parse_calibration(text, 'x.yaml').poses) == 2000
    monkeypatch.setattr(plain_yaml, 'MOST_VALUES', most // 2)
    with pytest.raises(DamagedCalibrationError, match='more than .* values'):
        parse_calibration(text, 'x.yaml')
    assert calibration_yaml._values_in(with_poses(80_000)) < calibration_yaml.MOST_VALUES
    for name, limit in (('MOST_VALUES', most - 1), ('MOST_BYTES', len(text.encode()) - 1)):
        with monkeypatch.context() as lower:
            lower.setattr(calibration_yaml, name, limit)
            with pytest.raises(InputError, match='has 2000 poses, which is more than its file'):
                write_calibration(tmp_path / 'c.yaml', calibration)
    assert not (tmp_path / 'c.yaml').exists()


def test_one_long_label_cannot_take_the_memory_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = parse_calibration(intact()[-1], 'x.yaml')
    labels = np.array([50 * 'x', *(len(calibration.poses) - 1) * ['']])
    text = format_calibration(replace(calibration,
                                      poses=calibration.poses.with_columns(label=labels)))
    assert parse_calibration(text, 'x.yaml').poses['label'][0] == 50 * 'x'
    monkeypatch.setattr(calibration_yaml, 'MOST_BYTES', 49 * len(labels))
    with pytest.raises(DamagedCalibrationError, match='label has 50 characters, expected 49'):
        parse_calibration(text, 'x.yaml')


def test_a_long_name_is_refused_and_not_repeated() -> None:
    content = yaml.safe_load(intact()[0])
    content['sensor'] = 5000 * 'x'
    with pytest.raises(DamagedCalibrationError, match='sensor has 5000 characters, expected at'):
        parse_calibration(yaml.dump(content, sort_keys=False), 'x.yaml')
    content['sensor'] = 4000 * 'x'
    assert parse_calibration(yaml.dump(content, sort_keys=False), 'x.yaml').sensor == 4000 * 'x'


# Kinds of files


@pytest.mark.parametrize(('make', 'words'), [
    (os.mkfifo, 'a pipe'), (Path.mkdir, 'a folder'),
    (lambda path: path.symlink_to('/dev/zero'), 'a character device')])
def test_only_a_regular_file_is_opened(make: Callable[[Path], object], words: str, tmp_path: Path
                                       ) -> None:
    make(tmp_path / 'c.yaml')
    with pytest.raises(InputError, match=f'is {words}.*, expected a regular file'):
        read_calibration(tmp_path / 'c.yaml')


@pytest.mark.parametrize(('data', 'words'), [
    (b'', 'it is empty'), (bytes(4096), 'it is empty'),
    (FIRST.encode() + b'sensor: \xff\n', 'line 2 is not text in UTF-8'),
    (b'sensor: 1\n', 'is not a calibration of accel_calib')])
def test_content_that_is_not_a_calibration_is_refused(data: bytes, words: str, tmp_path: Path
                                                      ) -> None:
    (tmp_path / 'c.yaml').write_bytes(data)
    with pytest.raises(StoredCalibrationError, match=words):
        read_calibration(tmp_path / 'c.yaml')


@pytest.mark.parametrize('ending', ['\r\n', '\r'])
def test_other_line_ends_do_not_count_as_damage(ending: str, tmp_path: Path) -> None:
    path = tmp_path / 'c.yaml'
    path.write_bytes(intact()[-1].replace('\n', ending).encode())
    assert EDITED not in read_calibration(path).warnings


# What a changed file may not hide


@pytest.mark.parametrize(('old', 'new', 'words'), [
    ('\nsensor: ', '\nnote: x\nsensor: ', "the key 'note' is not known"),
    ('\nreason: ', '\nreasons: x\nreason: ', "the key 'reasons' is not known"),
    ('  row: ', '  rows: [1]\n  row: ', "the key 'rows' of poses is not known"),
    ('tau: ', 'tuu: 1.0, tau: ', "the key 'tuu' of an effect is not known")])
def test_an_unknown_key_in_a_changed_file_is_refused(old: str, new: str, words: str) -> None:
    text = intact()[-1]
    assert old in text
    with pytest.raises(DamagedCalibrationError, match=words):
        parse_calibration(text.replace(old, new, 1), 'x.yaml')


def test_the_checksum_is_also_checked_if_the_version_was_changed() -> None:
    text = intact()[-1].replace('version: 2', 'version: 1', 1)
    assert EDITED in parse_calibration(text, 'x.yaml').warnings


def test_numbers_without_a_point_in_an_edited_file_are_read() -> None:
    text = intact()[-1]
    number = text.split('offset: {')[1].split('x: ')[1].split(',')[0]
    edited = parse_calibration(text.replace(number, '1e-2', 1), 'x.yaml')
    assert edited.model.values['offset'][0] == 0.01


@pytest.mark.parametrize(('old', 'new', 'words'), [
    ('reading:\n', 'reading:\n  - [0.0, 0.0, x]\n', "reading has shape|reading contains 'x'"),
    ('count: [', 'count: [-1.0, ', 'count has shape|count holds'),
    ('offset: {', 'offset: {x: 1e200, ', 'stated twice'),
    ('rejected: []', 'rejected: [1]', 'rejected is 1, expected names'),
    ('warnings: [', 'warnings: [1, ', 'warning is 1, expected text')])
def test_a_value_of_another_kind_is_named(old: str, new: str, words: str) -> None:
    texts = [text for text in intact() if old in text]
    assert texts
    with pytest.raises(DamagedCalibrationError, match=words):
        parse_calibration(texts[0].replace(old, new, 1), 'x.yaml')


@pytest.mark.parametrize('value', [1e31, -1e200, 1e300])
def test_values_far_beyond_all_sensors_are_refused(value: float) -> None:
    content = yaml.safe_load(intact()[0])
    content['effects']['offset']['x'] = value
    with pytest.raises(DamagedCalibrationError, match='x is .*, expected at most 1e.30'):
        parse_calibration(yaml.dump(content, sort_keys=False), 'x.yaml')


@pytest.mark.parametrize('value', [
    '1e5', '010', '0x10', '1:30', 'yes', '~', '', ' ', '2001-01-01', '=', '<<', '.nan', '1_0',
    '#', 'a: b', '[', '\x1b[31m', '\u2028', 'ß', '😀', '*a', '&a', '!a', '1.0e+5', '-', 60 * '1'])
def test_text_of_any_form_is_stored_as_it_is(value: str) -> None:
    calibration = replace(parse_calibration(intact()[0], 'x.yaml'), sensor=value, reason=value)
    found = parse_calibration(format_calibration(calibration), 'x.yaml')
    assert (found.sensor, found.reason) == (value, value)
    assert EDITED not in found.warnings


def test_a_number_is_read_as_yaml_reads_it() -> None:
    rng = np.random.default_rng(4)
    numbers = [0.0, -0.0, 1.0, 1e-320, 1.7e308, *(rng.normal(size=200) * 10.0 ** rng.integers(
        -300, 300, 200)).tolist(), *rng.integers(-10**17, 10**17, 50).tolist()]
    text = yaml.safe_dump({'a': numbers, 'b': [True, False, None, float('inf')]})
    assert read_plain(text) == yaml.safe_load(text) == {
        'a': numbers, 'b': [True, False, None, float('inf')]}


def test_the_command_line_answers_a_bomb_with_one_line_and_status_2(tmp_path: Path) -> None:
    (tmp_path / 'c.yaml').write_text(BOMBS['lists'][0])
    done = subprocess.run(
        [sys.executable, '-m', 'accel_calib.cli.main', 'compare', *2 * [str(tmp_path / 'c.yaml')]],
        capture_output=True, text=True, timeout=60, check=False,
        cwd=Path(__file__).parent.parent)
    assert done.returncode == 2
    assert len(done.stderr.splitlines()) == 1
    assert 'more than 8 levels' in done.stderr


if __name__ == '__main__':
    sys.stdout.write(f'{trials(int(sys.argv[1]), int((*sys.argv, 0)[2]))}\n')
