"""A parameter set as read-only MAVLink parameters."""

from __future__ import annotations

from quadid.online.records import OnlineSet

PARAMETERS = {"b": "QI_B", "d": "QI_D", "J_xx": "QI_J_XX", "J_yy": "QI_J_YY", "J_zz": "QI_J_ZZ", "J_r": "QI_J_R"}

REFERENCES = {"none": 0.0, "vehicle_file": 1.0, "history": 2.0}
"""What a set was compared with, as a number."""


def parameters_of(item: OnlineSet | None) -> list[tuple[str, float]]:
    """Names and values: number, state, reference of the set; the nominal parameters and their deviations."""
    if item is None:
        return [("QI_SEQ", 0.0)]
    high, low = divmod(item.sequence, 1 << 24)  # a float holds 24 bits
    out = [("QI_SEQ", float(low)), ("QI_SEQ_HI", float(high)), ("QI_MASS", item.mass)]
    out += [("QI_STALE", float(item.state.value == "stale")), ("QI_OLD", float(bool(item.outdated)))]
    out += [("QI_REF", REFERENCES[item.reference])]
    for p in item.parameters:
        if p.name in PARAMETERS:
            out += [(PARAMETERS[p.name], p.value), (f"{PARAMETERS[p.name]}_SD", p.sigma)]
    return out
