# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The layouts show topics of the policy for SROS 2; test_ros_services compares it with nodes."""

from __future__ import annotations

from collections.abc import Iterator
import json
from pathlib import Path
import re
from typing import Any
from xml.etree import ElementTree

import yaml

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


def of_rviz() -> set[str]:
    layout = yaml.safe_load((CONFIG / 'calibrator.rviz').read_text(encoding='utf-8'))
    return {display['Topic']['Value'] for display in layout['Visualization Manager']['Displays']
            if 'Topic' in display}


def of_foxglove() -> set[str]:
    """Return the topics and services; a path is a topic and fields."""
    def of(value: Any) -> set[str]:
        if isinstance(value, str):
            found = re.match(r'(/[\w/]+)(\.[\w.@]+)?$', value)
            return {found.group(1)} if found else set()
        items = [*value, *value.values()] if isinstance(value, dict) else value
        return {name for item in items for name in of(item)} if isinstance(
            items, list) else set()

    return of(json.loads((CONFIG / 'foxglove.json').read_text(encoding='utf-8'))['configById'])


def of_plotjuggler() -> set[str]:
    """Return the topics of the curves, of the equations and of the subscription."""
    root = ElementTree.parse(CONFIG / 'plotjuggler.xml').getroot()
    sources = [element.text for tag in ('linked_source', 'v1', 'v2') for element in root.iter(tag)]
    curves = {element.get('name') for element in root.iter('curve')}
    made = {element.get('name') for element in root.iter('snippet')}
    subscribed = {name for element in root.iter('selected_topics')
                  for name in element.get('value').split(';')}
    of_series = {next((topic for topic in subscribed if one.startswith(f'{topic}/')), one)
                 for one in [*sources, *(curves - made)]}
    return subscribed | of_series


def test_each_layout_shows_topics_of_the_calibrator_and_all_together_what_it_publishes() -> None:
    names = {'/' + name.replace('~/', 'calibrator/').lstrip('/')
             for name in names_of_the_calibrator()}
    layouts = [of_rviz(), of_foxglove(), of_plotjuggler()]
    assert all(set() < topics <= names for topics in layouts), layouts
    assert set().union(*layouts) >= {
        '/imu/data_raw', '/imu/data_calibrated', '/calibrator/poses', '/calibrator/still',
        '/diagnostics'}
