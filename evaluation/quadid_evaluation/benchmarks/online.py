"""The online service: accuracy, changes, silence in hover, repeatability, load.

    python -m quadid_evaluation.benchmarks.online --out docs/results
    python -m quadid_evaluation.benchmarks.online --parts load --out docs/results

A part that is measured alone leaves the others as they are; `load` needs the ROS extra; `speed` times a refit.  Every
number stands in `online.json`.
"""

import json
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from quadid_node.recording import stream
from quadid_node.service import Service
from quadid_node.worker import InlineWorker, ProcessWorker

from quadid.data.window import Block
from quadid.flight import Flight, fly
from quadid.identification.fit import FitOptions, fit
from quadid.online import Job, JobReply, OnlineDiagnosis, Publish, Session, SessionSettings
from quadid.online.records import Action
from quadid.online.stream import SETTLE
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks import ros_flight
from quadid_evaluation.harness import Given, machine, options, table

Work = Callable[[Job], JobReply]


def drive(session: Session, blocks: Iterable[Block], work: Work = Job.run) -> Iterator[Action]:
    """Pushes blocks one by one, does every job at once, and yields what the session says."""
    for block in blocks:
        session.push(block)
        yield from session.poll()
        while session.running is not None:
            session.deliver(work(session.running))
            yield from session.poll()


PELICAN = Vehicle.shipped("pelican")
SECONDS = 60.0
CHANGE = 0.15
CHANGE_AT = 33.3
FOUND_WITHIN, SIZE_WITHIN = 5.0, 0.10


def flown(seconds: float, seed: int, profile: str = "excited", **effects: dict[str, float]) -> Flight:
    """A Pelican flight."""
    return fly(PELICAN, seconds=seconds, seed=seed, profile=profile, effects=effects)


def published(actions: Iterable[Action], topic: str = "parameters") -> list[Any]:
    """Sets on a topic."""
    return [a.item for a in actions if isinstance(a, Publish) and a.topic == topic]


def against_batch(seeds: range) -> dict[str, Any]:
    """The last estimate of 60 s against `quadid.identify` on the same 60 s, and both against the truth."""
    rows = []
    for seed in seeds:
        flight = flown(SECONDS + 1.0, seed)
        actions = list(drive(Session(PELICAN), stream(flight.recording)))
        sets, last, truth = published(actions), published(actions, "candidate")[-1], flight.truth.parameters.as_dict()
        batch = fit([flight.window.slice(0, round(SECONDS * 50))], PELICAN, FitOptions()).parameters
        ours, theirs = ({n: p[n].value for n in NOMINAL_NAMES} for p in (last.parameters, batch))
        pairs = {"to_batch": (ours, theirs), "to_truth": (ours, truth), "batch_to_truth": (theirs, truth)}
        row = {"seed": seed, "first_set_at": sets[0].stop if sets else None, "sets": len(sets)}
        row |= {name: {n: a[n] / b[n] - 1.0 for n in NOMINAL_NAMES} for name, (a, b) in pairs.items()}
        rows.append(row | {"sigma": {n: last.told_by_flight(n) / ours[n] for n in NOMINAL_NAMES}})
    return {"seconds": SECONDS, "flights": rows}


def mass_changes(seeds: range) -> dict[str, Any]:
    """Mass up or down by 15 % in flight: when it is known, and what it is said to be.

    A hit is `mass_change`, named first, within 5 s, with its size within 10 %.
    """
    rows, hits = [], 0
    for seed in seeds:
        fraction = CHANGE if seed % 2 == 0 else -CHANGE
        flight = flown(CHANGE_AT + 8.0, seed, mass_change={"time": CHANGE_AT, "fraction": fraction})
        actions = drive(Session(PELICAN), stream(flight.recording))
        found = [a for a in actions if isinstance(a, OnlineDiagnosis)]
        first = found[0].findings[0] if found and found[0].findings else None
        said = [f.effect for d in found for f in d.findings]
        after = found[0].t - CHANGE_AT if found else None
        size, confident = (None, None) if first is None else (first.values.get("fraction"), first.confident)
        if said[:1] == ["mass_change"] and size is not None and after is not None:
            hits += after <= FOUND_WITHIN and abs(size / fraction - 1.0) <= SIZE_WITHIN
        row = {"seed": seed, "fraction": fraction, "said": said, "after": after}
        rows.append(row | {"size": size, "confident": confident})
    return {"at": CHANGE_AT, "flights": rows, "hits": hits}


def hover(seconds: float, seeds: range) -> dict[str, Any]:
    """Ten minutes of hover: what is published; and whether a set in force before one stays as it is, to the bit."""
    rows = []
    for seed in seeds:
        session = Session(PELICAN)
        actions = list(drive(session, stream(flown(seconds, seed, "hover").recording)))
        row: dict[str, Any] = {"seed": seed, "seconds": seconds, "published": len(published(actions))}
        row |= {"candidates": len(published(actions, "candidate")), "phase": session.status().phase.value}
        rows.append(row | {"diagnoses": sum(isinstance(a, OnlineDiagnosis) for a in actions)})
    first, quiet = flown(SECONDS, seeds[-1] + 1), flown(seconds, seeds[-1] + 1, "hover")
    session = Session(PELICAN)
    list(drive(session, stream(first.recording)))
    before = session.active_set.in_force
    later = list(drive(session, (Block(b.t + SECONDS + 3.0, b.columns) for b in stream(quiet.recording))))
    after = session.active_set.in_force
    kept = [None if one is None else one.parameters.values.tobytes() for one in (before, after)]
    same = kept[0] is not None and kept[0] == kept[1]
    told = {"seconds": seconds, "same_bits": same, "published": len(published(later))}
    return {"flights": rows, "after_flight": told}


DELAYS = {"attitude": 0.1, "rotor_speed": 0.3}
"""Delay of these channels behind the others [s]."""
PACE = 10.0
"""Times real time."""


def outcome(item: Any) -> tuple[Any, ...]:
    """Everything of a set that must be the same, to the bit."""
    p = item.parameters
    return item.state, item.reason, p.values.tobytes(), p.covariance.tobytes(), item.input_hash


def run_live(service: Service, arriving: list[Block]) -> list[tuple[Any, ...]]:
    """Plays blocks in the order of arrival at a pace, polling as a service does, until the last fit is back."""
    out: list[tuple[Any, ...]] = []

    def step() -> None:
        out.extend(outcome(o.item) for o in service.step() if isinstance(o, Publish))

    while not service.ready:
        step()
        time.sleep(0.02)
    begin, first = time.monotonic(), arriving[0].t[0]
    for k, block in enumerate(arriving):
        service.push(block)
        if k % 20 == 0:
            step()
            time.sleep(max(begin + (block.t[0] - first) / PACE - time.monotonic(), 0.0))
    while service.session.running is not None or service.session.status().backlog > 1.0:
        step()
        time.sleep(0.002)
    return out


def repeatability(seconds: float, seed: int) -> dict[str, Any]:
    """Estimates of a live run and of its replay: how many, and whether all are the same to the bit."""
    flight = flown(seconds, seed)
    rng = np.random.default_rng(seed)
    every = [block.part(k, k + 1) for block in stream(flight.recording) for k in range(len(block.t))]
    arrival = [b.t[0] + DELAYS.get(b.columns[0][0], 0.0) + rng.exponential(0.02) for b in every]
    arriving = [every[i] for i in np.argsort(arrival, kind="stable")]
    settings = SessionSettings()
    live_service = Service(PELICAN, settings, ProcessWorker(PELICAN))
    try:
        live = run_live(live_service, arriving)
    finally:
        live_service.close()
    replayed = run_live(Service(PELICAN, settings, InlineWorker()), arriving)
    return {"seconds": seconds, "estimates": len(live), "same_bits": live == replayed and len(live) > 0}


# --- The page


Result = Mapping[str, Any]


def page(results: Mapping[str, Any]) -> str:
    """Markdown of all parts that were measured."""
    out = [
        "# The online service",
        "",
        "`python -m quadid_evaluation.benchmarks.online --out docs/results`; every value is in `online.json`. Window "
        "10 s, a refit every second, grid 50 Hz, Pelican.",
        "",
    ]
    for name, (title, _, write) in PARTS.items():
        out += [f"## {title}", ""]
        if (found := results.get(name)) is None:
            out += ["Not measured.", ""]
            continue
        out += [*write(found["result"]), "", f"_{found['measured']}, load {found['machine'].rpartition(' ')[2]}_", ""]
    return "\n".join(out)


def _estimate(r: Result) -> list[str]:
    flights, rows = r["flights"], []
    first = [f["first_set_at"] for f in flights if f["first_set_at"] is not None]
    for n in NOMINAL_NAMES:
        batch, online, alone, sigma = (
            100.0 * np.array([f[what][n] for f in flights])
            for what in ("to_batch", "to_truth", "batch_to_truth", "sigma")
        )
        rows.append(
            (
                n,
                f"{_rms(batch):.3f}, {np.abs(batch).max():.3f}",
                f"{np.sum(np.abs(batch) <= 1.0)} of {len(batch)}",
                f"{_rms(online):.3f}, {_rms(alone):.3f}",
                f"{np.median(sigma):.3f}",
            )
        )
    heads = ("parameter", "online to batch: RMS, worst [%]", "within 1 %", "RMS error [%]: online, batch", "sigma [%]")
    return [
        f"{len(flights)} excited flights of {r['seconds']:.0f} s. First set published after {_median(first):.0f} s "
        f"(median; {len(first)} of {len(flights)} flights published). Goal: within 1 % of the offline batch.",
        "",
        *table(heads, rows),
    ]


def _change(r: Result) -> list[str]:
    flights = r["flights"]
    after = [f["after"] for f in flights if f["after"] is not None]
    error = 100.0 * np.array([abs(f["size"] / f["fraction"] - 1.0) for f in flights if f["size"] is not None])
    named = sum(f["said"][:1] == ["mass_change"] for f in flights)
    return [
        f"Mass +15 % or −15 % at {r['at']} s of {len(flights)} excited flights. Named `mass_change` within 5 s with "
        f"its size within 10 %: **{r['hits']} of {len(flights)}**. Named at all: {named}. Reported after "
        f"{_median(after):.2f} s (median), {max(after, default=float('nan')):.2f} s (latest); size off by "
        f"{np.median(error):.2f} % (median), {error.max():.2f} % (worst)."
    ]


def _hover(r: Result) -> list[str]:
    total = {key: sum(f[key] for f in r["flights"]) for key in ("published", "candidates", "diagnoses")}
    phases = ", ".join(dict.fromkeys(f["phase"] for f in r["flights"]))
    lines = [
        f"{len(r['flights'])} hovers of {r['flights'][0]['seconds']:.0f} s: {total['published']} sets published, "
        f"{total['candidates']} estimates, {total['diagnoses']} diagnoses; at the end: {phases}."
    ]
    after = r["after_flight"]
    same = "the same to the bit" if after["same_bits"] else "**changed**"
    lines += [
        f"60 s excited, then {after['seconds']:.0f} s of hover: {after['published']} sets published in the "
        f"hover, the set in force is {same}."
    ]
    return lines


def _repeat(r: Result) -> list[str]:
    same = "all the same to the bit" if r["same_bits"] else "**they differ**"
    return [
        f"{r['seconds']:.0f} s, samples out of order and up to 0.3 s late; fits in a process, then inline: "
        f"{r['estimates']} estimates, {same}. Over DDS: `tests/node/test_ros_node.py`."
    ]


def _load(r: Result) -> list[str]:
    return [
        "IMU 1 kHz, attitude and rotor speeds 250 Hz, references and odometry 50 Hz, from another process. Ten "
        "times a second what waits is processed in one round, which blocks services and timers. The grid waits "
        f"{1e3 * SETTLE:.0f} ms for the slowest channel. Goals: under 15 % of a core, rounds below 100 ms (p99).", "",
        *table(
            ("run", "% of a core: node, fits", "IMU received %", "wait of a message p50, p99 [ms]",
             "a round p50, p99 [ms]", "memory MiB"),
            [
                (name, f"{100 * x['cpu_node']:.1f}, {100 * x['cpu_worker']:.1f}", f"{100 * x['imu_received']:.2f}",
                 _pair(x["fitting"]), _pair(x["round"]), f"{x['memory_begin']:.0f} → {x['memory_end']:.0f}")
                for name, x in r.items()
            ],
        ),
    ]  # fmt: skip


def _pair(x: Result) -> str:
    return f"{x['p50']:.2f}, {x['p99']:.2f}" if x["count"] else "–"


def _rms(x: np.ndarray[Any, np.dtype[np.float64]]) -> float:
    return float(np.sqrt(np.mean(x**2)))


def _median(x: list[float]) -> float:
    return float(np.median(x)) if x else float("nan")


def _loads(seconds: float) -> dict[str, Any]:
    runs = {"excited": ("excited", False), "hover": ("hover", False), "recording": ("excited", True)}
    return {name: ros_flight.under_load(seconds, *how) for name, how in runs.items()}


PARTS: dict[str, tuple[str, Callable[[Given], Any], Callable[[Result], list[str]]]] = {
    "estimate": (
        "Sixty seconds of excited flight against the offline batch",
        lambda g: against_batch(range(g.flights)),
        _estimate,
    ),
    "change": ("Mass changed by 15 % in flight", lambda g: mass_changes(range(g.flights)), _change),
    "hover": ("Ten minutes of hover", lambda g: hover(600.0, range(3)), _hover),
    "repeat": ("Live and replayed", lambda g: repeatability(60.0, 1), _repeat),
    "load": ("Load", lambda g: _loads(g.load_seconds), _load),
}
"""Title, measurement and lines of each part; memory over many hours is what the soak shows."""


def keep(file: Path, name: str, result: object) -> dict[str, Any]:
    """All results of a JSON file with this one in it, which is read anew: parts may be measured side by side."""
    results = json.loads(file.read_text(encoding="utf-8")) if file.exists() else {}
    results[name] = {"result": result, "measured": time.strftime("%Y-%m-%d"), "machine": machine()}
    file.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")
    return dict(results)


if __name__ == "__main__":
    given = options(__doc__, PARTS, flights=40, load_seconds=60.0)
    out = given.out or Path("docs/results")
    for name in given.parts:
        begin = time.monotonic()
        results = keep(out / "online.json", name, PARTS[name][1](given))
        (out / "online.md").write_text(page(results), encoding="utf-8")
        print(f"{name}: {time.monotonic() - begin:.1f} s", flush=True)
