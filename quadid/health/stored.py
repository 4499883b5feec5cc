"""Trims of flights as plain data, for whoever keeps them."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from quadid.health.trim_estimation import AXES, FlightTrim
from quadid.jsonable import jsonable


def flight_to_dict(flight: FlightTrim) -> dict[str, Any]:
    """A flight's trim as plain data."""
    data: dict[str, Any] = jsonable(flight._asdict())
    return data


def flight_from_dict(data: Mapping[str, Any]) -> FlightTrim:
    """The trim of such data; raises ValueError, KeyError or TypeError for what is none."""
    mean, parts, shares, wander = (np.array(data[k], dtype=np.float64) for k in ("mean", "parts", "shares", "wander"))
    if mean.shape != (len(AXES),) or parts.ndim != 2 or parts.shape[1] != len(AXES) or wander.shape != mean.shape:
        raise ValueError(f"a trim of shape {mean.shape}, parts {parts.shape}")
    if shares.ndim != 1 or not all(np.isfinite(v).all() for v in (mean, parts, shares, wander)):
        raise ValueError("numbers that are not finite")
    seconds = float(data["seconds"])
    return FlightTrim(str(data["name"]), mean, parts, shares, wander, seconds, str(data["channels"]))
