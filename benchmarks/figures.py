# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The frame of the benchmarks: arguments, sets in parallel, tables and the page.

A benchmark is its sets, its measure and its table. ``python benchmarks/figures.py PAGE`` runs it,
on the package of this repository and with the helpers of its tests::

    python benchmarks/figures.py geometry --sets 20 --markdown docs/figures/geometry.md

"""

import argparse
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import ExitStack, redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from importlib.metadata import version
import inspect
import math
import multiprocessing
import os
from pathlib import Path
import platform
import re
import subprocess
import sys
import time
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT.parent / 'shared' / 'data'
"""Folder of real recordings."""

MODULES = {page: module for module, pages in (
    ('changes', ('compare', 'watching')), ('poses', ('geometry', 'next_pose', 'plans')),
    ('speed', ('fits', 'recordings', 'memory')), ('refine', ('refine_cost',)),
    ('trust', ('rating', 'robustness'))) for page in pages}
"""Modules of pages with another name."""

sys.path[:0] = [str(ROOT), str(ROOT / 'test'), str(ROOT / 'benchmarks')]

from accel_calib.errors import use_one_thread  # noqa: E402

use_one_thread()


@dataclass(frozen=True)
class Line:
    """One line of a table."""

    what: str  # the quantity, with its unit
    measured: str  # its value
    sets: int = 1  # number of sets, repeats or poses behind the value
    asked: str = ''  # the limit; empty if nothing is asked
    met: bool | None = None  # whether the value is within the limit; None if nothing is asked


def check(what: str, measured: str, value: float, *, least: float = -math.inf,
          most: float = math.inf, unit: str = '', sets: int = 1) -> Line:
    """Return the line of a value with limits; they are not judged if it is NaN."""
    if math.isinf(least) and math.isinf(most):
        return Line(what, measured, sets)
    asked = (f'{least:,g}' if least == most else f'≥ {least:,g}' if math.isinf(most) else
             f'≤ {most:,g}' if math.isinf(least) else f'{least:,g} to {most:,g}')
    met = None if math.isnan(value) else bool(least <= value <= most)
    return Line(what, measured, sets, asked + unit, met)


def share(what: str, good: Iterable[object], *, least: float = -math.inf,
          most: float = math.inf) -> Line:
    """Return the line of the share of sets that are good [%], with its exact 95 % interval."""
    from scipy.stats import binomtest  # here: processes that measure memory do without

    each = [bool(one) for one in good]
    if not each:
        return Line(what, 'no set', 0)
    limits = binomtest(sum(each), len(each)).proportion_ci()
    part = 100.0 * sum(each) / len(each)
    return check(what, f'{part:.1f} % ({sum(each)}/{len(each)}; {100.0 * limits.low:.1f} to '
                 f'{100.0 * limits.high:.1f})', part, least=least, most=most, unit=' %',
                 sets=len(each))


def table(lines: Iterable[Line]) -> str:
    """Return the lines as a Markdown table."""
    words = {True: 'yes', False: '**no**', None: ''}
    return markdown(('', 'measured', 'asked', 'sets', 'met'), (
        (x.what, x.measured, x.asked, x.sets, words[x.met]) for x in lines))


def markdown(heads: Sequence[object], rows: Iterable[Iterable[object]]) -> str:
    """Return a Markdown table."""
    lines = ['| ' + ' | '.join(map(str, row)) + ' |' for row in (heads, *rows)]
    return '\n'.join([lines[0], '|---' * len(heads) + '|', *lines[1:]])


@dataclass(frozen=True)
class Frame:
    """A pool of processes for the sets of a page; without one, they run in this process."""

    pool: Any = None

    def run(self, work: Callable[..., Any], tasks: Iterable[tuple[Any, ...]]) -> list[Any]:
        """Return the results of a function for each of some tuples of arguments, in this order."""
        began, tasks = time.monotonic(), list(tasks)
        found = (self.pool.starmap(work, tasks, chunksize=max(len(tasks) // 20, 1)) if self.pool
                 else [work(*task) for task in tasks])
        tell(f'{work.__name__}: {len(tasks)} sets in {time.monotonic() - began:.0f} s')
        return found

    def run_sets(self, work: Callable[..., Any], sets: int, *given: Any, first: int = 0
                 ) -> list[Any]:
        """Return the results of a function for arguments and the number of each set."""
        return self.run(work, [(*given, first + number) for number in range(sets)])


@dataclass(frozen=True)
class Measured:
    """The result of a function in a process of its own, and what it took."""

    result: Any
    seconds: float
    cpu: float  # [s]
    before: float  # resident memory with all imports and what was prepared [MB]
    megabytes: float  # largest resident memory of the process [MB]


def measure_alone(work: Callable[..., Any], *given: Any,
                  prepare: Callable[..., Any] | None = None) -> Measured:
    """Return what work takes in a fresh process; what `prepare` makes of its arguments is free."""
    with ProcessPoolExecutor(1, multiprocessing.get_context('spawn')) as alone:
        found = alone.submit(_measure, work, given, prepare).result()
    tell(work.__name__, *given, found)
    return found


def _measure(work: Callable[..., Any], given: Sequence[Any], prepare: Callable[..., Any] | None
             ) -> Measured:
    given = given if prepare is None else [prepare(*given)]
    before, began, cpu = largest_mb(), time.perf_counter(), time.process_time()
    result = work(*given)
    return Measured(result, time.perf_counter() - began, time.process_time() - cpu, before,
                    largest_mb())


def run_command(*command: str) -> None:
    """Run a command of the command line; what it prints goes to standard error."""
    from accel_calib.cli.main import main as accel_calib  # here: others measure without it

    with redirect_stdout(sys.stderr):
        status = accel_calib(list(command))
    if status not in (0, 1):
        raise RuntimeError(f'{" ".join(command)}: exit status {status}')


def largest_mb() -> float:
    """Return the largest resident memory of this process so far [MB]; not that of its parent."""
    text = Path('/proc/self/status').read_text(encoding='ascii')
    return int(text.partition('VmHWM:')[2].split()[0]) / 1024.0


def tell(*words: object) -> None:
    """Show the progress."""
    print(*words, file=sys.stderr, flush=True)


def main() -> None:
    """
    Make the page that the first argument names: print it, and write it if asked to.

    A page is a function with the name of its file in ``docs/figures``. It takes a `Frame` and
    options, and yields what it finds: tables, and phrases. The words beside them stand in the
    file. The options of the command line are those of the function, with their defaults: a
    number, False for a switch, or a tuple of words or numbers. `sets` brings `--jobs` along.

    """
    name = sys.argv[1] if len(sys.argv) > 1 else ''
    file = ROOT / 'docs' / 'figures' / f'{name}.md'
    if not file.exists():
        raise SystemExit(f'usage: {sys.argv[0]} PAGE [options]; a page is a file of docs/figures')
    page = getattr(import_module(MODULES.get(name, name)), name)
    options = argparse.ArgumentParser(prog=f'figures.py {name}')
    for option, parameter in list(inspect.signature(page).parameters.items())[1:]:
        usual = parameter.default
        kind: dict[str, Any] = {'type': type(usual)}
        if usual is False:
            kind = {'action': 'store_true'}
        elif isinstance(usual, tuple):
            known = usual if isinstance(usual[0], str) else None
            kind = {'nargs': '+', 'choices': known, 'type': type(usual[0])}
        options.add_argument(f'--{option.replace("_", "-")}', default=usual, **kind)
        if option == 'sets':
            options.add_argument('--jobs', type=int, default=2, help='number of processes')
    options.add_argument('--markdown', type=Path, help='file to write the page to')
    given = vars(options.parse_args(sys.argv[2:]))
    path, jobs, about = given.pop('markdown'), given.pop('jobs', 1), machine()
    words = [word for word in sys.argv[1:] if word not in ('--markdown', str(path))]
    command = ' '.join(['python benchmarks/figures.py', *words, '--markdown FILE'])
    os.environ['PYTHONPATH'] = os.pathsep.join(sys.path[:3])
    with ExitStack() as stack:
        pool = (stack.enter_context(multiprocessing.get_context('spawn').Pool(jobs)) if jobs > 1
                else None)
        parts = list(page(Frame(pool), **given))
    text = update(file.read_text(encoding='utf-8'), parts)
    text = re.sub(r'(Made by\s)`[^`]*`', lambda found: f'{found[1]}`{command}`', text)
    text = re.sub(r'(Machine: |` on |^(?!Made))[^,\n]+, \d+ cores, load .*?numpy [\d.]*\d',
                  lambda found: found[1] + about, text, flags=re.MULTILINE)
    text = re.sub(r'(Measured at the commit )[^\n]*', rf'\g<1>{commit()}.', text)
    print(text)
    if path is not None:
        path.write_text(text, encoding='utf-8')


def update(page: str, parts: Sequence[str]) -> str:
    """
    Return a page with tables in the place of its own, in their order, and numbers in phrases.

    A phrase is found in the page by its words. What has no place comes last.

    """
    number = r'[-+]?\d[\d,.]*\d|\d'
    tables = [part for part in parts if part.startswith('|')]
    for phrase in (part for part in parts if not part.startswith('|')):
        values = iter(re.findall(number, phrase))
        words = (re.escape(each) for each in re.sub(number, '#', phrase).split())
        pattern = r'\s+'.join(words).replace(re.escape('#'), f'(?:{number})')
        found = re.search(pattern, page)
        if found:
            new = re.sub(number, lambda _: next(values), found[0])  # noqa: B023
            page = page[:found.start()] + new + page[found.end():]
        else:
            tables.append(phrase)
    page = re.sub(r'^\| .*\n\|---.*\n(?:\|.*\n)*', lambda old: (
        f'{tables.pop(0)}\n' if tables else old[0]), page, flags=re.MULTILINE)
    before, place, after = page.rpartition('Measured at the commit ')
    return ''.join([before, *(f'{each}\n\n' for each in tables), place, after])


def commit() -> str:
    """Return the short name of the commit, with ``-dirty`` if more than the pages has changed."""
    def answer(*words: str) -> str:
        return subprocess.run(['git', *words], cwd=ROOT, check=True, capture_output=True,
                              text=True).stdout.strip()

    changed = answer('status', '--porcelain', '--untracked-files=no', '--', ':/',
                     ':(top,exclude)docs/figures')
    return answer('rev-parse', '--short=7', 'HEAD') + ('-dirty' if changed else '')


def machine() -> str:
    """Return the processor with its load, the system and the versions."""
    text = Path('/proc/cpuinfo').read_text(encoding='utf-8')
    name = re.search(r'model name\s*: (.*)', text)
    return (f'{name[1] if name else platform.machine()}, {os.cpu_count()} cores, load '
            f'{os.getloadavg()[0]:.1f} before; Linux {platform.release()}, Python '
            f'{platform.python_version()}, numpy {version("numpy")}')


if __name__ == '__main__':
    import figures  # as the pages do, so that there is one module
    figures.main()
