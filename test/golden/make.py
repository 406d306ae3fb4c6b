# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Write the expected results anew: ``python test/golden/make.py [NAME…]``.

The differences in git show what a change of the package changes in its results.

"""

from pathlib import Path
import sys
from tempfile import TemporaryDirectory
import time

sys.path[:0] = [str(Path(__file__).parents[2]), str(Path(__file__).parents[1])]

from golden.cases import CASES, result_of  # noqa: E402
from golden.record import EXPECTED, text_of  # noqa: E402
from golden.sweeps import SWEEPS  # noqa: E402
import pytest  # noqa: E402

for name in sys.argv[1:] or [*CASES, *SWEEPS]:
    begun = time.perf_counter()
    try:
        with TemporaryDirectory() as folder:
            text = text_of(result_of(name, Path(folder)))
    except pytest.skip.Exception as missing:
        sys.stdout.write(f'{name}: not written, {missing}\n')
        continue
    (EXPECTED / f'{name}.json').write_text(f'{text}\n', encoding='utf-8')
    sys.stdout.write(f'{name}: {time.perf_counter() - begun:.2f} s, {len(text) / 1e3:.0f} kB\n')
