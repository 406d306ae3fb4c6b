# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Golden results of what runs while samples arrive: sessions without ROS, and messages."""

from collections.abc import Iterator, Sequence
from dataclasses import replace
import json
from pathlib import Path
import struct
from typing import Any

import accel_calib as ac
from accel_calib.calibration import Calibration, fit_poses, level, SampleNoise
from accel_calib.logs import joined, layout_of
from accel_calib.messages import motion_of, output_frame, Rewriter
from accel_calib.session import diagnostics, progress, Surroundings
from accel_calib.units import units_of
from driven import Driver
from golden.figures import attempt, of_next_pose, those
from golden.inputs import G, samples
from inside import figures as health_figures, layout_with, Model
import numpy as np

SENSOR: dict[str, Any] = {'offset': np.array([0.03, -0.02, 0.04]), 'axis_gain': np.array(
    [0.01, -0.02, 0.015]), 'cross_axis': np.array([0.004, 0.002, -0.003])}
EFFECTS: dict[str, Any] = {
    'offset_temperature': np.array([1e-3, 2e-3, -1e-3, 40.0, 0.0]), 'lever_arm': np.array(
        [0.1, -0.05, 0.02]), 'quadratic': np.array([1e-3, -2e-3, 1e-3]),
    'temperature_rate': np.array([0.02, 0.01, -0.03])}


class _Driver(Driver):
    """A session of which each step returns a result."""

    def __init__(self) -> None:
        """Wait for the first step, which is `start`; another one is a start anew."""
        self.session: Any = None

    def start(self, **settings: Any) -> None:
        if self.session is not None:
            self.session.close()
        super().__init__('/imu', calibration_file='c.yaml', **settings)

    def end(self, answer: str) -> None:
        """Leave an answer that nobody asked for out of the log."""

    def ask(self, *names: str) -> Any:
        """Return the answers of commands, or their refusals."""
        return [attempt(super(_Driver, self).ask, name) for name in names]

    def feed(self, ups: Sequence[Any], at: float, t: float = np.nan, frame_id: str = 'imu',
             per_g: float = G, gain: float = 1.0, s: float = 2.4, **part: Any) -> None:
        """Push the samples of rests in blocks."""
        table = samples([{'up': up, 's': s, **part} for up in ups], seed=int(at))
        table[:, 1:4] *= per_g * gain
        for block in np.array_split(table, len(table) // 15):
            self.now += 0.3
            if self.session.accepts(frame_id):
                rows = np.full((len(block), 9), np.nan)
                rows[:, :7], rows[:, 7], rows[:, 0] = block, t, block[:, 0] + at
                self.session.state.around.take('temperature', t)
                self.session.push(rows, self.now)
            self.handle()
        self.session.tick()
        self.handle()

    def surround(self, **given: Any) -> None:
        """Change what is known of the surroundings."""
        self.session.change(surroundings=Surroundings(**given))

    def edit(self, old: str, new: str) -> None:
        """Change the file of the calibration."""
        path = Path('c.yaml')
        path.write_text(path.read_text(encoding='utf-8').replace(old, new, 1), encoding='utf-8')

    def kept(self) -> Any:
        """Return the files, the directions of the poses, and the findings of the calibration."""
        noted = [] if self.calibration is None else [each.kind for each in self.calibration.noted]
        return [sorted(map(str, Path().iterdir())), np.round(self.poses.reading / G, 1), noted]

    def frame(self) -> Any:
        """Return the rotation that is applied to messages, and the gravity in them."""
        state = self.session.state
        return {'rotation': state.on_topics(self.calibration).rotation,
                'gravity': state.gravity / G}

    def state(self) -> Any:
        """Return progress, diagnostics, checks and poses."""
        drift, plan = self.session.sensor.drift, self.session.sensor.guide.plan
        return [progress(self.session.state), dict(health_figures(self.session.state)),
                diagnostics(self.session.state)[1:], plan and {
                    'up': plan.up, 'frame_id': self.session.state.frame_id or '',
                    'asked': of_next_pose(plan.asked)},
                self.session.sensor.live.poses(),
                drift and {'covariance': drift.calibration.covariance, **those(
                    drift, 'repeats temperatures rests count scatter change since without')}]

    def reports(self) -> Any:
        """Return the results as JSON."""
        return [json.loads(text) for text in self.results]

    def lines(self) -> Any:
        return [f'{each.severity}: {each.words}' for each in self.log]


def session(steps: Sequence[Any]) -> Any:
    """Return the results of the steps of a session."""
    driver, found = _Driver(), []
    for step in steps:
        (name, given), = step.items() if isinstance(step, dict) else ((step, ()),)
        act = getattr(driver, name)
        found.append(act(**given) if isinstance(given, dict) else act(*given))
    driver.session.close()
    return found


def _calibrations() -> Iterator[Calibration]:
    """Yield calibrations with exact values: plain, levelled, and with effects."""
    made = fit_poses(ac.simulate(SENSOR, poses=16, units='m/s2', temperature=(20.0, 30.0),
                                 time=30.0 * np.arange(16)), units_of('m/s2'), model='10')
    plain = replace(made, model=Model(SENSOR), covariance=np.diag(np.arange(1.0, 10.0)) * 1e-7)
    flat = level(plain, plain.predict(np.array([[1.5, -2.0, 9.4]]))[0], 'ros')
    warm = Model({**SENSOR, **EFFECTS}, flat.rotation)
    yield from (plain, flat, replace(flat, model=warm, covariance=1e-8 * np.eye(len(warm.vector))))


def _messages(frame_id: str, seed: int) -> Iterator[bytes]:
    """Yield serialized Imu messages with covariances of all kinds."""
    rng, letters = np.random.default_rng(seed), frame_id.encode() + b'\0'
    for k, kind in enumerate(('full', 'unknown', 'absent', 'nan', 'full', 'full')):
        doubles = rng.normal(size=37) * np.where(np.arange(37) // 3 == 8, 6.0, 1.0)
        for start in (4, 16, 28):
            root = rng.normal(size=(3, 3)) * 0.01
            doubles[start:start + 9] = (root @ root.T).ravel() if kind in ('full', 'nan') else 0.0
            doubles[start] = -1.0 if kind == 'absent' else doubles[start]
        doubles[30] = np.nan if kind == 'nan' else doubles[30]
        head = struct.pack('<4siII', b'\0\1\0\0', 100 + 7 * k, 250_000_000 * (k % 4), len(letters))
        yield (head + letters + b'\xab' * (-(len(head + letters) - 4) % 8)
               + doubles.astype('<f8').tobytes())


def messages() -> Any:
    """Return corrected messages: the bytes before the numbers, and the numbers."""
    found: dict[str, Any] = {}
    noise = SampleNoise(np.array([0.01, 0.02, 0.03]), np.array([1e-3, 2e-3, 4e-3]))
    for calibration, frame_id in zip(_calibrations(), ('imu', 'base/imu_7', ''), strict=True):
        raws = list(_messages(frame_id, len(frame_id)))
        layout, to = layout_of(raws[0]), output_frame(calibration, frame_id)
        assert layout is not None
        write, single = Rewriter(layout, calibration, G, to, noise if frame_id else None), []
        for k, raw in enumerate(raws):
            write.bias = (0.01, -0.02, 0.03) if k == 5 else (0.0, 0.0, 0.0)
            out, begin = write(raw, {'temperature': 20.0 + 2.0 * k}) or b'', write.layout.begin
            single += [out[:begin], np.frombuffer(out[begin:]).tolist()]
        found[frame_id] = {
            'single': single, 'layout': layout, 'frame': to,
            'motion': motion_of(raws[0], layout, np.array([0.1, 0.2, 9.8]))[-32:]}
    raw = next(_messages('imu', 1))
    found['layouts'] = [layout_with(each) for each in ('', 'imu', 'imu_link', 'übung')]
    found['damaged'] = [layout_of(each) is None for each in (
        raw, raw[:-1], raw + b'\0', b'\0\0' + raw[2:], raw[:12] + b'\0' + raw[13:], raw[:20])]
    found['refused'] = [getattr(attempt(joined, each, 37, 'imu', before=3), 'args', '')
                        for each in ([raw, raw[:-9]], [b'\7' + raw[1:]], [raw + bytes(3)],
                                     [raw, raw, raw + bytes(4)])]
    return found
