# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Lag and rate of the temperature: known solutions, wavy temperatures, streams."""

from accel_calib.effects import add_history, TemperatureHistory
from accel_calib.estimate import estimate
from inside import (
    acting_temperature, Lag, low_passed, Model, rate_of, simulate_poses, ThermalStream)
import numpy as np
import pytest
from shared import random_directions, rms, SENSOR

KEY = 'temperature_of_offset'
START = 1.7e9
"""Stamps are seconds since 1970."""


class Wave:
    """A temperature of two periods, and its low pass in the steady state."""

    def __init__(self, rng, lag):
        self.size, self.phase = rng.uniform(2.0, 6.0, 2), rng.uniform(0.0, 6.0, 2)
        self.speed, self.lag = 2.0 * np.pi / rng.uniform(400.0, 1500.0, 2), lag

    def true(self, time):
        return self.low_passed(time, 0.0)

    def low_passed(self, time, lag=None):
        turned = self.speed * (self.lag if lag is None else lag)
        angle = np.multiply.outer(time, self.speed) + self.phase - np.arctan(turned)
        return 25.0 + np.sin(angle) @ (self.size / np.hypot(1.0, turned))


def stepped(temperature, step):
    return np.round(temperature / step) * step


@pytest.mark.parametrize(('a', 'b', 'known'), [
    (0.0, 0.0, False), (0.0, 0.0, True), (2e-7, -3e-5, True)])
def test_low_pass_of_a_ramp_and_of_a_cubic_temperature_with_its_rates_is_exact(a, b, known):
    time = np.array([0.0, 7.0, 30.0, 31.0, 95.0, 400.0]) - 40.0
    c, lag = 0.01, 25.0
    warm, rate = a * time ** 3 + b * time ** 2 + c * time, 3 * a * time ** 2 + 2 * b * time + c
    bend, twist = 6 * a * time + 2 * b, 6 * a
    steady = warm - lag * rate + lag ** 2 * bend - lag ** 3 * twist
    expected = steady + (warm - steady)[0] * np.exp(-(time - time[0]) / lag)
    found = (low_passed(START + time, warm, lag, rate) if known else
             ThermalStream({KEY: Lag(lag, False)}, rate=False).add_all(START + time, warm)[KEY])
    np.testing.assert_allclose(found, expected, atol=1e-9)


def test_order_of_the_rows_and_rows_without_values_do_not_matter():
    rng = np.random.default_rng(1)
    time = START + np.cumsum(rng.uniform(5.0, 30.0, 50))
    warm = 20.0 + np.cumsum(rng.normal(size=50))
    mixed = rng.permutation(52)
    given = np.append(time, [np.nan, time[3]])[mixed], np.append(warm, [20.0, np.nan])[mixed]
    lags = {KEY: Lag(70.0, False)}
    for function in (rate_of, lambda *rows: low_passed(*rows, 70.0, rate_of(*rows)),
                     lambda *rows: ThermalStream(lags, rate=False).add_all(*rows)[KEY]):
        expected = np.append(function(time, warm), [np.nan, np.nan])[mixed]
        np.testing.assert_allclose(function(*given), expected, atol=1e-9)


def test_the_rate_of_the_samples_of_a_ramp_is_exact():
    time = np.arange(0.0, 300.0, 0.05)
    np.testing.assert_allclose(rate_of(START + time, 20.0 + 0.08 * time), 0.08, rtol=5e-4)


@pytest.mark.parametrize('spacing', [10.0, 20.0, 30.0, 60.0])
@pytest.mark.parametrize('lag', [30.0, 100.0, 300.0])
def test_temperatures_ahead_of_a_lagging_sensor_and_of_a_lagging_die_are_found(spacing, lag):
    rng = np.random.default_rng(int(spacing + lag))
    time = np.cumsum(rng.uniform(0.7, 1.3, 400) * spacing)
    wave = Wave(rng, lag)
    true, behind = wave.true(time), wave.low_passed(time)
    for step, most in ((0.01, 0.1), (0.06, 0.25)):
        context = {'time': START + time, 'temperature': stepped(behind, step)}
        ahead = acting_temperature(context, KEY, lag, True)
        assert rms(ahead - true) < min(most, 0.3 * rms(behind - true))
    context['temperature'] = stepped(true, 0.01)
    found = acting_temperature(context, KEY, lag, False)
    assert rms((found - behind)[time > time[0] + 8.0 * lag]) < 0.03


@pytest.mark.parametrize('lag', [30.0, 300.0])
def test_temperature_ahead_of_a_lagging_sensor_is_found_in_a_stream(lag):
    wave, time = Wave(np.random.default_rng(4), lag), np.arange(0.0, 1200.0, 0.01)
    warm = stepped(wave.low_passed(time), 0.06)
    found = ThermalStream({KEY: Lag(lag, True)}, rate=True).add_all(START + time, warm)
    settled = time > 100.0
    behind = rms((warm - wave.true(time))[settled])
    assert rms((found[KEY] - wave.true(time))[settled]) < 0.25 * behind
    true_rate = np.gradient(wave.low_passed(time), time)
    assert rms((found['temperature_rate'] - true_rate)[settled]) < 0.2 * rms(true_rate)


LAGS = {KEY: Lag(40.0, True), 'temperature_of_gain': Lag(25.0, False)}


def test_samples_added_alone_and_together_are_the_same_over_a_pause_and_missing_temperatures():
    rng = np.random.default_rng(3)
    time = START + np.cumsum(rng.uniform(0.0, 0.4, 3000))
    time[1500:] += 500.0
    warm = stepped(25.0 + 6.0 * np.sin(time / 90.0), 0.06)
    warm[rng.random(3000) < 0.05] = np.nan
    warm[3::50] = 0.0
    expected = ThermalStream(LAGS, rate=True).add_all(time, warm)
    stream = ThermalStream(LAGS, rate=True)
    for k, (moment, temperature) in enumerate(zip(time.tolist(), warm.tolist(), strict=True)):
        stream.add(moment, temperature)
        if np.isfinite(temperature):
            for key, values in expected.items():
                assert stream.value[key] == pytest.approx(values[k], abs=1e-9), (key, k)
        else:
            assert all(np.isnan(values[k]) for values in expected.values())


def test_stream_begins_with_the_first_temperature_and_again_if_the_time_jumps_back():
    stream = ThermalStream(LAGS, rate=True)
    stream.add(1.0, np.nan)
    assert stream.value == {}
    stream.add(2.0, 20.0)
    assert stream.value == {'temperature_rate': 0.0, **dict.fromkeys(LAGS, 20.0)}
    stream.add_all(START + np.arange(100.0), 20.0 + np.arange(100.0))
    assert stream.value['temperature_of_gain'] < 110.0
    stream.add(START - 3600.0, 30.0)
    assert stream.value == {'temperature_rate': 0.0, **dict.fromkeys(LAGS, 30.0)}


@pytest.mark.parametrize('effect', ['offset_temperature', 'gain_temperature'])
@pytest.mark.parametrize('of_sensor', [0.0, 1.0])
@pytest.mark.parametrize('lag', [40.0, 150.0])
def test_fit_recovers_the_lag_within_its_uncertainty(effect, of_sensor, lag):
    rng = np.random.default_rng(int(lag + of_sensor))
    count = 80
    time = START + np.cumsum(rng.uniform(15.0, 30.0, count))
    context = {'time': time, 'temperature': stepped(Wave(rng, 60.0).low_passed(time), 0.01)}
    values = np.array([1e-3, -1.5e-3, 1.2e-3, lag, of_sensor])
    true = Model({**{name: np.array(each) for name, each in SENSOR.items()}, effect: values})
    poses = simulate_poses(true, random_directions(count, rng), rng, context=context)
    start = Model({**{name: np.zeros(3) for name in SENSOR},
                   effect: np.array([5e-4, -5e-4, 5e-4, 1.5 * lag, of_sensor])})
    fit = estimate(start, add_history(poses, start))
    assert fit.model.needs == ('temperature', 'time')
    found, sd = fit.model.values[effect], np.sqrt(np.diag(fit.covariance))[-5:]
    assert sd[3] < 0.15 * lag
    np.testing.assert_array_less(np.abs(found - values)[:4], 3.5 * sd[:4])
    assert (found[4], sd[4]) == (of_sensor, 0.0)


def lagging(lag, of_sensor):
    """Return a model with a temperature that lags."""
    return Model({'offset_temperature': np.array([1e-3, 1e-3, 1e-3, lag, of_sensor])})


def test_points_do_not_depend_on_the_batches():
    time = START + np.arange(0.0, 120.0, 0.5)
    warm = 20.0 + 0.25 * (time - START)
    known, later = lagging(30.0, 1.0), lagging(20.0, 1.0)
    found = []
    for batch in (1, 7, 40, len(time)):  # a recording that is played fast has long ones
        history = TemperatureHistory()
        history.columns_of(known)
        for begin in range(0, len(time), batch):
            history.add(time[begin:begin + batch], warm[begin:begin + batch])
        during = history.during(known, START + 60.0, START + 70.0)[KEY]
        found.append([history.columns_of(known)[KEY], *during, history.stream(later).value[KEY]])
    np.testing.assert_allclose(found, np.tile(found[0], (4, 1)), atol=1e-9)
    assert found[0][0] == pytest.approx(warm[-1] + 30.0 * 0.25, abs=0.2)


def test_history_starts_again_if_the_time_jumps_back_within_a_batch():
    jumped, again = TemperatureHistory(), TemperatureHistory()
    jumped.add(START + np.arange(100.0, 200.0), np.full(100, 50.0))
    jumped.add(START + np.array([200.0, 201.0, 0.0, 1.0, 2.0, 30.0]),
               np.array([50.0, 50.0, 20.0, 21.0, 22.0, 20.0]))
    again.add(START + np.array([0.0, 1.0, 2.0, 30.0]), np.array([20.0, 21.0, 22.0, 20.0]))
    found, expected = (each.stream(lagging(30.0, 0.0)).value for each in (jumped, again))
    assert found == expected
    assert expected[KEY] == pytest.approx(21.0, abs=1.0)
