# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Print the versions and hashes of all installed packages, as a lock file for development.

    .venv/bin/python .ci/lock.py >requirements-dev.txt

Only packages that pip installed from an index are listed: neither this package, nor tf2_msgs,
which `make test` builds. pip itself is left out. The hash is that of the file which pip chooses
for this Python and system.

"""

from __future__ import annotations

from importlib.metadata import Distribution, distributions
import json
import platform
import re
import subprocess
import sys

HEADER = """\
# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

# The versions that the last change was tested with, on Python {python}, {system}.
# CONTRIBUTING.md says how to use this file and how to make it anew.
"""


def normal(name: str) -> str:
    """Return the normal form of the name of a distribution."""
    return re.sub(r'[-_.]+', '-', name).lower()


def from_an_index(distribution: Distribution) -> bool:
    """Return whether pip installed a distribution from an index; wheels of ROS hold others."""
    installer = (distribution.read_text('INSTALLER') or '').strip()
    return installer == 'pip' and distribution.read_text('direct_url.json') is None


def hashed(pins: list[str]) -> dict[str, str]:
    """Return the SHA-256 of the file of each package, by the name in its normal form."""
    report = subprocess.run(
        [sys.executable, '-m', 'pip', 'install', '--quiet', '--dry-run', '--ignore-installed',
         '--no-deps', '--report', '-', *pins], check=True, stdout=subprocess.PIPE).stdout
    return {normal(each['metadata']['name']): each['download_info']['archive_info']['hashes'][
        'sha256'] for each in json.loads(report)['install']}


def main() -> None:
    """Print the lock file."""
    found = {normal(each.metadata['Name']): each.version for each in distributions()
             if from_an_index(each)}
    found.pop('pip', None)
    hashes = hashed([f'{name}=={version}' for name, version in found.items()])
    print(HEADER.format(python='.'.join(platform.python_version_tuple()[:2]),
                        system=f'{platform.system()} {platform.machine()}'))
    for name in sorted(found):
        print(f'{name}=={found[name]} --hash=sha256:{hashes[name]}')


if __name__ == '__main__':
    main()
