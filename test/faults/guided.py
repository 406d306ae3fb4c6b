# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Inputs guided by the coverage of the readers, for runs by hand.

It needs `atheris`, which is not among the requirements of the tests, and writes the inputs that
reach new code to a folder::

    pip install atheris
    mkdir corpus
    python test/faults/guided.py yaml corpus -max_total_time=600

The kinds are those of fuzz.py that read one file. The sound files are the first inputs. It ends at
the first finding, and writes its input to the current folder.

"""

from __future__ import annotations

from pathlib import Path
import sys
from tempfile import TemporaryDirectory

import atheris

ROOT = Path(__file__).resolve().parents[2]
sys.path[:0] = [str(ROOT), str(ROOT / 'test')]

with atheris.instrument_imports(include=['accel_calib']):
    from faults.fuzz import ended, KINDS
    from faults.inputs import sound
import numpy as np  # noqa: E402


def main() -> None:
    """Read inputs until a finding or the end of the time."""
    kind, corpus = sys.argv[1], Path(sys.argv[2])
    files = sound(kind)
    for number, each in enumerate(files):
        (corpus / f'sound_{number}').write_bytes(each.content[each.name])
    name, read = files[0].name, KINDS[kind][1]
    with TemporaryDirectory() as folder:
        path = Path(folder) / 'case' / name
        path.parent.mkdir()

        def one(data: bytes) -> None:
            path.write_bytes(data)
            outcome = ended(read, path, np.random.default_rng(len(data)))
            if outcome not in ('read', 'refused'):
                raise AssertionError(outcome)

        atheris.Setup([sys.argv[0], str(corpus), *sys.argv[3:]], one)
        atheris.Fuzz()


if __name__ == '__main__':
    main()
