# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Poses, stored and drawn as they come, with the next one asked for."""

from __future__ import annotations

from typing import TYPE_CHECKING

from .fitting import asked_for, poses_up, then
from .markers import pose_markers

if TYPE_CHECKING:
    from concurrent.futures import Future

    from .calibrator_node import CalibratorNode
    from ..calibrate import NextPose
    from ..table import Poses


class PoseView:
    """
    The poses of a calibrator node, as others see them.

    Parameters
    ----------
    node : CalibratorNode
        Whose poses these are.

    """

    def __init__(self, node: CalibratorNode) -> None:
        self._node = node
        self.next = ''

    def show(self, *, store: bool) -> None:
        """Draw the poses and the next one asked for, and store them where that is asked."""
        node = self._node
        poses, units, model = node.watch.book.poses(), node.units, node.settings.model
        where = node.store if store else None

        def job() -> NextPose:
            if where is not None:
                where.save_poses(poses)
            if not len(poses):
                return asked_for(poses, units, model)
            return node.worker.apart.call(asked_for, poses, units, model)

        node.worker.run(job, lambda done: self._draw(done, poses))

    def _draw(self, done: Future[NextPose], poses: Poses) -> None:
        """Draw the poses; say so where they could not be stored."""
        node = self._node
        asked = None
        try:
            asked = done.result()
        except OSError as error:
            node.get_logger().error(f'the poses cannot be stored: {error}; mend the permissions, '
                                    'or set calibration_file', throttle_duration_sec=10.0)
        if asked is not None:
            self._tell(asked, len(poses))
        node.poses.publish(pose_markers(poses_up(poses, node.units), asked, node.frame_id))

    def _tell(self, asked: NextPose, count: int) -> None:
        """Say what to do next, in the log where there is no RViz."""
        before, self.next = self.next, then(asked)
        if count and self.next != before:
            self._node.get_logger().info(f'{count} poses; {self.next}')
