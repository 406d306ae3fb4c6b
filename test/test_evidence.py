# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The page of evidence states what its commands find in real recordings."""

import importlib
import re

import numpy as np
import pytest
from shared import data, GRAVITY, rms, ROOT

NUMBER = re.compile(r'[-−]?\d+(?:\.\d+)?')


@pytest.fixture(scope='module')
def evidence():
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / 'docs'))
        return importlib.import_module('evidence')


@pytest.fixture(scope='module')
def cases(evidence):
    return evidence.cases_of(data('README.md').parent)


def test_the_table_states_what_the_commands_find(evidence, cases):
    stated, found = evidence.PAGE.read_text('utf-8'), evidence.with_table(cases)
    assert NUMBER.sub('#', found) == NUMBER.sub('#', stated), 'run: python docs/evidence.py'
    numbers = [[float(each.replace('−', '-')) for each in NUMBER.findall(text)]
               for text in (found, stated)]
    np.testing.assert_allclose(*numbers, rtol=0.1)


def test_the_slopes_of_the_sense_hat_are_those_of_an_independent_analysis(cases):
    slopes = cases[0].calibration.model.values['offset_temperature'][:3]
    np.testing.assert_allclose(1e3 * slopes, [0.57, 0.41, -0.41], atol=0.01)


def test_the_effects_of_the_cycle_leave_a_third_of_the_polynomial_of_its_publisher(cases):
    columns = np.genfromtxt(data('poses/thermal_cycle_poses.csv'), delimiter=',', names=True,
                            skip_header=1)
    warm = columns['temperature']
    left = [columns[name] - np.polyval(np.polyfit(warm, columns[name], 3), warm)
            for name in ('ax', 'ay', 'az')]
    cubic_mg = 1e3 * rms(np.linalg.norm(left, axis=0)) / GRAVITY
    assert cubic_mg == pytest.approx(4.8, abs=0.05)
    assert cases[2].result['rms_after_mg'] < 0.4 * cubic_mg


def test_nothing_is_named_in_the_null_controls(cases):
    assert [case.result['verdict'] for case in cases[3:]] == ['explained'] + ['no_gap'] * 4
