"""The account of all fuzzing: which inputs were tried when, with how many findings; kept as JSON, shown as a page."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from quadid_evaluation.studies.judged import judged

from tests.fuzz.formats import FORMATS

GOAL = 1_000_000
"""Inputs of each format that are wanted."""
Run = dict[str, Any]


def load(path: Path) -> dict[str, list[Run]]:
    """Reads the runs by format; none where there is no account yet."""
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def next_input(runs: Sequence[Run]) -> int:
    """The first number that no run has tried."""
    return max((run["stop"] for run in runs), default=0)


def note(runs: list[Run], run: Run) -> None:
    """Adds a run; one that goes on where the last one of the same day and revision stopped is joined to it."""
    last = runs[-1] if runs else None
    if last and (last["stop"], last["date"], last["revision"]) == (run["start"], run["date"], run["revision"]):
        for key in ("read", "refused", "stopped", "findings", "seconds"):
            last[key] = last.get(key, 0) + run.get(key, 0)
        last["stop"] = run["stop"]
    else:
        runs.append(run)


def save(path: Path, book: Mapping[str, Sequence[Run]]) -> None:
    """Writes the account, and beside it the page that shows it, with what people wrote at its end."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(book, indent=1) + "\n", encoding="utf-8")
    shown = path.with_suffix(".md")
    shown.write_text(page(book) + judged(shown), encoding="utf-8")


def page(book: Mapping[str, Sequence[Run]]) -> str:
    """Markdown: counts by format, then every run."""
    lines = [
        "# Fuzzing of the binary readers",
        "",
        "`make fuzz`: small logs are mutated with knowledge of their format and read within 0.5 s of processor time "
        "and 1 GiB. Anything but a recording of finite values and rising times, one line of a documented error, or an "
        "end by limits, as the process that reads logs has them, is a finding; findings become tests "
        f"(`tests/fuzz/test_findings.py`). Runs and notes: `fuzz.json`. Goal: {GOAL:,} inputs per format.",
        "",
        "| format | inputs | read | refused | stopped | findings | inputs/s |",
        "|---|---|---|---|---|---|---|",
    ]
    for kind in FORMATS:
        runs = book.get(kind, [])
        ends = ("read", "refused", "stopped", "findings")
        read, refused, stopped, findings = (sum(int(run.get(k, 0)) for run in runs) for k in ends)
        tried, seconds = sum(run["stop"] - run["start"] for run in runs), sum(run["seconds"] for run in runs)
        rate = f"{tried / seconds:.0f}" if seconds else ""
        lines.append(f"| {kind} | {tried:,} | {read:,} | {refused:,} | {stopped} | {findings} | {rate} |")
    return "\n".join(lines) + "\n"
