# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

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
