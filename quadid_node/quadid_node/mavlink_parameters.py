"""A parameter set as read-only MAVLink parameters."""

from __future__ import annotations

from quadid.online.records import OnlineSet

PARAMETERS = {"b": "QI_B", "d": "QI_D", "J_xx": "QI_J_XX", "J_yy": "QI_J_YY", "J_zz": "QI_J_ZZ", "J_r": "QI_J_R"}


def parameters_of(item: OnlineSet | None) -> list[tuple[str, float]]:
    """Names and values: number and state of the set, then the nominal parameters and their standard deviations."""
    if item is None:
        return [("QI_SEQ", 0.0)]
    high, low = divmod(item.sequence, 1 << 24)  # a float holds 24 bits
    out = [("QI_SEQ", float(low)), ("QI_SEQ_HI", float(high)), ("QI_MASS", item.mass)]
    out += [("QI_STALE", float(item.state.value == "stale")), ("QI_OLD", float(bool(item.outdated)))]
    for p in item.parameters:
        if p.name in PARAMETERS:
            out += [(PARAMETERS[p.name], p.value), (f"{PARAMETERS[p.name]}_SD", p.sigma)]
    return out
