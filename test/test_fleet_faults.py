# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A fleet whose program is killed, whose disk is full, or whose recordings are far away."""

from __future__ import annotations

from collections.abc import Callable, Iterator
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from accel_calib.fleet import cluster, run, Store
from accel_calib.fleet.run import mapped
from fleet_case import found_in, QUICK, rows_of, state_of, write_fleet
import pytest

pytest.importorskip('distributed')
pytest.importorskip('pyarrow')

ROBOTS, DATES = 5, 5
COUNT = ROBOTS * DATES + 1
FULL_KB = 120
"""Size of a disk that has room for some of the results."""


@pytest.fixture(scope='module')
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder of recordings; one of them cannot be calibrated."""
    folder = write_fleet(tmp_path_factory.mktemp('recorded'), ROBOTS, DATES)
    (folder / 'robot_0' / 'bad.csv').write_text('nothing of use\n')
    return folder


@pytest.fixture(scope='module')
def undisturbed(recorded: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[str, Any]:
    """Return the results of one run."""
    results = tmp_path_factory.mktemp('undisturbed')
    with cluster(workers=2) as client:
        summary = run(client, found_in(recorded), QUICK, Store(results))
    assert summary.counts == {'ok': COUNT - 1, 'error': 1}
    found = state_of(results)
    assert len(found['rows']) == len(found['done']) == COUNT
    assert len(found['texts']) == COUNT - 1
    return found


def command(recorded: Path | str, results: Path, *more: str) -> list[str]:
    return [sys.executable, '-m', 'accel_calib.cli.main', 'fleet', str(recorded), '-o',
            str(results), '--no-refine', '--workers', '2', *more]


def counted(results: Path, pattern: str) -> Callable[[], int]:
    return lambda: sum(1 for _ in results.glob(pattern))


@pytest.fixture
def started() -> Iterator[Callable[[list[str]], subprocess.Popen[bytes]]]:
    """Yield a function that starts a program in a session of its own; what is left is killed."""
    running = []

    def start(words: list[str]) -> subprocess.Popen[bytes]:
        running.append(subprocess.Popen(words, start_new_session=True, stdout=subprocess.DEVNULL,
                                        stderr=subprocess.DEVNULL))
        return running[-1]

    yield start
    for process in running:
        try:
            os.killpg(process.pid, signal.SIGKILL)
        except ProcessLookupError:
            continue
        process.wait()


def test_a_program_killed_at_any_stage_loses_and_doubles_nothing(
        recorded: Path, undisturbed: dict[str, Any], tmp_path: Path,
        started: Callable[[list[str]], subprocess.Popen[bytes]]) -> None:
    results = tmp_path / 'out'
    stages = [('pending/*/*.json', 2), ('pending/*/*.json', COUNT - 2),
              ('recordings/*/data.parquet', 2), ('sensors.parquet', 1)]
    killed = 0
    for pattern, enough in stages:
        program, count = started(command(recorded, results)), counted(results, pattern)
        while program.poll() is None and count() < enough:
            time.sleep(0.001)
        program.kill()
        killed += program.wait() == -signal.SIGKILL
    assert killed >= 3  # the last one may have been done
    assert started(command(recorded, results)).wait() == 0
    assert state_of(results) == undisturbed


def test_a_full_disk_stops_the_run_with_one_line_and_the_next_run_completes_it(
        recorded: Path, undisturbed: dict[str, Any], tmp_path: Path) -> None:
    if subprocess.run(['unshare', '-r', '-m', 'true'], check=False).returncode:
        pytest.skip('this user may not mount a file system')
    results, kept = tmp_path / 'out', tmp_path / 'kept'
    results.mkdir()
    kept.mkdir()
    (tmp_path / 'script').write_text(
        f'set -e; mount -t tmpfs -o size={FULL_KB}k tmpfs "{results}"\n'
        '"$@" >/dev/null 2>"$0.full" && exit 7\n'
        f'cp -r "{results}/." "{kept}"; mount -o remount,size=64m "{results}"\n'
        f'"$@" --json "$0.json" >/dev/null; rm -r "{kept}"; cp -r "{results}" "{kept}"\n')
    done = subprocess.run(['unshare', '-r', '-m', 'bash', str(tmp_path / 'script'),
                           *command(recorded, results)], check=False, capture_output=True,
                          text=True)
    assert done.returncode == 0, done.stderr
    (line,) = (tmp_path / 'script.full').read_text().splitlines()
    assert 'No space left on device' in line
    assert sum(json.loads((tmp_path / 'script.json').read_text())[name]
               for name in ('ok', 'error', 'skipped')) == COUNT
    assert state_of(kept) == undisturbed


def deadly(name: str) -> str:
    """Kill the worker at one of the items."""
    if name == 'deadly':
        os.kill(os.getpid(), signal.SIGKILL)
    return name


def test_of_recordings_that_share_a_task_only_the_deadly_one_fails() -> None:
    dask, distributed = pytest.importorskip('dask'), pytest.importorskip('distributed')
    items = [*map(str, range(30)), 'deadly', *map(str, range(30, 40))]
    with dask.config.set({'distributed.scheduler.allowed-failures': 1}), \
            cluster(workers=2) as client:
        found = dict(mapped(client, deadly, items))
    assert isinstance(found.pop('deadly'), distributed.KilledWorker)
    assert found == {name: name for name in items if name != 'deadly'}


def test_recordings_are_read_from_a_store_of_s3(
        recorded: Path, undisturbed: dict[str, Any], tmp_path: Path,
        monkeypatch: pytest.MonkeyPatch) -> None:
    server_of = pytest.importorskip('moto.server')
    s3fs = pytest.importorskip('s3fs')
    for name, value in {'ACCESS_KEY_ID': 'key', 'SECRET_ACCESS_KEY': 'secret',
                        'DEFAULT_REGION': 'us-east-1'}.items():
        monkeypatch.setenv(f'AWS_{name}', value)
    server = server_of.ThreadedMotoServer(ip_address='127.0.0.1', port=0)
    server.start()
    try:
        host, port = server.get_host_and_port()
        monkeypatch.setenv('AWS_ENDPOINT_URL', f'http://{host}:{port}')
        store = s3fs.S3FileSystem(skip_instance_cache=True)
        store.mkdir('fleet')
        store.put(f'{recorded}/', 'fleet/recorded/', recursive=True)
        asked = command('s3://fleet/recorded/robot_*', tmp_path / 'out')
        done = subprocess.run(asked, check=False, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert 'could not be read, 0 skipped' in done.stdout
        again = subprocess.run(command('s3://fleet/nothing/', tmp_path / 'out'), check=False,
                               capture_output=True, text=True)
    finally:
        server.stop()
    assert again.returncode == 2
    assert 's3://fleet/nothing/ holds no recording' in again.stderr
    rows = {row['recording']: row for row in rows_of(tmp_path / 'out')}
    local = {row['recording']: row for row in undisturbed['rows']}
    assert len(rows) == COUNT
    for name, row in rows.items():
        same = local[name.replace('s3://fleet/recorded', str(recorded))]
        assert [row[key] for key in ('content', 'sensor', 'status', 'offset.x')] == [
            same[key] for key in ('content', 'sensor', 'status', 'offset.x')]
