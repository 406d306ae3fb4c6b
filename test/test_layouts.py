# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The layouts for RViz, Foxglove and PlotJuggler are well-formed, and show topics of the node."""

import json
from pathlib import Path
import re
from xml.etree import ElementTree

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
CONFIG = ROOT / 'config'
SOURCE = (ROOT / 'accel_calib' / 'ros' / 'calibrator_node.py').read_text(encoding='utf-8')
SHOWN = {'/imu/data_raw', '/imu/data_calibrated', '/calibrator/poses', '/calibrator/still',
         '/diagnostics'}
"""What the layouts together are for."""


def names_of_the_node():
    """Return the topics and services of the node, with its name for the tilde."""
    found = re.findall(r"'(~/\w+|imu/\w+|/diagnostics)'", SOURCE)
    triggers = re.search(r'_TRIGGERS = \((.*?)\)', SOURCE, re.DOTALL).group(1)
    names = {*found, *(f'~/{name}' for name in re.findall(r"'(\w+)'", triggers))}
    return {'/' + name.replace('~/', 'calibrator/').lstrip('/') for name in names}


def rviz():
    return yaml.safe_load((CONFIG / 'calibrator.rviz').read_text(encoding='utf-8'))


def foxglove():
    return json.loads((CONFIG / 'foxglove.json').read_text(encoding='utf-8'))


def plotjuggler():
    return ElementTree.parse(CONFIG / 'plotjuggler.xml').getroot()


def topics_of_rviz():
    return {display['Topic']['Value'] for display in rviz()['Visualization Manager']['Displays']
            if 'Topic' in display}


def topics_of_foxglove():
    """Return the topics and services; a path is a topic and fields."""
    def of(value):
        if isinstance(value, str):
            found = re.match(r'(/[\w/]+)(\.[\w.@]+)?$', value)
            return {found.group(1)} if found else set()
        items = [*value, *value.values()] if isinstance(value, dict) else value
        return {name for item in items for name in of(item)} if isinstance(
            items, list) else set()

    return of(foxglove()['configById'])


def topics_of_plotjuggler():
    """Return the topics of the curves, of the equations and of the subscription."""
    root = plotjuggler()
    sources = [element.text for tag in ('linked_source', 'v1', 'v2') for element in root.iter(tag)]
    curves = {element.get('name') for element in root.iter('curve')}
    made = {element.get('name') for element in root.iter('snippet')}
    series = [*sources, *(curves - made)]
    subscribed = {name for element in root.iter('selected_topics')
                  for name in element.get('value').split(';')}
    of_series = {next((topic for topic in subscribed if one.startswith(f'{topic}/')), one)
                 for one in series}
    return subscribed | of_series


TOPICS = {'calibrator.rviz': topics_of_rviz, 'foxglove.json': topics_of_foxglove,
          'plotjuggler.xml': topics_of_plotjuggler}


@pytest.mark.parametrize('name', TOPICS)
def test_topics_of_a_layout_are_those_of_the_node(name):
    assert TOPICS[name]()
    assert TOPICS[name]() <= names_of_the_node()


def test_the_layouts_show_what_the_node_publishes():
    assert set().union(*(topics() for topics in TOPICS.values())) >= SHOWN
