"""`make foreign`: what is answered on vehicles of others, beside their truth, a regression and small networks."""

from __future__ import annotations

import argparse
import dataclasses
import json
import os
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import quadid
from quadid.app.logs import load_vehicle
from quadid.data.window import Window
from quadid.errors import QuadidError
from quadid.identification.predict import QUANTITIES, mean_errors, no_change
from quadid.model.layout import Layout
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.foreign.learning import (
    FEATURES,
    network,
    ridge,
    runs_of,
    shares,
    velocity_against_position,
)
from quadid_evaluation.studies.foreign.numbers import Number, of_cases, of_rotorpy
from quadid_evaluation.studies.foreign.page import AHEAD, Row, page, section
from quadid_evaluation.studies.foreign.sets import SETS, FlightSet

RATE = 100.0
"""Grid of the scores [Hz]."""
SOON = 0.1
"""Time [s] after which the rate of `crazyflie rpm` is wanted below 0.35 of no change."""
NOTES = Path(__file__).with_name("notes.md")
NUMBERS = "numbers"
"""Key of the numbers of other data."""
_KEPT = ("parameters", "verdict", "validation", "findings")


def main() -> None:
    """Runs the sets that were asked for, or all, prints them and writes the page from all results so far."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("--others", action="store_true", help="numbers of RotorPy's flights and independent cases too")
    parser.add_argument("names", nargs="*", help=", ".join(SETS))
    given = parser.parse_args()
    unknown = [n for n in given.names if n not in SETS]
    if unknown:
        sys.exit(f"no set called {unknown[0]}; there are {', '.join(SETS)}")
    kept = given.out / "foreign.json"
    rows = json.loads(kept.read_text()) if kept.exists() else {}
    if given.others:
        rows[NUMBERS] = [dataclasses.asdict(n) for n in (*of_rotorpy(), *of_cases(given.data))]
        _write(kept, rows)
    for name in given.names or ([] if given.others else SETS):
        row = measured(SETS[name], given.data)
        print(section(name, SETS[name], row), flush=True)
        rows[name] = dataclasses.asdict(row)
        _write(kept, rows)


def _write(kept: Path, rows: dict[str, Any]) -> None:
    """Keeps all results so far, and writes the page of them."""
    kept.write_text(json.dumps(rows, indent=1) + "\n")
    sets = {n: Row(**rows[n]) for n in SETS if n in rows}
    text = page(sets, NOTES.read_text(), [Number(**n) for n in rows.get(NUMBERS, [])])
    kept.with_suffix(".md").write_text(text)


def measured(one: FlightSet, data: Path) -> Row:
    """Identifies, diagnoses and predicts one set."""
    begin = time.perf_counter()
    vehicle = load_vehicle(str(data / one.vehicle))
    try:
        train = [quadid.load(str(data / log), vehicle) for log in one.train]
        identified = quadid.identify(train).result
        found = quadid.diagnose(train)
    except QuadidError as error:
        return Row(None, None, {}, time.perf_counter() - begin, str(error))
    files = {"physical file": found.vehicle}
    prediction: dict[str, list[float]] = {}
    soon: dict[str, float] = {}
    velocity = (float("nan"), float("nan"))
    if one.unseen:
        seen, new = ([w for log in part for w in _fine(data, log, vehicle)] for part in (one.train, one.unseen))
        prediction = {name: _share(new, v, AHEAD) for name, v in files.items()} | learners(seen, new)
        soon = {name: _share(new, v, SOON)[3] for name, v in files.items()}
        velocity = velocity_against_position(new)
    first, second = ({key: r[key] for key in _KEPT if key in r} for r in (identified, found.result))
    terms = tuple(t.formula for t in found.vehicle.residual)
    return Row(first, second, prediction, time.perf_counter() - begin, terms=terms, soon=soon, velocity=velocity)


def _fine(data: Path, log: str, vehicle: Vehicle) -> Sequence[Window]:
    return quadid.load(str(data / log), vehicle, rate=RATE).windows


def learners(seen: Sequence[Window], new: Sequence[Window]) -> dict[str, list[float]]:
    """Errors of ridge, random features and network half a second ahead, as shares of no change."""
    if all(w.velocity is None for w in new):
        return {}
    learn, test = runs_of(seen), runs_of(new)
    guesses = {"ridge": ridge(learn), "random features": ridge(learn, FEATURES), "network": network(learn)}
    alone = shares(ridge(learn.state, FEATURES), test.state).tolist()
    return {name: shares(guess, test).tolist() for name, guess in guesses.items()} | {"state alone": alone}


def _share(windows: Sequence[Window], vehicle: Vehicle, seconds: float) -> list[float]:
    """Errors so long after a measured state, as shares of no change."""
    steps = round(seconds / windows[0].dt)
    errors = mean_errors(windows, vehicle, Layout(vehicle).initial(vehicle), steps)
    still = no_change(windows, vehicle, steps)
    return [errors[q] / still[q] for q in QUANTITIES]


if __name__ == "__main__":
    main()
