"""Blinded campaign: hides effects in flown data, lets the diagnosis look at the log alone, and grades the answer.

    python -m studies.campaign --cases 400 --out docs/results

Every case is decided by its class and number alone.  The diagnosis gets windows and a vehicle file with a poor guess;
what was hidden never reaches it.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import time
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")

import numpy as np

from quadid.diagnose import Diagnosis, diagnose
from quadid.effects import EFFECTS
from quadid.errors import QuadidError
from quadid.flight import OUTSIDE, FlightError, draw_effect, draw_outside, draw_truth, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import ParameterPrior, Vehicle
from quadid.window import Window

GUESS = 0.2
"""Standard deviation of the logarithm of the initial guess against the truth."""
NEEDS_MORE = {"wind": ("velocity",), "ground_effect": ("position", "velocity")}
SINGLES = tuple(EFFECTS)
PAIRS = (
    ("motor_lag", "rotor_drag"), ("cg_offset", "gyro_bias"), ("weak_rotor", "battery_sag"), ("motor_lag", "cg_offset"),
    ("command_delay", "imu_lever_arm"), ("mass_change", "rotor_drag"), ("accel_bias", "thrust_curve"),
    ("imu_misalignment", "motor_lag"), ("rate_damping", "cg_offset"), ("product_of_inertia", "attitude_delay"),
)  # fmt: skip
LOOK_ALIKES = (
    ("motor_lag", "command_delay"), ("weak_rotor", "cg_offset"), ("rotor_drag", "accel_bias"),
    ("mass_change", "battery_sag"), ("imu_lag", "motor_lag"), ("attitude_delay", "gyro_scale"),
)  # fmt: skip


@dataclass(frozen=True)
class Case:
    """One blinded case: what is hidden and how it is flown."""

    group: str
    number: int
    hidden: dict[str, dict[str, float]]
    expected: tuple[str, ...]
    outside: dict[str, dict[str, float]] = field(default_factory=dict)
    vehicle: str = "pelican"
    seconds: float = 120.0
    noise_scale: float = 1.0
    profile: str = "excited"
    scale: float = 1.0

    @property
    def seed(self) -> int:
        """Seed of the flight."""
        return zlib.crc32(f"{self.group}/{self.number}".encode()) % 2**31


@dataclass(frozen=True)
class Graded:
    """The answer to one case beside the truth."""

    case: Case
    verdict: str
    named: tuple[str, ...]
    listed: tuple[str, ...]
    first: str | None
    values: dict[str, dict[str, float]]
    intervals: dict[str, dict[str, tuple[float, float]]]
    mse_nominal: float
    mse_extended: float
    mse_oracle: float | None
    rest: float
    seconds: float
    note: str = ""


def cases(group: str, count: int, start: int = 0) -> list[Case]:
    """Returns cases `start` to `start + count` of one class."""
    return [_case(group, n) for n in range(start, start + count)]


def _case(group: str, n: int) -> Case:
    vehicle = "pelican_x" if n % 3 == 2 else "pelican"
    craft = Vehicle.shipped(vehicle)

    def draw(name: str, scale: float = 1.0, seconds: float = 120.0) -> dict[str, dict[str, float]]:
        return draw_effect(name, n, scale, craft, seconds)

    blank = Case(group, n, {}, (), vehicle=vehicle)
    hidden: dict[str, dict[str, float]]
    if group == "null":
        return blank
    if group in ("single", "noisy", "short", "weak"):
        name = SINGLES[n % len(SINGLES)]
        hidden = draw(name, seconds=60.0 if group == "short" else 120.0)
        changed: dict[str, dict[str, Any]] = {
            "noisy": {"noise_scale": 3.0},
            "short": {"seconds": 60.0},
            "weak": {"profile": "gentle"},
        }
        return replace(blank, hidden=hidden, expected=tuple(hidden), **changed.get(group, {}))
    if group.startswith("size_"):
        name = SINGLES[n % len(SINGLES)]
        scale = float(group.split("_")[1])
        hidden = draw(name, scale)
        return replace(blank, hidden=hidden, expected=tuple(hidden), scale=scale)
    if group in ("pair", "look_alike"):
        pool = PAIRS if group == "pair" else LOOK_ALIKES
        hidden = {k: v for name in pool[n % len(pool)] for k, v in draw(name).items()}
        return replace(blank, hidden=hidden, expected=tuple(hidden))
    if group == "outside":
        name = sorted(OUTSIDE)[n % len(OUTSIDE)]
        return replace(blank, outside={name: draw_outside(name, n)})
    if group == "clutter":
        large = SINGLES[n % len(SINGLES)]
        hidden = {}
        for i, name in enumerate(SINGLES):
            if name not in ("mass_change", "thrust_drop", "ground_effect", "wind"):
                hidden.update({k: v for k, v in draw_effect(name, n + 1000 * i, 0.05, craft).items() if k == name})
        hidden.update(draw(large))
        return replace(blank, hidden=hidden, expected=(large,))
    raise ValueError(f"unknown class '{group}'")


GROUPS = {
    "single": 100, "null": 100, "pair": 30, "look_alike": 24, "outside": 48, "clutter": 50, "noisy": 25, "short": 25,
    "weak": 25, "size_0.3": 25, "size_0.1": 25, "size_0.03": 25,
}  # fmt: skip


def guessed_vehicle(case: Case, truth: dict[str, float]) -> Vehicle:
    """The vehicle file handed to the diagnosis: geometry and mass right, parameters a poor guess."""
    rng = np.random.default_rng([case.seed, 77])
    priors = {
        n: ParameterPrior(initial=float(f"{truth[n] * np.exp(GUESS * rng.uniform(-1.7, 1.7)):.3e}"))
        for n in NOMINAL_NAMES
    }
    return Vehicle.shipped(case.vehicle).model_copy(update={"parameters": priors})


def flown(case: Case) -> tuple[Window, Window, Vehicle]:
    """Flies the training and the validation flight of a case."""
    craft = Vehicle.shipped(case.vehicle)
    truth = draw_truth(craft, case.seed)
    extras = tuple({e for name in case.hidden for e in NEEDS_MORE.get(name, ())})
    windows = []
    for k in range(2):
        flight = fly(
            craft, truth, case.seconds, case.seed + 7919 * k, case.profile, effects=case.hidden, outside=case.outside,
            noise_scale=case.noise_scale, extras=extras,
        )  # fmt: skip
        windows.append(flight.window)
    return windows[0], windows[1], guessed_vehicle(case, truth.as_dict())


def run(case: Case) -> Graded:
    """Flies, diagnoses and grades one case."""
    try:
        train, validate, vehicle = flown(case)
    except (FlightError, QuadidError) as error:
        return _failed(case, f"not flown: {error}")
    began = time.perf_counter()
    try:
        found, workings = diagnose([train], vehicle, [validate], seed=case.seed)
    except QuadidError as error:
        return _failed(case, f"refused: {error}")
    seconds = time.perf_counter() - began
    return _graded(case, found, workings.remainder.deviance / workings.search.model.rows, seconds)


def _graded(case: Case, found: Diagnosis, rest: float, seconds: float) -> Graded:
    return Graded(
        case,
        found.verdict.value,
        tuple(f.effect for f in found.findings if f.confident),
        tuple(f.effect for f in found.findings),
        found.findings[0].effect if found.findings else None,
        {f.effect: {p.name: p.value for p in f.parameters} for f in found.findings},
        {f.effect: {p.name: p.ci95 for p in f.parameters} for f in found.findings},
        found.validation.nominal,
        found.validation.extended,
        None,
        rest,
        seconds,
    )


def _failed(case: Case, note: str) -> Graded:
    return Graded(case, "failed", (), (), None, {}, {}, float("nan"), float("nan"), None, 0.0, 0.0, note)


def right(g: Graded) -> bool:
    """Whether the answer is right in full: all that was hidden, nothing else; `unknown` for the unknown."""
    group = g.case.group
    if group == "null":
        return g.verdict == "nothing_found"
    if group == "outside":
        return g.verdict == "unknown" or (g.verdict == "nothing_found")
    if group == "clutter":
        return g.first in g.case.expected and all(n in g.case.hidden for n in g.named)
    return set(g.named) == set(g.case.expected)


def _line(g: Graded) -> str:
    """One wrong answer, for the log of a campaign."""
    what = g.case.expected if g.case.group == "clutter" else g.case.hidden or g.case.outside
    return (
        f"{g.case.number} {g.case.vehicle} {g.verdict} {list(g.listed)} hidden {what} "
        f"mse {g.mse_nominal:.3f} -> {g.mse_extended:.3f} rest {g.rest:.3f} {g.note}"
    )


def run_many(todo: Sequence[Case], processes: int = 2) -> list[Graded]:
    """Runs cases in worker processes, in order."""
    if processes <= 1:
        return [_said(run(c)) for c in todo]
    with multiprocessing.get_context("spawn").Pool(processes) as pool:
        return [_said(g) for g in pool.imap(run, todo, chunksize=1)]


def _said(g: Graded) -> Graded:
    """Prints one case as it is done."""
    print("   ", "right" if right(g) else "WRONG", f"{g.seconds:.1f} s", _line(g), flush=True)
    return g


def main() -> None:
    """Command line of the campaign."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--groups", default=",".join(GROUPS))
    parser.add_argument("--count", type=int, default=0, help="cases a class (default: the full campaign)")
    parser.add_argument("--start", type=int, default=0)
    parser.add_argument("--processes", type=int, default=2)
    parser.add_argument("--out", default="")
    options = parser.parse_args()
    everything: list[dict[str, Any]] = []
    for group in options.groups.split(","):
        todo = cases(group, options.count or GROUPS[group], options.start)
        graded = run_many(todo, options.processes)
        good = sum(right(g) for g in graded)
        print(f"{group}: {good} of {len(graded)} right", flush=True)
        everything += [asdict(g) for g in graded]
    if options.out:
        Path(options.out).mkdir(parents=True, exist_ok=True)
        (Path(options.out) / "campaign.json").write_text(json.dumps(everything, default=float), encoding="utf-8")


if __name__ == "__main__":
    main()
