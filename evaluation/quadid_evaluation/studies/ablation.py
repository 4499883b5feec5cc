"""Worth of each rule and number of the diagnosis: what changes without it, or with half and twice it.

    QUADID_DATA=../shared/data python -m quadid_evaluation.studies.ablation --out docs/results

A stopped run goes on from `--records`; `--recorded` runs nothing.  `--flights` (cases of the campaign) and `--only`
(words of variants) go by commas.
"""

import ast
import datetime
import importlib
import inspect
import math
import pkgutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np

import quadid.diagnosis
from quadid.diagnosis.evidence import stated_errors
from quadid.diagnosis.hypotheses import RELEVANT, candidates, fit_model, paired_gain
from quadid.diagnosis.pipeline import SHARE_TO_NAME
from quadid.diagnosis.search import LINEAR_MISFIT
from quadid.identification.fit import flexible_fit
from quadid.identification.problem import Shooting
from quadid_evaluation.harness import Given, keep, kept, options
from quadid_evaluation.studies.campaign import Graded, case, given, grade
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


def _unless(unwanted: str) -> Any:
    """The candidates without those of which an attribute is set."""
    return lambda *asked: [c for c in candidates(*asked) if not getattr(c, unwanted)]


RULES: dict[str, dict[str, Any]] = {
    "swaps": {"_swaps": lambda *_, **__: iter(())},
    "swaps within a family": {
        "_rivals": lambda score, cause, regains: regains and score.candidate.effect != cause.effect
    },
    "impossible numbers": {"impossible_causes": lambda *_, **__: {}},
    "constancy of a bias": {"inconstant_causes": lambda *_, **__: {}},
    "calibration (Godambe)": {"calibration": lambda *_, **__: 1.0},
    "use on held-out blocks": {"Model.gains_beside": lambda large, small: True},
    "use without the best block": {
        "Model.gains_beside": lambda large, small: (
            paired_gain(small.held_out, large.held_out).total > RELEVANT * small.rows
        )
    },
    "a last pruning": {"pruned": lambda shooting, model: model},
    "noise around the causes": {"_noise_around": lambda windows, short, model: short.noise},
    "a start from everything": {"from_everything": lambda s, *_: fit_model(s, s.layout.initial(s.vehicle), ())},
    "two starts of the flexible fit when far": {
        "flexible_fit": lambda *a, **k: flexible_fit(*a[:2], a[2][:1], a[3], a[1].noise, **k)
    },
    "what the fit left undone, in scores": {"Everything._unspent": lambda *_, **__: 0.0},
    "causes that show only in pairs": {"candidates": _unless("split")},
    "optional numbers of a cause": {"candidates": _unless("refines")},
    "onset refined": {"_refine_time": lambda shooting, model, candidate: model},
    "a look at the longest segments": {"Stage.longest": lambda *_, **__: None},
    "longest segments where velocity is found": {"is_long": lambda *_, **__: False},
    "ordinary sizes last": {"ordinary": lambda *_, **__: False},
    "contradiction by unseen data": {"stated_errors": lambda *a: replace(stated_errors(*a), contradicted=False)},
    "what the rest follows": {"follows": lambda *_, **__: ()},
    "numbers by the likelihood of innovations": {"fit_numbers": lambda *_, **__: None},
    "moments that a rigid body can have": {"possible_moments": lambda parameters: (parameters, None)},
    "slight steps and winds": {"slight_causes": lambda *_, **__: {}},
    "lags beside unreliable inertias": {"late_unknown": lambda *_, **__: {}},
}
"""Rules that are functions, and what stands in their place."""
OUT: dict[str, Any] = {
    "UNTIDY": 0.0, "BLOCKS": 2, "STEP_SIGMA": 0.0, "TIME_SIGMA": 0.0, "FALSE_ALARM": 1.0, "RELEVANT": 0.0,
    "NOISE_FELL": 0.0, "SHARE_TO_NAME": 0.0, "SHARE_ALONE": SHARE_TO_NAME,
    "LEAST_STRUCTURE": 0.0, "LEAST_OF_EXPLAINED": 0.0, "LIKELY_SENSOR": math.inf, "WRONG_SIGN": 0.0, "ERRORS": 0.0,
    "WAVES": 0, "ALARM": math.inf,
    "CHANGE_SHARE": 0.0, "LINEAR_MISFIT": math.inf, "CLEAN_MISFIT": LINEAR_MISFIT, "NEAR": 1.0, "ALIKE": 1.0,
    "MOST_REFITS": 1000,
}  # fmt: skip
"""Value that stands for a number that is left out; numbers that have no such value are halved and doubled only."""


# --- The flights, each diagnosed under every variant


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
    "single 1083", "single 8005", "look_alike 15", "outside 1029", "clutter 2005", "clutter 2019", "cases 12",
    "cases_hub 2", "cases_hub 6", "recorded iris pitch_yaw", "recorded arpl", "recorded ardupilot quad_sq",
    "recorded brushed rpm", "recorded crazyflie rpm",
)  # fmt: skip
"""Flights of a run where nothing else is asked for: besides those, flights that rules were once made for."""


@dataclass(frozen=True)
class Answer:
    """Answer to a flight under a variant, and how many linearisations it took: a cost that no machine changes."""

    flight: str
    variant: str
    graded: Graded
    fits: int


def run(flight: str, chosen: Sequence[Variant], records: Path) -> list[Answer]:
    """Diagnoses one flight under each variant that `records` lacks, and keeps the answers there."""
    have = {a.variant: a for a in kept(records, Answer) if a.flight == flight}
    left = [v for v in chosen if v.name not in have]
    if left:
        one = case(flight)
        windows = given(one)
        for variant in left:
            with variant.in_force(), _counted() as count:
                graded = grade(one, *windows)
            have[variant.name] = Answer(flight, variant.name, graded, len(count))
            keep(records, have[variant.name])
            mark = "right" if graded.right else "WRONG"
            print(f"{mark} {variant.name}: {flight}: {graded.verdict} {list(graded.listed)}", flush=True)
    return [have[v.name] for v in chosen]


@contextmanager
def _counted() -> Iterator[list[None]]:
    """Notes every linearisation within it."""
    calls, linearise = list[None](), Shooting.linearise

    def counted(self: Shooting, *a: Any, **k: Any) -> Any:
        calls.append(None)
        return linearise(self, *a, **k)

    Shooting.linearise = counted  # type: ignore[method-assign]
    try:
        yield calls
    finally:
        Shooting.linearise = linearise  # type: ignore[method-assign]


# --- The page


SAME, WIDTH = 0.01, 0.05
"""Relative changes of the error on unseen data, and of an interval's width, that count as none."""
REMOVED = Path(__file__).with_name("ablation_removed.md")
"""Rules that went because of such runs, in words."""


def difference(one: Graded, other: Graded) -> tuple[str, bool]:
    """Things that `other` answers and `one` does not, in words, and whether a name or the verdict is among them.

    Names come before the first of them and the verdict, these before the error on unseen data, and that before
    intervals and the rest.
    """
    gone, come = (sorted(set(a.listed) - set(b.listed)) for a, b in ((one, other), (other, one)))
    if gone or come:
        return ", ".join([*(f"−{n}" for n in gone), *(f"+{n}" for n in come)]), True
    if one.first != other.first:
        return f"first {one.first} → {other.first}", True
    if (one.verdict, set(one.named)) != (other.verdict, set(other.named)):
        return f"{one.verdict}, {len(one.named)} confident → {other.verdict}, {len(other.named)}", True
    before, after = one.stated[1], other.stated[1]
    if abs(before - after) > SAME * max(before, after):
        return f"error {before:.3g} → {after:.3g}", False
    for effect, numbers in one.intervals.items():
        for name, (low, high) in numbers.items():
            width, new = high - low, float(np.diff(other.intervals[effect][name])[0])
            if abs(new - width) > WIDTH * max(width, new):
                return f"interval of {effect}.{name} {width:.2g} → {new:.2g}", False
    if one.right != other.right:
        return f"numbers {'wrong → right' if other.right else 'right → wrong'}", False
    if one.follows != other.follows:
        return f"rest follows “{one.follows}” → “{other.follows}”", False
    return "", False


def cell(base: Mapping[str, Answer], answers: Sequence[Answer]) -> tuple[str, bool]:
    """Effect of a variant: right and wrong, its weightiest difference, effort; and whether a name is among it."""
    pairs = [(base[a.flight].graded, a) for a in answers]
    found = []
    for b, a in pairs:
        text, names = difference(b, a.graded)
        found += [(b.right == a.graded.right, not names, a.flight, text)] if text else []
    better, worse = (sum((b.right, a.graded.right) == way for b, a in pairs) for way in ((False, True), (True, False)))
    signs = (("+", better), ("−", worse))
    signed = " ".join(f"{sign}{n}" for sign, n in signs if n)
    told = [f"**{signed}**"] if signed else []
    for _, _, flight, text in sorted(found, key=lambda f: f[:2])[:1]:
        told.append(f"{flight}{f' (of {len(found)})' if len(found) > 1 else ''}: {text}")
    fits = sum(a.fits for a in answers) / max(sum(base[a.flight].fits for a in answers), 1)
    told += [f"fits ×{fits:.2f}"] if abs(fits - 1.0) > 0.03 else []
    return "; ".join(told), bool(signed) or any(not same for _, same, *_ in found)


def page(chosen: Sequence[Variant], answers: Mapping[str, Sequence[Answer]], asked: Given) -> str:
    """The result page: rules and numbers that change a name or a verdict, the others by name."""
    base = {a.flight: a for a in answers["base"]}
    idle, slight, telling = list[str](), list[str](), list[str]()
    for subject in dict.fromkeys(v.subject for v in chosen[1:]):
        cells, named = dict[str, str](), False
        for variant in (v for v in chosen if v.subject == subject):
            text, names = cell(base, answers[variant.name])
            how = variant.name.removeprefix(subject).strip() if variant.scaled else ""
            cells |= {how: f"{how}: {text}" if how else text} if text else {}
            named |= names
        if named:
            telling.append(f"* {subject}: {'; '.join(cells.values())}")
        else:
            (slight if cells else idle).append(subject)
    left_out = [name for name in FLIGHTS if name not in base]
    missing = f" without {', '.join(left_out)}" if left_out else ""
    missing += f" --only '{asked.only}'" if asked.only else ""
    return f"""# Diagnosis: ablation of rules and constants

{len(base)} flights, {datetime.date.today().isoformat()}, `make ablation`{missing}

Numbers of campaign cases are seeds. Unchanged, {sum(a.graded.right for a in base.values())} of the {len(base)} are
right; of recorded flights: no identified number excludes what is known.

{REMOVED.read_text(encoding="utf-8").strip()}

## Without each rule and constant
No change of: {", ".join(idle)}.

Only errors, intervals or effort change: {", ".join(slight)}.

+n −n: cases that become right or wrong; one difference is quoted: causes (− gone, + new), verdict, error (> 1 %). Fits:
linearisations (> 3 %). Halves and doubles: {len(base.keys() & set(SCALED))} flights.

""" + "\n".join([*telling, ""])


if __name__ == "__main__":
    asked = options(__doc__, records="ablation.jsonl", flights=",".join(FLIGHTS), only="", recorded=False)
    records, words = Path(asked.records), [w for w in asked.only.split(",") if w]
    chosen = [v for v in variants() if v.name == "base" or not words or any(w in v.name for w in words)]
    answers: dict[str, list[Answer]] = {v.name: [] for v in chosen}
    recorded = {(a.flight, a.variant) for a in kept(records, Answer)}
    for flight in asked.flights.split(","):
        here = [v for v in chosen if not v.scaled or flight in SCALED]
        for answer in run(flight, [v for v in here if not asked.recorded or (flight, v.name) in recorded], records):
            answers[answer.variant].append(answer)
    print(text := page(chosen, answers, asked))
    if asked.out is not None:
        (asked.out / "ablation.md").write_text(text, encoding="utf-8")
