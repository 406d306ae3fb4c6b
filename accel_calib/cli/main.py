# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

# PYTHON_ARGCOMPLETE_OK
"""
The command ``accel-calib``.

Only what the requested command needs is imported, so that ``--help`` does not wait for numpy. The
first imports are few, because Ctrl-C ends the program without words only after them.

"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
import os
import signal
import sys
from threading import current_thread, main_thread

INTERRUPTED = 130
_STANDARD_ERROR = 2
NOT_READ = 141
"""Exit status of a program that SIGPIPE ends."""


def main(arguments: Sequence[str] | None = None) -> int:
    """
    Run a command, and return the exit status.

    It is 0; 1 if a result is BAD or a requested check fails; 2 for invalid input or an internal
    error, with one line on standard error.

    """
    with _leaving():
        from .commands import parser
        from .options import BAD_INPUT, in_one_line
        from ..errors import (
            AccelCalibError, crash_words, hide_warnings, known_error, use_one_thread)

        use_one_thread()
        _open_streams()
        if '_ARGCOMPLETE' in os.environ:
            with suppress(ImportError):  # the shell then shows no completions
                import argcomplete

                argcomplete.autocomplete(parser())  # prints them, and exits
        if arguments is None:
            hide_warnings()
        given = sys.argv[1:] if arguments is None else list(arguments)
        at = given.index('--ros-args') if '--ros-args' in given else len(given)
        own = given[:at]
        top = parser(own[:1])
        args = top.parse_command(own, own[0] if own else '')
        if not args.command:
            top.print_help()
            return 0
        args.for_ros = given[at:]
        from .frame import run  # imports numpy and rich

    try:
        return run(args)
    except BrokenPipeError:  # `accel-calib … | head`: nobody reads the rest
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return NOT_READ
    except (AccelCalibError, OSError) as err:
        line = str(known_error(err))
    except KeyboardInterrupt:
        return INTERRUPTED
    except Exception as err:  # a defect of this program, which no user should see as a traceback
        line = crash_words(err)
    finally:
        if arguments is None:  # Python's own end would print that it was interrupted
            signal.signal(signal.SIGINT, signal.SIG_IGN)
    print(f'accel-calib {args.command}: {in_one_line(line)}', file=sys.stderr)
    return BAD_INPUT


@contextmanager
def _leaving() -> Iterator[None]:
    """Let Ctrl-C end the program without words, while modules load and nothing is written."""
    before = signal.getsignal(signal.SIGINT)
    if before == signal.SIG_IGN or current_thread() is not main_thread():
        yield  # a command in the background, or not the thread that gets Ctrl-C
        return
    signal.signal(signal.SIGINT, lambda number, frame: os._exit(INTERRUPTED))
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _open_streams() -> None:
    """
    Open what is closed of the standard streams, so that no other file gets its number.

    Standard output and error replace the characters that their encoding lacks.

    """
    while (number := os.open(os.devnull, os.O_RDWR)) <= _STANDARD_ERROR:
        pass
    os.close(number)
    for name, mode in (('stdin', 'r'), ('stdout', 'w'), ('stderr', 'w')):
        if getattr(sys, name) is None:
            setattr(sys, name, open(os.devnull, mode, encoding='utf-8'))  # noqa: SIM115
    from .options import plain_handler

    for stream in (sys.stdout, sys.stderr):
        if hasattr(stream, 'reconfigure'):
            stream.reconfigure(errors=plain_handler())


if __name__ == '__main__':
    sys.exit(main())
