"""Result of a diagnosis: verdict, findings with numbers, intervals and what lost against them; and as data for JSON."""

import math
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from quadid.chi_square import Z95, survival
from quadid.diagnosis.evidence import Benefit, Validation, Worth
from quadid.diagnosis.hypotheses import Candidate, Model
from quadid.diagnosis.residual_tests import Remainder
from quadid.diagnosis.search import Search
from quadid.effects import EFFECTS
from quadid.identification.problem import Shooting
from quadid.identification.result import parameter_entry
from quadid.jsonable import jsonable
from quadid.parameters import Parameter
from quadid.vehicle import Vehicle

STEP_SIGMA = 3e-4
"""Standard deviation [s] added to lags and delays: commands and samples of a loop at 1 kHz keep whole steps, and stamps
no more; two minutes of data alone would give a delay ten times more precisely."""
TIME_SIGMA = 0.1
"""Standard deviation [s] given to a change time, the resolution of its scan."""


class Explanation(StrEnum):
    """Overall answer."""

    NOTHING_FOUND = "nothing_found"
    EXPLAINED = "explained"
    PARTLY_EXPLAINED = "partly_explained"
    UNKNOWN = "unknown"

    @property
    def sentence(self) -> str:
        """The verdict in plain words."""
        return {
            Explanation.NOTHING_FOUND: "The simulation agrees with the flight: nothing was found that it gets wrong.",
            Explanation.EXPLAINED: "This explains more than 99.9 % of the model error.",
            Explanation.PARTLY_EXPLAINED: "This explains most of the model error; some remains.",
            Explanation.UNKNOWN: "The simulation gets something wrong that no known cause explains.",
        }[self]


@dataclass(frozen=True)
class FoundParameter:
    """One number of a finding: contract name, SI unit, value and 95 % interval."""

    name: str
    unit: str
    value: float
    ci95: tuple[float, float]


@dataclass(frozen=True)
class Alternative:
    """A look-alike that lost: its error on unseen data in place of the finding."""

    effect: str
    mse_after: float


@dataclass(frozen=True)
class Finding:
    """One named cause.

    Attributes:
        effect: contract name.
        confident: False when the verdict is `unknown`, or the finding has not the form that its name claims.
        parameters: numbers of the effect.
        gain: what it is worth on unseen data, given all other findings.
        p_value: chance of numbers so far from neutral without the effect, corrected for how many causes were tried.
        alternatives: look-alikes refitted in its place, best first.
        evidence: one sentence a pilot understands.
        per_log: its values belong to the flight, not the vehicle.
        ordinary: no larger than it may be on any vehicle (`diagnose.attribution`); such come after all others.
    """

    effect: str
    confident: bool
    parameters: tuple[FoundParameter, ...]
    gain: Benefit
    p_value: float
    alternatives: tuple[Alternative, ...]
    evidence: str
    per_log: bool = False
    ordinary: bool = False

    def to_dict(self) -> dict[str, Any]:
        """Plain data of contract form."""
        parameters = [{**asdict(p), "ci95": jsonable(p.ci95)} for p in self.parameters]
        return {**asdict(self), "parameters": parameters}


@dataclass(frozen=True)
class Diagnosis:
    """Outcome of a diagnosis; `to_dict` gives the JSON of contract §7 but for the file name.

    `parameters` are the nominal six beside the findings.
    """

    verdict: Explanation
    findings: tuple[Finding, ...]
    validation: Validation
    remainder: Remainder
    parameters: tuple[Parameter, ...]
    vehicle: Vehicle
    vehicle_name: str
    warnings: tuple[str, ...] = field(default_factory=tuple)

    @property
    def vehicle_yaml(self) -> str:
        """The extended vehicle as a file."""
        return self.vehicle.to_yaml()

    @property
    def unexplained(self) -> dict[str, float]:
        """Share of each channel's residual power that is structure, where there is any."""
        return {channel: round(share, 4) for channel, share in self.remainder.shares.items()}

    @property
    def unexplained_follows(self) -> list[dict[str, Any]]:
        """Signals that the rest follows, strongest first: site, signal, and the errors by which it stands out."""
        return [
            {"acts_on": f.site.name, "signal": f.signal, "share": round(f.gain.total / self.remainder.rows, 5)}
            for f in self.remainder.followed
        ]

    def to_dict(self) -> dict[str, Any]:
        """Plain data of contract form."""
        return {
            "schema": "quadid.diagnose/1",
            "verdict": self.verdict.value,
            "statement": self.verdict.sentence,
            "parameters": [parameter_entry(p) for p in self.parameters],
            "findings": [f.to_dict() for f in self.findings],
            "validation": {
                "mse_nominal": self.validation.nominal,
                "mse_extended": self.validation.extended,
                "noise_floor": 1.0,
                "on": self.validation.on,
                "mse_extended_refitted": self.validation.refitted,
            },
            "unexplained": self.unexplained,
            "unexplained_follows": self.unexplained_follows,
            "vehicle_file": None,
            "warnings": list(self.warnings),
        }


def describe(
    shooting: Shooting, search: Search, worth: Sequence[Worth], believed: Sequence[Candidate]
) -> tuple[Finding, ...]:
    """Findings in the order of their worth; those `believed` are confident."""
    sigma = search.model.deviations
    return tuple(_finding(shooting, search, w, sigma, w.cause in believed) for w in worth if not w.cause.refines)


def _finding(shooting: Shooting, search: Search, worth: Worth, sigma: dict[str, float], confident: bool) -> Finding:
    cause = worth.cause
    numbers = _numbers(shooting, search.model, cause, sigma)
    body, benefit = EFFECTS[cause.effect].describe({p.name: p.value for p in numbers}), worth.benefit
    return Finding(
        effect=cause.effect,
        confident=confident,
        parameters=numbers,
        gain=benefit,
        p_value=min(1.0, survival(search.model.wald(cause), len(cause.names)) * len(search.listed)),
        alternatives=_alternatives(search, cause, benefit.mse_after),
        evidence=f"{body[0].upper()}{body[1:]}; on unseen data the error of {benefit.seconds:g} s runs falls from "
        f"{benefit.mse_before:.3g} to {benefit.mse_after:.3g} times the noise.",
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
        steps = STEP_SIGMA if p.name in ("tau", "tau_down", "delay") else 0.0
        spread = math.hypot(sigma.get(name, 0.0), 0.0 if base is None else sigma[f"{effect}.{p.beside}{which}"], steps)
        half = Z95 * (TIME_SIGMA if p.name == "time" else spread)
        low, high = value - half, value + half
        if p.name == "cutoff":  # the vector holds its period
            value, low, high = 1.0 / max(value, 1e-9), 1.0 / high, 1.0 / low if low > 0.0 else math.inf
        out.append(FoundParameter(p.name, p.unit, value, (low, high)))
    return tuple(out)


def _alternatives(search: Search, cause: Candidate, mse_after: float) -> tuple[Alternative, ...]:
    """Other causes refitted in place of `cause` on the same blocks, each effect once, best first.

    Their errors lie above `mse_after`, the finding's own, by what they were worse when both were last compared.
    """
    found: dict[str, Alternative] = {}
    for step in search.rounds:
        for t in step.moves:
            holder = t.gone or (step.accepted.candidate if step.accepted else None)
            mine = step.before if t.gone or step.accepted is None else step.accepted.model
            if t.candidate is None or holder is None or holder.label != cause.label:
                continue
            if t.candidate.effect != cause.effect:
                worse = float(t.model.held_out.sum() - mine.held_out.sum()) / mine.rows
                found[t.candidate.effect] = Alternative(t.candidate.effect, mse_after + worse)
    return tuple(sorted(found.values(), key=lambda a: a.mse_after))
