"""`make autopilot`: recorded flights of autopilots through the online session, replayed and live.

    python -m quadid_evaluation.studies.autopilot [--out docs/results] [--live] [WORD ...]

Words choose the flights whose name holds one of them; `--live` plays telemetry logs into `quadid serve` in real time.
"""

from __future__ import annotations

import argparse
import os
import time
from collections.abc import Iterator
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid_node.messages import Output, set_to_dict
from quadid_node.recording import stream
from quadid_node.service import Service
from quadid_node.settings import session_settings
from quadid_node.worker import InlineWorker
from quadid_replay import open_log

from quadid.app.logs import load_vehicle
from quadid.data.window import Sample
from quadid.online import Event, Phase, Publish
from quadid_evaluation.studies.autopilot.flights import ARDUCOPTER, OTHERS, Flown, Outcome, errors_of
from quadid_evaluation.studies.autopilot.live import serve
from quadid_evaluation.studies.autopilot.readings import telemetry
from quadid_evaluation.studies.page import put_section

TITLE = "Flights of real autopilots, online"
COMMAND = "make autopilot"
BATCH = 200
"""Samples between two looks at the session."""


def main() -> None:
    """Flies what was asked for, prints each flight, writes the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    parser.add_argument("--out", type=Path, help="folder of the result page; default: print only")
    parser.add_argument("--live", action="store_true")
    parser.add_argument("--seconds", type=float, default=1e9, help="of each log at most [s]")
    parser.add_argument("words", nargs="*")
    given = parser.parse_args()
    way = "live" if given.live else "replay"
    for kind, flights in (("ArduCopter", ARDUCOPTER), ("Others", OTHERS)):
        rows = []
        for one in flights:
            if given.words and not any(w in one.name for w in given.words):
                continue
            if given.live and not one.log.endswith(".tlog"):
                continue
            done = flown(one, given.data, given.live, given.seconds)
            rows.append(row(one, done))
            print(rows[-1], flush=True)
            for text in (*done.models, *done.alarms):
                print(f"    {text}", flush=True)
        if rows and given.out is not None:
            put_section(given.out / "autopilot.md", TITLE, f"{kind} {way}", section(kind, way, rows, given.seconds))


def flown(one: Flown, data: Path, live: bool, seconds: float) -> Outcome:
    """One flight through the session."""
    file = Path(one.vehicle) if one.vehicle.startswith("studies") else data / one.vehicle
    if live:
        return serve(data / one.log, file, seconds)
    begin = time.monotonic()
    vehicle = load_vehicle(str(file))
    recording = open_log(str(data / one.log), "auto", vehicle.columns)
    if one.interval:
        recording = telemetry(recording, one.interval, one.pulses)
    service = Service(vehicle, session_settings("auto", seed=0), InlineWorker())
    outputs: list[Output] = []
    for count, sample in enumerate(until(stream(recording), seconds)):
        service.push(sample)
        if count % BATCH == 0:
            outputs += _worked(service)
    outputs += _worked(service)
    sets: dict[str, list[dict[str, Any]]] = {"parameters": [], "candidate": []}
    for output in outputs:
        if isinstance(output, Publish):
            sets[output.topic].append(set_to_dict(output.item, covariance=False))
    events = [{"t": o.t, "kind": o.kind, "text": o.text} for o in outputs if isinstance(o, Event)]
    status = service.session.status()
    said = f"{status.phase.value}: {status.reason}"
    return Outcome(sets["parameters"], sets["candidate"], events, said, time.monotonic() - begin)


def _worked(service: Service) -> list[Output]:
    """Steps until the session needs more samples."""
    out = service.step()
    while service.session.running is not None:
        out += service.step()
    return out


def until(samples: Iterator[Sample], seconds: float) -> Iterator[Sample]:
    """The first `seconds` of a stream."""
    first = next(samples)
    return chain([first], takewhile(lambda s: s.t - first.t <= seconds, samples))


def row(one: Flown, done: Outcome) -> str:
    """The line of one flight."""
    first = "none" if done.first is None else f"{done.first:.0f}"
    wrong = sum("**" in " ".join(errors_of(s, one.truth)) for s in done.published) if one.truth else None
    counts = [len(done.published), *([] if wrong is None else [wrong]), len(done.alarms)]
    cells = [one.name, ", ".join(map(str, counts)), first]
    if one.truth:
        sets = (done.published[0], done.published[-1]) if done.published else ()
        cells += ["; ".join(errors_of(s, one.truth)) for s in sets] or ["", ""]
    ending = "" if done.status.startswith(Phase.ACCEPTED.value) else done.status
    return "| " + " | ".join([*cells, ending]) + " |"


def section(kind: str, way: str, rows: list[str], seconds: float) -> str:
    """Markdown of one kind of flights."""
    truth = ["first set", "last set"] if kind == "ArduCopter" else []
    counts = "sets, wrong ones, alarms" if truth else "sets, alarms"
    heads = ["flight", counts, "excited flight to first set [s]", *truth, "at the end, unless a set is in force"]
    how = f"`{COMMAND}`, {way}" + (" in real time through `quadid serve`" if way == "live" else "")
    how += f"; the first {seconds:g} s of each log" if seconds < 1e9 else ""
    lines = [f"## {kind}, {way}", "", f"{how}; seed 0.", "", "| " + " | ".join(heads) + " |", "|" + "---|" * len(heads)]
    return "\n".join([*lines, *rows])


if __name__ == "__main__":
    main()
