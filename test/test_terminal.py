# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Text on terminals of any width and encoding, wrong arguments, and ``accel-calib watch``."""

from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
import io
import json
import math
import os
from pathlib import Path
import pty
import shlex
import subprocess
import sys

import accel_calib as ac
from accel_calib.errors import InputError
from accel_calib.session import Progress
from golden.screens import ENOUGH, FITTED, SEEN, START
from inside import CALIBRATOR, COMMAND, in_one_line, main, Output, shown
import numpy as np
import pytest
from shared import forked, python, random_directions, ROOT, run, run_json, table

SIMULATE = ('simulate', '--recording', '--poses', '14', '--effect', 'offset=0.02,-0.01,0.03', '-o')


@pytest.fixture(scope='module')
def files(tmp_path_factory):
    """Return a folder with a recording, its poses, their calibration, and other poses."""
    folder = tmp_path_factory.mktemp('files')
    for line in ((*SIMULATE, folder / 'r.csv'),
                 ('capture', folder / 'r.csv', '-o', folder / 'p.csv'),
                 ('fit', folder / 'p.csv', '-o', folder / 'stored.yaml'),
                 ('simulate', '-o', folder / 'other.csv', '--effect', 'offset=0.09,-0.01,0.03')):
        assert run(*line) == 0
    return folder


@pytest.mark.usefixtures('without_pages')
@pytest.mark.parametrize('columns', [80, 60])
def test_output_fits_the_width(columns, files, tmp_path, monkeypatch, capsys):
    stored, other, rest = (tmp_path / name for name in ('c.yaml', 'd.yaml', 'rest.csv'))
    run('simulate', '-o', rest, '--recording', '--poses', 1, '--dwell', 600, '--rate', 20)
    capsys.readouterr()
    poses = files / 'p.csv'
    monkeypatch.setenv('COLUMNS', str(columns))
    for arguments in (
            ('fit', poses, '-o', stored), ('calibrate', poses, '-o', other),
            ('history', stored, other), ('export', stored, '--to', 'px4'), ('noise', rest),
            ('refine', poses), ('verify', poses, '-c', stored), ('compare', stored, stored), ()):
        assert run(*arguments) == 0
    text = capsys.readouterr().out
    wide = [line for line in text.splitlines() if len(line) > columns
            and not any(str(path) in line for path in (tmp_path, files))]
    assert len(text.splitlines()) > 100
    assert not wide


@pytest.mark.parametrize('seed', [0, 3])
def test_the_verdict_comes_first_and_then_at_most_five_notes(seed, tmp_path, monkeypatch, capsys):
    rng = np.random.default_rng(seed)
    readings = random_directions(9 + 3 * seed, rng)
    readings += [0.04, 0.0, -0.02]
    readings[seed:2 * seed] *= 1.1
    np.savetxt(tmp_path / 'poses.csv', np.hstack([readings, 0.002 + 0.0 * readings]),
               delimiter=',', header='# units: g\nax,ay,az,std_x,std_y,std_z', comments='')
    monkeypatch.setenv('COLUMNS', '3000')

    def lines_of(*more):
        run('calibrate', tmp_path / 'poses.csv', '-o', tmp_path / 'c.yaml', '--keep-bad', '--json',
            tmp_path / 'c.json', *more)
        return capsys.readouterr().out.splitlines()

    few, every = lines_of(), lines_of('--verbose')
    result = json.loads((tmp_path / 'c.json').read_text())
    assert every[0].startswith(result['rating'])
    head = 1 + max(k for k, line in enumerate(every) if line.startswith(('next', '      accel')))
    assert few[:head] == every[:head]
    notes = few[head:[line.startswith('stored') for line in few].index(True)]
    assert len(notes) <= 5 <= len(every) - head
    texts = [f'note: {each["text"]}' for each in result['findings'][result['rating'] != 'GOOD':]]
    assert notes[:4] == [*texts, *every[head + len(texts):]][:len(notes[:4])]
    assert all(map(str.startswith, every[head:], texts))


@pytest.mark.parametrize('encoding', ['ascii', 'cp1252'])
def test_output_of_an_old_encoding_has_replacements(encoding, files, tmp_path, monkeypatch):
    written = io.BytesIO()
    monkeypatch.setattr(sys, 'stdout', io.TextIOWrapper(written, encoding))
    assert run('fit', files / 'p.csv', '-o', tmp_path / 'c.yaml') == 0
    sys.stdout.flush()
    text = written.getvalue().decode(encoding)
    assert ('+-' if encoding == 'ascii' else '±') in text
    assert '?' not in text


def test_a_long_line_breaks_at_words_and_a_path_stays_whole(monkeypatch):
    monkeypatch.setenv('COLUMNS', '30')
    output = Output()
    output.file = io.StringIO()
    path = '/a/long/path/of/a/calibration/of/one/sensor.yaml'
    output.print(f'the calibration with 12.3 ± 0.4 mg at 31 °C is stored in {path}')
    lines = output.file.getvalue().splitlines()
    assert [line.strip() for line in lines] == [
        'the calibration with', '12.3 ± 0.4 mg at 31 °C is', 'stored in', path]


def test_control_characters_are_escaped():
    assert in_one_line('a\x1b[31m\nb') == 'a\\x1b[31m b'
    assert shown('\x1b[31m', 'utf-8') == '\\x1b[31m'
    assert shown('a ± \udc80', 'ascii') == 'a +- \\udc80'


@pytest.mark.parametrize(('line', 'said'), table('misspelt'))
def test_a_misspelt_name_gets_a_suggestion_in_one_line_and_a_wrong_value_none(line, said, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(line.split())
    error = capsys.readouterr().err
    assert said in error
    assert error.count('\n') == 1


def test_progress_shows_on_a_terminal_from_the_start(tmp_path):
    path, count = tmp_path / 'rest.csv', 50_000
    reading = np.random.default_rng(3).normal((0.1, 0.2, 9.8), 0.02, (count, 3))
    np.savetxt(path, np.column_stack([np.arange(count) / 100.0, reading]), fmt='%.4f',
               delimiter=',', header='time,ax,ay,az', comments='')
    status, shown_text = on_a_terminal('capture', path, '-o', tmp_path / 'p.csv')
    assert status == 0
    assert 'samples' in shown_text


def on_a_terminal(*arguments, **environment):
    """Return the exit status of a command, and its text on a terminal."""
    ours, theirs = pty.openpty()
    with ThreadPoolExecutor(1) as reader, open(ours, 'rb', 0) as terminal:
        text = reader.submit(_all_of, terminal)
        status = forked(*arguments, folder=Path(), terminal=theirs, TERM='xterm',
                        **environment).returncode
        os.close(theirs)
        return status, text.result().decode()


def _all_of(terminal):
    text = b''
    with suppress(OSError):  # the last process has closed it
        while part := terminal.read(1 << 16):
            text += part
    return text


@pytest.mark.parametrize(('line', 'verdict', 'colour'), [
    ('fit p.csv', 'GOOD', 32), ('verify other.csv -c stored.yaml', 'BAD', 31),
    ('fit p.csv p.csv', 'GOOD', 32)])
def test_the_verdict_has_a_colour_on_a_terminal_only(line, verdict, colour, files, capsys,
                                                     monkeypatch):
    monkeypatch.chdir(files)
    monkeypatch.delenv('NO_COLOR', raising=False)
    assert f'\x1b[1;{colour}m{verdict}\x1b[0m' in on_a_terminal(*line.split())[1]
    _, plain = on_a_terminal(*line.split(), NO_COLOR='1')
    assert verdict in plain
    assert f'{colour}m' not in plain
    capsys.readouterr()
    run(*line.split())
    no_terminal = ''.join(capsys.readouterr())
    assert verdict in no_terminal
    assert '\x1b' not in no_terminal


def test_verify_says_why_it_ends_with_1(files, capsys, monkeypatch):
    monkeypatch.setenv('COLUMNS', '300')
    other, limited = files / 'other.csv', ('-c', files / 'stored.yaml', '--max', 5)
    status, found = run_json(capsys, 'verify', other, *limited)
    assert (status, found['max_mg'], found['above_max']) == (1, 5.0, True)
    assert run('verify', files / 'p.csv', *limited) == 0
    assert 'above' not in capsys.readouterr().out
    assert run('verify', files / 'p.csv', other, *limited) == 1
    why = 'mg is above --max 5 mg: exit status 1'
    lines = [line for line in capsys.readouterr().out.splitlines() if why in line]
    assert [line.split(':')[0] for line in lines] == [str(other)]


def piped(line, folder):
    """Run a line of bash with ``accel-calib``, which ends with status 0."""
    program = shlex.join([sys.executable, *COMMAND])
    done = subprocess.run(
        ['bash', '-euc', f'accel-calib() {{ {program} "$@"; }}; {line}'],
        cwd=folder, capture_output=True, text=True, check=False,
        env={**os.environ, 'PYTHONPATH': str(ROOT)})
    assert done.returncode == 0, done.stderr
    return done


def test_a_log_goes_through_pipes(files, tmp_path):
    simulate = f'accel-calib {shlex.join(SIMULATE)} -'
    piped(f'{simulate} | accel-calib capture - -o - | accel-calib fit - -o piped.yaml', tmp_path)
    assert ac.load(tmp_path / 'piped.yaml') == ac.load(files / 'stored.yaml')


def test_logs_and_tables_go_through_standard_streams(files, capsys, monkeypatch):
    def streamed(line, file):
        """Return what a command prints whose standard input is a file."""
        with (files / file).open() as opened:
            monkeypatch.setattr(sys, 'stdin', opened)
            assert run(*line.split()) == 0
        return capsys.readouterr()

    monkeypatch.chdir(files)
    monkeypatch.setenv('COLUMNS', '200')
    assert 'standard input' in streamed('verify - -c stored.yaml', 'p.csv').out
    calibrated = streamed('calibrate - -o -', 'r.csv')
    assert 'accel-calib calibrate -' in calibrated.err
    (files / 'made.yaml').write_text(calibrated.out, encoding='utf-8')
    assert ac.load('made.yaml').rating.name == 'GOOD'
    assert not Path('-.html').exists()
    table = streamed('apply - -c stored.yaml -o -', 'r.csv')
    assert table.out.startswith('# units: "m/s2"\n')
    for line in ('export FILE --to imucal -o -', 'verify p.csv -c FILE'):
        assert len({streamed(line.replace('FILE', name), 'stored.yaml').out
                    for name in ('-', 'stored.yaml')}) == 1
    assert json.loads(streamed('fit - --json -', 'p.csv').out)['file'] == 'standard input'


def test_a_reader_that_leaves_early_gets_no_error(tmp_path):
    done = piped('accel-calib simulate -o - --poses 20000 | head -1; echo $PIPESTATUS', tmp_path)
    assert done.stdout == '# units: "m/s2"\n141\n'  # as SIGPIPE ends a program
    assert 'Broken' not in done.stderr


@pytest.mark.parametrize(('line', 'message'), table('not_together'))
def test_arguments_that_do_not_go_together_are_refused(line, message, tmp_path):
    (tmp_path / 'r.csv').write_text('time,ax,ay,az\n0,0,0,9.8\n', encoding='utf-8')
    done = forked(*line.split(), folder=tmp_path)
    assert done.returncode == 2
    assert message in done.stderr
    assert done.stderr.count('\n') == 1


def test_a_terminal_is_no_standard_input(capsys, monkeypatch):
    monkeypatch.setattr(sys.stdin, 'isatty', lambda: True, raising=False)
    with pytest.raises(SystemExit, match='2'):
        main(['fit', '-'])
    assert 'expected a log through a pipe' in capsys.readouterr().err


def test_the_shell_completes_options(tmp_path):
    pytest.importorskip('argcomplete')
    out = tmp_path / 'completions'
    line = 'accel-calib fit --mod'
    python(*COMMAND, _ARGCOMPLETE='1', COMP_LINE=line, COMP_POINT=str(len(line)),
           _ARGCOMPLETE_IFS='\n', _ARGCOMPLETE_STDOUT_FILENAME=str(out))
    assert '--model' in out.read_text(encoding='utf-8')


@pytest.mark.parametrize('progress', [START, ENOUGH, FITTED, replace(
    START, still=False, stillness=math.nan, accuracy=math.nan, step='', advice='')])
def test_figures_are_read_as_they_are_written(progress: Progress) -> None:
    figures = dict(progress.figures())
    found = Progress.from_figures({**figures, 'a figure of a later version': '1'})
    assert dict(found.figures()) == figures
    seen = replace(SEEN, accuracy=0.0012, still=progress.still, step=progress.step)
    assert Progress.from_figures(dict(seen.figures())) == seen


@pytest.mark.parametrize('changed', [
    {'poses': None}, {'still': 'perhaps'}, {'dwell [s]': 'long'}])
def test_figures_of_another_version_are_refused(changed: dict[str, str | None]) -> None:
    figures = {**dict(START.figures()), **changed}
    with pytest.raises(InputError, match=min(changed).partition(' ')[0]):
        Progress.from_figures({name: text for name, text in figures.items() if text})


@pytest.mark.parametrize('command', [(*COMMAND, 'watch', '--once'), CALIBRATOR])
def test_missing_ros_is_one_line(command: tuple[str, ...], tmp_path: Path) -> None:
    for name in ('diagnostic_msgs', 'rclpy'):
        (tmp_path / f'{name}.py').write_text(f"raise ImportError('no {name}')\n")
    done = python(*command, folder=tmp_path, PYTHONPATH=f'{tmp_path}{os.pathsep}{ROOT}')
    assert done.returncode == 2
    line, = done.stderr.splitlines()
    assert 'source /opt/ros/jazzy/setup.bash' in line
