"""Tables of the report of a fleet: a row a thing, folded where they are long, so that a phone shows them too."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from quadid.types import Json, JsonDict
from quadid_report.page import number
from quadid_report.page import unit as unit_text
from quadid_report.parts import rows_of, section
from quadid_report.verdict import percent

MOST_ROWS = 200
"""Rows of one section; the database has all."""
FOLDED = 8
"""Tables of more rows are folded."""


def summary_sections(summary: Json) -> list[JsonDict | None]:
    """What `quadid_report.fleet_summary.summarise` found, a section a kind; None for kinds without a row."""
    return [_units(summary), _drifts(summary), _outliers(summary), _common(summary), _unusable(summary)]


def date(seconds: float) -> str:
    """A time [s since 1970] as ``2026-11-25 15:05:00``."""
    return str(np.datetime_as_string(np.datetime64(round(seconds), "s"))).replace("T", " ")


def _section(
    identifier: str, title: str, head: Sequence[str], rows: Sequence[Sequence[str]], intro: str = ""
) -> JsonDict | None:  # fmt: skip
    if not rows:
        return None
    fold = f"All {len(rows)}" if len(rows) > FOLDED else ""
    return section(
        identifier, title, intro + _left_out(rows), tables=[rows_of(head, rows[:MOST_ROWS], fold, "compact")]
    )


def _left_out(rows: Sequence[Any]) -> str:
    return f" The first {MOST_ROWS} of {len(rows)}; the database has all." if len(rows) > MOST_ROWS else ""


def _units(summary: Json) -> JsonDict | None:
    """Parameters of every vehicle; the first is open."""
    head = ("Parameter", "Median", "Unit", "Spread", "Flights")
    tables: list[JsonDict] = []
    for unit in summary["units"][:MOST_ROWS]:
        rows = [
            (p["parameter"], number(p["median"]), unit_text(p["unit"]), percent(p["spread"]), str(p["flights"]))
            for p in unit["parameters"]
        ]
        if rows:
            title = f"{unit['unit']}: {unit['done']} of {unit['logs']} logs gave an answer"
            tables.append({**rows_of(head, rows, title, "compact"), "open": not tables})
    intro = f"Spread between flights: robust standard deviation over the median.{_left_out(summary['units'])}"
    return section("vehicles", "Vehicles", intro, tables=tables) if tables else None


def _drifts(summary: Json) -> JsonDict | None:
    rows = [
        (d["unit"], d["parameter"], f"{100 * d['change']:+.2g} % in {d['days']:.3g} days".replace("-", "−"),
         f"{number(100 * d['ci95'][0], 2)} … {number(100 * d['ci95'][1], 2)} % a day", number(d["p_value"], 2),
         str(d["flights"]))
        for d in summary["drifts"]
    ]  # fmt: skip
    head = ("Vehicle", "Parameter", "Change", "Rate, 95 % interval", "Chance without drift", "Flights")
    intro = "Kendall's rank test, corrected for the number of tests; slope after Theil and Sen."
    return _section("drift", "Drift", head, rows, intro)


def _outliers(summary: Json) -> JsonDict | None:
    rows = [
        (o["log"], o["parameter"], f"{number(o['value'])} {unit_text(o['unit_of_value'])}", number(o["median"]),
         number(o["deviations"], 2))
        for o in summary["outliers"]
    ]  # fmt: skip
    head = ("Log", "Parameter", "Value", "Median of the vehicle", "Deviations")
    return _section("outliers", "Outliers", head, rows, "In robust standard deviations of the vehicle.")


def _common(summary: Json) -> JsonDict | None:
    rows = [
        (c["unit"], c["effect"].replace("_", " "), f"{c['flights']} of {c['of']}",
         f"{c['parameter']} = {number(c['median'])} {c['unit_of_value']}".rstrip(),
         f"{number(c['lowest'])} … {number(c['highest'])}")
        for c in summary["common"]
    ]  # fmt: skip
    head = ("Vehicle", "Finding", "Flights", "Median", "Range")
    return _section("common", "What the simulation gets wrong, flight after flight", head, rows)


def _unusable(summary: Json) -> JsonDict | None:
    rows = [
        (r["status"], r["reason"], str(r["logs"]), ", ".join(r["names"][:5]) + (" …" if r["logs"] > 5 else ""))
        for r in summary["reasons"]
    ]
    return _section("unusable", "Logs without an answer", ("Outcome", "Reason", "Logs", "Which"), rows)


def every_log(logs: Sequence[Json]) -> JsonDict:
    """Every log with its error and where its date comes from, folded by vehicle, the worst error first."""
    worst = sorted(logs, key=lambda log: -(log["mse_fitted"] if log["mse_fitted"] is not None else math.inf))
    head, errors = ("Log", "Outcome", "Error", "Date"), ("mse_initial", "mse_fitted")
    tables = []
    for unit, some in groupby(sorted(worst[:MOST_ROWS], key=lambda log: str(log["unit"])), key=lambda log: log["unit"]):
        rows = [
            (
                log["name"], log["status"],
                " → ".join(number(log[key], 3) for key in errors) if log[errors[-1]] is not None else "–",
                f"{date(log['started'])[:-3]} ({log['dated_by']})",
            )
            for log in some
        ]  # fmt: skip
        tables.append(rows_of(head, rows, f"{unit}: {len(rows)} log{'s' * (len(rows) != 1)}", "compact"))
    intro = (
        "Error over one second of simulation, before and after, in noise variances: 1 is the noise floor. The worst "
        "come first. Dates are those of the clock in the log or of its file."
    )
    return section("logs", "Every log", intro + _left_out(logs), tables=tables)
