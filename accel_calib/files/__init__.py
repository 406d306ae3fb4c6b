# Copyright 2026 The accel_calib authors
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""Pose tables, recordings and calibrations on disk: one reader and one writer each."""

from .bag import is_bag
from .bag_correction import correct_bag, Progress
from .calibration_yaml import (
    check_sensor,
    format_calibration,
    parse_calibration,
    read_calibration,
    write_calibration,
)
from .recording import open_recording, read_recording, Source, Stream
from .table_csv import read_poses, read_samples, write_table

__all__ = ['Progress', 'Source', 'Stream', 'check_sensor', 'correct_bag', 'format_calibration',
           'is_bag', 'open_recording', 'parse_calibration', 'read_calibration', 'read_poses',
           'read_recording', 'read_samples', 'write_calibration', 'write_table']
