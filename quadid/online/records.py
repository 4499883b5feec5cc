"""What a session hands out: parameter sets with their story, findings, events for the history, its status."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, Literal

from quadid.health.trim_estimation import FlightTrim
from quadid.parameters import ParameterSet
from quadid.types import FloatArray

WAITS = "waits for approval: "
"""Begins the reason of a set that passed every check; what follows stays true once it is approved."""


Reference = Literal["history", "vehicle_file", "none"]
"""What a set was compared with: sets of earlier flights or that a person approved, a b of the vehicle file with its
sigma, or nothing, where a wrong scale of all rotor speeds cannot be seen."""


class Phase(StrEnum):
    """What a session is doing; the values read as sentences."""

    WAITING = "waiting for data"
    COLLECTING = "collecting the first window"
    BLOCKED = "an input is missing or inconsistent"
    NOT_FLYING = "not flying: nothing is learned"
    NOT_EXCITED = "the motion does not reveal the parameters"
    FITTING = "a fit is running"
    FAILED = "the last fit failed"
    CANDIDATE = "an estimate exists, the gate holds it back"
    PENDING = "an estimate passed the gate and waits for approval"
    ACCEPTED = "a parameter set is in force"


class SetState(StrEnum):
    """State of one parameter set."""

    REJECTED = "rejected"
    PENDING = "pending"
    ACCEPTED = "accepted"
    ROLLED_BACK = "rolled_back"
    STALE = "stale"


@dataclass(frozen=True)
class OnlineSet:
    """A parameter set and where it comes from.

    Attributes:
        sequence: counts the sets of a vehicle from 1; 0: never numbered (a candidate that was refused).
        state: what became of it; reason: why, one sentence.
        parameters: values, covariance, status.
        start, stop: first and last time of the data it rests on [s], the session's time.
        samples: grid rows in them.
        mse: mean squared residual over noise variance in the newest window; mse_held_out: the same of an estimate that
            had not seen that window; NaN: none.
        input_hash: SHA-256 of the windows and the seed that led here.
        approved_by: ``auto``, a person, or empty.
        check: the gate's check that decided.
        mass: of the vehicle that the set rests on [kg]; NaN: not noted.
        outdated: why a set in force is known to be out of date; empty: it is not known to be.
        outdated_code: the same for programs: an effect's name, ``unknown_cause`` or ``disagreement``.
        reference: what rotor speeds, force and mass were checked against.
    """

    sequence: int
    state: SetState
    reason: str
    parameters: ParameterSet
    start: float
    stop: float
    samples: int
    mse: float = float("nan")
    mse_held_out: float = float("nan")
    input_hash: str = ""
    approved_by: str = ""
    check: str = ""
    mass: float = float("nan")
    outdated: str = ""
    outdated_code: str = ""
    reference: Reference = "none"


@dataclass(frozen=True)
class Publish:
    """Action: publish a set.

    Attributes:
        topic: ``parameters`` (in force, latched) or ``candidate`` (every fit with its reason).
        item: the set.
    """

    topic: Literal["parameters", "candidate"]
    item: OnlineSet


@dataclass(frozen=True)
class OnlineAlternative:
    """A look-alike that was fitted against a finding, and the cost left with it (1: noise)."""

    effect: str
    mse_after: float


@dataclass(frozen=True)
class OnlineFinding:
    """One cause of a sudden change.

    Attributes:
        effect: name in the catalogue.
        values, sigma: its numbers by name, SI; units: their units.
        mse_before, mse_after: mean squared residual over noise variance around the change without and with it.
        p_value: of its absence, corrected for what was tried.
        alternatives: look-alikes.
        evidence: one sentence.
        confident: whether it beats its look-alikes.
    """

    effect: str
    values: Mapping[str, float]
    sigma: Mapping[str, float]
    units: Mapping[str, str]
    mse_before: float
    mse_after: float
    p_value: float
    alternatives: tuple[OnlineAlternative, ...]
    evidence: str
    confident: bool = True


@dataclass(frozen=True)
class OnlineDiagnosis:
    """Action: publish findings.

    Attributes:
        t: when they were known [s]; start, stop: the data they rest on [s].
        findings: most important first; empty: nothing found, or a change whose cause is unknown.
        verdict: ``nothing_found``, ``explained``, ``partly_explained`` or ``unknown``.
    """

    topic: ClassVar[Literal["diagnosis"]] = "diagnosis"
    t: float
    start: float
    stop: float
    findings: tuple[OnlineFinding, ...]
    verdict: str


@dataclass(frozen=True)
class HealthyFlight:
    """Action: keep a flight for the vehicle's healthy history.

    Attributes:
        t: when it ended [s].
        trim: of the flight.
    """

    topic: ClassVar[Literal["healthy_flight"]] = "healthy_flight"
    t: float
    trim: FlightTrim


@dataclass(frozen=True)
class Event:
    """Action: a line for the history and, from `level` warning on, for people.

    Attributes:
        t: session time [s].
        level: ``info``, ``warning`` or ``error``.
        kind: short fixed word, for machines.
        text: sentence for people.
    """

    topic: ClassVar[Literal["event"]] = "event"
    t: float
    level: str
    kind: str
    text: str


@dataclass(frozen=True)
class SessionStatus:
    """What a session is doing.

    Attributes:
        t: newest sample [s, time of the stamps]; NaN before the first.
        phase: what; reason: why, and what would change it.
        excitation: relative standard deviation of each nominal parameter that the newest window allows; NaN: unknown.
        samples: grid rows in the newest window; window_seconds: usable time in it [s]; gaps: cuts in it.
        mse: of the newest window, 1 at the noise floor; NaN before.
        fits, rejected: fits done, and those the gate refused.
        in_force, pending: sequence numbers, 0 for none; stale: the set in force is from an earlier run.
        approval: auto or manual, now.
        faults: dropped samples by reason.
        backlog: time of data that wait for the processor or a running fit [s].
        skipped: fits left out because the machine was too slow.
    """

    t: float
    phase: Phase
    reason: str
    excitation: FloatArray
    samples: int
    window_seconds: float
    gaps: int
    mse: float
    fits: int
    rejected: int
    in_force: int
    pending: int
    stale: bool
    approval: str
    faults: Mapping[str, int]
    backlog: float
    skipped: int = 0
