"""Two vehicle files beside each other for people: verdict, tables and one page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from quadid.report.figures import axis, figure, level, section, trace
from quadid.report.tables import Column, TextTable, number
from quadid.report.verdict import Verdict, percent
from quadid.types import Json


def compare_verdict(result: Json) -> Verdict:
    """Which predicts better, and by how much."""
    low, high = result["ci95"]
    span = f"Ratio of errors B / A {number(result['ratio'], 3)}, 95 % {number(low, 3)} to {number(high, 3)}"
    names = {"a": f"A ({result['a']})", "b": f"B ({result['b']})"}
    where = f"over all quantities after {result['after']} samples"
    if result["better"] == "neither":
        return Verdict("fair", "Neither file predicts better on these flights", (f"{span}, {where}.",), ())
    better, worse = (names[k] for k in (("b", "a") if result["better"] == "b" else ("a", "b")))
    share = abs(1.0 - (result["ratio"] if result["better"] == "b" else 1.0 / result["ratio"]))
    return Verdict("good", f"{better} predicts better than {worse}, by {percent(share)}", (f"{span}, {where}.",), ())


def compare_tables(result: Json) -> list[TextTable]:
    """Errors, parameters and effects."""
    columns = (
        Column("after", right=True), Column("quantity"), Column("A", right=True), Column("B", right=True),
        Column("B / A", right=True), Column("95 % interval", right=True, rank=1),
    )  # fmt: skip
    rows = []
    for after, errors in result["horizons"].items():
        for name, e in errors.items():
            low, high = (number(v, 3) for v in e["ci95"])
            label = f"{name} [{result['units'][name]}]"
            rows.append((after, label, number(e["a"]), number(e["b"]), number(e["ratio"], 3), f"{low} .. {high}"))
    title = (
        f"Mean open-loop error of A ({result['a']}) and B ({result['b']}) after n samples, {result['samples']} runs in "
        f"{result['blocks']} blocks"
    )
    return [TextTable(title, columns, tuple(rows)), _parameter_table(result), *_effect_tables(result)]


def _parameter_table(result: Json) -> TextTable:
    columns = (
        Column("parameter"), Column("A", right=True), Column("A, 95 %", right=True, rank=2), Column("B", right=True),
        Column("B, 95 %", right=True, rank=2), Column("apart [sigma]", right=True), Column("unit", rank=1),
    )  # fmt: skip
    rows = []
    for p in result["parameters"]:
        ends = [" .. ".join(number(v) for v in p[k]) if p[k] else "a guess" for k in ("a_ci95", "b_ci95")]
        apart = number(p["apart"], 2)
        rows.append((p["name"], number(p["a"]), ends[0], number(p["b"]), ends[1], apart, p["unit"]))
    return TextTable("Parameters side by side", columns, tuple(rows))


def _effect_tables(result: Json) -> list[TextTable]:
    columns = (Column("effect"), Column("number"), Column("A", right=True), Column("B", right=True))
    rows = [(e["effect"], e["name"], number(e["a"]), number(e["b"])) for e in result["effects"]]
    return [TextTable("Effects side by side", columns, tuple(rows))] if rows else []


def compare_page(result: Json, provenance: Sequence[Json]) -> dict[str, Any]:
    """Builds the page; `result` of the form ``quadid.compare_vehicles/1``, `provenance` rows of name and value."""
    errors, *rest = compare_tables(result)
    after = np.array([float(h) for h in result["horizons"]])
    data = []
    for role, name in zip(("measured", "before", "after", "truth"), result["units"], strict=True):
        found = [result["horizons"][h][name] for h in result["horizons"]]
        for key, edge in (("ratio", ""), (0, ", 95 %"), (1, ", 95 %")):
            values = [e["ratio"] if key == "ratio" else e["ci95"][key] for e in found]
            y = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
            if np.isfinite(y).any():
                more = {"line": {"dash": "dot"}, "showlegend": False} if edge else {"mode": "lines+markers"}
                data.append(trace(role, name + edge, after, y, **more))
    layout = {
        "xaxis": axis("samples after the start"),
        "yaxis": axis("error of B over that of A"),
        "shapes": [level(1.0)],
    }
    caption = "below 1: B predicts better; dotted: 95 % interval"
    ratios = figure("ratios", "Errors of B over those of A", data, layout, 320, caption=caption)
    return {
        "title": f"{result['a']} and {result['b']} on the same flights",
        "subtitle": ", ".join(result["logs"]),
        "verdict": asdict(compare_verdict(result)),
        "sections": [
            section("errors", "Errors", errors.title, [ratios], [errors.part()]),
            *(section(f"side-{i}", t.title, "", tables=[t.part()]) for i, t in enumerate(rest)),
        ],
        "warnings": result["warnings"],
        "provenance": provenance,
    }  # fmt: skip
