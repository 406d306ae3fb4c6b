# Copyright 2026 The accel_calib authors
# SPDX-License-Identifier: Apache-2.0

"""The state of the calibrator as diagnostic messages."""

from __future__ import annotations

from diagnostic_msgs.msg import DiagnosticStatus, KeyValue

from ..session import Finding, findings, Health, worst
from ..session.health import figures


def status_of(health: Health) -> DiagnosticStatus:
    """Return the diagnostics: the most severe finding, and the values."""
    status = _status(worst(health), 'calibrator', health)
    status.values = [KeyValue(key=key, value=value) for key, value in figures(health)]
    return status


def self_test_of(health: Health) -> list[DiagnosticStatus]:
    """Return one status for each finding; the test passes if all are OK."""
    return [_status(finding, finding.name, health) for finding in findings(health)]


def _status(finding: Finding, name: str, health: Health) -> DiagnosticStatus:
    return DiagnosticStatus(level=bytes([finding.level]), name=f'accel_calib: {name}',
                            message=finding.words, hardware_id=health.sensor)
