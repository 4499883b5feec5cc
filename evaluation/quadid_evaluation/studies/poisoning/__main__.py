"""Every channel wrong by a factor, at once or slowly; writes `poisoning.md`.

python -m quadid_evaluation.studies.poisoning --out docs/results [--minutes 60]
"""

from __future__ import annotations

import argparse
import copy
import json
import os
import time
from itertools import combinations
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

from quadid.flight import Flight, fly
from quadid.online import Session, SessionSettings
from quadid.online.records import OnlineSet
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.judged import judged
from quadid_evaluation.studies.poisoning.flying import (
    MUST,
    Poison,
    Spoil,
    about_the_mean,
    fly_online,
    late,
    leaking,
    scaled,
    smoothed,
    supported,
)  # fmt: skip
from quadid_evaluation.studies.poisoning.page import page

CHANNELS: dict[str, tuple[str, int | None]] = {
    "gyro p": ("gyro", 0), "gyro q": ("gyro", 1), "gyro r": ("gyro", 2), "accelerometer": ("accel", None),
    "attitude": ("attitude", None), "all rotor speeds": ("rotor_speed", None),
    "rotor 1": ("rotor_speed", 0), "rotor 2": ("rotor_speed", 1),
}  # fmt: skip
"""Rotors 3 and 4 are the mirror images of 1 and 2."""
FACTORS, STEPS = (0.8, 0.9, 1.1, 1.25), (0.5, 1.5)
RAMPS = (0.0, 120.0, 30.0, 300.0)
LEARNT = 60.0
"""Healthy flight before the poison sets in [s]: a set is in force by then."""
AFTER = 45.0
"""Flight after the poison is whole [s]."""
WEIGHT, B = 1.3 * 9.80665, 2.33e-5
"""Of the flown vehicle [N], [N s^2/rad^2]."""
SINGLE: dict[str, Spoil] = {
    **{f"support {f:+.0%} of weight": supported(f * WEIGHT, B) for f in (0.04, 0.08, 0.15, -0.08, -0.15)},
    **{f"accelerometer scale {f:g} under a bias": about_the_mean(f) for f in (0.9, 1.06, 1.12, 1.3)},
    "leak p to q 15 %": leaking(0, 1, 0.15), "leak q to p 5 %": leaking(1, 0, 0.05),
    "leak r to p 15 %": leaking(2, 0, 0.15),
    **{f"gyro smoothed {f:g} Hz": smoothed(f) for f in (3.0, 4.0, 4.5, 5.0)},
    "attitude 100 ms late": late("attitude", 0.1), "attitude 50 ms late": late("attitude", 0.05),
    "rotor 1 x 0.95": scaled("rotor_speed", 0.95, 0), "rotor 1 x 0.9": scaled("rotor_speed", 0.9, 0),
    "rotor 3 x 1.1": scaled("rotor_speed", 1.1, 2),
}  # fmt: skip
"""Faults from take-off of a first flight, one at a time."""
PARTS: dict[str, Spoil] = {
    "accel 1.03": scaled("accel", 1.03), "accel 0.97": scaled("accel", 0.97),
    "gyro 0.975": scaled("gyro", 0.975), "gyro 1.025": scaled("gyro", 1.025),
    "support 4 %": supported(0.04 * WEIGHT, B), "leak 3 %": leaking(0, 1, 0.03),
    "accel scale 1.04": about_the_mean(1.04), "rotor 1 x 0.97": scaled("rotor_speed", 0.97, 0),
    "attitude 40 ms late": late("attitude", 0.04),
}  # fmt: skip
"""Faults that are small enough to pass alone: in pairs and triples."""
TOGETHER = [c for n in (2, 3) for c in combinations(PARTS, n) if len({p.split()[0] for p in c}) == n]
SEED = 3
SETTINGS = SessionSettings(refit=2.0)
Cell = dict[str, Any]


def cells() -> list[Cell]:
    """All cells of both tables: steps first, because they take the shortest flights."""
    out = []
    for ramp in RAMPS:
        for name in CHANNELS:
            for factor in FACTORS + (STEPS if ramp == 0.0 else ()):
                out.append({"when": "in flight", "channel": name, "factor": factor, "ramp": ramp})
                if ramp == 0.0 or name == "all rotor speeds":
                    out.append({"when": "from take-off", "channel": name, "factor": factor, "ramp": ramp})
    names = [*SINGLE, *(" + ".join(c) for c in TOGETHER)]
    return out + [{"when": "first flight", "channel": name, "factor": 1.0, "ramp": 0.0} for name in names]


class Study:
    """One flight, a session that knows its first minute, and the set an earlier flight left."""

    def __init__(self) -> None:
        self.vehicle = Vehicle.shipped("pelican")
        self.flight: Flight = fly(self.vehicle, seconds=LEARNT + RAMPS[-1] + AFTER, seed=SEED)
        self.begin = min(float(c.t[0]) for c in self.flight.recording.channels.values())
        self.session = Session(self.vehicle, SETTINGS)
        self.healthy = fly_online(self.session, self.flight.recording, self.begin, LEARNT)

    def error(self, item: OnlineSet) -> dict[str, float]:
        """Relative errors of what must be known."""
        return {n: item.parameters[n].value / getattr(self.flight.truth.parameters, n) - 1.0 for n in MUST}

    def run(self, cell: Cell) -> Cell:
        """Flies a cell and notes the errors of what was published after the poison had begun."""
        if cell["when"] == "first flight":
            return self.first_flight(cell)
        begin = LEARNT if cell["when"] == "in flight" else self.begin
        channel, column = CHANNELS[cell["channel"]]
        poison = Poison(channel, column, cell["factor"], begin, cell["ramp"])
        restored = self.healthy[-1]
        session = copy.deepcopy(self.session) if begin == LEARNT else Session(self.vehicle, SETTINGS, restored, 100)
        known = len(session.poll())
        sets = fly_online(session, poison.spoil(self.flight.recording), begin, begin + cell["ramp"] + AFTER)
        return self.judged(cell, session, sets, known)

    def first_flight(self, cell: Cell) -> Cell:
        """A flight with faults from take-off, of a vehicle that nothing is known of."""
        recording, session = self.flight.recording, Session(self.vehicle, SETTINGS)
        for name in cell["channel"].split(" + "):
            recording = (SINGLE | PARTS)[name](recording)
        return self.judged(cell, session, fly_online(session, recording, self.begin, LEARNT), 0)

    def judged(self, cell: Cell, session: Session, sets: list[OnlineSet], known: int) -> Cell:
        """The cell with what was published."""
        fresh = [s for s in sets if not s.outdated and s.state.value in ("accepted", "rolled_back")]
        worst = {n: max((self.error(s)[n] for s in fresh), key=abs, default=None) for n in MUST}
        return {
            **cell,
            "flown": time.strftime("%Y-%m-%d"),
            "sets": len(fresh),
            "worst": worst,
            "says": session.status().reason,
            "known": known,
        }


def main() -> None:
    """Flies the cells that no earlier run has flown, until the time is over, and writes the page."""
    parser = argparse.ArgumentParser(prog="python -m quadid_evaluation.studies.poisoning", description=__doc__)
    parser.add_argument("--out", type=Path, default=Path("docs/results"), help="folder of poisoning.md")
    parser.add_argument("--minutes", type=float, default=240.0, help="stop after this time; the next run goes on")
    parser.add_argument("--only", default="", help="cells whose kind or channel has this in its name")
    parser.add_argument("--fresh", action="store_true", help="forget what earlier runs have flown")
    given = parser.parse_args()
    kept = given.out / "poisoning.json"
    done: list[Cell] = json.loads(kept.read_text()) if kept.exists() and not given.fresh else []
    study, until = Study(), time.monotonic() + 60.0 * given.minutes
    for cell in cells():
        if given.only not in f"{cell['when']} {cell['channel']}":
            continue
        if any(all(d[k] == v for k, v in cell.items()) for d in done) or time.monotonic() > until:
            continue
        done.append(study.run(cell))
        print(done[-1], flush=True)
        kept.write_text("[\n" + ",\n".join(json.dumps(d) for d in done) + "\n]\n")
    healthy = [(s.stop, study.error(s)) for s in study.healthy]
    where = given.out / "poisoning.md"
    where.write_text(page(cells(), done, healthy, SEED) + judged(where))


if __name__ == "__main__":
    main()
