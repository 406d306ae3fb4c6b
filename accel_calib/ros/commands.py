# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What the services of the calibrator do.

Each answers with what came of it; where it did not go, with what was found and what to do.

"""

from __future__ import annotations

from typing import Any, TYPE_CHECKING

from diagnostic_msgs.srv import SelfTest
from std_srvs.srv import SetBool

from .answers import Answers
from .context import context_of_rest
from .fitting import asked_for, fitted, refined, story, summary, then
from .health import self_test_of
from .pose_view import PoseView
from ..calibrate import FLAT, level
from ..errors import InputError, StoredCalibrationError
from ..files import check_sensor

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from .calibrator_node import CalibratorNode
    from .storage import Store
    from .worker import Promise
    from ..calibrate import Calibration
    from ..refine import Refinement

_NO_CALIBRATION = InputError('there is no calibration yet', 'capture poses and call ~/fit first')


class Commands:
    """
    The services of a calibrator node.

    Parameters
    ----------
    node : CalibratorNode
        Whose state they change, in its callbacks.

    """

    def __init__(self, node: CalibratorNode) -> None:
        self._node = node
        self._answers = Answers(node, node.worker)
        self._fitted_poses = 0
        self.view = PoseView(node)
        triggers: dict[str, Callable[[], str | Promise]] = {
            'capture_pose': self.capture_pose, 'undo_pose': self.undo_pose, 'fit': self.fit,
            'refine': self.refine, 'set_level': self.set_level, 'save': self.save,
            'load': self.load, 'reset': self.reset}
        for name, command in triggers.items():
            self._answers.serve(name, command)
        node.create_service(SetBool, '~/enable', self._on_enable)
        node.create_service(SelfTest, '~/self_test', self._on_self_test)

    def _store(self) -> Store:
        if self._node.store is None:
            raise InputError('the name of the sensor is not known, for no Imu message has come '
                             'yet', 'start the driver, or set the parameter sensor')
        return self._node.store

    def poses_changed(self, *, ended: bool = False) -> None:
        """Show and store the poses, and fit where that is to go by itself."""
        self.view.show(store=True)
        count, settings = len(self._node.watch.book.poses()), self._node.settings
        enough = settings.auto_fit and count >= settings.auto_fit_poses
        if enough and (ended or count > self._fitted_poses):
            self._fitted_poses = count
            self.fit()

    def capture_pose(self) -> str:
        """Take the rest that is going on as a pose."""
        dwell = self._node.watch.capture_now()
        if dwell is None:
            raise self._not_still()
        self.poses_changed()
        poses = self._node.watch.book.poses()
        asked = asked_for(poses, self._node.units, self._node.settings.model)
        return (f'{len(poses)} poses: the sensor has been still for '
                f'{dwell.end - dwell.start:.1f} s; {then(asked)}')

    def _not_still(self) -> InputError:
        """Say why there is no rest."""
        node, least = self._node, self._node.settings.min_dwell
        if not node.vitals.messages:
            return InputError('no Imu message has come yet', 'start the driver')
        length = node.vitals.length_g
        if abs(length - 1.0) > node.settings.still_norm_tolerance:
            return InputError(f'|a| is {length:.3g} g, expected about 1 g at rest',
                              'hold the sensor still; if it is, set the parameter units')
        if not node.watch.detector.still:
            return InputError('the sensor is not still', f'hold it still for {least:g} s, and '
                              'look at ~/still')
        return InputError(f'the sensor has been still for less than {least:g} s',
                          'hold it still a little longer')

    def undo_pose(self) -> str:
        """Take back the last pose."""
        if not self._node.watch.undo():
            raise InputError('there are no poses', 'capture one first')
        self.poses_changed()
        return f'the last pose is taken back, {len(self._node.watch.book.poses())} are left'

    def fit(self) -> Promise:
        """Fit the poses, use and store the calibration."""
        node, store = self._node, self._store()
        node.watch.refresh()
        poses, before = node.watch.book.poses(), node.applied.calibration
        units, settings, sensor = node.units, node.settings, node.sensor
        context = node.message_context

        def job() -> tuple[Calibration, OSError | None]:
            calibration = node.worker.apart.call(fitted, poses, units, settings, sensor, before,
                                                 context)
            return calibration, node.worker.apart.call(_stored, store, calibration)

        def finish(found: tuple[Calibration, OSError | None]) -> str:
            self._use(*found)
            return f'{summary(found[0])}; stored in {store.calibration}'

        return self._answers.later(job, finish)

    def refine(self) -> Promise:
        """Find what the calibration lacks, use and store the refined one."""
        node, store = self._node, self._store()
        node.watch.refresh()
        poses, before = node.watch.book.poses(), node.applied.calibration
        units, sensor = node.units, node.sensor

        def job() -> tuple[Refinement, OSError | None]:
            refinement = node.worker.apart.call(refined, poses, units, sensor, before)
            return refinement, node.worker.apart.call(_stored, store, refinement.calibration)

        def finish(found: tuple[Refinement, OSError | None]) -> str:
            self._use(found[0].calibration, found[1])
            return f'{story(found[0])}; stored in {store.calibration}'

        return self._answers.later(job, finish)

    def _use(self, calibration: Calibration, not_stored: OSError | None) -> None:
        """Use a calibration, stored or not."""
        self._node.adopt(calibration)
        if not_stored is not None:
            raise InputError(f'the calibration is in use, but cannot be stored: {not_stored}',
                             'mend the permissions and call ~/save, or set calibration_file')

    def set_level(self) -> str | Promise:
        """Take the rest that is going on as flat."""
        node, calibration = self._node, self._node.applied.calibration
        if calibration is None:
            raise _NO_CALIBRATION
        rest = node.watch.detector.current()
        if rest is None:
            raise self._not_still()
        store = self._store()
        levelled = level(calibration, rest.mean, node.settings.frame,
                         context_of_rest(rest, node.units))

        def finish(not_stored: OSError | None) -> str:
            self._use(levelled, not_stored)
            doubts = [words for words in levelled.warnings if words.startswith(FLAT)]
            return '; '.join([f'this pose is flat now; stored in {store.calibration}', *doubts])

        return self._answers.later(lambda: _stored(store, levelled), finish)

    def save(self) -> Promise:
        """Store calibration and poses."""
        node, store, calibration = self._node, self._store(), self._node.applied.calibration
        if calibration is None:
            raise _NO_CALIBRATION
        poses = node.watch.book.poses()

        def job() -> None:
            store.save_calibration(calibration)
            store.save_poses(poses)

        stored = f'stored in {store.calibration} and {store.poses}'
        return self._answers.later(job, lambda none: stored)

    def load(self) -> Promise:
        """Read the stored calibration again; the one in use stays where it is refused."""
        node, store = self._node, self._store()
        sensor, units = node.sensor, node.units.name

        def finish(calibration: Calibration | None) -> str:
            if calibration is None:
                raise StoredCalibrationError(f'there is no {store.calibration}',
                                             'call ~/fit, or put a calibration there')
            node.adopt(calibration)
            return f'read {store.calibration}'

        return self._answers.later(lambda: store.load_calibration(sensor, units), finish)

    def reset(self) -> Promise:
        """Forget poses and calibration; the stored files are kept under other names."""
        node, store = self._node, self._store()

        def finish(kept: list[Path]) -> str:
            node.watch.clear()
            node.adopt(None)
            self._fitted_poses = 0
            self.poses_changed()
            return 'poses and calibration are forgotten' + ''.join(
                f'; {path.name} keeps what was stored' for path in kept)

        return self._answers.later(store.set_aside, finish)

    def check_sensor(self) -> None:
        """Put down a calibration of another sensor."""
        node, calibration = self._node, self._node.applied.calibration
        if calibration is None:
            return
        try:
            check_sensor(calibration, node.sensor)
        except StoredCalibrationError as error:
            node.adopt(None)
            node.problem = str(error)
            node.get_logger().error(node.problem)

    def _on_enable(self, request: SetBool.Request, response: SetBool.Response) -> Any:
        self._node.applied.enabled = request.data
        response.success = True
        response.message = ('messages are corrected' if request.data
                            else 'raw messages go out unchanged')
        return response

    def _on_self_test(self, request: SelfTest.Request, response: SelfTest.Response) -> Any:
        health = self._node.vitals.health(self._node)
        response.id = health.sensor
        response.status = self_test_of(health)
        passed = all(status.level == b'\x00' for status in response.status)
        response.passed = b'\x01' if passed else b'\x00'
        return response


def _stored(store: Store, calibration: Calibration) -> OSError | None:
    """Store a calibration; give why not, where it cannot be."""
    try:
        store.save_calibration(calibration)
    except OSError as error:
        return error
    return None
