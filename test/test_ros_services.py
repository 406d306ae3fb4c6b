# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The services, the parameters, and all names of the nodes, as stated in files of config/."""

from dataclasses import fields
import re
from typing import Any

from accel_calib.calibration import plan_session
from accel_calib.errors import InputError
from accel_calib.findings import request_words
from accel_calib.logs import read_poses
from accel_calib.session import CalibratorSettings
from accel_calib.units import units_of
from diagnostic_msgs.msg import DiagnosticArray
from inside import capture_settings, changed, Model, simulate_poses, spread_directions
from inside_ros import pose_markers, SimulatorSettings
import numpy as np
import pytest
from sensor_msgs.msg import Imu
from shared import Readings, Stored
from std_msgs.msg import Bool
from test_policy import granted, optional_elements, profile_of
from visualization_msgs.msg import MarkerArray


def count(markers: list[Any], namespace: str = 'poses') -> int:
    return sum(m.ns == namespace for m in markers[-1].markers) if markers else 0


def test_log_and_markers_report_that_more_poses_no_longer_help() -> None:
    poses = simulate_poses(Model({}), spread_directions(24), np.random.default_rng(1))
    asked = plan_session(poses, units_of('g'), 'auto').asked
    assert (asked.direction, re.findall(r'\d\S*', request_words(asked))) == (None, ['24', '0.18'])
    markers = pose_markers(np.zeros((0, 3)), asked, 'imu').markers
    assert [m.text for m in markers if m.ns == 'next'] == [request_words(asked)]
    few = plan_session(poses.take(slice(0, 8)), units_of('g'), 'auto').asked
    arrow, text = [m for m in pose_markers(np.zeros((0, 3)), few, 'imu').markers if m.ns == 'next']
    np.testing.assert_allclose([getattr(arrow.points[1], axis) for axis in 'xyz'], few.direction)
    assert text.text == few.words


def test_poses_are_captured_and_removed_on_request(bench: Any, readings: Readings) -> None:
    markers = bench.listen(MarkerArray, 'calibrator/poses', latched=True)
    still = bench.listen(Bool, 'calibrator/still', latched=True)
    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(auto_capture=False, sensor='arm', passthrough=True)
    poses = readings([[0, 0, 1], [1, 0, 0], [0, 1, 0]], dwell=3.0)
    bench.feed(poses[:140])
    bench.spin(lambda: still and still[-1].data)
    assert count(markers) == 0
    answer = bench.call_while('capture_pose', lambda: bench.imu(poses[130]))
    assert answer.success, answer.message
    assert answer.message.startswith('1 pose: ')
    bench.spin(lambda: count(markers) == 1)
    asked = markers[-1].markers[-1].text
    assert re.search(r' up \([-+xyz ]+\)$', asked)
    assert answer.message.endswith(f'; next: {asked}')

    bench.send_until(lambda: bench.imu(poses[130]), lambda: diagnostics and any(
        value.key == 'next' and value.value == asked
        for value in diagnostics[-1].status[0].values))
    bench.feed(poses[140:165])
    bench.spin(lambda: not still[-1].data)
    rng = np.random.default_rng(1)
    answer = bench.call_while('capture_pose', lambda: bench.imu(
        poses[150] + 2.0 * rng.normal(size=3)))
    assert not answer.success
    assert 'not still' in answer.message
    bench.feed(poses[165:310])
    bench.spin(lambda: still[-1].data)
    assert bench.call_while('capture_pose', lambda: bench.imu(poses[300])).success
    bench.spin(lambda: count(markers) == 2)
    table = bench.home / 'accel_calib' / 'arm_poses.csv'
    bench.spin(lambda: len(read_poses(table)) == 2)
    assert bench.call('undo_pose').success
    bench.spin(lambda: count(markers) == 1)
    assert bench.call('undo_pose').success
    assert not bench.call('undo_pose').success


def test_self_test_names_what_fails(bench: Any, stored: Stored) -> None:
    rng = np.random.default_rng(1)

    def moving() -> Imu:
        return bench.imu(np.array([0, 0, 9.8]) + 3.0 * rng.normal(size=3))

    diagnostics = bench.listen(DiagnosticArray, '/diagnostics')
    bench.calibrator(calibration_file=stored('good.yaml'))
    answer = bench.call('self_test')
    assert answer.passed == b'\x00'
    assert 'no Imu messages' in {status.name: status.message for status in answer.status}[
        'calibrator: stream']
    bench.exchange(bench.came_out, moving)
    diagnostics.clear()

    bench.send_until(moving, lambda: len(diagnostics) > 1)
    answer = bench.call('self_test')
    assert answer.passed == b'\x01', [status.message for status in answer.status]
    assert answer.id == 'imu_link'


def test_parameters_accept_numbers_of_other_types_and_lists() -> None:
    settings = changed(CalibratorSettings(), {'model': 10, 'min_dwell': 2, 'sensor': 7,
                                              'use_sim_time': True})
    assert (settings.model, settings.min_dwell, settings.sensor) == ('10', 2.0, '7')
    assert isinstance(settings.min_dwell, float)
    lists = changed(SimulatorSettings(), {'mounting': [1, 2.5, 3], 'effects': []})
    assert (lists.mounting, lists.effects) == ([1.0, 2.5, 3.0], [])


@pytest.mark.parametrize(('name', 'value'), [
    ('model', '12'), ('model', True), ('gravity', 0.5), ('gravity', float('nan')),
    ('gravity', '9.8'), ('auto_capture', 1), ('auto_fit_poses', 12.5), ('auto_fit_poses', True),
    ('units', 'counts'), ('sensor', ['a'])])
def test_values_that_parameters_do_not_accept_are_refused(name: str, value: Any) -> None:
    with pytest.raises(InputError, match=f'parameter {name} is .*, expected '):
        changed(CalibratorSettings(), {name: value})


def test_lists_of_another_length_and_settings_that_contradict_each_other_are_refused() -> None:
    with pytest.raises(InputError, match='a list of 3 numbers'):
        changed(SimulatorSettings(), {'mounting': [1.0]})
    with pytest.raises(InputError, match='max_dwell'):
        capture_settings(CalibratorSettings(min_dwell=2.0, max_dwell=3.0))


def test_node_declares_all_parameters_and_refuses_invalid_values_while_it_runs(bench: Any) -> None:
    from rcl_interfaces.srv import DescribeParameters, ListParameters, SetParameters
    from rclpy.parameter import Parameter
    bench.calibrator()

    def ask(kind: Any, name: str, **request: Any) -> Any:
        return bench.ask(kind, f'calibrator/{name}', **request)

    table = {parameter.name: parameter.metadata for parameter in fields(CalibratorSettings)}
    names = ask(ListParameters, 'list_parameters').result.names
    assert set(table) <= set(names)
    described = ask(DescribeParameters, 'describe_parameters', names=list(table)).descriptors
    assert {each.name: (each.description, not each.read_only) for each in described} == {
        name: (about['words'], about['live']) for name, about in table.items()}
    tried = [Parameter('model', value=7), Parameter('model', value='11'),
             Parameter('gravity', value=9.81), Parameter('auto_fit_poses', value=2)]
    results = ask(SetParameters, 'set_parameters',
                  parameters=[each.to_parameter_msg() for each in tried]).results
    assert [each.successful for each in results] == [True, False, False, False]
    assert 'one of auto' in results[1].reason


Names = dict[str, set[str]]

RIGHTS = {'publish': 'topics', 'subscribe': 'topics', 'reply': 'services', 'request': 'services'}


def allowed(executable: str, *parameters: str) -> Names:
    """Return the full names by right, with the rights for these parameters."""
    profile = profile_of(executable)
    node = profile.get('node')
    found = {right: {name if name.startswith('/') else f'/{name.replace("~", node)}'
                     for name in granted(profile, tag, right)} for right, tag in RIGHTS.items()}
    for parameter, block in optional_elements():
        if parameter in parameters:
            for right in block.attrib:
                found[right] |= {each.text for each in block}
    return found


def used(bench: Any, node: str) -> Names:
    """Return the full names that a node uses, as DDS shows them."""
    graph = bench.node
    looks = {'publish': graph.get_publisher_names_and_types_by_node,
             'subscribe': graph.get_subscriber_names_and_types_by_node,
             'reply': graph.get_service_names_and_types_by_node,
             'request': graph.get_client_names_and_types_by_node}
    return {right: {name for name, _ in look(node, '/')} for right, look in looks.items()}


@pytest.mark.parametrize(('executable', 'parameters'), [
    ('calibrator', {}),
    ('calibrator', {'use_sim_time': True, 'base_frame': 'base_link', 'publish_tf': True}),
    ('calibrator_lifecycle', {}), ('simulator', {})])
def test_each_node_uses_all_that_the_policy_grants_and_nothing_else(
        executable: str, parameters: dict[str, Any], bench: Any,
        request: pytest.FixtureRequest) -> None:
    if parameters:
        request.getfixturevalue('tf_message')
    bench.start(executable, **parameters)
    if executable == 'calibrator_lifecycle':
        bench.go(1)  # TRANSITION_CONFIGURE
    node, expected = executable.partition('_')[0], allowed(executable, *parameters)
    bench.spin(lambda: node in bench.node.get_node_names())
    bench.spin(lambda: all(expected[right] <= names for right, names in used(bench, node).items()))
    assert used(bench, node) == expected
