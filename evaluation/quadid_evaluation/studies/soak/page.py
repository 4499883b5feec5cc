"""The soak as a page for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from quadid_node.history import KEPT

from quadid_evaluation.studies.soak.accelerated import FLIGHT, GROUND, slope

Result = Mapping[str, Any]


def page(results: Result) -> str:
    """Markdown of the parts that were measured."""
    out = [
        "# Soak", "",
        "`make soak`: session, fits, diagnoses and history in one process at accelerated time; the node over DDS with "
        "its fit process in real time. Points over time are in `soak.json`.", "",
    ]  # fmt: skip
    for name, title, write in (
        ("accelerated", "At accelerated time", _accelerated), ("live", "In real time", _live),
    ):  # fmt: skip
        found = results.get(name)
        out += [f"## {title}", "", *(write(found["result"]) if found else ["Not measured."]), ""]
        if found:
            out += [f"_{found['measured']}, load {found['machine'].partition('load average ')[2]}_", ""]
    return "\n".join(out)


def _accelerated(r: Result) -> list[str]:
    points = r["points"]
    last = points[-1]
    short = (
        ""
        if last["hours"] > 0.99 * r["asked_hours"]
        else f", **stopped before the {r['asked_hours']:.0f} h asked for,**"
    )
    lines = [
        f"**{last['hours']:.1f} h of flight**{short} in {r['wall_seconds'] / 60:.0f} min: {FLIGHT:.0f} s flown, "
        f"{GROUND:.0f} s of silence, and again; {last['fits']} fits, a diagnosis every {r['diagnose']:.0f} s, "
        f"{last['published']} sets published. The history keeps the newest {r['kept']} candidates and events here (in "
        f"service {KEPT['candidates']} and {KEPT['events']}).", "",
        f"Samples sent {last['sent']:,}, taken {last['taken']:,}, dropped {last['dropped']:,}: "
        f"**{last['sent'] - last['taken'] - last['dropped']} lost**. Memory {last['memory_mib']:.0f} MiB at the end. "
        f"Slopes over the last three quarters: memory {slope(points, 'memory_mib'):+.3f} MiB/h, files "
        f"{slope(points, 'files_mib'):+.3f} MiB/h, processor time {slope(points, 'us_a_sample'):+.3f} us a sample per "
        "hour.",
    ]  # fmt: skip
    return lines


def _live(r: Result) -> list[str]:
    points, minutes = r["points"], r["minutes"]
    taken, sent = minutes[-1]["messages"], r["sent"]
    lost = {t: n - taken.get(t, 0) for t, n in sent.items()}
    p99 = np.array([m["p99"] for m in minutes if m["p99"] is not None])
    third = max(len(p99) // 3, 1)
    lines = [
        f"**{points[-1]['hours'] * 60:.0f} min**; all inputs at 100 Hz, a fit every second, a diagnosis every minute: "
        f"{minutes[-1]['fits']} fits, set {minutes[-1]['in_force']} in force at the end, exit code {r['exit_code']}, "
        f"{len(r['problems'])} warnings or errors.", "",
        f"Messages sent {sum(sent.values()):,}, taken {sum(taken.values()):,}; "
        f"**lost: {', '.join(f'{t} {n}' for t, n in lost.items() if n) or 'none'}**; samples dropped by the session: "
        f"{minutes[-1]['dropped'] or 'none'}. Slopes over the last three quarters: memory "
        f"{slope(points, 'memory_mib'):+.2f} MiB/h, fit process {slope(points, 'worker_mib'):+.2f} MiB/h, files "
        f"{slope(points, 'files_mib'):+.2f} MiB/h; handles {points[0]['handles']:.0f} → {points[-1]['handles']:.0f}. "
        f"IMU latency p99: first third {np.median(p99[:third]):.0f} ms, last third {np.median(p99[-third:]):.0f} ms "
        f"(load average {points[0]['load']:.0f} → {points[-1]['load']:.0f}).",
    ]  # fmt: skip
    if r["problems"]:
        lines += ["", "Warnings: " + "; ".join(f"`{p[:160]}`" for p in r["problems"][:8])]
    return lines
