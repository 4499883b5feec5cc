"""Health of the vehicle on its way out: message and JSON."""

from __future__ import annotations

import math
from typing import Any

from quadid.condition.changes import Change
from quadid.condition.watch import HealthReport
from quadid.jsonable import jsonable
from quadid_node.inputs import stamp

FRAME = "base_link_frd"
VERDICTS = {"unchanged": 0, "changed": 1, "unknown": 2}


def health_message(report: HealthReport, vehicle: str) -> dict[str, Any]:
    """quadid_msgs/Health of a report."""
    mass, low, high = report.mass
    return {
        "header": {"stamp": stamp(report.t), "frame_id": FRAME},
        "vehicle_id": vehicle,
        "verdict": VERDICTS[report.verdict],
        "has_baseline": report.has_baseline,
        "score": report.score,
        "rotor_loss": list(report.rotor_loss),
        "rotor_loss_lower": [low for low, _ in report.rotor_interval],
        "rotor_loss_upper": [high for _, high in report.rotor_interval],
        "mass": mass, "mass_lower": low, "mass_upper": high,
        "changes": [_finding(change) for change in report.changes],
        "text": report.text,
    }  # fmt: skip


def _finding(change: Change) -> dict[str, Any]:
    """quadid_msgs/Finding of a change; what belongs to fits is NaN."""
    intervals = [ci or (value, value) for _, _, value, ci in change.parameters]
    return {
        "effect": change.effect,
        "confident": change.confident,
        "parameter_names": [name for name, *_ in change.parameters],
        "parameter_units": [unit or "1" for _, unit, *_ in change.parameters],
        "parameter_values": [float(value) for _, _, value, _ in change.parameters],
        "ci95_lower": [low for low, _ in intervals],
        "ci95_upper": [high for _, high in intervals],
        "mse_before": math.nan, "mse_after": math.nan, "gain_ci95": [math.nan, math.nan],
        "p_value": change.p_value,
        "alternatives": [rival.effects[0] for rival in change.rivals],
        "alternatives_mse": [math.nan] * len(change.rivals),
        "evidence": change.evidence,
    }  # fmt: skip


def health_to_dict(report: HealthReport) -> dict[str, Any]:
    """A report as JSON: ``quadid.health/1`` as far as a flight in progress has it, with the loss of every rotor."""
    data: dict[str, Any] = jsonable({
        "schema": "quadid.health/1", "t": report.t, "verdict": report.verdict, "has_baseline": report.has_baseline,
        "changes": [change.to_dict() for change in report.changes],
        "score": report.score, "rotor_loss": report.rotor_loss, "rotor_interval": report.rotor_interval,
        "mass": report.mass, "text": report.text,
    })  # fmt: skip
    return data
