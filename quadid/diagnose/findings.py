"""From the selected model to findings, numbers with intervals, losers, a sentence, and to the extended vehicle."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from quadid.chi_square import Z95, survival
from quadid.diagnose.attribution import Benefit, Worth
from quadid.diagnose.hypotheses import Candidate
from quadid.diagnose.model import Model
from quadid.diagnose.result import Alternative, Finding, FoundParameter
from quadid.diagnose.selection import Search
from quadid.effects import EFFECTS
from quadid.identify.shooting import Shooting
from quadid.model.layout import Layout
from quadid.parameters import Parameter, Status
from quadid.vehicle import Vehicle
from quadid.vehicle_parts import ParameterPrior

STEP_SIGMA = 3e-4
"""Standard deviation [s] added to lags and delays: commands and samples of a loop at 1 kHz keep whole steps, and stamps
no more; two minutes of data would tell a delay ten times better than that."""
TIME_SIGMA = 0.1
"""Standard deviation [s] given to a change time, the resolution of its scan."""


def describe(
    shooting: Shooting, search: Search, worth: Sequence[Worth], believed: Sequence[Candidate]
) -> tuple[Finding, ...]:
    """Findings in the order of their worth; those `believed` are confident."""
    sigma = search.model.deviations
    return tuple(_finding(shooting, search, w, sigma, w.cause in believed) for w in worth if not w.cause.refines)


def _finding(shooting: Shooting, search: Search, worth: Worth, sigma: dict[str, float], confident: bool) -> Finding:
    cause = worth.cause
    numbers = _numbers(shooting, search.model, cause, sigma)
    values = {p.name: p.value for p in numbers}
    benefit = worth.benefit
    return Finding(
        effect=cause.effect,
        confident=confident,
        parameters=numbers,
        gain=benefit,
        p_value=min(1.0, survival(search.model.wald(cause), len(cause.names)) * search.tests),
        alternatives=_alternatives(search, cause, benefit.mse_after),
        evidence=_sentence(cause.effect, values, benefit),
        per_log=EFFECTS[cause.effect].per_log,
        ordinary=worth.ordinary,
    )


def _numbers(shooting: Shooting, model: Model, cause: Candidate, sigma: dict[str, float]) -> tuple[FoundParameter, ...]:
    effect, out, which = cause.effect, [], ""
    if effect == "weak_rotor":
        rotor = float(cause.names[0].rsplit("_", 1)[1])
        out, which = [FoundParameter("rotor", "", rotor, (rotor, rotor))], f"_{rotor:.0f}"
    for p in EFFECTS[effect].parameters:
        name = f"{effect}.{p.entry or p.name}{which}"
        if p.name == "rotor" or (p.optional and name not in sigma):
            continue
        base = next((f.value for f in out if f.name == p.beside), None)
        value = float(model.theta[shooting.layout.entry(name).index]) + (base or 0.0)
        half = Z95 * _sigma(
            p.name, math.hypot(sigma.get(name, 0.0), 0.0 if base is None else sigma[f"{effect}.{p.beside}{which}"])
        )
        low, high = value - half, value + half
        if p.name == "cutoff":  # the vector holds its period
            value, low, high = 1.0 / max(value, 1e-9), 1.0 / high, 1.0 / low if low > 0.0 else math.inf
        out.append(FoundParameter(p.name, p.unit, value, (low, high)))
    return tuple(out)


def _sigma(name: str, from_data: float) -> float:
    """Standard deviation of a number: of the scan for a moment, widened by the steps of real loops for a lag."""
    if name == "time":
        return TIME_SIGMA
    return math.hypot(from_data, STEP_SIGMA) if name in ("tau", "tau_down", "delay") else from_data


def _alternatives(search: Search, cause: Candidate, mse_after: float) -> tuple[Alternative, ...]:
    """Other causes refitted in place of `cause` on the same blocks, each effect once, best first.

    Their errors lie above `mse_after`, the finding's own, by what they were worse when both were last compared.
    """
    found: dict[str, Alternative] = {}
    for step in search.rounds:
        for t in step.trials:
            holder = t.gone or (step.accepted.candidate if step.accepted else None)
            mine = step.before if t.gone or step.accepted is None else step.accepted.model
            if t.candidate is None or holder is None or holder.label != cause.label:
                continue
            if t.candidate.effect != cause.effect:
                worse = float(t.model.held_out.sum() - mine.held_out.sum()) / mine.rows
                found[t.candidate.effect] = Alternative(t.candidate.effect, mse_after + worse)
    return tuple(sorted(found.values(), key=lambda a: a.mse_after))


def _sentence(effect: str, values: Mapping[str, float], benefit: Benefit) -> str:
    """Sentence of one finding with `values` in contract units."""
    body = EFFECTS[effect].told(values)
    return (
        f"{body[0].upper()}{body[1:]}; on unseen data the error of {benefit.seconds:g} s runs falls from "
        f"{benefit.mse_before:.3g} to {benefit.mse_after:.3g} times the noise."
    )


def extended_vehicle(vehicle: Vehicle, layout: Layout, model: Model, parameters: Sequence[Parameter]) -> str:
    """Returns the YAML of `vehicle` with `parameters`, their standard deviations, and the effects of `model`.

    A number that is not to be used is a guess, without standard deviation.
    """
    priors = {}
    for p in parameters:
        low, high = vehicle.limits(p.name)
        priors[p.name] = ParameterPrior(
            initial=p.value, bounds=(min(low, p.value), max(high, p.value)),
            sigma=None if p.status is Status.UNRELIABLE else p.sigma,
        )  # fmt: skip
    effects = {k: dict(v) for k, v in vehicle.effects.items()}
    for cause in model.causes:
        effects[cause.effect] = {
            k: v for k, v in layout.read_effect(model.theta, cause.effect).items() if math.isfinite(v)
        }
    return vehicle.model_copy(update={"parameters": priors, "effects": effects}).to_yaml()
