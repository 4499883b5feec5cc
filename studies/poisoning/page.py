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
        f"{os.cpu_count()} cores: a simulated Pelican with one channel multiplied by a factor that comes at once or "
        "grows over a ramp, heard by an online session with default settings but a fit every 2 s. The numbers are the "
        "largest errors of b / J_xx / J_yy among all sets accepted after the poison had begun; `–`: none was accepted.",
        "", f"* Cells with no published error above {GOAL:.0%}: **{held} of {len(done)}** flown "
        f"({len(cells)} in all); largest error: **{max(worst, default=0.0):.1%}**",
        f"* Without poison: {len(healthy)} sets in the first 60 s, the first after {first[0]:.0f} s of flight.", "",
    ]  # fmt: skip
    titles = {
        "in flight": "The poison begins after 60 s, with a set in force; the vehicle file holds bare guesses",
        "from take-off": "The poison begins at take-off; the history holds a set of a healthy flight",
    }
    for when, title in titles.items():
        lines += [f"## {title}", "", *_table([c for c in cells if c["when"] == when], done), ""]
    said = Counter(re.sub(r"\d+", "…", d["says"].split(":")[0]) for d in done)
    lines += ["## What the sessions said in the end", "", "| check or phase | cells |", "|---|---|"]
    lines += [f"| {name} | {count} |" for name, count in said.most_common()]
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
        if any(entries):  # rows of which nothing was flown yet are left out
            lines.append(f"| {channel} | {ramp:g} | " + " | ".join(entries) + " |")
    return lines


def _entry(cell: Cell | None) -> str:
    if cell is None:
        return ""
    values = list(cell["worst"].values())
    if None in values:
        return "–"
    text = " / ".join(f"{100.0 * v:+.1f}" for v in values)
    return f"**{text}**" if max(map(abs, values)) > GOAL else text
