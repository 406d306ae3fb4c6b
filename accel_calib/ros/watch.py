# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
Receive the progress of a calibrator node.

The node publishes ``~/progress`` up to four times per second while somebody listens, and at least
once per second. A longer silence therefore means that the node or the network is down.

"""

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from time import monotonic

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.exceptions import InvalidTopicNameException
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node

from .declare import LATCHED
from .run import started
from ..errors import InputError
from ..session import Progress

Show = Callable[[str, Progress | None, str], None]
"""Function of the name of the node, its progress (None: no message yet), and a problem or ''."""

_LOOK_EVERY = 0.1
"""Longest wait for a message before the end is checked [s]."""

_FIRST = 6.0
"""Longest wait for the first message [s]; DDS repeats a lost announcement after 3 s."""

_SILENT = 3.0
"""Longest wait for the next message [s]."""

_NEXT = 1.5
"""Wait for a second message [s]; the first one may have been published long ago."""

_SUFFIX = '/progress'


class _Receiver(Node):
    """The progress of a calibrator: full name, such as ``/left/calibrator``, and messages."""

    def __init__(self, name: str) -> None:
        # A leading underscore hides the node from ros2 node list.
        super().__init__('_accel_calib_watch', enable_rosout=False, start_parameter_services=False)
        self.arrived = monotonic()  # of the last message, or the start
        self.progress: Progress | None = None
        self.received = 0
        try:
            found = self.create_subscription(
                DiagnosticStatus, f'{name.rstrip("/")}{_SUFFIX}', self._on_message, LATCHED)
        except InvalidTopicNameException as err:
            raise InputError(f'--node is {name!r}, expected the name of a node',
                             'set it to a name such as calibrator or left/calibrator') from err
        self._topic = found.topic_name
        self.calibrator = self._topic.removesuffix(_SUFFIX)

    def _on_message(self, message: DiagnosticStatus) -> None:
        self.progress = Progress.from_figures({each.key: each.value for each in message.values})
        self.arrived = monotonic()
        self.received += 1

    def problem(self) -> tuple[str, ...]:
        """Return what was found and expected, and what to do, if a message is overdue."""
        if monotonic() - self.arrived <= (_SILENT if self.received else _FIRST):
            return ()
        topic = self._topic
        others = [name.removesuffix(_SUFFIX) for name, kinds in self.get_topic_names_and_types()
                  if name.endswith(_SUFFIX) and 'diagnostic_msgs/msg/DiagnosticStatus' in kinds
                  and name != topic and self.count_publishers(name)]
        expected = f'expected a message on {topic} every second'
        if self.count_publishers(topic):
            return (f'{self.calibrator} sends no message, {expected}',
                    'check that the node still runs, and the network')
        if others:
            return (f'found {" and ".join(sorted(others))}, but not {self.calibrator}, {expected}',
                    f'set --node {min(others).lstrip("/")}')
        return (f'found no calibrator {self.calibrator}, {expected}',
                'start it with accel-calib node, or check --node and ROS_DOMAIN_ID')


def watch(name: str, show: Show, is_over: Callable[[], bool], args: Sequence[str] = ()) -> None:
    """
    Show the progress of a calibrator at each message, and problems, until it is over.

    `name` is with or without namespace. `show` is called for each message, and each time the
    problem changes; `is_over` about ten times per second. `args` are those of ROS, starting with
    ``--ros-args``. InputError if ROS does not start, the name is not valid, or the node has
    another version.

    """
    with _receiver(name, args) as (receiver, spin):
        shown, problem = 0, ''
        show(receiver.calibrator, None, problem)
        while not is_over():
            spin()
            before, problem = problem, '; '.join(receiver.problem())
            if receiver.received != shown or problem != before:
                shown = receiver.received
                show(receiver.calibrator, receiver.progress, problem)


def current(name: str, is_over: Callable[[], bool], args: Sequence[str] = ()
            ) -> tuple[str, Progress | None]:
    """
    Return the full name of a calibrator and its progress now; None: it was over before.

    Parameters and errors are as in `watch`; InputError also if no node answers.

    """
    with _receiver(name, args) as (receiver, spin):
        while receiver.received < 2 and not is_over():
            spin()
            if receiver.received and monotonic() - receiver.arrived > _NEXT:
                break
            if problem := receiver.problem():
                raise InputError(*problem)
        return receiver.calibrator, receiver.progress


@contextmanager
def _receiver(name: str, args: Sequence[str]) -> Iterator[tuple[_Receiver, Callable[[], None]]]:
    """Yield a receiver, and what waits for its messages."""
    with (started(list(args), 'check the arguments after --ros-args'),
          SingleThreadedExecutor() as executor):
        receiver = _Receiver(name)
        executor.add_node(receiver)
        yield receiver, partial(executor.spin_once, timeout_sec=_LOOK_EVERY)
