# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The command line: results, JSON, one line for invalid input, and one command from any log."""

from dataclasses import fields, replace
import json
from pathlib import Path
import re
import shutil
import sys

import accel_calib as ac
from accel_calib.disk import write_atomically
from accel_calib.errors import RefusedFitError
from accel_calib.logs import write_table
from accel_calib.stillness import CaptureSettings
from accel_calib.stored import read_calibration
from faults.sample import sample
from inside import (
    are_samples, calibrated_by, CALIBRATOR, COMMAND, COMMANDS, FitPlan, is_partial, main, parser,
    rotation_from_rpy, spread_directions)
import numpy as np
import pytest
from shared import (
    data, forked, LOG_CORPUS, LOGS, MPS2, OPTIONS, python, random_directions, refused, run,
    run_json, run_on_small_disk, SENSOR, table)


@pytest.fixture(scope='module')
def made(tmp_path_factory):
    """Return a folder with poses and their calibration."""
    folder = tmp_path_factory.mktemp('made')
    poses = folder / 'poses.csv'
    assert run('simulate', '-o', poses, *OPTIONS, '--poses', 24) == 0
    assert run('fit', poses, '-o', folder / 'calibration.yaml', '--sensor', 'imu_link') == 0
    return folder


@pytest.fixture
def poses(made, tmp_path):
    return Path(shutil.copy(made / 'poses.csv', tmp_path))


@pytest.fixture
def calibration(poses, made, tmp_path):
    return Path(shutil.copy(made / 'calibration.yaml', tmp_path))


def test_flat_row_is_levelled_even_when_it_is_not_fitted(tmp_path, capsys):
    path = tmp_path / 'poses.csv'
    run('simulate', '-o', path, *OPTIONS, '--mounting', 20, -30, 0, '--poses', 30)
    status, result = run_json(capsys, 'fit', path, '--rows', '2:30', '--flat', 1)
    assert (status, result['poses_used']) == (0, 29)
    expected = rotation_from_rpy(*np.radians((20, -30, 0)))[2]
    np.testing.assert_allclose(np.array(result['rotation'])[:, 2], expected, atol=2e-3)


def test_several_tables_return_a_list_in_their_order(tmp_path, capsys):
    folder = tmp_path / 'out'
    tables = [tmp_path / f'{name}.csv' for name in ('0', 'bad', '1', '2')]
    for seed, path in enumerate(tables):
        run('simulate', '-o', path, *OPTIONS, '--seed', seed)
    tables[1].write_text('ax,ay\n1,2\n')
    folder.mkdir()
    status, results = run_json(capsys, 'fit', *tables, '-o', folder)
    assert status == 2
    assert [result['file'] for result in results] == [str(path) for path in tables]
    assert sorted(path.name for path in folder.iterdir()) == ['0.yaml', '1.yaml', '2.yaml']
    status, results = run_json(capsys, 'verify', *tables[2:], '-c', folder / '0.yaml')
    assert status == 0
    assert all(result['rms_after_mg'] < 1 for result in results)
    assert run_json(capsys, 'verify', *tables[2:], '-c', folder / '0.yaml', '--jobs', 2) == (
        status, results)
    status, results = run_json(capsys, 'refine', *tables, '-o', folder)
    assert status == 2
    assert [result.get('verdict') for result in results] == ['no_gap', None, 'no_gap', 'no_gap']
    assert set(results[1]) == {'file', 'error', 'advice'}


@pytest.mark.parametrize(('command', 'kind'), [
    ('fit', 'poses'), ('refine', 'poses'), ('calibrate', 'poses'), ('fit', 'recording'),
    ('refine', 'recording'), ('calibrate', 'recording'), ('verify', 'recording')])
def test_a_refusal_says_how_the_log_was_read(command, kind, calibration, tmp_path, capsys):
    log, count = tmp_path / 'log.csv', 2 if kind == 'poses' else 500
    columns = np.column_stack([0.01 * np.arange(count),
                               np.random.default_rng(1).normal(size=(count, 3))])
    without_time = kind == 'poses'
    np.savetxt(log, columns[:, without_time:], fmt='%.4f', delimiter=',', comments='',
               header='time,ax[g],ay[g],az[g]'[5 * without_time:])
    more = {'calibrate': ('-o', tmp_path / 'c.yaml'), 'verify': ('-c', calibration)}
    arguments = command, log, *more.get(command, ())
    status, result = run_json(capsys, *arguments)
    assert status == 2
    assert 'ax' in result['read_as']
    assert run(*arguments) == 2
    assert capsys.readouterr().out == f'read as: {result["read_as"]}\n'
    refused(capsys, *arguments)


@pytest.mark.parametrize('closed', [(1,), (2,), (0,), (0, 1, 2)])
@pytest.mark.parametrize('command', ['fit poses.csv -o new.yaml', 'fit missing.csv'])
def test_closed_streams_change_no_exit_status_and_no_file(closed, command, poses, tmp_path):
    done = forked(*command.split(), folder=tmp_path, closed=closed)
    assert done.returncode == (2 if 'missing' in command else 0), done.stderr
    assert done.stderr.count('\n') == ('missing' in command and 2 not in closed)
    assert ('missing' in command) is not (tmp_path / 'new.yaml').exists()


def test_a_name_that_is_not_utf_8_is_refused_in_one_line(poses, tmp_path):
    for command in ('fit', 'calibrate'):
        done = forked(command, poses, '-o', 'new.yaml', '--sensor', 'a\udcff', folder=tmp_path)
        assert done.returncode == 2
        assert done.stderr.count('\n') == 1
    assert not (tmp_path / 'new.yaml').exists()


INTERRUPTED = """
import atexit, runpy, signal, sys
signal.signal(signal.SIGINT, signal.{handler})  # a shell lets background commands ignore it


def interrupt(event, about):
    if event == 'import' and about[0] == {name!r}:
        signal.raise_signal(signal.SIGINT)
sys.addaudithook(interrupt)
if {name!r} == 'the end':  # the last handler is called first, before Python has ended anything
    atexit.register(signal.raise_signal, signal.SIGINT)
sys.argv = ['accel-calib', 'fit', {poses!r}]
runpy.run_module({module!r}, run_name='__main__')
"""


@pytest.mark.parametrize(('name', 'handler', 'status'), [
    *((name, 'default_int_handler', 130) for name in sample((
        'argparse', 'accel_calib.errors', 'numpy', 'numpy.linalg._umath_linalg', 'rich.console',
        'scipy.special._ufuncs'), 3)),
    ('rich.console', 'SIG_IGN', 0), ('the end', 'default_int_handler', 0)])
def test_ctrl_c_while_modules_load_ends_without_words_and_changes_nothing_later_or_if_ignored(
        name, handler, status, poses):
    done = python('-c', INTERRUPTED.format(
        name=name, handler=handler, poses=str(poses), module=COMMAND[1]))
    assert (done.returncode, done.stderr) == (status, '')
    assert not done.stdout if status else 'Residual' in done.stdout


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_has_help_with_an_example(command, capsys):
    with pytest.raises(SystemExit, match='0'):
        main([command, '--help'])
    assert f'example:\n  accel-calib {command}' in capsys.readouterr().out


@pytest.mark.parametrize(('arguments', 'without'), [
    (['--help'], ['numpy', 'yaml', 'rich', 'jinja2']), (['fly'], ['numpy']),
    (['fit', '{poses}'], ['matplotlib', 'rosbags', 'jinja2', 'accel_calib.refinement',
                          'accel_calib.report'])])
def test_only_what_is_used_is_imported(arguments, without, poses):
    code = (f'import sys\nfrom {main.__module__} import main\n'
            'try:\n    main()\nexcept SystemExit:\n    pass\n'
            'print(*sys.modules, file=sys.stderr)\n'
            'import warnings; warnings.warn("by numpy", RuntimeWarning)')
    done = python('-c', code, *(argument.format(poses=poses) for argument in arguments))
    assert ('noise floor' in done.stdout) is (arguments[0] == 'fit')
    assert not {*without, 'RuntimeWarning:'} & set(done.stderr.split())
    assert main.__module__ in done.stderr.split()


@pytest.mark.parametrize('command', [[*COMMAND, 'fit', 'poses.csv'], CALIBRATOR])
@pytest.mark.parametrize(('given', 'threads'), [('', 1), ('2', 2)])
def test_numpy_is_imported_with_one_thread_unless_another_number_is_set(command, given, threads):
    if command is CALIBRATOR:
        pytest.importorskip('rclpy')
    code = ('import os, runpy, sys\n'
            f'if not {given!r}:\n    del os.environ["OPENBLAS_NUM_THREADS"]\n'
            'class Seen:\n'
            '    def find_spec(self, name, *rest):\n'
            '        if name == "numpy":\n'
            '            os._exit(int(os.environ.get("OPENBLAS_NUM_THREADS", "9")))\n'
            f'sys.meta_path.insert(0, Seen())\nsys.argv = {[*command[1:]]!r}\n'
            f'runpy.run_module({command[1]!r}, run_name="__main__")')
    assert python('-c', code, OPENBLAS_NUM_THREADS=given).returncode == threads


def test_files_of_the_current_folder_are_never_run(tmp_path):
    for name in ('one.csv', 'two.csv'):
        run('simulate', '-o', tmp_path / name)
    for name in ('pickle', 'numpy', 'multiprocessing', 'select', 'queue', 'accel_calib'):
        (tmp_path / f'{name}.py').write_text('open("run", "w").close()\nraise SystemExit(9)\n')
    code = ('import sys; sys.path[:] = filter(None, sys.path)\n'
            f'from {main.__module__} import main; sys.exit(main())')
    done = python('-c', code, 'fit', 'one.csv', 'two.csv', '--jobs', 2, '--json', '-',
                  folder=tmp_path)
    assert done.returncode == 0, done.stderr
    assert [each['rating'] for each in json.loads(done.stdout)] == ['GOOD', 'GOOD']
    assert not (tmp_path / 'run').exists()


def test_a_defect_is_one_line_with_the_details_in_a_file(tmp_path, monkeypatch, capsys):
    def break_(*given, **options):
        raise ValueError('of two\nlines')

    monkeypatch.setattr('numpy.random.default_rng', break_)
    monkeypatch.setattr('tempfile.tempdir', str(tmp_path))
    assert run('simulate', '-o', tmp_path / 'x.csv') == 2
    error = capsys.readouterr().err
    assert error.startswith('accel-calib simulate: internal error: ValueError: of two lines; ')
    assert error.count('\n') == 1
    details, = tmp_path.glob('accel_calib-*.txt')
    assert str(details) in error
    assert 'Traceback' in details.read_text(encoding='utf-8')


def test_the_report_has_a_page_and_figures(poses, tmp_path):
    pytest.importorskip('matplotlib')
    page, folder = tmp_path / 'r.html', tmp_path / 'figures'
    assert run('report', poses, '-o', page, '--figures', folder) == 0
    assert page.read_text().startswith('<!DOCTYPE html>')
    names = {path.name for path in folder.iterdir()}
    assert {'ladder.svg', 'ladder.png', 'remaining_sphere.png'} <= names
    assert run('refine', poses, '-o', tmp_path / 'mine.yaml', '--report', page) == 0
    assert {*re.findall(r'\w+\.yaml', page.read_text())} == {'mine.yaml'}


@pytest.mark.parametrize(('module', 'line'), [
    ('matplotlib', 'refine poses.csv --report r.html'), ('aiohttp', 'live poses.csv'),
    ('allantools', 'noise poses.csv'), ('pyulog', f'capture {LOGS}/px4/default.ulg -o p.csv'),
    ('pymavlink', f'capture {LOGS}/ardupilot/two_imus.bin -o p.csv'),
    *((module, f'capture {next((LOG_CORPUS / "formats").glob(f"*{suffix}"))} -o p.csv')
      for module, suffix in (('h5py', '.h5'), ('pyarrow', '.feather')))])
def test_a_missing_library_is_named_in_one_line_with_how_to_install_it(module, line, poses, capsys,
                                                                       monkeypatch):
    monkeypatch.chdir(poses.parent)
    monkeypatch.setitem(sys.modules, module, None)
    assert f'pip install {module.partition(".")[0]}' in refused(capsys, *line.split())
    assert [*poses.parent.iterdir()] == [poses]
    assert run('refine', poses) == 0


# --------------------------------------------------------------------- settings of the capture


def shaky(path, quiet, shaken, std_g=0.012):
    """Write a recording whose first rests are quiet, and whose other rests are shaken."""
    rng = np.random.default_rng(3)
    rest, turn, rows = 250, 80, []
    ups = spread_directions(quiet + shaken)
    for k, (up, following) in enumerate(zip(ups, np.roll(ups, -1, axis=0))):
        shaking = std_g * np.sin(2 * np.pi * 31.0 * np.arange(rest) / 100.0)[:, np.newaxis]
        rows += [up + (shaking if k >= quiet else 0.0) * np.ones((rest, 3)),
                 np.linspace(up, following, turn)]
    readings = np.concatenate(rows) + rng.normal(0.0, 5e-4, ((rest + turn) * len(ups), 3))
    np.savetxt(path, np.column_stack([np.arange(len(readings)) / 100.0, readings]), fmt='%.5f',
               delimiter=',', header='# units: "g"\ntime,ax,ay,az', comments='')
    return path


@pytest.mark.parametrize('line', table('capturing_commands'))
def test_every_command_that_captures_has_all_settings_of_the_capture(line):
    assert {each.name for each in fields(CaptureSettings)} <= vars(
        parser(line.split()).parse_args(line.split())).keys()


@pytest.mark.parametrize(('quiet', 'given', 'stated'), [
    (3, (), r'(\d) poses only'),
    (0, ('--still-std-max', 0.004), r'0.5 s the standard deviation is (\S+) g, the limit is')])
def test_a_wider_limit_that_finds_many_more_poses_is_stated_and_can_be_used(
        quiet, given, stated, tmp_path, capsys):
    log = shaky(tmp_path / 'log.csv', quiet, 12 - quiet)
    assert run('calibrate', log, '-o', tmp_path / 'c.yaml', *given) == 2
    words = ' '.join(''.join(capsys.readouterr()).split())
    (many, limit), = re.findall(r'(\d+) with still_std_max (\d\S*\d)', words)
    assert int(many) >= 6
    assert float(*re.findall(stated, words)) == pytest.approx(
        quiet or 0.012 / np.sqrt(2.0), rel=0.1)
    run('capture', log, '-o', tmp_path / 'p.csv', '--still-std-max', limit)
    assert f'captured {many} poses from' in capsys.readouterr().out


# One command from any log to a calibration, a page and a verdict


@pytest.fixture
def recording(tmp_path):
    path = tmp_path / 'log.csv'
    assert run('simulate', '-o', path, '--recording', '--poses', 14, '--dwell', 3, *OPTIONS,
               '--mounting', 5, -3, 0) == 0
    return path


def bent(path, *, bend_mg):
    """Write poses of a sensor whose readings are far from an ellipsoid, without their noise."""
    up = random_directions(40, np.random.default_rng(5))
    rough = np.sign(np.sin(9.0 * up[:, :1])) * bend_mg * 1e-3
    np.savetxt(path, 9.80665 * up * (1.0 + rough), delimiter=',', header='ax,ay,az', comments='')
    return path


@pytest.mark.parametrize('command', ['calibrate', 'fit', 'refine'])
def test_a_bad_calibration_is_not_stored_unless_asked_for(command, tmp_path, capsys):
    path, out = bent(tmp_path / 'poses.csv', bend_mg=40.0), tmp_path / 'c.yaml'
    for more in ((), ('--keep-bad',)):
        status, result = run_json(capsys, command, path, '-o', out, *more)
        assert (status, result['rating'], out.exists()) == (1, 'BAD', bool(more))
        assert out.with_suffix('.html').exists() is (command == 'calibrate')
    status, result = run_json(capsys, 'verify', path, '-c', out)
    assert (status, result['rating']) == (1, 'BAD')


def test_what_the_gate_refuses_is_never_stored(tmp_path, capsys):
    path, out = bent(tmp_path / 'poses.csv', bend_mg=150.0), tmp_path / 'c.yaml'
    status, result = run_json(capsys, 'calibrate', path, '-o', out, '--keep-bad')
    assert (status, {*result}, out.exists()) == (2, {'file', 'error', 'advice'}, False)


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize(('flat', 'row'), [('last', 13), ('3', 2)])
def test_the_flat_pose_is_the_first_the_last_or_a_row(flat, row, recording, tmp_path, capsys):
    out = tmp_path / 'c.yaml'
    run_json(capsys, 'calibrate', recording, '-o', out, '--flat', flat, '--no-refine')
    stored = read_calibration(out)
    np.testing.assert_allclose(stored.apply(stored.poses.reading[row]), (0, 0, 9.80665), atol=0.05)


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize('name', ['xsens_mti_counts', 'mpu9150_imu1'])
def test_real_logs_become_good_calibrations_without_an_option(name, tmp_path, capsys):
    status, result = run_json(capsys, 'calibrate', data(f'{name}.csv'), '-o', tmp_path / 'c.yaml',
                              '--no-refine')
    assert (status, result['rating']) == (0, 'GOOD')
    assert result['units'] == ('native' if name.startswith('xsens') else 'm/s2')
    assert result['rms_after_mg'] <= (0.115 if name.startswith('xsens') else 0.3)  # as imu_tk


@pytest.mark.parametrize(('step', 'rows', 'count', 'samples'), [
    (0.01, 20, {}, True), (20.0, 60, {}, False), (0.1, 60, {'count': np.ones(60)}, False),
    (10.0, 6000, {}, True)])
def test_samples_are_distinguished_from_poses(step, rows, count, samples):
    columns = {'time': np.arange(rows) * step, 'reading': np.ones((rows, 3)), **count}
    assert are_samples(columns) == samples


@pytest.mark.parametrize(('per_g', 'unit'), [(1000.0, 'g'), (1024.0, 'native')])
def test_whole_numbers_are_mg_only_where_1_g_is_about_1000(per_g, unit, tmp_path):
    made = ac.simulate({}, recording=True, poses=10, units='g')
    np.savetxt(tmp_path / 'log.csv', np.column_stack([made['time'], np.round(
        per_g * made.reading)]), delimiter=',', header='time,ax,ay,az', comments='')
    assert ac.capture(tmp_path / 'log.csv').units == unit


@pytest.mark.parametrize(('size_kb', 'status', 'left'), [(64, 0, ['c.yaml']), (4, 2, [])])
@pytest.mark.parametrize('command', ['calibrate', 'fit'])
def test_a_page_or_calibration_that_does_not_fit_on_the_disk_is_one_line(
        command, size_kb, status, left, recording, tmp_path):
    disk = tmp_path / 'disk'
    more = {'calibrate': ['--no-refine'], 'fit': ['--report', disk / 'c.html']}[command]
    done, copy = run_on_small_disk(disk, size_kb, command, recording, '-o', disk / 'c.yaml', *more)
    assert (done.returncode, done.stderr.count('\n')) == (status, 1 if status else 0)
    assert 'No space left' in (done.stderr if status else done.stdout)
    assert [each.name for each in copy.iterdir()] == left
    assert all(read_calibration(copy / name).name for name in left)


def test_an_error_of_the_disk_names_the_file_that_is_asked_for(tmp_path):
    with pytest.raises(FileNotFoundError) as error:  # as on a disk that is read-only
        write_atomically(Path('/proc/c.yaml'), lambda file: None)
    assert error.value.filename == '/proc/c.yaml'
    poses, disk = tmp_path / 'poses.csv', tmp_path / 'disk'
    write_table(poses, ac.simulate({'quadratic': 0.01}, poses=24))
    done, copy = run_on_small_disk(disk, 64, 'report', poses, '-o', tmp_path / 'page.html',
                                   '--figures', disk / 'figures')
    assert f'report: {disk}/figures/' in done.stderr
    assert all(each.read_bytes().endswith((b'</svg>\n', b'IEND\xaeB`\x82'))
               for each in (copy / 'figures').iterdir())


# The plan of a fit beside a calibration that is in use

PLAN = FitPlan(model='10', refined=False)


def test_frame_and_mounting_of_the_calibration_in_use_are_kept() -> None:
    first, second = (ac.simulate(SENSOR, poses=16, seed=seed) for seed in (1, 2))
    assert not calibrated_by(second, MPS2, PLAN).calibration.is_levelled
    before = calibrated_by(first, MPS2, replace(PLAN, flat=3, frame='android')).calibration
    after = calibrated_by(second, MPS2, replace(PLAN, before=before)).calibration
    assert after.frame == before.frame
    np.testing.assert_allclose(after.rotation, before.rotation, atol=1e-3)
    moved = calibrated_by(second, MPS2, replace(PLAN, before=before, flat=5)).calibration
    assert np.max(np.abs(moved.rotation - before.rotation)) > 0.1


def test_poses_near_one_direction_are_fitted_if_planned_and_replace_no_full_fit() -> None:
    tilts = np.array([[0, 0], [0.25, 0], [-0.2, 0.1], [0, 0.25], [0.1, -0.25], [-0.15, -0.2]])
    cone = ac.simulate(SENSOR, directions=np.column_stack([tilts, np.ones(len(tilts))]))
    with pytest.raises(RefusedFitError):
        calibrated_by(cone, MPS2, PLAN)
    partial = calibrated_by(cone, MPS2, replace(PLAN, partial=True)).calibration
    assert is_partial(partial)
    again = calibrated_by(cone, MPS2, replace(PLAN, partial=True, before=partial)).calibration
    assert is_partial(again)
    full = calibrated_by(ac.simulate(SENSOR, poses=16), MPS2, PLAN).calibration
    with pytest.raises(RefusedFitError):
        calibrated_by(cone, MPS2, replace(PLAN, partial=True, before=full))
