# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What benchmarks share: options, pages with what is measured beside what is asked, a load."""

from __future__ import annotations

import argparse
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from importlib.metadata import version
import os
from pathlib import Path
import platform
import subprocess
import sys


@dataclass(frozen=True)
class Line:
    """
    One line of a table.

    Parameters
    ----------
    what : str
        The quantity, with its unit.
    measured, asked : str
        Its value, and the limit; an empty limit if nothing is asked.
    sets : int
        Number of sets, repeats or poses behind the value.
    met : bool or None
        Whether the value is within the limit; None if nothing is asked.

    """

    what: str
    measured: str
    asked: str
    sets: int
    met: bool | None


def table(lines: Sequence[Line]) -> str:
    """Return the lines as a Markdown table."""
    words = {True: 'yes', False: '**no**', None: ''}
    return markdown(('', 'measured', 'asked', 'sets', 'met'), (
        (x.what, x.measured, x.asked, x.sets, words[x.met]) for x in lines))


def markdown(heads: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table."""
    lines = ['| ' + ' | '.join(map(str, row)) + ' |' for row in (heads, *rows)]
    return '\n'.join([lines[0], '|---' * len(heads) + '|', *lines[1:]])


def parser(about: str | None, **numbers: float) -> argparse.ArgumentParser:
    """Return the parser of a benchmark: options with numbers, such as the seed, and the page."""
    made = argparse.ArgumentParser(description=(about or '').strip().splitlines()[0])
    for name, usual in numbers.items():
        made.add_argument(f'--{name}', type=type(usual), default=usual)
    made.add_argument('--markdown', type=Path, help='file to write the page to')
    return made


def publish(page: str, path: Path | None) -> None:
    """Print a page with the commit that it is of, and write it to the path if there is one."""
    page = f'{page.rstrip()}\n\nMeasured at the commit {commit()}.\n'
    print(page)
    if path is not None:
        path.write_text(page, encoding='utf-8')


def commit() -> str:
    """Return the short name of the commit, with ``-dirty`` if more than the pages has changed."""
    def answer(*words: str) -> str:
        return subprocess.run(['git', *words], cwd=Path(__file__).parent, check=True,
                              capture_output=True, text=True).stdout.strip()

    changed = answer('status', '--porcelain', '--untracked-files=no', '--', ':/',
                     ':(top,exclude)docs/figures')
    return answer('rev-parse', '--short=7', 'HEAD') + ('-dirty' if changed else '')


def machine() -> str:
    """Return the processor with its load before the benchmark, the system and the versions."""
    try:
        text = Path('/proc/cpuinfo').read_text(encoding='utf-8')
        name = next(line.split(':')[1].strip() for line in text.splitlines()
                    if line.startswith('model name'))
    except (OSError, StopIteration):
        name = platform.processor() or platform.machine()
    return (f'{name}, {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f} before; Linux '
            f'{platform.release()}, Python {platform.python_version()}, numpy {version("numpy")}')


@contextmanager
def busy(loops: int) -> Iterator[None]:
    """Run this number of busy loops."""
    processes = [subprocess.Popen([sys.executable, '-c', 'while True: pass'])
                 for _ in range(loops)]
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.wait()
