"""Sets, findings and events as plain dictionaries: for the history, for Zenoh, for JSON on the command line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from quadid.chi_square import Z95
from quadid.condition.watch import HealthReport
from quadid.jsonable import jsonable
from quadid.online.records import OnlineDiagnosis, OnlineSet, Reference, SessionStatus, SetState
from quadid.parameters import NOMINAL_NAMES, Parameter, ParameterSet, Status


def set_to_dict(item: OnlineSet, covariance: bool = True) -> dict[str, Any]:
    """A set; times are stamps [s], parameters as in `quadid identify`'s JSON, with standard deviation and bounds."""
    parameters = [
        {
            "name": p.name, "unit": p.unit, "value": p.value, "sigma": p.sigma, "ci95": p.ci95, "initial": p.initial,
            "bounds": p.bounds, "status": p.status, **({"relative_to": p.relative_to} if p.relative_to else {}),
        }
        for p in item.parameters
    ]  # fmt: skip
    data: dict[str, Any] = jsonable({
        **vars(item), "parameters": parameters, **({"covariance": item.parameters.covariance} if covariance else {}),
    })  # fmt: skip
    return data


def set_from_dict(data: Mapping[str, Any]) -> OnlineSet:
    """The set of `set_to_dict`; raises KeyError, TypeError or ValueError for what is none, or fits into no message."""
    parameters = []
    for p in data["parameters"]:
        values = [_float(v) for v in (p["value"], p["sigma"], *p["ci95"], p["initial"], *p["bounds"])]
        relative = p.get("relative_to")
        parameters.append(Parameter(
            text(p["name"]), text(p["unit"]), values[0], values[1], values[4], (values[5], values[6]),
            Status(p["status"]), relative if relative is None else text(relative), (values[2], values[3]),
        ))  # fmt: skip
    covariance = np.array(data.get("covariance") or np.diag([p.sigma**2 for p in parameters]), dtype=np.float64)
    found = ParameterSet(tuple(parameters), covariance)
    return OnlineSet(
        int(data["sequence"]), SetState(data["state"]), text(data["reason"]), found,
        _time(data["start"]), _time(data["stop"]), _count(data["samples"]), _float(data["mse"]),
        _float(data["mse_held_out"]), text(data["input_hash"]), text(data["approved_by"]), text(data["check"]),
        _float(data.get("mass")), text(data.get("outdated", "")), text(data.get("outdated_code", "")),
        _reference(data.get("reference", "none")),
    )  # fmt: skip


def diagnosis_to_dict(item: OnlineDiagnosis) -> dict[str, Any]:
    """A diagnosis; times are stamps [s], findings as in `quadid diagnose`'s JSON."""
    findings = []
    for found in item.findings:
        parameters = []
        for name, value in found.values.items():
            half = Z95 * found.sigma.get(name, math.nan)
            ci95 = value - half, value + half
            parameters.append({"name": name, "unit": found.units.get(name, ""), "value": value, "ci95": ci95})
        findings.append({
            "effect": found.effect, "confident": found.confident, "parameters": parameters,
            "gain": {"mse_before": found.mse_before, "mse_after": found.mse_after},
            "p_value": found.p_value, "evidence": found.evidence, "alternatives": [vars(a) for a in found.alternatives],
        })  # fmt: skip
    data: dict[str, Any] = jsonable({**vars(item), "findings": findings})
    return data


def health_to_dict(report: HealthReport) -> dict[str, Any]:
    """A report as JSON: ``quadid.health/1`` as far as a flight in progress has it, with the loss of every rotor."""
    data: dict[str, Any] = jsonable({
        "schema": "quadid.health/1", "t": report.t, "verdict": report.verdict, "has_baseline": report.has_baseline,
        "changes": [change.to_dict() for change in report.changes],
        "score": report.score, "rotor_loss": report.rotor_loss, "rotor_interval": report.rotor_interval,
        "mass": report.mass, "text": report.text,
    })  # fmt: skip
    return data


def status_to_dict(status: SessionStatus) -> dict[str, Any]:
    """What a session is doing."""
    excitation = dict(zip(NOMINAL_NAMES, status.excitation.tolist(), strict=True))
    data: dict[str, Any] = jsonable({**vars(status), "phase": status.phase.name.lower(), "excitation": excitation})
    return data


def _reference(value: object) -> Reference:
    for known in get_args(Reference):
        if value == known:
            return known  # type: ignore[no-any-return]
    raise ValueError(f"a set with reference {str(value)[:40]!r}; allowed: {', '.join(get_args(Reference))}")


def text(value: object) -> str:
    """Text that UTF-8 has; a half of a surrogate pair ends whoever sends it."""
    found = str(value)
    found.encode()
    return found


def _count(value: Any) -> int:
    """Of 32 bits, as the message has it."""
    if not 0 <= int(value) < 1 << 32:
        raise ValueError(f"a set of {str(value)[:40]} samples")
    return int(value)


def _time(value: float | None) -> float:
    """A stamp [s]; the message has 32 bits for seconds."""
    t = _float(value)
    if abs(t) >= 1 << 31:
        raise ValueError(f"a set of the time {t:g}")
    return t


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)
