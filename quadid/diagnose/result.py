"""What a diagnosis says: findings, verdict, validation; and the same as plain data for JSON."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from quadid.diagnose.attribution import Benefit, Validation
from quadid.diagnose.residual_tests import Remainder
from quadid.identify.residual_prediction import Prediction
from quadid.identify.result import parameter_entry
from quadid.jsonable import jsonable
from quadid.parameters import Parameter


class Verdict(StrEnum):
    """Overall answer."""

    NOTHING_FOUND = "nothing_found"
    EXPLAINED = "explained"
    PARTLY_EXPLAINED = "partly_explained"
    UNKNOWN = "unknown"

    @property
    def sentence(self) -> str:
        """The verdict in plain words."""
        return {
            Verdict.NOTHING_FOUND: "The simulation agrees with the flight: nothing was found that it gets wrong.",
            Verdict.EXPLAINED: "These causes explain all of the model error.",
            Verdict.PARTLY_EXPLAINED: "These causes explain most of the model error; some remains.",
            Verdict.UNKNOWN: "The simulation gets something wrong that no known cause explains.",
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

    `parameters` are the nominal six beside the findings.  The vehicle file holds physical
    values; `prediction` is what predicts better, if anything does.
    """

    verdict: Verdict
    findings: tuple[Finding, ...]
    validation: Validation
    remainder: Remainder
    parameters: tuple[Parameter, ...]
    vehicle_yaml: str
    vehicle_name: str
    warnings: tuple[str, ...] = field(default_factory=tuple)
    prediction: Prediction | None = None

    @property
    def unexplained(self) -> dict[str, float]:
        """Share of each channel's residual power that is structure, where there is any."""
        return {channel: round(share, 4) for channel, share in self.remainder.shares.items()}

    @property
    def unexplained_follows(self) -> list[dict[str, Any]]:
        """What the rest follows, strongest first: where it acts, the signal, and the errors by which it stands out."""
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
            "prediction": None if self.prediction is None else self.prediction.to_dict(),
            "prediction_file": None,
            "warnings": list(self.warnings),
        }
