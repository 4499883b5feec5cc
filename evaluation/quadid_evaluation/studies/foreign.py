"""`make foreign`: what is answered on vehicles of others, beside their truth and a regression.

`--others` measures RotorPy and the independent cases; `--bands` (`make bands`) prints the coverage of predicted bands.
"""

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
from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.errors import QuadidError
from quadid.identification.predict import BANDS, PHASES, QUANTITIES, Forecast, lengths
from quadid.model.layout import Layout
from quadid.parameters import Parameter
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import options, put, table
from quadid_evaluation.studies.campaign import INDEPENDENT, answers, given, independent
from quadid_evaluation.studies.flight_sets import SETS, FlightSet, Number, of_set, shares_of_no_change
from quadid_evaluation.studies.rotorpy_flight import NAMES, fly, hummingbird

# --- Numbers beside their truth


ROTORPY_SECONDS = 30.0


def of_rotorpy() -> Iterator[Number]:
    """RotorPy's Hummingbird with aerodynamics and 45 ms of lag, and without aerodynamics and 5 ms."""
    for name, truth, how in (
        ("RotorPy, aerodynamics, lag 45 ms", hummingbird(tau_m=0.045), {"seed": 1, "reach": 1.4}),
        ("RotorPy, no aerodynamics, lag 5 ms", hummingbird(tau_m=0.005), {"seed": 2, "aero": False}),
    ):
        flight = fly(truth, ROTORPY_SECONDS, **how)
        found, _ = diagnose([flight.window], flight.vehicle)
        yield from _beside(name, found.parameters, {ours: truth[theirs] for ours, theirs in NAMES.items()})


def of_cases() -> Iterator[Number]:
    """Nominal parameters of the independent cases, the hidden effect not told."""
    for folder in INDEPENDENT:
        for answer in answers(folder):
            train, held, vehicle = given(independent(folder, answer))
            found, _ = diagnose(train, vehicle, held)
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
    groups: dict[str, list[bool]] = {}
    for n in sorted(named, key=lambda n: n.data.startswith(tuple(short))):
        group = next((g for g in short if n.data.startswith(g)), "recorded vehicles")
        groups.setdefault(group, []).append(n.inside)
    held = sum(n.inside for n in named)
    lines = [
        f"Of {len(named)} identified values with known truth, {held} have it inside the 95 % interval "
        f"({held / len(named):.0%}; wanted 90 %): "
        + ", ".join(f"{group} {sum(mine)} of {len(mine)}" for group, mine in groups.items())
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


# --- The page


AHEAD = 0.5
COMMAND = "make foreign"
ANSWERS = ("data", "verdict", "error on held-out data [noise variances]", "causes (brackets: not confident)")


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

    def cell(values: Sequence[float], bold: Sequence[bool] = (False,) * 4) -> str:
        texts = ["–" if np.isnan(v) else f"{v:.2f}" for v in values]
        return ", ".join(f"**{text}**" if strong else text for text, strong in zip(texts, bold, strict=False))

    # Half-second errors of all sets beside each other; verdict, error and causes of every set.
    ahead, answers, numbers = list[tuple[str, ...]](), list[tuple[str, ...]](), list[Number]()
    for name, row in rows.items():
        numbers += of_set(name, SETS[name], {"identify": row.identified, "diagnose": row.diagnosed})
        if row.diagnosed is None:
            answers.append((name, "refused", "", row.failed.partition("; fix")[0].partition(": ")[2]))
            continue
        error = row.diagnosed["validation"]
        found = [f["effect"] if f["confident"] else f"({f['effect']})" for f in row.diagnosed["findings"]]
        told = f"{error['mse_nominal']:.3g} → {error['mse_extended']:.3g}"
        answers.append((name, row.diagnosed["verdict"], told, ", ".join(found)))
        if "ridge" in row.prediction:
            ours, *rivals = (row.prediction[who] for who in ("physical file", "ridge", "random features"))
            best = [mine < min(theirs) for mine, *theirs in zip(ours, *rivals, strict=True)]
            ahead.append((name, cell(ours, best), *map(cell, rivals), cell(row.velocity[::-1])))
    parts = [
        f"# Vehicles of others\n\n`{COMMAND}`, {max(row.date for row in rows.values())}; parameters, intervals, sizes "
        "of causes and terms of every set are in `foreign.json`.",
        f"Errors {AHEAD:g} s ahead on unseen flights, relative to predicting no change: {', '.join(QUANTITIES)}; "
        "bold: better than ridge and random features. Iris: the other half of the same flight. A benchmark, no goal: "
        "rotor speeds were logged in closed loop, so they already answer the disturbances to come, and a model that "
        "takes torque for less than it is predicts better. The file is physics that may fly; bands of its "
        "predictions: `quadid score`.",
        "\n".join(table(("data", "file", "ridge", "random features", "position error, scale of its velocity"), ahead)),
        outside_table([*numbers, *others]),
        "\n".join(table(ANSWERS, answers)),
        notes,
    ]
    return "\n\n".join(part.strip() for part in parts if part) + "\n"


# --- What about a hundred lines of learning reach: ridge regression, also on random features


BINS = 10
"""Parts of the half second over which rotor speeds are averaged."""
FEATURES = 400
WEIGHTS = (1e-4, 1e-3, 1e-2, 1e-1)
"""Ridge weights; the best on a held-out fifth of the training flights is taken."""
EVERY = 0.02
"""Time between runs [s]."""


Runs = tuple[FloatArray, FloatArray]
"""States and inputs (runs, inputs); changes over half a second (runs, 4, 3): position, velocity, turn, rate."""


def runs_of(windows: Sequence[Window], seconds: float = 0.5) -> Runs:
    """All runs of windows that measure attitude and velocity; changes that are not measured are zero.

    All predict the change of position, velocity, attitude and rate over half a second at once, from the measured state
    and the rotor speeds of that half second, in body axes: more than a simulation gets to see, since in closed loop the
    later rotor speeds betray the motion that they answer.
    """
    xs, ys = [], []
    for w in windows:
        steps, every = round(seconds / w.dt), max(round(EVERY / w.dt), 1)
        if w.attitude is None or w.velocity is None or w.gyro is None or len(w) <= steps + 1:
            continue
        known = np.isfinite(np.hstack([w.attitude, w.velocity, w.gyro])).all(axis=1)
        start = np.arange(0, len(w) - steps, every)
        start = start[known[start] & known[start + steps]]
        end = start + steps
        before, after = (Rotation.from_quat(w.attitude[rows], scalar_first=True) for rows in (start, end))
        edges = np.linspace(0, steps, BINS + 1).astype(int)
        sums = np.cumsum(np.vstack([np.zeros(w.rotor_speed.shape[1]), w.rotor_speed]), axis=0)
        inputs = [(sums[start + b] - sums[start + a]) / (b - a) for a, b in zip(edges[:-1], edges[1:], strict=True)]
        place = np.zeros_like(w.velocity) if w.position is None else np.nan_to_num(w.position)
        velocity, down = before.apply(w.velocity[start], inverse=True), before.apply([0.0, 0.0, 1.0], inverse=True)
        xs.append(np.concatenate([velocity, w.gyro[start], down, *inputs], axis=1))
        changes = [
            before.apply(place[end] - place[start], inverse=True),
            before.apply(w.velocity[end] - w.velocity[start], inverse=True),
            (before.inv() * after).as_rotvec(),
            w.gyro[end] - w.gyro[start],
        ]
        ys.append(np.stack(changes, axis=1))
    return np.concatenate(xs), np.concatenate(ys)


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
    inputs, changes = train
    mean, spread = inputs.mean(axis=0), inputs.std(axis=0) + 1e-9
    rng = np.random.default_rng(seed)
    weights = rng.normal(size=(inputs.shape[1], features)) * 0.7 / np.sqrt(inputs.shape[1])
    phases = rng.uniform(0.0, 2.0 * np.pi, features)

    def mapped(x: FloatArray) -> FloatArray:
        z = (x - mean) / spread
        bends = np.cos(z @ weights + phases) * 5.0 * np.sqrt(2.0 / max(features, 1))
        return np.concatenate([np.ones((len(z), 1)), z, bends], axis=1)

    a, y = mapped(inputs), changes.reshape(len(changes), -1)
    cut = 4 * len(a) // 5

    def solved(rows: int, weight: float) -> FloatArray:
        part = a[:rows]
        return np.asarray(np.linalg.solve(part.T @ part + weight * rows * np.eye(a.shape[1]), part.T @ y[:rows]))

    scale = y.std(axis=0) + 1e-12
    best = min(WEIGHTS, key=lambda weight: float(np.mean(((a[cut:] @ solved(cut, weight) - y[cut:]) / scale) ** 2)))
    coefficients = solved(len(a), best)
    return lambda x: (mapped(x) @ coefficients).reshape(-1, 4, 3)


def learners(seen: Sequence[Window], new: Sequence[Window]) -> dict[str, list[float]]:
    """Errors of ridge and random features half a second ahead, as shares of no change, by quantity."""
    if all(w.velocity is None for w in new):
        return {}
    learn, (inputs, changes) = runs_of(seen), runs_of(new)
    still = _errors(changes, np.zeros_like(changes)).mean(axis=0)
    guesses = {"ridge": ridge(learn), "random features": ridge(learn, FEATURES)}
    return {who: (_errors(changes, g(inputs)).mean(axis=0) / still).tolist() for who, g in guesses.items()}


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


def measured(one: FlightSet, data: Path) -> Row:
    """Identifies, diagnoses and predicts one set."""
    begin, vehicle = time.perf_counter(), Vehicle.named(data / one.vehicle)
    try:
        train = [quadid.load(str(data / log), vehicle) for log in one.train]
        identified, found = quadid.identify(train).result, quadid.diagnose(train)
    except QuadidError as error:
        return Row(None, None, {}, time.perf_counter() - begin, str(error))
    prediction: dict[str, list[float]] = {}
    soon: dict[str, float] = {}
    velocity = (float("nan"), float("nan"))
    if one.unseen:
        _, seen, new = one.windows(data, RATE)
        prediction = {
            "physical file": [*shares_of_no_change(new, found.vehicle, AHEAD).values()],
            **learners(seen, new),
        }
        soon = {"physical file": shares_of_no_change(new, found.vehicle, SOON)["rate"]}
        velocity = velocity_against_position(new)
    first, second = ({key: r[key] for key in _KEPT if key in r} for r in (identified, found.result))
    terms = tuple(t.formula for t in found.vehicle.residual)
    return Row(first, second, prediction, time.perf_counter() - begin, terms=terms, soon=soon, velocity=velocity)


# --- Bands of predictions on flights that were not fitted: share of outcomes inside them


WANTED = {"50": (0.40, 0.60), "95": (0.90, 0.99)}
"""Shares that a band must hold, by per cent."""
BANDS_HEADS = ("data", "of", *(f"{band} % band" for band in BANDS), "outcomes", "missing removed")


def bands(name: str, one: FlightSet, data: Path) -> list[Sequence[str]]:
    """Rows of one set, a quantity each: the file of `diagnose` on the training flights, scored `SOON` on the others."""
    vehicle = Vehicle.named(data / one.vehicle)
    try:
        train, unseen = ([quadid.load(str(data / log), vehicle) for log in part] for part in (one.train, one.unseen))
        found = quadid.diagnose(train, unseen)
        file, total = found.vehicle, dict[str, FloatArray]()
        for log in one.unseen:
            windows = quadid.load(str(data / log), vehicle, rate=RATE).windows
            samples = round(SOON / windows[0].dt)
            forecast = Forecast(windows, file, Layout(file).initial(file), file.random)
            for quantity, counts in forecast.covered([samples])[samples].items():
                total[quantity] = total.get(quantity, 0.0) + counts
    except QuadidError as error:
        return [(name, f"refused: {error.found}", *[""] * 5)]
    removed = found.result["removed"]
    told = "–" if removed is None else f"{100.0 * removed:.0f} %"
    return [
        (name, quantity, *(_inside(c, i) for i in range(len(BANDS))), f"{c[-1]:.0f}", told)
        for quantity, c in total.items()
        if c[-1]
    ]


def _inside(counts: FloatArray, i: int) -> str:
    """Share inside one band, bold where it is not what is wanted, with its interval (Wilson 1927)."""
    n, share, (low, high) = counts[-1] / PHASES, counts[i] / counts[-1], WANTED.get(list(BANDS)[i], (0.0, 1.0))
    middle = (share + 0.5 * Z95**2 / n) / (1.0 + Z95**2 / n)
    half = Z95 * np.sqrt(share * (1.0 - share) / n + 0.25 * Z95**2 / n**2) / (1.0 + Z95**2 / n)
    text = f"{100.0 * share:.0f}"
    text = text if low <= share <= high else f"**{text}**"
    return f"{text} [{100.0 * (middle - half):.0f}, {100.0 * (middle + half):.0f}]"


# --- The command


def main() -> None:
    """Runs the sets that were asked for, or all, prints them and writes the page from all results so far."""
    asked = options(__doc__, words=", ".join(SETS), others=False, bands=False)
    if unknown := [n for n in asked.words if n not in SETS]:
        sys.exit(f"no set called {unknown[0]}; there are {', '.join(SETS)}")
    if asked.bands:
        rows = [bands(name, SETS[name], asked.data) for name in asked.words or SETS if SETS[name].unseen]
        told = (
            f"`make bands`: files of `diagnose`, scored {SOON:g} s ahead on flights that were not fitted, from the "
            "filtered state and the logged rotor speeds. Random forces are those of the file; sensor noise, trim and "
            "biases come from the first third of each flight, outcomes from the rest. Brackets: 95 % interval, "
            f"predictions as if one in {PHASES} were independent; bold: outside what is wanted (50 % bands 40 to 60, "
            "95 % bands 90 to 99). Last column: what the findings take off the squared missing force and moment there."
        )
        put(asked, "bands.md", "Bands of predictions", "bands", [told, "", *table(BANDS_HEADS, chain(*rows))])
        return
    kept = (asked.out or Path("docs/results")) / "foreign.json"
    known = json.loads(kept.read_text()) if kept.exists() else {}
    if asked.others:
        known[NUMBERS] = [dataclasses.asdict(n) for n in (*of_rotorpy(), *of_cases())]
    for name in asked.words or ([] if asked.others else SETS):
        row = measured(SETS[name], asked.data)
        known[name] = dataclasses.asdict(row)
        print(page({name: row}), flush=True)
        kept.write_text(json.dumps(known, indent=1) + "\n")
    kept.write_text(json.dumps(known, indent=1) + "\n")
    sets = {n: Row(**known[n]) for n in SETS if n in known}
    numbers = [Number(**n) for n in known.get(NUMBERS, [])]
    kept.with_suffix(".md").write_text(page(sets, NOTES.read_text(), numbers))


if __name__ == "__main__":
    main()
