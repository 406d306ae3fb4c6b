# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

r"""
The formats of logs, and how each is opened: one entry of `FORMATS` per format.

The first bytes of a file decide; only where none fit, its suffix. Reading, ``fleet``, help, the
documentation and the refusals are made from this table. A new format is a new entry: its name,
suffixes, first bytes, and a function that returns its tables (see
`accel_calib.logs.containers.Member`). An entry without such a function is recognised in order to
name the program that converts it.

"""

from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, closing, contextmanager, ExitStack
from dataclasses import dataclass, replace
from functools import partial
from importlib.util import find_spec
import io
from itertools import chain, islice
from pathlib import Path
import re
from typing import Any

import numpy as np

from . import containers
from .bag import open_bag
from .bag_samples import context_of, FIRST_MESSAGES, imu_samples
from .child import LogFile, parts_of
from .columns import Chosen, LogOptions, shown
from .containers import Frame, Member, Piped, Stream
from .flight import DATAFLASH, read_dataflash, read_ulg
from .names import meaning, record_instead
from .quantities import are_samples, decide_quantities
from .text import PEEKED, text_table, TextTable
from .times import check_order
from ..disk import check_regular, FIRST_LINE
from ..errors import DamagedLogError, InputError, needing, saying
from ..finding import Finding
from ..table import check_units, check_values, concatenated, CONTEXT, Floats, Poses, Recording
from ..text import counted
from ..units import Units, units_of

_HEAD, _TAIL = 8192, 65536
"""Number of first and last bytes by which a file is recognised: a ZIP archive ends with the names
of its files."""

_MOST_TABLES = 500
Progress = Callable[[int, int], object]
"""Function called with the number of samples done, and that of all samples."""


@dataclass(frozen=True)
class OpenLog:
    """
    An open log that is read block by block; `open_log` makes it.

    `blocks` are the samples, in order; their size does not depend on that of the log. An error is
    raised when a table without times is read as samples. `samples` is the number of samples; of a
    long text log, an estimate from the size of the file. `sensor` is empty if it is not stated.
    `read_as` is how the log is read, in one line, empty if nothing is assumed. `poses` are those
    of a pose table. `noted` returns the notes so far: what was left out. `findings` are what was
    decided by the values of the first block, against what they seem to be.

    """

    blocks: Iterator[Recording]
    samples: int
    units: Units
    sensor: str = ''
    read_as: str = ''
    poses: Poses | None = None
    noted: Callable[[], tuple[str, ...]] = tuple
    findings: tuple[Finding, ...] = ()

    @property
    def notes(self) -> tuple[str, ...]:
        """Return what is left out, and the findings; complete once all blocks are read."""
        return (*self.noted(), *(each.text for each in self.findings))

    def watched(self, progress: Progress) -> Iterator[Recording]:
        """Yield the blocks, and call a function with the number of samples done and of all."""
        done = 0
        for block in self.blocks:
            yield block
            done += len(block)
            progress(done, max(done, self.samples))


# ------------------------------------------------------------------------ bags and flight logs

@contextmanager
def _bag(_: 'Format', path: Path, options: LogOptions) -> Iterator[OpenLog]:
    with open_bag(path) as bag:
        topic = bag.imu_topic(options.topic)
        sensor = options.sensor or bag.frame_id(topic)
        context, notes = context_of(bag, topic, sensor, options)
        notes = [*bag.notes, *notes]
        blocks = imu_samples(bag, topic, sensor, chosen=bool(options.sensor), context=context,
                             notes=notes)
        received = [stamp for _, stamp, _ in bag.first(topic, size=FIRST_MESSAGES)]  # [ns]
        span = max(received, default=0) - min(received, default=0)
        rate = f' at {(len(received) - 1) * 1e9 / span:.3g} Hz' if span else ''
        # Drivers exist that publish g, although Imu messages are in m/s².
        units = units_of(options.units or options.default_units or 'm/s2', options.gravity)
        read_as = f'Imu messages of {topic}{rate} in {units.name}'
        with saying(read_as):
            head = list(islice(blocks, 1))
            for first in head:
                check_units(first, units, str(bag.path))
        yield OpenLog(chain(head, blocks), bag.count(topic), units, sensor, read_as,
                      noted=lambda: tuple(notes))


@contextmanager
def _flight(known: 'Format', path: Path, options: LogOptions) -> Iterator[OpenLog]:
    recording, read_as, notes = known.read(path, options.topic, options.instance)
    check_values(recording.columns, str(path), recording.row)
    units = units_of('m/s2', options.gravity)
    if options.units not in ('', units.name):
        raise InputError(f'{path} is in {units.name}, but --units is {options.units}',
                         'remove --units')
    with saying(read_as):
        check_units(recording, units, str(path))
    yield OpenLog(iter((recording,)), len(recording), units, recording.sensor, read_as,
                  noted=lambda: notes)


# ------------------------------------------------------------------------------- binary files

@contextmanager
def _binary(known: 'Format', path: Path, options: LogOptions) -> Iterator[OpenLog]:
    """Open a binary file in a child process."""
    with parts_of(known.file(path), _parts, known, options, in_child=options.in_child) as parts:
        head = next(parts)
        notes, findings = list(head.pop('noted')), tuple(head.pop('findings'))

        def blocks() -> Iterator[Recording]:
            for block in parts:
                if isinstance(block, Recording):
                    yield block
                else:
                    notes[:] = block

        yield OpenLog(blocks(), **head, noted=lambda: tuple(notes), findings=findings)


def _parts(path: Path, known: 'Format', options: LogOptions) -> Generator[Any]:
    """Yield the fields of an `OpenLog`, its blocks, and its notes at the end."""
    with known.opened(known, path, options) as log:
        head = {**vars(log), 'noted': log.noted()}
        del head['blocks']
        yield head
        yield from log.blocks
        yield log.noted()


# ------------------------------------------------------------------------------------- tables

@contextmanager
def _tables(known: 'Format', path: Path, options: LogOptions, members: Sequence[Member] = ()
            ) -> Iterator[OpenLog]:
    """Open the one of the tables of a file that has the accelerometer, and note why it is."""
    file = known.file(path)
    with ExitStack() as stack:
        with file.refused():
            members = members or known.read(path, stack)
        member, why = _member_of(file, members, options)
        log = _text(path / member.name, stack.enter_context(_opened(file, member, options)),
                    options)
        yield replace(log, read_as=', '.join(filter(None, (member.name, log.read_as))),
                      noted=lambda: (*why, *log.noted()))


@contextmanager
def _opened(file: LogFile, member: Member, options: LogOptions) -> Iterator[TextTable]:
    """Open a table as text; InputError if its bytes are of another format."""
    path = file.path
    with closing(member.parts()) as parts, io.BufferedReader(Stream(file, parts), PEEKED) as raw:
        name = member.name or (path.stem if path.suffix in containers.PACKED else path.name)
        inside = recognised(Path(name), raw.peek())
        if inside is not TEXT:
            what = inside.name if name == path.name else f'{name}, {inside.name}'
            raise InputError(f'{path} holds {what}, expected a table of text',
                             containers.UNPACK)
        yield text_table(path / member.name, options, raw, member.size)


def _member_of(file: LogFile, members: Sequence[Member], options: LogOptions
               ) -> tuple[Member, tuple[str, ...]]:
    """
    Return the table with the accelerometer, and a note on why if there are others.

    `options.topic` can name it; raise InputError if there is none, or several. Tables of linear
    acceleration come last, and tables whose names say that they are of an accelerometer first.

    """
    path, names = file.path, [member.name for member in members]
    if names == ['']:
        return members[0], ()
    wanted = [member for member in members if options.topic in ('', member.name)]
    if not 0 < len(names) <= _MOST_TABLES:
        raise InputError(f'{path} holds {len(names)} tables, expected 1 to {_MOST_TABLES}',
                         'check that this is the intended file')
    if not wanted:
        raise InputError(f'{path} has no table {options.topic}, expected one of {shown(names)}',
                         f'name one of these with --topic "{names[0]}"')
    tables: dict[Member, Chosen] = {}
    refused: list[InputError] = []
    for member in wanted:
        try:
            with _opened(file, member, options) as text:
                tables[member] = text.columns
        except InputError as err:
            refused.append(err)
    if not tables:
        damaged = [err for err in refused if isinstance(err, DamagedLogError)]
        if damaged or len(wanted) == 1:
            raise (damaged or refused)[0]
        raise InputError(f'{path} has the tables {shown(names)}, expected one of an accelerometer',
                         'export the table of the accelerometer, with gravity, or name one with '
                         f'--topic "{names[0]}" to see why it is not read')
    ranks = {member: (not record_instead(columns.layout.header, columns.layout.path), any(
        meaning(name).quantity == 'reading' or 'accel' in name.casefold()
        for name in (Path(member.name).stem, *columns.names('reading')[:1])))
        for member, columns in tables.items()}
    left = [member for member in tables if ranks[member] == max(ranks.values())]
    if len(left) > 1:
        raise InputError(f'{path} has {len(left)} tables of accelerometers, '
                         f'{shown([member.name for member in left])}, expected one',
                         f'choose one with --topic "{left[0].name}"')
    why = ('--topic names it' if options.topic else 'its name is that of an accelerometer'
           if len(tables) > 1 else 'no other one has an accelerometer')
    return left[0], (f'{left[0].name} is read of {len(names)} tables: {why}',) * (len(names) > 1)


def _text(path: Path, text: TextTable, options: LogOptions) -> OpenLog:
    cells = text.blocks()
    first = next(cells)
    quantities = decide_quantities(text.columns, first, options)
    if quantities.clock.newest_first:
        first, *rest = (each.take(slice(None, None, -1)) for each in [first, *cells][::-1])
        cells = iter(rest)
    about = {**text.layout.about, 'units': quantities.units.name}
    blocks = (Poses(*quantities.columns(block, str(path)), **about)
              for block in chain((first,), cells))
    poses = None
    samples: Iterator[Recording]
    with saying(', '.join(quantities.said)):
        head = next(blocks)
        is_recording = 'time' in head and are_samples(head.columns)
        if is_recording:
            check_order(head['time'], head.reading, str(path))
        check_units(head, quantities.units, str(path))
        if is_recording:
            samples = _without_empty_cells(chain((head,), blocks))
            count = len(head)
            if text.more:  # the size of the file, and the rows of this block, tell about how many
                width = 2 if text.layout.encoding.startswith('utf-16') else 1
                count = max(count, int(text.size / width / max(text.characters, 1) * count))
        else:
            rows = concatenated([head, *blocks])
            if 'time' not in rows and are_samples(rows.columns):
                raise InputError(
                    f'{path} has no times, but its {len(rows)} rows look like samples of a '
                    'recording, expected a column time', 'state the samples per second with '
                    '--rate HZ, or name the column with --columns time=NAME; if each row is a '
                    'pose, add a column orientation')
            poses = rows if options.partial else _without_holes(rows, quantities.findings)
            poses = replace(poses, findings=tuple(quantities.findings))
            samples, count = _as_samples(path, poses), len(poses)
    rate = [] if quantities.rate_hz is None else [f'{quantities.rate_hz:g} Hz (stated)']
    return OpenLog(
        blocks=samples, samples=count, units=quantities.units, sensor=head.sensor,
        read_as=', '.join([*quantities.said, *rate]), poses=poses,
        noted=lambda: (*text.notes, *quantities.all_notes), findings=tuple(quantities.findings))


def _without_empty_cells(blocks: Iterable[Poses]) -> Iterator[Recording]:
    """Yield samples; the context of a slower sensor is interpolated where it has empty cells."""
    last = dict[str, Floats]()
    for block in blocks:
        columns = {key: block[key] for key in CONTEXT if key in block}
        for key, values in columns.items():
            known, before = np.flatnonzero(np.isfinite(values)), last.get(key, values[:0])
            track = np.concatenate([before, values[known]])
            if len(track):
                columns[key] = np.interp(np.arange(len(values)), [-1] * len(before) + [*known],
                                         track)
            last[key] = track[-1:]
        yield Recording(**vars(block.with_columns(**columns)))


def _without_holes(poses: Poses, findings: list[Finding]) -> Poses:
    """Return poses without the columns of the context that have holes, which are findings."""
    for key in [key for key in (*CONTEXT, *poses.quantities) if key in poses]:
        holes = np.flatnonzero(~np.isfinite(poses[key]))
        if len(holes):
            findings.append(Finding(
                'not_used', f'{key} is not used, because of cells without a number '
                f'({len(holes)} of {len(poses)})', f'fill in the cells of {key} that have no '
                'number, or remove their rows', rows=tuple(poses.row[holes].tolist()),
                about=key))
            poses = poses.without_columns(key)
    return poses


def _as_samples(path: Path, poses: Poses) -> Iterator[Recording]:
    """Yield the rows of a table as samples, for a command that needs samples."""
    if 'time' not in poses:
        raise InputError(f'{path} has no column time, expected a recording', 'add the times of '
                         'the samples, or name their column with --columns time=NAME')
    yield Recording(**vars(poses))


# ---------------------------------------------------------------------------------- formats

@dataclass(frozen=True)
class Format:
    """
    A format of logs.

    Parameters
    ----------
    name : str
        What a file is, for messages.
    suffixes : tuple of str
        Suffixes of its files, in lower case.
    first : bytes
        Regular expression that the first bytes match; empty if only the suffix tells.
    read : function or None
        Function of a path and a stack of open files that returns the tables; for flight logs,
        `read_ulg` or `read_dataflash`.
    needs : str
        Package that has to be installed.
    advice : str
        What to do with a file that is not read; ``{}`` stands for its name.
    opened : function
        Function of the format, a path and `LogOptions` that opens a log.
    again : str
        What to do with a damaged file.
    plain : bool
        Whether it is text, which needs no child process.
    module : str
        Module that reads it, by default `needs`, which the server of the children imports.

    """

    name: str
    suffixes: tuple[str, ...]
    first: bytes
    read: Any = None
    needs: str = ''
    advice: str = ''
    opened: Callable[..., AbstractContextManager[OpenLog]] = _tables
    again: str = 'copy it again, or export the log as CSV'
    plain: bool = False
    module: str = ''

    def file(self, path: Path) -> LogFile:
        return LogFile(path, self.name, self.again, self.module or self.needs)


_EXPORT, _VEHICLE = 'export it as CSV with ', 'copy it from the vehicle again'
_ZIP = rb'PK\x03\x04'

FORMATS = (
    Format('a bag', ('.mcap', '.db3', '.bag'), rb'\x89MCAP0|SQLite format 3\0|#ROSBAG V',
           opened=_bag, needs='rosbags',
           module='rosbags.rosbag2',
           again='use another bag, or one file of it; mcap recover repairs an mcap file that is '
           'cut, and ros2 bag reindex a metadata.yaml'),
    Format('a PX4 log', ('.ulg',), rb'ULog\x01\x12\x35', read_ulg, 'pyulog', opened=_flight,
           again=_VEHICLE),
    Format('an ArduPilot log', ('.bin',), DATAFLASH, read_dataflash, 'pymavlink', opened=_flight,
           again=_VEHICLE),
    Format('an ArduPilot log as text', ('.log',), rb'(?:.*\n)?FMT, *\d+, *\d+, *\w+, *\w+',
           read_dataflash, opened=_flight, plain=True),
    Format('a NumPy file', ('.npy', '.npz'), rb'\x93NUMPY|' + _ZIP + rb'.*\.npyPK',
           containers.of_numpy),
    Format('an Excel file (.xlsx)', ('.xlsx', '.xlsm'), _ZIP + rb'.*xl/workbook\.xml',
           containers.sheets, 'openpyxl'),
    Format('an Excel file (.xls)', ('.xls',), rb'\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1',
           containers.old_sheets, 'xlrd'),
    Format('an ActiGraph log', ('.gt3x',), _ZIP + rb'.*log\.bin',
           advice=f'{_EXPORT}ActiLife, or with pygt3x'),
    Format('a ZIP archive', ('.zip',), _ZIP, containers.archived),
    Format('a MATLAB file', ('.mat',), rb'MATLAB 5\.0 MAT-file', containers.matlab,
           module='scipy.io'),
    Format('an HDF5 file', ('.h5', '.hdf5'), rb'\x89HDF\r\n|MATLAB 7\.3 MAT-file', containers.hdf5,
           'h5py'),
    Format('a Parquet file', ('.parquet',), b'PAR1', partial(containers.columnar, 'parquet'),
           'pyarrow'),
    Format('a Feather file', ('.feather', '.arrow'), b'ARROW1',
           partial(containers.columnar, 'ipc'), 'pyarrow'),
    Format('JSON lines', ('.jsonl', '.ndjson'), rb'\s*\{[^\n]*\}\s*\n\s*\{',
           partial(containers.lines, 'json'), plain=True),
    Format('a JSON file', ('.json',), rb'\s*(?:\{\s*"|\[\s*(?:\{|\[\s*[-"\d]))',
           containers.json_document, plain=True),
    Format('lines of InfluxDB', ('.lp',), rb'(?:#[^\n]*\n)*[^\s,=]+(?:,[^\s=]+=[^\s]+)* '
           rb'[^\s=]+=[-\d.]+[iu]?(?:,[^\s=]+=[^\s]+)* \d{9,19}\s',
           partial(containers.lines, 'influx'), plain=True),
    Format('a log of the Betaflight blackbox', ('.bbl', '.bfl'),
           b'H Product:Blackbox flight data recorder', advice='decode it with blackbox_decode {}'),
    Format('a telemetry log of MAVLink', ('.tlog',), b'', advice='use the .bin log of the '
           'vehicle, or mavlogdump.py --format csv --types RAW_IMU {}'),
    Format('a GENEActiv log', ('.bin',), b'Device Identity',
           advice=f'{_EXPORT}the GENEActiv software, or with GENEAread in R'),
    Format('an Axivity log', ('.cwa',), rb'MD\xfc\x03', advice=f'{_EXPORT}OmGui or cwa-convert'),
    Format('an XDF file', ('.xdf', '.xdfz'), b'XDF:', advice='load it with pyxdf, and store time '
           'and readings as CSV'),
    Format('an enDAQ log', ('.ide',), rb'\x1a\x45\xdf\xa3',
           advice=f'{_EXPORT}enDAQ Lab, or with idelib'),
    Format('a stream of WitMotion frames', (), rb'.{0,10}?(?:\x55[\x50-\x5a].{9}){3}',
           advice='record it with the WitMotion software, which writes text'),
    Format('a Shimmer log', (), rb'.{30}\0[\x03\x0a]..\0[\x01-\x03]\0',
           advice=f'{_EXPORT}Consensys, or read it with pyshimmer'),
    Format('a NilsPod log', (), rb'[\x30-\x40]...[\x01\x02\x04\x05\x0a\x14\x28\x50\xa0]'
           rb'[\x10\x20\x40\x80][\0-\x02].[\x02\x04\x08\x10]',
           advice='load it with nilspodlib, and store the readings as CSV'),
    Format('a calibration', (), FIRST_LINE.encode(), advice='use the log or the table that it was '
           'made from; most commands take a calibration with -c'),
    Format('a packed file', tuple(containers.PACKED),
           b'|'.join(first for first, _ in containers.PACKED.values()), containers.text),
    Format('text', ('.csv', '.tsv', '.txt', '.log'), b'', containers.text, plain=True))
"""The formats; of several that fit, the first one counts."""

BAG, TEXT = FORMATS[0], FORMATS[-1]

SUFFIXES = tuple(dict.fromkeys(
    suffix for each in FORMATS if not each.advice for suffix in each.suffixes))
"""Suffixes of the formats that are read."""


def recognised(path: Path, head: bytes) -> Format:
    """Return the format of a file with these first bytes."""
    suffix = path.suffix.lower()
    is_binary = b'\0' in head
    fitting = (each for each in FORMATS if each.first and re.match(each.first, head, re.DOTALL))
    named = (each for each in FORMATS
             if suffix in each.suffixes and (is_binary or not each.first))
    return next(chain(fitting, named), TEXT)


def is_bag(path: Path) -> bool:
    """Return whether a path names a bag rather than a table."""
    return path.is_dir() or path.suffix.lower() in BAG.suffixes


@contextmanager
def open_log(path: Path | Piped | Frame, options: LogOptions = LogOptions()) -> Iterator[OpenLog]:
    """
    Open a log of any kind: text, a bag, a flight log of PX4 or ArduPilot, or a DataFrame.

    Parameters
    ----------
    path : Path, Piped or Frame
        The file, the folder of a rosbag2, standard input, or the DataFrame.
    options : LogOptions
        How to read it; by default it is recognised.

    Raises
    ------
    InputError
        If the log cannot be read, has no accelerometer or several, contradicts the options, or
        holds no gravity; also while it is read.
    OSError
        If the file cannot be read.

    """
    if isinstance(path, Path):
        known = BAG
        if not path.is_dir():
            check_regular(path)
        if not is_bag(path):
            with path.open('rb') as file:
                head = file.read(_HEAD)
                file.seek(max(file.tell(), path.stat().st_size - _TAIL))
                known = recognised(path, head + file.read())
            if known is BAG:
                raise InputError(f'{path} holds a bag, expected the suffix of one: '
                                 f'{", ".join(BAG.suffixes)}',
                                 'rename it')
        if known.advice:
            raise InputError(f'{path} is {known.name}, expected a log or a table that is read',
                             known.advice.format(path.name))
        if known.needs and find_spec(known.needs) is None:
            with needing(known.needs, known.name):
                raise ImportError(f'no module {known.needs}')
        opened = (known.opened if known.plain else _binary)(known, path, options)
    else:
        opened = _tables(TEXT, Path(str(path)), options, [path.table])
    with opened as log, saying(log.read_as):
        yield log


def read_poses(path: Path, *, partial: bool = False) -> Poses:
    """
    Return the poses of a pose table; a recording is an InputError, as others in `open_log`.

    `partial`: columns of the context with empty cells, which are NaN, are kept.

    """
    with open_log(path, LogOptions(partial=partial)) as log:
        if log.poses is not None:
            return log.poses
        raise InputError(f'{path} is a recording of {counted(sum(map(len, log.blocks)), "sample")}'
                         ', expected a pose table', 'use capture')


def read_recording(path: Path, topic: str = '', sensor: str = '', *, in_child: bool = True
                   ) -> Recording:
    """Return all samples of a recording; options as in `LogOptions`, errors as in `open_log`."""
    with open_log(path, LogOptions(topic=topic, sensor=sensor, in_child=in_child)) as log:
        return concatenated(list(log.blocks))
