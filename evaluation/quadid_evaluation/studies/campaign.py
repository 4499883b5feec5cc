"""Blinded campaign: hides effects in flown data, lets the diagnosis look at the log alone, and grades the answer.

    python -m quadid_evaluation.studies.campaign --out docs/results
    python -m quadid_evaluation.studies.campaign --groups cases:12,cases_hub:12

Every case is decided by its class and number alone.  The diagnosis gets windows and a vehicle file with a poor guess;
what was hidden never reaches it.  `cases` and `cases_hub` are flights of simulators written by others, `recorded` the
sets of `quadid_evaluation.studies.flight_sets`.
"""

import datetime
import json
import time
import zlib
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

import quadid
from quadid.data.window import Window
from quadid.diagnosis import Diagnosis, Search, diagnose
from quadid.diagnosis.evidence import block_deviance
from quadid.diagnosis.hypotheses import Start, candidates, extend, fit_model
from quadid.effects import EFFECTS
from quadid.errors import QuadidError
from quadid.flight import OUTSIDE, FlightError, draw_effect, draw_outside, draw_truth, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Command, Vehicle
from quadid_evaluation.harness import DATA, keep, kept, options, pooled, share, table
from quadid_evaluation.studies.flight_sets import SETS, of_set
from quadid_evaluation.studies.truth import with_values

# --- The cases


GUESS = 0.2
"""Standard deviation of the logarithm of the initial guess against the truth."""
GUSTS = {"gusts": {"push": 0.6, "turn": 1.0, "time": 0.5}}
"""Forces of 0.6 m/s^2, moments of 1 rad/s^2: a quarter of the control moment of these flights."""
LATER = (
    "translational_lift",
    "supply_voltage",
    "rotor_telemetry_delay",
    "drag_torque_curve",
    "no_gyroscopic_coupling",
    "velocity_scale",
)
"""Effects that joined the catalogue when the numbers of the cases below were in use; a class of their own."""
INDEPENDENT, RECORDED = ("cases", "cases_hub"), "recorded"
"""Flights of simulators of others: rotors whose air acts at the centre of gravity, and at each hub; recorded ones."""
SINGLES = tuple(name for name in EFFECTS if name not in LATER)
PAIRS = (
    ("motor_lag", "rotor_drag"),
    ("cg_offset", "gyro_bias"),
    ("weak_rotor", "battery_sag"),
    ("motor_lag", "cg_offset"),
    ("command_delay", "imu_lever_arm"),
    ("mass_change", "rotor_drag"),
    ("accel_bias", "thrust_curve"),
    ("imu_misalignment", "motor_lag"),
    ("rate_damping", "cg_offset"),
    ("product_of_inertia", "attitude_delay"),
)
LOOK_ALIKES = (
    ("motor_lag", "command_delay"),
    ("weak_rotor", "cg_offset"),
    ("rotor_drag", "accel_bias"),
    ("mass_change", "battery_sag"),
    ("imu_lag", "motor_lag"),
    ("attitude_delay", "gyro_scale"),
)


@dataclass(frozen=True)
class Case:
    """One blinded case: what is hidden and how it is flown.

    Attributes:
        number: within its class; the name of a recorded set.
        hidden: effects with their numbers; expected: those that an answer has to name.
    """

    group: str
    number: int | str
    hidden: dict[str, dict[str, float]] = field(default_factory=dict)
    expected: tuple[str, ...] = ()
    outside: dict[str, dict[str, float]] = field(default_factory=dict)
    vehicle: str = "pelican"
    seconds: float = 120.0

    @property
    def seed(self) -> int:
        """Seed of the flight and of the diagnosis; 0 for flights of others."""
        if self.group in (*INDEPENDENT, RECORDED):
            return 0
        return zlib.crc32(f"{self.group}/{self.number}".encode()) % 2**31


def cases(group: str, count: int, start: int = 0) -> list[Case]:
    """Returns cases `start` to `start + count` of one class."""
    if group == RECORDED:
        return [Case(group, name) for name in SETS][start : start + count]
    if group in INDEPENDENT:
        return [independent(group, answer) for answer in answers(group)[start : start + count]]
    return [_case(group, n) for n in range(start, start + count)]


def case(name: str) -> Case:
    """One case by class and number, or name: ``single 7000``, ``cases 12``, ``recorded iris``."""
    group, _, number = name.partition(" ")
    if group in (*INDEPENDENT, RECORDED):
        return next(c for c in cases(group, len(SETS)) if str(c.number) == number)
    return _case(group, int(number))


@cache
def answers(folder: str) -> list[dict[str, Any]]:
    """The answer sheet of an independent simulator."""
    return list(json.loads((DATA / folder / "answers.json").read_text(encoding="utf-8")))


def independent(folder: str, answer: dict[str, Any]) -> Case:
    """A case of an independent simulator; what is hidden amid clutter is the large effect."""
    expected, kind = tuple(answer["effects"]), answer["kind"]
    hidden = answer["truth"] if kind == "clutter" else {n: answer["truth"].get(n, {}) for n in expected}
    return Case(folder, int(answer["case"].removeprefix("case_")), hidden, expected)


def _case(group: str, n: int) -> Case:
    vehicle = "pelican_x" if n % 3 == 2 else "pelican"
    craft, blank = Vehicle.shipped(vehicle), Case(group, n, vehicle=vehicle)
    if group in ("single", "rough", "short"):
        names: Sequence[str] = (SINGLES[n % len(SINGLES)],)
    elif group == "later":
        names = (LATER[n % len(LATER)],)
    elif group in ("pair", "look_alike"):
        pool = PAIRS if group == "pair" else LOOK_ALIKES
        names = pool[n % len(pool)]
    elif group == "null":
        return blank
    elif group == "outside":
        name = sorted(OUTSIDE)[n % len(OUTSIDE)]
        return replace(blank, outside={name: draw_outside(name, n)})
    elif group == "clutter":
        # Every effect at a twentieth; what is invisible without a companion is drawn with it, both at full size.
        small = [name for name in SINGLES if name not in ("mass_change", "thrust_drop", "ground_effect", "wind")]
        hidden = {name: draw_effect(name, n + 1000 * SINGLES.index(name), 0.05, craft)[name] for name in small}
        large = draw_effect(SINGLES[n % len(SINGLES)], n, 1.0, craft, 120.0)
        return replace(blank, hidden=hidden | large, expected=tuple(large))
    else:
        raise ValueError(f"unknown class '{group}'")
    seconds = 60.0 if group == "short" else 120.0
    drawn = {k: v for name in names for k, v in draw_effect(name, n, 1.0, craft, seconds).items()}
    outside = GUSTS if group == "rough" else {}
    return replace(blank, hidden=drawn, expected=tuple(drawn), seconds=seconds, outside=outside)


GROUPS = {
    "single": 100,
    "null": 100,
    "pair": 30,
    "look_alike": 24,
    "outside": 48,
    "clutter": 50,
    "rough": 25,
    "later": 30,
}


def guessed_vehicle(case: Case, truth: dict[str, float]) -> Vehicle:
    """The vehicle file handed to the diagnosis: geometry and mass right, parameters a poor guess."""
    rng = np.random.default_rng([case.seed, 77])
    guesses = [float(f"{truth[n] * np.exp(GUESS * rng.uniform(-1.7, 1.7)):.3e}") for n in NOMINAL_NAMES]
    return with_values(shipped(case), np.array(guesses))


def needs(case: Case) -> set[str]:
    """Channels needed to see the case's effects; a log with position has velocity too."""
    found = {need for name in case.hidden for need in EFFECTS[name].needs}
    return found | ({"velocity"} if "position" in found else set())


def shipped(case: Case) -> Vehicle:
    """The vehicle of a case, with rotor speeds read back where an effect needs readings."""
    craft = Vehicle.shipped(case.vehicle)
    return craft.model_copy(update={"command": Command(sampling="instant")}) if "readings" in needs(case) else craft


def flown(case: Case) -> tuple[Window, Window, Vehicle]:
    """Flies the training and the validation flight of a case."""
    craft = shipped(case)
    truth = draw_truth(craft, case.seed)
    extras = tuple(sorted(needs(case) & {"velocity", "position", "battery"}))
    how: dict[str, Any] = {"effects": case.hidden, "outside": case.outside, "extras": extras}
    first, second = (fly(craft, truth, case.seconds, case.seed + 7919 * k, **how).window for k in range(2))
    return first, second, guessed_vehicle(case, truth.as_dict())


def given(case: Case) -> tuple[list[Window], list[Window], Vehicle]:
    """Windows to diagnose, windows to measure the gain on, and the vehicle as guessed."""
    if case.group == RECORDED:
        vehicle, train, held = SETS[str(case.number)].windows()
    elif case.group in INDEPENDENT:
        folder = DATA / case.group / f"case_{case.number:03d}"
        vehicle = Vehicle.named(folder / "vehicle.yaml")
        train, held = (list(quadid.load(folder / f"{log}.csv", vehicle).windows) for log in ("train", "validate"))
    else:
        one, other, vehicle = flown(case)
        train, held = [one], [other]
    return train, held, vehicle


# --- One case diagnosed, and graded against what was hidden and an oracle that knows the structure


WITH_ORACLE = ("single", "pair", "look_alike")
"""Classes in which the true structure is fitted too."""


@dataclass(frozen=True)
class Graded:
    """The answer to one case beside the truth.

    Attributes:
        verdict: of the diagnosis, or ``failed``.
        named: effects called confident; listed: all findings.
        right: all that was hidden and nothing else, `unknown` for the unknown; of recorded flights, no number called
            identified excludes what is known of the vehicle.
        values: found parameters by effect and name; intervals: their 95 % intervals.
        mse_nominal, mse_extended: in the segments that decided; mse_oracle: of the true structure fitted to the first
            flight; stated: the first two as `diagnose` states them.
        rest: structure left, as a share of the noise; follows: what it follows most, and where.
    """

    case: Case
    verdict: str = "failed"
    named: tuple[str, ...] = ()
    listed: tuple[str, ...] = ()
    right: bool = False
    values: dict[str, dict[str, float]] = field(default_factory=dict)
    intervals: dict[str, dict[str, tuple[float, float]]] = field(default_factory=dict)
    mse_nominal: float = float("nan")
    mse_extended: float = float("nan")
    mse_oracle: float | None = None
    stated: tuple[float, float] = (float("nan"), float("nan"))
    rest: float = 0.0
    follows: str = ""
    seconds: float = 0.0
    note: str = ""

    @property
    def first(self) -> str | None:
        """The first finding."""
        return self.listed[0] if self.listed else None


def run(case: Case) -> Graded:
    """Flies or reads, diagnoses and grades one case."""
    try:
        train, held, vehicle = given(case)
    except (FlightError, QuadidError) as error:
        return Graded(case, note=f"not flown: {error}")
    return grade(case, train, held, vehicle)


def grade(case: Case, train: Sequence[Window], held: Sequence[Window], vehicle: Vehicle) -> Graded:
    """Diagnoses and grades the windows of one case."""
    began = time.perf_counter()
    try:
        found, search = diagnose(train, vehicle, held, seed=case.seed)
    except QuadidError as error:
        return Graded(case, note=f"refused: {error}")
    seconds = time.perf_counter() - began
    return Graded(
        case,
        found.verdict.value,
        tuple(f.effect for f in found.findings if f.confident),
        tuple(f.effect for f in found.findings),
        right(case, found),
        {f.effect: {p.name: p.value for p in f.parameters} for f in found.findings},
        {f.effect: {p.name: p.ci95 for p in f.parameters} for f in found.findings},
        *found.validation.deciding,
        _oracle(case, search, held) if case.group in WITH_ORACLE else None,
        (found.validation.nominal, found.validation.extended),
        found.remainder.deviance / search.model.rows,
        next((f"{f.signal} at {f.site.name}" for f in found.remainder.followed), ""),
        seconds,
    )


def right(case: Case, found: Diagnosis) -> bool:
    """Checks whether an answer is right in full."""
    named = [f.effect for f in found.findings if f.confident]
    if case.group == RECORDED:
        numbers = of_set("", SETS[str(case.number)], {"": found.to_dict()})
        return all(n.inside for n in numbers if n.identified)
    if case.expected == ("unknown",):
        return found.verdict.value == "unknown"
    if case.outside and not case.hidden:
        return not named
    if len(case.hidden) > len(case.expected):  # amid clutter the large one comes first
        first = found.findings[0].effect if found.findings else None
        return first in case.expected and set(named) <= set(case.hidden)
    return set(named) == set(case.expected) and (bool(named) or found.verdict.value == "nothing_found")


def _oracle(case: Case, search: Search, held: Sequence[Window]) -> float:
    """Error on the second flight of the model with the true causes, each fitted from the truth's neighbourhood."""
    shooting, model = search.shooting, search.nominal
    listed = candidates(shooting.layout, shooting.has_velocity, shooting.channels >= 15)
    for effect, values in sorted(case.hidden.items(), key=lambda item: item[0] != "rotor_drag"):
        # From the true effect, and nominal parameters of the vehicle file.
        theta = np.asarray(model.theta).copy()
        shooting.layout.write_effects(theta, {effect: values})
        label = f"weak_rotor {round(values['rotor'])}" if effect == "weak_rotor" else effect
        cause = next(c for c in listed if c.label == label)
        model = extend(shooting, model, cause, Start(theta, model.states), 12)
    model = fit_model(shooting, model.theta, model.causes, model.states, 12)
    deviance, rows = block_deviance(shooting.on(held), model)
    return float(deviance.sum()) / rows


HEADS = ("case", "hidden", "found", "error on the unseen flight")


def row(g: Graded) -> tuple[str, ...]:
    """One answer as cells under `HEADS`; the verdict is left out where the cell contains it."""
    what = {n: g.case.hidden.get(n, {}) for n in g.case.expected} or g.case.outside
    hidden = ", ".join(" ".join([name, *(f"{k} {v:.4g}" for k, v in values.items())]) for name, values in what.items())
    found = ", ".join(
        " ".join([name, *(f"{values[k]:.4g}" for k in g.case.hidden.get(name, {}) if k in values)])
        for name, values in g.values.items()
    )
    verdict = "" if g.right and g.verdict in ("explained", "nothing_found") else f"{g.verdict}: "
    verdict = verdict if g.right else f"**wrong**, {verdict}"
    errors = f"{g.stated[0]:.3g} → {g.stated[1]:.3g}"
    return f"{g.case.group} {g.case.number}", hidden or "–", f"{verdict}{found or g.note or '–'}", errors


# --- Figures and page


GAIN_TO_COMPARE = 0.05
"""Gains of the oracle below this are too small for a ratio."""
NEAR = 0.05
"""Relative error below which an effect has no row of its own."""


def oracle_ratios(graded: Sequence[Graded]) -> list[float]:
    """Gain of the extended model over that of the oracle, on the flight not used, where there is a gain to speak of."""
    return [
        (g.mse_nominal - g.mse_extended) / (g.mse_nominal - g.mse_oracle)
        for g in graded
        if g.mse_oracle is not None and g.mse_nominal - g.mse_oracle > GAIN_TO_COMPARE
    ]


def write(graded: Sequence[Graded], folder: Path, command: str) -> Path:
    """Writes `diagnosis.md` and its picture into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = {g.case.group: [x for x in graded if x.case.group == g.case.group] for g in graded}
    lines = [
        "# Diagnosis: blinded campaign",
        "",
        f"{len(graded)} cases, `{command}`, {datetime.date.today().isoformat()}. Class and number of a case are its "
        "seed. Flights of 120 s; intervals in brackets are exact 95 % binomial ones.",
        "",
        "## By class",
        "",
        *table(
            ("class", "all found", "nothing else named", "correct", "verdicts", "median [s]"),
            [_class(name, part) for name, part in groups.items()],
        ),
        "",
        "Correct: exactly the hidden effects are named; nothing on a null; no confident name for an effect outside "
        "the catalogue; in clutter (every effect at a twentieth of its size, one large) the large one first.",
        "",
    ]
    if singles := groups.get("single", []):
        ratios = {name: found for name, part in groups.items() if (found := oracle_ratios(part))}
        told = "; ".join(f"{n} {np.median(r):.3f} ({min(r):.3f}), {len(r)} cases" for n, r in ratios.items())
        confusion(singles, folder / "diagnosis-confusion.png")
        lines += [
            "## Parameters of the effects",
            "",
            f"Effects always found within {NEAR:.0%}, at most one number outside its interval, are left out.",
            "",
            *_parameters(singles),
            "",
            "## Gain on an unseen flight, relative to the true structure",
            "",
            f"Median (worst): {told}.",
            "",
            "## First finding",
            "",
            "![Hidden effect against first finding](diagnosis-confusion.png)",
            "",
        ]
    wrong = [g for g in graded if not g.right]
    page = folder / "diagnosis.md"
    lines += [f"## Wrong answers ({len(wrong)})", "", *table(HEADS, map(row, wrong))]
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return page


def _class(name: str, graded: Sequence[Graded]) -> tuple[str, ...]:
    found = sum(set(g.case.expected) <= set(g.named) for g in graded)
    alone = sum(all(n in g.case.hidden for n in g.named) for g in graded)
    return (
        name,
        "–" if name in ("null", "outside") else f"{found} of {len(graded)}",
        f"{alone} of {len(graded)}",
        share(sum(g.right for g in graded), len(graded)),
        ", ".join(f"{verdict} {count}" for verdict, count in Counter(g.verdict for g in graded).most_common()),
        f"{np.median([g.seconds for g in graded]):.1f}",
    )


def _parameters(singles: Sequence[Graded]) -> list[str]:
    """Errors |found - hidden| / |hidden| of each hidden effect that was found; how often intervals hold the truth."""
    errors, inside = dict[str, list[float]](), dict[str, list[bool]]()
    for g in singles:
        for effect in g.values.keys() & set(g.case.expected):
            truth = {n: v for n, v in g.case.hidden[effect].items() if n not in ("rotor", "time")}
            off = [g.values[effect].get(n, np.nan) - v for n, v in truth.items()]
            errors.setdefault(effect, []).append(float(np.linalg.norm(off) / np.linalg.norm([*truth.values()])))
            held = [low <= truth[n] <= high for n, (low, high) in g.intervals[effect].items() if n in truth]
            inside.setdefault(effect, []).extend(held)

    def cells(sizes: Sequence[float]) -> tuple[str, str, str]:
        return str(len(sizes)), f"{100 * np.median(sizes):.1f}", f"{100 * max(sizes):.1f}"

    rows = [
        (effect, *cells(errors[effect]), f"{sum(inside[effect])} of {len(inside[effect])}")
        for effect in EFFECTS
        if effect in errors and (max(errors[effect]) >= NEAR or sum(inside[effect]) + 1 < len(inside[effect]))
    ]
    every, held = [e for sizes in errors.values() for e in sizes], [h for some in inside.values() for h in some]
    rows.append(("**all**", *cells(every), share(sum(held), len(held))))
    return table(("effect", "found", "median error %", "largest error %", "truth in the 95 % interval"), rows)


def confusion(singles: Sequence[Graded], path: Path) -> None:
    """Draws hidden effect against first finding."""
    hidden = list(EFFECTS)
    named = [*EFFECTS, "unknown", "nothing_found"]
    counts = np.zeros((len(hidden), len(named)))
    for g in singles:
        own = [e for e in g.case.expected if e != "rotor_drag"] or list(g.case.expected)
        said = own[0] if g.first in g.case.expected else (g.first if g.named else g.verdict)
        counts[hidden.index(own[0]), named.index(said if said in named else "unknown")] += 1
    figure, axes = plt.subplots(figsize=(11, 9.5), layout="constrained")
    axes.imshow(counts, cmap="Blues", vmin=0, vmax=max(counts.max(), 1))
    for i, j in np.argwhere(counts > 0):
        colour = "white" if counts[i, j] > 0.6 * counts.max() else "black"
        axes.text(j, i, f"{counts[i, j]:.0f}", ha="center", va="center", color=colour, fontsize=8)
    axes.set_xticks(range(len(named)), named, rotation=90, fontsize=8)
    axes.set_yticks(range(len(hidden)), hidden, fontsize=8)
    axes.set_xlabel("named first")
    axes.set_ylabel("hidden")
    figure.savefig(path, dpi=110)
    plt.close(figure)


# --- The command


def answered(wanted: Iterable[Case], records: Path | None, processes: int) -> list[Graded]:
    """Answers to cases, those of an earlier run from its records; each new one is printed and kept."""
    have = {(g.case.group, g.case.number): g for g in kept(records, Graded)}

    def told(found: Graded) -> None:
        keep(records, found)
        have[found.case.group, found.case.number] = found
        print(*table(HEADS, [row(found)])[2:], f"{found.seconds:.1f} s {found.note}", flush=True)

    pooled(run, [c for c in wanted if (c.group, c.number) not in have], processes, told)
    return [have[c.group, c.number] for c in wanted]


if __name__ == "__main__":
    asked = options(__doc__, groups=",".join(GROUPS), count=0, start=0, processes=2, records="")
    parts = [group.partition(":") for group in asked.groups.split(",")]
    wanted = [c for name, _, n in parts for c in cases(name, int(n or asked.count or GROUPS[name]), asked.start)]
    graded = answered(wanted, Path(asked.records) if asked.records else None, asked.processes)
    for name, *_ in parts:
        mine = [g.right for g in graded if g.case.group == name]
        print(f"{name}: {sum(mine)} of {len(mine)} right", flush=True)
    if asked.out is not None:
        command = f"--start {asked.start} --groups {asked.groups} --out docs/results"
        print(write(graded, asked.out, f"python -m quadid_evaluation.studies.campaign {command}"))
