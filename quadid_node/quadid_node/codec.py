"""Sets, findings and events as plain dictionaries: for the history, for Zenoh, for JSON on the command line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import msgspec
import numpy as np

from quadid.chi_square import Z95
from quadid.condition.watch import HealthReport
from quadid.jsonable import jsonable
from quadid.online.records import OnlineDiagnosis, OnlineSet, SessionStatus
from quadid.parameters import NOMINAL_NAMES


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
    """The set of `set_to_dict`, by the types of the records.

    Raises:
        ValueError, LookupError or TypeError: what is none, or fits into no message: text that UTF-8 has not (it ends
            whoever sends it), samples beyond 32 bits, times whose seconds are.
    """
    msgspec.json.encode(data)  # raises for such text
    found = _with_nan(data)
    parameters = found["parameters"]
    covariance = data.get("covariance") or np.diag([p["sigma"] ** 2 for p in parameters])
    found["parameters"] = {"parameters": parameters, "covariance": covariance}
    made: OnlineSet = msgspec.convert(found, OnlineSet, dec_hook=lambda _, rows: np.array(rows, dtype=np.float64))
    if not 0 <= made.samples < 1 << 32 or any(abs(t) >= 1 << 31 for t in (made.start, made.stop)):
        raise ValueError(f"a set of {made.samples} samples from {made.start:g} to {made.stop:g} s")
    return made


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


def _with_nan(value: Any) -> Any:
    """Data of JSON with NaN for null."""
    if isinstance(value, Mapping):
        return {name: _with_nan(inner) for name, inner in value.items()}
    if isinstance(value, list):
        return [_with_nan(inner) for inner in value]
    return math.nan if value is None else value
