# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""Files of pose tables, recordings and calibrations, with one reader and one writer each."""

from .atomic import copy_atomically, remove_leftovers, write_atomically
from .bag import is_bag
from .bag_correction import correct_bag, Progress
from .calibration_yaml import read_calibration, write_calibration
from .fleet_yaml import read_prior, write_priors
from .logs import LineReader, Log, LogOptions, open_log, OpenLog, read_log, read_recording
from .tables import read_poses, write_blocks, write_table

__all__ = ['LineReader', 'Log', 'LogOptions', 'OpenLog', 'Progress', 'copy_atomically',
           'correct_bag', 'is_bag', 'open_log', 'read_calibration', 'read_log', 'read_poses',
           'read_prior', 'read_recording', 'remove_leftovers', 'write_atomically', 'write_blocks',
           'write_calibration', 'write_priors', 'write_table']
