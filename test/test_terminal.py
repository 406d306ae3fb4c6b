# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Text on terminals of any width and encoding, and help for wrong arguments."""

import io
import os
import pty
import subprocess
import sys

from inside import COMMAND, in_one_line, main, Output, shown
import numpy as np
import pytest

RUN = [sys.executable, *COMMAND]


@pytest.fixture
def poses(tmp_path, capsys):
    path = tmp_path / 'poses.csv'
    assert main(['simulate', '-o', str(path), '--effect', 'offset=0.02,-0.01,0.03', '--effect',
                 'axis_gain=0.01,-0.02,0.005', '--temperature', '20', '30']) == 0
    capsys.readouterr()
    return path


@pytest.fixture
def printed(monkeypatch, capsys):
    """Return a function that runs a command on a terminal of this width, and returns its text."""
    def run(*arguments, columns=80):
        monkeypatch.setenv('COLUMNS', str(columns))
        assert main([str(argument) for argument in arguments]) == 0
        return capsys.readouterr().out

    return run


@pytest.mark.parametrize('columns', [80, 60])
def test_output_fits_the_width(columns, poses, printed, tmp_path):
    stored, other, rest = (tmp_path / name for name in ('c.yaml', 'd.yaml', 'rest.csv'))
    printed('simulate', '-o', rest, '--recording', '--poses', '1', '--dwell', '600', '--rate',
            '20')
    text = ''.join(printed(*arguments, columns=columns) for arguments in (
        ('fit', poses, '-o', stored), ('calibrate', poses, '-o', other),
        ('history', stored, other), ('export', stored, '--to', 'px4'), ('noise', rest),
        ('refine', poses), ('verify', poses, '-c', stored), ('compare', stored, stored), ()))
    wide = [line for line in text.splitlines() if len(line) > columns
            and str(tmp_path) not in line]
    assert len(text.splitlines()) > 100
    assert not wide


@pytest.mark.parametrize('encoding', ['ascii', 'cp1252'])
def test_output_of_an_old_encoding_has_replacements(encoding, poses, tmp_path):
    done = subprocess.run([*RUN, 'fit', str(poses), '-o', str(tmp_path / 'c.yaml')],
                          capture_output=True, check=True,
                          env={**os.environ, 'PYTHONIOENCODING': encoding})
    text = done.stdout.decode(encoding)
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


@pytest.mark.parametrize(('arguments', 'meant'), [
    (['calibrte', 'x'], 'calibrate'), (['fit', 'x.csv', '--modle', '4'], '--model'),
    (['refine', 'x.csv', '--bsae', '4'], '--base'), (['fit', 'x', '--units', 'm/s'], 'm/s2')])
def test_a_misspelt_name_gets_a_suggestion_in_one_line(arguments, meant, capsys):
    with pytest.raises(SystemExit, match='2'):
        main(arguments)
    error = capsys.readouterr().err
    assert f'(did you mean {meant}?)' in error
    assert error.count('\n') == 1


def test_progress_shows_on_a_terminal_from_the_start(tmp_path):
    rng = np.random.default_rng(3)
    path, count = tmp_path / 'rest.csv', 50_000
    values = np.column_stack([np.arange(count) / 100.0, rng.normal((0.1, 0.2, 9.8), 0.02,
                                                                   (count, 3))])
    np.savetxt(path, values, fmt='%.4f', delimiter=',', header='time,ax,ay,az', comments='')
    ours, theirs = pty.openpty()
    process = subprocess.Popen([*RUN, 'capture', str(path), '-o', str(tmp_path / 'p.csv')],
                               stdout=subprocess.PIPE, stderr=theirs,
                               env={**os.environ, 'TERM': 'xterm'})
    os.close(theirs)
    process.communicate()
    shown_text = os.read(ours, 1 << 16).decode()
    os.close(ours)
    assert 'samples' in shown_text


def test_the_shell_completes_options(tmp_path):
    pytest.importorskip('argcomplete')
    out = tmp_path / 'completions'
    line = 'accel-calib fit --mod'
    subprocess.run(RUN, env={**os.environ, '_ARGCOMPLETE': '1', 'COMP_LINE': line,
                             'COMP_POINT': str(len(line)), '_ARGCOMPLETE_IFS': '\n',
                             '_ARGCOMPLETE_STDOUT_FILENAME': str(out)},
                   check=False)
    assert '--model' in out.read_text(encoding='utf-8')
