"""The soak as a page for people."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from quadid_node.store import KEPT

from studies.soak.accelerated import FLIGHT, GROUND, slope

Result = Mapping[str, Any]


def page(results: Result) -> str:
    """Markdown of the parts that were measured."""
    out = [
        "# Soak: memory, files, latency and lost samples over many hours", "",
        "`make soak`, or `python -m studies.soak --only accelerated|live`. The accelerated part drives session, fits, "
        "diagnoses and history in one process; the part in real time is the node over DDS with its fit process.", "",
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
        f"{GROUND:.0f} s of silence, and again; a fit every {r['refit']:.0f} s, a diagnosis every "
        f"{r['diagnose']:.0f} s ({last['fits']} in all), {last['published']} sets published. The history keeps the "
        f"newest {r['kept']} candidates and events here, so that its limit is reached (in service "
        f"{KEPT['candidates']} and {KEPT['events']}).", "",
        f"Samples sent {last['sent']:,}, taken {last['taken']:,}, dropped {last['dropped']:,}: "
        f"**{last['sent'] - last['taken'] - last['dropped']} lost without a word**. Slopes over the last three "
        f"quarters: memory {slope(points, 'memory_mib'):+.3f} MiB/h, files {slope(points, 'files_mib'):+.3f} MiB/h, "
        f"processor time {slope(points, 'us_a_sample'):+.3f} us a sample per hour.", "",
        "| flight h | memory MiB | history MiB | us a sample |",
        "|---|---|---|---|",
    ]  # fmt: skip
    chosen = points[:: -max(len(points) // 3, 1)][::-1]
    lines += [
        f"| {p['hours']:.1f} | {p['memory_mib']:.1f} | {p['files_mib']:.1f} | {p['us_a_sample']:.1f} |" for p in chosen
    ]  # fmt: skip
    return lines


def _live(r: Result) -> list[str]:
    points, minutes = r["points"], r["minutes"]
    taken, sent = minutes[-1]["messages"], r["sent"]
    lost = {t: n - taken.get(t, 0) for t, n in sent.items()}
    p99 = np.array([m["p99"] for m in minutes if m["p99"] is not None])
    third = max(len(p99) // 3, 1)
    lines = [
        f"**{points[-1]['hours'] * 60:.0f} min**; IMU 100 Hz, everything else 100 Hz, a fit every second, a diagnosis "
        f"every minute: {minutes[-1]['fits']} fits, set {minutes[-1]['in_force']} in force at the end, exit code "
        f"{r['exit_code']}, {len(r['problems'])} warnings or errors said.", "",
        f"Messages sent {sum(sent.values()):,}, taken {sum(taken.values()):,}; "
        f"**lost: {', '.join(f'{t} {n}' for t, n in lost.items() if n) or 'none'}**; samples dropped by the session: "
        f"{minutes[-1]['dropped'] or 'none'}. Slopes over the last three quarters: memory "
        f"{slope(points, 'memory_mib'):+.2f} MiB/h, fit process {slope(points, 'worker_mib'):+.2f} MiB/h, files "
        f"{slope(points, 'files_mib'):+.2f} MiB/h. IMU latency p99, median of the minutes: first third "
        f"{np.median(p99[:third]):.1f} ms, last third {np.median(p99[-third:]):.1f} ms (other programs share the "
        f"machine).", "",
        "| min | memory MiB | fit process MiB | history and log MiB | handles | load average |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    every = max(len(points) // 3, 1)
    lines += [
        f"| {60 * p['hours']:.0f} | {p['memory_mib']:.1f} | {p['worker_mib']:.1f} | {p['files_mib']:.2f} | "
        f"{p['handles']:.0f} | {p['load']:.1f} |" for p in points[::-every][::-1]
    ]  # fmt: skip
    if r["problems"]:
        lines += ["", "Said: " + "; ".join(f"`{p[:160]}`" for p in r["problems"][:8])]
    return lines
