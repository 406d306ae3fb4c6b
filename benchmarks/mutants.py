# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The share of wrong operators in the code that tests find.

A mutant is the package with one operator or comparison replaced, by the operators of cosmic-ray.
One of each place is drawn at random, and of these a sample. A mutant runs with the tests that
execute its statement in their own process, the quickest first; so commands and nodes in other
processes are left out, and the share that is killed is a lower bound.

"""

import ast
from collections import Counter, defaultdict
from collections.abc import Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from itertools import groupby
import os
from pathlib import Path
from queue import SimpleQueue
import random
import re
import shutil
import subprocess
import sys
from tempfile import TemporaryDirectory
from xml.etree import ElementTree

from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator, operator_names
import coverage
from figures import Frame, markdown, ROOT, tell

IN_OTHER_PROCESSES = ('__init__.py', 'api.py', 'cli', 'fleet', 'live', 'report', 'ros')
"""Parts of the package whose tests start processes, or look at pages."""

KINDS = re.compile(r'core/Replace(BinaryOperator|ComparisonOperator|UnaryOperator|AndWithOr'
                   r'|OrWithAnd)')
ELSEWHERE = re.compile(
    r'test_(ros|live_(page|server|sources)|fleet|docs|launch|packaging|dependencies|bombs'
    r'|store_damage)')  # the last ones give up their rights, also that to write what is covered
LIMIT_S = 300
"""Time after which a test counts as failed: a mutant may never end."""

Place = tuple[str, int, list[tuple[Operator, int]]]
"""File and line of an operator, and what can replace it, each with its number in the file."""


@dataclass(frozen=True)
class Mutant:
    """One replaced operator in a file of the package."""

    file: str
    line: int
    lines: range  # of the statement
    code: str  # of the file
    words: str  # the line before and after


def places_of(file: str) -> list[Place]:
    """Return the places of a file, in its order, with the operators that are possible there."""
    source = (ROOT / file).read_text()
    nodes = list(ast_nodes(get_ast(source)))
    notes = [range(note.lineno, (note.end_lineno or note.lineno) + 1)
             for node in ast.walk(ast.parse(source)) for name in ('annotation', 'returns')
             if (note := getattr(node, name, None)) is not None]
    at = defaultdict(list)
    for name in filter(KINDS.match, operator_names()):
        operator = get_operator(name)()
        starts = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for count, start in enumerate(starts):
            if not any(start[0] in lines for lines in notes):
                at[start].append((operator, count))
    return [(file, line, possible) for (line, _), possible in sorted(at.items())]


def draw_mutants(count: int, seed: int) -> Iterator[Mutant]:
    """Yield mutants of the package."""
    draw, package = random.Random(seed), ROOT / 'accel_calib'
    files = sorted(str(path.relative_to(ROOT)) for path in package.rglob('*.py')
                   if path.relative_to(package).parts[0] not in IN_OTHER_PROCESSES)
    drawn = draw.sample([place for file in files for place in places_of(file)], count)
    for file, line, operators in drawn:
        source = (ROOT / file).read_text()
        code = mutate_code(source, *draw.choice(operators))
        pairs = zip(source.splitlines(), code.splitlines(), strict=True)
        before, after = next((a.strip(), b.strip()) for a, b in pairs if a != b)
        statement = max((node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)
                         and node.lineno <= line <= (node.end_lineno or node.lineno)),
                        key=lambda node: node.lineno)
        lines = range(statement.lineno, (statement.end_lineno or line) + 1)
        yield Mutant(file, line, lines, code, f'`{before}` → `{after}`'.replace('|', '\\|'))


def copy_to(to: Path) -> Path:
    """Copy what tests need."""
    return Path(shutil.copytree(ROOT, to, symlinks=True, ignore=shutil.ignore_patterns(
        '.git', '.venv', 'build', '__pycache__', '.*_cache')))


def run_tests(where: Path, *arguments: str) -> int:
    """Run tests in a copy, and return the exit status."""
    environment = {**os.environ, 'PYTHONDONTWRITEBYTECODE': '1', 'PYTHONPATH': '',
                   'PATH': f'{Path(sys.executable).parent}:{os.environ["PATH"]}',
                   'COVERAGE_FILE': str(where / '.coverage')}
    command = [sys.executable, '-m', 'pytest', '-q', '-p', 'no:cacheprovider', '-o',
               f'faulthandler_timeout={LIMIT_S}', '-o', 'faulthandler_exit_on_timeout=true',
               *arguments]
    return subprocess.run(command, cwd=where, env=environment, check=False,
                          stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL).returncode


class Tests:
    """Which tests execute which lines, and how long each takes."""

    def __init__(self, where: Path) -> None:
        files = [str(path.relative_to(where)) for path in sorted(where.glob('test/test_*.py'))
                 if not ELSEWHERE.match(path.name)]
        status = run_tests(where, '-n', str(os.cpu_count()), '--dist', 'loadfile',
                           '--cov=accel_calib', '--cov-context=test', '--cov-report=',
                           '--junitxml=tests.xml', *files)
        if status:
            raise SystemExit(f'the tests fail without any mutant: pytest ended with {status}')
        cases = ElementTree.parse(where / 'tests.xml').getroot().iter('testcase')
        self.seconds = {f'{case.get("classname", "").replace(".", "/")}.py::{case.get("name")}':
                        float(case.get('time', 0)) for case in cases}
        self.of_file = {file: list(names) for file, names in groupby(
            sorted(self.seconds), key=lambda name: name.split('::')[0])}
        self.data = coverage.CoverageData(str(where / '.coverage'))
        self.data.read()
        self.measured = {str(Path(name).relative_to(where)): name
                         for name in self.data.measured_files()}

    def of(self, file: str, lines: Iterable[int]) -> list[str]:
        """Return the tests of these lines, or of the file if it is executed by its import."""
        by_line = self.data.contexts_by_lineno(self.measured[file])
        if any('' in by_line.get(line, ()) for line in lines):
            lines = by_line
        contexts = {each for line in lines for each in by_line.get(line, ()) if each}
        found = set()
        for test, _, phase in (context.rpartition('|') for context in contexts):
            # What a fixture executes is of all tests of its file.
            found |= {test} if phase == 'run' else set(self.of_file[test.split('::')[0]])
        return sorted(found, key=lambda name: self.seconds[name])


def mutants(frame: Frame, count: int = 300, seed: int = 1) -> Iterator[str]:
    """Yield the share that is killed by folder, and the mutants that survive."""
    drawn = list(draw_mutants(count, seed))
    with TemporaryDirectory() as folder:
        tests = Tests(copy_to(Path(folder, 'covered')))
        copies: SimpleQueue[Path] = SimpleQueue()
        workers = os.cpu_count() or 1
        for number in range(workers):
            copies.put(copy_to(Path(folder, str(number))))

        def is_killed(given: Mutant) -> bool:
            """Return whether a test fails, or does not end, in a copy with the mutant."""
            names, where = tests.of(given.file, given.lines), copies.get()
            original = (where / given.file).read_text()
            try:
                (where / 'tests.txt').write_text('\n'.join(names))
                (where / given.file).write_text(given.code)
                return bool(names) and run_tests(where, '-x', '@tests.txt') != 0
            finally:
                (where / given.file).write_text(original)
                copies.put(where)

        rows, folders, survived = [], Counter[str](), Counter[str]()
        with ThreadPoolExecutor(workers) as pool:
            for done, (given, killed) in enumerate(zip(drawn, pool.map(is_killed, drawn)), 1):
                folder_of = given.file.split('/')[1]  # or a module of the base
                folders[folder_of] += 1
                if not killed:
                    survived[folder_of] += 1
                    rows.append((given.file, given.line, given.words))
                    tell(done, *rows[-1])
    yield f'{len(drawn)} mutants, seed {seed}: {1.0 - len(rows) / len(drawn):.1%} killed'
    yield markdown(('folder', 'mutants', 'killed'), (
        (each, number, f'{1.0 - survived[each] / number:.0%}')
        for each, number in sorted(folders.items())))
    yield markdown(('file', 'line', 'survives'), rows)
