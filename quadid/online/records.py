"""Records and jobs of a session: what it hands out and asks for."""

import math
import traceback
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import ClassVar, Literal, TypeGuard

import numpy as np

from quadid.blas import one_thread
from quadid.condition.trim import FlightTrim
from quadid.condition.watch import HealthReport
from quadid.data.window import Window
from quadid.errors import QuadidError
from quadid.parameters import ParameterSet
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- What a session hands out: parameter sets with their story, findings, events for the history, its status


WAITS = "waits for approval: "
"""Begins the reason of a set that passed every check; what follows stays true once it is approved."""


Reference = Literal["history", "vehicle_file", "none"]
"""Reference of a set: sets of earlier flights or that a person approved, a b of the vehicle file with its
sigma, or nothing, where a wrong scale of all rotor speeds cannot be seen."""


class Phase(StrEnum):
    """Phases of a session; the values read as sentences."""

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
        reference_sd: standard deviation (log scale) of a factor that b, d and the inertias have in common, as far as
            the reference tells it; `parameters` hold it.
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
    reference_sd: float = 0.0

    def told_by_flight(self, name: str) -> float:
        """Standard deviation of a parameter beside that of the reference, of the same unit."""
        p = self.parameters[name]
        return math.sqrt(max(p.sigma**2 - (self.reference_sd * p.value) ** 2, 0.0))


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
    """Status of a session.

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


# --- Work that a session asks for and does not do itself: a fit, a question about a change, a diagnosis
#
# Whoever drives the session runs it, in its own process or another, and delivers the reply.


UNEXPECTED = "unexpected error, please report it: "
"""Begins the problem of a job that failed by an error of this program, not by what its data are."""

MOST_ERRORS = 5
"""After so many of them in a row no more such jobs are begun by themselves."""


def unexpected(error: BaseException) -> str:
    """An unforeseen error as a problem: what, and where it arose."""
    *_, last = traceback.extract_tb(error.__traceback__)
    return f"{UNEXPECTED}{type(error).__name__}: {str(error)[:200]} ({Path(last.filename).name}, line {last.lineno})"


@dataclass(frozen=True)
class JobReply:
    """Answer to a job.

    Attributes:
        number: of the job.
        problem: why there is no result, or empty.
    """

    number: int
    problem: str = ""

    @property
    def is_unexpected(self) -> bool:
        """True if the job failed by an error of this program."""
        return self.problem.startswith(UNEXPECTED)


@dataclass(frozen=True)
class Job(ABC):
    """A pure function of its own fields.

    Attributes:
        background: whether the session goes on meanwhile; it stands still for all others.
        reply: what it is answered with.
        number: counts the jobs of a session.
        vehicle: the vehicle.
        windows: stretches of data on one grid.
        start, stop: the time they stand for [s].
    """

    background: ClassVar[bool] = False
    reply: ClassVar[type[JobReply]]

    number: int
    vehicle: Vehicle
    windows: tuple[Window, ...]
    start: float
    stop: float

    def run(self) -> JobReply:
        """Does it; an error is the reply's `problem`, never raised."""
        try:
            with one_thread():
                return self.answer()
        except (QuadidError, np.linalg.LinAlgError) as error:
            return self.failed(str(error))
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever it is, the flight goes on, and it is told with its input
            return self.failed(unexpected(error))

    @abstractmethod
    def answer(self) -> JobReply:
        """Does it; raises QuadidError or LinAlgError for data that allow no answer."""

    def failed(self, problem: str) -> JobReply:
        """The reply of a job that could not be run."""
        return self.reply(self.number, problem)

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """True if a reply is to this job, and of its kind."""
        return isinstance(reply, self.reply) and reply.number == self.number


# --- Outgoing actions of a session: its phase and reason, and what waits to be handed out


Action = Job | Publish | OnlineDiagnosis | HealthReport | HealthyFlight | Event


class Outbox:
    """Phase, reason and outgoing actions.

    Attributes:
        phase, reason: what the session is doing, and why.
    """

    def __init__(self, stamp: Callable[[float], float]) -> None:
        """Speaks in the time of the stream's stamps: `stamp` turns session time [s] into them."""
        self._stamp = stamp
        self.phase, self.reason = Phase.WAITING, "no samples yet"
        self._out: list[Action] = []

    def stamp(self, t: float) -> float:
        """Session time as a stamp [s]; NaN for no time."""
        return self._stamp(t) if math.isfinite(t) else math.nan

    def act(self, *actions: Action) -> None:
        """Queues actions."""
        self._out.extend(actions)

    def say(self, t: float, level: str, kind: str, text: str) -> None:
        """Queues an event at session time `t` [s]."""
        self._out.append(Event(self.stamp(t), level, kind, text))

    def state(self, phase: Phase, reason: str) -> None:
        """Notes phase and reason."""
        self.phase, self.reason = phase, reason

    def note(self, t: float, phase: Phase, reason: str) -> None:
        """Notes phase and reason, and journals them when they are of a new kind."""
        if (phase, reason.split(":")[0]) != (self.phase, self.reason.split(":")[0]):
            level = "warning" if phase in (Phase.BLOCKED, Phase.FAILED) else "info"
            self.say(t, level, phase.name.lower(), reason)
        self.state(phase, reason)

    def take(self) -> list[Action]:
        """Hands the queued actions out."""
        out, self._out = self._out, []
        return out
