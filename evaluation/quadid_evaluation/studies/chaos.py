"""Chaos: random faults at the running service for some minutes: did it crash, publish anything wrong, and recover?

    python -m quadid_evaluation.studies.chaos --minutes 20 --seed 1 --out docs/results

Faults go by row of the list in `tests/faults/fault_list.py`: each does its harm, and returns what it did.
"""

import contextlib
import math
import os
import random
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import psutil
from quadid_node.mavlink_wire import SIGNING_EPOCH, dialect
from quadid_replay.writers import mavlink_messages

from quadid.flight import Flight, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.ros_flight import fit_process
from quadid_evaluation.harness import QUADID, free_port, judged, options, table

# --- The service under fire, its history as it is seen from outside, its fit process


GATE = "windows=2,width=0.08,yaw_width=0.6"


class Running:
    """Starts, watches, ends the service.

    Attributes:
        crashes: ends that nobody asked for, and tracebacks.
        rows: (sequence, b) of every numbered set ever seen in a history file.
    """

    def __init__(self, folder: Path, port: int, key: Path) -> None:
        self.history, self._port, self._key = folder / "disk" / "h.sqlite", port, key
        self.crashes: list[str] = []
        self.rows: set[tuple[int, float]] = set()
        self.lines: list[str] = []
        self.child: subprocess.Popen[str] | None = None
        self.start()

    def start(self) -> None:
        """Starts the service."""
        self.child = self.another()
        threading.Thread(target=self._read, args=(self.child,), daemon=True).start()

    def another(self) -> subprocess.Popen[str]:
        """A further service on the same vehicle and history."""
        command = [QUADID, "serve", "--vehicle", "pelican", "--window", "5", "--diagnose", "0", "--gate", GATE]
        command += ["--history", str(self.history), "--key", str(self._key)]
        command += ["--mavlink", f"udpin:127.0.0.1:{self._port}"]
        environment = {**os.environ, "PYTHONUNBUFFERED": "1"}
        return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, env=environment)

    def end(self, number: int) -> float:
        """Sends a signal and waits; returns how long it took [s]."""
        assert self.child is not None
        begin, child = time.monotonic(), self.child
        self.child = None
        child.send_signal(number)
        try:
            code = child.wait(60)
            if number != signal.SIGKILL and code != 0:
                self.crashes.append(f"exit code {code} after signal {number}: {self.lines[-3:]}")
        except subprocess.TimeoutExpired:
            self.crashes.append(f"not gone within 60 s of signal {number}: {self.lines[-3:]}")
            child.kill()
            child.wait(30)
        return time.monotonic() - begin

    def check(self) -> None:
        """Notes a crash, and starts the service anew after one."""
        if self.child is not None and self.child.poll() is not None:
            self.crashes.append(f"ended by itself with code {self.child.returncode}: {self.lines[-3:]}")
            self.start()

    def asked(self, query: str) -> list[tuple[Any, ...]]:
        """Rows of the history; none where it cannot be read now."""
        try:
            address = f"{self.history.as_uri()}?mode=ro"
            with contextlib.closing(sqlite3.connect(address, uri=True, timeout=0.2)) as db:
                return db.execute(query).fetchall()
        except sqlite3.Error:
            return []

    def newest_estimate(self) -> float:
        """Time of the newest estimate in the history (UNIX time); remembers the numbered sets on the way."""
        self.rows |= set(self.asked("SELECT sequence, json_extract(data, '$.parameters[0].value') FROM sets"))
        return float(sum(wall or 0.0 for (wall,) in self.asked("SELECT max(wall) FROM candidates")))

    def newest_number(self) -> int:
        """Largest number of a set in the history; 0 for none."""
        return sum(number or 0 for (number,) in self.asked("SELECT max(sequence) FROM sets"))

    def recovered(self, since: float, limit: float) -> float | None:
        """Time until the next estimate was journalled [s]; None when none came within `limit`."""
        while time.time() - since < limit:
            self.check()
            if (newest := self.newest_estimate()) > since:
                return newest - since
            time.sleep(0.3)
        return None

    def _read(self, child: subprocess.Popen[str]) -> None:
        assert child.stdout is not None
        for line in child.stdout:
            self.lines = [*self.lines[-200:], line.rstrip()]
            if "Traceback" in line:
                self.crashes.append(f"a traceback was said, after: {self.lines[-2:-1]}")


def low_bits(number: int) -> int:
    """Value of QI_SEQ for a set's number: a float on the wire holds 24 bits, QI_SEQ_HI the others."""
    return number % (1 << 24)


# --- The vehicle


GROUND = 5.0
"""Pause between two flights [s]."""


class Sender:
    """Something that speaks MAVLink over UDP to a port of this machine."""

    def __init__(self, port: int, key: bytes | None, system: int = 1) -> None:
        self.socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.socket.connect(("127.0.0.1", port))
        self.socket.setblocking(False)
        self.mav: Any = dialect.MAVLink(None, srcSystem=system, srcComponent=1)
        if key is not None:
            self.mav.signing.secret_key = key
            self.mav.signing.sign_outgoing = True
            self.tell_time()

    def tell_time(self) -> None:
        """Signs with the time of day from now on, as an autopilot with GPS does; pymavlink only counts frames."""
        self.mav.signing.timestamp = max(self.mav.signing.timestamp, int((time.time() - SIGNING_EPOCH) * 100_000))

    def send(self, message: Any) -> bytes:
        """Sends a message; returns its frame."""
        frame = bytes(message.pack(self.mav))
        self.mav.seq = (self.mav.seq + 1) % 256
        self.raw(frame)
        return frame

    def raw(self, data: bytes) -> None:
        """Sends bytes; nobody listening is no error."""
        with contextlib.suppress(OSError):
            self.socket.send(data)

    def heard(self) -> Iterator[Any]:
        """Messages that came back."""
        reader: Any = dialect.MAVLink(None)
        reader.robust_parsing = True
        with contextlib.suppress(OSError):  # nothing more has come
            while True:
                yield from reader.parse_buffer(self.socket.recv(4096)) or []


class SignedVehicle(threading.Thread):
    """Flies until told to stop.

    Attributes:
        silent: sends nothing while set.
        spoil: changes a message before it is sent, or drops it (None).
        jump: added to the vehicle's own time from the next message on [s]: a reboot.
        told: parameter values that the service sent, newest last: (time, name, value).
        frames: newest frames, for who wants to replay them.
    """

    def __init__(self, port: int, key: bytes, flight: Flight) -> None:
        super().__init__(daemon=True)
        self._sender, self._flight = Sender(port, key), flight
        self._end = threading.Event()
        self.silent = False
        self.spoil: Callable[[Any], Any | None] | None = None
        self.jump = 0.0
        self.told: list[tuple[float, str, float]] = []
        self.frames: list[bytes] = []

    def run(self) -> None:
        """Flies."""
        shift, recording = 10.0, self._flight.recording
        while not self._end.is_set():
            begin, jumped = time.monotonic(), self.jump
            later = max(shift + jumped, 1.0)
            channels = {n: replace(c, t=c.t + later) for n, c in recording.channels.items()}
            for t, message in mavlink_messages(replace(recording, channels=channels)):
                self._end.wait(max(begin + t - later - time.monotonic(), 0.0))
                if self._end.is_set() or self.jump != jumped:
                    break
                sent = message if self.spoil is None else self.spoil(message)
                if sent is not None and not self.silent:
                    self._sender.tell_time()
                    self.frames = [*self.frames[-50:], self._sender.send(sent)]
                for answer in self._sender.heard():
                    if answer.get_type() == "PARAM_VALUE" and answer.get_srcComponent() == 191:
                        self.told.append((time.time(), str(answer.param_id), float(answer.param_value)))
            shift += time.monotonic() - begin + GROUND
            self._end.wait(GROUND)

    def stop(self) -> None:
        """Lands for good."""
        self._end.set()
        self.join(10.0)


# --- The faults


@dataclass
class Scene:
    """Things that a fault can get hold of."""

    service: Running
    vehicle: SignedVehicle
    port: int
    rng: random.Random
    small_disk: bool


Fault = Callable[[Scene], str]
COMMIT_LIMIT = 120.0
"""A service that finds a set in its history numbers it anew within this time of a start [s]."""
REFUSED_LIMIT = 300.0
"""A second service has to say within this time [s] that it is refused; starting took a minute on a crowded machine."""


def fit_process_hit(scene: Scene, harm: Callable[[psutil.Process], object], did: str) -> str:
    child = scene.service.child
    worker = None if child is None else fit_process(child.pid)
    if worker is None:
        return "no fit process at that moment"
    harm(worker)
    return did


def short_of_memory(worker: psutil.Process) -> None:
    worker.rlimit(psutil.RLIMIT_DATA, (1 << 20, 1 << 20))


def ended(scene: Scene, *signals: signal.Signals) -> str:
    number = scene.rng.choice(signals)
    took = scene.service.end(number)
    scene.service.start()
    return f"{number.name}, gone after {took:.1f} s, started again"


def killed_at_commit(scene: Scene) -> str:
    """Kill -9 as soon as a numbered set is on the disk: its publication follows the commit by milliseconds."""
    scene.service.end(signal.SIGKILL)
    before, until = scene.service.newest_number(), time.monotonic() + COMMIT_LIMIT
    scene.service.start()  # what is in force gets a new number at the start
    while scene.service.newest_number() <= before:
        if time.monotonic() > until:
            return f"no numbered set within {COMMIT_LIMIT:.0f} s of a start"
        time.sleep(0.0005)
    told, number = len(scene.vehicle.told), scene.service.newest_number()
    scene.service.end(signal.SIGKILL)
    heard = any(name == "QI_SEQ" and round(value) == low_bits(number) for _, name, value in scene.vehicle.told[told:])
    scene.service.start()
    return f"kill -9 after the commit of set {number}, which was {'' if heard else 'not '}heard on the wire"


def history_locked(scene: Scene) -> str:
    db = sqlite3.connect(scene.service.history, timeout=1.0)
    try:
        db.execute("BEGIN EXCLUSIVE")
        time.sleep(8.0)
        db.rollback()
    except sqlite3.Error as error:
        return f"not to be locked ({error})"
    finally:
        db.close()
    return "for 8 s"


def history_damaged(scene: Scene) -> str:
    path = scene.service.history
    if not path.is_file():
        return "no history at that moment"
    data = path.read_bytes()
    path.write_bytes(data[:4096] + scene.rng.randbytes(max(len(data) - 4096, 0)))
    return f"{len(data)} bytes but the first page overwritten"


def disk_full(scene: Scene) -> str:
    if not scene.small_disk:
        return "not tried: this machine does not let us mount a small disk"
    filler = scene.service.history.parent / "filler"
    with filler.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            time.sleep(6.0)
    filler.unlink()
    return "for 6 s"


def link_silent(scene: Scene) -> str:
    scene.vehicle.silent = True
    time.sleep(8.0)
    scene.vehicle.silent = False
    return "for 8 s"


def vehicle_reboots(scene: Scene) -> str:
    scene.vehicle.jump = -1e6  # its clock begins anew
    time.sleep(1.0)
    scene.vehicle.jump = 0.0
    return "boot clock back to zero, then on again"


def spoilt(scene: Scene, spoil: Callable[[Any], Any], did: str) -> str:
    scene.vehicle.spoil = spoil
    time.sleep(5.0)
    scene.vehicle.spoil = None
    return f"{did} for 5 s"


def gyro(change: Callable[[Any], Sequence[float]]) -> Callable[[Any], Any]:
    """Messages whose gyro, (x, y, z) of an IMU message, is changed."""

    def spoil(message: Any) -> Any:
        if message.get_type() == "HIGHRES_IMU":
            message.xgyro, message.ygyro, message.zgyro = change(message)
        return message

    return spoil


def gyro_times(factor: float) -> Callable[[Any], Any]:
    return gyro(lambda m: [factor * v for v in (m.xgyro, m.ygyro, m.zgyro)])


def sensor_not_a_number(scene: Scene) -> str:
    value = scene.rng.choice((math.nan, math.inf, 1e30))
    return spoilt(scene, gyro_times(value), f"gyro times {value}")


def sensor_stuck(scene: Scene) -> str:
    first = list[tuple[float, float, float]]()

    def frozen(m: Any) -> tuple[float, float, float]:
        first.append((m.xgyro, m.ygyro, m.zgyro))
        return first[0]

    return spoilt(scene, gyro(frozen), "gyro frozen")


def forged(scene: Scene) -> str:
    """An unsigned and a wrongly signed vehicle with twice the thrust, and a frame from the far future."""
    attackers = [Sender(scene.port, None), Sender(scene.port, bytes(32))]
    attackers[1].mav.signing.timestamp = 2**48 - 10_000
    for k in range(400):
        for attacker in attackers:
            attacker.send(dialect.MAVLink_heartbeat_message(2, 12, 0, 0, 4, 3))
            attacker.send(dialect.MAVLink_highres_imu_message(k * 10_000, 0, 0, -19.6, 3.0, 0, 0, *[0.0] * 7, 0x3F))
            attacker.send(dialect.MAVLink_param_set_message(1, 191, b"QI_B", 1.0, 9))
        time.sleep(0.01)
    return "1200 unsigned and 1200 wrongly signed frames, some from the far future"


def replayed(scene: Scene) -> str:
    thief = Sender(scene.port, None)
    frames = list(scene.vehicle.frames)
    for _ in range(40):
        for frame in frames:
            thief.raw(frame)
        time.sleep(0.05)
    return f"{40 * len(frames)} genuine frames once more"


def flood(scene: Scene) -> str:
    crowd, count = Sender(scene.port, None), 0
    end = time.monotonic() + 4.0
    while time.monotonic() < end:
        for _ in range(100):
            crowd.raw(scene.rng.randbytes(scene.rng.randrange(1, 300)))
        count += 100
        time.sleep(0.02)
    return f"{count} datagrams of garbage in 4 s"


def second_service(scene: Scene) -> str:
    other = scene.service.another()
    try:
        out, _ = other.communicate(timeout=REFUSED_LIMIT)
    except subprocess.TimeoutExpired:
        other.kill()
        other.wait(30)
        scene.service.crashes.append(f"a second service on one history was not refused within {REFUSED_LIMIT:.0f} s")
        return "**not refused**"
    if "another service" not in out:
        scene.service.crashes.append(f"a second service on one history was not refused: {out[-200:]}")
    return f"refused with exit code {other.returncode}"


def history_removed(scene: Scene) -> str:
    for path in Path(scene.service.history.parent).glob("h.sqlite*"):
        if path.is_file():
            path.unlink()
    return "every file of it deleted"


FAULTS: dict[str, tuple[int, Fault]] = {
    "fit process killed": (11, lambda s: fit_process_hit(s, psutil.Process.kill, "SIGKILL")),
    "fit process stopped": (11, lambda s: fit_process_hit(s, psutil.Process.suspend, "SIGSTOP")),
    "fit process out of memory": (11, lambda s: fit_process_hit(s, short_of_memory, "its memory limited to 1 MiB")),
    "SIGTERM or SIGINT": (13, lambda s: ended(s, signal.SIGTERM, signal.SIGINT)),
    "power cut": (13, lambda s: ended(s, signal.SIGKILL)),
    "kill between commit and publication": (23, killed_at_commit),
    "history locked": (12, history_locked),
    "history damaged": (12, history_damaged),
    "history deleted": (12, history_removed),
    "disk full": (12, disk_full),
    "link silent": (9, link_silent),
    "vehicle reboots": (7, vehicle_reboots),
    "sensor not a number": (6, sensor_not_a_number),
    "sensor stuck": (6, sensor_stuck),
    "wrong units": (10, lambda s: spoilt(s, gyro_times(180.0 / math.pi), "gyro in deg/s")),
    "wrong sign": (17, lambda s: spoilt(s, gyro_times(-1.0), "gyro with the sign flipped")),
    "half of the messages lost": (
        8,
        lambda s: spoilt(s, lambda m: m if s.rng.random() < 0.5 else None, "half of all messages lost"),
    ),
    "forged frames": (14, forged),
    "replayed frames": (14, replayed),
    "flood": (14, flood),
    "second service": (21, second_service),
}
"""Row of the list and what does it, by name."""


# --- The run


KEY = bytes(range(32))
Entry = dict[str, Any]
"""One fault: row, name, what was done, how long it lasted [s], recovery [s], load average."""
START_LIMIT = 900.0
"""A first estimate has to come within this time [s]; a first start may compile."""
RECOVERY_LIMIT = 240.0
"""An estimate has to come within this time after a fault is over [s]."""
WITHIN = 0.05
"""A published b, J_xx or J_yy further off the truth than this is wrong."""
WIRE = {"QI_B": "b", "QI_J_XX": "J_xx", "QI_J_YY": "J_yy"}


def main() -> None:
    """Throws faults until the time is over, and writes what happened."""
    given = options(__doc__, words="faults; all without", minutes=20.0, seed=1)
    if unknown := set(given.words) - set(FAULTS):
        sys.exit(f"no fault {unknown.pop()}; there are {', '.join(FAULTS)}")
    flight = fly(Vehicle.shipped("pelican"), seconds=120.0, seed=3)
    truth = {n: getattr(flight.truth.parameters, n) for n in NOMINAL_NAMES}
    entries: list[Entry] = []
    with tempfile.TemporaryDirectory() as name, small_disk(Path(name) / "disk") as small:
        key, port = Path(name) / "key", free_port()
        key.write_bytes(KEY)
        service, vehicle = Running(Path(name), port, key), SignedVehicle(port, KEY, flight)
        vehicle.start()
        scene = Scene(service, vehicle, port, random.Random(given.seed), small)
        try:
            first = service.recovered(time.time(), START_LIMIT)
            if first is None:
                sys.exit(f"the service made no estimate within {START_LIMIT:.0f} s: {service.lines[-3:]}")
            _say(f"first estimate after {first:.0f} s; now the faults")
            begin = time.time()
            _throw(scene, given.words or list(FAULTS), entries, begin + 60.0 * given.minutes)
            minutes = (time.time() - begin) / 60.0
        finally:  # ends service and vehicle; the last numbered sets are in the history
            service.check()
            if service.child is not None:
                service.newest_estimate()
                service.end(signal.SIGTERM)
            vehicle.stop()
            service.newest_estimate()
    wrong, sets = judge(vehicle.told, truth, service.rows)
    command = f"python -m quadid_evaluation.studies.chaos --minutes {given.minutes:g} --seed {given.seed}"
    if given.out is not None:
        where = given.out / "chaos.md"
        where.write_text(page(command, minutes, entries, service.crashes, wrong, sets) + judged(where))
    _say(f"{len(entries)} faults, {len(service.crashes)} crashes, {len(wrong)} wrong publications")
    sys.exit(bool(service.crashes or wrong))


def _throw(scene: Scene, names: Sequence[str], entries: list[Entry], until: float) -> None:
    """Every fault once in random order, then again in another, until the time is over."""
    waiting: list[str] = []
    while time.time() < until:
        waiting = waiting or scene.rng.sample(list(names), len(names))
        name = waiting.pop()
        row, harm = FAULTS[name]
        at, did, over = time.time(), harm(scene), time.time()
        recovered = scene.service.recovered(over, RECOVERY_LIMIT)
        entry = {"row": row, "name": name, "did": did, "lasted": over - at, "recovered": recovered}
        entries.append(entry | {"load": os.getloadavg()[0]})
        _say(f"{name} ({did}): {'not recovered' if recovered is None else f'{recovered:.1f} s'}")
        if recovered is None:
            said = "; ".join(scene.service.lines[-2:])
            scene.service.crashes.append(f"{name}: no estimate within {RECOVERY_LIMIT:.0f} s; said: {said}")
            _say(said)
        time.sleep(scene.rng.uniform(0.0, 3.0))


def judge(
    told: list[tuple[float, str, float]], truth: dict[str, float], rows: set[tuple[int, float]]
) -> tuple[list[str], int]:
    """Wrong publications, and the number of sets seen on the wire."""
    wrong, sets, sequence = [], set(), 0
    for _, name, value in told:
        if name == "QI_SEQ":
            sequence = round(value)
        if name in WIRE and sequence:
            sets.add(sequence)
            error = value / truth[WIRE[name]] - 1.0
            if not abs(error) <= WITHIN:
                wrong.append(f"set {sequence}: {WIRE[name]} off by {error:+.1%}")
            if name == "QI_B" and not any(low_bits(n) == sequence and abs(b / value - 1.0) < 1e-5 for n, b in rows):
                wrong.append(f"set {sequence}: on the wire, in no history")
    values: dict[int, set[float]] = {}
    for number, b in rows:
        values.setdefault(number, set()).add(b)
    wrong += [f"set {number}: the number of {len(v)} sets" for number, v in values.items() if len(v) > 1]
    return sorted(set(wrong)), len(sets)


@contextlib.contextmanager
def small_disk(where: Path) -> Iterator[bool]:
    """A disk of 3 MiB for the history; yields False where the machine does not allow it (a plain folder then)."""
    where.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=3m", "tmpfs", str(where)]
    mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    try:
        yield mounted
    finally:
        if mounted:
            subprocess.run(["umount", "-l", str(where)], check=False)


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


def page(
    command: str, minutes: float, entries: list[dict[str, Any]], crashes: list[str], wrong: list[str], sets: int
) -> str:
    """Markdown: totals, then recovery by fault."""
    lines = [
        "# Chaos: random faults at the running service",
        "",
        f"`{command}` (`make chaos`), {time.strftime('%Y-%m-%d')}: `quadid serve` with history and signing, a signed "
        f"vehicle flying over MAVLink in real time; {len(entries)} faults in {minutes:.0f} min on {os.cpu_count()} "
        f"cores, load average {np.mean([e['load'] for e in entries] or [0]):.0f}.",
        "",
        f"* Crashes, unexpected ends, tracebacks, no recovery: **{len(crashes)}**",
        "* Wrong publications (b, J_xx or J_yy more than 5 % off, not in the history, or under another set's number): "
        f"**{len(wrong)}** of {sets} sets",
        "",
        "Recovery: from the end of the fault to the next estimate; a window takes 5 s.",
        "",
    ]
    rows = []
    for name in FAULTS:
        found = [e for e in entries if e["name"] == name]
        times = [e["recovered"] for e in found if e["recovered"] is not None]
        told = (
            f"{np.median(times):.1f}, {max(times):.1f}" if times else f"**none**: {found[-1]['did']}" if found else "–"
        )
        rows.append((f"{name} ({len(found)})", told))
    lines += table(("fault (times)", "recovery [s]: median, longest"), rows)
    for title, items in (("Crashes", crashes), ("Wrong", wrong)):
        if items:
            lines += ["", f"{title}:", *(f"* {item}" for item in items)]
    return "\n".join(lines) + "\n"


if __name__ == "__main__":
    main()
