"""The faults, by row of the list in `tests/faults/fault_list.py`: each does its harm, and returns what it did."""

from __future__ import annotations

import math
import os
import random
import resource
import signal
import sqlite3
import subprocess
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from quadid_node.mavlink_wire import dialect

from quadid_evaluation.studies.chaos.running import Running, low_bits, stop_quietly
from quadid_evaluation.studies.chaos.vehicle import Sender, Vehicle


@dataclass
class Scene:
    """What a fault can get hold of."""

    service: Running
    vehicle: Vehicle
    port: int
    rng: random.Random
    small_disk: bool


Fault = Callable[[Scene], str]
COMMIT_LIMIT = 120.0
"""A service that finds a set in its history numbers it anew within this time of a start [s]."""
START_LIMIT = 300.0
"""A second service has to say within this time [s] that it is refused; starting took a minute on a crowded machine."""


def worker_killed(scene: Scene) -> str:
    return _signal_worker(scene, signal.SIGKILL)


def worker_stopped(scene: Scene) -> str:
    return _signal_worker(scene, signal.SIGSTOP)


def worker_out_of_memory(scene: Scene) -> str:
    pid = scene.service.worker()
    if not pid:
        return "no fit process at that moment"
    resource.prlimit(pid, resource.RLIMIT_DATA, (1 << 20, 1 << 20))
    return "its memory limited to 1 MiB"


def _signal_worker(scene: Scene, number: signal.Signals) -> str:
    pid = scene.service.worker()
    if not pid:
        return "no fit process at that moment"
    os.kill(pid, number)
    return number.name


def terminated(scene: Scene) -> str:
    number = scene.rng.choice((signal.SIGTERM, signal.SIGINT))
    took = scene.service.end(number)
    scene.service.start()
    return f"{number.name}, gone after {took:.1f} s, started again"


def power_cut(scene: Scene) -> str:
    scene.service.end(signal.SIGKILL)
    scene.service.start()
    return "kill -9, started again"


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


def sensor_not_a_number(scene: Scene) -> str:
    value = scene.rng.choice((math.nan, math.inf, 1e30))
    return _spoilt(scene, lambda m: _scaled(m, value), f"gyro times {value} for 5 s")


def sensor_stuck(scene: Scene) -> str:
    kept: list[Any] = []

    def spoil(message: Any) -> Any:
        if message.get_type() == "HIGHRES_IMU":
            kept.append(message)
            message.xgyro, message.ygyro, message.zgyro = kept[0].xgyro, kept[0].ygyro, kept[0].zgyro
        return message

    return _spoilt(scene, spoil, "gyro frozen for 5 s")


def wrong_units(scene: Scene) -> str:
    return _spoilt(scene, lambda m: _scaled(m, 180.0 / math.pi), "gyro in deg/s for 5 s")


def wrong_sign(scene: Scene) -> str:
    return _spoilt(scene, lambda m: _scaled(m, -1.0), "gyro with the sign flipped for 5 s")


def half_lost(scene: Scene) -> str:
    return _spoilt(scene, lambda m: m if scene.rng.random() < 0.5 else None, "half of all messages lost for 5 s")


def _spoilt(scene: Scene, spoil: Callable[[Any], Any], told: str) -> str:
    scene.vehicle.spoil = spoil
    time.sleep(5.0)
    scene.vehicle.spoil = None
    return told


def _scaled(message: Any, factor: float) -> Any:
    if message.get_type() == "HIGHRES_IMU":
        message.xgyro, message.ygyro, message.zgyro = (
            factor * v for v in (message.xgyro, message.ygyro, message.zgyro)
        )
    return message


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
    other = scene.service.another(scene.service.history)
    try:
        out, _ = other.communicate(timeout=START_LIMIT)
    except subprocess.TimeoutExpired:
        stop_quietly(other)
        scene.service.crashes.append(f"a second service on one history was not refused within {START_LIMIT:.0f} s")
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
    "fit process killed": (11, worker_killed), "fit process stopped": (11, worker_stopped),
    "fit process out of memory": (11, worker_out_of_memory), "SIGTERM or SIGINT": (13, terminated),
    "power cut": (13, power_cut), "kill between commit and publication": (23, killed_at_commit),
    "history locked": (12, history_locked), "history damaged": (12, history_damaged),
    "history deleted": (12, history_removed), "disk full": (12, disk_full), "link silent": (9, link_silent),
    "vehicle reboots": (7, vehicle_reboots), "sensor not a number": (6, sensor_not_a_number),
    "sensor stuck": (6, sensor_stuck), "wrong units": (10, wrong_units), "wrong sign": (17, wrong_sign),
    "half of the messages lost": (8, half_lost), "forged frames": (14, forged), "replayed frames": (14, replayed),
    "flood": (14, flood), "second service": (21, second_service),
}  # fmt: skip
"""Row of the list and what does it, by name."""
