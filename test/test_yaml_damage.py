# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Damaged and hostile calibration files end in a calibration or in one line."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
import os
from pathlib import Path
import re

from accel_calib.calibration import Calibration, fit_poses, Rejected
from accel_calib.effects import OwnEffect
from accel_calib.errors import (
    AccelCalibError, DamagedCalibrationError, InputError, StoredCalibrationError)
from accel_calib.finding import has
from accel_calib.stored import read_calibration, read_prior, write_calibration
from accel_calib.units import units_of
from faults.fuzz import LONGEST_LINE
from faults.inputs import intact
from inside import (
    format_calibration, Model, MOST_BYTES, MOST_BYTES_READ, MOST_LETTERS_OF_LABELS, MOST_VALUES,
    MOST_VALUES_READ, parse_calibration, read_plain, simulate_poses, spread_directions)
import numpy as np
import pytest
from shared import table, with_effects
import yaml

MOST_EVENTS = 100
"""Number of YAML events after which the longest bomb must be refused."""

FIRST = 'format: accel_calib calibration\n'


# Bombs


def nested(opening: str) -> str:
    return f'{FIRST}x: {opening * 100_000}\n'


BOMBS: dict[str, tuple[str, str]] = {
    # libyaml 0.2.6 refuses these itself, before its first event.
    'lists': (nested('['), 'more than 8 levels|maximum nesting depth'),
    'mappings': (nested('{a: '), 'more than 8 levels'),
    'compact keys': (f'{FIRST}{"? " * 100_000}1\n', 'a key is a mapping or a list'),
    'indented': (FIRST + ''.join(f'{" " * k}a:\n' for k in range(3000)), 'more than 8 levels'),
    'aliases': (FIRST + ''.join(f'x{k}: &x{k} [{", ".join(9 * [f"*x{k - 1}" if k else "1"])}]\n'
                                for k in range(12)), "the anchor 'x0'"),
    'alias alone': (f'{FIRST}x: *y\n', "the alias 'y'"),
    'code': (f'{FIRST}x: !!python/object/apply:os.system [exit]\n', 'the tag .*os.system'),
    'second file': (f'{FIRST}---\nx: 1\n', 'a second document starts'),
    'twice': (f'{FIRST}date: 1\ndate: 2\n', "line 3, the key 'date' is stated twice"),
    'date': (f'{FIRST}date: 2001-99-99\n', "at date, line 2, the value is '2001-99-99'"),
    'octal': (f'{FIRST}x: 010\n', "the value is '010', expected a decimal number"),
    'minutes': (f'{FIRST}x: 1:30\n', "the value is '1:30', expected a decimal number"),
    'underscore': (f'{FIRST}x: 1_0.5\n', "the value is '1_0.5', expected a decimal number"),
    'huge': (f'{FIRST}version: 1{400 * "0"}\n', "its version is '1000"),
    'large': (f'{FIRST}version: {30 * "9"}\n', "the value is '9999"),
    'escape': (f'{FIRST}version: "\\e[31m"\n', r"version is ' \[31m'"),
    'zero byte': (f'{FIRST}x: \0\n', 'control characters'),
}


@pytest.mark.parametrize('name', BOMBS)
def test_a_bomb_is_refused_at_once_in_one_line(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, words = BOMBS[name]
    parse, events = yaml.parse, list[yaml.Event]()
    monkeypatch.setattr(yaml, 'parse', lambda *given, **options: (
        events.append(event) or event for event in parse(*given, **options)))
    with pytest.raises(DamagedCalibrationError, match=words) as refusal:
        parse_calibration(text, 'x.yaml')
    assert len(events) < MOST_EVENTS
    assert str(refusal.value).isprintable()
    assert len(str(refusal.value)) <= LONGEST_LINE


def test_the_number_of_values_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(*MOST_VALUES_READ, 1000)
    assert len(read_plain(f'[{"a," * 999}]')) == 999
    for text in (f'[{"a," * 1000}]', f'[{"[]," * 1000}]',
                 '{' + ''.join(f'{k}: 1,' for k in range(501)) + '}'):
        with pytest.raises(ValueError, match='more than 1000 values'):
            read_plain(text)


@pytest.mark.usefixtures('in_time')
@pytest.mark.parametrize('read', [read_calibration, read_prior])
def test_the_size_of_a_file_is_bounded_before_it_is_parsed(
        read: Callable[[Path], object], tmp_path: Path) -> None:
    path = tmp_path / 'large.yaml'
    path.write_text(FIRST)
    os.truncate(path, 2**40)  # without blocks on the disk, and more than a memory holds
    with pytest.raises(AccelCalibError, match=f'more than {MOST_BYTES} bytes'):
        read(path)
    os.mkfifo(tmp_path / 'pipe')
    with pytest.raises(InputError, match='is a pipe'):
        read(tmp_path / 'pipe')


def test_another_format_of_typical_values_is_refused_in_one_line(tmp_path: Path) -> None:
    (tmp_path / 'fleet.yaml').write_text('format: "a\\nb"\n')
    with pytest.raises(InputError, match=r"has format 'a b', expected 1"):
        read_prior(tmp_path / 'fleet.yaml')


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
    monkeypatch.setattr(*MOST_VALUES_READ, MOST_VALUES // 40)
    text = format_calibration(calibration)
    for where, limit in ((MOST_VALUES_READ, 10_000), (MOST_BYTES_READ, len(text.encode()) - 1)):
        with monkeypatch.context() as lower:
            lower.setattr(*where, limit)
            with pytest.raises(InputError, match='2000 poses cannot be stored: .* more than'):
                write_calibration(tmp_path / 'c.yaml', calibration)
    assert not (tmp_path / 'c.yaml').exists()


def test_one_long_label_cannot_take_the_memory_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    calibration = parse_calibration(intact()[-1], 'x.yaml')
    labels = np.array([50 * 'x', *(len(calibration.poses) - 1) * ['']])
    text = format_calibration(replace(calibration,
                                      poses=calibration.poses.with_columns(label=labels)))
    assert parse_calibration(text, 'x.yaml').poses['label'][0] == 50 * 'x'
    monkeypatch.setattr(*MOST_LETTERS_OF_LABELS, 49 * len(labels))
    with pytest.raises(DamagedCalibrationError, match='label has 50 characters, expected 49'):
        parse_calibration(text, 'x.yaml')


# Kinds of content


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
    assert not has(read_calibration(path).noted, 'edited')


# What a changed file may not hide


DAMAGE = table('damaged_calibrations')
"""Text of a calibration, what replaces it, and words of the refusal."""


@cache
def whole() -> str:
    """Return a calibration with the bias of a gyro and the noise of the samples."""
    rng = np.random.default_rng(10)
    rate = [0.01, -0.02, 0.03] + rng.normal(size=(24, 3)) * 2e-4
    poses = simulate_poses(Model({}), spread_directions(24), rng, context={
        'rate': rate, 'rate_std': np.full((24, 3), 0.003)})
    return format_calibration(fit_poses(poses, units_of('g'), model='10', sensor='imu_link',
                                        date='2026-01-01T00:00:00+00:00'))


@pytest.mark.parametrize(('old', 'new', 'words'), [
    *DAMAGE, ('sensor: imu_link', f'sensor: {4097 * "x"}', 'sensor has 4097 characters')])
def test_damage_is_refused_in_one_line_that_names_it(old: str, new: str, words: str) -> None:
    text = next(text for text in (whole(), *intact()) if old in text)
    with pytest.raises(StoredCalibrationError, match=words) as refusal:
        parse_calibration(text.replace(old, new, 1), 'x.yaml')
    assert '\n' not in str(refusal.value)


@pytest.mark.parametrize(('stated', 'words'), [
    ('', 'own_rms is missing'), (', own_rms: much', "own_rms is 'much', expected a finite")])
def test_an_own_effect_without_the_size_of_its_contribution_is_refused(stated: str, words: str
                                                                       ) -> None:
    own = OwnEffect('field', 'offset by a field', typical=1e-4, variable='motor_current')
    calibration = parse_calibration(intact()[-1], 'x.yaml')
    text = format_calibration(with_effects(
        calibration, {own: [1e-3, 2e-3, 3e-3]},
        motor_current=np.linspace(-1.0, 1.0, len(calibration.poses))))
    assert own in parse_calibration(text, 'x.yaml', [own]).model.effects
    with pytest.raises(DamagedCalibrationError, match=words):
        parse_calibration(re.sub(r',\s+own_rms: [-+.e\d]+', stated, text), 'x.yaml', [own])


def test_numbers_without_a_point_in_an_edited_file_are_read() -> None:
    text = intact()[-1]
    number = text.split('offset: {')[1].split('x: ')[1].split(',')[0]
    edited = parse_calibration(text.replace(number, '1e-2', 1), 'x.yaml')
    assert edited.model.values['offset'][0] == 0.01


@pytest.mark.parametrize('value', [
    '1e5', '010', '0x10', '1:30', 'yes', '~', '', ' ', '2001-01-01', '=', '<<', '.nan', '1_0',
    '#', 'a: b', '[', 'ß', '😀', '*a', '&a', '!a', '1.0e+5', '-', 60 * '1', '\x1b[31m', '\u2028',
    'a\ud800b', 'a\n# b: c', 4096 * 'x'])
def test_text_of_any_form_is_stored_as_one_printable_line(value: str) -> None:
    calibration = replace(parse_calibration(intact()[0], 'x.yaml'), sensor=value)
    kept = ''.join(each if each.isprintable() else ' ' for each in value).strip()
    found = parse_calibration(format_calibration(calibration), 'x.yaml')
    assert found.sensor == found.poses.sensor == calibration.sensor == kept
    assert not has(found.noted, 'edited')


def test_a_number_is_read_as_yaml_reads_it() -> None:
    rng = np.random.default_rng(4)
    numbers = [0.0, -0.0, 1.0, 1e-320, 1.7e308, *(rng.normal(size=200) * 10.0 ** rng.integers(
        -300, 300, 200)).tolist(), *rng.integers(-10**17, 10**17, 50).tolist()]
    text = yaml.safe_dump({'a': numbers, 'b': [True, False, None, float('inf')]})
    assert read_plain(text) == yaml.safe_load(text) == {
        'a': numbers, 'b': [True, False, None, float('inf')]}
