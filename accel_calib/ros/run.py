# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Start, spin and end a node cleanly, however the user ends it."""

from __future__ import annotations

import gc
from importlib import import_module
import signal
import sys
from typing import TYPE_CHECKING

from ..errors import AccelCalibError

if TYPE_CHECKING:
    from collections.abc import Sequence

    from rclpy.executors import Executor

_OK, _BAD_INPUT = 0, 2

_LOOK_EVERY = 0.25
"""Interval at which the shutdown of ROS is checked [s]."""

_SWITCH = 1e-4
"""Time after which another thread gives the interpreter to a message [s]."""


def run(node: str, args: Sequence[str] | None = None) -> int:
    """
    Run a node until it is ended.

    Parameters
    ----------
    node : str
        ``module:class`` of the node, in this package.
    args : sequence of str, optional
        Command line with the name of the program first; default: that of the process.

    Returns
    -------
    int
        Exit status: 0, or 2 if the input or ROS itself is missing or wrong.

    """
    try:
        return _run(node, args)
    except KeyboardInterrupt:
        return _OK


def _run(node: str, args: Sequence[str] | None) -> int:
    """Start ROS, run the node, end ROS."""
    try:
        import rclpy
    except ImportError as error:
        return _refuse(f'ROS 2 is not installed ({error}), expected rclpy of ROS 2 Jazzy; source '
                       "/opt/ros/jazzy/setup.bash, or pip install 'accel_calib[ros]'")
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
        # Under launch a Ctrl-C comes twice, and the second would cut the shutdown short.
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        rclpy.try_shutdown()
    return _OK


def _spin(node: str) -> None:
    """Create the node and spin it."""
    from rclpy.executors import ExternalShutdownException
    from rclpy.task import Future
    module, name = node.split(':')
    instance = getattr(import_module(module, __package__), name)()
    executor = _executor()
    executor.add_node(instance)
    sys.setswitchinterval(_SWITCH)
    gc.freeze()  # what exists now stays; to scan it again would take tens of ms
    try:
        instance.start()
        while instance.context.ok():
            # EventsExecutor.spin() ignores signals, and one future would keep each of these calls.
            executor.spin_until_future_complete(Future(), timeout_sec=_LOOK_EVERY)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError:
        if instance.context.ok():
            raise  # otherwise a callback was publishing while a signal came
    finally:
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        instance.close()
        executor.shutdown()
        instance.destroy_node()


def _executor() -> Executor:
    """Return the executor that costs least."""
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor
        return SingleThreadedExecutor()
    return EventsExecutor()


def _refuse(line: str) -> int:
    print(f'accel-calib: {line}', file=sys.stderr)
    return _BAD_INPUT
