"""One case: flown, diagnosed, and graded against what was hidden and against an oracle that knows the structure."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis import Diagnosis, Search, diagnose
from quadid.diagnosis.attribution import block_deviance
from quadid.diagnosis.hypotheses import Candidate, Model, Start, candidates, extend, fit_model
from quadid.errors import QuadidError
from quadid.flight import FlightError
from quadid.identification.problem import Shooting
from quadid_evaluation.studies.campaign.hidden_cases import Case, flown

WITH_ORACLE = ("single", "pair", "look_alike")
"""Classes in which the true structure is fitted too."""


@dataclass(frozen=True)
class Graded:
    """The answer to one case beside the truth.

    Attributes:
        case: what was hidden.
        verdict: of the diagnosis, or ``failed``.
        named: effects called confident; listed: all findings; first: the first of them.
        values: found parameters by effect and name; intervals: their 95 % intervals.
        mse_nominal, mse_extended: on the second flight; mse_oracle: of the true structure fitted to the first.
        rest: structure left, as a share of the noise.
        seconds: time of the diagnosis.
        note: why it failed.
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
    return _graded(case, found, search, oracle, seconds)


def _graded(case: Case, found: Diagnosis, search: Search, oracle: float | None, seconds: float) -> Graded:
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
        start = Start(_near_truth(shooting, model, effect, values), model.states)
        model = extend(shooting, model, _cause(listed, effect, values), start, 12)
    model = fit_model(shooting, model.theta, model.causes, model.states, 12)
    deviance, rows = block_deviance(shooting.on([validate]), model)
    return float(deviance.sum()) / rows


def _cause(listed: list[Candidate], effect: str, values: dict[str, float]) -> Candidate:
    label = f"weak_rotor {round(values['rotor'])}" if effect == "weak_rotor" else effect
    return next(c for c in listed if c.label == label)


def _near_truth(shooting: Shooting, model: Model, effect: str, values: dict[str, float]) -> np.ndarray:
    """Start of the oracle: the true effect, nominal parameters of the vehicle file."""
    theta = np.asarray(model.theta).copy()
    shooting.layout.write_effects(theta, {effect: values})
    return theta


def right(g: Graded) -> bool:
    """Whether the answer is right in full: all that was hidden, nothing else; `unknown` for the unknown."""
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
