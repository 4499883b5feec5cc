"""Proposed gains for people: verdict, tables, and the page with step responses before and after."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from quadid.model.rate_loop import Loops
from quadid.report.figures import axis, figure, section, trace
from quadid.report.tables import Column, TextTable, number
from quadid.report.verdict import Verdict
from quadid.types import Json, JsonDict


def gains_verdict(result: Json) -> Verdict:
    """Promises over the intervals, and their limits."""
    rates = {a["axis"]: a["rate"] for a in result["axes"]}
    least = min(r["phase_margin_least"] for r in rates.values())
    bands = ", ".join(f"{name} {r['bandwidth']:.2g} Hz" for name, r in rates.items())
    limits = ", ".join(f"{a['axis']} by {a['limited_by']} ({a['largest_bandwidth']:.2g} Hz)" for a in result["axes"])
    return Verdict(
        "fair" if result["warnings"] else "good",
        f"Rate loops of {bands}, with at least {least:.0f} degrees of phase margin over the intervals",
        (f"The bandwidth is limited: {limits}.",),
        ("Propellers off: check signs. Then set the gains by hand, rates before attitude, and take off with care.",),
    )


def gains_tables(result: Json) -> list[TextTable]:
    """Gains, loops before and after, and what they rest on."""
    rows = [
        (g["name"], number(g["value"], 4), number(g["current"], 4), f"{g['axis']} {g['term']}") for g in result["gains"]
    ]
    columns = (Column("parameter"), Column("proposed", right=True), Column("now", right=True), Column("what", rank=1))
    title = f"Gains for {result['program']}"
    return [TextTable(title, columns, tuple(rows)), loop_table(result), used_table(result)]


def loop_table(result: Json) -> TextTable:
    """Promises of every loop."""
    columns = (
        Column("loop"), Column("bandwidth [Hz]", right=True), Column("over the intervals", right=True, rank=1),
        Column("phase margin [deg]", right=True), Column("gain margin [dB]", right=True, rank=2),
        Column("overshoot", right=True),
    )  # fmt: skip
    rows = []
    for a in result["axes"]:
        for when, part in (("", a), (", now", a["before"])):
            for loop in ("rate", "attitude"):
                r = part and part[loop]
                if r:
                    top = f"{100.0 * r['overshoot']:.0f} %" if math.isfinite(r["overshoot"]) else "unstable"
                    rows.append((
                        f"{a['axis']} {loop}{when}", number(r["bandwidth"], 3),
                        " .. ".join(number(v, 3) for v in r["bandwidth_range"]),
                        f"{r['phase_margin']:.0f}, least {r['phase_margin_least']:.0f}",
                        f"{r['gain_margin']:.0f}, least {r['gain_margin_least']:.0f}", top,
                    ))  # fmt: skip
    return TextTable("Loops, and the least margins over the 95 % intervals", columns, tuple(rows))


def used_table(result: Json) -> TextTable:
    """What the gains rest on."""
    heads = (("number", False), ("value", True), ("95 % interval", True))
    columns = (*(Column(text, right) for text, right in heads), Column("from", rank=1))
    rows = []
    for u in result["used"]:
        interval = " .. ".join(number(v) for v in u["ci95"])
        rows.append((u["name"], f"{number(u['value'])} {u['unit']}", interval, u["source"]))
    return TextTable("What they rest on", columns, tuple(rows))


def step_figure(name: str, angle: bool, now: Loops, before: Loops | None) -> JsonDict:
    """Response to a unit step with its band over the intervals, before and after."""
    what = "attitude" if angle else "rate"
    data = []
    for role, label, loops in (("before", "now", before), ("after", "proposed", now)):
        if loops is None or not loops.stable or (angle and loops.attitude == 0.0):
            continue
        t, y = loops.step(angle)
        for edge, values in (("", y[0]), (", least", y.min(axis=0)), (", most", y.max(axis=0))):
            dash = {"line": {"dash": "dot"}} if edge else {}
            data.append(trace(role, label + edge, np.asarray(t), np.asarray(values), **dash))
    layout = {"xaxis": axis("time (s)"), "yaxis": axis(f"{name} {what} over what is asked for")}
    caption = "dotted: least and most over the 95 % intervals"
    return figure(f"step-{name}-{what}", f"{name.capitalize()} {what}", data, layout, 260, caption=caption)


def gains_page(result: Json, figures: Sequence[Json], provenance: Sequence[Json]) -> dict[str, Any]:
    """Builds the page.

    Args:
        result: of the form ``quadid.gains/1``.
        figures: of `step_figure`.
        provenance: rows of name and value.
    """
    chosen, loops, used = gains_tables(result)
    taken = [(a["axis"], number(a["at"], 3), *(f"{v:.0f}" for v in a["phase_taken"].values())) for a in result["axes"]]
    columns = (Column("axis"), Column("at [Hz]"), *(Column(name) for name in result["axes"][0]["phase_taken"]))
    phases = TextTable("Phase that each part takes where the fastest loop crosses 0 dB [deg]", columns, tuple(taken))
    return {
        "title": f"Gains for {result['vehicle']}",
        "subtitle": f"{result['program']}, phase margin {result['phase_margin']:g} degrees; nothing was sent",
        "verdict": asdict(gains_verdict(result)),
        "sections": [
            section("gains", "Gains", chosen.title, tables=[chosen.part()]),
            section("loops", "Loops", loops.title, figures, [loops.part()]),
            section("limits", "What limits the bandwidth", phases.title, tables=[phases.part()]),
            section("used", "What they rest on", "", tables=[used.part()]),
        ],
        "warnings": result["warnings"],
        "provenance": provenance,
    }  # fmt: skip
