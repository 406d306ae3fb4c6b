# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The results of all commands and of the library are those that are stored.

``python test/golden/make.py NAME`` stores the result of a case anew, if it is meant to change.

"""

import json
from pathlib import Path

from accel_calib.finding import Finding
from golden.cases import CASES, result_of
from golden.record import differences, EXPECTED, text_of
from golden.sweeps import SWEEPS
import pytest

MOST = 12


@pytest.mark.parametrize('name', [*SWEEPS, *CASES])
def test_the_result_is_the_one_that_is_stored(name: str, tmp_path: Path) -> None:
    expected = json.loads((EXPECTED / f'{name}.json').read_text(encoding='utf-8'))
    found = list(differences(expected, json.loads(text_of(result_of(name, tmp_path)))))
    assert not found, '\n'.join([f'{len(found)} differences', *found[:MOST]])


@pytest.mark.parametrize('name', [
    'few', 'wrong_rows', 'without_noise', 'swapped_axes', 'rivals', 'known_knocked', 'chain',
    'rated_effects'])
def test_no_figure_depends_on_a_text_of_a_finding(
        name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    checked = Finding.__post_init__

    def reword(self: Finding) -> None:
        checked(self)
        for part in ('text', 'advice'):
            object.__setattr__(self, part, getattr(self, part) and 'other words')

    expected = json.loads((EXPECTED / f'{name}.json').read_text(encoding='utf-8'))
    monkeypatch.setattr(Finding, '__post_init__', reword)
    found = json.loads(text_of(result_of(name, tmp_path)))
    assert found['words'] != expected['words']
    assert not list(differences(expected['figures'], found['figures']))


def test_each_result_has_one_case() -> None:
    assert CASES.keys().isdisjoint(SWEEPS)
    assert {path.stem for path in EXPECTED.iterdir()} == {*CASES, *SWEEPS}
