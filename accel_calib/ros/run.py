# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The executables: start, spin and shut down a node, also after Ctrl-C and other signals.

A signal stops the executor, and the node then ends between two callbacks. The handlers of rclpy
would shut down ROS in another thread, so that a callback could fail at every line that uses ROS.

``calibrator_lifecycle`` is the calibrator as a managed node:

==============  ==========================================================================
transition      effect
==============  ==========================================================================
``configure``   reads the parameters and loads the calibration; poses can be captured
``activate``    publishes corrected messages
``deactivate``  stops publishing them
``cleanup``     closes the files
==============  ==========================================================================

"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from difflib import get_close_matches
from functools import partial
import gc
from importlib import import_module
import os
import random
import signal
from socket import AF_INET, SOCK_DGRAM, socket
import sys
from threading import Thread
from typing import Any

from ..errors import AccelCalibError, hide_warnings, InputError, NEEDS_ROS, use_one_thread

_OK, _BAD_INPUT = 0, 2

_TURN = 3600.0
"""Time limit of a call of the executor [s]."""

_SIGNALS = (signal.SIGINT, signal.SIGTERM)
"""Signals that end a node."""

_SWITCH = 1e-4
"""Switch interval of the interpreter [s]; the longest wait of a message for another thread."""


def run(node: str, args: Sequence[str] | None = None) -> int:
    """
    Run a node until it is ended; return 0, or 2 if the input is invalid or ROS is not available.

    The node is ``module:class`` in this package. `args` is the command line, starting with the
    program name; by default that of the process.

    """
    use_one_thread()
    if args is None:
        hide_warnings()
    came, written = os.pipe()
    os.set_blocking(written, False)
    signal.set_wakeup_fd(written, warn_on_full_buffer=False)
    for number in _SIGNALS:
        signal.signal(number, lambda number, frame: None)  # Python writes to the pipe
    module, name = node.split(':')
    try:
        with started(args, 'check the parameters and arguments'):
            _spin(getattr(import_module(module, __package__), name)(), came)
    except AccelCalibError as error:
        print(f'accel-calib: {error}', file=sys.stderr)
        return _BAD_INPUT
    finally:
        # Under launch, Ctrl-C arrives twice; Python would raise the second one while it exits.
        for number in _SIGNALS:
            signal.signal(number, signal.SIG_IGN)
        signal.set_wakeup_fd(-1)
    return _OK


calibrator = partial(run, '.calibrator_node:CalibratorNode')
calibrator_lifecycle = partial(run, '.calibrator_node:ManagedCalibrator')
simulator = partial(run, '.simulator_node:SimulatorNode')

EXECUTABLES = {'calibrator': calibrator, 'calibrator_lifecycle': calibrator_lifecycle,
               'simulator': simulator}
"""The executables by name: ``python -m accel_calib.ros.run calibrator``."""


@contextmanager
def started(args: Sequence[str] | None, advice: str) -> Iterator[None]:
    """Start ROS, and shut it down at the end; the process keeps its signal handlers."""
    try:
        import rclpy
    except ImportError as error:
        raise InputError(f'ROS 2 is not installed ({error}), expected rclpy of ROS 2 Jazzy',
                         NEEDS_ROS) from error
    from rclpy.signals import SignalHandlerOptions
    try:
        rclpy.init(args=args, signal_handler_options=SignalHandlerOptions.NO)
    except RuntimeError as error:
        raise InputError(f'ROS 2 does not start: {str(error).splitlines()[0]}', advice) from error
    try:
        yield
    finally:
        # rclpy.try_shutdown() would also restore signal handlers, for an instant the default ones.
        rclpy.get_default_context().try_shutdown()


def _spin(node: Any, came: int) -> None:
    """Run a node until a signal came."""
    from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
    from rclpy.task import Future
    try:
        from rclpy.experimental import EventsExecutor as Executor  # it has the least overhead
    except ImportError:
        Executor = SingleThreadedExecutor
    executor, ended = Executor(), Future()

    def end() -> None:
        """Wait for a signal and end the node; a busy executor does not return after `_TURN`."""
        os.read(came, 1)
        ended.set_result(None)

    executor.add_node(node)
    sys.setswitchinterval(_SWITCH)
    try:
        node.start()
        known = list(node.get_parameters_by_prefix(''))
        for name in node._parameter_overrides:
            if not name.startswith('qos_overrides.') and not node.has_parameter(name):
                near = ' or '.join(get_close_matches(name, known)) or 'one of ros2 param list'
                node.get_logger().error(
                    f'there is no parameter {name}, expected {near}: correct the name')
        gc.freeze()  # permanent objects are not scanned again, which would take tens of ms
        Thread(target=end, daemon=True).start()
        while node.context.ok() and not ended.done():
            # Without a time limit, EventsExecutor has a busy loop. Each call leaks 35 bytes.
            executor.spin_until_future_complete(ended, timeout_sec=_TURN)
    except ExternalShutdownException:
        pass  # the node has ended itself
    finally:
        node.close()
        executor.shutdown()
        node.destroy_node()


_DOMAINS = range(1, 102)

_PARTICIPANTS = 10
"""Number of participants whose ports show that a domain is in use."""


@contextmanager
def own_domain(domains: Sequence[int] = _DOMAINS) -> Iterator[int]:
    """
    Yield a DDS domain that nobody else on this machine uses.

    Of the UDP ports of a domain, DDS does not use the third one. This process holds it, so that
    other processes with a domain of this function have another one. A domain in which somebody
    else has a participant is left out, too: a node may be left over from a program that was
    killed. AccelCalibError if all domains are in use.

    """
    for domain in random.SystemRandom().sample(domains, len(domains)):
        ports = 7400 + 250 * domain
        with socket(AF_INET, SOCK_DGRAM) as held:
            try:
                held.bind(('127.0.0.1', ports + 2))
                for number in range(_PARTICIPANTS):
                    with socket(AF_INET, SOCK_DGRAM) as participant:
                        participant.bind(('', ports + 10 + 2 * number))
            except OSError:
                continue
            yield domain
            return
    raise AccelCalibError(f'the DDS domains {domains[0]} to {domains[-1]} are all in use',
                          'end demonstrations or tests that still run')


if __name__ == '__main__':
    sys.exit(EXECUTABLES[sys.argv[1]](sys.argv[1:]))
