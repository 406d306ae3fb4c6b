# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Noise figures from a long rest, by Allan deviation."""

from collections.abc import Sequence
import json
from pathlib import Path
import re
from typing import Any

from accel_calib.errors import InputError
from accel_calib.findings import rate_noise
from accel_calib.logs import write_table
from accel_calib.noise import noise_of, NoiseFigures, to_json
from accel_calib.table import Floats, Recording
from accel_calib.units import STANDARD_GRAVITY
from inside import (
    ALLAN_COMPONENTS, allan_variances, fit_components, longest_rest, octaves, shares, spread_of)
import numpy as np
import pytest
from shared import changed, G, run, samples_of

allantools = pytest.importorskip('allantools')

RATE = 100.0
UP = np.array([0.0, 0.0, 1.0])


def flicker(rng: np.random.Generator, count: int, size: float) -> Floats:
    """Return noise with the two-sided density B²/(2π f), of twice the length and cut."""
    frequency = np.fft.rfftfreq(2 * count)[1:]
    power = size**2 / (np.pi * frequency) * count / 2.0
    parts = rng.normal(size=(2, len(frequency))) * np.sqrt(power)
    return np.fft.irfft(np.append(0.0, parts[0] + 1j * parts[1]), 2 * count)[:count]


def noise(rng: np.random.Generator, count: int, white: float, flat: float = 0.0,
          walk: float = 0.0) -> Floats:
    """Return a sum of N, B and K for a spacing of 1 s."""
    return (white * rng.normal(size=count) + flicker(rng, count, flat)
            + walk * np.cumsum(rng.normal(size=count)))


def resting(seed: int, count: int, white: float = 1e-4, *, flat: float = 0.0, walk: float = 0.0,
            gyro: float = 0.0, mean: Sequence[float] = UP) -> Recording:
    """Return a rest with these densities, in g/√Hz, g, g/s/√Hz and rad/s/√Hz."""
    rng = np.random.default_rng(seed)
    reading = np.column_stack([noise(rng, count, white * np.sqrt(RATE), flat, walk / np.sqrt(RATE))
                               for _ in range(3)]) + mean
    rates = {'rate': gyro * np.sqrt(RATE) * rng.normal(size=(count, 3))} if gyro else {}
    return sampled(reading, **rates)


def sampled(reading: Floats, **columns: Floats) -> Recording:
    """Return a recording [g]."""
    return samples_of(np.arange(len(reading)) / RATE, reading, 'g', **columns)


def figure_of(found: NoiseFigures, name: str, axis: int = 0) -> Any:
    return found.axes[axis].figures[name]


def test_allan_deviations_are_those_published_by_nist() -> None:
    # NIST SP 1065, section 12.4: 1000 points of a prescribed random generator.
    values = [1234567890]
    for _ in range(999):
        values.append(16807 * values[-1] % 2147483647)
    found = np.sqrt(allan_variances(np.array(values) / 2147483647.0, np.array([1, 10, 100])))
    assert found == pytest.approx([2.922319e-1, 9.159953e-2, 3.241343e-2], rel=1e-6)


@pytest.mark.parametrize(('component', 'alpha'), [(0, 2), (1, 0), (2, -1), (3, -2)])
def test_degrees_of_freedom_are_those_of_greenhall_and_riley(component: int, alpha: int) -> None:
    count = 4096
    lengths = octaves(count)
    sizes = np.eye(5)[component]
    freedom = 2.0 * shares(lengths)[:, component]**2 / np.diag(
        spread_of(lengths, count).covariance(sizes))
    published = [allantools.edf_greenhall(alpha, 2, int(m), count + 1, overlapping=True)
                 for m in lengths]
    # At short τ the published formula is for continuous time.
    assert freedom[5:] == pytest.approx(published[5:], rel=0.035)


def test_covariance_of_the_curve_is_that_of_simulated_curves() -> None:
    rng = np.random.default_rng(3)
    count, sizes = 2048, np.array([0.0, 1.0, 0.02, 1e-4, 0.0])
    lengths = octaves(count)
    curves = [allan_variances(noise(rng, count, *np.sqrt(sizes[1:4])), lengths)
              for _ in range(600)]
    expected = spread_of(lengths, count).covariance(sizes)
    deviation = np.sqrt(np.diag(expected))
    found = np.cov(np.array(curves).T) / np.outer(deviation, deviation)
    assert found == pytest.approx(expected / np.outer(deviation, deviation), abs=0.2)
    assert np.mean(curves, axis=0) == pytest.approx(shares(lengths) @ sizes, rel=0.1)


@pytest.mark.parametrize(('count', 'true'), [
    (16000, (1.0, 0.0, 0.006)), (30000, (1.0, 0.15, 0.0)), (500, (1.0, 0.0, 0.0))])
def test_intervals_hold_the_true_value(count: int, true: tuple[float, float, float]) -> None:
    rng = np.random.default_rng(11)
    lengths = octaves(count)
    spread = spread_of(lengths, count)
    fits = [fit_components(allan_variances(noise(rng, count, *true), lengths), lengths, spread)
            for _ in range(40)]
    for component, value in enumerate(true, start=1):
        found = [fit.components[component] for fit in fits]
        seen = [each for each in found if each.seen]
        if value == 0.0:
            assert len(seen) <= 2, ALLAN_COMPONENTS[component]
        else:
            assert len(seen) > 20
            inside = [each.interval[0] <= value <= each.interval[1] for each in seen]
            assert np.mean(inside) >= 0.87, ALLAN_COMPONENTS[component]
            sizes = np.array([each.value for each in seen])
            assert abs(np.mean(sizes) / value - 1.0) < 0.07
            assert 0.5 < np.std(sizes) / np.mean([each.sd for each in seen]) < 1.3
        assert np.mean([each.upper >= value for each in found]) >= 0.87


def test_density_and_walk_have_their_units() -> None:
    found = noise_of(resting(1, 200_000, 1e-4, walk=1e-5, gyro=2e-4), G)
    for axis in range(3):
        assert figure_of(found, 'noise_density', axis).value == pytest.approx(
            1e-4 * STANDARD_GRAVITY, rel=0.02)
        low, high = figure_of(found, 'random_walk', axis).interval
        assert 0.8 * low < 1e-5 * STANDARD_GRAVITY < 1.25 * high
        assert figure_of(found, 'noise_density', axis + 3).value == pytest.approx(2e-4, rel=0.02)
    assert found.rate == pytest.approx(RATE)


def test_the_flat_part_is_divided_by_its_factor() -> None:
    found = noise_of(resting(2, 200_000, 1e-6, flat=1e-4), G)
    axis = found.axes[0]
    assert axis.figures['bias_instability'].value == pytest.approx(
        1e-4 * STANDARD_GRAVITY, rel=0.1)
    middle = axis.deviation[len(axis.tau) // 2]
    assert middle / axis.figures['bias_instability'].value == pytest.approx(0.664, rel=0.1)


def test_white_noise_alone_shows_nothing_else_and_states_the_necessary_rest() -> None:
    found = noise_of(resting(3, 18_000), G)
    assert [figure_of(found, name).seen for name in ALLAN_COMPONENTS] == [
        False, True, False, False, False]
    assert found.needs['accelerometer', 'bias_instability'].endswith(' 3 min')
    assert 'h at rest' in found.needs['accelerometer', 'random_walk']


def test_rates_in_counts_are_not_taken_for_rad_s() -> None:
    recording = resting(5, 6000, gyro=1e-4)
    counts = recording.with_columns(rate=recording['rate'] * 7506.0)
    found = noise_of(counts, G)
    assert to_json(found)['gyroscope_noise_density'] is None
    assert to_json(found)['accelerometer_noise_density'] is not None


def test_the_longest_rest_between_turns_and_interruptions_is_used() -> None:
    parts = [resting(6, 3000), resting(7, 20_000, mean=(0.0, 1.0, 0.0)),
             resting(8, 5000, mean=(1.0, 0.0, 0.0))]
    turned = sampled(np.concatenate([part.reading for part in parts]))
    late = turned.with_columns(time=turned['time'] + 60.0 * (np.arange(28_000) >= 9000))
    for recording, start, samples in ((turned, 30.0, 20_000), (late, 150.0, 14_000)):
        rest = longest_rest(recording, G)
        assert start - 2.0 < rest.start < start + 5.0
        assert samples - 1000 < rest.samples <= samples
        assert rest.values[1].mean() == pytest.approx(1.0, abs=0.01)


def test_single_missing_samples_and_jitter_of_the_stamps_do_not_change_the_figures() -> None:
    recording, rng = resting(10, 30_000), np.random.default_rng(0)
    late = recording['time'] + rng.uniform(0.0, 0.008, 30_000)
    for other, word in ((recording.take(rng.random(30_000) > 0.018), 'missing'),
                        (recording.with_columns(time=late), 'uneven')):
        found = noise_of(other, G)
        assert found.rate == pytest.approx(RATE, rel=1e-3)
        assert found.samples > 29_000
        assert any(word in note for note in found.notes)
        for axis in range(3):
            low, high = figure_of(found, 'noise_density', axis).interval
            assert low < 1e-4 * STANDARD_GRAVITY < high


def test_a_change_of_the_rate_ends_a_rest_and_a_vibration_widens_the_intervals() -> None:
    rng, wave = np.random.default_rng(11), np.sin(1.087 * np.arange(30_000))[:, np.newaxis]
    slow = resting(11, 20_000, 1e-4 / np.sqrt(2.0))  # the same density at half the rate
    time = np.append(np.arange(10_000), 1e4 + 2.0 * np.arange(20_000)) / RATE
    for recording in (
            samples_of(time, np.append(resting(12, 10_000).reading, slow.reading, axis=0), 'g'),
            sampled(1e-3 * rng.normal(size=(30_000, 3)) + 2e-3 * wave + UP)):
        for axis in range(3):
            low, high = figure_of(noise_of(recording, G), 'noise_density', axis).interval
            assert low < 1e-4 * STANDARD_GRAVITY < high


def test_a_low_pass_filter_is_noted_and_the_density_is_that_of_long_times() -> None:
    rng = np.random.default_rng(12)
    raw = 1e-4 * np.sqrt(RATE) * rng.normal(size=(60_007, 3))
    smooth = np.cumsum(raw, axis=0)
    found = noise_of(sampled((smooth[7:] - smooth[:-7])[:60_000] / 7.0 + UP), G)
    assert any('low-pass filter' in note for note in found.notes)
    density = figure_of(found, 'noise_density')
    assert abs(density.value - 1e-4 * STANDARD_GRAVITY) < 4.0 * density.sd


@pytest.mark.parametrize('size', [0.3e-3, 1e-3, 3e-3])
def test_steps_of_a_coarse_output_do_not_end_a_rest_but_a_motion_does(size: float) -> None:
    rest = resting(26, 90_000, 1e-6, walk=size / 10.0, mean=(0.01, 0.02, 1.0)).reading
    rest = rest + size * np.sin(np.arange(90_000) / 2000.0)[:, np.newaxis]
    moved = rest + 0.03 * (np.arange(90_000) > 60_000)[:, np.newaxis]
    for reading, samples in ((rest, 90_000), (moved, 60_000)):
        found = longest_rest(sampled(np.round(reading / 0.0033) * 0.0033), G)
        assert found.samples == pytest.approx(samples, rel=0.02)


def test_a_coarse_output_and_a_change_of_temperature_are_noted() -> None:
    rest = resting(13, 20_000, mean=(0.0002, 0.0004, 0.9998)).with_columns(
        temperature=np.full(20_000, 20.0))
    warm = rest.with_columns(temperature=np.linspace(20.0, 26.0, 20_000))
    coarse = rest.with_columns(reading=np.round(rest.reading / 0.004) * 0.004)
    *noted, otherwise = (' '.join(noise_of(each, G).notes) for each in (coarse, warm, rest))
    for words, told in zip(('one step of the output|all samples of the rest are the same',
                            'temperature changed by'), noted, strict=True):
        assert re.search(words, told)
        assert not re.search(words, otherwise)


def test_an_axis_without_noise_is_left_out_with_a_note() -> None:
    recording = resting(14, 5000)
    found = noise_of(changed(recording, np.s_[:, 1], 0.0), G)
    assert [axis.axis for axis in found.axes] == ['x', 'z']
    assert any('accelerometer y' in note for note in found.notes)
    assert to_json(found)['accelerometer_noise_density_axes'][1] is None


def test_drift_and_swing_of_the_temperature_are_not_taken_for_a_random_walk() -> None:
    rest, time = resting(16, 200_000), np.arange(200_000)[:, np.newaxis] / RATE
    drifting, swinging = (noise_of(sampled(rest.reading + shift), G) for shift in (
        2e-6 * time, 5e-4 * np.sin(time / 200.0)))
    assert not figure_of(drifting, 'random_walk').seen
    drift = figure_of(drifting, 'drift')
    assert abs(drift.value - 2e-6 * STANDARD_GRAVITY) < 4.0 * drift.sd
    assert not figure_of(swinging, 'random_walk').seen
    assert 'another form' in swinging.needs['accelerometer', 'random_walk']


def test_a_recording_without_a_rest_is_refused() -> None:
    with pytest.raises(InputError, match='longest rest .* expected at least 64'):
        noise_of(sampled(np.random.default_rng(17).normal(size=(3000, 3)) + UP), G)


def test_the_figures_are_printed_beside_those_of_common_parts_written_and_drawn(
        tmp_path: Path, capsys: pytest.CaptureFixture[str],
        monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('matplotlib')
    monkeypatch.setenv('COLUMNS', '60')
    write_table(tmp_path / 'rest.csv', resting(19, 12_000, gyro=1e-4))
    assert run('noise', tmp_path / 'rest.csv', '--json', tmp_path / 'noise.json', '--report',
               tmp_path / 'noise.html') == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.split()[3:] for line in lines if line.startswith('typical')] == [
        ['49', 'to', '280', 'µg/√Hz'], ['2', 'to', '3.5', 'm°/s/√Hz']]
    made = json.loads((tmp_path / 'noise.json').read_text())
    assert made['accelerometer_random_walk'] is None
    assert all(limit > 0.0 for limit in made['accelerometer_random_walk_axes_upper'])
    text = (tmp_path / 'noise.html').read_text()
    assert 'class="verdict USABLE"' in text
    assert not re.search('https?:', text)


@pytest.mark.parametrize(('white', 'kind'), [(1e-4, 'not_seen'), (1e-3, 'noisy')])
def test_a_rest_is_rated(white: float, kind: str) -> None:
    rating = rate_noise(noise_of(resting(20, 6000, white), G))
    assert rating.name == 'USABLE'
    found = {each.kind for each in rating.findings}
    assert kind in found
    assert ('noisy' in found) is (kind == 'noisy')
