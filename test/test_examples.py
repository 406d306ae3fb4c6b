# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The examples run, and tell what they should."""

from pathlib import Path
import runpy

EXAMPLES = Path(__file__).parent.parent / 'examples'


def test_hidden_effect_is_found(capsys):
    runpy.run_path(str(EXAMPLES / 'find_hidden_effect.py'), run_name='__main__')
    said = capsys.readouterr().out
    assert 'Missing: offset_temperature' in said
    assert said.count('Missing') == 1
    assert said.endswith('Verdict: explained.\n')
