# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0
# flake8: noqa: F401

"""
What tests use of the package beyond the faces of its folders.

Tests import what `accel_calib`, its folders and its base modules export. This module gathers all
other names. A change of the files of the package therefore changes this module, and no test. A
name that is not clear without its file has another one here.

"""

from collections.abc import Sequence
from dataclasses import dataclass
from importlib.util import find_spec
import os
from pathlib import Path

from accel_calib.api import in_units_of
from accel_calib.calibration import Calibration, determines, posterior, refuse_if_unfit, sound_rows
from accel_calib.calibration.directions import poses_needed, rows_of, shape_words
from accel_calib.calibration.mounting import (
    axes_of, doubts_about_flat, fault_of, mounting, with_heading)
from accel_calib.calibration.partial import common_sensors, without_knocked
from accel_calib.calibration.planning import choose_levels, find_undetermined, missing_poses
from accel_calib.cli.commands import COMMANDS, HIDDEN as DEMO_CHOICES, parser
from accel_calib.cli.frame import Output, shown
from accel_calib.cli.main import main
from accel_calib.cli.nodes import changes, screen, state
from accel_calib.cli.options import in_one_line, plain_handler
from accel_calib.comparison import rotation_free
from accel_calib.comparison.agreement import (
    on_one_scale, outlier, p_values, Repeatability, repeatability_of, Runs)
from accel_calib.comparison.drift import change, is_over, MEMORY as DRIFT_MEMORY
from accel_calib.disk import check_regular, previous
from accel_calib.effects import (
    acting_temperature, correct, linear_model, Model, model_with, MODELS, OwnEffect, parse_effect,
    predict, sensor_force, simulate_poses, simulate_recording, ThermalStream, with_vector)
from accel_calib.effects.thermal import Lag, low_passed, rate_of
from accel_calib.estimate import believable, kinds, left_out, originals, unseen_mistakes
from accel_calib.estimate.closed_form import agreeing
from accel_calib.estimate.equations import equations, measured
from accel_calib.findings import mounting_figures
from accel_calib.fleet.overview import (
    digest, digest_of, estimated, not_agreeing, odd_sensors, OfModel, overview, priors_of,
    shared_effects, typical_of, Values as SensorValues, write_fleet_page)
from accel_calib.fleet.recording import (
    as_folder, content_hash, date_of, on_disk, row_of, schema, sensor_of)
from accel_calib.fleet.run import mapped
from accel_calib.fleet.sensors import alike, drift_of, merge_sensor, write_parquet
from accel_calib.geometry import (
    distinct, orientations_of, OVER_THE_SPHERE, quaternion_of, rotation_from_rpy,
    spread_directions, unit, words_of)
from accel_calib.logs import (
    bag_samples, child, is_port, layout_with, LogOptions, open_bag, open_log, port, text)
from accel_calib.logs.names import meaning
from accel_calib.logs.port import _interval as interval_of_lines
from accel_calib.logs.quantities import are_samples
from accel_calib.noise.allan import (
    allan_variances, COMPONENTS as ALLAN_COMPONENTS, fit_components, octaves, shares, spread_of)
from accel_calib.noise.figures import longest_rest
from accel_calib.pipeline import (
    calibrated as calibrated_by, Correction, Intake, is_partial, Plan as FitPlan, poses_of,
    RampIntake, thermally_calibrated)
from accel_calib.refinement import search as refine_search
from accel_calib.refinement.curves import (
    _grown as grown_curve, _rss_beside as rss_beside, best_curve, FoundCurve, Process, process_of,
    SIGNIFICANT, Walk, walk_beside)
from accel_calib.refinement.linear import _RARE as RARE, Block, LEVEL as REFINE_LEVEL, Linear, Set
from accel_calib.refinement.search import (
    _is_better as is_better_than_walk, _less as less, sampled, search as search_effects)
from accel_calib.refinement.settle import accepted, explored, Near, probabilities, reshaped
from accel_calib.refinement.state import (
    beginning, candidates, clipped, fitted_state, grid_step, linearised, off_grid, outside_of,
    unclipped, WORTH)
from accel_calib.refinement.steps import remarks_on
from accel_calib.report.page import all_drawings, axis_figures, curve_parts
from accel_calib.report.residuals import residuals_of
from accel_calib.report.sheet import drawn, page as page_of
from accel_calib.report.stability import comparison_page
from accel_calib.ros.run import own_domain
from accel_calib.session import store as session_store, worker
from accel_calib.session.conditions import figures, step_of
from accel_calib.session.poses import Guide, LiveCapture
from accel_calib.session.settings import changed
from accel_calib.session.state import new_sensor
from accel_calib.session.store import aside, SensorFiles, Store as SensorStore, store_of
from accel_calib.session.stream import StreamStatistics
from accel_calib.session.use import adopt as use_calibration, fit as fit_in_node
from accel_calib.session.worker import Worker, WorkerProcess
from accel_calib.stillness import rest_after, rounding_left, with_temperature
from accel_calib.stillness.chunks import repeated_extremes
from accel_calib.stillness.trend import _long_run as long_run, excess_of_means, oscillation
from accel_calib.stored import calibration_yaml, plain_yaml
from accel_calib.stored.calibration_yaml import calibration_bytes, calibration_from
from accel_calib.stored.exports import (
    CALIBRATION_ALONE, export, FORMATS as EXPORT_FORMATS, identifier, Options as ExportOptions,
    read_noise)
from accel_calib.stored.plain_yaml import MOST_BYTES, MOST_VALUES, read_plain
from accel_calib.table import concatenated, Poses, Recording
from accel_calib.units import Units

COMMAND = ('-m', 'accel_calib.cli.main')
"""Arguments of Python that run the command line."""

NODES = {
    name: ('-m', 'accel_calib.ros.run', name)
    for name in ('calibrator', 'calibrator_lifecycle', 'simulator')}
"""Arguments of Python that run a node, by its name."""

CALIBRATOR = NODES['calibrator']


def format_calibration(calibration: Calibration) -> str:
    """Return the text of the file of a calibration."""
    return calibration_bytes(calibration).decode()


def parse_calibration(text: str, name: str, own: Sequence[OwnEffect] = ()) -> Calibration:
    """Return the calibration in the text of a file, perhaps with own effects."""
    return calibration_from(text.encode(), name, own)


@dataclass(frozen=True)
class Log:
    """A log that was read; `read_as` and `notes` as in `OpenLog`."""

    table: Poses | Recording
    units: Units
    read_as: str
    notes: tuple[str, ...]


def read_log(path: Path, options: LogOptions = LogOptions()) -> Log:
    """Read the poses or the samples of a log; parameters and errors as in `open_log`."""
    with open_log(path, options) as log:
        table = log.poses if log.poses is not None else concatenated(list(log.blocks))
        return Log(table, log.units, log.read_as, log.notes)


def open_log_parts(path: Path, *, in_child: bool) -> list[object]:
    """Return all that is known of a log."""
    with open_log(path, LogOptions(in_child=in_child)) as log:
        return [concatenated(list(log.blocks)), log.samples, log.units, log.sensor, log.read_as,
                log.poses, log.notes, log.findings]


def server_of_children() -> int:
    """Return the id of the process that forks the children that read files."""
    process = child._server(os.getpid())._process
    return process.pid if process else 0


PAGE_FOLDER = Path(session_store.__file__).parents[1] / 'live' / 'page'
"""Files of the live page."""

# Limits that a test lowers, because the real ones take too long: arguments of monkeypatch.setattr.
ROWS_OF_A_TEXT = text, 'ROWS'
ROWS_OF_A_BAG = bag_samples, '_ROWS'
BLOCK_OF_A_BAG = bag_samples, 'BLOCK'
MOST_VALUES_READ = plain_yaml, 'MOST_VALUES'
MOST_BYTES_READ = plain_yaml, 'MOST_BYTES'
MOST_LETTERS_OF_LABELS = calibration_yaml, '_MOST_LETTERS'
HEAD_OF_A_PORT = port, '_HEAD_S'
MOST_OF_A_HEAD = port, '_HEAD_CHARACTERS'
PATIENCE_OF_A_PORT = port, '_PATIENCE_S'
PATIENCE_OF_A_WORKER = worker, '_PATIENCE'
LARGEST_SAMPLE = refine_search, 'MOST'
LARGEST_NUMBER_OF_STEPS = session_store, 'MOST_STEPS'
PATIENCE_WITH_A_CHILD = child, '_PATIENCE_S'

if find_spec('aiohttp'):  # what the live page needs is not installed everywhere
    from accel_calib.live import exchange, host, server
    from accel_calib.live.exchange import (
        announce, BUTTONS, LARGEST as LARGEST_LIVE_MESSAGE, PERIOD as LIVE_PERIOD, qr_code,
        reachable)
    from accel_calib.live.host import Host, open_source, Source
    from accel_calib.live.server import PageServer

    CLOCK_OF_A_SOURCE = host, 'time'
    PATIENCE_FOR_A_HELLO = exchange, '_HELLO_S'
    PATIENCE_FOR_A_REQUEST = server, '_REQUEST_S'
    PERIOD_OF_A_COMPLAINT = server, '_QUIET_S'
    STUCK = server, 'STUCK_S'
