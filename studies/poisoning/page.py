"""The page of the study."""

from __future__ import annotations

import os
import re
import time
from collections import Counter
from typing import Any

GOAL = 0.05
Cell = dict[str, Any]


def page(cells: list[Cell], done: list[Cell], healthy: list[tuple[float, dict[str, float]]], seed: int) -> str:
    """Markdown: what was asked, both tables, what the sessions said."""
    worst = [max((abs(v) for v in d["worst"].values() if v is not None), default=0.0) for d in done]
    held = sum(w <= GOAL for w in worst)
    first = healthy[0] if healthy else (float("nan"), {})
    lines = [
        "# Poisoned sensors", "",
        f"`make poisoning` (`python -m studies.poisoning`), {time.strftime('%Y-%m-%d')}, flight of seed {seed}, "
        f"{os.cpu_count()} cores: a simulated Pelican with one channel multiplied by a factor, at once or over a ramp, "
        "and an online session with default settings but a fit every 2 s.", "",
        f"* Cases with no published error of b, J_xx or J_yy above {GOAL:.0%}: **{held} of {len(done)}** flown "
        f"({len(cells)} in all); largest error: **{max(worst, default=0.0):.1%}**.",
        f"* Without poison: {len(healthy)} sets in the first 60 s, the first after {first[0]:.0f} s of flight.", "",
        "The tables show the largest error [%] of b, J_xx and J_yy among sets accepted after the poison began; `–`: "
        "none was accepted. Rows in which nothing was accepted are left out; every case is in `poisoning.json`.", "",
    ]  # fmt: skip
    titles = {
        "in flight": "Poison after 60 s, with a set in force; the vehicle file has bare guesses",
        "from take-off": "Poison from take-off; the history has a set of a healthy flight",
    }
    for when, title in titles.items():
        lines += [f"## {title}", "", *_table([c for c in cells if c["when"] == when], done), ""]
    said = Counter(re.sub(r"\d+", "…", d["says"].split(":")[0]) for d in done)
    lines += [
        "## State of the sessions at the end",
        "",
        ", ".join(f"{name} {count}" for name, count in said.most_common()),
    ]
    return "\n".join(lines) + "\n"


def _table(cells: list[Cell], done: list[Cell]) -> list[str]:
    factors = sorted({c["factor"] for c in cells})
    found = {(d["when"], d["channel"], d["factor"], d["ramp"]): d for d in done}
    lines = [
        "| channel | ramp s | " + " | ".join(f"× {f:g}" for f in factors) + " |",
        "|---|---|" + "---|" * len(factors),
    ]
    rows = dict.fromkeys((c["channel"], c["ramp"]) for c in sorted(cells, key=lambda c: c["channel"]))
    for channel, ramp in rows:
        entries = [_entry(found.get((cells[0]["when"], channel, f, ramp))) for f in factors]
        if any(entry not in ("", "–") for entry in entries):
            lines.append(f"| {channel} | {ramp:g} | " + " | ".join(entries) + " |")
    return lines


def _entry(cell: Cell | None) -> str:
    if cell is None:
        return ""
    values = list(cell["worst"].values())
    if None in values:
        return "–"
    worst = max(map(abs, values))
    return f"**{100.0 * worst:.1f}**" if worst > GOAL else f"{100.0 * worst:.1f}"
