"""Chaos as a page for people."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from studies.chaos.faults import FAULTS


def page(
    command: str, minutes: float, entries: list[dict[str, Any]], crashes: list[str], wrong: list[str], sets: int
) -> str:  # fmt: skip
    """Markdown: totals, then recovery by fault."""
    lines = [
        "# Chaos: random faults at the running service", "",
        f"`{command}` (`make chaos`), {time.strftime('%Y-%m-%d')}: `quadid serve` with its fit process, history and "
        f"a signing key, a signed vehicle flying over MAVLink in real time; {len(entries)} faults in {minutes:.0f} min "
        f"on {os.cpu_count()} cores, load average {np.mean([e['load'] for e in entries] or [0]):.0f} (mean).", "",
        f"* Crashes, unasked ends, tracebacks, no recovery: **{len(crashes)}**",
        "* Wrong publications (b, J_xx or J_yy more than 5 % off the truth, in no history, or under another set's "
        f"number): **{len(wrong)}**, "
        f"among {sets} sets on the wire", "",
        "Recovery: from the end of the fault to the next estimate in the history; a window of 5 s has to be flown "
        "first.", "",
        "| row | fault | times | recovery s: median | longest | what was done (last) |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, (row, _) in FAULTS.items():
        found = [e for e in entries if e["name"] == name]
        times = [e["recovered"] for e in found if e["recovered"] is not None]
        if not found:
            lines.append(f"| {row} | {name} | 0 | – | – | not drawn in this time |")
        elif times:
            lines.append(
                f"| {row} | {name} | {len(found)} | {np.median(times):.1f} | {max(times):.1f} | {found[-1]['did']} |"
            )
        else:
            lines.append(f"| {row} | {name} | {len(found)} | **none** | **none** | {found[-1]['did']} |")
    for title, items in (("Crashes", crashes), ("Wrong", wrong)):
        if items:
            lines += ["", f"{title}:", *(f"* {item}" for item in items)]
    return "\n".join(lines) + "\n"
