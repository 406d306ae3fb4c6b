# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""What the page of a fleet names: odd sensors, shared effects, sensors that changed."""

from __future__ import annotations

from accel_calib.fleet.page import not_agreeing, odd_sensors, overview, shared_effects
import numpy as np
import pytest

NAMES = ('offset.x', 'offset.y', 'offset.z', 'gain.x', 'gain.y', 'gain.z', 'gain.xy', 'gain.xz',
         'gain.yz')


def test_the_odd_sensors_of_a_fleet_are_named() -> None:
    rng = np.random.default_rng(1)
    values = {f's{k}': 0.01 * rng.normal(size=9) for k in range(60)}
    assert odd_sensors(values) == []
    values['s7'][2] += 0.15
    ((sensor, name, value, far),) = odd_sensors(values)
    assert (sensor, name) == ('s7', 'offset.z')
    assert value == values['s7'][2]
    assert far == pytest.approx(15.0, rel=0.4)


def test_few_fleets_without_odd_sensors_have_one_by_chance() -> None:
    rng = np.random.default_rng(2)
    found = sum(bool(odd_sensors({str(k): rng.normal(size=9) for k in range(40)}))
                for _ in range(100))
    assert found <= 10


def test_effects_that_sensors_share_are_counted_with_their_range() -> None:
    values = np.linspace(0.5e-3, 0.7e-3, 31)
    effects = {f's{k}': ({'offset_temperature.x': float(values[k])} if k < 31 else {})
               for k in range(40)}
    effects['s39'] = {'quadratic.x': 0.001}
    (line,) = shared_effects(effects)
    assert line == '31 of 40 sensors: offset_temperature.x 0.52 to 0.68 mg/°C'


def test_few_of_many_unchanged_sensors_are_named_as_changed() -> None:
    rng = np.random.default_rng(3)
    sensors = [{'sensor': f's{k}', 'p_value': float(p)} for k, p in enumerate(rng.random(1000))]
    assert len(not_agreeing(sensors)) <= 2
    sensors += [{'sensor': f'changed{k}', 'p_value': 1e-6} for k in range(20)]
    sensors.append({'sensor': 'single', 'p_value': None})
    named = {row['sensor'] for row in not_agreeing(sensors)}
    assert {f'changed{k}' for k in range(20)} <= named
    assert len(named) < 26


def test_bad_calibrations_and_errors_do_not_enter_the_values() -> None:
    def row(status: str, rating: str | None, offset: float) -> dict[str, object]:
        return {'sensor': 's', 'sensor_model': None, 'status': status, 'rating': rating,
                'parameters': [], **dict.fromkeys(NAMES, offset)}

    known = overview([row('ok', 'GOOD', 0.01), row('ok', 'USABLE', 0.03), row('ok', 'BAD', 5.0),
                      row('error', None, 9.0)])
    np.testing.assert_allclose(known.values['']['s'], 0.02)
    assert known.counts == {'GOOD': 1, 'USABLE': 1, 'BAD': 1, 'error': 1}
    assert len(known.errors) == 1
