# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A DDS domain for a demonstration or a test, beside others on the same machine."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
import random
from socket import AF_INET, SOCK_DGRAM, socket

from ..errors import AccelCalibError

_DOMAINS = range(1, 102)


@contextmanager
def own_domain() -> Iterator[int]:
    """
    Yield a DDS domain that nobody else on this machine uses.

    Of the UDP ports of a domain, DDS does not use the third one. This process holds it, so that
    other processes with a domain of this function have another one. A domain in which somebody
    else has a first participant is left out, too.

    Raises
    ------
    AccelCalibError
        If all domains are in use.

    """
    for domain in random.SystemRandom().sample(_DOMAINS, len(_DOMAINS)):
        ports = 7400 + 250 * domain
        with socket(AF_INET, SOCK_DGRAM) as held, socket(AF_INET, SOCK_DGRAM) as participant:
            try:
                held.bind(('127.0.0.1', ports + 2))
                participant.bind(('', ports + 10))
            except OSError:
                continue
            participant.close()
            yield domain
            return
    raise AccelCalibError('the DDS domains 1 to 101 are all in use',
                          'end demonstrations or tests that still run')
