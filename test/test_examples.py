# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The examples run without the repository as working folder, and print the expected result."""

import json
import os
from pathlib import Path
import re
import subprocess
import sys

import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = sorted(path.name for path in (ROOT / 'examples').iterdir() if path.is_file())


def text_of(name):
    """Return the code of an example: of a notebook, that of all its cells."""
    text = (ROOT / 'examples' / name).read_text(encoding='utf-8')
    if not name.endswith('.ipynb'):
        return text
    return '\n'.join(''.join(cell['source']) for cell in json.loads(text)['cells']
                     if cell['cell_type'] == 'code')


def output_of(name, folder, *written):
    """Run an example in an empty folder, and return its output; it may write these files."""
    environment = {**os.environ, 'PYTHONPATH': str(ROOT)}
    done = subprocess.run([sys.executable, '-', *written], cwd=folder, input=text_of(name),
                          text=True, env=environment, capture_output=True, timeout=120,
                          check=False)
    assert done.returncode == 0, done.stderr
    assert sorted(folder.iterdir()) == sorted(written)
    return done.stdout


def test_hidden_effect_is_found(tmp_path):
    output = output_of('find_hidden_effect.py', tmp_path)
    assert re.findall(r'Missing effect: (\w+)', output) == ['offset_temperature']
    assert output.endswith('Verdict: explained.\n')


def test_recording_is_calibrated_from_end_to_end(tmp_path):
    output = output_of('calibrate_recording.py', tmp_path)
    assert 'Calibration(model 10; 18 of 18 poses' in output
    before, after = map(float, re.search(r'residual (\S+) -> (\S+) mg', output).groups())
    assert before > 20.0
    assert after < 0.5
    assert output.endswith('Corrected force in the flat pose [g]: [0. 0. 1.]\n')


def test_error_falls_from_model_to_model_and_is_drawn(tmp_path):
    pytest.importorskip('matplotlib')
    paths = [tmp_path / name for name in ('surfaces.svg', 'surfaces.png')]
    output = output_of('error_surfaces.py', tmp_path, *paths)
    largest = [float(value) for value in re.findall(r'largest error (\S+) mg', output)]
    # Figures 1 to 4 of AN5286: about 50, 10, 5 and 2.5 mg.
    np.testing.assert_allclose(largest, [50.0, 10.0, 5.0, 2.5], rtol=0.1)
    assert '<svg' in paths[0].read_text(encoding='utf-8')
    assert paths[1].read_bytes().startswith(b'\x89PNG')


def test_the_notebook_runs_from_top_to_bottom(tmp_path):
    pytest.importorskip('matplotlib')
    pytest.importorskip('pandas')
    output = output_of('calibrate.ipynb', tmp_path)
    assert 'offset_temperature' in text_of('calibrate.ipynb')
    before, after = map(float, re.search(r'residual (\S+) -> (\S+) mg', output).groups())
    assert before > 20.0
    assert after < 0.5


def test_the_notebook_holds_no_output():
    notebook = json.loads((ROOT / 'examples' / 'calibrate.ipynb').read_text(encoding='utf-8'))
    code = [cell for cell in notebook['cells'] if cell['cell_type'] == 'code']
    assert code
    assert not [cell for cell in code if cell['outputs'] or cell['execution_count']]
    assert notebook['nbformat'] == 4


@pytest.mark.parametrize('name', EXAMPLES)
def test_examples_use_nothing_but_the_public_face(name):
    text = text_of(name)
    imports = re.findall(r'^(?:from|import) .*', text, re.MULTILINE)
    own = [line for line in imports if 'accel_calib' in line]
    assert own == ['import accel_calib as ac']


@pytest.mark.parametrize('name', EXAMPLES)
def test_every_example_is_run(name):
    assert f"output_of('{name}'" in Path(__file__).read_text(encoding='utf-8')
