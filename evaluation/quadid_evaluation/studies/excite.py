"""Promises of proposed manoeuvres: predicted intervals beside those that their flights gave.

    python -m quadid_evaluation.studies.excite --out docs/results
    python -m quadid_evaluation.studies.excite --vehicle FILE BEFORE.bin FLOWN.bin

Each seed is a new individual Pelican with a poor guess.  Its pilot flies gently for a minute; `quadid excite` proposes
a minute by that log, the true vehicle flies it, and both logs together go through `quadid identify`.  Once the vehicle
is as the model, once rotors lag, hubs drag and random forces act that the model lacks.

With logs, the promises by those before are compared with what they and a log of the flown manoeuvre give.
"""

import math
from collections.abc import Sequence
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np
from quadid_replay.writers import write_csv

import quadid
from quadid.chi_square import Z95
from quadid.errors import QuadidError
from quadid.flight import draw_truth, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import RandomForces, RandomInput, Vehicle
from quadid_evaluation.harness import Given, options, put, share, table
from quadid_evaluation.studies.truth import poor_guess

CRAFT, PAGE, TITLE = Vehicle.shipped("pelican"), "excite.md", "What to fly next"
GUSTS = RandomForces(
    horizontal=RandomInput(sigma=0.2, time=1.0), vertical=RandomInput(sigma=0.2, time=1.0),
    roll_pitch=RandomInput(sigma=0.5, time=0.3), yaw=RandomInput(sigma=0.2, time=0.5),
)  # fmt: skip
AIRS: dict[str, dict[str, Any]] = {
    "as the model": {},
    "with a lag of 30 ms, drag and gusts": {
        "effects": {"motor_lag": {"tau": 0.03}, "rotor_drag": {"k_x": 0.3, "k_y": 0.3}},
        "random": GUSTS,
    },
}
KEYS = ("now", "gentle_flight", "manoeuvre")


def obtained(logs: Sequence[str | Path], vehicle: Vehicle, seed: int = 1) -> tuple[FloatArray, FloatArray]:
    """Relative 95 % half-widths and values, each (6,), after identifying `logs`; NaN for what they do not reveal."""
    found = quadid.identify(list(logs), vehicle=vehicle, seed=seed).parameters
    known = [(found[n].ci95[1], found[n].value) if n in found.names else (math.nan, math.nan) for n in NOMINAL_NAMES]
    most, values = np.array(known).T
    return most / values - 1.0, values


def promised(logs: Sequence[str | Path], vehicle: Vehicle, seconds: float, seed: int = 1) -> tuple[Any, FloatArray]:
    """The proposal of `quadid excite`, and half-widths (3, 6) now, after a gentle flight, and after the manoeuvre."""
    found = quadid.excite(list(logs), vehicle=vehicle, seconds=seconds, seed=seed)
    rows = {p["name"]: p for p in found.result["parameters"]}
    return found.proposal, np.array([[rows[n][key] for n in NOMINAL_NAMES] for key in KEYS])


def run(seed: int, seconds: float, air: dict[str, Any]) -> tuple[FloatArray, FloatArray]:
    """One vehicle: half-widths (4, 6) as `promised` and obtained; errors (6,) over standard deviations."""
    truth = draw_truth(CRAFT, seed)
    vehicle = poor_guess(CRAFT, truth.as_dict(), seed)
    with TemporaryDirectory() as folder:
        before, after = (str(Path(folder) / f"{name}.csv") for name in ("before", "after"))
        write_csv(before, fly(CRAFT, truth, seconds, seed, "gentle", **air).recording)
        proposal, widths = promised([before], vehicle, seconds, seed)
        flown = fly(CRAFT, truth, proposal.seconds, seed + 1, "scripted", segments=proposal.segments, **air)
        write_csv(after, flown.recording)
        half, values = obtained([before, after], vehicle, seed)
    errors = np.log(values / [truth.as_dict()[n] for n in NOMINAL_NAMES]) * Z95 / np.log1p(half)
    return np.vstack([widths, half]), errors


def rows_of(widths: FloatArray) -> list[tuple[str, ...]]:
    """A row a parameter of half-widths (4, 6) [%]: predictions, what was obtained, and that over the promise."""
    return [
        (name, *(f"{100.0 * w:.2g}" for w in column), f"{column[3] / column[2]:.2g}")
        for name, column in zip(NOMINAL_NAMES, widths.T, strict=True)
    ]


HEADS = ("parameter", "now", "after a gentle flight", "promised", "obtained", "over the promise")


def simulated(given: Given) -> list[str]:
    """The section of simulated vehicles."""
    lines = ["## Simulated vehicles", "", (__doc__ or "").split("\n\n")[2].replace("  ", " ")]
    for name, air in AIRS.items():
        found = []
        for seed in range(given.seeds):
            try:
                found.append(run(30_000 + seed, given.seconds, air))
            except QuadidError as error:
                lines += ["", f"Vehicle {seed} {name}: {error}"]
        widths, errors = np.array([w for w, _ in found]), np.array([e for _, e in found])
        ratio = widths[:, 3] / widths[:, 2]
        known = np.isfinite(errors)
        lines += [
            "",
            f"Vehicles {name}: median half-width of {len(found)} in per cent.",
            "",
            *table(HEADS, rows_of(np.nanmedian(widths, axis=0))),
            "",
            f"* Obtained is at most twice the promise in {share(int((ratio <= 2.0).sum()), ratio.size)} of all cases "
            f"({np.nanmin(ratio):.2f} to {np.nanmax(ratio):.2f} of it).",
            f"* The truth is inside {share(int((np.abs(errors[known]) < Z95).sum()), int(known.sum()))}.",
        ]
    return lines


def recorded(given: Given) -> list[str]:
    """The section of recorded flights: the last word is the log of the flown manoeuvre."""
    vehicle, (*before, flown) = Vehicle.named(given.vehicle), given.words
    _, widths = promised(before, vehicle, given.seconds)
    rows = rows_of(np.vstack([widths, obtained([*before, flown], vehicle)[0]]))
    names = [Path(word).name for word in given.words]
    title = f"Half-widths in per cent, promised by {', '.join(names[:-1])} and obtained with {names[-1]}."
    return [f"## {vehicle.name}", "", title, "", *table(HEADS, rows)]


if __name__ == "__main__":
    logs = "logs: those before, then that of the flown manoeuvre"
    asked = options(__doc__, words=logs, vehicle="pelican", seeds=10, seconds=60.0)
    section = recorded if asked.words else simulated
    put(asked, PAGE, TITLE, section.__name__, section(asked))
