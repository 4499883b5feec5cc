"""Names of parameters and statuses as people read them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

PARAMETER_NAMES: dict[str, str] = {
    "b": "Thrust coefficient",
    "d": "Drag coefficient",
    "J_xx": "Roll inertia",
    "J_yy": "Pitch inertia",
    "J_zz": "Yaw inertia",
    "J_r": "Rotor inertia",
}
STATUS_WORDS: dict[str, str] = {
    "identified": "identified",
    "ratio_only": "only its ratio to {}",
    "prior_dominated": "not observable",
    "unreliable": "unreliable",
}


def parameter_name(symbol: str) -> str:
    """``Thrust coefficient b`` for ``b``; names of effects as they are."""
    return f"{PARAMETER_NAMES[symbol]} {symbol}" if symbol in PARAMETER_NAMES else symbol


def status_words(parameter: Mapping[str, Any]) -> str:
    """A parameter's status for people; `parameter` as in ``quadid.identify/1``."""
    if decided_before(parameter):
        return f"{100.0 * parameter['prior_share']:.0f} % from the file"
    return STATUS_WORDS[parameter["status"]].format(parameter.get("relative_to", "another"))


def decided_before(parameter: Mapping[str, Any]) -> bool:
    """Whether earlier knowledge, such as a `sigma` of the vehicle file, decides the value rather than this flight."""
    return parameter["status"] == "prior_dominated" and bool(parameter.get("measured_before"))


def effects_words(effects: Mapping[str, Mapping[str, float]]) -> str:
    """Effects of a vehicle file with their values: ``motor lag (tau = 0.03 s)``."""
    from quadid.effects import EFFECTS

    parts = []
    for effect, values in effects.items():
        told = ", ".join(f"{k} = {v:g} {EFFECTS[effect].parameter(k).unit}" for k, v in values.items())
        parts.append(f"{effect.replace('_', ' ')} ({told})")
    return ", ".join(parts)
