# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The ``metadata.yaml`` of a rosbag2 of one file."""

from __future__ import annotations

from pathlib import Path
from typing import Any, TYPE_CHECKING

import yaml

if TYPE_CHECKING:
    from rosbags.highlevel import AnyReader

_STORAGES = {'.mcap': 'mcap', '.db3': 'sqlite3'}
_VERSION = 9


def write_metadata(reader: AnyReader, file: Path) -> None:
    """
    Write what is known of an open bag beside the file that will hold its messages.

    Parameters
    ----------
    reader : AnyReader
        The bag.
    file : Path
        Named after the storage: ``.mcap`` or ``.db3``.

    """
    about = {'version': _VERSION, 'storage_identifier': _STORAGES[file.suffix],
             'relative_file_paths': [file.name], **_span(reader),
             'topics_with_message_count': [_topic(reader, each) for each in reader.connections],
             'compression_format': '', 'compression_mode': '',
             'files': [{'path': file.name, **_span(reader)}], 'custom_data': None,
             'ros_distro': getattr(reader.readers[0], 'ros_distro', None) or ''}
    with (file.parent / 'metadata.yaml').open('w', encoding='utf-8') as out:
        yaml.safe_dump({'rosbag2_bagfile_information': about}, out, sort_keys=False)


def _span(reader: AnyReader) -> dict[str, Any]:
    return {'starting_time': {'nanoseconds_since_epoch': reader.start_time},
            'duration': {'nanoseconds': max(reader.duration - 1, 0)},
            'message_count': reader.message_count}


def _topic(reader: AnyReader, connection: Any) -> dict[str, Any]:
    return {'topic_metadata': {
        'name': connection.topic, 'type': connection.msgtype,
        'serialization_format': connection.ext.serialization_format,
        'offered_qos_profiles': [_profile(each) for each in connection.ext.offered_qos_profiles],
        'type_description_hash': connection.digest or reader.typestore.hash_rihs01(
            connection.msgtype)}, 'message_count': connection.msgcount}


def _profile(qos: Any) -> dict[str, Any]:
    """Give a quality of service as rosbag2 writes it."""
    names = {key: getattr(qos, key).name.lower()
             for key in ('history', 'reliability', 'durability', 'liveliness')}
    times = {key: {'sec': getattr(qos, key).sec, 'nsec': getattr(qos, key).nsec}
             for key in ('deadline', 'lifespan', 'liveliness_lease_duration')}
    return {**names, **times, 'depth': qos.depth,
            'avoid_ros_namespace_conventions': qos.avoid_ros_namespace_conventions}
