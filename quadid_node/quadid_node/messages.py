"""What the service publishes, as plain dictionaries with the fields of quadid_msgs: for ROS topics and for MCAP alike.

Times inside are stamps; `stamps.stamp` turns them into the two integers of builtin_interfaces/Time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from typing import Any

from quadid.chi_square import Z95
from quadid.condition.changes import Change
from quadid.condition.watch import HealthReport
from quadid.online.records import OnlineDiagnosis, OnlineFinding, OnlineSet, Phase, SessionStatus, SetState
from quadid.parameters import NOMINAL_NAMES
from quadid_node.inputs import stamp
from quadid_node.service import SILENT_ERROR, SILENT_WARNING, Health, lag

Message = dict[str, Any]

PARAMETER_SET = "quadid_msgs/msg/ParameterSet"
TOPICS = {
    "parameters": ("quadid/parameters", PARAMETER_SET), "candidate": ("quadid/candidate", PARAMETER_SET),
    "diagnosis": ("quadid/diagnosis", "quadid_msgs/msg/Diagnosis"),
    "vehicle_health": ("quadid/health", "quadid_msgs/msg/Health"),
    "status": ("quadid/status", "quadid_msgs/msg/FitStatus"),
    "diagnostics": ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
}  # fmt: skip
"""Name and type of each topic."""
PUBLISHED = ("parameters", "candidate", "status")
"""Topics whose messages say when they were sent."""
SCHEMA_VERSION = 3
BODY_FRAME = "base_link_frd"
SET_STATES = {
    SetState.REJECTED: 1, SetState.PENDING: 2, SetState.ACCEPTED: 3, SetState.ROLLED_BACK: 4, SetState.STALE: 5,
}  # fmt: skip
NO_SET = 6
STATUSES = {"identified": 0, "ratio_only": 1, "prior_dominated": 2, "unreliable": 4}
PHASES = {
    Phase.WAITING: 0, Phase.COLLECTING: 1, Phase.NOT_EXCITED: 2, Phase.FITTING: 3, Phase.CANDIDATE: 4,
    Phase.PENDING: 4, Phase.ACCEPTED: 4, Phase.FAILED: 5, Phase.BLOCKED: 6, Phase.NOT_FLYING: 6,
}  # fmt: skip
HEALTH_VERDICTS = {"unchanged": 0, "changed": 1, "unknown": 2}
VERDICTS = {"nothing_found": 0, "explained": 1, "partly_explained": 2, "unknown": 3}
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"


def parameter_set(item: OnlineSet, vehicle: str, boot_id: str = "") -> Message:
    """quadid_msgs/ParameterSet of a set; `boot_id` of the run that numbered it, empty for a replay."""
    parameters = list(item.parameters)
    return {
        "header": {"stamp": stamp(item.stop), "frame_id": BODY_FRAME},
        "schema_version": SCHEMA_VERSION,
        "vehicle_id": vehicle,
        "sequence": item.sequence,
        "boot_id": boot_id,
        "state": SET_STATES[item.state],
        "reason": item.reason if not item.check else f"{item.check}: {item.reason}",
        "out_of_date": bool(item.outdated),
        "out_of_date_reason": item.outdated,
        "out_of_date_code": item.outdated and (item.outdated_code or "unknown_cause"),
        "reference": item.reference,
        "mass": item.mass,
        "names": [p.name for p in parameters],
        "units": [p.unit or "1" for p in parameters],
        "values": [p.value for p in parameters],
        "covariance": item.parameters.covariance.ravel().tolist(),
        "status": [STATUSES[p.status.value] for p in parameters],
        "relative_to": [p.relative_to or "" for p in parameters],
        "window_start": stamp(item.start),
        "window_end": stamp(item.stop),
        "samples": item.samples,
        "mse": item.mse,
        "mse_held_out": item.mse_held_out,
        "log_hash": item.input_hash,
        "approved_by": item.approved_by,
    }


def no_set(vehicle: str, boot_id: str) -> Message:
    """quadid_msgs/ParameterSet that says that nothing is in force."""
    nan = math.nan
    return {
        "header": {"frame_id": BODY_FRAME}, "schema_version": SCHEMA_VERSION, "vehicle_id": vehicle,
        "boot_id": boot_id, "state": NO_SET, "reason": "no set of this vehicle was accepted yet",
        "mass": nan, "mse": nan, "mse_held_out": nan,
    }  # fmt: skip


def diagnosis(item: OnlineDiagnosis, vehicle: str) -> Message:
    """quadid_msgs/Diagnosis of what was found."""
    nan = math.nan
    first = item.findings[0] if item.findings else None
    return {
        "header": {"stamp": stamp(item.t), "frame_id": BODY_FRAME},
        "vehicle_id": vehicle,
        "verdict": VERDICTS.get(item.verdict, 3),
        "findings": [_finding(f) for f in item.findings],
        "mse_nominal": first.mse_before if first else nan,
        "mse_extended": first.mse_after if first else nan,
        "unexplained_channels": [],
        "unexplained": [],
        "window_start": stamp(item.start),
        "window_end": stamp(item.stop),
    }


def _finding(finding: OnlineFinding) -> Message:
    values = finding.values
    half = {n: Z95 * finding.sigma.get(n, math.nan) for n in values}
    return {
        "effect": finding.effect,
        "confident": finding.confident,
        "parameter_names": list(values),
        "parameter_units": [finding.units.get(n) or "1" for n in values],
        "parameter_values": list(values.values()),
        "ci95_lower": [v - half[n] for n, v in values.items()],
        "ci95_upper": [v + half[n] for n, v in values.items()],
        "mse_before": finding.mse_before,
        "mse_after": finding.mse_after,
        "gain_ci95": [math.nan, math.nan],
        "p_value": finding.p_value,
        "alternatives": [a.effect for a in finding.alternatives],
        "alternatives_mse": [a.mse_after for a in finding.alternatives],
        "evidence": finding.evidence,
    }


def health_message(report: HealthReport, vehicle: str) -> Message:
    """quadid_msgs/Health of a report."""
    mass, low, high = report.mass
    return {
        "header": {"stamp": stamp(report.t), "frame_id": BODY_FRAME},
        "vehicle_id": vehicle,
        "verdict": HEALTH_VERDICTS[report.verdict],
        "has_baseline": report.has_baseline,
        "score": report.score,
        "rotor_loss": list(report.rotor_loss),
        "rotor_loss_lower": [low for low, _ in report.rotor_interval],
        "rotor_loss_upper": [high for _, high in report.rotor_interval],
        "mass": mass, "mass_lower": low, "mass_upper": high,
        "changes": [_change(change) for change in report.changes],
        "text": report.text,
    }  # fmt: skip


def _change(change: Change) -> Message:
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


RESULTS: Mapping[str, Callable[[Any, str, str], Message]] = {
    "parameters": lambda output, vehicle, boot_id: parameter_set(output.item, vehicle, boot_id),
    "candidate": lambda output, vehicle, boot_id: parameter_set(output.item, vehicle, boot_id),
    "diagnosis": lambda output, vehicle, _: diagnosis(output, vehicle),
    "vehicle_health": lambda output, vehicle, _: health_message(output, vehicle),
}
"""Message of an output, by its topic; of the vehicle's name and the `boot_id` of `parameter_set`."""


def fit_status(status: SessionStatus, vehicle: str, seconds: float = math.nan) -> Message:
    """quadid_msgs/FitStatus; `seconds` is how long the last fit took."""
    return {
        "header": {"stamp": stamp(status.t), "frame_id": BODY_FRAME},
        "vehicle_id": vehicle,
        "in_force": status.in_force,
        "state": PHASES[status.phase],
        "reason": "; ".join(filter(None, (lag(status.backlog), f"{status.phase.value}: {status.reason}"))),
        "names": list(NOMINAL_NAMES),
        "excitation": [float(v) for v in status.excitation],
        "samples": status.samples,
        "window_seconds": status.window_seconds,
        "backlog": status.backlog,
        "gaps": status.gaps,
        "cost": status.mse,
        "seconds": seconds,
        "fits": status.fits,
        "rejected": status.rejected,
    }


def idle_status(vehicle: str, reason: str) -> Message:
    """quadid_msgs/FitStatus of a node that is not active, or was not configured."""
    return {"vehicle_id": vehicle, "reason": reason, "cost": math.nan, "seconds": math.nan}


def diagnostics(
    health: Health | None, name: str, hardware: str, now: Message, notes: dict[str, str], hints: dict[str, str],
    idle: str = "", problem: str = "",
) -> Message:  # fmt: skip
    """diagnostic_msgs/DiagnosticArray: session, inputs, worker and history, each a status of its own (REP-107).

    Args:
        health: of the service; None before the node is configured.
        name: full node name.
        hardware: vehicle.
        now: stamp of the report.
        notes: errors of the transport by topic or link (a QoS that does not match, a second publisher).
        hints: what is wrong with the messages of a topic.
        idle: why the node is not active, and what to do; empty while it is.
        problem: why it could not be configured, or empty.
    """
    if health is None:
        said = f"{idle}; {problem}" if problem else idle
        entries = [entry(name, "session", hardware, ERROR if problem else WARN, said, {})]
        return {"header": {"stamp": now, "frame_id": ""}, "status": entries}
    status = health.status
    warned = bool(idle) or status.phase in (Phase.BLOCKED, Phase.FAILED) or bool(lag(status.backlog))
    said = idle or f"{status.phase.value}: {status.reason}"
    if lag(status.backlog):
        said = f"{lag(status.backlog)}; {said}"
    session = entry(name, "session", hardware, WARN if warned else OK, said, {
        "set in force": f"{status.in_force}{' (stale)' * status.stale}", "waiting for approval": status.pending,
        "approval": status.approval, "fits": status.fits, "refused": status.rejected, "mse": f"{status.mse:.3f}",
        "backlog [s]": f"{status.backlog:.2f}", "fits left out": status.skipped,
    })  # fmt: skip
    worker_level = OK if health.worker in ("idle", "busy", "inline") else WARN
    worker = entry(name, "worker", hardware, worker_level, health.worker, {"restarts": health.restarts})
    history_level = OK if health.history in ("", "none kept") else ERROR
    history = entry(name, "history", hardware, history_level, health.history or "written", {})
    entries = [session, _inputs(health, name, hardware, notes, hints), worker, history]
    return {"header": {"stamp": now, "frame_id": ""}, "status": entries}


def _inputs(health: Health, name: str, hardware: str, notes: dict[str, str], hints: dict[str, str]) -> Message:
    level, message = OK, "data arrive"
    worst = max(health.feeds.items(), key=lambda item: item[1].silence, default=None)
    if worst is None:
        level, message = WARN, "nothing arrives yet"
    elif worst[1].silence > SILENT_WARNING:
        level = ERROR if worst[1].silence > SILENT_ERROR else WARN
        message = f"{worst[0]} is silent for {worst[1].silence:.0f} s"
    troubles = [f"{topic}: {why}" for topic, why in [*notes.items(), *hints.items()]]
    if troubles:
        message = "; ".join(troubles if level == OK else [message, *troubles])
        level = ERROR if notes else max(level, WARN)
    values: dict[str, Any] = {f"{k} [Hz]": f"{feed.rate:.1f}" for k, feed in health.feeds.items()}
    values |= {f"dropped: {reason}": count for reason, count in health.status.faults.items()}
    return entry(name, "inputs", hardware, level, message, values)


def entry(name: str, part: str, hardware: str, level: bytes, message: str, values: dict[str, Any]) -> Message:
    """diagnostic_msgs/DiagnosticStatus of one part of the node with this full name."""
    pairs = [{"key": str(k), "value": str(v)} for k, v in values.items()]
    return {
        "level": level, "name": f"{name.lstrip('/')}: {part}", "message": message, "hardware_id": hardware,
        "values": pairs,
    }  # fmt: skip
