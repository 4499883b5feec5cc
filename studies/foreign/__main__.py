"""`make foreign`: what is answered on vehicles of others, beside their truth, a regression and small networks."""

from __future__ import annotations

import argparse
import os
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

import quadid
from quadid.errors import QuadidError
from quadid.identify.open_loop import QUANTITIES, mean_errors, no_change
from quadid.model.layout import Layout
from quadid.vehicle import Vehicle
from quadid.window import Window
from quadid.workflow.loading import Log, load_vehicle
from studies.foreign.learning import FEATURES, network, ridge, runs_of, shares
from studies.foreign.sets import SETS, FlightSet
from studies.page import put_section

AHEAD = 0.5
RATE = 100.0
"""Grid of the scores [Hz]."""
COMMAND = "make foreign"


@dataclass(frozen=True)
class Row:
    """What one set gave.

    Attributes:
        identified, diagnosed: JSON results; None with the reason in `failed`.
        prediction: half-second errors as shares of no change by what predicts them, each of the four quantities.
        seconds: wall time.
    """

    identified: dict[str, Any] | None
    diagnosed: dict[str, Any] | None
    prediction: dict[str, list[float]]
    seconds: float
    failed: str = ""


def main() -> None:
    """Runs the sets that were asked for, or all, prints and writes the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--data", type=Path, default=Path(os.environ.get("QUADID_DATA", "../shared/data")))
    parser.add_argument("--out", type=Path, default=Path("docs/results"))
    parser.add_argument("names", nargs="*", help=", ".join(SETS))
    given = parser.parse_args()
    unknown = [n for n in given.names if n not in SETS]
    if unknown:
        sys.exit(f"no set called {unknown[0]}; there are {', '.join(SETS)}")
    for name in given.names or SETS:
        row = measured(SETS[name], given.data)
        text = section(name, SETS[name], row)
        print(text, flush=True)
        put_section(given.out / "foreign.md", "Vehicles of others", f"foreign {name}", text)


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
    if found.prediction is not None:
        files["prediction file"] = found.prediction
    prediction: dict[str, list[float]] = {}
    if one.unseen:
        finer = [[quadid.load(str(data / log), vehicle, rate=RATE) for log in part] for part in (one.train, one.unseen)]
        prediction = predicted(files, *finer)
    return Row(identified, found.result, prediction, time.perf_counter() - begin)


def predicted(files: dict[str, Vehicle], train: Sequence[Log], unseen: Sequence[Log]) -> dict[str, list[float]]:
    """Errors half a second ahead on unseen flights, as shares of no change."""
    windows = [w for log in unseen for w in log.windows]
    out = {name: _share(windows, vehicle) for name, vehicle in files.items()}
    seen, new = ([w for log in part for w in log.windows] for part in (train, unseen))
    if any(w.velocity is not None for w in new):
        learn, test = runs_of(seen), runs_of(new)
        learners = {"ridge": ridge(learn), "random features": ridge(learn, FEATURES), "network": network(learn)}
        out |= {name: shares(predict, test).tolist() for name, predict in learners.items()}
    return out


def _share(windows: Sequence[Window], vehicle: Vehicle) -> list[float]:
    steps = round(AHEAD / windows[0].dt)
    errors = mean_errors(windows, vehicle, Layout(vehicle).initial(vehicle), steps)
    still = no_change(windows, vehicle, steps)
    return [errors[q] / still[q] for q in QUANTITIES]


def section(name: str, one: FlightSet, row: Row) -> str:
    """Markdown of one set."""
    lines = [f"## {name}", "", f"`{COMMAND}` ({row.seconds:.0f} s), trained on {', '.join(one.train)}.", ""]
    if row.identified is None or row.diagnosed is None:
        return "\n".join([*lines, f"Refused: {row.failed}"])
    lines += ["| parameter | truth | identify | status | diagnose | status |", "|---|---|---|---|---|---|"]
    after = {p["name"]: p for p in row.diagnosed.get("parameters", [])}
    for p in row.identified["parameters"]:
        low, high = one.truth.get(p["name"], (np.nan, np.nan))
        truth = "" if np.isnan(low) else f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        cells = [_cell(p), p["status"], *((_cell(q), q["status"]) if (q := after.get(p["name"])) else ("", ""))]
        lines.append(f"| {p['name']} | {truth} | {' | '.join(cells)} |")
    lines += [
        "",
        f"Verdict `{row.diagnosed['verdict']}`, error on data not fitted "
        f"{row.diagnosed['validation']['mse_nominal']:.3g} → {row.diagnosed['validation']['mse_extended']:.3g} "
        "noise variances. Found: " + (", ".join(_finding(f) for f in row.diagnosed["findings"]) or "nothing") + ".",
    ]
    if row.prediction:
        lines += ["", f"Error {AHEAD:g} s ahead on {', '.join(one.unseen)}, as a share of no change:", "",
                  "| | " + " | ".join(QUANTITIES) + " |", "|---|---|---|---|---|"]  # fmt: skip
        lines += [f"| {who} | " + " | ".join(f"{s:.2f}" for s in s4) + " |" for who, s4 in row.prediction.items()]
    return "\n".join(lines)


def _cell(p: dict[str, Any]) -> str:
    low, high = p["ci95"]
    return f"{p['value']:.3g} [{low:.3g}, {high:.3g}]"


def _finding(f: dict[str, Any]) -> str:
    numbers = ", ".join(f"{p['name']} {p['value']:.3g} {p['unit']}".strip() for p in f["parameters"])
    return f"{f['effect']} ({numbers}{'' if f['confident'] else '; not confident'})"


if __name__ == "__main__":
    main()
