# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Start, spin and shut down a node, also after Ctrl-C and other signals."""

from __future__ import annotations

import gc
from importlib import import_module
import signal
import sys
from typing import TYPE_CHECKING

from ..errors import AccelCalibError, NEEDS_ROS

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rclpy.executors import Executor

_OK, _BAD_INPUT = 0, 2

_LOOK_EVERY = 0.5
"""Interval at which the shutdown of ROS is checked [s]."""

_SWITCH = 1e-4
"""Switch interval of the interpreter [s]; the longest wait of a message for another thread."""


def run(node: str, args: Sequence[str] | None = None) -> int:
    """
    Run a node until it is ended.

    Parameters
    ----------
    node : str
        ``module:class`` of the node, in this package.
    args : sequence of str, optional
        Command line, starting with the program name; by default that of the process.

    Returns
    -------
    int
        Exit status: 0, or 2 if the input is invalid or ROS is not available.

    """
    try:
        return _run(node, args)
    except KeyboardInterrupt:
        return _OK


def _run(node: str, args: Sequence[str] | None) -> int:
    """Start ROS, run the node, and shut down ROS."""
    try:
        import rclpy
    except ImportError as error:
        return _refuse(f'ROS 2 is not installed ({error}), expected rclpy of ROS 2 Jazzy; '
                       f'{NEEDS_ROS}')
    from rclpy.executors import ExternalShutdownException
    try:
        rclpy.init(args=args)
    except RuntimeError as error:
        return _refuse(f'ROS 2 does not start: {str(error).splitlines()[0]}; check the '
                       'parameters and arguments')
    try:
        _spin(node)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except AccelCalibError as error:
        return _refuse(str(error))
    finally:
        # Under launch, Ctrl-C arrives twice; the second one would interrupt the shutdown.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        rclpy.try_shutdown()
    return _OK


def _spin(node: str) -> None:
    """Create the node and spin it."""
    import rclpy
    from rclpy.executors import ExternalShutdownException
    from rclpy.task import Future
    module, name = node.split(':')
    try:
        instance = getattr(import_module(module, __package__), name)()
        executor = _executor()
        executor.add_node(instance)
    except Exception:  # rclpy has many errors for a context that a signal has shut down
        if rclpy.ok():
            raise
        return
    sys.setswitchinterval(_SWITCH)
    gc.freeze()  # permanent objects are not scanned again, which would take tens of ms
    try:
        instance.start()
        while instance.context.ok():
            # EventsExecutor.spin() ignores signals. Each call leaks 35 bytes in rclpy 7.1.
            executor.spin_until_future_complete(Future(), timeout_sec=_LOOK_EVERY)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        if instance.context.ok():
            raise  # otherwise a signal came while a callback was publishing
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        instance.close()
        executor.shutdown()
        instance.destroy_node()


def _executor() -> Executor:
    """Return the executor with the least overhead."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor
        return SingleThreadedExecutor()
    return EventsExecutor()


def _refuse(line: str) -> int:
    print(f'accel-calib: {line}', file=sys.stderr)
    return _BAD_INPUT
