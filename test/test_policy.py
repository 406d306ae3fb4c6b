# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The policy for SROS 2 is well formed, and has the names of the nodes; see test_ros_policy."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest

ROOT = Path(__file__).parent.parent
FILE = ROOT / 'config' / 'sros2_policy.xml'
ROS = ROOT / 'accel_calib' / 'ros'


ENCLAVES = {'calibrator': 'calibrator', 'calibrator_lifecycle': 'calibrator',
            'simulator': 'simulator'}
"""Name of the node by executable."""

PARAMETERS = {f'~/{name}' for name in (
    'describe_parameters', 'get_parameter_types', 'get_parameters', 'get_type_description',
    'list_parameters', 'set_parameters', 'set_parameters_atomically')}
OF_EVERY_NODE = {'/parameter_events', '/rosout'}
OF_MANAGED_NODES = {f'~/{name}' for name in (
    'change_state', 'get_available_states', 'get_available_transitions', 'get_state',
    'get_transition_graph')}


def policy() -> ElementTree.Element:
    return ElementTree.parse(FILE).getroot()


def optional_elements() -> Iterator[tuple[str, ElementTree.Element]]:
    """Yield the parameter and the element of each right that is in a comment."""
    for words, xml in re.findall(r'<!-- Only with (\w+):\n(.*?)-->', FILE.read_text(), re.DOTALL):
        yield words, ElementTree.fromstring(xml)


def profile_of(executable: str) -> ElementTree.Element:
    return policy().find(f"enclaves/enclave[@path='/accel_calib/{executable}']/profiles/profile")


def granted(profile: ElementTree.Element, tag: str, right: str) -> set[str]:
    """Return the names of which a profile grants a right."""
    return {each.text for block in profile.findall(tag) if block.get(right) == 'ALLOW'
            for each in block}


def source_names(module: str, method: str) -> set[str]:
    """Return the names in the calls of a method in a module of the nodes."""
    text = (ROS / f'{module}.py').read_text(encoding='utf-8')
    return set(re.findall(rf"{method}\([^()']*'([~/\w]+)'", text))


def triggers() -> set[str]:
    text = (ROS / 'calibrator_node.py').read_text(encoding='utf-8')
    names = re.search(r'_TRIGGERS = \((.*?)\)', text, re.DOTALL).group(1)
    return {f'~/{name}' for name in re.findall(r"'(\w+)'", names)}


def test_each_executable_has_an_enclave() -> None:
    found = {enclave.get('path'): enclave.find('profiles/profile').get('node')
             for enclave in policy().iter('enclave')}
    assert found == {f'/accel_calib/{name}': node for name, node in ENCLAVES.items()}


@pytest.mark.parametrize('executable', ['calibrator', 'calibrator_lifecycle'])
def test_topics_of_the_calibrator_are_those_of_the_code(executable: str) -> None:
    profile, managed = profile_of(executable), executable == 'calibrator_lifecycle'
    made = source_names('calibrator_node', 'create_publisher') | source_names(
        'calibrator_node', '_published')
    assert granted(profile, 'topics', 'publish') == made | OF_EVERY_NODE | (
        {'~/transition_event'} if managed else set())
    assert granted(profile, 'topics', 'subscribe') == source_names(
        'calibrator_node', 'create_subscription')


@pytest.mark.parametrize('executable', ['calibrator', 'calibrator_lifecycle'])
def test_services_of_the_calibrator_are_those_of_the_code(executable: str) -> None:
    profile, managed = profile_of(executable), executable == 'calibrator_lifecycle'
    made = triggers() | source_names('calibrator_node', 'create_service')
    assert len(made) > 10
    assert granted(profile, 'services', 'reply') == made | PARAMETERS | (
        OF_MANAGED_NODES if managed else set())


def test_names_of_the_simulator_are_those_of_the_code() -> None:
    profile = profile_of('simulator')
    made = source_names('simulator_node', 'create_publisher')
    assert granted(profile, 'topics', 'publish') == made | OF_EVERY_NODE
    assert granted(profile, 'topics', 'subscribe') == set()
    assert granted(profile, 'services', 'reply') == PARAMETERS | source_names(
        'simulator_node', 'create_service')


def test_no_node_may_call_a_service() -> None:
    assert not any(granted(profile, 'services', 'request') for profile in policy().iter('profile'))
