"""Sets, findings and events as plain dictionaries: for the history, for Zenoh, for JSON on the command line."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any, get_args

import numpy as np

from quadid.chi_square import Z95
from quadid.jsonable import jsonable
from quadid.online.records import OnlineDiagnosis, OnlineFinding, OnlineSet, Reference, SessionStatus, SetState
from quadid.parameters import NOMINAL_NAMES, Parameter, ParameterSet, Status


def number(value: float | None) -> float | None:
    """A number that JSON can hold: NaN and infinities become null."""
    return None if value is None or not math.isfinite(value) else float(value)


def parameters_to_dict(parameters: ParameterSet) -> list[dict[str, Any]]:
    """Parameters as in `quadid identify`'s JSON, with standard deviation and bounds."""
    out = []
    for p in parameters:
        entry = {
            "name": p.name, "unit": p.unit, "value": number(p.value), "sigma": number(p.sigma),
            "ci95": [number(p.ci95[0]), number(p.ci95[1])], "initial": number(p.initial),
            "bounds": [number(p.bounds[0]), number(p.bounds[1])], "status": p.status.value,
        }  # fmt: skip
        if p.relative_to is not None:
            entry["relative_to"] = p.relative_to
        out.append(entry)
    return out


def set_to_dict(item: OnlineSet, covariance: bool = True) -> dict[str, Any]:
    """A set; times are stamps [s]."""
    out: dict[str, Any] = {
        "sequence": item.sequence, "state": item.state.value, "check": item.check, "reason": item.reason,
        "approved_by": item.approved_by, "start": number(item.start), "stop": number(item.stop),
        "samples": item.samples, "mse": number(item.mse), "mse_held_out": number(item.mse_held_out),
        "input_hash": item.input_hash, "mass": number(item.mass), "outdated": item.outdated,
        "outdated_code": item.outdated_code, "reference": item.reference,
        "parameters": parameters_to_dict(item.parameters),
    }  # fmt: skip
    if covariance:
        out["covariance"] = item.parameters.covariance.tolist()
    return out


def set_from_dict(data: Mapping[str, Any]) -> OnlineSet:
    """The set of `set_to_dict`; raises KeyError, TypeError or ValueError for what is none."""
    parameters = []
    for p in data["parameters"]:
        values = [_float(v) for v in (p["value"], p["sigma"], *p["ci95"], p["initial"], *p["bounds"])]
        parameters.append(Parameter(
            str(p["name"]), str(p["unit"]), values[0], values[1], values[4], (values[5], values[6]),
            Status(p["status"]), p.get("relative_to"), (values[2], values[3]),
        ))  # fmt: skip
    covariance = np.array(data.get("covariance") or np.diag([p.sigma**2 for p in parameters]), dtype=np.float64)
    found = ParameterSet(tuple(parameters), covariance)
    return OnlineSet(
        int(data["sequence"]), SetState(data["state"]), str(data["reason"]), found,
        _float(data["start"]), _float(data["stop"]), int(data["samples"]), _float(data["mse"]),
        _float(data["mse_held_out"]), str(data["input_hash"]), str(data["approved_by"]), str(data["check"]),
        _float(data.get("mass")), str(data.get("outdated", "")), str(data.get("outdated_code", "")),
        _reference(data.get("reference", "none")),
    )  # fmt: skip


def finding_to_dict(finding: OnlineFinding) -> dict[str, Any]:
    """A finding as in `quadid diagnose`'s JSON."""
    parameters = []
    for name, value in finding.values.items():
        half = Z95 * finding.sigma.get(name, math.nan)
        parameters.append({
            "name": name, "unit": finding.units.get(name, ""), "value": number(value),
            "ci95": [number(value - half), number(value + half)],
        })  # fmt: skip
    return {
        "effect": finding.effect, "confident": finding.confident, "parameters": parameters,
        "gain": {"mse_before": number(finding.mse_before), "mse_after": number(finding.mse_after)},
        "p_value": number(finding.p_value), "evidence": finding.evidence,
        "alternatives": [{"effect": a.effect, "mse_after": number(a.mse_after)} for a in finding.alternatives],
    }  # fmt: skip


def diagnosis_to_dict(item: OnlineDiagnosis) -> dict[str, Any]:
    """A diagnosis; times are stamps [s]."""
    return {
        "t": number(item.t), "start": number(item.start), "stop": number(item.stop), "verdict": item.verdict,
        "findings": [finding_to_dict(f) for f in item.findings],
    }  # fmt: skip


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


def _float(value: float | None) -> float:
    return math.nan if value is None else float(value)
