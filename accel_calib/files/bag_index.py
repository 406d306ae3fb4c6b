# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""
What is in a rosbag2, by its index alone.

`rosbags` counts the messages of an SQLite file one by one when it opens it, which takes as long as
reading them. So the index is read here; where that fails, or tells of something that is not known
here, the answer is None, and `rosbags` opens the bag or says what is wrong with it.

"""

from __future__ import annotations

from pathlib import Path
import sqlite3
import struct
from typing import NamedTuple

import yaml

from . import db3, mcap

Topics = dict[tuple[str, str], int]
"""By name and type, how many messages to expect."""

_STORAGES = ('.mcap', '.db3')
_VERSION = 9  # of metadata.yaml, the newest that is known


class Index(NamedTuple):
    """The files that hold the messages of a bag as they are, and its topics."""

    files: list[Path]
    topics: Topics


def index_of(path: Path) -> Index | None:
    """Read the index of a rosbag2: of a folder, or of a single file."""
    try:
        if path.is_dir():
            return _of_folder(path)
        if path.suffix in _STORAGES:
            return Index([path], (mcap if path.suffix == '.mcap' else db3).topics_in(path))
    except (OSError, sqlite3.Error, struct.error, yaml.YAMLError, ValueError, LookupError,
            TypeError, AttributeError):
        pass
    return None


def _of_folder(path: Path) -> Index | None:
    text = (path / 'metadata.yaml').read_text(encoding='utf-8')
    about = yaml.safe_load(text)['rosbag2_bagfile_information']
    files = [path / Path(name).name for name in about['relative_file_paths']]
    topics: Topics = {}
    for each in about['topics_with_message_count']:
        topic = each['topic_metadata']
        if topic['serialization_format'] != 'cdr':
            return None
        topics[topic['name'], topic['type']] = int(each['message_count'])
    plain = ((about.get('compression_mode') or 'none').lower() == 'none'
             and about['version'] <= _VERSION
             and all(file.is_file() and file.suffix in _STORAGES for file in files))
    return Index(files, topics) if plain else None
