# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Whatever is in place of the stored files, the calibrator starts, says so, and works."""

from collections.abc import Callable, Iterator
import os
from pathlib import Path
import re
import shutil
import stat
import tempfile
from typing import Any

from accel_calib.errors import InputError, StoredCalibrationError
from accel_calib.finding import Level
from accel_calib.session import CalibratorSettings
from accel_calib.stored import read_calibration
from inside import aside, MOST_BYTES, SensorFiles, SensorStore, spread_directions, store_of
import numpy as np
import pytest
from shared import Readings, Stored
from test_session import Driver

NOBODY = 65534
IDENTITY = 'imu_link', '/imu/data_raw'


@pytest.fixture
def folder() -> Iterator[Path]:
    """Yield a folder of a user who cannot read everything, unlike root."""
    as_root, made = os.geteuid() == 0, Path(tempfile.mkdtemp())
    if as_root:
        os.chown(made, NOBODY, NOBODY)
        os.seteuid(NOBODY)
    yield made
    if as_root:
        os.seteuid(0)
    made.chmod(0o700)
    shutil.rmtree(made)


def replace_by(make: Callable[[Path], object]) -> Callable[[Path], object]:
    """Return a function that removes a file and makes something else in its place."""
    def replaced(path: Path) -> None:
        path.unlink()
        make(path)

    return replaced


def fill_folder(path: Path) -> None:
    path.mkdir()
    (path / 'mine').write_text('kept')


def impossible(largest: float) -> Callable[[Path], object]:
    """Return a function that writes readings, deviations and counts of any size up to this."""
    rows = [f'{reading},{std},{std},{std},{count}\n'
            for reading in (f'{largest},0,0', f'0,-{largest},0', '1e-320,0,0', '0,0,0', '0,0,9e15')
            for std, count in ((0, 1), (largest, 1.0 / largest), (1.0 / largest, largest))]
    return lambda path: path.write_text('ax,ay,az,std_x,std_y,std_z,count\n' + ''.join(rows))


DAMAGE: dict[str, Callable[[Path], object]] = {
    'bytes': lambda path: path.write_bytes(np.random.default_rng(1).bytes(4096)),
    'folder': replace_by(fill_folder),
    'pipe': replace_by(os.mkfifo),
    'link_to_nothing': replace_by(lambda path: path.symlink_to('nothing')),
}
OF_CALIBRATION: dict[str, Callable[[Path], object]] = {
    **DAMAGE,
    'link_to_itself': replace_by(lambda path: path.symlink_to(path.name)),
    'link_to_device': replace_by(lambda path: path.symlink_to('/dev/null')),
    'cut': lambda path: os.truncate(path, path.stat().st_size // 2),
    'absurd': lambda path: path.write_text(re.sub(
        r'x: -?0\.\d+', 'x: 7.5', path.read_text(), count=1)),
    'newer': lambda path: path.write_text('format: accel_calib calibration\nversion: 99\n'),
}
OF_POSES: dict[str, Callable[[Path], object]] = {
    **DAMAGE,
    'not_finite': lambda path: path.write_text('ax,ay,az\n1,2,nan\n'),
    'too_long': lambda path: os.truncate(path, MOST_BYTES + 1),
    'huge': impossible(1e300), 'large': impossible(1e29),
}


@pytest.fixture
def store(stored: Stored) -> SensorStore:
    """Return a store with a calibration and 12 poses."""
    made = SensorStore(stored(sensor='imu_link'), *IDENTITY, 'm/s2')
    made.save_poses(read_calibration(made.calibration).poses.take(slice(0, 12)))
    return made


def kept(path: Path) -> str:
    """Return what is stored at a path, without following a link."""
    mode = path.lstat().st_mode
    if stat.S_ISLNK(mode):
        return f'link to {os.readlink(path)}'
    if stat.S_ISDIR(mode):
        return f'folder of {sorted(each.name for each in path.iterdir())}'
    if stat.S_ISREG(mode):
        return f'{path.stat().st_size} bytes: {path.read_bytes()[:9999]!r}'
    return f'kind {stat.S_IFMT(mode)}'


def works(path: Path, readings: Readings) -> None:
    """Check that a calibrator starts, fits and stores, and that the next one uses the result."""
    driver = Driver(calibration_file=str(path))
    driver.feed(readings(spread_directions(10)))
    assert driver.ask('fit')
    driver.session.close()
    after = Driver(calibration_file=str(path))
    after.feed(readings([[0, 0, 1]])[:10])
    assert after.session.sensor.calibration is not None
    assert len(after.session.sensor.live.poses()) >= 10
    assert not after.logged()
    after.session.close()


@pytest.mark.parametrize(('which', 'damage'), [
    *(('calibration', damage) for damage in OF_CALIBRATION),
    *(('poses', damage) for damage in OF_POSES)])
def test_whatever_is_in_place_of_a_file_is_kept_and_replaced(
        which: str, damage: str, store: SensorStore, readings: Readings) -> None:
    of_poses = which == 'poses'
    path = store.poses if of_poses else store.calibration
    (OF_POSES if of_poses else OF_CALIBRATION)[damage](path)
    found = kept(path)
    driver = Driver(calibration_file=str(store.calibration))
    assert path.name in driver.logged()
    assert (driver.session.sensor.calibration is not None) is of_poses
    assert len(driver.session.sensor.live.poses()) == (0 if of_poses else 12)
    driver.session.close()
    works(store.calibration, readings)
    assert found in [kept(each) for each in store.calibration.parent.iterdir()]


def works_without_storing(path: Path, readings: Readings) -> tuple[str, Level]:
    """Check that a calibrator uses a fit that it cannot store; return log and level."""
    driver = Driver(calibration_file=str(path))
    said = driver.logged()
    driver.feed(readings(spread_directions(10)))
    level = driver.finding('storage').level
    with pytest.raises(InputError, match='in use but could not be stored.*another calibration_'):
        driver.ask('fit')
    assert driver.session.sensor.calibration is not None
    driver.session.close()
    return said, level


def make_device(path: Path) -> None:
    try:
        os.mknod(path, stat.S_IFCHR | 0o666, os.makedev(1, 3))
    except PermissionError:
        pytest.skip('only root makes devices')


@pytest.mark.parametrize(('make', 'kind'), [
    (make_device, 'a character device'), (fill_folder, 'a folder')])
def test_what_does_not_look_like_a_file_is_never_renamed_or_replaced(
        make: Callable[[Path], object], kind: str, tmp_path: Path, readings: Readings) -> None:
    path = tmp_path / 'documents'
    make(path)
    before = kept(path)
    assert f'{path} is {kind}' in works_without_storing(path, readings)[0]
    assert kept(path) == before


# Rights


def test_files_that_nobody_may_read_are_kept_and_replaced(folder: Path, readings: Readings
                                                          ) -> None:
    store = SensorStore(folder / 'imu.yaml', *IDENTITY, 'm/s2')
    for path in (store.calibration, store.poses):
        path.write_text('secret')
        path.chmod(0)
    driver = Driver(calibration_file=str(store.calibration))
    assert driver.logged().count('Permission denied') == 2
    driver.session.close()
    works(store.calibration, readings)
    others = sorted(each.name for each in folder.iterdir() if not each.stat().st_mode & 0o777)
    assert others == ['imu.yaml.other1', 'imu_poses.csv.damaged1']


@pytest.mark.parametrize('mode', [0, 0o500, 0o600])
def test_a_folder_without_rights_is_reported_and_nothing_is_lost(
        mode: int, folder: Path, readings: Readings) -> None:
    inner = folder / 'inner'
    inner.mkdir()
    (inner / '.imu.yaml.123.tmp').write_text('left behind')
    (inner / 'imu_poses.csv').write_text('ax,ay,az\n1,2,words\n')
    inner.chmod(mode)
    _, level = works_without_storing(inner / 'imu.yaml', readings)
    assert level == 'BAD'
    inner.chmod(0o700)
    assert (inner / 'imu_poses.csv').read_text() == 'ax,ay,az\n1,2,words\n'


# Places


@pytest.mark.parametrize('name', ['file/imu.yaml', f'{"x" * 300}.yaml', 'loop/imu.yaml'])
def test_a_path_that_no_file_can_have_is_reported(name: str, tmp_path: Path, readings: Readings
                                                  ) -> None:
    (tmp_path / 'file').touch()
    (tmp_path / 'loop').symlink_to('loop')
    _, level = works_without_storing(tmp_path / name, readings)
    assert level == 'BAD'


def test_a_home_that_is_not_known_is_refused_in_one_line() -> None:
    with pytest.raises(InputError, match='has no home folder; state the whole path'):
        store_of(CalibratorSettings(calibration_file='~nobody_has_this_name/imu.yaml'), *IDENTITY)


# Lock and steps


@pytest.mark.parametrize('make', [
    Path.mkdir, os.mkfifo, lambda path: path.symlink_to(path.with_name('precious')),
    lambda path: os.mknod(path, stat.S_IFSOCK | 0o600)])
def test_whatever_is_in_place_of_the_lock_is_left_as_it_is(
        make: Callable[[Path], object], store: SensorStore) -> None:
    precious = store.calibration.with_name('precious')
    precious.write_text('kept')
    lock = store.calibration.with_name('known.lock')
    make(lock)
    before = kept(lock)
    SensorFiles(store).take().release()
    assert kept(lock) == before
    assert precious.read_text() == 'kept'
    assert Driver(calibration_file=str(store.calibration)).session.sensor.calibration


def test_undo_passes_over_what_is_not_a_step(store: SensorStore) -> None:
    text = store.calibration.read_text()
    step = store.calibration.with_name('known.yaml.before1')
    step.write_text(text.replace('date: ', 'date: 2025 # '))
    with pytest.raises(StoredCalibrationError, match='before1 is damaged .*before1.damaged1; try'):
        store.step_back()
    step.write_text(text.replace("date: '2026", "date: '2025"))
    os.mkfifo(step.with_name('known.yaml.before2'))
    step.with_name('known.yaml.before3').mkdir()
    step.with_name('known.yaml.before٤').write_text('not a number of ours')
    step.with_name('known.yaml.before05').write_text('nor this one')
    assert list(store.steps()) == [1]
    back = store.step_back()
    assert back is not None
    assert back.date.startswith('2025')
    undone = read_calibration(store.calibration.with_name('known.yaml.undone1'))
    store.write(store.prepared(undone))
    assert list(store.steps()) == [4]


@pytest.mark.parametrize(('broken', 'file_of'), [('yaml.parse', 'known.yaml'),
                                                 ('numpy.loadtxt', 'known_poses.csv')])
def test_an_error_that_nobody_expected_does_not_stop_the_calibrator(
        broken: str, file_of: str, store: SensorStore, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*given: Any, **options: Any) -> None:
        raise ZeroDivisionError(broken)

    monkeypatch.setattr(broken, fail)
    driver = Driver(calibration_file=str(store.calibration))
    assert f'ZeroDivisionError: {broken}' in driver.logged()
    assert f'{store.calibration.with_name(file_of)}.damaged1' in driver.logged()
    file = driver.logged().split('with the file ')[1].split(';')[0]
    assert 'Traceback' in Path(file).read_text()
    Path(file).unlink()


def test_things_are_renamed_without_replacing_others(tmp_path: Path) -> None:
    (tmp_path / 'a.yaml').write_text('new')
    (tmp_path / 'a.yaml.damaged1').symlink_to('nothing')
    assert aside(tmp_path / 'a.yaml', 'damaged').name == 'a.yaml.damaged2'
    assert (tmp_path / 'a.yaml.damaged1').is_symlink()
    with pytest.raises(FileNotFoundError):
        aside(tmp_path / 'a.yaml', 'damaged')
