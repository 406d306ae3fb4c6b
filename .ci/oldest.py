# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Print the oldest versions that setup.py allows, for pip install -c.

    .venv/bin/python .ci/oldest.py >oldest.txt

Requirements without a lower bound are left out, such as the tools for development.

"""

from __future__ import annotations

from pathlib import Path
import re
import runpy
from unittest import mock

import setuptools

SETUP = Path(__file__).parent.parent / 'setup.py'
LOWER_BOUND = re.compile(r'([\w.-]+).*>=\s*([\w.]+)')


def requirements() -> list[str]:
    """Return all requirements in setup.py, those of the extras too."""
    with mock.patch.object(setuptools, 'setup') as setup:
        runpy.run_path(str(SETUP))
    given = setup.call_args.kwargs
    return [*given['install_requires'], *(
        each for extra in given['extras_require'].values() for each in extra)]


def main() -> None:
    """Print one line per requirement."""
    bounds = {match[1]: match[2] for each in requirements()
              if (match := LOWER_BOUND.match(each.split(';')[0]))}
    for name, version in sorted(bounds.items()):
        print(f'{name}=={version}')


if __name__ == '__main__':
    main()
