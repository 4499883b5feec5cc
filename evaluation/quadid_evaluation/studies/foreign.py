"""`make foreign`: what is answered on vehicles of others, beside their truth and a regression."""

from __future__ import annotations

import dataclasses
import datetime
import json
import sys
import time
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

import quadid
from quadid.app.logs import load_vehicle
from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.errors import QuadidError
from quadid.identification.predict import QUANTITIES, mean_errors, no_change
from quadid.model.layout import Layout
from quadid.parameters import Parameter, Status
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options, table
from quadid_evaluation.studies.cases import FOLDERS, windows
from quadid_evaluation.studies.flight_sets import SETS, FlightSet
from quadid_evaluation.studies.learning import FEATURES, ridge, runs_of, shares, velocity_against_position
from quadid_evaluation.studies.rotorpy_flight import fly, hummingbird

# --- Numbers beside their truth


ROTORPY_SECONDS = 30.0
ROTORPY_NAMES = {"b": "k_eta", "d": "k_m", "J_xx": "Ixx", "J_yy": "Iyy", "J_zz": "Izz"}


@dataclass(frozen=True)
class Number:
    """One parameter beside what it is.

    Attributes:
        data: set, flight or case; by: command.
        name: of the parameter; status: as the command gives it; value: its estimate.
        interval: 95 %; truth: interval in which the truth lies.
    """

    data: str
    by: str
    name: str
    status: str
    value: float
    interval: tuple[float, float]
    truth: tuple[float, float]

    @property
    def inside(self) -> bool:
        """Whether the interval holds the truth, or part of what is known of it."""
        return self.interval[0] <= self.truth[1] and self.truth[0] <= self.interval[1]

    @property
    def identified(self) -> bool:
        """Whether the number deserves its name, as the command says."""
        return self.status == Status.IDENTIFIED.value


def of_set(name: str, one: FlightSet, answers: Mapping[str, Mapping[str, Any] | None]) -> Iterator[Number]:
    """Numbers of one set whose truth is known; `answers` by command, as JSON results."""
    for by, answer in answers.items():
        found = {f["effect"] for f in (answer or {}).get("findings", [])}
        truth = one.truth | (one.beside_curve if "thrust_curve" in found else {})
        for p in (answer or {}).get("parameters", []):
            if p["name"] in truth:
                low, high = p["ci95"]
                yield Number(name, by, p["name"], p["status"], p["value"], (low, high), truth[p["name"]])


def of_rotorpy() -> Iterator[Number]:
    """RotorPy's Hummingbird with aerodynamics and 45 ms of lag, and without aerodynamics and 5 ms."""
    for name, truth, how in (
        ("RotorPy, aerodynamics, lag 45 ms", hummingbird(tau_m=0.045), {"seed": 1, "reach": 1.4}),
        ("RotorPy, no aerodynamics, lag 5 ms", hummingbird(tau_m=0.005), {"seed": 2, "aero": False}),
    ):
        flight = fly(truth, ROTORPY_SECONDS, **how)
        found, _ = diagnose([flight.window], flight.vehicle)
        yield from _beside(name, found.parameters, {ours: truth[theirs] for ours, theirs in ROTORPY_NAMES.items()})


def of_cases(data: Path) -> Iterator[Number]:
    """Nominal parameters of the independent cases, diagnosed as `quadid_evaluation.studies.cases` does, the hidden
    effect not told."""
    for folder in FOLDERS:
        for answer in json.loads((data / folder / "answers.json").read_text(encoding="utf-8")):
            place = data / folder / answer["case"]
            vehicle = Vehicle.from_yaml((place / "vehicle.yaml").read_text(encoding="utf-8"))
            train, other = (windows(place / f"{flight}.csv", vehicle) for flight in ("train", "validate"))
            found, _ = diagnose(train, vehicle, other)
            yield from _beside(f"{folder} {answer['case']}", found.parameters, answer["nominal"])


def _beside(data: str, parameters: Iterable[Parameter], truth: Mapping[str, float]) -> Iterator[Number]:
    for p in parameters:
        if p.name in truth:
            both = (truth[p.name], truth[p.name])
            yield Number(data, "diagnose", p.name, p.status.value, p.value, (p.ci95[0], p.ci95[1]), both)


def outside_table(numbers: Sequence[Number], short: Sequence[str] = ("cases", "RotorPy")) -> str:
    """Markdown: the share of identified numbers that hold their truth, by group, and those that do not.

    Data whose name begins with one of `short` are counted by it, all others as recorded vehicles.
    """
    named = [n for n in numbers if n.identified]
    if not named:
        return ""
    held = sum(n.inside for n in named)
    lines = [
        f"Of {len(named)} identified values with known truth, {held} have it inside the 95 % interval "
        f"({held / len(named):.0%}; wanted 90 %): "
        + ", ".join(f"{group} {sum(n.inside for n in mine)} of {len(mine)}" for group, mine in _groups(named, short))
        + ". All values: `foreign.json`.",
        "",
    ]  # fmt: skip
    rows = []
    for n in named:
        if n.inside:
            continue
        low, high = n.truth
        truth = f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        off = n.value / min(max(n.value, low), high) - 1.0
        interval = f"{n.value:.3g} [{n.interval[0]:.3g}, {n.interval[1]:.3g}]"
        rows.append((f"{n.data}, {n.by}", n.name, interval, f"{truth}, **{off:+.2%}**"))
    return "\n".join([*lines, *table(("outside", "parameter", "estimate [95 %]", "truth"), rows)])


def _groups(named: Sequence[Number], short: Sequence[str]) -> Iterator[tuple[str, list[Number]]]:
    """Numbers of the recorded vehicles, and those of each of `short`; empty groups are left out."""
    recorded = [n for n in named if not n.data.startswith(tuple(short))]
    for group, mine in (
        ("recorded vehicles", recorded),
        *((g, [n for n in named if n.data.startswith(g)]) for g in short),
    ):
        if mine:
            yield group, mine


# --- The page; `section` is what the command prints of each set


AHEAD = 0.5
COMMAND = "make foreign"
SHOWN = 6
"""Residual terms that are printed."""
_LEARNT = ("ridge", "random features")


@dataclass(frozen=True)
class Row:
    """What one set gave.

    Attributes:
        identified, diagnosed: JSON results; None with the reason in `failed`.
        prediction: half-second errors as shares of no change by what predicts them, each of the four quantities.
        seconds: wall time.
        terms: formulas of the residual terms.
        soon: error of the rate after 0.1 s by the same predictors, as a share of no change.
        velocity: scale of the logged velocity against the change of position, and the position error it makes.
        date: of the measurement.
    """

    identified: dict[str, Any] | None
    diagnosed: dict[str, Any] | None
    prediction: dict[str, list[float]]
    seconds: float
    failed: str = ""
    terms: tuple[str, ...] = ()
    soon: dict[str, float] = field(default_factory=dict)
    velocity: tuple[float, float] = (float("nan"), float("nan"))
    date: str = field(default_factory=lambda: datetime.date.today().isoformat())


def page(rows: Mapping[str, Row], notes: str = "", others: Sequence[Number] = ()) -> str:
    """Markdown of all sets measured so far, `notes` last; what else each gave stands in `foreign.json`.

    `others` are numbers with truth of data beside the sets.
    """
    head = (
        f"# Vehicles of others\n\n`{COMMAND}`, {max(row.date for row in rows.values())}; parameters, intervals, sizes "
        "of causes and terms of every set are in `foreign.json`."
    )
    return (
        "\n\n".join(p.strip() for p in (head, _ahead(rows), _numbers(rows, others), _answers(rows), notes) if p) + "\n"
    )


def _answers(rows: Mapping[str, Row]) -> str:
    """Verdict, error and causes of every set."""
    lines = []
    for name, row in rows.items():
        if row.diagnosed is None:
            lines.append((name, "refused", "", row.failed.partition("; fix")[0].partition(": ")[2]))
            continue
        error = row.diagnosed["validation"]
        found = [f["effect"] if f["confident"] else f"({f['effect']})" for f in row.diagnosed["findings"]]
        told = f"{error['mse_nominal']:.3g} → {error['mse_extended']:.3g}"
        lines.append((name, row.diagnosed["verdict"], told, ", ".join(found)))
    heads = ("data", "verdict", "error on held-out data [noise variances]", "causes (brackets: not confident)")
    return "\n".join(table(heads, lines))


def _ahead(rows: Mapping[str, Row]) -> str:
    """Half-second errors of all sets beside each other."""
    lines = [
        f"Errors {AHEAD:g} s ahead on unseen flights, relative to predicting no change: {', '.join(QUANTITIES)}; "
        "bold: better than ridge and random features. Iris: the other half of the same flight. A benchmark, no goal: "
        "rotor speeds were logged in closed loop, so they already answer the disturbances to come, and a model that "
        "takes torque for less than it is predicts better. The file is physics "
        "that may fly; bands of its predictions: `quadid score`.", "",
    ]  # fmt: skip
    shown = []
    for name, row in rows.items():
        if "ridge" not in row.prediction or row.diagnosed is None:
            continue
        ours = row.prediction["physical file"]
        rivals = np.min([row.prediction[who] for who in _LEARNT], axis=0)
        best = [f"**{_share(a)}**" if a < b else _share(a) for a, b in zip(ours, rivals, strict=True)]
        cells = [", ".join(best), *(", ".join(_share(s) for s in row.prediction[who]) for who in _LEARNT)]
        cells.append(f"{_share(row.velocity[1])}, {_share(row.velocity[0])}")
        shown.append((name, *cells))
    heads = ("data", "file", "ridge", "random features", "position error, scale of its velocity")
    return "\n".join([*lines, *table(heads, shown)]) if shown else ""


def _share(value: float) -> str:
    return "–" if np.isnan(value) else f"{value:.2f}"


def _numbers(rows: Mapping[str, Row], others: Sequence[Number]) -> str:
    """Every number whose truth is known, beside it."""
    own = [
        n for name, row in rows.items()
        for n in of_set(name, SETS[name], {"identify": row.identified, "diagnose": row.diagnosed})
    ]  # fmt: skip
    return outside_table([*own, *others])


def section(name: str, one: FlightSet, row: Row) -> str:
    """Markdown of one set."""
    lines = [f"## {name}", "", f"`{COMMAND}` ({row.seconds:.0f} s), trained on {', '.join(one.train)}.", ""]
    if row.identified is None or row.diagnosed is None:
        return "\n".join([*lines, f"Refused: {row.failed}"])
    after, rows = {p["name"]: p for p in row.diagnosed.get("parameters", [])}, []
    for p in row.identified["parameters"]:
        low, high = one.truth.get(p["name"], (np.nan, np.nan))
        truth = "" if np.isnan(low) else f"{low:.3g}" if low == high else f"{low:.3g} to {high:.3g}"
        both = ((_cell(q), q["status"]) if q else ("", "") for q in (p, after.get(p["name"])))
        rows.append((p["name"], truth, *chain.from_iterable(both)))
    lines += table(("parameter", "truth", "identify", "status", "diagnose", "status"), rows)
    lines += [
        "",
        f"Verdict `{row.diagnosed['verdict']}`, error on data not fitted "
        f"{row.diagnosed['validation']['mse_nominal']:.3g} → {row.diagnosed['validation']['mse_extended']:.3g} "
        "noise variances. Found: " + (", ".join(_finding(f) for f in row.diagnosed["findings"]) or "nothing") + ".",
    ]
    if row.prediction:
        lines += ["", f"Error {AHEAD:g} s ahead on {', '.join(one.unseen)}, as a share of no change:", ""]
        lines += table(("", *QUANTITIES), [(who, *(f"{s:.2f}" for s in s4)) for who, s4 in row.prediction.items()])
    if row.soon:
        lines += ["", "Rate after 0.1 s: " + ", ".join(f"{who} {share:.2f}" for who, share in row.soon.items()) + "."]
    if row.terms:
        shown = "; ".join(f"`{t}`" for t in row.terms[:SHOWN])
        lines += ["", f"Beyond the catalogue {len(row.terms)} terms, first {shown}."]
    return "\n".join([*lines, "", f"Measured {row.date}."])


def _cell(p: dict[str, Any]) -> str:
    low, high = p["ci95"]
    return f"{p['value']:.3g} [{low:.3g}, {high:.3g}]"


def _finding(f: dict[str, Any]) -> str:
    numbers = ", ".join(f"{p['name']} {p['value']:.3g} {p['unit']}".strip() for p in f["parameters"])
    return f"{f['effect']} ({numbers}{'' if f['confident'] else '; not confident'})"


# --- The measurement


RATE = 100.0
"""Grid of the scores [Hz]."""
SOON = 0.1
"""Time [s] after which the rate of `crazyflie rpm` is wanted below 0.35 of no change."""
NOTES = Path(__file__).with_name("foreign_notes.md")
NUMBERS = "numbers"
"""Key of the numbers of other data."""
_KEPT = ("parameters", "verdict", "validation", "findings")


def main() -> None:
    """Runs the sets that were asked for, or all, prints them and writes the page from all results so far."""
    given = options(__doc__, words=", ".join(SETS), others=False)
    if unknown := [n for n in given.words if n not in SETS]:
        sys.exit(f"no set called {unknown[0]}; there are {', '.join(SETS)}")
    given.out = given.out or Path("docs/results")
    kept = given.out / "foreign.json"
    rows = json.loads(kept.read_text()) if kept.exists() else {}
    if given.others:
        rows[NUMBERS] = [dataclasses.asdict(n) for n in (*of_rotorpy(), *of_cases(given.data))]
        _write(kept, rows)
    for name in given.words or ([] if given.others else SETS):
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
        prediction = {name: _ahead_of(new, v, AHEAD) for name, v in files.items()} | learners(seen, new)
        soon = {name: _ahead_of(new, v, SOON)[3] for name, v in files.items()}
        velocity = velocity_against_position(new)
    first, second = ({key: r[key] for key in _KEPT if key in r} for r in (identified, found.result))
    terms = tuple(t.formula for t in found.vehicle.residual)
    return Row(first, second, prediction, time.perf_counter() - begin, terms=terms, soon=soon, velocity=velocity)


def _fine(data: Path, log: str, vehicle: Vehicle) -> Sequence[Window]:
    return quadid.load(str(data / log), vehicle, rate=RATE).windows


def learners(seen: Sequence[Window], new: Sequence[Window]) -> dict[str, list[float]]:
    """Errors of ridge and random features half a second ahead, as shares of no change."""
    if all(w.velocity is None for w in new):
        return {}
    learn, test = runs_of(seen), runs_of(new)
    guesses = {"ridge": ridge(learn), "random features": ridge(learn, FEATURES)}
    return {name: shares(guess, test).tolist() for name, guess in guesses.items()}


def _ahead_of(windows: Sequence[Window], vehicle: Vehicle, seconds: float) -> list[float]:
    """Errors so long after a measured state, as shares of no change."""
    steps = round(seconds / windows[0].dt)
    errors = mean_errors(windows, vehicle, Layout(vehicle).initial(vehicle), steps)
    still = no_change(windows, vehicle, steps)
    return [errors[q] / still[q] for q in QUANTITIES]


if __name__ == "__main__":
    main()
