"""Outputs of the service for others: messages with the fields of quadid_msgs, and JSON.

Messages are plain dictionaries, for ROS topics and for MCAP alike; times inside are stamps.  JSON is what the history
keeps, Zenoh carries and the commands print.
"""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, NamedTuple

import msgspec
import numpy as np

from quadid.chi_square import Z95
from quadid.condition.watch import HealthReport
from quadid.jsonable import jsonable
from quadid.online.records import (
    Event,
    HealthyFlight,
    OnlineDiagnosis,
    OnlineFinding,
    OnlineSet,
    Phase,
    Publish,
    SessionStatus,
    SetState,
)
from quadid.parameters import NOMINAL_NAMES
from quadid_node.inputs import stamp

Output = Publish | OnlineDiagnosis | HealthReport | HealthyFlight | Event
"""Output of a service; the tables of the links are keyed by its `topic`."""
SILENT_WARNING, SILENT_ERROR = 1.0, 5.0
"""A channel that was there and is silent for this long [s] is worth a warning, an error."""
BEHIND = 2.0
"""From this far behind the data [s] on the backlog is reported, at every doubling."""


def lag(seconds: float) -> str:
    """Message about a session that is so far behind its data [s]; empty where it is not."""
    if seconds < BEHIND:
        return ""
    return f"{seconds:.0f} s behind the data, the machine is too slow: fits are left out, changes come first"


@dataclass(frozen=True)
class Feed:
    """Arrival of one channel.

    Attributes:
        rate: samples a second over the last two seconds [Hz].
        silence: since its last sample, up to when the service looked for samples last [s].
    """

    rate: float
    silence: float


@dataclass(frozen=True)
class ServiceHealth:
    """Snapshot for monitoring: session, channels, worker, history, how long the last fit took [s]."""

    status: SessionStatus
    feeds: dict[str, Feed]
    worker: str
    restarts: int
    history: str
    fit_seconds: float


# --- Messages

Message = dict[str, Any]

PARAMETER_SET = "quadid_msgs/msg/ParameterSet"
TOPICS = {
    "parameters": ("quadid/parameters", PARAMETER_SET),
    "candidate": ("quadid/candidate", PARAMETER_SET),
    "diagnosis": ("quadid/diagnosis", "quadid_msgs/msg/Diagnosis"),
    "vehicle_health": ("quadid/health", "quadid_msgs/msg/Health"),
    "status": ("quadid/status", "quadid_msgs/msg/FitStatus"),
    "diagnostics": ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray"),
}
"""Name and type of each topic."""
PUBLISHED = ("parameters", "candidate", "status")
"""Topics whose messages say when they were sent."""
SCHEMA_VERSION = 3
BODY_FRAME = "base_link_frd"
SET_STATES = {
    SetState.REJECTED: 1,
    SetState.PENDING: 2,
    SetState.ACCEPTED: 3,
    SetState.ROLLED_BACK: 4,
    SetState.STALE: 5,
}
NO_SET = 6
STATUSES = {"identified": 0, "ratio_only": 1, "prior_dominated": 2, "unreliable": 4}
PHASES = {
    Phase.WAITING: 0,
    Phase.COLLECTING: 1,
    Phase.NOT_EXCITED: 2,
    Phase.FITTING: 3,
    Phase.CANDIDATE: 4,
    Phase.PENDING: 4,
    Phase.ACCEPTED: 4,
    Phase.FAILED: 5,
    Phase.BLOCKED: 6,
    Phase.NOT_FLYING: 6,
}
HEALTH_VERDICTS = {"unchanged": 0, "changed": 1, "unknown": 2}
VERDICTS = {"nothing_found": 0, "explained": 1, "partly_explained": 2, "unknown": 3}
OK, WARN, ERROR = b"\x00", b"\x01", b"\x02"
WORKING, NO_HISTORY = ("idle", "busy", "inline"), "none kept"
"""States of a worker, and of no history, that are as they should be."""


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
    """quadid_msgs/ParameterSet of a vehicle without a set in force."""
    nan = math.nan
    return {
        "header": {"frame_id": BODY_FRAME},
        "schema_version": SCHEMA_VERSION,
        "vehicle_id": vehicle,
        "boot_id": boot_id,
        "state": NO_SET,
        "reason": "no set of this vehicle was accepted yet",
        "mass": nan,
        "mse": nan,
        "mse_held_out": nan,
    }


def diagnosis(item: OnlineDiagnosis, vehicle: str) -> Message:
    """quadid_msgs/Diagnosis of what was found."""
    nan = math.nan
    first = item.findings[0] if item.findings else None
    return {
        "header": {"stamp": stamp(item.t), "frame_id": BODY_FRAME},
        "vehicle_id": vehicle,
        "verdict": VERDICTS.get(item.verdict, 3),
        "findings": [_finding(_as_plain(f)) for f in item.findings],
        "mse_nominal": first.mse_before if first else nan,
        "mse_extended": first.mse_after if first else nan,
        "unexplained_channels": [],
        "unexplained": [],
        "window_start": stamp(item.start),
        "window_end": stamp(item.stop),
    }


def _finding(found: Mapping[str, Any]) -> Message:
    """quadid_msgs/Finding of plain data; what belongs to fits is NaN for a change since healthy flights."""
    nan, gain, rows, rivals = math.nan, found.get("gain", {}), found["parameters"], found["alternatives"]
    intervals = [p["ci95"] or (float(p["value"]),) * 2 for p in rows]
    return {
        **{key: found[key] for key in ("effect", "confident", "p_value", "evidence")},
        "parameter_names": [p["name"] for p in rows],
        "parameter_units": [p["unit"] or "1" for p in rows],
        "parameter_values": [float(p["value"]) for p in rows],
        "ci95_lower": [low for low, _ in intervals],
        "ci95_upper": [high for _, high in intervals],
        "mse_before": gain.get("mse_before", nan),
        "mse_after": gain.get("mse_after", nan),
        "gain_ci95": [nan, nan],
        "alternatives": [a["effect"] for a in rivals],
        "alternatives_mse": [a.get("mse_after", nan) for a in rivals],
    }


def _as_plain(found: OnlineFinding) -> dict[str, Any]:
    """A finding as plain data, as in `quadid diagnose`'s JSON, with 95 % intervals."""
    half = {n: Z95 * found.sigma.get(n, math.nan) for n in found.values}
    return {
        "effect": found.effect,
        "confident": found.confident,
        "parameters": [
            {"name": n, "unit": found.units.get(n, ""), "value": v, "ci95": (v - half[n], v + half[n])}
            for n, v in found.values.items()
        ],
        "gain": {"mse_before": found.mse_before, "mse_after": found.mse_after},
        "p_value": found.p_value,
        "evidence": found.evidence,
        "alternatives": [vars(a) for a in found.alternatives],
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
        "mass": mass,
        "mass_lower": low,
        "mass_upper": high,
        "changes": [_finding(change.to_dict()) for change in report.changes],
        "text": report.text,
    }


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


def diagnostics(
    health: ServiceHealth | None,
    name: str,
    hardware: str,
    now: Message,
    notes: dict[str, str],
    hints: dict[str, str],
    idle: str = "",
    problem: str = "",
) -> Message:
    """diagnostic_msgs/DiagnosticArray: session, inputs, worker and history, each a status of its own (REP-107).

    Args:
        health: of the service; None before the node is configured.
        notes: errors of the transport by topic or link (a QoS that does not match, a second publisher).
        idle: why the node is not active, and what to do; empty while it is.
    """

    def part(what: str, level: bytes, text: str, values: dict[str, Any] | None = None) -> Message:
        return entry(name, what, hardware, level, text, values or {})

    if health is None:
        entries = [part("session", ERROR if problem else WARN, f"{idle}; {problem}" if problem else idle)]
        return {"header": {"stamp": now, "frame_id": ""}, "status": entries}
    # The session: its phase and reason, and what it has done.
    status, late = health.status, lag(health.status.backlog)
    warned = bool(idle or late) or status.phase in (Phase.BLOCKED, Phase.FAILED)
    said = "; ".join(filter(None, (late, idle or f"{status.phase.value}: {status.reason}")))
    counts = {
        "set in force": f"{status.in_force}{' (stale)' * status.stale}",
        "waiting for approval": status.pending,
        "approval": status.approval,
        "fits": status.fits,
        "refused": status.rejected,
        "mse": f"{status.mse:.3f}",
        "backlog [s]": f"{status.backlog:.2f}",
        "fits left out": status.skipped,
    }
    # Inputs: the channel that is silent for longest, and what is wrong on topics and links.
    worst, silence = max(((n, feed.silence) for n, feed in health.feeds.items()), key=lambda f: f[1], default=("", 0.0))
    level, arrive = (OK, "data arrive") if health.feeds else (WARN, "nothing arrives yet")
    if silence > SILENT_WARNING:
        level, arrive = ERROR if silence > SILENT_ERROR else WARN, f"{worst} is silent for {silence:.0f} s"
    if troubles := [f"{topic}: {why}" for topic, why in [*notes.items(), *hints.items()]]:
        arrive = "; ".join(troubles if level == OK else [arrive, *troubles])
        level = ERROR if notes else max(level, WARN)
    rates = {f"{k} [Hz]": f"{feed.rate:.1f}" for k, feed in health.feeds.items()}
    dropped = {f"dropped: {reason}": count for reason, count in status.faults.items()}
    entries = [
        part("session", WARN if warned else OK, said, counts),
        part("inputs", level, arrive, rates | dropped),
        part("worker", OK if health.worker in WORKING else WARN, health.worker, {"restarts": health.restarts}),
        part("history", OK if health.history in ("", NO_HISTORY) else ERROR, health.history or "written"),
    ]
    return {"header": {"stamp": now, "frame_id": ""}, "status": entries}


def entry(name: str, part: str, hardware: str, level: bytes, message: str, values: dict[str, Any]) -> Message:
    """diagnostic_msgs/DiagnosticStatus of one part of the node with this full name."""
    pairs = [{"key": str(k), "value": str(v)} for k, v in values.items()]
    return {
        "level": level,
        "name": f"{name.lstrip('/')}: {part}",
        "message": message,
        "hardware_id": hardware,
        "values": pairs,
    }


# --- JSON


_FIELDS = ("name", "unit", "value", "sigma", "ci95", "initial", "bounds", "status", "relative_to")
"""Fields of a parameter in a message."""


def set_to_dict(item: OnlineSet, covariance: bool = True) -> dict[str, Any]:
    """A set; times are stamps [s], parameters as in `quadid identify`'s JSON, with standard deviation and bounds."""
    parameters = [{name: v for name in _FIELDS if (v := getattr(p, name)) is not None} for p in item.parameters]
    data: dict[str, Any] = jsonable(
        {**vars(item), "parameters": parameters, **({"covariance": item.parameters.covariance} if covariance else {})}
    )
    return data


def set_from_dict(data: Mapping[str, Any]) -> OnlineSet:
    """The set of `set_to_dict`, by the types of the records.

    Raises:
        ValueError, LookupError or TypeError: what is none, or fits into no message: text that UTF-8 has not (it ends
            whoever sends it), samples beyond 32 bits, times whose seconds are.
    """
    msgspec.json.encode(data)  # raises for such text
    found = _with_nan(data)
    parameters, _ = found["parameters"], found["reference_sd"]  # without the second it would count as known
    covariance = data.get("covariance") or np.diag([p["sigma"] ** 2 for p in parameters])
    found["parameters"] = {"parameters": parameters, "covariance": covariance}
    made: OnlineSet = msgspec.convert(found, OnlineSet, dec_hook=lambda _, rows: np.array(rows, dtype=np.float64))
    for p in made.parameters:
        if p.ci95[1] < p.value or p.value < p.ci95[0]:
            raise ValueError(f"a set with {p.name} = {p.value:g} outside its interval")
    if not 0.0 <= made.reference_sd <= 1.0:
        raise ValueError(f"a set whose reference has a standard deviation of {made.reference_sd:g}")
    if not 0 <= made.samples < 1 << 32 or any(abs(t) >= 1 << 31 for t in (made.start, made.stop)):
        raise ValueError(f"a set of {made.samples} samples from {made.start:g} to {made.stop:g} s")
    return made


def diagnosis_to_dict(item: OnlineDiagnosis) -> dict[str, Any]:
    """A diagnosis; times are stamps [s], findings as in `quadid diagnose`'s JSON."""
    data: dict[str, Any] = jsonable({**vars(item), "findings": list(map(_as_plain, item.findings))})
    return data


def health_to_dict(report: HealthReport) -> dict[str, Any]:
    """A report as JSON: ``quadid.health/1`` as far as a flight in progress has it, with the loss of every rotor."""
    changes = [change.to_dict() for change in report.changes]
    data: dict[str, Any] = jsonable({"schema": "quadid.health/1", **vars(report), "changes": changes})
    return data


def status_to_dict(status: SessionStatus) -> dict[str, Any]:
    """State of a session."""
    excitation = dict(zip(NOMINAL_NAMES, status.excitation.tolist(), strict=True))
    data: dict[str, Any] = jsonable({**vars(status), "phase": status.phase.name.lower(), "excitation": excitation})
    return data


def _with_nan(value: Any) -> Any:
    """Data of JSON with NaN for null."""
    if isinstance(value, Mapping):
        return {name: _with_nan(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_with_nan(inner) for inner in value]
    return math.nan if value is None else value


class Result(NamedTuple):
    """Forms of an output: as a message, of the vehicle's name and the `boot_id` of `parameter_set`, and as JSON."""

    message: Callable[[Any, str, str], Message]
    json: Callable[[Any], dict[str, Any]]


_SET = Result(
    lambda output, vehicle, boot_id: parameter_set(output.item, vehicle, boot_id),
    lambda output: set_to_dict(output.item),
)
RESULTS: Mapping[str, Result] = {
    "parameters": _SET,
    "candidate": _SET,
    "diagnosis": Result(lambda output, vehicle, _: diagnosis(output, vehicle), diagnosis_to_dict),
    "vehicle_health": Result(lambda output, vehicle, _: health_message(output, vehicle), health_to_dict),
}
"""Forms of each output, by its topic."""
