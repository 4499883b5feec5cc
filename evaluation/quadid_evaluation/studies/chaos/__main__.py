"""Chaos: random faults at the running service for some minutes; writes `chaos.md`.

python -m quadid_evaluation.studies.chaos --minutes 20 --seed 1 --out docs/results
"""

from __future__ import annotations

import argparse
import contextlib
import os
import random
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

from quadid.flight import fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle as Pelican
from quadid_evaluation.studies.chaos.faults import FAULTS, Scene
from quadid_evaluation.studies.chaos.page import page
from quadid_evaluation.studies.chaos.running import Running, low_bits
from quadid_evaluation.studies.chaos.vehicle import Vehicle
from quadid_evaluation.studies.judged import judged

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
    parser = argparse.ArgumentParser(prog="python -m quadid_evaluation.studies.chaos", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of chaos.md")
    parser.add_argument("--minutes", type=float, default=20.0)
    parser.add_argument("--seed", type=int, default=1, help="of the order of the faults")
    parser.add_argument("--only", choices=sorted(FAULTS), action="append", help="this fault (may be repeated)")
    given = parser.parse_args()
    flight = fly(Pelican.shipped("pelican"), seconds=120.0, seed=3)
    truth = {n: getattr(flight.truth.parameters, n) for n in NOMINAL_NAMES}
    entries: list[Entry] = []
    with tempfile.TemporaryDirectory() as name, small_disk(Path(name) / "disk") as small:
        key, port = Path(name) / "key", _free_port()
        key.write_bytes(KEY)
        service, vehicle = Running(Path(name), port, key), Vehicle(port, KEY, flight)
        vehicle.start()
        scene = Scene(service, vehicle, port, random.Random(given.seed), small)
        try:
            minutes = _attack(scene, given.only or list(FAULTS), entries, 60.0 * given.minutes)
        finally:
            _land(scene)
    wrong, sets = judge(vehicle.told, truth, service.rows)
    command = f"python -m quadid_evaluation.studies.chaos --minutes {given.minutes:g} --seed {given.seed}"
    given.out.mkdir(parents=True, exist_ok=True)
    where = given.out / "chaos.md"
    where.write_text(page(command, minutes, entries, service.crashes, wrong, sets) + judged(where))
    _say(f"{len(entries)} faults, {len(service.crashes)} crashes, {len(wrong)} wrong publications")
    sys.exit(bool(service.crashes or wrong))


def _attack(scene: Scene, names: Sequence[str], entries: list[Entry], seconds: float) -> float:
    """Waits for a first estimate, then throws faults for `seconds`; returns how long it did so [min]."""
    first = _recovered(scene.service, time.time(), START_LIMIT)
    if first is None:
        sys.exit(f"the service made no estimate within {START_LIMIT:.0f} s: {scene.service.lines[-3:]}")
    _say(f"first estimate after {first:.0f} s; now the faults")
    begin = time.time()
    _throw(scene, names, entries, begin + seconds)
    return (time.time() - begin) / 60.0


def _land(scene: Scene) -> None:
    """Ends service and vehicle; takes the last numbered sets from the history."""
    scene.service.check()
    if scene.service.child is not None:
        scene.service.newest_estimate()
        scene.service.end(signal.SIGTERM)
    scene.vehicle.stop()
    scene.service.newest_estimate()


def _throw(scene: Scene, names: Sequence[str], entries: list[Entry], until: float) -> None:
    """Every fault once in random order, then again in another, until the time is over."""
    waiting: list[str] = []
    while time.time() < until:
        if not waiting:
            waiting = scene.rng.sample(list(names), len(names))
        name = waiting.pop()
        row, harm = FAULTS[name]
        at = time.time()
        did = harm(scene)
        over = time.time()
        recovered = _recovered(scene.service, over)
        entries.append({
            "row": row, "name": name, "did": did, "lasted": over - at, "recovered": recovered,
            "load": os.getloadavg()[0],
        })  # fmt: skip
        _say(f"{name} ({did}): {'not recovered' if recovered is None else f'{recovered:.1f} s'}")
        if recovered is None:
            said = "; ".join(scene.service.lines[-2:])
            scene.service.crashes.append(f"{name}: no estimate within {RECOVERY_LIMIT:.0f} s; said: {said}")
            _say(said)
        time.sleep(scene.rng.uniform(0.0, 3.0))


def _recovered(service: Running, since: float, limit: float = RECOVERY_LIMIT) -> float | None:
    """Time until the next estimate was journalled [s]; None when none came."""
    while time.time() - since < limit:
        service.check()
        newest = service.newest_estimate()
        if newest > since:
            return newest - since
        time.sleep(0.3)
    return None


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


def _free_port() -> int:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def _say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')} {text}", flush=True)


if __name__ == "__main__":
    main()
