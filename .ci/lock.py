# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Print the versions of all installed packages, as a lock file for development.

    .venv/bin/python .ci/lock.py >requirements-dev.txt

Only packages that pip installed from an index are listed: neither this package, nor tf2_msgs,
which `make test` builds. pip itself is left out.

"""

from __future__ import annotations

from importlib.metadata import Distribution, distributions
import platform
import re

HEADER = """\
# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

# The versions that the last change was tested with, on Python {python}, {system}.
# CONTRIBUTING.md says how to use this file and how to make it anew.
"""


def name_of(distribution: Distribution) -> str:
    """Return the name of a distribution in its normal form."""
    return re.sub(r'[-_.]+', '-', distribution.metadata['Name']).lower()


def from_an_index(distribution: Distribution) -> bool:
    """Return whether pip installed a distribution from an index; wheels of ROS hold others."""
    installer = (distribution.read_text('INSTALLER') or '').strip()
    return installer == 'pip' and distribution.read_text('direct_url.json') is None


def main() -> None:
    """Print the lock file."""
    found = {name_of(each): each.version for each in distributions() if from_an_index(each)}
    print(HEADER.format(python='.'.join(platform.python_version_tuple()[:2]),
                        system=f'{platform.system()} {platform.machine()}'))
    for name in sorted(found.keys() - {'pip'}):
        print(f'{name}=={found[name]}')


if __name__ == '__main__':
    main()
