# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Reading of binary files in a child process with limits.

Libraries in C parse binary files, and one wrong byte can end their process, or let them allocate
without end. A child process therefore runs them: a generator function that yields the content of
a file, which `parts_of` yields again here. The child has limits, which grow with the file: of the
memory that it needs beyond its start, of the processor time until the next part, of what it sends,
and of its temporary files. However it ends, the error is one line that names the file.

**Start.** An interpreter with numpy and rosbags takes half a second to start. A server process
does so once. It opens no file: for each file it forks a child, within milliseconds. This is safe
because the server has one thread, which a process with ROS or matrices has not. The server starts
with the first file and ends with this process, also if this is killed, because its socket is then
closed. It ends all children then. A child also ends as soon as `parts_of` is left.

**Format.** A part is JSON, followed by the bytes of its arrays. Damaged bytes could make the child
send anything, so nothing that it sends is unpickled. Only numbers, text and the records of
`_RECORDS`, which check themselves, are made of it. Arrow would have the same properties, but not
every installation has it. What this process sends to the child is trusted, and pickled.

"""

import atexit
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, ExitStack, suppress
from dataclasses import dataclass, is_dataclass
import errno
from functools import cache, partial
from importlib import import_module
import json
import math
import os
from pathlib import Path
import pickle
import re
import resource
import signal
import socket
import subprocess
import sys
import tempfile
from threading import Lock
import time
from typing import Any, NoReturn

import numpy as np

from ..errors import AccelCalibError, DamagedLogError, InputError, ONE_THREAD, saying
from ..finding import Finding
from ..table import Autopilot, Poses, Recording
from ..text import reason
from ..units import Units

_MB = 1 << 20
_MEMORY, _MEMORY_PER_BYTE = 1024 * _MB, 16
"""Memory of a child beyond its start [bytes], and more of it for each byte of the file."""

_SENT, _SENT_PER_BYTE = 256 * _MB, 256
"""Size of all parts, and of a temporary file [bytes], and more of it for each byte of the file;
LZ4 reaches at most 255."""

_PATIENCE_S, _BYTES_PER_S = 30, 5e5
"""Processor time until the next part [s], and number of bytes of the file that need 1 s more."""

_RECORDS: dict[str, Callable[..., Any]] = {
    each.__name__: each for each in (Autopilot, Finding, Poses, Recording, Units)}
_ERRORS = {each.__name__: each for each in (InputError, DamagedLogError, OSError)}
_ARRAY, _KINDS = 'array of', 'biufSU'
"""Key of an array in JSON, and kinds of its elements: numbers and text."""

_START = ('import sys; sys.path[:] = sys.argv[1:]; '
          f'from {__name__} import serve; serve()')
"""Code of the server. The current folder is not searched for modules: it may hold any file."""

# The pools of Arrow and of other threads would reserve more than the limit of memory.
_ENVIRONMENT = {**ONE_THREAD, 'ARROW_DEFAULT_MEMORY_POOL': 'system', 'MALLOC_ARENA_MAX': '1'}

_BY_VALUE = (None, errno.EINVAL, errno.EOVERFLOW, errno.EISDIR, errno.EFBIG, errno.ENAMETOOLONG,
             errno.ENOTDIR)
"""System errors that a damaged size or place in a file causes; others are not about its bytes."""

_PID_BYTES, _LENGTH_BYTES = 4, 8


@dataclass(frozen=True)
class LogFile:
    """
    A binary file to be read.

    `expected` is what it should be, `advice` what to do if it is damaged, and `module` the one
    that reads it, which the server imports once.

    """

    path: Path
    expected: str
    advice: str
    module: str = ''

    def limits(self) -> tuple[int, int, int]:
        """Return the limits: memory [bytes], what is sent [bytes], and processor time [s]."""
        files = self.path.iterdir() if self.path.is_dir() else [self.path]
        size = sum(each.stat().st_size for each in files if each.exists())
        return (_MEMORY + _MEMORY_PER_BYTE * size, _SENT + _SENT_PER_BYTE * size,
                math.ceil(_PATIENCE_S + size / _BYTES_PER_S))

    def damaged(self, why: str) -> DamagedLogError:
        return DamagedLogError(f'{self.path} is damaged ({why}), expected {self.expected}',
                               self.advice)

    @contextmanager
    def refused(self) -> Iterator[None]:
        """
        Turn what libraries raise for damaged bytes into a DamagedLogError.

        Errors of the system, such as a missing file or permission, pass.

        """
        try:
            yield
        except AccelCalibError:
            raise
        except MemoryError as err:
            raise self.damaged('it needs more memory than a file of its size may') from err
        except Exception as err:  # libraries raise errors of any class
            if isinstance(err, OSError) and err.errno not in _BY_VALUE:
                raise
            why = re.sub(r'\S*/accel_calib_\w+/[^\s:]*', self.path.name, reason(err))
            raise self.damaged(why) from err


@contextmanager
def parts_of(file: LogFile, function: Callable[..., Generator[Any]], *given: Any,
             in_child: bool) -> Iterator[Iterator[Any]]:
    """
    Yield the iterator over what a module-level generator function yields of a file.

    Parameters
    ----------
    file : LogFile
        The file; its path is the first argument of the function.
    function, given
        The function and its further arguments. It yields numbers, text, arrays, records of
        `_RECORDS`, and lists and mappings of those.
    in_child : bool
        Whether it runs in a child process with limits, rather than in this one.

    Raises
    ------
    InputError
        From the iterator: if the file is damaged, or exceeds a limit.
    OSError
        From the iterator: if the file cannot be read.

    """
    with ExitStack() as stack:
        if not in_child:
            yield _guarded(file, stack.enter_context(closing(function(file.path, *given))))
            return
        # Here, so that it is removed although the child is killed.
        folder = stack.enter_context(tempfile.TemporaryDirectory(prefix='accel_calib_'))
        here = None if file.path.is_absolute() else os.getcwd()
        task, (ours, theirs) = (here, folder, file.limits()), socket.socketpair()
        server, stream = _server(os.getpid()), stack.enter_context(ours.makefile('rb'))
        stack.enter_context(ours)
        with theirs:
            pid = server.ask(file.module.encode() or b'-', theirs.fileno())
        if not pid:
            raise InputError(f'{file.path} cannot be read: its reader, {sys.executable}, does not '
                             'start', 'check the installation of Python')
        ended = cache(partial(server.ask, pid.to_bytes(_PID_BYTES, 'little')))
        stack.callback(ended)
        with suppress(ConnectionError):  # its end is found when the first part is read
            ours.sendall(pickle.dumps((file, function, given, task)))
        yield _guarded(file, _received(file, stream, ended))


def _guarded(file: LogFile, parts: Iterator[Any]) -> Iterator[Any]:
    """Yield parts; what is raised while they are made, but not where they are used, is refused."""
    while True:
        with file.refused():
            part = next(parts, file)
        if part is file:
            return
        yield part


# ------------------------------------------------------------------------- parts on a stream

def _send(stream: Any, kind: str, content: Any) -> None:
    arrays = []

    def plain(value: Any) -> Any:
        if isinstance(value, np.ndarray):
            arrays.append(value)
            return {_ARRAY: (value.dtype.str, value.shape)}
        if is_dataclass(value):
            return {type(value).__name__: vars(value)}
        return value.item()  # a number of numpy

    text = json.dumps((kind, content), default=plain).encode()
    stream.write(len(text).to_bytes(_LENGTH_BYTES, 'little') + text)
    for each in arrays:
        stream.write(each.tobytes())
    stream.flush()


def _made(taken: Callable[[int], bytearray], value: dict[str, Any]) -> Any:
    """Return an array or a record of an object in JSON; a function takes bytes from the stream."""
    key = next(iter(value)) if len(value) == 1 else ''
    if key == _ARRAY:
        kind, shape = np.dtype(value[key][0]), value[key][1]
        if kind.kind not in _KINDS:
            raise ValueError(f'its reader sends an array of {kind}')
        return np.ndarray(shape, kind, taken(kind.itemsize * math.prod(shape)))
    if key in _RECORDS:
        return _RECORDS[key](**{name: tuple(each) if isinstance(each, list) else each
                                for name, each in value[key].items()})
    return value


def _received(file: LogFile, stream: Any, ended: Callable[[], int]) -> Iterator[Any]:
    """Yield the parts that a child sends; `ended` ends it, and returns its exit status."""
    most = left = file.limits()[1]

    def taken(size: int) -> bytearray:
        nonlocal left
        left -= size
        if left < 0:
            raise InputError(f'{file.path} holds more than {most} bytes of samples, expected at '
                             'most as many for its size', 'use another file')
        data = bytearray(size)
        if stream.readinto(data) < size:
            raise EOFError
        return data

    while True:
        try:
            size = int.from_bytes(taken(_LENGTH_BYTES), 'little')
            kind, content = json.loads(taken(size), object_hook=partial(_made, taken))
        except (EOFError, ConnectionError):
            status = ended()
            raise file.damaged(
                f'its reader ended with status {status}' if status >= 0 else
                f'its reader needed more than {file.limits()[2]} s of processor time until the '
                'next samples' if status == -signal.SIGXCPU else
                f'its reader ended by {signal.Signals(-status).name}') from None
        if kind == 'end':
            return
        if kind == 'part':
            yield content
        else:
            with saying(content[1]):
                raise _ERRORS[kind](*content[0])


# ------------------------------------------------------------------------------- the server

class _Server:
    """The process that forks a child for each file."""

    def __init__(self, _: int) -> None:
        self._turn = Lock()
        self._process: subprocess.Popen[bytes] | None = None
        atexit.register(self.close)

    def ask(self, request: bytes, *streams: int) -> int:
        """
        Start or end a child; 0 if the server does not answer.

        With a stream, the request is a module to import, and the id of a child is returned that
        reads its task from the stream. Otherwise it is the id of a child, which is ended at once
        unless it has ended, and its exit status is returned.

        """
        with self._turn:
            try:
                if self._process is None:
                    self._socket, theirs = socket.socketpair()
                    path = [*filter(None, sys.path), str(Path(__file__).parents[2])]
                    with theirs:
                        # In its own session it does not receive the Ctrl-C of a terminal.
                        self._process = subprocess.Popen(
                            [sys.executable, '-c', _START, *path], stdin=theirs.fileno(),
                            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
                            start_new_session=True, env={**os.environ, **_ENVIRONMENT})
                socket.send_fds(self._socket, [request], streams)
                if answer := self._socket.recv(_PID_BYTES):
                    return int.from_bytes(answer, 'little', signed=True)
                raise ConnectionError
            except OSError:
                self.close()
                return 0
            except BaseException:  # of a signal: its answer may still come
                self.close()
                raise

    def close(self) -> None:
        """End the server and its children."""
        if self._process is not None:
            self._socket.close()
            self._process.wait()
            self._process = None


_server = cache(_Server)
"""The server of the process with an id; a copy of it that was forked needs another one."""


def serve() -> None:
    """Start and end children until the socket is closed; the main function of the server."""
    asks = socket.socket(fileno=sys.stdin.fileno())
    import_module('accel_calib.logs')
    children = set[int]()
    while True:
        request, streams, *_ = socket.recv_fds(asks, 256, 1)
        if streams:
            with suppress(ImportError):  # the child raises it again
                import_module(request.decode())
            answer = os.fork()
            if not answer:
                asks.close()
                _read(socket.socket(fileno=streams[0]))
            os.close(streams[0])
            children.add(answer)
        elif request:
            pid = int.from_bytes(request, 'little')
            answer = _ended(pid) if pid in children else 0
            children.discard(pid)
        else:
            break
        asks.sendall(answer.to_bytes(_PID_BYTES, 'little', signed=True))
    for pid in children:
        _ended(pid)


def _ended(pid: int) -> int:
    os.kill(pid, signal.SIGKILL)  # no effect on a process that has ended and was not waited for
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


# -------------------------------------------------------------------------------- the child

def _read(connected: socket.socket) -> NoReturn:
    """Run the task on a stream, and end this process."""
    status = 1
    try:
        stream = connected.makefile('rwb')
        file, function, given, (here, folder, limits) = pickle.load(stream)
        if here:
            os.chdir(here)
        tempfile.tempdir, (memory, sent, seconds) = folder, limits
        _limit(resource.RLIMIT_CORE, 0)
        pages = int(Path('/proc/self/statm').read_text(encoding='ascii').split()[0])
        _limit(resource.RLIMIT_AS, pages * resource.getpagesize() + memory)
        _limit(resource.RLIMIT_FSIZE, sent)
        _limit(resource.RLIMIT_CPU, seconds)
        try:
            for part in _guarded(file, function(file.path, *given)):
                _send(stream, 'part', part)
                _limit(resource.RLIMIT_CPU, math.ceil(time.process_time()) + seconds)
            _send(stream, 'end', None)
        except AccelCalibError as err:
            _send(stream, type(err).__name__, (err.args, err.read_as))
        except OSError as err:
            _send(stream, 'OSError', ((err.errno, err.strerror, err.filename), ''))
        status = 0
    finally:
        os._exit(status)


def _limit(kind: int, value: int) -> None:
    most = resource.getrlimit(kind)[1]
    resource.setrlimit(kind, (value if most == resource.RLIM_INFINITY else min(value, most), most))
