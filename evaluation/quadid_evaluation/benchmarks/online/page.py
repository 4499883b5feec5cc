"""The measured figures as a page for people."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from quadid_node.service import ROUND_SECONDS, STEP_SECONDS, WORK_SECONDS

from quadid.online.stream import SETTLE
from quadid.parameters import NOMINAL_NAMES

Result = Mapping[str, Any]


def page(results: Mapping[str, Any]) -> str:
    """Markdown of all parts that were measured."""
    out = [
        "# The online service", "",
        "`python -m quadid_evaluation.benchmarks.online --out docs/results`; every value is in `online.json`. "
        "Window 10 s, a refit every "
        "second, grid 50 Hz, Pelican.", "",
    ]  # fmt: skip
    for name, (title, write) in PARTS.items():
        found = results.get(name)
        out += [f"## {title}", ""]
        if found is None:
            out += ["Not measured.", ""]
            continue
        out += [*write(found["result"]), "", f"_{found['measured']}, load {found['machine'].rpartition(' ')[2]}_", ""]
    return "\n".join(out)


def _estimate(r: Result) -> list[str]:
    flights = r["flights"]
    first = [f["first_set_at"] for f in flights if f["first_set_at"] is not None]
    lines = [
        f"{len(flights)} excited flights of {r['seconds']:.0f} s. First set published after {_median(first):.0f} s "
        f"(median; {len(first)} of {len(flights)} flights published). Goal: within 1 % of the offline batch.", "",
        "| parameter | online to batch: RMS, worst [%] | within 1 % | RMS error [%]: online, batch | sigma [%] |",
        "|---|---|---|---|---|",
    ]  # fmt: skip
    for n in NOMINAL_NAMES:
        batch = _column(flights, "to_batch", n)
        lines.append(
            f"| {n} | {_rms(batch):.3f}, {np.abs(batch).max():.3f} | {np.sum(np.abs(batch) <= 1.0)} of {len(batch)} | "
            f"{_rms(_column(flights, 'to_truth', n)):.3f}, {_rms(_column(flights, 'batch_to_truth', n)):.3f} | "
            f"{np.median(_column(flights, 'sigma', n)):.3f} |"
        )
    return lines


def _column(flights: list[Result], what: str, name: str) -> np.ndarray[Any, np.dtype[np.float64]]:
    return 100.0 * np.array([f[what][name] for f in flights])


def _change(r: Result) -> list[str]:
    flights = r["flights"]
    after = [f["after"] for f in flights if f["after"] is not None]
    sized = [f for f in flights if f["size"] is not None]
    error = np.array([abs(f["size"] / f["fraction"] - 1.0) for f in sized]) * 100.0
    named = sum(f["said"][:1] == ["mass_change"] for f in flights)
    return [
        f"Mass +15 % or −15 % at {r['at']} s of {len(flights)} excited flights. Named `mass_change` within 5 s with "
        f"its size within 10 %: **{r['hits']} of {len(flights)}**. Named at all: {named}. Reported after "
        f"{_median(after):.2f} s (median), {max(after, default=float('nan')):.2f} s (latest); size off by "
        f"{np.median(error):.2f} % (median), {error.max():.2f} % (worst).",
    ]  # fmt: skip


def _hover(r: Result) -> list[str]:
    total = {key: sum(f[key] for f in r["flights"]) for key in ("published", "candidates", "diagnoses")}
    phases = ", ".join(dict.fromkeys(f["phase"] for f in r["flights"]))
    lines = [
        f"{len(r['flights'])} hovers of {r['flights'][0]['seconds']:.0f} s: {total['published']} sets published, "
        f"{total['candidates']} estimates, {total['diagnoses']} diagnoses; at the end: {phases}."
    ]
    after = r["after_flight"]
    same = "the same to the bit" if after["same_bits"] else "**changed**"
    lines += [f"60 s excited, then {after['seconds']:.0f} s of hover: {after['published']} sets published in the "
              f"hover, the set in force is {same}."]  # fmt: skip
    return lines


def _repeat(r: Result) -> list[str]:
    same = "all the same to the bit" if r["same_bits"] else "**they differ**"
    return [
        f"{r['seconds']:.0f} s, samples out of order and up to 0.3 s late; fits in a process, then inline: "
        f"{r['estimates']} estimates, {same}. Over DDS: `tests/node/test_ros_node.py`.",
    ]  # fmt: skip


def _refit(r: Result) -> list[str]:
    cpu, wall = r["cpu_ms"], r["wall_ms"]
    return [
        f"{r['refits']} warm refits of a 10 s window: processor time p50 {cpu['p50']:.0f} ms, p99 {cpu['p99']:.0f} ms; "
        f"wall time worst {wall['max']:.0f} ms. First fit with global search: {r['first_ms'][0]:.0f} ms. Goal: 250 ms.",
    ]  # fmt: skip


def _load(r: Result) -> list[str]:
    lines = [
        "IMU 1 kHz, attitude and rotor speeds 250 Hz, references and odometry 50 Hz, from another process. Every "
        f"{1e3 * ROUND_SECONDS:g} ms waiting messages are processed in steps {1e3 * STEP_SECONDS:g} ms apart, which "
        f"block services and timers; no piece of work begins after {1e3 * WORK_SECONDS:.1f} ms. The grid waits "
        f"{1e3 * SETTLE:.0f} ms for the slowest channel. Goals: under 15 % of a core, steps below 5 ms (p99).", "",
        "| run | % of a core: node, fits | IMU received % | wait of a message p50, p99 [ms] | a step p50, p99 [ms] "
        "| memory MiB |",
        "|---|---|---|---|---|---|",
    ]  # fmt: skip
    for name, x in r.items():
        lines.append(
            f"| {name} | {100 * x['cpu_node']:.1f}, {100 * x['cpu_worker']:.1f} | {100 * x['imu_received']:.2f} | "
            f"{_pair(x['fitting'])} | {_pair(x['step'])} | {x['memory_begin']:.0f} → {x['memory_end']:.0f} |"
        )
    return lines


def _pair(x: Result) -> str:
    return f"{x['p50']:.2f}, {x['p99']:.2f}" if x["count"] else "–"


def _rms(x: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _median(x: list[float]) -> float:
    return float(np.median(x)) if x else float("nan")


PARTS: dict[str, tuple[str, Callable[[Result], list[str]]]] = {
    "estimate": ("Sixty seconds of excited flight against the offline batch", _estimate),
    "change": ("Mass changed by 15 % in flight", _change),
    "hover": ("Ten minutes of hover", _hover),
    "repeat": ("Live and replayed", _repeat),
    "refit": ("Refit of a 10 s window", _refit),
    "load": ("Load", _load),
}
"""Parts in the order of the page; memory over many hours is what the soak shows."""
