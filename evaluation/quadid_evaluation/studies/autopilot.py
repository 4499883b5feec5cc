"""`make autopilot`: recorded flights of autopilots through the online session, replayed and live.

    python -m quadid_evaluation.studies.autopilot [--out docs/results] [--live] [WORD ...]

Words choose the flights whose name holds one of them; `--live` plays telemetry logs into `quadid serve` in real time.
"""

import json
import socket
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import chain, takewhile
from pathlib import Path
from typing import Any

import numpy as np
from quadid_node.messages import set_to_dict
from quadid_node.recording import play, stream
from quadid_node.service import Service, session_settings
from quadid_node.worker import InlineWorker
from quadid_replay import open_log
from quadid_replay.tlog import read_frames

from quadid.data.window import Block
from quadid.online import Event, Phase, Publish
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import QUADID, free_port, options, put, table
from quadid_evaluation.studies.readings import telemetry

# --- The flights, what is known of them, and what a session that flew one of them is asked for


SITL = "ardupilot_sitl"
X = {"b": 4.24e-5, "J_xx": 0.02297, "J_yy": 0.02297, "J_zz": 0.04594}
"""Truth of ArduPilot's default frame; b is the secant of its thrust curve at hover."""
X_PWM = {**X, "b": 3.69e-5}
"""The same where the vehicle file takes 1000 to 2000 us for 0 to 754 rad/s: the pulse that hovers stands for 446."""
SQUARE = {"b": 1.983e-5, "J_xx": 0.018, "J_yy": 0.024, "J_zz": 0.036}


@dataclass(frozen=True)
class Flown:
    """One flight.

    Attributes:
        log, vehicle: below the data folder, or a path of its own.
        truth: of the parameters that are known.
        interval: the log as a live link would bring it, with rotor readings so far apart [s]; 0: as it is.
        pulses: such a link brings motor outputs, not rotor speeds.
    """

    log: str
    vehicle: str
    truth: Mapping[str, float] = field(default_factory=dict)
    interval: float = 0.0
    pulses: bool = False

    @property
    def name(self) -> str:
        """Log and vehicle file."""
        told = "motor outputs" if self.pulses else "rotors"
        thinned = f", {told} every {self.interval * 1e3:g} ms" if self.interval else ""
        return f"{self.log} with {self.vehicle.rsplit('/', 1)[-1]}{thinned}"


ARDUCOPTER = (
    Flown(f"{SITL}/quad_sq.bin", f"{SITL}/quad_sq.yaml", SQUARE),
    Flown(f"{SITL}/x.bin", f"{SITL}/sitl_x.yaml", X),
    Flown(f"{SITL}/quad_sq.tlog", f"{SITL}/quad_sq.yaml", SQUARE),
    Flown(f"{SITL}/x.tlog", f"{SITL}/sitl_x.yaml", X),
    Flown(f"{SITL}/quad_sq_pwm.tlog", f"{SITL}/quad_sq_pwm.yaml", SQUARE),
    Flown(f"{SITL}/quad_sq.tlog", f"{SITL}/quad_sq_pwm.yaml", SQUARE),
    Flown(f"{SITL}/x.tlog", f"{SITL}/sitl_x_pwm.yaml", X_PWM),
    Flown(f"{SITL}/x_zero_rpm.tlog", f"{SITL}/sitl_x_pwm.yaml", X_PWM),
    *(Flown(f"{SITL}/x.bin", f"{SITL}/sitl_x.yaml", X, interval) for interval in (0.02, 0.0125)),
    *(Flown(f"{SITL}/quad_sq.bin", f"{SITL}/quad_sq.yaml", SQUARE, interval) for interval in (0.02, 0.0125)),
    Flown(f"{SITL}/x.bin", f"{SITL}/sitl_x_pwm.yaml", X_PWM, 0.0125, True),
    Flown(f"{SITL}/quad_sq.bin", f"{SITL}/quad_sq_pwm.yaml", SQUARE, 0.0125, True),
)
"""A real autopilot in a simulator of others: the truth is known, and nothing changes in flight."""
_VEHICLES = Path(__file__).parent / "vehicles"
OTHERS = (
    Flown("ardupilot/log171.bin", f"{_VEHICLES}/log171.yaml"),
    Flown("px4/ascend_cubeorange_test.ulg", f"{_VEHICLES}/ascend.yaml"),
    *(Flown(f"crazyflie_rpm/figure8_{n}.csv", "crazyflie_rpm/vehicle.yaml") for n in (17, 22, 27, 35)),
    *(Flown(f"nanodrone/{k}_run1.csv", "nanodrone/vehicle.yaml") for k in ("chirp", "random", "square")),
)
"""Real flights without change: every alarm is false."""


@dataclass(frozen=True)
class Outcome:
    """Outcome of a flight in a session.

    Attributes:
        published, candidates: sets as JSON, in order.
        status: the last one, phase and reason.
        seconds: wall time.
    """

    published: list[dict[str, Any]]
    candidates: list[dict[str, Any]]
    events: list[dict[str, Any]]
    status: str
    seconds: float

    def told(self, kind: str) -> list[str]:
        """Events of a kind with their times: ``change`` (alarms), ``model`` (effects that the model took in)."""
        return [f"{e['t'] - self.begin:.0f} s: {e['text']}" for e in self.events if e["kind"] == kind]

    @property
    def begin(self) -> float:
        """Beginning of the excited flight: the first data learned from; before any, that of the stream [s]."""
        times = [s["start"] for s in (*self.candidates, *self.published) if s.get("start")]
        return min(times, default=min((e["t"] for e in self.events if e["t"] is not None), default=0.0))


def errors_of(item: Mapping[str, Any], truth: Mapping[str, float]) -> list[str]:
    """Error of each identified parameter whose truth is known; bold where it is wrong.

    Wrong is: more than 3 % and outside its interval, or more than 10 %.
    """
    out = []
    for p in item["parameters"]:
        if p["name"] in truth and p["status"] == "identified":
            off = p["value"] / truth[p["name"]] - 1.0
            outside = not p["ci95"][0] <= truth[p["name"]] <= p["ci95"][1]
            wrong = abs(off) > 0.10 or (outside and abs(off) > 0.03)
            text = f"{p['name']} {off:+.1%}"
            out.append(f"**{text}**" if wrong else text)
    return out


# --- A telemetry log played into `quadid serve`: its bytes over UDP, each at its receive time


WARM = 120.0
"""Longest wait for the fit process to be warm [s]."""
LINGER = 5.0
"""The service goes on this long after the last byte [s]."""


def serve(log: Path, vehicle: Path, seconds: float) -> Outcome:
    """Plays a telemetry log in real time into a `quadid serve` of its own, and reads its history.

    Args:
        log: telemetry log.
        vehicle: vehicle file.
        seconds: of the log to play at most.
    """
    begin, frames = time.monotonic(), read_frames(log)
    with tempfile.TemporaryDirectory() as folder, socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as wire:
        wire.bind(("127.0.0.1", 0))
        port, history = free_port(), Path(folder) / "history.sqlite"
        with serving(vehicle, f"udpin:127.0.0.1:{port}", history) as said:
            # Every frame when it came, counted from the first; what is asked of the vehicle finds no ear.
            start, due = time.monotonic(), frames.received - frames.received[:1]
            for k in range(int(np.searchsorted(due, seconds, "right"))):
                time.sleep(max(start + due[k] - time.monotonic(), 0.0))
                wire.sendto(frames.frame(k), ("127.0.0.1", port))
            time.sleep(LINGER)
        return stored(vehicle, history, said, time.monotonic() - begin)


@contextmanager
def serving(vehicle: Path, link: str, history: Path) -> Iterator[list[str]]:
    """A `quadid serve` on a MAVLink connection, once it is ready or `WARM` is over; yields the lines that it prints."""
    served = subprocess.Popen(
        [QUADID, "serve", "--vehicle", str(vehicle), "--mavlink", link, "--history", str(history)],
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
    )
    said, ready = list[str](), threading.Event()
    listener = threading.Thread(target=_listen, args=(served, said, ready), daemon=True)
    listener.start()
    try:
        ready.wait(WARM)
        yield said
    finally:
        served.terminate()
        served.wait(30)
        listener.join(5)


def stored(vehicle: Path, history: Path, said: list[str], seconds: float) -> Outcome:
    """Record that an ended service left in its history; `said`: its lines; `seconds`: how long it ran."""
    told = subprocess.run(
        [QUADID, "history", "--vehicle", str(vehicle), "--history", str(history),
         "--candidates", "10000", "--events", "10000", "--json", "-"],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    found = json.loads(told.stdout)
    last = [line for line in said if " | Hz: " in line][-1:]
    status = last[0].split(" | Hz: ")[0] if last else ""
    return Outcome(found["sets"], found["candidates"], found["events"], status, seconds)


def _listen(served: subprocess.Popen[str], said: list[str], ready: threading.Event) -> None:
    """Keeps the lines of a service, and notes when it is ready."""
    assert served.stdout is not None
    for line in served.stdout:
        said.append(line.rstrip())
        if line.startswith("ready"):
            ready.set()


# --- The study


TITLE = "Flights of real autopilots, online"
COMMAND = "make autopilot"


def main() -> None:
    """Flies what was asked for, prints each flight, writes the page."""
    given = options(__doc__, words="parts of names of flights; all without", live=False, seconds=1e9)
    way = "live" if given.live else "replay"
    for kind, flights in (("ArduCopter", ARDUCOPTER), ("Others", OTHERS)):
        rows = list[list[str]]()
        for one in flights:
            if given.words and not any(w in one.name for w in given.words):
                continue
            if given.live and not one.log.endswith(".tlog"):
                continue
            done = flown(one, given.data, given.live, given.seconds)
            rows.append(row(one, done))
            print(*rows[-1], sep=" | ", flush=True)
            for text in (*done.told("model"), *done.told("change")):
                print(f"    {text}", flush=True)
        if rows:
            put(given, "autopilot.md", TITLE, f"{kind} {way}", section(kind, way, rows, given.seconds))


def flown(one: Flown, data: Path, live: bool, seconds: float) -> Outcome:
    """One flight through the session."""
    file = data / one.vehicle
    if live:
        return serve(data / one.log, file, seconds)
    begin = time.monotonic()
    vehicle = Vehicle.named(file)
    recording = open_log(str(data / one.log), "auto", vehicle.columns)
    if one.interval:
        recording = telemetry(recording, one.interval, one.pulses)
    service = Service(vehicle, session_settings("auto", seed=0), InlineWorker(), live=False)
    outputs = play(service, until(stream(recording), seconds))
    sets = [(o.topic, set_to_dict(o.item, covariance=False)) for o in outputs if isinstance(o, Publish)]
    events = [{"t": o.t, "kind": o.kind, "text": o.text} for o in outputs if isinstance(o, Event)]
    status = service.session.status()
    published, candidates = ([one for topic, one in sets if topic == name] for name in ("parameters", "candidate"))
    said = f"{status.phase.value}: {status.reason}"
    return Outcome(published, candidates, events, said, time.monotonic() - begin)


def until(blocks: Iterator[Block], seconds: float) -> Iterator[Block]:
    """The first `seconds` of a stream."""
    first = next(blocks)
    return chain([first], takewhile(lambda b: b.t[0] - first.t[0] <= seconds, blocks))


def row(one: Flown, done: Outcome) -> list[str]:
    """The cells of one flight."""
    first = f"{done.published[0]['stop'] - done.begin:.0f}" if done.published else "none"
    wrong = sum("**" in " ".join(errors_of(s, one.truth)) for s in done.published) if one.truth else None
    counts = [len(done.published), *([] if wrong is None else [wrong]), len(done.told("change"))]
    cells = [one.name, ", ".join(map(str, counts)), first]
    if one.truth:
        sets = (done.published[0], done.published[-1]) if done.published else ()
        cells += ["; ".join(errors_of(s, one.truth)) for s in sets] or ["", ""]
    ending = "" if done.status.startswith(Phase.ACCEPTED.value) else done.status
    return [*cells, ending]


def section(kind: str, way: str, rows: list[list[str]], seconds: float) -> str:
    """Markdown of one kind of flights."""
    truth = ["first set", "last set"] if kind == "ArduCopter" else []
    counts = "sets, wrong ones, alarms" if truth else "sets, alarms"
    heads = ["flight", counts, "excited flight to first set [s]", *truth, "at the end, unless a set is in force"]
    how = f"`{COMMAND}`, {way}" + (" in real time through `quadid serve`" if way == "live" else "")
    how += f"; the first {seconds:g} s of each log" if seconds < 1e9 else ""
    return "\n".join([f"## {kind}, {way}", "", f"{how}; seed 0.", "", *table(heads, rows)])


if __name__ == "__main__":
    main()
