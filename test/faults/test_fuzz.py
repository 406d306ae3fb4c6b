# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""A part of the seeded cases of fuzz.py: every file ends in a result or in one line."""

from importlib.util import find_spec
from pathlib import Path
import struct

from accel_calib.errors import InputError
from faults import inputs
from faults.fuzz import KINDS, outcomes
from faults.inputs import Files
from faults.sample import FACTOR
from inside import read_log
import pytest

CASES = 30 * FACTOR
_NEEDED = {'ulg': 'pyulog', 'bin': 'pymavlink'}


@pytest.mark.parametrize('kind', KINDS)
def test_a_damaged_file_ends_in_a_result_or_in_one_line(kind: str) -> None:
    if kind in _NEEDED and find_spec(_NEEDED[kind]) is None:
        pytest.skip(f'{_NEEDED[kind]} is not installed')
    found = dict(outcomes(kind, CASES, seed=5))
    assert not {case: each for case, each in found.items() if each not in ('read', 'refused')}
    assert {*found.values()} == {'read', 'refused'}


def flight() -> bytes:
    """Return a flight log of two sensors."""
    pytest.importorskip('pymavlink')
    return (inputs.LOGS / 'ardupilot' / 'two_imus.bin').read_bytes()


def test_a_cut_definition_of_a_ulog_ends(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('pyulog')
    unknown = struct.pack('<HB', 9000, ord('z')) + bytes(9000)
    cut = struct.pack('<HB', 9000, 0)
    logs = iter([b'ULog\x01\x12\x35' + bytes(9) + rest for rest in (
        unknown + cut + bytes(10), unknown + cut, b'\x12\x01\0\0')])
    monkeypatch.setitem(KINDS, 'cut', (
        lambda: lambda rng: Files('log.ulg', {'log.ulg': next(logs)}),
        lambda path, rng: read_log(path)))
    assert {*dict(outcomes('cut', 3, seed=1)).values()} == {'refused'}


def test_a_message_of_a_flight_log_with_a_field_without_name_is_left_out(tmp_path: Path) -> None:
    data = flight()
    at = data.index(b'TimeUS,I,GyrX')
    names = data[at:at + 64].replace(b'GyrX', b'', 1).ljust(64, b'\0')
    path = tmp_path / 'log.bin'
    path.write_bytes(data[:at] + names + data[at + 64:])
    with pytest.raises(InputError, match='has none of the messages'):
        read_log(path)
