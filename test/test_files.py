# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Tables and calibrations on disk: what is written is read, and what is overwritten.

Damaged and hostile calibrations end in a calibration or in one line.

"""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
import os
from pathlib import Path
import re
import stat

import accel_calib as ac
from accel_calib.calibration import Calibration, fit_poses, Rejected
from accel_calib.disk import write_atomically
from accel_calib.effects import OwnEffect
from accel_calib.errors import (
    AccelCalibError, DamagedCalibrationError, InputError, StoredCalibrationError)
from accel_calib.finding import has
from accel_calib.logs import read_poses, write_table
from accel_calib.stored import read_calibration, read_prior, write_calibration
from accel_calib.table import COLUMNS, numbered, Poses
from faults.fuzz import LONGEST_LINE
from faults.inputs import intact
from inside import (
    format_calibration, main, Model, MOST_BYTES, MOST_BYTES_READ, MOST_LETTERS_OF_LABELS,
    MOST_VALUES, MOST_VALUES_READ, parse_calibration, previous, read_plain, simulate_poses,
    spread_directions)
import numpy as np
import pytest
from shared import G, sensor, table, with_effects
import yaml


def every_column(count=4):
    rng = np.random.default_rng(1)
    columns = {key: rng.uniform(1, 2, count if len(column.names) == 1 else (count, 3))
               for key, column in COLUMNS.items() if not column.made}
    columns['reference'] /= np.linalg.norm(columns['reference'], axis=1, keepdims=True)
    columns['orientation'] = np.arange(float(count))
    columns['label'] = np.array(['flat', 'left, side up', 'nose "down"', ''])
    columns['time'] = 1.7e9 + np.arange(count) * 0.0025
    return Poses(columns, numbered(columns))


def test_every_column_is_read_as_it_was_written(tmp_path):
    table = every_column()
    write_table(tmp_path / 'poses.csv', table)
    found = read_poses(tmp_path / 'poses.csv')
    assert set(found.columns) == set(table.columns)
    assert found['label'].tolist() == table['label'].tolist()
    for key in table.columns.keys() - {'label'}:
        np.testing.assert_allclose(found[key], table[key], rtol=1e-11)
    np.testing.assert_allclose(np.diff(found['time']), 0.0025, atol=5e-7)


@pytest.fixture(params=['4', '9', '10', '12'])
def calibration(request):
    rng, directions = np.random.default_rng(2), spread_directions(16)
    context = {'reference': directions} if request.param == '12' else {}
    poses = simulate_poses(sensor(rng), directions, rng, context=context)
    return fit_poses(poses, G, model=request.param, sensor='imu_link',
                     date='2026-11-21T00:00:00+00:00')


def test_a_stored_calibration_is_read_with_all_digits_and_the_previous_one_is_kept(
        calibration, tmp_path):
    path = tmp_path / 'calibration.yaml'
    path.write_text('the one before')
    write_calibration(path, calibration)
    assert previous(path).read_text() == 'the one before'
    assert {*tmp_path.iterdir()} == {path, previous(path)}
    found = read_calibration(path)
    assert format_calibration(found) == format_calibration(calibration)
    reading = np.random.default_rng(3).normal(size=(5, 3))
    np.testing.assert_array_equal(found.correct(reading), calibration.correct(reading))
    np.testing.assert_array_equal(found.gain_sd, calibration.gain_sd)


def put(path, text='new\n'):
    write_atomically(path, lambda file: file.write(text))


@pytest.mark.parametrize('mode', [0o600, 0o640, 0o644])
def test_the_permissions_are_kept_and_those_of_a_new_file_are_of_the_process(mode, tmp_path):
    path, new = tmp_path / 'file', tmp_path / 'new'
    path.write_text('old\n')
    path.chmod(mode)
    before = os.umask(0o027)
    try:
        write_atomically(path, lambda file: file.write('new\n'), keep_before=True)
        put(new)
    finally:
        os.umask(before)
    assert previous(path).read_text() == 'old\n'
    modes = [stat.S_IMODE(each.stat().st_mode) for each in (path, previous(path), new)]
    assert modes == [mode, mode, 0o640]


def test_a_link_stays_and_its_target_is_replaced(tmp_path):
    (tmp_path / 'folder').mkdir()
    target, link = tmp_path / 'folder' / 'target', tmp_path / 'link'
    target.write_text('old\n')
    link.symlink_to(target)
    put(link)
    assert link.is_symlink()
    assert target.read_text() == 'new\n'
    assert {*tmp_path.iterdir()} == {target.parent, link}


def test_only_a_regular_writable_file_is_replaced(tmp_path):
    fifo, protected = tmp_path / 'fifo', tmp_path / 'protected'
    os.mkfifo(fifo)
    protected.write_text('old\n')
    protected.chmod(0o444)
    for path, words in ((fifo, 'not a regular file'), (tmp_path, 'not a regular file'),
                        (protected, 'write-protected')):
        with pytest.raises(InputError, match=words):
            put(path)
    assert protected.read_text() == 'old\n'
    assert stat.S_ISFIFO(fifo.stat().st_mode)


def test_a_link_at_a_temporary_name_is_not_followed(tmp_path, monkeypatch):
    victim = tmp_path / 'victim'
    victim.write_text('mine\n')
    monkeypatch.setattr('secrets.token_hex', lambda size: 'known')
    (tmp_path / '.file.known.tmp').symlink_to(victim)
    with pytest.raises(FileExistsError):
        put(tmp_path / 'file')
    assert victim.read_text() == 'mine\n'


def test_leftovers_of_killed_processes_are_removed_if_they_are_old_and_can_be(tmp_path):
    folder, old, young = (tmp_path / f'.file.{k}.tmp' for k in range(3))
    folder.mkdir()
    for path in (old, young):
        path.write_text('half')
    for path in (folder, old):
        os.utime(path, (0.0, 0.0))
    put(tmp_path / 'file')
    assert [each.exists() for each in (folder, old, young)] == [True, False, True]


# Damaged and hostile calibrations end in a calibration or in one line


MOST_EVENTS = 100
"""Number of YAML events after which the longest bomb must be refused."""

FIRST = 'format: accel_calib calibration\n'


# Bombs


def nested(opening: str) -> str:
    return f'x: {opening * 100_000}'


BOMBS: dict[str, tuple[str, str]] = {
    # libyaml 0.2.6 refuses these itself, before its first event.
    'lists': (nested('['), '8 levels|nesting depth'), 'mappings': (nested('{a: '), '8 levels'),
    'compact keys': (f'{"? " * 100_000}1', 'a key is'),
    'indented': (''.join(f'{" " * k}a:\n' for k in range(3000)), '8 levels'),
    'aliases': (''.join(f'x{k}: &x{k} [{", ".join(9 * [f"*x{k - 1}" if k else "1"])}]\n'
                        for k in range(12)), "anchor 'x0'"),
    'alias alone': ('x: *y', "alias 'y'"), 'second file': ('---\nx: 1', 'second document'),
    'code': ('x: !!python/object/apply:os.system [exit]', 'tag .*os.system'),
    'twice': ('date: 1\ndate: 2', "line 3, the key 'date'"),
    'date': ('date: 2001-99-99', "line 2, the value is '2001-99-99'"),
    'octal': ('x: 010', "'010'"), 'minutes': ('x: 1:30', "'1:30'"),
    'underscore': ('x: 1_0.5', "'1_0.5'"), 'huge': (f'version: 1{400 * "0"}', "version is '1000"),
    'large': (f'version: {30 * "9"}', "value is '9999"), 'zero byte': ('x: \0', 'control'),
    'escape': ('version: "\\e[31m"', r"version is ' \[31m'")}
"""Content below the first line, and words of the refusal."""


@pytest.mark.parametrize('name', BOMBS)
def test_a_bomb_is_refused_at_once_in_one_line(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    text, words = BOMBS[name]
    parse, events = yaml.parse, list[yaml.Event]()
    monkeypatch.setattr(yaml, 'parse', lambda *given, **options: (
        events.append(event) or event for event in parse(*given, **options)))
    with pytest.raises(DamagedCalibrationError, match=words) as refusal:
        parse_calibration(f'{FIRST}{text}\n', 'x.yaml')
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
    (b'', 'empty'), (bytes(4096), 'empty'), (FIRST.encode() + b'sensor: \xff\n', 'line 2'),
    (b'sensor: 1\n', 'not a calibration')])
def test_content_that_is_not_a_calibration_is_refused(data, words, tmp_path: Path) -> None:
    (tmp_path / 'c.yaml').write_bytes(data)
    with pytest.raises(StoredCalibrationError, match=words):
        read_calibration(tmp_path / 'c.yaml')


@pytest.mark.parametrize('ending', ['\r\n', '\r'])
def test_other_line_ends_do_not_count_as_damage(ending: str, tmp_path: Path) -> None:
    path = tmp_path / 'c.yaml'
    path.write_bytes(intact()[-1].replace('\n', ending).encode())
    assert not has(read_calibration(path).noted, 'edited')


def test_a_mark_of_the_encoding_and_comments_can_be_before_the_first_line(tmp_path: Path) -> None:
    path, text = tmp_path / 'c.yaml', intact()[-1]
    for before, is_edited in (('\ufeff', False), ('# left IMU\n\n', True), ('---\n', True)):
        path.write_text(f'{before}{text}', encoding='utf-8')
        assert has(read_calibration(path).noted, 'edited') is is_edited


# What a changed file may not hide


@cache
def whole() -> str:
    """Return a calibration with the bias of a gyro and the noise of the samples."""
    rng = np.random.default_rng(10)
    rate = [0.01, -0.02, 0.03] + rng.normal(size=(24, 3)) * 2e-4
    poses = simulate_poses(Model({}), spread_directions(24), rng, context={
        'rate': rate, 'rate_std': np.full((24, 3), 0.003)})
    return format_calibration(fit_poses(poses, G, model='10', sensor='imu_link',
                                        date='2026-01-01T00:00:00+00:00'))


@pytest.mark.parametrize(('old', 'new', 'words'), [
    *table('damaged_calibrations'),
    ('sensor: imu_link', f'sensor: {4097 * "x"}', 'sensor has 4097 characters')])
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


@pytest.mark.parametrize('name', ['temperature', 'Temp (°C)'])
@pytest.mark.parametrize('empty', ['', 'nan', 'N/A'])
def test_the_temperature_of_a_slower_thermometer_is_known_at_each_sample(
        name, empty, tmp_path, capsys):
    made = ac.simulate({'offset_temperature': 0.002}, recording=True, poses=24, seed=8,
                       temperature=(18.0, 40.0))
    warm = [f'{each:.3f}' if k % 97 == 3 else empty
            for k, each in enumerate(made['temperature'])]
    rows = [f'{time:.2f},{x:.5f},{y:.5f},{z:.5f},{each}' for time, (x, y, z), each in zip(
        made['time'], made.reading, warm, strict=True)]
    log = tmp_path / 'log.csv'
    log.write_text('\n'.join([f'time,ax,ay,az,{name}', *rows, '']))
    read = ac.read_recording(log)
    assert len(read) == len(made)
    assert read['temperature'][97:-97] == pytest.approx(made['temperature'][97:-97], abs=1e-3)
    calibration = ac.calibrate(log)
    assert 'offset_temperature' in calibration.model.effects
    calibration.save(tmp_path / 'c.yaml')
    log.write_text('time,ax,ay,az,temperature\n' + ''.join(
        f'{k / 100},0,0,9.8,\n' for k in range(40)))
    done = main(['apply', str(log), '-c', str(tmp_path / 'c.yaml'), '-o', str(tmp_path / 'out')])
    assert (done, 'need temperature' in capsys.readouterr().err) == (2, True)
