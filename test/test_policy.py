# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The layouts show topics of the policy for SROS 2; test_ros_services compares it with nodes."""

from collections.abc import Iterator
from pathlib import Path
import re
from xml.etree import ElementTree

CONFIG = Path(__file__).parent.parent / 'config'
FILE = CONFIG / 'sros2_policy.xml'


def optional_elements() -> Iterator[tuple[str, ElementTree.Element]]:
    """Yield the parameter and the element of each right that is in a comment."""
    for words, xml in re.findall(r'<!-- Only with (\w+):\n(.*?)-->', FILE.read_text(), re.DOTALL):
        yield words, ElementTree.fromstring(xml)


def profile_of(executable: str) -> ElementTree.Element:
    return ElementTree.parse(FILE).getroot().find(
        f"enclaves/enclave[@path='/accel_calib/{executable}']/profiles/profile")


def granted(profile: ElementTree.Element, tag: str, right: str) -> set[str]:
    """Return the names of which a profile grants a right."""
    return {each.text for block in profile.findall(tag) if block.get(right) == 'ALLOW'
            for each in block}


def names_of_the_calibrator() -> set[str]:
    """Return the names of its topics and services."""
    profile = profile_of('calibrator')
    return (granted(profile, 'topics', 'publish') | granted(profile, 'topics', 'subscribe')
            | granted(profile, 'services', 'reply'))


def shown_by(layout: str, names: set[str]) -> set[str]:
    """Return the topics and services in a file; of a series of a topic, the topic."""
    text = (CONFIG / layout).read_text(encoding='utf-8')
    return {next((name for name in names if found.startswith(f'{name}/')), found)
            for found in re.findall(r'["\s;>](/[a-z][\w/]*)', text)}


def test_each_layout_shows_topics_of_the_calibrator_and_all_together_what_it_publishes() -> None:
    names = {'/' + name.replace('~/', 'calibrator/').lstrip('/')
             for name in names_of_the_calibrator()}
    layouts = [shown_by(layout, names) for layout in (
        'calibrator.rviz', 'foxglove.json', 'plotjuggler.xml')]
    assert all(set() < topics <= names for topics in layouts), layouts
    assert set().union(*layouts) >= {
        '/imu/data_raw', '/imu/data_calibrated', '/calibrator/poses', '/calibrator/still',
        '/diagnostics'}
