# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""One entry in the catalogue is all that a new effect takes."""

import accel_calib as ac
from accel_calib.effects import AXES, by_axis, Effect, EFFECTS, ONE
from accel_calib.logs import layout_of
from accel_calib.messages import Rewriter
from bag_files import header, IMU, imu
from inside import refinement_page
import numpy as np
import pytest
from rosbags.typesys import get_typestore, Stores
from shared import random_directions

NEW = Effect('offset that grows with the cube of temperature', 'third-order TCO', AXES, 'g',
             0.005, 0.5, by_axis(ONE),
             lambda context, shape: ((context['temperature'] - 25.0) / 20.0) ** 3,
             ('temperature',))
SENSOR = {'offset': [0.02, -0.01, 0.03], 'axis_gain': [0.01, -0.02, 0.005],
          'cross_axis': [0.004, 0.002, -0.003]}
VALUES = [0.02, -0.015, 0.01]


@pytest.fixture
def poses(monkeypatch):
    monkeypatch.setitem(EFFECTS, 'offset_cubic_temperature', NEW)
    rng = np.random.default_rng(1)
    return ac.simulate({**SENSOR, 'offset_cubic_temperature': VALUES}, units='m/s2', seed=2,
                       directions=random_directions(60, rng),
                       temperature=rng.uniform(5.0, 45.0, 60), time=np.arange(60) * 20.0)


def test_a_new_effect_is_simulated_named_fitted_corrected_and_reported(poses, tmp_path):
    found = ac.refine(poses, base='10')
    assert [step.effect for step in found.steps] == ['offset_cubic_temperature']
    np.testing.assert_allclose([found.steps[0].parameters[axis] for axis in AXES], VALUES,
                               atol=1e-3)
    assert NEW.words.capitalize() in refinement_page(found, 'poses')

    found.calibration.save(tmp_path / 'calibration.yaml')
    calibration = ac.load(tmp_path / 'calibration.yaml')
    np.testing.assert_allclose(calibration.model.values['offset_cubic_temperature'], VALUES,
                               atol=1e-3)
    forces = calibration.apply(poses.reading, temperature=poses['temperature'])
    np.testing.assert_allclose(np.linalg.norm(forces, axis=1), 9.80665, atol=0.02)

    store = get_typestore(Stores.ROS2_JAZZY)
    data = bytes(store.serialize_cdr(imu(store, header(store, 10 ** 9), poses.reading[7]), IMU))
    rewrite = Rewriter(layout_of(data), calibration, 1.0, 9.80665, '')
    corrected = rewrite(data, float(poses['temperature'][7]))
    force = store.deserialize_cdr(corrected, IMU).linear_acceleration
    np.testing.assert_allclose([force.x, force.y, force.z], forces[7], atol=1e-9)
