"""`make foreign`: what is answered on vehicles of others, beside their truth and a regression."""

import dataclasses
import datetime
import json
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

import quadid
from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.errors import QuadidError
from quadid.identification.predict import QUANTITIES, lengths
from quadid.parameters import Parameter, Status
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options, table
from quadid_evaluation.studies.ahead import shares_of_no_change
from quadid_evaluation.studies.cases import FOLDERS, windows
from quadid_evaluation.studies.flight_sets import SETS, FlightSet
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
        """Checks whether the interval holds the truth, or part of what is known of it."""
        return self.interval[0] <= self.truth[1] and self.truth[0] <= self.interval[1]

    @property
    def identified(self) -> bool:
        """Checks whether the command calls the value identified."""
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
    ]
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
    """Results of one set.

    Attributes:
        identified, diagnosed: JSON results; None with the reason in `failed`.
        prediction: half-second errors as shares of no change by what predicts them, each of the four quantities.
        terms: formulas of the residual terms.
        soon: error of the rate after 0.1 s by the same predictors, as a share of no change.
        velocity: scale of the logged velocity against the change of position, and the position error it makes.
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
        "that may fly; bands of its predictions: `quadid score`.",
        "",
    ]
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
        n
        for name, row in rows.items()
        for n in of_set(name, SETS[name], {"identify": row.identified, "diagnose": row.diagnosed})
    ]
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


# --- What about a hundred lines of learning reach: ridge regression, also on random features


BINS = 10
"""Parts of the half second over which rotor speeds are averaged."""
FEATURES = 400
WEIGHTS = (1e-4, 1e-3, 1e-2, 1e-1)
"""Ridge weights; the best on a held-out fifth of the training flights is taken."""
EVERY = 0.02
"""Time between runs [s]."""


@dataclass(frozen=True)
class Runs:
    """States and inputs (runs, inputs) and changes over half a second (runs, 4, 3): position, velocity, turn, rate."""

    x: FloatArray
    y: FloatArray


def runs_of(windows: Sequence[Window], seconds: float = 0.5) -> Runs:
    """All runs of windows that measure attitude and velocity; changes that are not measured are zero.

    All predict the change of position, velocity, attitude and rate over half a second at once, from the measured state
    and the rotor speeds of that half second, in body axes: more than a simulation gets to see, since in closed loop the
    later rotor speeds betray the motion that they answer.
    """
    parts = [p for w in windows if (p := _runs(w, seconds)) is not None]
    return Runs(np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts]))


def _runs(w: Window, seconds: float) -> tuple[FloatArray, FloatArray] | None:
    steps, every = round(seconds / w.dt), max(round(EVERY / w.dt), 1)
    if w.attitude is None or w.velocity is None or w.gyro is None or len(w) <= steps + 1:
        return None
    known = np.isfinite(w.attitude).all(axis=1) & np.isfinite(w.velocity).all(axis=1) & np.isfinite(w.gyro).all(axis=1)
    start = np.arange(0, len(w) - steps, every)
    start = start[known[start] & known[start + steps]]
    end = start + steps
    before, after = (Rotation.from_quat(w.attitude[rows], scalar_first=True) for rows in (start, end))
    edges = np.linspace(0, steps, BINS + 1).astype(int)
    sums = np.cumsum(np.vstack([np.zeros(w.rotor_speed.shape[1]), w.rotor_speed]), axis=0)
    inputs = [(sums[start + b] - sums[start + a]) / (b - a) for a, b in zip(edges[:-1], edges[1:], strict=True)]
    state = [before.apply(w.velocity[start], inverse=True), w.gyro[start], before.apply([0.0, 0.0, 1.0], inverse=True)]
    place = np.zeros_like(w.velocity) if w.position is None else np.nan_to_num(w.position)
    changes = [
        before.apply(place[end] - place[start], inverse=True),
        before.apply(w.velocity[end] - w.velocity[start], inverse=True),
        (before.inv() * after).as_rotvec(),
        w.gyro[end] - w.gyro[start],
    ]
    return np.concatenate([*state, *inputs], axis=1), np.stack(changes, axis=1)


def velocity_against_position(windows: Sequence[Window], seconds: float = 0.5) -> tuple[float, float]:
    """Scale of the logged velocity against the change of position, and the error that it alone makes.

    Returns:
        Scale of the velocity against the change of position, least squares; mean distance between the change of
        position over `seconds` and the integral of the logged velocity, as a share of no change.  NaN without both.
    """
    moved, flown = [np.zeros((0, 3))], [np.zeros((0, 3))]
    for w in windows:
        steps = round(seconds / w.dt)
        if w.position is None or w.velocity is None or len(w) <= steps:
            continue
        path = np.vstack([np.zeros(3), np.cumsum(0.5 * (w.velocity[1:] + w.velocity[:-1]) * w.dt, axis=0)])
        both = np.hstack([w.position[steps:] - w.position[:-steps], path[steps:] - path[:-steps]])
        both = both[np.isfinite(both).all(axis=1)]
        moved, flown = [*moved, both[:, :3]], [*flown, both[:, 3:]]
    p, v = np.concatenate(moved), np.concatenate(flown)
    if not len(p):
        return float("nan"), float("nan")
    miss = np.linalg.norm(p - v, axis=1).mean() / np.linalg.norm(p, axis=1).mean()
    return float(np.sum(v * p) / np.sum(p * p)), float(miss)


Predictor = Callable[[FloatArray], FloatArray]


def ridge(train: Runs, features: int = 0, seed: int = 1) -> Predictor:
    """Ridge regression, with random cosine features beside the inputs where asked for (Rahimi and Recht, 2007)."""
    mean, spread = train.x.mean(axis=0), train.x.std(axis=0) + 1e-9
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(train.x.shape[1], features)) * 0.7 / np.sqrt(train.x.shape[1])
    phases = rng.uniform(0.0, 2.0 * np.pi, features)

    def mapped(x: FloatArray) -> FloatArray:
        z = (x - mean) / spread
        bends = np.cos(z @ weights + phases) * 5.0 * np.sqrt(2.0 / max(features, 1))
        return np.concatenate([np.ones((len(z), 1)), z, bends], axis=1)

    a, y = mapped(train.x), train.y.reshape(len(train.y), -1)
    cut = 4 * len(a) // 5

    def solved(rows: int, weight: float) -> FloatArray:
        part = a[:rows]
        return np.asarray(np.linalg.solve(part.T @ part + weight * rows * np.eye(a.shape[1]), part.T @ y[:rows]))

    scale = y.std(axis=0) + 1e-12
    best = min(WEIGHTS, key=lambda weight: float(np.mean(((a[cut:] @ solved(cut, weight) - y[cut:]) / scale) ** 2)))
    coefficients = solved(len(a), best)
    return lambda x: (mapped(x) @ coefficients).reshape(-1, 4, 3)


def shares(predict: Predictor, unseen: Runs) -> FloatArray:
    """Mean error of each quantity as a share of predicting no change, shape (4,)."""
    guess = predict(unseen.x)
    return np.asarray(_errors(unseen.y, guess).mean(axis=0) / _errors(unseen.y, np.zeros_like(guess)).mean(axis=0))


def _errors(truth: FloatArray, guess: FloatArray) -> FloatArray:
    """Errors (runs, 4): Euclidean, of turns the angle between them."""
    miss = truth - guess
    angle = (Rotation.from_rotvec(guess[:, 2]).inv() * Rotation.from_rotvec(truth[:, 2])).magnitude()
    miss[:, 2] = 0.0
    miss[:, 2, 0] = 2.0 * np.sin(0.5 * angle)  # `lengths` takes an axis times twice the sine of half the angle
    return lengths(miss)


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
    vehicle = Vehicle.named(data / one.vehicle)
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
        ours = {name: [*shares_of_no_change(new, v, AHEAD).values()] for name, v in files.items()}
        prediction = ours | learners(seen, new)
        soon = {name: shares_of_no_change(new, v, SOON)["rate"] for name, v in files.items()}
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


if __name__ == "__main__":
    main()
