# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The short form of `benchmarks/long_run.py`: rounds of captures, fits and refinements."""

from faults.sample import FACTOR
from long_run import run_rounds
import numpy as np
import pytest

ROUNDS, ROUND, INTERVAL = 2, 50.0, 10.0
"""A round of 50 s has a fit and a refinement [s]."""

RATE = 200.0
"""At this rate a message is only lost if the node does not run for half a second [1/s]."""

GROWTH = {'own': 6.0, 'worker': 6.0}
"""
Growth of a memory in the second round that is allowed [MB].

A leak of 600 bytes for each message would be 6 MB. Smaller ones show only in an hour
(docs/figures/long_run.md), because a process takes memory at many first times: `own` grew by 0.3
to 3.3 MB. The second refinement of a worker process takes 3 MB more than the first one, and later
ones take no more.

"""


@pytest.mark.skipif(FACTOR == 1, reason='two minutes: make faults')
def test_a_long_run_loses_no_message_answers_every_call_and_keeps_its_memory(domain: int) -> None:
    run = run_rounds(ROUNDS, ROUND, INTERVAL, RATE, domain=domain)
    assert np.all(run.count(run.sent) > 0.5 * RATE * INTERVAL)
    assert not np.any(run.lost(run.ours))
    assert [each for each in run.answers if not each.success] == []
    for name in ('fit', 'refine'):
        assert len(run.called(name)) == ROUNDS
    poses = [int(each.words.partition(' from ')[2].split()[0]) for each in run.called('fit')]
    assert all(count >= 10 for count in poses), poses
    for name, most in GROWTH.items():
        assert run.grown(name) < most, name
    assert 'Traceback' not in run.log
    assert 'unexpected error' not in run.log
