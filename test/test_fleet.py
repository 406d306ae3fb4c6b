# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Many recordings on a real cluster of two workers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
import functools
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
from threading import Thread
import time
from typing import Any

from accel_calib.errors import InputError
from accel_calib.files import read_calibration
from accel_calib.files.exports import export
from accel_calib.fleet import cluster, Input, run, Store
from accel_calib.fleet.alike import alike
from accel_calib.fleet.identity import as_folder, date_of, sensor_of
from accel_calib.fleet.inputs import content_hash, on_disk
from fleet_case import found_in, OFFSET, QUICK, rows_of, write_fleet, write_poses
import numpy as np
import pytest

pytest.importorskip('distributed')
pytest.importorskip('pyarrow')


@pytest.fixture(scope='module')
def client() -> Iterator[Any]:
    with cluster(workers=2) as started:
        yield started


def test_each_recording_becomes_a_row_and_a_calibration(client: Any, tmp_path: Path) -> None:
    write_fleet(tmp_path / 'in', 2, 2)
    summary = run(client, found_in(tmp_path / 'in'), QUICK, Store(tmp_path / 'out'))
    rows = rows_of(tmp_path / 'out')
    assert summary.counts == {'ok': 4}
    assert len(rows) == 4
    for row in rows:
        robot = int(row['sensor'].removeprefix('robot_').removesuffix('/imu_link'))
        assert abs(row['offset.x'] - 0.010 - 0.001 * robot) < 5.0 * row['offset.x.sd'] < 0.002
        stored = read_calibration(tmp_path / 'out' / row['calibration'])
        assert stored.offset[0] == pytest.approx(row['offset.x'], abs=1e-12)
        assert stored.date == row['date'] == f'{Path(row["recording"]).stem}T00:00:00+00:00'


def test_a_bad_recording_is_a_row_with_its_error(client: Any, tmp_path: Path) -> None:
    good = write_poses(tmp_path / 'a.csv')
    bad = tmp_path / 'bad.csv'
    bad.write_text('nothing of use\n')
    few = write_poses(tmp_path / 'few.csv', directions=np.eye(3))
    summary = run(client, found_in(good, bad, few), QUICK, Store(tmp_path / 'out'))
    rows = {row['recording']: row for row in rows_of(tmp_path / 'out')}
    assert summary.counts == {'ok': 1, 'error': 2}
    assert rows[str(good)]['status'] == 'ok'
    assert 'no table of numbers' in rows[str(bad)]['error']
    assert rows[str(bad)]['advice']
    assert rows[str(few)]['error']
    assert rows[str(few)]['calibration'] is None


def test_a_second_run_calibrates_only_what_is_new(client: Any, tmp_path: Path) -> None:
    folder, store = write_fleet(tmp_path / 'in', 1, 2), Store(tmp_path / 'out')
    run(client, found_in(folder), QUICK, store)
    before = rows_of(store.folder)
    write_poses(folder / 'robot_0' / '2026-03-03.csv', seed=9)
    (folder / 'robot_0' / '2026-01-03.csv').rename(folder / 'robot_0' / 'renamed.csv')
    summary = run(client, found_in(folder), QUICK, store)
    assert summary.counts == {'ok': 1, 'skipped': 2}
    assert rows_of(store.folder)[:2] == before
    assert len(rows_of(store.folder)) == 3


def test_other_options_replace_the_rows(client: Any, tmp_path: Path) -> None:
    path, store = write_poses(tmp_path / 'a.csv'), Store(tmp_path / 'out')
    other = replace(QUICK, log=replace(QUICK.log, gravity=9.81))
    for options in (QUICK, other, QUICK):
        assert run(client, found_in(path), options, store).counts == {'ok': 1}
        assert len(rows_of(store.folder)) == 1


def test_a_recording_that_could_not_be_read_is_tried_again(client: Any, tmp_path: Path) -> None:
    store, path = Store(tmp_path / 'out'), tmp_path / 'a.csv'
    missing = [Input(str(path), 'a.csv')]
    assert run(client, missing, QUICK, store).counts == {'unread': 1}
    (row,) = rows_of(store.folder)
    assert 'No such file' in row['error']
    write_poses(path)
    assert run(client, missing, QUICK, store).counts == {'ok': 1}
    (row,) = rows_of(store.folder)
    assert row['status'] == 'ok'


def test_a_change_for_good_is_named_and_an_odd_calibration_is_not(
        client: Any, tmp_path: Path) -> None:
    moved = OFFSET + np.eye(3)[2] * 0.02
    for k, (changed, odd) in enumerate([(OFFSET, OFFSET), (OFFSET, moved), (moved, OFFSET),
                                        (moved, OFFSET)], 1):
        write_poses(tmp_path / 'in' / 'changed' / f'2026-{k:02d}-01.csv', changed, seed=k)
        write_poses(tmp_path / 'in' / 'odd' / f'2026-{k:02d}-01.csv', odd, seed=10 + k)
    summary = run(client, found_in(tmp_path / 'in'), QUICK, Store(tmp_path / 'out'))
    changes = {row['sensor'].split('/')[0]: row['changes'] for row in summary.sensors}
    (change,), (single,) = changes['changed'], changes['odd']
    assert change['for_good']
    assert change['date'].startswith('2026-03')
    assert change['parameter'] == 'offset.z'
    assert change['change'] == pytest.approx(0.02, abs=5.0 * change['sd'])
    assert not single['for_good']
    assert single['date'].startswith('2026-02')


def test_poses_that_do_not_determine_all_values_are_no_change(client: Any, tmp_path: Path) -> None:
    folder = write_fleet(tmp_path / 'in', 1, 3)
    few = folder / 'robot_0' / '2026-02-03.csv'
    lines = few.read_text().splitlines()
    few.write_text('\n'.join([*lines[:-14], *lines[-4:]]))
    summary = run(client, found_in(folder), QUICK, Store(tmp_path / 'out'))
    assert summary.counts == {'ok': 3}
    rows = {Path(row['recording']).name: row for row in rows_of(tmp_path / 'out')}
    assert [row['determined'] for row in rows.values()] == [True, False, True]
    assert rows[few.name]['model'] == '4'
    assert abs(rows[few.name]['gain.x'] - 1.004) > 5.0 * rows[few.name]['gain.x.sd']
    (sensor,) = summary.sensors
    assert (sensor['agree'], sensor['changes'], sensor['calibrations']) == (True, [], 2)
    assert 'Not compared: 1 recording whose poses do not determine' in (
        tmp_path / 'out' / 'fleet.html').read_text(encoding='utf-8')


def test_only_calibrations_with_the_effects_of_most_are_compared() -> None:
    def row(name: str, *more: str, **known: Any) -> dict[str, Any]:
        return {'calibration': name, 'determined': True,
                'effects': ['offset', 'axis_gain', 'cross_axis', *more], **known}

    warm = [row('a', 'offset_temperature'), row('b', 'offset_temperature')]
    others = [row('c', 'offset_step'), row('d'), {**warm[0], 'determined': False},
              {**warm[0], 'calibration': None}, {**warm[0], 'effects': [
                  'offset', 'axis_gain', 'offset_temperature']}]
    assert alike([*others, *warm]) == warm
    plain = [row('e'), row('f', effects=['offset', 'gain']), row('g', effects=['offset'])]
    assert alike([*plain, *warm]) == plain
    assert alike(others[2:4]) == []


def test_addresses_are_read_like_files(client: Any, tmp_path: Path) -> None:
    write_fleet(tmp_path / 'in', 1, 2)
    (tmp_path / 'in' / 'robot_0' / 'bad.csv').write_text('nothing of use\n')
    found = found_in(f'file://{tmp_path}/in')
    assert [each.inside for each in found] == [
        'robot_0/2026-01-03.csv', 'robot_0/2026-02-03.csv', 'robot_0/bad.csv']
    assert run(client, found, QUICK, Store(tmp_path / 'out')).counts == {'ok': 2, 'error': 1}
    bad = next(row for row in rows_of(tmp_path / 'out') if row['error'])
    assert f'file://{tmp_path}/in/robot_0/bad.csv has no table' in bad['error']


def test_a_merge_that_stopped_is_completed_by_the_next_run(client: Any, tmp_path: Path) -> None:
    folder, store = write_fleet(tmp_path / 'in', 2, 2), Store(tmp_path / 'out')
    in_the_way = tmp_path / 'out' / 'sensors.parquet'  # written after the data set
    with pytest.raises(OSError, match='sensors.parquet'):
        run(client, found_in(folder), QUICK, store,
            lambda done, count: in_the_way.mkdir() if done == count else None)
    assert len(rows_of(store.folder)) == 4
    in_the_way.rmdir()
    summary = run(client, found_in(folder), QUICK, store)
    assert summary.counts == {'skipped': 4}
    assert len(summary.sensors) == 2
    assert len({row['key'] for row in rows_of(store.folder)}) == len(rows_of(store.folder)) == 4
    assert store.waiting() == []


def test_results_that_cannot_be_written_stop_the_run_and_are_made_later(
        client: Any, tmp_path: Path) -> None:
    path, store = write_poses(tmp_path / 'a.csv'), Store(tmp_path / 'out')
    store.folder.mkdir()
    (store.folder / 'calibrations').write_text('in the way')
    with pytest.raises(OSError, match='calibrations'):
        run(client, found_in(path), QUICK, store)
    (store.folder / 'calibrations').unlink()
    assert run(client, found_in(path), QUICK, store).counts == {'ok': 1}


def test_two_programs_do_not_write_to_one_folder(client: Any, tmp_path: Path) -> None:
    store = Store(tmp_path / 'out')
    with store.locked(), pytest.raises(InputError, match='another program'):
        run(client, [], QUICK, store)


def test_a_run_whose_scheduler_is_gone_ends_with_an_error_and_is_continued(
        client: Any, tmp_path: Path) -> None:
    folder, store = write_fleet(tmp_path / 'in', 3, 4), Store(tmp_path / 'out')
    command = [sys.executable, '-m', 'distributed.cli.dask_scheduler', '--port', '0', '--host',
               '127.0.0.1', '--no-dashboard', '--scheduler-file', str(tmp_path / 'address.json')]
    scheduler = subprocess.Popen(command, stderr=subprocess.DEVNULL)
    worker = subprocess.Popen(
        [sys.executable, '-m', 'distributed.cli.dask_worker', '--no-nanny', '--nthreads', '1',
         '--no-dashboard', '--scheduler-file', str(tmp_path / 'address.json'),
         '--death-timeout', '20'], stderr=subprocess.DEVNULL)
    try:
        while not (tmp_path / 'address.json').exists():
            assert scheduler.poll() is None
            time.sleep(0.1)
        address = json.loads((tmp_path / 'address.json').read_text())['address']
        with cluster(address) as far:
            far.wait_for_workers(1, timeout=60)
            with pytest.raises(InputError, match='the scheduler .* is gone'):
                run(far, found_in(folder), QUICK, store,
                    lambda done, count: scheduler.kill() if done == 2 else None)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()
    summary = run(client, found_in(folder), QUICK, store)
    assert summary.counts['skipped'] >= 2
    assert len(rows_of(store.folder)) == len({row['key'] for row in rows_of(store.folder)}) == 12


def test_killed_workers_lose_and_double_nothing(tmp_path: Path) -> None:
    folder, store = write_fleet(tmp_path / 'in', 4, 4), Store(tmp_path / 'out')
    with cluster(workers=2) as client:
        killed = []

        def kill_one(done: int, count: int) -> None:
            if done in (2, 7):
                pid = next(iter(client.run(os.getpid).values()))
                os.kill(pid, signal.SIGKILL)
                killed.append(pid)

        summary = run(client, found_in(folder), QUICK, store, kill_one)
    rows = rows_of(store.folder)
    assert len(killed) == 2
    assert sum(summary.counts.values()) == 16
    assert set(summary.counts) <= {'ok', 'skipped'}
    assert len(rows) == len({row['recording'] for row in rows}) == 16
    assert {row['status'] for row in rows} == {'ok'}


@pytest.mark.parametrize(('inside', 'name', 'expected'), [
    ('robot_17/2026-11-22.mcap', 'imu_link', 'robot_17/imu_link'),
    ('2026-11/a.csv', 'SN123', 'SN123'),
    ('2026/11/22/a.csv', 'SN123', 'SN123'),
    ('robot_17/a.csv', '', 'robot_17'),
    ('SN123/a.csv', 'SN123', 'SN123'),
    ('a.csv', '', 'unknown'),
])
def test_a_sensor_is_named_by_folder_and_file(inside: str, name: str, expected: str) -> None:
    assert sensor_of(Input(f'/data/{inside}', inside), name) == expected


def test_a_pattern_names_the_sensor_by_its_path() -> None:
    found = Input('/data/robot_17/a.csv', 'a.csv')
    assert sensor_of(found, 'imu', r'robot_(\d+)') == '17'
    with pytest.raises(InputError, match='does not match --sensor-from'):
        sensor_of(found, 'imu', 'drone')


def test_names_of_sensors_are_names_of_one_folder() -> None:
    names = ['a/b', 'a%2Fb', '..', 'a=b', '~unread', 'ü' * 200]
    folders = [as_folder(name) for name in names]
    assert len({*folders}) == len(names)
    assert not [each for each in folders if '/' in each or each.startswith(('.', '~'))]
    assert max(map(len, folders)) < 220


@pytest.mark.parametrize(('inside', 'expected'), [
    ('2026-11-22.csv', ('2026-11-22T00:00:00+00:00', 'path')),
    ('x/20261122_093015.mcap', ('2026-11-22T09:30:15+00:00', 'path')),
    ('a_1234567890.csv', ('1970-01-01T00:00:05+00:00', 'file')),
])
def test_a_date_is_taken_from_the_path_if_there_are_no_stamps(
        inside: str, expected: tuple[str, str]) -> None:
    assert date_of(Input(inside, inside), None, 5.0) == expected


def test_lists_globs_and_folders_find_recordings(tmp_path: Path) -> None:
    write_fleet(tmp_path, 2, 2)
    (tmp_path / 'list.txt').write_text('# mine\nrobot_0\nrobot_1/*-02-*.csv\n')
    (tmp_path / 'robot_0' / 'notes.md').write_text('no recording')
    assert [each.inside for each in found_in(f'@{tmp_path}/list.txt')] == [
        '2026-01-03.csv', '2026-02-03.csv', '2026-02-03.csv']
    assert [each.inside for each in found_in(tmp_path / 'robot_*')] == [
        'robot_0/2026-01-03.csv', 'robot_0/2026-02-03.csv',
        'robot_1/2026-01-03.csv', 'robot_1/2026-02-03.csv']
    with pytest.raises(InputError, match='does not exist'):
        found_in(tmp_path / 'robot_9')
    with pytest.raises(InputError, match='holds no recording'):
        found_in(tmp_path / 'nothing_*')


def test_an_address_of_the_web_may_have_a_query(tmp_path: Path) -> None:
    pytest.importorskip('aiohttp')
    write_poses(tmp_path / 'robot_0' / 'a.csv')
    handler = functools.partial(SimpleHTTPRequestHandler, directory=str(tmp_path))
    with ThreadingHTTPServer(('127.0.0.1', 0), handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        address = f'http://127.0.0.1:{server.server_port}/robot_0/a.csv?token=1'
        (found,) = found_in(address)
        with on_disk(found.path) as path:
            assert path.name == 'a.csv'
            assert path.read_bytes() == (tmp_path / 'robot_0' / 'a.csv').read_bytes()
        server.shutdown()
    assert found.path == address


def test_the_content_of_a_folder_is_that_of_its_files_and_names(tmp_path: Path) -> None:
    for name, files in (('a', {'x': 'ab', 'y': 'c'}), ('b', {'x': 'ab', 'y': 'c'}),
                        ('c', {'x': 'a', 'y': 'bc'}), ('d', {'x': 'ab', 'z': 'c'})):
        (tmp_path / name).mkdir()
        for file, text in files.items():
            (tmp_path / name / file).write_text(text)
    a, b, c, d = (content_hash(tmp_path / name) for name in 'abcd')
    assert a == b
    assert len({a, c, d}) == 3


def test_pandas_reads_the_results_as_the_page_says(client: Any, tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    write_poses(tmp_path / 'in' / 'good.csv')
    (tmp_path / 'in' / 'bad.csv').write_text('nothing to see\n')
    run(client, found_in(tmp_path / 'in'), QUICK, Store(tmp_path / 'results'))
    monkeypatch.chdir(tmp_path)
    page = Path(__file__).resolve().parents[1] / 'docs' / 'fleet.md'
    found = page.read_text(encoding='utf-8').partition('```python\n')[2].partition('```')[0]
    names: dict[str, Any] = {}
    exec(compile(found, 'fleet.md', 'exec'), names)
    assert names['errors'].recording.tolist() == [str(tmp_path / 'in' / 'bad.csv')]
    assert len(names['rows']) == 2


def test_each_calibration_is_exported_as_asked(client: Any, tmp_path: Path) -> None:
    write_poses(tmp_path / 'in' / 'a.csv')
    options = replace(QUICK, exports=('c', 'arduino', 'px4', 'betaflight'))
    run(client, found_in(tmp_path / 'in'), options, Store(tmp_path / 'out'))
    row, = rows_of(tmp_path / 'out')
    stored = tmp_path / 'out' / row['calibration']
    assert sorted(path.name for path in stored.parent.iterdir()) == sorted(
        [stored.name, *(f'{stored.stem}_{end}' for end in (
            'arduino.h', 'betaflight.txt', 'c.h', 'px4.params'))])
    calibration = read_calibration(stored)
    assert stored.with_name(f'{stored.stem}_px4.params').read_bytes().decode() == (
        export(calibration, 'px4').text_or_bytes)
    assert any(line.startswith('betaflight: ') for line in row['warnings'])


def test_typical_values_that_no_longer_hold_are_removed(client: Any, tmp_path: Path) -> None:
    write_fleet(tmp_path / 'in', 5, 1)
    found, store = found_in(tmp_path / 'in'), Store(tmp_path / 'out')
    assert run(client, found, QUICK, store).priors
    assert (tmp_path / 'out' / 'fleet.yaml').exists()
    assert not run(client, found, replace(QUICK, model_from=r'robot_\d'), store).priors
    assert not (tmp_path / 'out' / 'fleet.yaml').exists()
