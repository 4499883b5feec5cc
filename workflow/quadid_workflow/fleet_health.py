"""Health of every vehicle of a fleet over its flights: each flight against the vehicle's first ones."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from typing import Any

from quadid.health import FlightTrim, assess
from quadid.health.stored import flight_from_dict
from quadid.vehicle import Vehicle

Row = Mapping[str, Any]

BASELINE = 5
"""The first flights of a vehicle are its baseline, so many where there are more."""
FEWEST = 3
"""Baseline flights that a trend takes at least."""


def health_trend(logs: Sequence[Row], trims: Sequence[Row], vehicles: Mapping[str, str]) -> list[dict[str, Any]]:
    """Compares each flight of a vehicle with its first flights.

    Args:
        logs: rows with name, unit, started [s since 1970].
        trims: rows with log and trim (JSON).
        vehicles: text of the vehicle file by unit.

    Returns:
        A row a flight, in the order of time: unit, log, started, baseline (whether it is part of it), and, for the
        others, score, verdict, baseline_lacking, p_value and changes as in ``quadid.health/1``; none for vehicles with
        too few flights.
    """
    flown = {row["log"]: flight_from_dict(json.loads(row["trim"])) for row in trims}
    by_unit: dict[str, list[Row]] = {}
    for log in sorted(logs, key=lambda row: (float(row["started"]), row["name"])):
        if log["name"] in flown and log["unit"] in vehicles:
            by_unit.setdefault(log["unit"], []).append(log)
    out = []
    for unit, mine in sorted(by_unit.items()):
        count = min(BASELINE, len(mine) - 1)
        if count >= FEWEST:
            out += _trend(Vehicle.from_yaml(vehicles[unit], unit), unit, mine, flown, count)
    return out


def _trend(
    vehicle: Vehicle, unit: str, logs: Sequence[Row], flown: Mapping[str, FlightTrim], count: int
) -> list[dict[str, Any]]:
    baseline = [flown[log["name"]] for log in logs[:count]]
    rows: list[dict[str, Any]] = []
    for k, log in enumerate(logs):
        row = {"unit": unit, "log": log["name"], "started": log["started"], "baseline": k < count}
        if k >= count:
            found = assess([flown[log["name"]]], baseline, vehicle).to_dict()
            row |= {key: found[key] for key in ("score", "verdict", "baseline_lacking", "p_value", "changes")}
        rows.append(row)
    return rows
