"""Blinded campaign: hides effects in flown data, lets the diagnosis look at the log alone, and grades the answer.

    python -m quadid_evaluation.studies.campaign --out docs/results

Every case is decided by its class and number alone.  The diagnosis gets windows and a vehicle file with a poor guess;
what was hidden never reaches it.
"""

import datetime
import json
import multiprocessing
import time
import zlib
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt
import numpy as np

from quadid.data.window import Window
from quadid.diagnosis import Search, diagnose
from quadid.diagnosis.evidence import block_deviance
from quadid.diagnosis.hypotheses import Model, Start, candidates, extend, fit_model
from quadid.effects import EFFECTS
from quadid.errors import QuadidError
from quadid.flight import OUTSIDE, FlightError, draw_effect, draw_outside, draw_truth, fly
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Command, Vehicle
from quadid_evaluation.harness import options, share, table
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
    if group in ("single", "rough", "noisy", "short", "weak"):
        name = SINGLES[n % len(SINGLES)]
        hidden = draw(name, seconds=60.0 if group == "short" else 120.0)
        changed: dict[str, dict[str, Any]] = {
            "rough": {"outside": GUSTS},
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
    if group == "later":
        hidden = draw(LATER[n % len(LATER)])
        return replace(blank, hidden=hidden, expected=tuple(hidden))
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
        # What is invisible without a companion is drawn with it, both at full size.
        hidden.update(draw(large))
        return replace(blank, hidden=hidden, expected=tuple(draw(large)))
    raise ValueError(f"unknown class '{group}'")


GROUPS = {
    "single": 100,
    "null": 100,
    "pair": 30,
    "look_alike": 24,
    "outside": 48,
    "clutter": 50,
    "rough": 25,
    "noisy": 25,
    "short": 25,
    "weak": 25,
    "size_0.3": 25,
    "size_0.1": 25,
    "size_0.03": 25,
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
    windows = []
    for k in range(2):
        flight = fly(
            craft,
            truth,
            case.seconds,
            case.seed + 7919 * k,
            case.profile,
            effects=case.hidden,
            outside=case.outside,
            noise_scale=case.noise_scale,
            extras=extras,
        )
        windows.append(flight.window)
    return windows[0], windows[1], guessed_vehicle(case, truth.as_dict())


# --- One case flown, diagnosed, and graded against what was hidden and an oracle that knows the structure


WITH_ORACLE = ("single", "pair", "look_alike")
"""Classes in which the true structure is fitted too."""


@dataclass(frozen=True)
class Graded:
    """The answer to one case beside the truth.

    Attributes:
        verdict: of the diagnosis, or ``failed``.
        named: effects called confident; listed: all findings; first: the first of them.
        values: found parameters by effect and name; intervals: their 95 % intervals.
        mse_nominal, mse_extended: on the second flight; mse_oracle: of the true structure fitted to the first.
        rest: structure left, as a share of the noise.
    """

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


def run(case: Case) -> Graded:
    """Flies, diagnoses and grades one case."""
    try:
        train, validate, vehicle = flown(case)
    except (FlightError, QuadidError) as error:
        return _failed(case, f"not flown: {error}")
    began = time.perf_counter()
    try:
        found, search = diagnose([train], vehicle, [validate], seed=case.seed)
    except QuadidError as error:
        return _failed(case, f"refused: {error}")
    seconds = time.perf_counter() - began
    oracle = _oracle(case, search, validate) if case.group in WITH_ORACLE else None
    return Graded(
        case,
        found.verdict.value,
        tuple(f.effect for f in found.findings if f.confident),
        tuple(f.effect for f in found.findings),
        found.findings[0].effect if found.findings else None,
        {f.effect: {p.name: p.value for p in f.parameters} for f in found.findings},
        {f.effect: {p.name: p.ci95 for p in f.parameters} for f in found.findings},
        *found.validation.deciding,
        oracle,
        found.remainder.deviance / search.model.rows,
        seconds,
    )


def _failed(case: Case, note: str) -> Graded:
    return Graded(case, "failed", (), (), None, {}, {}, float("nan"), float("nan"), None, 0.0, 0.0, note)


def _oracle(case: Case, search: Search, validate: Window) -> float:
    """Error on the second flight of the model with the true causes, each fitted from the truth's neighbourhood."""
    shooting = search.shooting
    listed = candidates(shooting.layout, shooting.has_velocity, shooting.channels >= 15)
    model: Model = search.nominal
    for effect, values in sorted(case.hidden.items(), key=lambda item: item[0] != "rotor_drag"):
        # From the true effect, and nominal parameters of the vehicle file.
        theta = np.asarray(model.theta).copy()
        shooting.layout.write_effects(theta, {effect: values})
        start = Start(theta, model.states)
        label = f"weak_rotor {round(values['rotor'])}" if effect == "weak_rotor" else effect
        model = extend(shooting, model, next(c for c in listed if c.label == label), start, 12)
    model = fit_model(shooting, model.theta, model.causes, model.states, 12)
    deviance, rows = block_deviance(shooting.on([validate]), model)
    return float(deviance.sum()) / rows


def right(g: Graded) -> bool:
    """Checks whether the answer is right in full: all that was hidden, nothing else; `unknown` for the unknown."""
    group = g.case.group
    if group == "null":
        return g.verdict == "nothing_found"
    if group == "outside":
        return not g.named and g.verdict != "failed"
    if group == "clutter":
        return g.first in g.case.expected and all(n in g.case.hidden for n in g.named)
    return set(g.named) == set(g.case.expected)


def line(g: Graded) -> str:
    """One answer on a line, for the log of a campaign."""
    what = g.case.expected if g.case.group == "clutter" else g.case.hidden or g.case.outside
    return (
        f"{'right' if right(g) else 'WRONG'} {g.seconds:.1f} s {g.case.group} {g.case.number} {g.case.vehicle} "
        f"{g.verdict} {list(g.listed)} hidden {what} mse {g.mse_nominal:.3f} -> {g.mse_extended:.3f} "
        f"rest {g.rest:.3f} {g.note}"
    )


# --- Figures and page


GAIN_TO_COMPARE = 0.05
"""Gains of the oracle below this are too small for a ratio."""
NEAR = 0.05
"""Relative error below which an effect has no row of its own."""


def parameter_errors(graded: Sequence[Graded]) -> dict[str, list[float]]:
    """Relative error of each hidden effect found, as a vector: |found - hidden| / |hidden|, by effect."""
    out: dict[str, list[float]] = {}
    for g in graded:
        for effect in g.case.expected:
            if effect not in g.values:
                continue
            names = [n for n in g.case.hidden[effect] if n not in ("rotor", "time")]
            found = np.array([g.values[effect].get(n, np.nan) for n in names])
            truth = np.array([g.case.hidden[effect][n] for n in names])
            out.setdefault(effect, []).append(float(np.linalg.norm(found - truth) / np.linalg.norm(truth)))
    return out


def coverage(graded: Sequence[Graded]) -> dict[str, tuple[int, int]]:
    """Number of times that the 95 % interval of a found effect's own parameters holds the truth, by effect."""
    inside: dict[str, list[bool]] = {}
    for g in graded:
        for effect in g.case.expected:
            for name, (low, high) in g.intervals.get(effect, {}).items():
                if name in ("rotor", "time") or name not in g.case.hidden[effect]:
                    continue
                inside.setdefault(effect, []).append(bool(low <= g.case.hidden[effect][name] <= high))
    return {effect: (sum(v), len(v)) for effect, v in inside.items()}


def oracle_ratios(graded: Sequence[Graded]) -> list[float]:
    """Gain of the extended model over that of the oracle, on the flight not used, where there is a gain to speak of."""
    return [
        (g.mse_nominal - g.mse_extended) / (g.mse_nominal - g.mse_oracle)
        for g in graded
        if g.mse_oracle is not None and g.mse_nominal - g.mse_oracle > GAIN_TO_COMPARE
    ]


def write(graded: Sequence[Graded], folder: Path, command: str) -> Path:
    """Writes `diagnosis.md` and its pictures into `folder`; returns the page."""
    folder.mkdir(parents=True, exist_ok=True)
    groups = {g.case.group: [x for x in graded if x.case.group == g.case.group] for g in graded}
    lines = [
        "# Diagnosis: blinded campaign",
        "",
        f"{len(graded)} cases, `{command}`, {datetime.date.today().isoformat()}. Class and number of a case are its "
        "seed. Flights of 120 s unless said otherwise; intervals in brackets are exact 95 % binomial ones.",
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
    singles = groups.get("single", [])
    if singles:
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
    sizes = {float(k.split("_")[1]): v for k, v in groups.items() if k.startswith("size_")}
    if sizes:
        detection({**sizes, 1.0: singles}, folder / "diagnosis-detection.png")
        lines += ["## How small an effect is found", "", "![Detection curve](diagnosis-detection.png)", ""]
    wrong = [g for g in graded if not right(g)]
    lines += [f"## Wrong answers ({len(wrong)})", "", *(f"* {_told(g)}" for g in wrong)]
    page = folder / "diagnosis.md"
    page.write_text("\n".join(lines) + "\n", encoding="utf-8")
    return page


def _class(name: str, graded: Sequence[Graded]) -> tuple[str, ...]:
    found = sum(set(g.case.expected) <= set(g.named) for g in graded)
    alone = sum(all(n in g.case.hidden for n in g.named) for g in graded)
    return (
        name,
        "–" if name in ("null", "outside") else f"{found} of {len(graded)}",
        f"{alone} of {len(graded)}",
        share(sum(map(right, graded)), len(graded)),
        ", ".join(f"{verdict} {count}" for verdict, count in Counter(g.verdict for g in graded).most_common()),
        f"{np.median([g.seconds for g in graded]):.1f}",
    )


def _parameters(singles: Sequence[Graded]) -> list[str]:
    errors, inside = parameter_errors(singles), coverage(singles)
    rows = [
        (effect, *_sizes(values), f"{inside[effect][0]} of {inside[effect][1]}" if effect in inside else "–")
        for effect, values in errors.items()
        if not (max(values) < NEAR and effect in inside and inside[effect][0] + 1 >= inside[effect][1])
    ]
    held, total = (sum(pair[k] for pair in inside.values()) for k in (0, 1))
    rows.append(("**all**", *_sizes([e for v in errors.values() for e in v]), share(held, total)))
    return table(("effect", "found", "median error %", "largest error %", "truth in the 95 % interval"), rows)


def _sizes(errors: Sequence[float]) -> tuple[str, str, str]:
    """Cells of a table: how many relative errors, the middle one, the largest."""
    return str(len(errors)), f"{100 * np.median(errors):.1f}", f"{100 * max(errors):.1f}"


def _told(g: Graded) -> str:
    """A wrong answer in words; the sizes of what was hidden follow from its class and number."""
    hidden = ", ".join(g.case.hidden or g.case.outside)
    said = ", ".join(g.listed) or g.note or "nothing"
    return (
        f"{g.case.group} {g.case.number}, {g.case.vehicle}: hidden {hidden}; {g.verdict}: {said}; error "
        f"{g.mse_nominal:.3g} → {g.mse_extended:.3g}"
    )


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


def detection(sizes: dict[float, list[Graded]], path: Path) -> None:
    """Draws the share found and the share of wrong names against the size of the effect."""
    figure, axes = plt.subplots(figsize=(7, 4), layout="constrained")
    scales = sorted(s for s in sizes if sizes[s])
    found = [np.mean([set(g.case.expected) <= set(g.named) for g in sizes[s]]) for s in scales]
    wrong = [np.mean([any(n not in g.case.hidden for n in g.named) for g in sizes[s]]) for s in scales]
    axes.semilogx(scales, found, "o-", label="found and named")
    axes.semilogx(scales, wrong, "s--", label="something else named")
    axes.set_xticks(scales, [f"{s:g}" for s in scales])
    axes.set_xlabel("size of the effect, realistic size = 1")
    axes.set_ylabel("share of cases")
    axes.set_ylim(-0.03, 1.03)
    axes.grid(alpha=0.3)
    axes.legend()
    figure.savefig(path, dpi=110)
    plt.close(figure)


# --- The command


def kept(records: Path) -> list[Graded]:
    """Answers of an earlier run of the same code, the latest to each case."""
    out = {}
    for text in records.read_text(encoding="utf-8").splitlines():
        data = json.loads(text)
        case = Case(**{**data.pop("case")})
        data["intervals"] = {e: {n: tuple(v) for n, v in p.items()} for e, p in data["intervals"].items()}
        case = Case(**{**asdict(case), "expected": tuple(case.expected)})
        graded = Graded(case, **{**data, "named": tuple(data["named"]), "listed": tuple(data["listed"])})
        out[case.group, case.number] = graded
    return list(out.values())


def main() -> None:
    """Runs the classes asked for, goes on where `--records` stopped, and writes the page."""
    given = options(__doc__, groups=",".join(GROUPS), count=0, start=0, processes=2, records="")
    records = Path(given.records) if given.records else None
    graded = kept(records) if records is not None and records.exists() else []
    with multiprocessing.get_context("spawn").Pool(given.processes) as pool:
        for group in given.groups.split(","):
            name, _, count = group.partition(":")
            have = {(g.case.group, g.case.number) for g in graded}
            wanted = cases(name, int(count or given.count or GROUPS[name]), given.start)
            for found in pool.imap(run, [c for c in wanted if (c.group, c.number) not in have]):
                print("   ", line(found), flush=True)
                graded.append(found)
                if records is not None:
                    with records.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(asdict(found), default=float) + "\n")
            mine = [g for g in graded if g.case.group == name]
            print(f"{name}: {sum(map(right, mine))} of {len(mine)} right", flush=True)
    if given.out is not None:
        command = f"--start {given.start} --groups {given.groups} --out docs/results"
        print(write(graded, given.out, f"python -m quadid_evaluation.studies.campaign {command}"))


if __name__ == "__main__":
    main()
