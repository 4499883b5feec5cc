"""The page of the study."""

from __future__ import annotations

import os
import time
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
        f"`make poisoning` (`python -m quadid_evaluation.studies.poisoning`), {time.strftime('%Y-%m-%d')}, "
        f"flight of seed {seed}, "
        f"{os.cpu_count()} cores: a simulated Pelican with one channel multiplied by a factor, at once or over a ramp, "
        "or with other faults from take-off, and an online session with default settings but a fit every 2 s.", "",
        f"* Cases with no published error of b, J_xx or J_yy above {GOAL:.0%}: **{held} of {len(done)}** flown "
        f"({len(cells)} in all); largest error: **{max(worst, default=0.0):.1%}**. In {sum(w > 0.0 for w in worst)} "
        "something was accepted.",
        f"* Without poison: {len(healthy)} sets in the first 60 s, the first after {first[0]:.0f} s of flight.", "",
        "Largest error [%] of b, J_xx and J_yy among sets accepted after the poison began, over all factors; `–`: none "
        "was accepted. Channels without an accepted set are left out; `poisoning.json` has every case.", "",
    ]  # fmt: skip
    titles = {
        "in flight": "Poison after 60 s, with a set in force; the vehicle file has bare guesses",
        "from take-off": "Poison from take-off; the history has a set of a healthy flight",
        "first flight": "Faults from take-off of a first flight: nothing to compare with; alone, in pairs and triples",
    }
    for when, title in titles.items():
        asked, flown = ([c for c in part if c["when"] == when] for part in (cells, done))
        days = sorted({d.get("flown", "2026-11-24") for d in flown})
        told = f"{len(flown)} of {len(asked)} cases flown, {' to '.join(dict.fromkeys(days[:1] + days[-1:]))}."
        lines += [f"## {title}", "", told, "", *_table(asked, done), ""]
    return "\n".join(lines) + "\n"


def _table(cells: list[Cell], done: list[Cell]) -> list[str]:
    ramps = sorted({c["ramp"] for c in cells})
    lines = ["| channel | " + " | ".join(f"{r:g} s" if r else "at once" for r in ramps) + " |"]
    lines += ["|---|" + "---|" * len(ramps)]
    for channel in sorted({c["channel"] for c in cells}):
        key = (cells[0]["when"], channel)
        found = [[d for d in done if (d["when"], d["channel"]) == key and d["ramp"] == r] for r in ramps]
        entries = [_entry(part) for part in found]
        if set(entries) - {"", "–"}:
            lines.append(f"| {channel} | " + " | ".join(entries) + " |")
    return lines


def _entry(flown: list[Cell]) -> str:
    """Largest error of the cases of one channel and ramp."""
    errors = [abs(v) for d in flown for v in d["worst"].values() if v is not None]
    if not errors:
        return "–" if flown else ""
    return f"**{100.0 * max(errors):.1f}**" if max(errors) > GOAL else f"{100.0 * max(errors):.1f}"
