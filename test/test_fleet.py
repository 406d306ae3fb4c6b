# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Many recordings on a real cluster of two workers, which all tests share.

They are in one file, so that they run in one process. Runs draw no figures, which take longer than
all the rest; test_fleet_page.py tests them.

"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
import functools
from http.server import SimpleHTTPRequestHandler, ThreadingHTTPServer
import io
import json
import os
from pathlib import Path
import shutil
import signal
import subprocess
import sys
from threading import Thread
from typing import Any

from accel_calib import simulate
from accel_calib.effects import effects_of_file
from accel_calib.errors import InputError
from accel_calib.fleet import cluster, Input, Options, run, Store
from accel_calib.logs import write_table
from accel_calib.stored import read_calibration, read_prior
from faults.sample import sample
from fleet_case import (
    found_in, OFFSET, page_of, QUICK, rows_of, state_of, write_fleet, write_poses)
from inside import (
    alike, as_folder, COMMAND, content_hash, date_of, export, main, mapped, on_disk, overview,
    row_of, sensor_of)
import numpy as np
import pytest
from shared import OWN, python, run_on_small_disk, run_snippets, table, wait

KilledWorker = pytest.importorskip('distributed').KilledWorker
pytest.importorskip('pyarrow')


@pytest.fixture(scope='module')
def client() -> Iterator[Any]:
    with cluster(workers=2) as started:
        yield started


@pytest.fixture(scope='module', autouse=True)
def without_figures() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(sys.modules, 'matplotlib', None)
        yield


@pytest.fixture
def calibrate(client: Any, tmp_path: Path) -> Callable[..., Any]:
    """Return a function that calibrates recordings, by default of `in`, with results in `out`."""
    def calibrated(*names: Path | str, options: Options = QUICK, out: str = 'out') -> Any:
        found = found_in(*(names or [tmp_path / 'in']))
        return run(client, found, options, Store(tmp_path / out))

    return calibrated


def listens_at() -> list[str]:
    """Return the addresses at which this process waits for connections."""
    psutil = pytest.importorskip('psutil')
    return [each.laddr.ip for each in psutil.Process().net_connections('tcp')
            if each.status == psutil.CONN_LISTEN]


def test_a_cluster_of_this_machine_is_not_reached_from_others(client: Any) -> None:
    addresses = [listens_at(), *client.run(listens_at).values()]
    assert len(addresses[0]) > 1  # the scheduler and the dashboard
    assert {each for found in addresses for each in found} == {'127.0.0.1'}
    assert client.dashboard_link.startswith('http://127.0.0.1:')


def test_recordings_without_a_name_are_said_to_need_one(calibrate: Any, tmp_path: Path) -> None:
    for k in range(3):
        write_poses(tmp_path / 'in' / f'board{k}.csv', OFFSET, seed=k, sensor='')
    summary = calibrate()
    unknown, = summary.sensors
    assert summary.rating.findings[0].kind == 'unnamed'
    assert (unknown['calibrations'], unknown['drift'], unknown['changes']) == (0, None, [])
    assert '--sensor-from' in page_of(tmp_path / 'out')
    summary = calibrate(options=replace(QUICK, sensor_from=r'board\d'), out='other')
    assert {row['sensor'] for row in summary.sensors} == {'board0', 'board1', 'board2'}
    assert 'unnamed' not in {each.kind for each in summary.rating.findings}


def test_each_recording_of_an_address_becomes_a_row_and_a_calibration_on_the_workers(
        calibrate: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_fleet(tmp_path / 'in', 6, 2)
    (tmp_path / 'in' / 'bad.csv').write_text('nothing of use\n')
    for where, name in ((Store, 'merge'), (sys.modules[overview.__module__], 'digest')):
        monkeypatch.setattr(where, name, None)  # in this process, which must not need them
    address = f'file://{tmp_path}/in'
    assert found_in(address)[0].inside == 'bad.csv'
    summary = calibrate(address)
    assert summary.counts == {'ok': 12, 'error': 1}
    assert read_prior(tmp_path / 'out' / 'fleet.yaml').sensors == 6
    assert len(summary.sensors) == 7
    assert 'bad.csv' in page_of(tmp_path / 'out')
    assert not list((tmp_path / 'out' / 'pending').iterdir())
    for row in rows_of(tmp_path / 'out'):
        if row['status'] == 'error':
            assert f'{address}/bad.csv' in row['error']
            continue
        robot = int(row['sensor'].removeprefix('robot_').removesuffix('/imu_link'))
        assert abs(row['offset.x'] - 0.010 - 0.001 * robot) < 5.0 * row['offset.x.sd'] < 0.002
        stored = read_calibration(tmp_path / 'out' / row['calibration'])
        assert stored.offset[0] == pytest.approx(row['offset.x'], abs=1e-12)
        assert stored.date == row['date'] == f'{Path(row["recording"]).stem}T00:00:00+00:00'


def test_the_results_do_not_depend_on_the_order_of_the_tasks(
        client: Any, recorded: Path, undisturbed: Path, tmp_path: Path) -> None:
    run(client, found_in(recorded)[::-1], QUICK, Store(tmp_path))
    assert page_of(tmp_path) == page_of(undisturbed)
    assert state_of(tmp_path) == state_of(undisturbed)


def test_what_cannot_be_calibrated_or_read_is_a_row_with_its_error_and_tried_again(
        client: Any, tmp_path: Path) -> None:
    folder, store = tmp_path / 'in', Store(tmp_path / 'out')
    bad, good = folder / 'bad.csv', write_poses(folder / 'a.csv')
    bad.write_text('nothing of use\n')
    few = write_poses(folder / 'few.csv', directions=np.eye(3))
    odd = [os.fsdecode(os.fsencode(folder) + name) for name in (b'/\xff.csv', b'/\xfe/b.csv')]
    for each in odd:
        write_poses(Path(each))
    found = [*found_in(folder), Input(str(folder / 'late.csv'), 'late.csv')]
    assert run(client, found, QUICK, store).counts == {'ok': 1, 'error': 2, 'unread': 3}
    rows = {row['recording']: row for row in rows_of(store.folder)}
    assert rows[str(good)]['status'] == 'ok'
    assert rows[str(few)]['calibration'] is None
    for name in ('bad', 'few', 'late', '\\xff', '\\xfe/b'):
        assert rows[f'{folder}/{name}.csv']['error']
        assert rows[f'{folder}/{name}.csv']['advice']
    write_poses(folder / 'late.csv', seed=9)
    assert run(client, found, QUICK, store).counts == {'ok': 1, 'skipped': 3, 'unread': 2}
    assert sum(row['status'] == 'ok' for row in rows_of(store.folder)) == 2


def without_a_value(data: bytes) -> bytes:
    """Return a Parquet file with a row that does not say what it is about."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    file, rows = io.BytesIO(), pq.read_table(pa.BufferReader(data))
    about = rows.to_pylist()
    about[0][next(name for name in ('recording', 'sensor') if name in about[0])] = None
    pq.write_table(pa.Table.from_pylist(about, rows.schema), file)
    return file.getvalue()


DAMAGE: dict[str, Callable[[bytes], bytes]] = {
    'truncated': lambda data: data[:len(data) // 2], 'empty': lambda data: b'',
    'foreign': lambda data: b'{"key": 1}', 'without a value': without_a_value,
    'of another value': lambda data: data[:200] + bytes([data[200] ^ 1]) + data[201:]}


@pytest.mark.parametrize(('name', 'damages'), [
    ('data.parquet', [*DAMAGE]), ('sensors.parquet', ['empty']),
    ('sensors.parquet', ['without a value']),
    ('pending', ['truncated', 'foreign', 'of another value'])])
def test_damaged_files_of_the_results_are_set_aside_and_made_again(
        name: str, damages: list[str], client: Any, recorded: Path, undisturbed: Path,
        tmp_path: Path) -> None:
    store = Store(shutil.copytree(undisturbed, tmp_path / 'out'))
    for damage in damages if name == 'pending' else []:
        store.add({**rows_of(store.folder)[0], 'key': damage})
    files = sorted(store.folder.rglob('*.json' if name == 'pending' else name))
    broken = {file: DAMAGE[damage](file.read_bytes()) for file, damage in zip(files, damages)}
    assert len(broken) == len(damages)
    for file, data in broken.items():
        file.write_bytes(data)
    aside = [Path(each) for each in run(client, found_in(recorded), QUICK, store).damaged]
    assert sorted(each.read_bytes() for each in aside) == sorted(broken.values())
    assert name == 'pending' or {each.name for each in aside} == {name}
    assert not [file for file, data in broken.items() if file.exists()
                and file.read_bytes() == data]
    assert state_of(store.folder) == state_of(undisturbed)
    assert run(client, found_in(recorded), QUICK, store).damaged == ()


def test_results_whose_file_or_mark_is_lost_are_made_again(
        client: Any, recorded: Path, undisturbed: Path, tmp_path: Path) -> None:
    store = Store(shutil.copytree(undisturbed, tmp_path / 'out'))
    first, *_, other = sorted((store.folder / 'calibrations').rglob('*.yaml'))
    next(store.folder.glob(f'done/*/{first.stem}')).write_bytes(b'\xff' * 300)
    other.unlink()
    sorted(store.folder.rglob('data.parquet'))[1].unlink()
    run(client, found_in(recorded), QUICK, store)
    assert state_of(store.folder) == state_of(undisturbed)


def test_a_second_run_calibrates_what_is_new_and_all_with_other_options(
        client: Any, tmp_path: Path) -> None:
    folder, store = write_fleet(tmp_path / 'in', 1, 2), Store(tmp_path / 'out')
    run(client, found_in(folder), QUICK, store)
    before = rows_of(store.folder)
    write_poses(folder / 'robot_0' / '2026-03-03.csv', seed=9)
    (folder / 'robot_0' / '2026-01-03.csv').rename(folder / 'robot_0' / 'renamed.csv')
    assert run(client, found_in(folder), QUICK, store).counts == {'ok': 1, 'skipped': 2}
    assert rows_of(store.folder)[:2] == before
    bad = folder / 'robot_0' / 'bad.csv'
    bad.write_text('nothing of use\n')
    assert run(client, found_in(folder), QUICK, store).counts == {'error': 1, 'skipped': 3}
    write_poses(bad, seed=8)
    other, name = replace(QUICK, log=replace(QUICK.log, gravity=9.81)), 'robot_0/imu_link'
    for options, sensor, count in ((QUICK, name, 1), (other, name, 4), (QUICK, name, 4),
                                   (replace(QUICK, sensor_from='robot_.'), 'robot_0', 4)):
        summary = run(client, found_in(folder), options, store)
        assert (summary.counts['ok'], summary.rating.name) == (count, 'GOOD')
        rows = rows_of(store.folder)
        assert {(len(rows), row['sensor']) for row in rows} == {(4, sensor)}
        assert [row['sensor'] for row in summary.sensors] == [sensor]
        files = (store.folder / 'calibrations').rglob('*.yaml')
        assert {row['calibration'] for row in rows} == {
            str(path.relative_to(store.folder)) for path in files}


def test_a_copy_counts_once_and_a_moved_recording_leaves_its_sensor(
        client: Any, tmp_path: Path) -> None:
    folder, store = write_fleet(tmp_path / 'in', 2, 2), Store(tmp_path / 'out')
    first, second = (folder / f'robot_{k}' / '2026-01-03.csv' for k in range(2))
    copies = [folder / f'robot_{k}' / 'copy.csv' for k in range(2)]
    changes: list[tuple[Callable[[], Any], dict[str, int], list[int]]] = [
        (lambda: shutil.copy(first, copies[0]), {'ok': 4, 'skipped': 1}, [2, 2]),
        (lambda: shutil.copy(first, copies[1]), {'ok': 1, 'skipped': 5}, [2, 3]),
        (copies[0].unlink, {'skipped': 5}, [2, 3]),
        (lambda: second.rename(folder / 'robot_0' / 'moved.csv'), {'ok': 1, 'skipped': 4},
         [3, 2]),
        (lambda: first.rename(folder / 'moved.csv'), {'ok': 1, 'skipped': 4}, [2, 2])]
    for change, counts, rows in changes:
        change()
        assert run(client, found_in(folder), QUICK, store).counts == counts
        sensors = [row['sensor'] for row in rows_of(store.folder)]
        assert [sensors.count(f'robot_{k}/imu_link') for k in range(2)] == rows
        assert len([*(store.folder / 'calibrations').rglob('*.yaml')]) == len(sensors)


def test_the_weather_changes_no_value_of_a_sensor(tmp_path: Path) -> None:
    effects, rows = {'offset': OFFSET, 'offset_temperature': (0.001, -0.001, 0.0005)}, []
    for month, limits in enumerate(((0.0, 20.0), (20.0, 50.0)), 1):
        path = tmp_path / f'2026-{month:02d}-03.csv'
        write_table(path, simulate(effects, poses=24, seed=month, temperature=limits))
        rows.append(row_of(Input(str(path), path.name), path, Options())[0])
    for name, true in zip(('offset.x', 'offset.y', 'offset.z'), OFFSET):
        assert all(abs(row[name] - true) < 5.0 * row[f'{name}.sd'] < 0.002 for row in rows)
    assert [each['name'].partition('.')[0] for each in rows[0]['parameters']].count(
        'offset_temperature') == 3  # the lag is none


def test_poses_that_do_not_determine_all_values_are_no_change(calibrate: Any, tmp_path: Path
                                                              ) -> None:
    folder = write_fleet(tmp_path / 'in', 1, 3)
    few = folder / 'robot_0' / '2026-02-03.csv'
    lines = few.read_text().splitlines()
    few.write_text('\n'.join([*lines[:-14], *lines[-4:]]))
    summary = calibrate()
    assert summary.counts == {'ok': 3}
    rows = {Path(row['recording']).name: row for row in rows_of(tmp_path / 'out')}
    assert [row['determined'] for row in rows.values()] == [True, False, True]
    assert rows[few.name]['model'] == '4'
    assert abs(rows[few.name]['gain.x'] - 1.004) > 5.0 * rows[few.name]['gain.x.sd']
    (sensor,) = summary.sensors
    assert (sensor['agree'], sensor['changes'], sensor['calibrations']) == (True, [], 2)
    assert 'Not compared: 1 ' in page_of(tmp_path / 'out')


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
    with store.locked(), pytest.raises(InputError, match='another program'):
        run(client, [], QUICK, store)
    (store.folder / 'calibrations').write_text('in the way')
    with pytest.raises(OSError, match='calibrations'):
        run(client, found_in(path), QUICK, store)
    (store.folder / 'calibrations').unlink()
    assert run(client, found_in(path), QUICK, store).counts == {'ok': 1}


@pytest.mark.parametrize(('inside', 'name', 'expected'), table('named_sensors'))
def test_a_sensor_is_named_by_folder_and_file(inside: str, name: str, expected: str) -> None:
    assert sensor_of(Input(f'/data/{inside}', inside), name) == expected


def test_names_of_sensors_come_from_a_pattern_and_are_names_of_one_folder() -> None:
    found = Input('/data/robot_17/a.csv', 'a.csv')
    assert sensor_of(found, 'imu', r'robot_(\d+)') == '17'
    with pytest.raises(InputError, match='does not match --sensor-from'):
        sensor_of(found, 'imu', 'drone')
    names = ['a/b', 'a%2Fb', '..', 'a=b', '~unread', 'ü' * 200]
    folders = [as_folder(name) for name in names]
    assert len({*folders}) == len(names)
    assert not [each for each in folders if '/' in each or each.startswith(('.', '~'))]
    assert max(map(len, folders)) < 220


@pytest.mark.parametrize(('inside', 'expected'), [
    ('2026-11-22.csv', ('2026-11-22T00:00:00+00:00', 'path')),
    ('x/20261122_093015.mcap', ('2026-11-22T09:30:15+00:00', 'path')),
    ('a_1234567890.csv', ('1970-01-01T00:00:05+00:00', 'file'))])
def test_a_date_is_taken_from_the_path_if_there_are_no_stamps(
        inside: str, expected: tuple[str, str]) -> None:
    assert date_of(Input(inside, inside), None, 5.0) == expected


def test_lists_globs_and_folders_find_recordings(
        tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    write_fleet(tmp_path, 2, 2)
    (tmp_path / 'list.txt').write_text('# mine\nrobot_0\nrobot_1/*-02-*.csv\n')
    (tmp_path / 'robot_0' / 'notes.md').write_text('no recording')
    assert [each.inside for each in found_in(f'@{tmp_path}/list.txt')] == [
        '2026-01-03.csv', '2026-02-03.csv', '2026-02-03.csv']
    assert [each.inside for each in found_in(tmp_path / 'robot_*')] == [
        'robot_0/2026-01-03.csv', 'robot_0/2026-02-03.csv',
        'robot_1/2026-01-03.csv', 'robot_1/2026-02-03.csv']
    (tmp_path / 'itself.txt').write_text('@itself.txt\n')
    (tmp_path / 'latin.txt').write_bytes(b'\xff.csv\n')
    for name in ('robot_9', 'nothing_*', '@itself.txt', '@latin.txt'):
        with pytest.raises(InputError):
            found_in(name)
    whole = found_in(tmp_path)
    for link, target in (('robot_0/up', tmp_path), ('a', 'robot_1'), ('a.csv', 'none.csv')):
        (tmp_path / link).symlink_to(target)
    assert found_in(tmp_path) == whole


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


def test_pandas_reads_the_results_as_the_page_says(calibrate: Any, tmp_path: Path,
                                                   monkeypatch: pytest.MonkeyPatch) -> None:
    write_poses(tmp_path / 'in' / 'good.csv')
    (tmp_path / 'in' / 'bad.csv').write_text('nothing to see\n')
    calibrate(out='results')
    monkeypatch.chdir(tmp_path)
    names = run_snippets('docs/fleet.md')
    assert names['errors'].recording.tolist() == [str(tmp_path / 'in' / 'bad.csv')]
    assert len(names['rows']) == 2


def test_each_calibration_is_exported_as_asked(calibrate: Any, tmp_path: Path) -> None:
    path = write_poses(tmp_path / 'in' / 'a.csv')
    path.write_text(path.read_text().replace('imu_link', r'a\ud800\n'))
    calibrate(options=replace(QUICK, exports=('c', 'arduino', 'px4', 'betaflight')))
    row, = rows_of(tmp_path / 'out')
    stored = tmp_path / 'out' / row['calibration']
    assert sorted(path.name for path in stored.parent.iterdir()) == sorted(
        [stored.name, *(f'{stored.stem}_{end}' for end in (
            'arduino.h', 'betaflight.txt', 'c.h', 'px4.params'))])
    calibration = read_calibration(stored)
    assert stored.with_name(f'{stored.stem}_px4.params').read_bytes().decode() == (
        export(calibration, 'px4').text_or_bytes)
    assert any(line.startswith('betaflight: ') for line in row['warnings'])
    assert row['sensor'] == 'a'
    unexpected = calibrate(options=replace(QUICK, exports=('none',)), out='other')
    assert (unexpected.counts, unexpected.rating.name) == ({'unread': 1}, 'BAD')


def test_typical_values_that_no_longer_hold_are_removed(
        client: Any, recorded: Path, undisturbed: Path, tmp_path: Path) -> None:
    store = Store(shutil.copytree(undisturbed, tmp_path / 'out'))
    assert (store.folder / 'fleet.yaml').exists()
    by_robot = replace(QUICK, model_from=r'robot_\d')
    run(client, found_in(recorded), by_robot, store)
    assert not (store.folder / 'fleet.yaml').exists()


# ------------------------------------------------------------------------------ disturbed runs

ROBOTS, DATES = 5, 2
COUNT = ROBOTS * DATES + 1
FULL_KB = 48
"""Size of a disk that has room for some of the results."""

WAIT_S = 300.0


@dataclass(frozen=True)
class Site:
    """
    Where a run is disturbed.

    Parameters
    ----------
    client : distributed.Client
        The cluster.
    recorded, results : Path
        The recordings and the results.

    """

    client: Any
    recorded: Path
    results: Path

    def command(self, *more: str) -> list[str]:
        """Return the arguments of the command line."""
        return ['fleet', str(self.recorded), '-o', str(self.results), '--no-refine', *more]

    def on_cluster(self) -> list[str]:
        """Return the arguments of the command line for the cluster."""
        return self.command('--scheduler', self.client.scheduler.address)


def killed(pattern: str, enough: int) -> Callable[[Site], None]:
    """Return a function that kills the program as soon as there are so many files."""
    def disturb(site: Site) -> None:
        program = subprocess.Popen([sys.executable, *COMMAND,
                                    *site.on_cluster()], stdout=subprocess.DEVNULL)
        wait(lambda: program.poll() is not None or len([*site.results.glob(pattern)]) >= enough)
        program.kill()
        # After the last stage it may have been done.
        assert program.wait() == -signal.SIGKILL or pattern == 'sensors.parquet'

    return disturb


def full_disk(site: Site) -> None:
    """Run on a file system that is too small, and copy what is there."""
    done, copy = run_on_small_disk(site.results, FULL_KB, *site.command('--workers', '2'))
    assert done.returncode == 2
    assert 'No space left' in done.stderr
    assert done.stderr.count('\n') == 1
    site.results.rmdir()
    copy.replace(site.results)


def worker_killed(site: Site) -> None:
    """Kill a worker after two recordings; the run goes on."""
    pids = []

    def kill_one(done: int, count: int) -> None:
        if done == 2:
            pids.append(next(iter(site.client.run(os.getpid).values())))
            os.kill(pids[0], signal.SIGKILL)

    run(site.client, found_in(site.recorded), QUICK, Store(site.results), kill_one)
    assert pids
    assert {row['status'] for row in rows_of(site.results)} == {'ok', 'error'}


def scheduler_killed(site: Site) -> None:
    """Kill the scheduler of another cluster after two recordings."""
    address = site.results.with_name('address.json')
    common = ['--no-dashboard', '--scheduler-file', str(address)]
    scheduler, worker = (subprocess.Popen(
        [sys.executable, '-m', f'distributed.cli.{name}', *common, *more],
        stderr=subprocess.DEVNULL) for name, more in (
            ('dask_scheduler', ['--port', '0', '--host', '127.0.0.1']),
            ('dask_worker', ['--no-nanny', '--nthreads', '1', '--death-timeout', '60'])))
    try:
        wait(lambda: scheduler.poll() is not None or (
            address.exists() and address.read_text().endswith('}')))
        with cluster(json.loads(address.read_text())['address']) as far:
            far.wait_for_workers(1, timeout=WAIT_S)
            with pytest.raises(InputError, match='the scheduler .* is gone'):
                run(far, found_in(site.recorded), QUICK, Store(site.results),
                    lambda done, count: scheduler.kill() if done == 2 else None)
    finally:
        for process in (scheduler, worker):
            process.kill()
            process.wait()


DISTURBANCES = {
    'worker killed': worker_killed,
    'program killed at the first results': killed('pending/*/*.json', 2),
    'program killed at the last results': killed('pending/*/*.json', COUNT - 2),
    'program killed between two sensors': killed('recordings/*/data.parquet', 2),
    'program killed after the last sensor': killed('sensors.parquet', 1),
    'scheduler killed': scheduler_killed, 'disk full': full_disk}


@pytest.fixture(scope='module')
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of recordings; one of them cannot be calibrated."""
    folder = write_fleet(tmp_path_factory.mktemp('recorded'), ROBOTS, DATES)
    (folder / 'robot_0' / 'bad.csv').write_text('nothing of use\n')
    return folder


@pytest.fixture(scope='module')
def undisturbed(client: Any, recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of the results of one run."""
    results = tmp_path_factory.mktemp('undisturbed')
    summary = run(client, found_in(recorded), QUICK, Store(results))
    assert summary.counts == {'ok': COUNT - 1, 'error': 1}
    found = state_of(results)
    assert len(found['rows']) == len(found['done']) == len(found['places']) / 2 == COUNT
    assert len(found['texts']) == COUNT - 1
    return results


@pytest.mark.parametrize('disturbance', sample(DISTURBANCES, 2, seed=2))
def test_the_run_after_a_disturbed_one_loses_and_doubles_nothing(
        disturbance: str, client: Any, recorded: Path, undisturbed: Path, tmp_path: Path) -> None:
    site = Site(client, recorded, tmp_path / 'out')
    DISTURBANCES[disturbance](site)
    assert main([*site.on_cluster(), '--json', str(tmp_path / 'out.json')]) == 0
    found = json.loads((tmp_path / 'out.json').read_text())
    assert sum(found[name] for name in ('ok', 'error', 'skipped')) == COUNT
    assert found['unread'] == 0
    assert state_of(site.results) == state_of(undisturbed)


@pytest.mark.parametrize('moment', ['starts', 'works'])
def test_ctrl_c_ends_the_program_and_its_workers_without_words(
        moment: str, recorded: Path, tmp_path: Path) -> None:
    (temporary := tmp_path / 'tmp').mkdir()
    results = tmp_path / 'out'
    program = subprocess.Popen(
        [sys.executable, *COMMAND, 'fleet', str(recorded), '-o', str(results), '--workers', '1'],
        stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env={**os.environ, 'TMPDIR': str(temporary)},
        # Background commands of a shell inherit that it is ignored.
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL))
    seen = temporary.glob if moment == 'starts' else results.glob
    wait(lambda: [*seen('*')] or program.poll() is not None)
    os.killpg(program.pid, signal.SIGINT)  # as a terminal does
    assert program.communicate(timeout=WAIT_S)[1] == ''
    assert program.returncode == 130
    assert not [*temporary.iterdir()]


def test_ctrl_c_interrupts_where_the_program_waits_not_within_dask(client: Any) -> None:
    reached = []

    def interrupted() -> None:
        with cluster(client.scheduler.address) as own:
            signal.raise_signal(signal.SIGINT)
            reached.append(len(own.nthreads()))  # a call of Dask
            list(mapped(own, str, range(3)))
            reached.append('all done')

    # Background commands of a shell inherit that it is ignored.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted()
    finally:
        signal.signal(signal.SIGINT, before)
    assert reached == [2]


def test_own_effects_are_known_to_all_workers_and_needed_later(
        calibrate: Any, tmp_path: Path) -> None:
    (tmp_path / 'own.py').write_text(OWN, encoding='utf-8')
    options = replace(QUICK, refined=True, own=effects_of_file(tmp_path / 'own.py'))
    for seed in range(2):
        poses = simulate({'offset': OFFSET, 'dead_band': (0.01, -0.008, 0.006)}, poses=60,
                         seed=seed, units='g', also=options.own)
        (tmp_path / 'in').mkdir(exist_ok=True)
        write_table(tmp_path / 'in' / f'2026-0{seed + 1}-03.csv', replace(poses, sensor='arm'))
    summary = calibrate(options=options)
    assert summary.counts == {'ok': 2}
    arm, = summary.sensors
    assert (arm['calibrations'], arm['note']) == (2, None)  # compared on a worker, too
    rows = rows_of(tmp_path / 'out')
    assert [row['effects'][-1] for row in rows] == ['dead_band'] * 2
    assert calibrate(options=options).counts == {'skipped': 2}
    (tmp_path / 'own.py').write_text(OWN.replace('0.05', '0.06'), encoding='utf-8')
    changed = replace(options, own=effects_of_file(tmp_path / 'own.py'))
    assert calibrate(options=changed).counts == {'ok': 2}
    without = python(*COMMAND, 'verify', tmp_path / 'in' / '2026-01-03.csv', '-c',
                     tmp_path / 'out' / rows_of(tmp_path / 'out')[0]['calibration'])
    assert without.returncode == 2
    assert "'dead_band'" in without.stderr


# --------------------------------------- last, because what they kill would be started again

def test_a_recording_that_takes_too_long_is_a_row_with_its_error(
        client: Any, tmp_path: Path) -> None:
    good, store = write_poses(tmp_path / 'a.csv'), Store(tmp_path / 'out')
    long = tmp_path / 'long.csv'
    long.write_text('time,ax,ay,az\n' + ''.join(f'{k / 100},0,0,9.81\n' for k in range(200_000)))
    run(client, found_in(good), QUICK, store)
    summary = run(client, found_in(good, long), QUICK, store, limit_s=0.05)
    assert summary.counts == {'skipped': 1, 'unread': 1}
    row, = (row for row in rows_of(store.folder) if row['status'] == 'unread')
    assert row['recording'] == str(long)
    assert '0.05 s' in row['error']


def deadly(name: str) -> str:
    """Kill the worker at one of the items."""
    if name == 'deadly':
        os.kill(os.getpid(), signal.SIGKILL)
    return name


def test_a_cluster_that_lost_all_workers_for_good_starts_another(monkeypatch: Any) -> None:
    monkeypatch.setattr(sys.modules['accel_calib.fleet.run'], '_ABSENT_S', 1.0)
    with cluster(workers=1) as client:
        nanny, = client.cluster.workers.values()
        monkeypatch.setattr(nanny, 'instantiate', nanny.finished)  # does not start it again
        assert dict(mapped(client, str.upper, ['a'])) == {'a': 'A'}
        os.kill(nanny.pid, signal.SIGKILL)
        assert dict(mapped(client, str.upper, ['b', 'c'])) == {'b': 'B', 'c': 'C'}


def test_of_recordings_that_share_a_task_only_the_deadly_one_fails(client: Any) -> None:
    items = [*map(str, range(30)), 'deadly', *map(str, range(30, 40))]
    scheduler = client.cluster.scheduler
    # One death is forgiven: a task can be sent to a worker that has just died.
    before, scheduler.allowed_failures = scheduler.allowed_failures, 1
    try:
        found = dict(mapped(client, deadly, items))
    finally:
        scheduler.allowed_failures = before
    assert isinstance(found.pop('deadly'), KilledWorker)
    assert found == {name: name for name in map(str, range(40))}
