# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The public face: what users have in hand is accepted, and results are as the docs state."""

from dataclasses import fields, replace
from pathlib import Path
import pickle
import re

import accel_calib as ac
from accel_calib.errors import AccelCalibError, InputError
from accel_calib.logs import write_table
import numpy as np
import pytest
from shared import LOGS, python, SENSOR

MATRIX = np.linalg.inv(np.eye(3) + np.diag(SENSOR['axis_gain']) + np.array(
    [[0.0, 0.004, 0.002], [0.004, 0.0, -0.003], [0.002, -0.003, 0.0]]))


@pytest.fixture(scope='module')
def poses():
    return ac.simulate(SENSOR, seed=1)


@pytest.fixture(scope='module')
def recording():
    return ac.simulate(SENSOR, recording=True, poses=6, seed=3)


@pytest.fixture(scope='module')
def calibration(poses):
    return ac.fit(poses, flat=1, sensor='imu_link')


def test_names_of_the_package_are_its_public_face():
    assert [name for name in dir(ac) if not name.startswith('_')] == sorted(ac.__all__)
    for name in ac.__all__:
        assert getattr(ac, name).__doc__
    with pytest.raises(AttributeError, match='no attribute'):
        _ = ac.fits


def test_no_folder_has_the_name_of_a_public_function():
    package = Path(ac.__file__).parent
    assert not {path.stem for path in package.iterdir()} & set(ac.__all__)


def test_what_is_slow_to_import_is_imported_when_it_is_used():
    code = 'import accel_calib.session, sys; print("scipy.special" in sys.modules)'
    assert python('-c', code).stdout == 'False\n'


def test_poses_are_a_path_a_table_a_data_frame_or_an_array(poses, tmp_path):
    path = tmp_path / 'poses.csv'
    write_table(path, poses)
    expected, frame = ac.fit(poses).offset, poses.to_dataframe().assign(label='pose')
    for given in (path, str(path), ac.read_poses(str(path)), frame[frame.columns[::-1]]):
        np.testing.assert_allclose(ac.fit(given).offset, expected, atol=1e-6)
    for given in (poses.reading, poses.reading.tolist()):
        np.testing.assert_allclose(ac.fit(given).offset, expected, atol=0.01)


def test_a_calibration_is_stored_read_and_used_again(calibration, poses, tmp_path):
    path = str(tmp_path / 'calibration.yaml')
    calibration.save(path)
    read = ac.load(path)
    assert isinstance(read, ac.Calibration)
    np.testing.assert_allclose(read.apply(poses.reading), calibration.apply(poses.reading),
                               atol=1e-9)
    np.testing.assert_allclose(read.apply(poses.reading[0])[:2], 0.0, atol=1e-6)
    found = ac.verify(poses, path)
    assert found.rms_after_mg < 1.0 < found.rms_before_mg
    assert type(found.noise_floor_mg) is float
    assert ac.compare([path, calibration]).agree
    pytest.importorskip('matplotlib')
    read.report(tmp_path / 'page.html')
    assert '<svg' in (tmp_path / 'page.html').read_text(encoding='utf-8')


@pytest.mark.parametrize('name', ['esp32/micros.csv', 'phyphox/semicolon_point.csv',
                                  'sensor-logger/android/TotalAcceleration.csv'])
def test_a_data_frame_of_samples_is_read_as_the_file_is(name):
    pandas = pytest.importorskip('pandas')
    path = LOGS / name
    frame = pandas.read_csv(path, sep=None, engine='python')
    expected = ac.capture(path)
    for given in (frame, frame.set_index(frame.columns[0])):
        np.testing.assert_allclose(ac.capture(given).reading, expected.reading, rtol=1e-9)
    assert ac.fit(frame) == ac.fit(path)  # the samples are captured, not fitted


def test_a_data_frame_has_times_as_dates_too(recording):
    pandas = pytest.importorskip('pandas')
    frame = recording.to_dataframe()
    start = pandas.Timestamp('2026-01-31T23:59:50', tz='UTC')
    frame.index = start + pandas.to_timedelta(frame.pop('time'), unit='s')
    for given in (frame, frame.tz_localize(None)):
        np.testing.assert_allclose(ac.capture(given).reading, ac.capture(recording).reading,
                                   atol=2e-3)


def test_samples_without_times_are_refused(recording):
    pandas = pytest.importorskip('pandas')
    frame = pandas.DataFrame(recording.reading, columns=['ax', 'ay', 'az'])
    for given in (frame, recording.reading):
        with pytest.raises(InputError, match='look like samples'):
            ac.fit(given)
    assert len(ac.capture(frame, rate=100.0)) == 6


def test_what_python_passes_is_used_as_it_is_or_named():
    pandas = pytest.importorskip('pandas')
    reading = ac.simulate(SENSOR, poses=20).reading
    hidden = np.ma.masked_array(reading, mask=np.arange(60).reshape(20, 3) == 4)
    with pytest.raises(InputError, match='row 2 of ax, ay, az holds a number that is not finite'):
        ac.fit(hidden)
    unnamed = ac.fit(pandas.DataFrame(reading))
    assert (len(unnamed.poses), unnamed.rejected) == (20, ())
    with pytest.raises(ValueError, match="flat is 'middle', expected a row number, first or last"):
        ac.calibrate(reading, flat='middle')
    with pytest.raises(ValueError, match='context is .*, expected a mapping by column'):
        ac.capture('bag', context=['temperature:=/imu/temp'])
    for name in ('rate', 'turn'):
        with pytest.raises(InputError, match=f'{name} is -1, expected'):
            ac.simulate(recording=True, **{name: -1})


def test_a_log_is_calibrated_in_one_call(tmp_path):
    recording = ac.simulate(SENSOR, recording=True, poses=20, seed=3)
    path = tmp_path / 'log.csv'
    write_table(path, recording)
    found = [ac.calibrate(given, flat='first', sensor='imu_link')
             for given in (path, recording, ac.capture(recording), recording.to_dataframe())]
    for calibration in found:
        assert isinstance(calibration, ac.Calibration)
        assert calibration.rating.name == 'GOOD'
        assert calibration.findings == calibration.rating.findings
        assert (calibration.sensor, calibration.is_levelled) == ('imu_link', True)
        np.testing.assert_allclose(calibration.matrix, MATRIX, atol=2e-3)


def test_calibrate_adds_effects_unless_told_otherwise_and_levels_with_them():
    poses = ac.simulate({**SENSOR, 'offset_temperature': [1e-3, 2e-3, -1e-3]}, poses=40,
                        temperature=(10.0, 50.0), noise=1e-3, mounting=(3.0, -5.0, 0.0), seed=1)
    found = ac.calibrate(poses, flat='first')
    assert 'offset_temperature' in found.model.effects
    assert 'offset_temperature' not in ac.calibrate(poses, refined=False).model.effects
    up = found.apply(poses.reading[0], temperature=10.0)
    np.testing.assert_allclose(up / 9.80665, [0.0, 0.0, 1.0], atol=3e-3)
    beyond = poses.take(np.arange(3)).with_columns(temperature=np.array([-20.0, 25.0, 90.0]))
    np.testing.assert_array_equal(found.held(beyond)['temperature'], [10.0, 25.0, 50.0])


def test_calibrate_takes_the_options_of_reading_and_of_capture():
    recording = ac.simulate(SENSOR, recording=True, poses=12, seed=3)
    frame = recording.to_dataframe().rename(columns={'ax': 'p', 'ay': 'q', 'az': 'r'})
    named = {'ax': 'p', 'ay': 'q', 'az': 'r'}
    assert len(ac.calibrate(frame, columns=named, min_dwell=2.0).poses) == 12
    with pytest.raises(InputError, match='min_dwel'):
        ac.calibrate(frame, columns=named, min_dwel=2.0)


def test_a_table_becomes_a_data_frame_and_is_read_again(poses, calibration):
    pytest.importorskip('pandas')
    frame = poses.to_dataframe()
    assert {'ax', 'ay', 'az', 'std_x', 'count'} <= {*frame.columns}
    assert [*frame.index] == [*poses.row]
    np.testing.assert_array_equal(frame['ay'], poses.reading[:, 1])
    assert ac.fit(frame, flat=1, sensor='imu_link') == calibration
    in_g = ac.simulate(SENSOR, seed=1, units='g')
    assert ac.fit(in_g.to_dataframe()).units.name == 'g'


def test_the_figures_of_a_calibration_become_a_data_frame(calibration):
    pytest.importorskip('pandas')
    frame = calibration.to_dataframe()
    assert [*frame.columns] == ['label', 'unit', 'value', 'sd']
    offsets = frame.loc[['offset.x', 'offset.y', 'offset.z']]
    np.testing.assert_array_equal(offsets['value'], calibration.offset)
    np.testing.assert_array_equal(offsets['sd'], calibration.offset_sd)
    assert {*offsets['unit']} == {'m/s²'}
    assert frame.loc['rms_after_mg', 'value'] == calibration.quality.rms_after_mg


def test_the_residuals_of_a_calibration_are_drawn(calibration):
    matplotlib = pytest.importorskip('matplotlib')
    matplotlib.use('Agg')
    axes = calibration.plot()
    before, after = (line.get_ydata() for line in axes.get_lines()[:2])
    assert len(before) == len(after) == len(calibration.used_poses)
    rms = [np.sqrt(np.mean(np.square(each))) for each in (before, after)]
    np.testing.assert_allclose(rms, [calibration.quality.rms_before_mg,
                                     calibration.quality.rms_after_mg], rtol=0.05)
    assert calibration.plot(axes) is axes
    np.testing.assert_array_equal(axes.get_lines()[0].get_xdata(), calibration.used_poses.row)
    from matplotlib import pyplot
    pyplot.close(axes.figure)


def test_calibrations_are_equal_if_all_values_are(calibration, poses, tmp_path):
    calibration.save(tmp_path / 'calibration.yaml')
    again = ac.load(tmp_path / 'calibration.yaml')
    assert calibration == again
    assert again == calibration.in_units('m/s2')
    assert poses == ac.simulate(SENSOR, seed=1)
    for other in (ac.fit(poses, sensor='imu_link'), ac.fit(poses, flat=1),
                  ac.fit(poses.take(slice(1, None)), sensor='imu_link'), None, 'GOOD'):
        assert calibration != other
    assert calibration in [None, again]
    assert poses != ac.simulate(SENSOR, seed=2)
    later = replace(calibration, date='2030-01-01T00:00:00+00:00')
    assert later == calibration  # the same poses fitted later
    with pytest.raises(TypeError, match='unhashable'):
        hash(calibration)


def test_records_are_shown_in_a_line_and_as_html_and_can_be_pickled(calibration, poses):
    for record in (calibration, poses, ac.refine(poses, base=calibration)):
        assert len(repr(record)) < 120
        assert '\n' not in repr(record)
        assert record._repr_html_().startswith(('<table>', '<p>'))
        assert repr(pickle.loads(pickle.dumps(record))) == repr(record)


def test_a_record_is_pickled_with_cached_values_while_another_thread_adds_one(poses):
    class Late:
        def __reduce__(self):
            vars(record)['late'] = True
            return str, ('arm',)

    record = replace(poses, findings=(Late(),))
    vars(record)['early'] = True
    again = pickle.loads(pickle.dumps(record))
    assert again.findings == ('arm',)
    assert vars(record)['late']
    assert vars(again).keys() == {'early', *(each.name for each in fields(poses))}


@pytest.mark.parametrize(('call', 'message'), [
    (lambda poses: ac.fit(poses.reading[:3]), '3 poses'),
    (lambda poses: ac.fit(np.ones((5, 2))), '(5, 2)'),
    (lambda poses: ac.fit(poses, units='g'), 'm/s2'), (lambda poses: ac.fit(poses, flat=40), '40'),
    (lambda poses: ac.fit(poses, nose_down=2), 'no flat row'),
    (lambda poses: ac.fit(poses, flat=1, nose_down=1), '10°'),
    (lambda poses: ac.simulate({'offest': 1.0}), 'offest'),
    *((lambda poses, given=given: ac.simulate({}, **given), words) for given, words in (
        ({'time': [0.0, 1.0]}, '24 rows'), ({'temperature': [1, 2, 3]}, '24 rows'),
        ({'recording': True, 'x': [1]}, 'no value by pose'), ({'temperature': 25}, '24 rows'),
        ({'directions': np.ones(3)}, '(3,)'), ({'directions': [[0, 0, 0]]}, 'zero'))),
    (lambda poses: ac.simulate({'gain_drift': [1, 1, 1, 0]}), 'or state them for each pose'),
    (lambda poses: ac.calibrate(poses, min_dwel=3), 'min_dwel'),
    (lambda poses: ac.refine(ac.simulate({'offset_temperature': 0.016}, temperature=[5, 45])),
     'not on an ellipsoid; check the poses for mistakes, take new poses at one temperature'),
    (lambda poses: ac.compare([ac.fit(poses)]), '1 calibration'),
    (lambda poses: ac.capture(ac.simulate({}, recording=True, poses=2), min_dwel=3), 'min_dwel'),
    (lambda poses: ac.fit(poses).apply(poses.to_dataframe()), '(24, 7)'),
    *((lambda poses, wrong=wrong: ac.fit(poses).apply([[0.1, wrong, 9.8], [0, 0, 9.8]]),
       'not finite') for wrong in (np.nan, np.inf)),
    *((lambda poses, flat=flat: ac.fit(poses, flat=flat, frame='enu'), "frame is 'enu'")
      for flat in (None, 1)),
    (lambda poses: ac.fit(poses.to_dataframe().set_axis([*'xyzxyz', 'n'], axis=1)), 'x, y, z')])
def test_bad_input_is_refused_in_one_line(call, message, poses):
    with pytest.raises((AccelCalibError, ValueError), match=re.escape(message)) as refusal:
        call(poses)
    assert '\n' not in str(refusal.value)


def test_a_lever_arm_acts_in_a_simulated_recording_while_the_sensor_turns() -> None:
    arm = np.array([0.3, -0.2, 0.1])
    none, turned = (ac.simulate({'lever_arm': size * arm}, recording=True, poses=6, dwell=0.5,
                                noise=0.0) for size in (0.0, 1.0))
    rate = none['rate']
    np.testing.assert_allclose(turned.reading - none.reading,
                               np.cross(rate, np.cross(rate, arm)), atol=0.1)
