# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The share of wrong operators in the code that tests find.

A mutant is the package with one operator or comparison replaced, by the operators of cosmic-ray.
One of each place is drawn at random, and of these a sample. A mutant runs with the tests that
execute its statement in their own process, the quickest first; so commands and nodes in other
processes are left out, and the share that is killed is a lower bound.

    python benchmarks/mutants.py [--count 300] [--seed 1] [--markdown FILE]

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

from figures import markdown, parser, publish
from cosmic_ray.ast import ast_nodes, get_ast
from cosmic_ray.mutating import mutate_code
from cosmic_ray.operators.operator import Operator
from cosmic_ray.plugins import get_operator, operator_names
import coverage

ROOT = Path(__file__).resolve().parent.parent
FOLDERS = ('calibration', 'comparison', 'effects', 'estimate', 'findings', 'logs',
           'messages', 'refinement', 'session', 'stillness', 'stored')
KINDS = re.compile(r'core/Replace(BinaryOperator|ComparisonOperator|UnaryOperator|AndWithOr'
                   r'|OrWithAnd)')
ELSEWHERE = re.compile(
    r'test_(ros|live_(page|server|sources)|fleet|docs|launch|packaging|dependencies|bombs'
    r'|store_damage)')  # the last ones give up their rights, also that to write what is covered
LIMIT_S = 300
"""Time after which a test counts as failed: a mutant may never end."""


@dataclass(frozen=True)
class Place:
    """Where an operator stands, and what can replace it, each with its number in the file."""

    file: str
    line: int
    operators: list[tuple[Operator, int]]


@dataclass(frozen=True)
class Mutant:
    """One replaced operator: the statement's lines in a file of the package, before and after."""

    file: str
    line: int
    lines: range
    code: str
    words: str


def places(file: str) -> list[Place]:
    """Return the places of a file, in its order, with the operators that are possible there."""
    source = (ROOT / file).read_text()
    nodes = list(ast_nodes(get_ast(source)))
    notes = [range(note.lineno, (note.end_lineno or note.lineno) + 1)
             for note in annotations(ast.parse(source))]
    at = defaultdict(list)
    for name in filter(KINDS.match, operator_names()):
        operator = get_operator(name)()
        starts = [start for node in nodes for start, _ in operator.mutation_positions(node)]
        for count, start in enumerate(starts):
            if not any(start[0] in lines for lines in notes):
                at[start].append((operator, count))
    return [Place(file, line, possible) for (line, _), possible in sorted(at.items())]


def annotations(tree: ast.AST) -> Iterator[ast.expr]:
    for node in ast.walk(tree):
        for name in ('annotation', 'returns'):
            if (note := getattr(node, name, None)) is not None:
                yield note


def mutant(place: Place, draw: random.Random) -> Mutant:
    """Return one of the mutants of a place."""
    source = (ROOT / place.file).read_text()
    code = mutate_code(source, *draw.choice(place.operators))
    pairs = zip(source.splitlines(), code.splitlines(), strict=True)
    before, after = next((a.strip(), b.strip()) for a, b in pairs if a != b)
    around = [node for node in ast.walk(ast.parse(source)) if isinstance(node, ast.stmt)
              and node.lineno <= place.line <= (node.end_lineno or node.lineno)]
    statement = max(around, key=lambda node: node.lineno)
    lines = range(statement.lineno, (statement.end_lineno or place.line) + 1)
    return Mutant(place.file, place.line, lines, code, f'`{before}` → `{after}`')


def sample(count: int, seed: int) -> list[Mutant]:
    """Draw mutants of the folders."""
    draw = random.Random(seed)
    files = sorted(str(path.relative_to(ROOT)) for folder in FOLDERS
                   for path in (ROOT / 'accel_calib' / folder).rglob('*.py'))
    drawn = draw.sample([place for file in files for place in places(file)], count)
    return [mutant(place, draw) for place in drawn]


def copied(to: Path) -> Path:
    """Copy what tests need."""
    return Path(shutil.copytree(ROOT, to, symlinks=True, ignore=shutil.ignore_patterns(
        '.git', '.venv', 'build', '__pycache__', '.*_cache')))


def pytest(where: Path, *arguments: str) -> int:
    """Run tests in a copy, and return the exit status."""
    environment = {**os.environ, 'PYTHONDONTWRITEBYTECODE': '1',
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
        status = pytest(where, '-n', str(os.cpu_count()), '--dist', 'loadfile',
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
        """
        Return the tests of these lines, or of the file if it is executed by its import.

        What a fixture executes is of all tests of its file.

        """
        by_line = self.data.contexts_by_lineno(self.measured[file])
        if any('' in by_line.get(line, ()) for line in lines):
            lines = by_line
        contexts = {each for line in lines for each in by_line.get(line, ()) if each}
        found = set()
        for test, _, phase in (context.rpartition('|') for context in contexts):
            found |= {test} if phase == 'run' else set(self.of_file[test.split('::')[0]])
        return sorted(found, key=lambda name: self.seconds[name])


def is_killed(given: Mutant, tests: Tests, where: Path) -> bool:
    """Return whether a test fails, or does not end, in a copy with the mutant."""
    names = tests.of(given.file, given.lines)
    if not names:
        return False
    (where / 'tests.txt').write_text('\n'.join(names))
    original = (where / given.file).read_text()
    (where / given.file).write_text(given.code)
    try:
        return pytest(where, '-x', '@tests.txt') != 0
    finally:
        (where / given.file).write_text(original)


def main() -> None:
    options = parser(__doc__, count=300, seed=1).parse_args()
    drawn = sample(options.count, options.seed)
    with TemporaryDirectory() as folder:
        tests = Tests(copied(Path(folder, 'covered')))
        copies: SimpleQueue[Path] = SimpleQueue()
        workers = os.cpu_count() or 1
        for number in range(workers):
            copies.put(copied(Path(folder, str(number))))

        def tried(given: Mutant) -> bool:
            where = copies.get()
            try:
                return is_killed(given, tests, where)
            finally:
                copies.put(where)

        rows, folders, survived = [], Counter[str](), Counter[str]()
        with ThreadPoolExecutor(workers) as pool:
            for done, (given, killed) in enumerate(zip(drawn, pool.map(tried, drawn)), 1):
                folder_of = given.file.split('/')[1]
                folders[folder_of] += 1
                if not killed:
                    survived[folder_of] += 1
                    rows.append((given.file, given.line, given.words.replace('|', '\\|')))
                    print(done, *rows[-1], flush=True)
    shares = [(each, count, f'{1.0 - survived[each] / count:.0%}')
              for each, count in sorted(folders.items())]
    words = ('# Mutants\n\nThe share of wrong operators that tests in their own process find, by '
             f'folder; {len(drawn)} mutants, seed {options.seed}: '
             f'{1.0 - len(rows) / len(drawn):.1%} killed')
    publish('\n\n'.join((
        words, markdown(('folder', 'mutants', 'killed'), shares),
        markdown(('file', 'line', 'survives'), rows))), options.markdown)


if __name__ == '__main__':
    main()
