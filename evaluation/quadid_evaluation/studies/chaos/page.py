"""Chaos as a page for people."""

from __future__ import annotations

import os
import time
from typing import Any

import numpy as np

from quadid_evaluation.studies.chaos.faults import FAULTS


def page(
    command: str, minutes: float, entries: list[dict[str, Any]], crashes: list[str], wrong: list[str], sets: int
) -> str:  # fmt: skip
    """Markdown: totals, then recovery by fault."""
    lines = [
        "# Chaos: random faults at the running service", "",
        f"`{command}` (`make chaos`), {time.strftime('%Y-%m-%d')}: `quadid serve` with history and signing, a signed "
        f"vehicle flying over MAVLink in real time; {len(entries)} faults in {minutes:.0f} min on {os.cpu_count()} "
        f"cores, load average {np.mean([e['load'] for e in entries] or [0]):.0f}.", "",
        f"* Crashes, unexpected ends, tracebacks, no recovery: **{len(crashes)}**",
        "* Wrong publications (b, J_xx or J_yy more than 5 % off, not in the history, or under another set's number): "
        f"**{len(wrong)}** of {sets} sets", "",
        "Recovery: from the end of the fault to the next estimate; a window takes 5 s.", "",
        "| fault (times) | recovery [s]: median, longest |",
        "|---|---|",
    ]  # fmt: skip
    for name in FAULTS:
        found = [e for e in entries if e["name"] == name]
        times = [e["recovered"] for e in found if e["recovered"] is not None]
        if not found:
            lines.append(f"| {name} (0) | – |")
        elif times:
            lines.append(f"| {name} ({len(found)}) | {np.median(times):.1f}, {max(times):.1f} |")
        else:
            lines.append(f"| {name} ({len(found)}) | **none**: {found[-1]['did']} |")
    for title, items in (("Crashes", crashes), ("Wrong", wrong)):
        if items:
            lines += ["", f"{title}:", *(f"* {item}" for item in items)]
    return "\n".join(lines) + "\n"
