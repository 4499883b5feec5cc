"""Worth of each rule and number of the diagnosis: what changes without it, or with half and twice it.

    QUADID_DATA=../shared/data python -m quadid_evaluation.studies.ablation --out docs/results

A stopped run goes on from `--records`; `--recorded` runs nothing; `--cache` keeps flights once flown.  `--flights` and
`--only` (words of variants) go by commas.
"""

from __future__ import annotations

import ast
import datetime
import hashlib
import importlib
import inspect
import io
import json
import math
import pickle
import pkgutil
import re
import sys
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import quadid
import quadid.diagnosis
from quadid.data.window import Window
from quadid.diagnosis import diagnose
from quadid.diagnosis.evidence import stated_errors
from quadid.diagnosis.hypotheses import RELEVANT, Model, candidates, fit_model, paired_gain
from quadid.diagnosis.pipeline import SHARE_TO_NAME
from quadid.diagnosis.search import LINEAR_MISFIT
from quadid.errors import QuadidError
from quadid.identification.fit import flexible_fit
from quadid.identification.problem import Shooting
from quadid.model.rollout import Rollout
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import DATA, Given, options
from quadid_evaluation.studies.campaign import Case, cases, flown
from quadid_evaluation.studies.flight_sets import SETS, FlightSet
from quadid_evaluation.studies.foreign import of_set
from quadid_evaluation.studies.house import named_numbers

# --- What is changed: every number left out, halved and doubled, every rule left out


@dataclass(frozen=True)
class Variant:
    """One change of the method.

    Attributes:
        name: for the page; subject: the rule or number that it changes; scaled: a number is halved or doubled.
        values: what replaces what, by name of an attribute of a module, or of a class there (`Class.name`).
    """

    name: str
    subject: str
    values: dict[str, Any]
    scaled: bool = False

    @contextmanager
    def in_force(self) -> Iterator[None]:
        """Within it every module of the diagnosis that knows one of the names has the other value."""
        changed: list[tuple[Any, str, Any]] = []
        try:
            for module in modules():
                for path, value in self.values.items():
                    owner, _, name = path.rpartition(".")
                    place = getattr(module, owner, None) if owner else module
                    if place is not None and hasattr(place, name) and getattr(place, name) is not value:
                        changed.append((place, name, getattr(place, name)))
                        setattr(place, name, value)
            if self.values and not changed:
                raise LookupError(f"no module of quadid.diagnose has {', '.join(self.values)}")
            yield
        finally:
            for place, name, value in reversed(changed):
                setattr(place, name, value)


def modules() -> list[ModuleType]:
    """All modules of the diagnosis."""
    found = pkgutil.iter_modules(quadid.diagnosis.__path__, "quadid.diagnosis.")
    return [importlib.import_module(m.name) for m in found]


def numbers() -> dict[str, Any]:
    """Named numbers of the diagnosis, or tuples of such, by name."""
    trees = (ast.parse(inspect.getsource(m)) for m in modules())
    names = [name for tree in trees for name in named_numbers(tree)]
    return {name: getattr(m, name) for m in modules() for name in names if hasattr(m, name)}


def variants() -> list[Variant]:
    """The method as it is (`base`), without each rule, and without, with half and with twice each number."""
    out = [Variant("base", "base", {}), *(Variant(f"without {name}", name, values) for name, values in RULES.items())]
    for name, value in numbers().items():
        out += [Variant(f"{name} out", name, {name: OUT[name]})] if name in OUT else []
        out += [Variant(f"{name} × {f:g}", name, {name: _times(value, f)}, scaled=True) for f in (0.5, 2.0)]
    return out


def _times(value: Any, factor: float) -> Any:
    """A number or tuple of numbers times `factor`; what counts something stays whole."""
    if isinstance(value, tuple):
        return tuple(factor * v for v in value)
    return max(round(factor * value), 1) if isinstance(value, int) else factor * value


def _given(value: Any) -> Callable[..., Any]:
    """A function that gives `value` whatever it is asked."""
    return lambda *_, **__: value


def _none(*_: object, **__: object) -> Iterator[Any]:
    return iter(())


def _unpruned(shooting: object, model: Any) -> Any:
    return model


def _same_noise(windows: object, short: Any, model: object) -> Any:
    return short.noise


def _nominal(shooting: Shooting, *_: object) -> Model:
    return fit_model(shooting, shooting.layout.initial(shooting.vehicle), ())


def _gains(small: Model, large: Model) -> bool:
    return paired_gain(small.held_out, large.held_out).total > RELEVANT * small.rows


def _regains(score: Any, cause: Any, regains: bool) -> bool:
    return regains and score.candidate.effect != cause.effect


def _unpaired(*given: Any) -> Any:
    return [c for c in candidates(*given) if not c.split]


def _unrefined(*given: Any) -> Any:
    return [c for c in candidates(*given) if not c.refines]


def _as_scanned(shooting: object, model: Any, candidate: object) -> Any:
    return model


def _uncontradicted(*given: Any) -> Any:
    return replace(stated_errors(*given), contradicted=False)


def _as_fitted(parameters: Any) -> Any:
    return parameters, None


def _first_guess(*given: Any, **more: Any) -> Any:
    return flexible_fit(*given[:2], given[2][:1], given[3], given[1].noise, **more)


RULES: dict[str, dict[str, Any]] = {
    "swaps": {"_swaps": _none},
    "swaps within a family": {"_rivals": _regains},
    "impossible numbers": {"impossible_causes": _given({})},
    "constancy of a bias": {"inconstant_causes": _given({})},
    "calibration (Godambe)": {"calibration": _given(1.0)},
    "use on held-out blocks": {"relevant": _given(True)},
    "use without the best block": {"relevant": _gains},
    "a last pruning": {"pruned": _unpruned},
    "noise around the causes": {"_noise_around": _same_noise},
    "a start from everything": {"from_everything": _nominal},
    "two starts of the flexible fit when far": {"flexible_fit": _first_guess},
    "what the fit left undone, in scores": {"Everything._unspent": _given(0.0)},
    "causes that show only in pairs": {"candidates": _unpaired},
    "optional numbers of a cause": {"candidates": _unrefined},
    "onset refined": {"_refine_time": _as_scanned},
    "a look at the longest segments": {"Stage.longest": _given(None)},
    "longest segments where velocity is found": {"is_long": _given(False)},
    "ordinary sizes last": {"ordinary": _given(False)},
    "contradiction by unseen data": {"stated_errors": _uncontradicted},
    "what the rest follows": {"follows": _given(())},
    "numbers by the likelihood of innovations": {"fit_numbers": _given(None)},
    "moments that a rigid body can have": {"possible_moments": _as_fitted},
    "slight steps and winds": {"slight_causes": _given({})},
    "lags beside unreliable inertias": {"late_unknown": _given({})},
}
"""Rules that are functions, and what stands in their place."""
OUT: dict[str, Any] = {
    "UNTIDY": 0.0, "BLOCKS": 2, "STEP_SIGMA": 0.0, "TIME_SIGMA": 0.0, "FALSE_ALARM": 1.0, "RELEVANT": 0.0,
    "NOISE_FELL": 0.0, "SHARE_TO_NAME": 0.0, "SHARE_ALONE": SHARE_TO_NAME,
    "LEAST_STRUCTURE": 0.0, "LEAST_OF_EXPLAINED": 0.0, "LIKELY_SENSOR": math.inf, "WRONG_SIGN": 0.0, "ERRORS": 0.0,
    "WAVES": 0, "ALARM": math.inf, "_RIDGE": 0.0,
    "CHANGE_SHARE": 0.0, "LINEAR_MISFIT": math.inf, "CLEAN_MISFIT": LINEAR_MISFIT, "NEAR": 1.0, "ALIKE": 1.0,
    "MOST_REFITS": 1000,
}  # fmt: skip
"""Value that stands for a number that is left out; numbers that have no such value are halved and doubled only."""


# --- The flights: hidden effects of the campaign, independent cases, recorded and foreign flights


SCALED = (
    "single 7000",
    "single 7006",
    "single 7008",
    "single 7009",
    "null 7000",
    "pair 7001",
    "look_alike 7000",
    "look_alike 7003",
    "outside 7000",
)
"""Flights on which numbers are halved and doubled too: one of each kind, which compute fast."""
FLIGHTS = (
    *SCALED, "outside 7002", "outside 7003", "outside 7007", "outside 7012", "outside 7021", "single 1055",
    "single 1083", "single 8005", "look_alike 15", "outside 1029", "clutter 2005", "clutter 2019", "cases case_012",
    "cases_hub case_002", "cases_hub case_006", "iris", "arpl", "sitl square", "brushed rpm", "crazyflie",
)  # fmt: skip
"""Flights of a run where nothing else is asked for: besides those, flights that rules were once made for."""
Windows = tuple[list[Window], list[Window], Vehicle]
"""Windows to diagnose, windows to measure the gain on, and the vehicle."""


@dataclass(frozen=True)
class Flight:
    """One diagnosis to make.

    Attributes:
        train, held: logs below the data folder, each with `@from:to` where cut; vehicle: its file there.
        hidden: what a case hides; None where nobody knows.
        clutter: what may be named beside it, after it.
        known: what is known of a recorded vehicle.
    """

    name: str
    case: Case | None = None
    train: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    vehicle: str = ""
    hidden: tuple[str, ...] | None = None
    clutter: tuple[str, ...] = ()
    known: FlightSet | None = None


_RECORDED = (
    ("iris", "iris/vehicle.yaml", "pitch_yaw.csv", "sideways.csv"),
    ("sitl square", "ardupilot_sitl/quad_sq.yaml", "quad_sq.bin@20:70", "quad_sq.bin@100:140"),
    ("sitl x", "ardupilot_sitl/sitl_x.yaml", "x.bin@20:100", "x.bin@100:160"),
    ("brushed rpm", "brushed/vehicle.yaml", "jana00.csv", "jana02.csv"),
    ("brushed pwm", "brushed/vehicle_pwm.yaml", "jana00_pwm.csv", "jana02_pwm.csv"),
    ("arpl", "arpl/vehicle.yaml", "log15.csv", ""),
    ("nanobench", "nanobench/vehicle.yaml", "B2_circle_fast_rep1.csv", "B9_trefoil_fast_rep10.csv"),
    ("crazyflie", "crazyflie_rpm/vehicle.yaml", "figure8_22.csv figure8_34.csv", "figure8_30.csv"),
    ("nano-drone", "nanodrone/vehicle.yaml", "random_run1.csv square_run1.csv", "random_run3.csv"),
)
"""Name, vehicle file, logs to diagnose, logs to measure on, in the folder of the vehicle file."""


def _recorded() -> list[Flight]:
    out = []
    for name, vehicle, train, held in _RECORDED:
        folder = vehicle.split("/")[0]
        logs = [tuple(f"{folder}/{log}" for log in names.split()) for names in (train, held)]
        known = next((s for s in SETS.values() if s.vehicle == vehicle and s.truth), None)
        out.append(Flight(name, None, logs[0], logs[1], vehicle, known=known))
    return out


def flights(names: Sequence[str] = FLIGHTS) -> list[Flight]:
    """Flights by name: ``single 7000`` (class and number of the campaign), ``cases case_012``, ``iris``."""
    known = {f.name: f for f in (*_independent("cases"), *_independent("cases_hub"), *_recorded())}
    return [known[name] if name in known else _hidden(name) for name in names]


def _hidden(name: str) -> Flight:
    """A case of the campaign."""
    group, number = name.split()
    (case,) = cases(group, 1, int(number))
    clutter = tuple(case.hidden) if group == "clutter" else ()
    return Flight(name, case, hidden=case.expected, clutter=clutter)


def _independent(folder: str) -> list[Flight]:
    """The cases of an independent simulator in one folder."""
    answers = json.loads((DATA / folder / "answers.json").read_text(encoding="utf-8"))
    return [
        Flight(
            f"{folder} {a['case']}",
            None,
            (f"{folder}/{a['case']}/train.csv",),
            (f"{folder}/{a['case']}/validate.csv",),
            f"{folder}/{a['case']}/vehicle.yaml",
            tuple(a["effects"]),
            tuple(a["truth"]) if a["kind"] == "clutter" else (),
        )
        for a in answers
    ]


def load(flight: Flight, cache: Path | None = None) -> Windows:
    """Windows to diagnose, windows to measure the gain on, and the vehicle as guessed.

    Args:
        cache: folder that keeps flights once flown or read; they do not depend on the diagnosis.
    """
    kept = None if cache is None else cache / f"{flight.name.replace(' ', '-').replace('/', '-')}.pickle"
    if kept is not None and kept.exists():
        train, held, text = pickle.loads(kept.read_bytes())
        return train, held, Vehicle.from_yaml(text)
    if flight.case is not None:
        one, other, vehicle = flown(flight.case)
        train, held = [one], [other]
    else:
        vehicle = Vehicle.named(DATA / flight.vehicle)
        train, held = _windows(flight.train, vehicle), _windows(flight.held, vehicle)
    if kept is not None:
        kept.parent.mkdir(parents=True, exist_ok=True)
        kept.write_bytes(pickle.dumps((train, held, vehicle.to_yaml())))
    return train, held, vehicle


def _windows(names: Sequence[str], vehicle: Vehicle) -> list[Window]:
    return [w for n in names for w in quadid.load(DATA / n, vehicle).windows]


# --- Fits kept from one variant to the next: most changes ask for the same fits of the same flight again


FITS = (
    "polish",
    "settle_states",
    "flexible_fit",
    "residual_noise",
    "mode_power",
    "filtered",
    "mse_score",
    "reliability",
    "follows",
)
"""Functions that the diagnosis calls, of `quadid.identify`, which no variant changes, but for the last one …"""
NUMBERS = ("quadid.diagnosis.residual_tests", "quadid.diagnosis.hypotheses")
"""… whose answer depends on numbers of these modules, and on nothing else that a variant changes."""


MOST = 600
"""Answers kept; the oldest go first."""


class Memory:
    """Answers of functions to arguments of equal content, and how many linearisations a diagnosis asked for.

    Attributes:
        asked: linearisations since `asked` was last set to 0, remembered ones included: a cost that no machine changes.
    """

    def __init__(self) -> None:
        """Knows nothing."""
        self.asked = 0
        self._known: dict[bytes, Any] = {}
        self._inside = False
        self._windows: dict[int, tuple[Window, bytes]] = {}

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Within it the diagnosis asks this memory before it fits."""
        places = [(m, n) for m in modules() for n in FITS if hasattr(m, n)]
        kept: list[tuple[Any, str, Any]] = [(m, n, getattr(m, n)) for m, n in [*places, (Shooting, "linearise")]]
        try:
            for where, name, function in kept:
                setattr(where, name, self._remembered(name, function))
            yield
        finally:
            for where, name, function in kept:
                setattr(where, name, function)

    def _remembered(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def answer(*args: Any, **kwargs: Any) -> Any:
            if self._inside:  # of a fit that is remembered as a whole
                return function(*args, **kwargs)
            key = self._key((name, args, kwargs, _numbers() if name == "follows" else ()))
            if key not in self._known:
                self._inside = True
                try:
                    self._known[key] = function(*args, **kwargs)
                finally:
                    self._inside = False
                if len(self._known) > MOST:
                    self._known.pop(next(iter(self._known)))
            found = self._known[key]
            self.asked += getattr(found, "iterations", 1)
            return found

        return answer

    def _key(self, what: object) -> bytes:
        out = io.BytesIO()
        _Content(out, self).dump(what)
        return hashlib.sha256(out.getbuffer()).digest()

    def window(self, window: Window) -> bytes:
        """Digest of what a window holds."""
        if id(window) not in self._windows:
            self._windows[id(window)] = (window, hashlib.sha256(pickle.dumps(window)).digest())
        return self._windows[id(window)][1]


def _numbers() -> list[tuple[str, Any]]:
    """Numbers of the modules that the last function of `FITS` rests on, as they are now."""
    return [(n, v) for m in NUMBERS for n, v in vars(sys.modules[m]).items() if n.isupper()]


class _Content(pickle.Pickler):
    """Writes arguments, windows and their simulations by the digest of their content."""

    def __init__(self, file: io.BytesIO, memory: Memory) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.memory = memory

    def persistent_id(self, obj: object) -> object:
        if isinstance(obj, Rollout):
            return self.memory.window(obj.window), obj.vehicle.to_yaml()
        return self.memory.window(obj) if isinstance(obj, Window) else None


# --- One flight diagnosed, as a record that can be kept and compared


SAME = 0.01
"""Relative change of the error on unseen data below which two answers with equal names count as equal."""
WIDTH = 0.05
"""The same for the width of an interval."""


@dataclass(frozen=True)
class Answer:
    """Answer of a diagnosis.

    Attributes:
        flight: its name; variant: what was changed in the method.
        verdict: of the diagnosis, or ``refused``.
        listed: all findings, in order; named: the confident ones.
        right: whether that is what was hidden, or, of recorded flights, no number called identified excludes what is
            known of the vehicle; None where nobody knows.
        nominal, extended: error on unseen data; fits: linearisations asked for.
        intervals: of the numbers found, 95 %.
        follows: what the rest follows most, and where.
    """

    flight: str
    variant: str
    verdict: str
    listed: tuple[str, ...]
    named: tuple[str, ...]
    right: bool | None
    nominal: float
    extended: float
    fits: int
    intervals: dict[str, tuple[float, float]]
    follows: str = ""

    def difference(self, other: Answer) -> str:
        """Things that an answer has and this one has not, in words; empty where nothing differs.

        Names come before the first of them and the verdict, these before the error on unseen data, and that before
        intervals and the rest.
        """
        gone, come = (sorted(set(a.listed) - set(b.listed)) for a, b in ((self, other), (other, self)))
        if gone or come:
            return ", ".join([*(f"−{n}" for n in gone), *(f"+{n}" for n in come)])
        if self.listed[:1] != other.listed[:1]:
            return f"first {self.listed[0]} → {other.listed[0]}"
        if (self.verdict, set(self.named)) != (other.verdict, set(other.named)):
            return f"{self.verdict}, {len(self.named)} confident → {other.verdict}, {len(other.named)}"
        if abs(self.extended - other.extended) > SAME * max(self.extended, other.extended):
            return f"error {self.extended:.3g} → {other.extended:.3g}"
        for name, (low, high) in self.intervals.items():
            width, new = high - low, other.intervals[name][1] - other.intervals[name][0]
            if abs(new - width) > WIDTH * max(width, new):
                return f"interval of {name} {width:.2g} → {new:.2g}"
        if self.right != other.right:
            return f"numbers {'wrong → right' if other.right else 'right → wrong'}"
        if self.follows != other.follows:
            return f"rest follows “{self.follows}” → “{other.follows}”"
        return ""


def ask(flight: Flight, given: Windows, variant: str, memory: Memory) -> Answer:
    """Diagnoses one flight."""
    train, held, vehicle = given
    memory.asked = 0
    try:
        seed = 0 if flight.case is None else flight.case.seed
        found, _ = diagnose(train, vehicle, held, seed)
    except QuadidError as error:
        return Answer(flight.name, variant, f"refused: {error}", (), (), None, math.nan, math.nan, memory.asked, {})
    named = tuple(f.effect for f in found.findings if f.confident)
    listed = tuple(f.effect for f in found.findings)
    # Of one effect that is found twice, as weak rotors are, the second one counts.
    intervals = {f"{f.effect}.{p.name}": p.ci95 for f in found.findings for p in f.parameters}
    follows = next((f"{f.signal} at {f.site.name}" for f in found.remainder.followed), "")
    right = _right(flight, found.verdict.value, listed, named)
    if flight.known is not None:
        right = all(n.inside for n in of_set("", flight.known, {"": found.to_dict()}) if n.identified)
    return Answer(
        flight.name,
        variant,
        found.verdict.value,
        listed,
        named,
        right,
        found.validation.nominal,
        found.validation.extended,
        memory.asked,
        intervals,
        follows,
    )


def _right(flight: Flight, verdict: str, listed: Sequence[str], named: Sequence[str]) -> bool | None:
    """True if the answer is what the class of the flight asks for (as
    `quadid_evaluation.studies.campaign.right`)."""
    if flight.hidden is None:
        return None
    if flight.hidden == ("unknown",):
        return verdict == "unknown"
    if flight.clutter:
        return bool(listed) and listed[0] in flight.hidden and set(named) <= set(flight.clutter)
    if flight.case is not None and flight.case.outside:
        return not named
    return Counter(named) == Counter(flight.hidden) and (bool(named) or verdict == "nothing_found")


def run(
    flight: Flight, chosen: Sequence[Variant], cache: Path | None, records: Path, told: Callable[[Answer], None]
) -> list[Answer]:
    """Diagnoses one flight under each variant that `records` lacks, and keeps the answers there."""
    have = {a.variant: a for a in read(records) if a.flight == flight.name}
    if any(v.name not in have for v in chosen):
        given, memory = load(flight, cache), Memory()
        with memory.in_use():
            for variant in (v for v in chosen if v.name not in have):
                with variant.in_force():
                    answer = have[variant.name] = ask(flight, given, variant.name, memory)
                with records.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(answer)) + "\n")
                told(answer)
    return [have[v.name] for v in chosen]


def read(records: Path) -> list[Answer]:
    """Answers kept so far."""
    if not records.exists():
        return []
    rows = [json.loads(line) for line in records.read_text(encoding="utf-8").splitlines()]
    return [Answer(**{**r, "listed": tuple(r["listed"]), "named": tuple(r["named"])}) for r in rows]


# --- The page


REMOVED = Path(__file__).with_name("ablation_removed.md")
"""Rules that went because of such runs, in words."""
IDLE = re.compile(r"\* [^:]+: ")
"""A row in which nothing changes."""
NAMES = re.compile(r"\*\*[−+]|: [−+]\w|: first |confident →")
"""Mark of a row in which a name or a verdict changes."""


def told(answer: Answer) -> None:
    """Prints one answer."""
    mark = {True: "right", False: "WRONG", None: "-"}[answer.right]
    print(f"{mark:5s} {answer.variant}: {answer.flight}: {answer.verdict} {list(answer.listed)}", flush=True)


def row(subject: str, chosen: Sequence[Variant], answers: Mapping[str, Sequence[Answer]]) -> str:
    """One line of the page: what changes under each change of one rule or number."""
    base = answers["base"]
    cells = {}
    for variant in (v for v in chosen if v.subject == subject):
        how = variant.name.removeprefix(subject).strip().removeprefix("without " + subject) or "out"
        cells[how] = _cell(base, answers[variant.name])
    scaled = [f"{how}: {cells[how]}" for how in ("× 0.5", "× 2") if cells.get(how)]
    return f"* {subject}: {'; '.join([cells['out'], *scaled] if cells.get('out') else scaled)}"


def _cell(base: Sequence[Answer], answers: Sequence[Answer]) -> str:
    known = {b.flight: b for b in base}
    base = [known[a.flight] for a in answers]
    pairs = [(b, a) for b, a in zip(base, answers, strict=True) if b.difference(a)]
    better = sum(a.right is True and b.right is False for b, a in pairs)
    worse = sum(a.right is False and b.right is True for b, a in pairs)
    fits = sum(a.fits for a in answers) / max(sum(b.fits for b in base), 1)
    signed = " ".join(f"{sign}{n}" for sign, n in (("+", better), ("−", worse)) if n)
    told = [f"**{signed}**"] if signed else []
    for b, a in sorted(pairs, key=_weight)[:1]:
        told.append(f"{b.flight}{f' (of {len(pairs)})' if len(pairs) > 1 else ''}: {b.difference(a)}")
    told += [f"fits ×{fits:.2f}"] if abs(fits - 1.0) > 0.03 else []
    return "; ".join(told)


def _weight(pair: tuple[Answer, Answer]) -> tuple[bool, bool]:
    base, other = pair
    return base.right == other.right, (base.verdict, set(base.listed)) == (other.verdict, set(other.listed))


def _sorted(rows: Sequence[str]) -> tuple[list[str], list[str], list[str]]:
    """Subjects of rows in which nothing changes, of rows without another name or verdict, and the other rows."""
    subject = {row: row.split(": ")[0].removeprefix("* ") for row in rows}
    moving = [row for row in rows if not IDLE.fullmatch(row)]
    telling = [row for row in moving if NAMES.search(row)]
    slight = [subject[row] for row in moving if row not in telling]
    return [subject[row] for row in rows if row not in moving], slight, telling


def page(rows: Sequence[str], base: Sequence[Answer], options: Given) -> str:
    """The result page: rows that change something, the others by name."""
    left_out = [name for name in FLIGHTS if name not in options.flights.split(",")]
    missing = f" without {', '.join(left_out)}" if left_out else ""
    missing += f" --only '{options.only}'" if options.only else ""
    right = [a for a in base if a.right is not None]
    idle, slight, telling = _sorted(rows)
    scaled = len({a.flight for a in base} & set(SCALED))
    return (
        f"""# Diagnosis: ablation of rules and constants

{len(base)} flights, {datetime.date.today().isoformat()}, `make ablation`{missing}

Numbers of campaign cases are seeds. Unchanged, {sum(bool(a.right) for a in right)} of the {len(right)} with known
answer are right; of recorded flights: no identified number excludes what is known.

{REMOVED.read_text(encoding="utf-8").strip()}

## Without each rule and constant
No change of: {", ".join(idle)}.

Only errors, intervals or effort change: {", ".join(slight)}.

+n −n: cases that become right or wrong; one difference is quoted: causes (− gone, + new), verdict, error (> 1 %). Fits:
linearisations (> 3 %). Halves and doubles: {scaled} flights.

"""
        + "\n".join(telling)
        + "\n"
    )


def main() -> None:
    """Command line of the study."""
    given = options(__doc__, records="ablation.jsonl", cache="", flights=",".join(FLIGHTS), only="", recorded=False)
    records, cache = Path(given.records), Path(given.cache) if given.cache else None
    words = [w for w in given.only.split(",") if w]
    chosen = [v for v in variants() if v.name == "base" or not words or any(w in v.name for w in words)]
    answers: dict[str, list[Answer]] = {v.name: [] for v in chosen}
    recorded = {(a.flight, a.variant) for a in read(records)}
    for flight in flights(given.flights.split(",")):
        here = [v for v in chosen if not v.scaled or flight.name in SCALED]
        known = [v for v in here if not given.recorded or (flight.name, v.name) in recorded]
        for answer in run(flight, known, cache, records, told):
            answers[answer.variant].append(answer)
    rows = [row(s, chosen, answers) for s in dict.fromkeys(v.subject for v in chosen) if s != "base"]
    print("\n".join(rows))
    if given.out is not None:
        (given.out / "ablation.md").write_text(page(rows, answers["base"], given), encoding="utf-8")


if __name__ == "__main__":
    main()
