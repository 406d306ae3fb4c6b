# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The policy for SROS 2 grants what the running nodes use, and nothing else."""

from __future__ import annotations

from typing import Any

from test_policy import granted, optional_elements, profile_of

Names = dict[str, set[str]]

RIGHTS = {'publish': 'topics', 'subscribe': 'topics', 'reply': 'services', 'request': 'services'}


def resolved(name: str, node: str) -> str:
    """Return the full name of a topic or service of a node without a namespace."""
    return name if name.startswith('/') else f'/{name.replace("~", node)}'


def allowed(executable: str, *parameters: str) -> Names:
    """Return the full names by right, with the rights for these parameters."""
    profile = profile_of(executable)
    node = profile.get('node')
    found = {right: {resolved(name, node) for name in granted(profile, tag, right)}
             for right, tag in RIGHTS.items()}
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


def compare(bench: Any, node: str, expected: Names) -> None:
    """Wait until all that is allowed is seen, and check that there is nothing else."""
    bench.spin(lambda: node in bench.node.get_node_names())
    bench.spin(lambda: all(expected[right] <= names for right, names in used(bench, node).items()))
    assert used(bench, node) == expected


def test_calibrator_uses_all_that_the_policy_grants_and_nothing_else(bench: Any) -> None:
    bench.calibrator()
    compare(bench, 'calibrator', allowed('calibrator'))


def test_rights_in_comments_are_those_that_the_parameters_need(
        bench: Any, tf_message: Any) -> None:
    bench.calibrator(use_sim_time=True, base_frame='base_link', publish_tf=True)
    compare(bench, 'calibrator', allowed('calibrator', 'use_sim_time', 'base_frame', 'publish_tf'))


def test_simulator_uses_all_that_the_policy_grants_and_nothing_else(bench: Any) -> None:
    bench.start('simulator', poses=2, dwell=1.0)
    compare(bench, 'simulator', allowed('simulator'))


def test_managed_calibrator_uses_all_that_the_policy_grants_and_nothing_else(bench: Any) -> None:
    from lifecycle_msgs.msg import Transition
    bench.start('calibrator_lifecycle')
    bench.go(Transition.TRANSITION_CONFIGURE)
    compare(bench, 'calibrator', allowed('calibrator_lifecycle'))
