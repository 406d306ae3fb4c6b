# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The calibrator as a managed node; see `run`."""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from rclpy.lifecycle import LifecycleNode, TransitionCallbackReturn

from .calibrator_node import Calibrator
from ..errors import AccelCalibError

if TYPE_CHECKING:
    from rclpy.lifecycle import LifecycleState


class ManagedCalibrator(LifecycleNode):
    """A calibrator whose states are those of a managed node."""

    def __init__(self) -> None:
        super().__init__('calibrator')
        self._calibrator: Calibrator | None = None
        self._own = self._entities()

    def start(self) -> None:
        """Do nothing: transitions start the calibrator."""

    def _entities(self) -> list[Any]:
        return [*self.publishers, *self.subscriptions, *self.services, *self.timers]

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Read the parameters, load the calibration and listen, without publishing."""
        try:
            self._calibrator = Calibrator(self)
        except AccelCalibError as error:
            self.get_logger().error(str(error))
            self._destroy_entities()
            return TransitionCallbackReturn.FAILURE
        self._calibrator.stream.set_active(active=False)
        self._calibrator.start()
        return super().on_configure(state)

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Publish corrected messages."""
        self._set_active(active=True)
        return super().on_activate(state)

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Stop publishing corrected messages."""
        self._set_active(active=False)
        return super().on_deactivate(state)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the files and remove all topics and services."""
        self.close()
        self._destroy_entities()
        return super().on_cleanup(state)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Close the files."""
        self.close()
        self._destroy_entities()
        return super().on_shutdown(state)

    def _set_active(self, *, active: bool) -> None:
        if self._calibrator is not None:
            self._calibrator.stream.set_active(active=active)

    def close(self) -> None:
        """Finish writing, and release the files."""
        if self._calibrator is not None:
            self._calibrator.close()
            self._calibrator = None

    def _destroy_entities(self) -> None:
        """Remove what the calibrator has created in this node."""
        for kinds, destroy in ((self.publishers, self.destroy_publisher),
                               (self.subscriptions, self.destroy_subscription),
                               (self.services, self.destroy_service),
                               (self.timers, self.destroy_timer)):
            for each in list(kinds):
                if each not in self._own:
                    # The executor calls these for the events that it has already received.
                    each.callback = each.send_response = _ignore
                    destroy(each)


def _ignore(*given: Any) -> None:
    """Do nothing with a message, a request, a response, or at the time of a timer."""
