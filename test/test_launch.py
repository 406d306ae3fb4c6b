# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
The launch files start the right executables with real topics, parameters and states.

launch is not on PyPI. The stand-ins for its classes have the same keywords as those of Jazzy, so a
misspelt keyword fails here too. `started` visits a launch file as launch does.

"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, fields, make_dataclass
from pathlib import Path
import re
import runpy
import sys
from types import ModuleType, SimpleNamespace
from typing import Any

from accel_calib.session import CalibratorSettings, WEB_PORT
from inside import default_of
import pytest
import yaml

ROOT = Path(__file__).parent.parent
CALIBRATOR = ROOT / 'launch' / 'calibrator.launch.py'
DEFAULTS = {each.name: default_of(each) for each in fields(CalibratorSettings)}


class Context:
    """What launch knows while it visits a launch file."""

    def __init__(self, given: Mapping[str, str]) -> None:
        self.values = dict(given)
        self.declared: dict[str, DeclareLaunchArgument] = {}


@dataclass(frozen=True)
class LaunchConfiguration:
    name: str

    def perform(self, context: Context) -> str:
        return context.values[self.name]


@dataclass(frozen=True)
class DeclareLaunchArgument:
    name: str
    default_value: str | None = field(default=None, kw_only=True)
    description: str | None = field(default=None, kw_only=True)
    choices: list[str] | None = field(default=None, kw_only=True)

    def visit(self, context: Context) -> list[Any]:
        context.declared[self.name] = self
        value = context.values.setdefault(self.name, self.default_value)
        assert self.choices is None or value in self.choices
        return []


@dataclass(frozen=True)
class OpaqueFunction:
    function: Callable[[Context], list[Any]] = field(kw_only=True)

    def visit(self, context: Context) -> list[Any]:
        return self.function(context)


@dataclass(frozen=True)
class IncludeLaunchDescription:
    source: str
    launch_arguments: Iterable[tuple[str, Any]] = field(default=(), kw_only=True)

    def visit(self, context: Context) -> list[Any]:
        for name, value in self.launch_arguments:
            context.values[name] = text_of(value, context)
        return runpy.run_path(self.source)['generate_launch_description']()


@dataclass(frozen=True)
class IfCondition:
    predicate: LaunchConfiguration

    def evaluate(self, context: Context) -> bool:
        return {'true': True, 'false': False}[self.predicate.perform(context).lower()]


@dataclass(frozen=True)
class ParameterValue:
    value: LaunchConfiguration  # of a text, launch does not convert the type
    value_type: type = field(kw_only=True)

    def evaluate(self, context: Context) -> Any:
        text = self.value.perform(context)
        return text.lower() == 'true' if self.value_type is bool else self.value_type(text)


@dataclass(kw_only=True, eq=False)
class Node:
    package: str
    executable: str
    name: str
    namespace: Any
    output: str
    parameters: list[Any]
    remappings: list[tuple[Any, Any]] = field(default_factory=list)
    context: Context | None = None

    def visit(self, context: Context) -> list[Any]:
        self.context = Context(context.values)
        return []

    def topic(self, name: str) -> str:
        """Return the full name of a topic of the node."""
        renamed = {inside: text_of(outside, self.context) for inside, outside in self.remappings}
        short = renamed.get(name, name)
        namespace = text_of(self.namespace, self.context)
        space = f'/{namespace}' if namespace else ''
        if short.startswith('~/'):
            return f'{space}/{self.name}/{short[2:]}'
        return short if short.startswith('/') else f'{space}/{short}'

    def values(self) -> dict[str, Any]:
        """Return the parameters that are not in a file."""
        return {name: text_of(value, self.context) for given in self.parameters
                if isinstance(given, dict) for name, value in given.items()}


class LifecycleNode(Node):
    """A managed node."""


def record(name: str, *members: str) -> Any:
    """Return a class with keywords, whose visit starts nothing."""
    return make_dataclass(name, members, kw_only=True, frozen=True,
                          namespace={'visit': lambda self, context: []})


ChangeState = record('ChangeState', 'lifecycle_node_matcher', 'transition_id')
EmitEvent = record('EmitEvent', 'event')


@dataclass(frozen=True, kw_only=True)
class OnStateTransition:
    target_lifecycle_node: Node
    start_state: str
    goal_state: str
    entities: list[Any]
    handle_once: bool = False


@dataclass(frozen=True)
class RegisterEventHandler:
    event_handler: OnStateTransition

    def visit(self, context: Context) -> list[Any]:
        return []


def text_of(value: Any, context: Context) -> Any:
    """Return the value of a substitution, or of what is a value already."""
    if isinstance(value, ParameterValue):
        return value.evaluate(context)
    return value.perform(context) if isinstance(value, LaunchConfiguration) else value


TRANSITION = SimpleNamespace(TRANSITION_CONFIGURE=1, TRANSITION_ACTIVATE=3)
MODULES: dict[str, dict[str, Any]] = {
    'ament_index_python.packages': {'get_package_share_path': lambda name: ROOT},
    'launch': {'LaunchContext': Context, 'LaunchDescription': list},
    'launch.actions': {each.__name__: each for each in (
        DeclareLaunchArgument, EmitEvent, IncludeLaunchDescription, OpaqueFunction,
        RegisterEventHandler)},
    'launch.conditions': {'IfCondition': IfCondition},
    'launch.events': {'matches_action': lambda node: node},
    'launch.launch_description_sources': {'PythonLaunchDescriptionSource': str},
    'launch.substitutions': {'LaunchConfiguration': LaunchConfiguration},
    'launch_ros.actions': {'LifecycleNode': LifecycleNode, 'Node': Node},
    'launch_ros.event_handlers': {'OnStateTransition': OnStateTransition},
    'launch_ros.events.lifecycle': {'ChangeState': ChangeState},
    'launch_ros.parameter_descriptions': {'ParameterValue': ParameterValue},
    'lifecycle_msgs.msg': {'Transition': TRANSITION},
}


@dataclass(frozen=True)
class Started:
    """What a launch file did."""

    actions: list[Any]
    declared: dict[str, DeclareLaunchArgument]

    @property
    def nodes(self) -> list[Node]:
        return [each for each in self.actions if isinstance(each, Node)]

    @property
    def node(self) -> Node:
        node, = self.nodes
        return node


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> Callable[..., Started]:
    """Return a function that visits a launch file with arguments."""
    for name, content in MODULES.items():
        module = ModuleType(name)
        vars(module).update(content)
        monkeypatch.setitem(sys.modules, name, module)
        parent = name.rpartition('.')[0]
        if parent and parent not in MODULES:
            monkeypatch.setitem(sys.modules, parent, ModuleType(parent))

    def start(path: Path = CALIBRATOR, **arguments: str) -> Started:
        context, actions = Context(arguments), []

        def visit(entities: Iterable[Any]) -> None:
            for entity in entities:
                actions.append(entity)
                visit(entity.visit(context))

        visit(runpy.run_path(str(path))['generate_launch_description']())
        return Started(actions, context.declared)

    return start


def test_defaults_are_the_topics_of_the_node_and_change_no_parameter(started: Any) -> None:
    node = started().node
    assert (node.package, node.executable) == ('accel_calib', 'calibrator')
    for name in ('imu/data_raw', 'imu/data_calibrated', 'temperature'):
        assert node.topic(name) == f'/{name}'
    assert node.topic('~/linear_acceleration') == '/calibrator/linear_acceleration'
    assert node.values() == {}
    params_file, = node.parameters
    assert Path(text_of(params_file, node.context)) == ROOT / 'config' / 'calibrator.yaml'


@pytest.mark.parametrize(('argument', 'topic'), [
    ('imu', 'imu/data_raw'), ('output', 'imu/data_calibrated'), ('temperature', 'temperature'),
    ('linear_acceleration', '~/linear_acceleration')])
def test_each_topic_has_an_argument(argument: str, topic: str, started: Any) -> None:
    inside = started(namespace='left', **{argument: 'camera/x'}).node
    outside = started(namespace='left', **{argument: '/camera/x'}).node
    assert inside.topic(topic) == '/left/camera/x'
    assert outside.topic(topic) == '/camera/x'


def test_namespace_moves_all_topics_but_the_temperature(started: Any) -> None:
    node = started(namespace='left').node
    assert node.topic('imu/data_raw') == '/left/imu/data_raw'
    assert node.topic('imu/data_calibrated') == '/left/imu/data_calibrated'
    assert node.topic('~/linear_acceleration') == '/left/calibrator/linear_acceleration'
    assert node.topic('temperature') == '/temperature'


GIVEN = {
    'gravity': ('9.81', 9.81), 'passthrough': ('true', True), 'auto_fit': ('true', True),
    'drift_warn': ('0.02', 0.02),
    'units': ('g', 'g'), 'model': ('10', '10'), 'frame': ('ned', 'ned'),
    'output_frame_id': ('base', 'base'), 'rotate': ('false', False),
    'mounting_rpy': ('[0, 0.5, -1]', [0.0, 0.5, -1.0]), 'base_frame': ('base', 'base'),
    'context': ("['supply_voltage:=battery', motor:=/motor/temp]",
                ['supply_voltage:=battery', 'motor:=/motor/temp']),
    'publish_tf': ('true', True), 'gyro_bias': ('True', True), 'fill_covariance': ('true', True),
    'confirm': ('true', True), 'calibration_file': ('/x.yaml', '/x.yaml'), 'sensor': ('7', '7'),
    'web_host': ('0.0.0.0', '0.0.0.0')}
ARGUMENTS = {'imu', 'output', 'temperature', 'linear_acceleration', 'namespace', 'params_file',
             'lifecycle', 'web', 'web_port', *GIVEN}


@pytest.mark.parametrize('name', GIVEN)
def test_each_parameter_argument_sets_a_parameter_of_its_type(name: str, started: Any) -> None:
    text, value = GIVEN[name]
    given = started(**{name: text}).node.values()
    assert given == {name: value}
    assert type(given[name]) is type(DEFAULTS[name])


def test_web_serves_the_live_page(started: Any) -> None:
    assert started(web='true').node.values() == {'web_port': WEB_PORT}
    assert started(web='true', web_port='9000').node.values() == {'web_port': 9000}
    assert started(web_port='9000').node.values() == {}
    assert DEFAULTS['web_port'] == 0


def test_every_argument_is_described(started: Any) -> None:
    declared = started().declared
    assert set(declared) == ARGUMENTS
    assert all(each.description.endswith('.') for each in declared.values())


@pytest.mark.parametrize('text', ['0 0 1.57', '0, 0, 1.57', '[0.0, 0, 1.57]'])
def test_mounting_is_written_as_in_a_urdf_or_as_in_yaml(text: str, started: Any) -> None:
    assert started(mounting_rpy=text).node.values() == {'mounting_rpy': [0.0, 0.0, 1.57]}


@pytest.mark.parametrize('text', ['0 0', '0 0 x', '1 2 3 4', '[]'])
def test_mounting_that_is_not_three_numbers_is_refused(text: str, started: Any) -> None:
    with pytest.raises(ValueError, match='mounting_rpy is .*, expected 3 numbers; write'):
        started(mounting_rpy=text)


def test_lifecycle_starts_the_managed_node_and_activates_it_once(started: Any) -> None:
    plain, managed = started().node, started(lifecycle='true', model='7', namespace='left')
    node = managed.node
    assert isinstance(node, LifecycleNode)
    assert not isinstance(plain, LifecycleNode)
    assert node.executable == 'calibrator_lifecycle'
    assert node.remappings == plain.remappings
    assert node.values() == {'model': '7'}
    handler, = (each.event_handler for each in managed.actions
                if isinstance(each, RegisterEventHandler))
    activate, = handler.entities
    assert activate.event == ChangeState(lifecycle_node_matcher=node, transition_id=3)
    assert (handler.start_state, handler.goal_state) == ('configuring', 'inactive')
    assert handler.target_lifecycle_node is node
    assert handler.handle_once
    after = managed.actions[managed.actions.index(node) + 1:]
    assert after == [EmitEvent(event=ChangeState(lifecycle_node_matcher=node, transition_id=1))]


def test_two_imus_have_their_own_topics_and_share_the_thermometer(started: Any) -> None:
    path = ROOT / 'launch' / 'two_imus.launch.py'
    nodes = started(path, model='7').nodes
    assert [node.topic('imu/data_calibrated') for node in nodes] == [
        '/left/imu/data_calibrated', '/right/imu/data_calibrated']
    assert [node.topic('temperature') for node in nodes] == ['/temperature', '/temperature']
    assert [node.values() for node in nodes] == [{'model': '7'}, {'model': '7'}]
    own = started(path, temperature='temperature').nodes
    assert [node.topic('temperature') for node in own] == [
        '/left/temperature', '/right/temperature']


def test_two_imus_have_live_pages_at_different_ports(started: Any) -> None:
    path = ROOT / 'launch' / 'two_imus.launch.py'
    assert [node.values() for node in started(path, web='true').nodes] == [
        {'web_port': WEB_PORT}, {'web_port': WEB_PORT + 1}]


@pytest.mark.parametrize('namespace', ['', 'robot'])
def test_filters_are_connected_from_the_raw_readings_to_the_odometry(
        namespace: str, started: Any) -> None:
    path = ROOT / 'launch' / 'with_filters.launch.py'
    calibrator, madgwick, ekf = started(path, namespace=namespace, output='corrected',
                                        odometry='wheels', base_link='base').nodes
    assert madgwick.topic('imu/data_raw') == calibrator.topic('imu/data_calibrated')
    assert ekf.topic(ekf.values()['imu0']) == madgwick.topic('imu/data')
    assert ekf.values()['odom0'] == 'wheels'
    frame = calibrator.values()['output_frame_id']
    assert frame == ekf.values()['base_link_frame'] == 'base'
    assert calibrator.values()['fill_covariance'] is True
    assert ekf.values()['imu0_remove_gravitational_acceleration'] is True
    assert madgwick.values()['publish_tf'] is False


def test_filters_use_orientation_rate_and_acceleration_of_the_imu(started: Any) -> None:
    ekf = started(ROOT / 'launch' / 'with_filters.launch.py').nodes[-1].values()
    names = ('x', 'y', 'z', 'roll', 'pitch', 'yaw', 'vx', 'vy', 'vz', 'vroll', 'vpitch', 'vyaw',
             'ax', 'ay', 'az')
    used = {key: [name for name, on in zip(names, ekf[f'{key}_config'], strict=True) if on]
            for key in ('imu0', 'odom0')}
    assert used == {
        'imu0': ['roll', 'pitch', 'yaw', 'vroll', 'vpitch', 'vyaw', 'ax', 'ay', 'az'],
        'odom0': ['vx', 'vy']}


# Names of other packages

NAV2 = ROOT / 'docs' / 'guides' / 'nav2.md'

_IMU = ('', '_config', '_differential', '_relative', '_queue_size', '_pose_rejection_threshold',
        '_twist_rejection_threshold', '_linear_acceleration_rejection_threshold',
        '_remove_gravitational_acceleration')
_ODOM = (*_IMU[:7], '_pose_use_child_frame')
_ODOMETRY = frozenset({'odom_topic'})

THEIRS = {
    # robot_localization, src/ros_filter.cpp
    'ekf_filter_node': {
        'print_diagnostics', 'gravitational_acceleration', 'debug', 'debug_out_file', 'map_frame',
        'odom_frame', 'base_link_frame', 'base_link_frame_output', 'world_frame', 'tf_prefix',
        'publish_tf', 'publish_acceleration', 'permit_corrected_publication',
        'transform_time_offset', 'transform_timeout', 'frequency', 'predict_to_current_time',
        'sensor_timeout', 'two_d_mode', 'smooth_lagged_data', 'history_length',
        'reset_on_time_jump', 'disabled_at_startup', *(f'imu0{end}' for end in _IMU),
        *(f'odom0{end}' for end in _ODOM)},
    # imu_filter_madgwick, src/imu_filter_ros.cpp
    'imu_filter': {
        'stateless', 'use_mag', 'publish_tf', 'reverse_tf', 'fixed_frame', 'constant_dt',
        'remove_gravity_vector', 'publish_debug_topics', 'yaw_offset', 'declination',
        'world_frame', 'gain', 'zeta', 'mag_bias_x', 'mag_bias_y', 'mag_bias_z',
        'orientation_stddev'},
    # nav2_lifecycle_manager, src/lifecycle_manager.cpp
    'lifecycle_manager_imu': {'node_names', 'autostart', 'bond_timeout',
                              'bond_respawn_max_duration', 'attempt_respawn_reconnection'},
    # nav2_bt_navigator, nav2_controller, nav2_velocity_smoother: what the page uses
    'bt_navigator': _ODOMETRY, 'controller_server': _ODOMETRY, 'velocity_smoother': _ODOMETRY,
    'calibrator': set(DEFAULTS)}
"""Names of the parameters of each node, in the files of its package at the commits `FROM`."""

BRINGUP = {'namespace', 'use_namespace', 'slam', 'map', 'use_localization', 'use_sim_time',
           'params_file', 'autostart', 'use_composition', 'use_respawn', 'log_level'}
"""Arguments of nav2_bringup, launch/bringup_launch.py."""

FROM = {'robot_localization': '1cb953379378d13b3e0935ed73d0c7407bd80543',
        'imu_filter_madgwick': 'c8a27cda72ad4e89245e851c732888a089e86065',
        'nav2_bringup, nav2_lifecycle_manager': 'f4108e5b1c2bce804a1aa0c7be6673a8eb4a1501'}


def test_parameters_of_other_packages_have_their_names(started: Any) -> None:
    text = NAV2.read_text(encoding='utf-8')
    shown = [yaml.safe_load(block)
             for block in re.findall(r'^```yaml\n(.*?)^```', text, re.MULTILINE | re.DOTALL)]
    given = {name: about['ros__parameters'] for block in shown for name, about in block.items()}
    assert set(given) == set(THEIRS)
    _, madgwick, ekf = started(ROOT / 'launch' / 'with_filters.launch.py').nodes
    for name, values in (*given.items(), ('imu_filter', madgwick.values()),
                         ('ekf_filter_node', ekf.values())):
        assert set(values) <= THEIRS[name], name
    for key in ('imu0_config', 'odom0_config'):
        assert [type(each) for each in given['ekf_filter_node'][key]] == [bool] * 15
    bringup, = re.findall(r'ros2 launch nav2_bringup bringup_launch.py (.*)', text)
    assert {each.partition(':=')[0] for each in bringup.split()} <= BRINGUP
    assert dict(re.findall(r'^\| (\S.*?) \| .* \| `(\w{40})` \|$', text, re.MULTILINE)) == FROM


@pytest.mark.parametrize(('name', 'more'), [
    ('calibrator', set()), ('two_imus', set()), ('with_filters', {'odometry', 'base_link'})])
def test_launch_finds_the_arguments_of_each_file(name: str, more: set[str]) -> None:
    pytest.importorskip('launch_ros', reason='not on PyPI')
    path = ROOT / 'launch' / f'{name}.launch.py'
    description = runpy.run_path(str(path))['generate_launch_description']()
    assert {each.name for each in description.get_launch_arguments()} == ARGUMENTS | more


def test_every_launch_file_is_tested() -> None:
    files = {path.name.partition('.')[0] for path in (ROOT / 'launch').glob('*.launch.py')}
    assert files == {'calibrator', 'two_imus', 'with_filters'}
