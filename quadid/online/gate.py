"""The gate: ordered checks between an estimate and the parameter topic, each with a reason; and the set in force."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field

from quadid.checks.motion import Factor
from quadid.chi_square import Z95
from quadid.online.records import WAITS, Event, OnlineSet, Publish, Reference, SetState
from quadid.parameters import (
    MAY_VANISH,
    NOMINAL_NAMES,
    PRIOR_SHARE,
    TANGENT,
    UNKNOWN,
    ParameterSet,
    Status,
    at_bound,
    impossible_inertia,
)
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

ROOM = 16.0
"""An estimate, or a number that somebody stored, may be off a bare guess by this factor each way."""
LIMITED = (*NOMINAL_NAMES, TANGENT)
"""Parameters that may not jump from one set to the next; effects may."""
MUST_BE_KNOWN = ("b", "J_xx", "J_yy")
"""Without these no set is published; yaw parameters may stay at the vehicle file's values, and say so."""


def with_room(vehicle: Vehicle) -> Vehicle:
    """The vehicle with wide bounds about its bare guesses, as sure of these as before; bounds that it gives stay."""
    parameters = {}
    for name, given in vehicle.parameters.items():
        bounds = given.bounds or (given.initial / ROOM, given.initial * ROOM)
        sigma = given.sigma or (None if given.bounds else given.log_sigma * given.initial)
        parameters[name] = given.model_copy(update={"bounds": bounds, "sigma": sigma})
    return vehicle.model_copy(update={"parameters": parameters})


class GateSettings(BaseModel):
    """Settings of the gate: how cautious it is.

    Attributes:
        approval: ``auto``: what passes is published; ``manual``: it waits for a person.
        windows: windows without a common sample that must agree.
        width: largest half-width of the 95 % interval of b, J_xx, J_yy, relative.
        yaw_width: the same of d, J_zz, J_r, beyond which they stay at the vehicle file's values.
        step: largest change of a parameter from the set in force, relative.
        creep: largest change from the last set that a person approved, or the first of this flight.
        reference: largest change of torque over inertia from that set, from the vehicle file before the first, and
            between windows, that is published without a person: rotor speeds wrong by a factor change it, and a
            controller's gain margin has to bear it.
        inertia_slack: how far the triangle inequality of the inertias may be broken.
        gain: deviance per held-out window that counts as a real gain over the set in force.
        sharper: a set is also published when the interval of a parameter has shrunk to this share,
        pause: but not sooner than this after the last one [s].
        watch: deviance by which a new set may lose to its predecessor before it is taken back.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    approval: Literal["auto", "manual"] = "auto"
    windows: int = Field(default=3, ge=2, le=20)
    width: float = Field(default=0.05, gt=0.0, le=1.0)
    yaw_width: float = Field(default=0.3, gt=0.0, le=3.0)
    step: float = Field(default=0.25, gt=0.0, le=2.0)
    creep: float = Field(default=0.4, gt=0.0, le=4.0)
    reference: float = Field(default=0.025, gt=0.0, le=4.0)
    inertia_slack: float = Field(default=1.5, ge=1.0, le=3.0)
    gain: float = Field(default=6.0, gt=0.0)
    sharper: float = Field(default=0.8, gt=0.0, lt=1.0)
    pause: float = Field(default=10.0, ge=0.0)
    watch: float = Field(default=30.0, gt=0.0)


@dataclass(frozen=True)
class Case:
    """Case of an estimate: all that the gate judges it by.

    Attributes:
        parameters: the estimate.
        excited: whether the newest window revealed anything.
        thrust_ratio: thrust by this estimate over measured specific force times mass, newest window.
        agreeing: windows without a common sample, newest first, that agree with it, up to the first that does not.
        disagreement: what differs in that one, or empty.
        held_out: gain over the set in force (or the first guess) in each window that neither had seen.
        in_force: the set in force.
        baseline: the set from which creeping is measured.
        approval: auto or manual, now.
        age: time since the data that the set in force rests on [s].
        unexplained: what speaks against the model: a sensor's scale that a diagnosis found, or empty.
        doubts: factors that b, J_xx and J_yy may be off by, as the sensors disagree.
        stated: parameters that the vehicle file claims to know.
        walked: change of torque over inertia (log) from the oldest to the newest agreeing window and its standard
            deviation, by the inertia's name.
        between_rows: relative standard deviation by what the rotors do between readings, newest window, by name.
        left_out: of thrust by b w^2 and standard deviations, shape (2, R + 1) (`Estimator.left_out`).
        loaded: why the vehicle may have another mass than in the vehicle file, or empty.
    """

    parameters: ParameterSet
    excited: bool
    thrust_ratio: float
    agreeing: int
    disagreement: str
    held_out: tuple[float, ...]
    in_force: OnlineSet | None
    baseline: OnlineSet | None
    approval: str
    age: float = math.inf
    unexplained: str = ""
    doubts: tuple[Factor, ...] = ()
    stated: ParameterSet = field(default_factory=lambda: ParameterSet((), np.zeros((0, 0))))
    walked: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    between_rows: Mapping[str, float] = field(default_factory=dict)
    left_out: FloatArray = field(default_factory=lambda: np.zeros((2, 2)))
    loaded: str = ""


@dataclass(frozen=True)
class Decision:
    """Outcome: the state the set gets, the check that decided, and why."""

    state: SetState
    check: str
    reason: str


Check = Callable[[Case, GateSettings], str | None]


def decide(case: Case, settings: GateSettings) -> Decision:
    """Runs the checks in order; the first that objects decides."""
    for name, check in CHECKS:
        reason = check(case, settings)
        if reason is None:
            continue
        if name == "step_limit" and _step(case, settings, 2.0) is None:
            return Decision(SetState.PENDING, name, f"{reason}: a person must approve it")
        return Decision(SetState.REJECTED, name, reason)
    for name, check in JUDGED:
        reason = check(case, settings)
        if reason is not None:
            return Decision(SetState.PENDING, name, f"{reason}: a person must approve it")
    story = f"{case.agreeing} windows agree; {_gain_text(case)}"
    if case.approval != "auto":
        return Decision(SetState.PENDING, "approval", f"{WAITS}{story}")
    return Decision(SetState.ACCEPTED, "approval", story)


def _excitation(case: Case, settings: GateSettings) -> str | None:
    return None if case.excited else "the newest window does not reveal roll and pitch dynamics: move the sticks more"


def implausible(parameters: ParameterSet, settings: GateSettings) -> str | None:
    """Why no vehicle has these parameters, whoever estimated or stored them; None when one may."""
    for p in parameters:
        if not math.isfinite(p.value) or not 0.0 <= p.sigma < math.inf:
            return f"{p.name} = {p.value:g} {p.unit} with standard deviation {p.sigma:g} is not a number"
        if p.name in LIMITED and not p.value > 0.0:
            return f"{p.name} = {p.value:g} {p.unit} is not positive"
        low, high = p.bounds
        guessed = p.status is Status.PRIOR_DOMINATED or p.prior_share > PRIOR_SHARE**2
        guessed |= p.name == MAY_VANISH and p.value < high / 2.0
        if at_bound(p.value, low, high) and not guessed:
            return f"{p.name} = {p.value:.4g} {p.unit} rests on its bound [{low:.4g}, {high:.4g}]"
    why = impossible_inertia([parameters[n].value for n in ("J_xx", "J_yy", "J_zz")], settings.inertia_slack)
    return f"impossible inertia: {why}" if why else None


def _bounds(case: Case, settings: GateSettings) -> str | None:
    why = implausible(case.parameters, settings)
    if why:
        return why
    if not (case.thrust_ratio > 0.0 and abs(math.log(case.thrust_ratio)) <= settings.width):
        return f"b would give {case.thrust_ratio:.2f} times the thrust measured by the accelerometer"
    return None


def _width(case: Case, settings: GateSettings) -> str | None:
    for p in case.parameters:
        half = Z95 * p.sigma / max(abs(p.value), 1e-300)
        if p.name in MUST_BE_KNOWN and (p.status in UNKNOWN or half > settings.width):
            missed = Z95 * case.between_rows.get(p.name, 0.0)
            text = f"{p.name} is known to {half:.2%} only, wanted {settings.width:.2%}: keep flying"
            unseen = f"; what the rotors do between readings moves it by {missed:.0%}"
            way = "log motors faster (80 Hz, not 50), or fly more smoothly"
            return f"{text}{unseen}: {way}" if missed > settings.width else text
    return None


def _agreement(case: Case, settings: GateSettings) -> str | None:
    if case.disagreement:
        return f"windows disagree: {case.disagreement}"
    if case.agreeing < settings.windows:
        return f"{case.agreeing} of {settings.windows} windows without a common sample agree so far: keep flying"
    for name, (change, sigma) in case.walked.items():
        if _far(change, sigma, settings.reference):
            return f"torque over inertia ({name}) walks: {math.expm1(change):+.1%} from the first to the last of them"
    return None


def _held_out(case: Case, settings: GateSettings) -> str | None:
    fresh = case.in_force is None or case.in_force.state is SetState.STALE
    if fresh and not case.held_out:
        return "no window yet that the estimate has not seen"
    if not all(math.isfinite(g) for g in case.held_out):
        return "the estimate cannot be scored on data it has not seen"
    total, n = sum(case.held_out), len(case.held_out)
    if total < -settings.gain * n:
        return f"predicts unseen data worse than the set in force: deviance {-total:.1f} more in {n} windows"
    if fresh or (n and total > settings.gain * n) or _is_sharper(case, settings):
        return None
    return "no improvement over the set in force: it predicts as well with about as narrow intervals"


def _is_sharper(case: Case, settings: GateSettings) -> bool:
    assert case.in_force is not None
    old = case.in_force
    return case.age >= settings.pause and any(
        p.sigma < settings.sharper * old.told_by_flight(p.name) and p.status not in UNKNOWN
        for p in case.parameters
        if p.name in old.parameters.names
    )


def _too_far(off: FloatArray, sigma: FloatArray, settings: GateSettings) -> tuple[bool, bool]:
    """True if something may be off by more than a parameter's interval may be wide; and if more data would show it."""
    half = Z95 * sigma
    far, surely = np.abs(off) + half > settings.width, np.abs(off) - half > settings.width
    return bool(far.any()), bool((far & (half > 0.5 * settings.width)).any() and not surely.any())


def _unproven(case: Case, settings: GateSettings) -> str | None:
    """Open questions before anything is published: agreement of sensors, thrust against speed."""
    for f in case.doubts:
        if _too_far(np.array([f.off]), np.array([f.sigma]), settings)[1]:
            return f"{f}, wanted +- {0.5 * settings.width / Z95:.3f}: whether the sensors agree is not known yet"
    value, sigma = case.left_out[:, :-1]
    if _too_far(value, sigma, settings)[1]:
        half = Z95 * float(sigma.max())
        return f"how thrust follows rotor speed is known to {half:.1%} only, wanted {0.5 * settings.width:.1%}: climb"
    return None


def _doubtful(case: Case, settings: GateSettings) -> str | None:
    for f in case.doubts:
        if _too_far(*_together(f, case), settings)[0]:
            also = f" and thrust {math.expm1(_hidden(case)[0]):+.1%} off the set's thrust"
            return f"{f}{also}: b, J_xx and J_yy may be off by it, allowed {settings.width:.0%}"
    return None


def _together(factor: Factor, case: Case) -> tuple[FloatArray, FloatArray]:
    """Distance of a factor from 1, with what thrust leaves out beside it, and the standard deviation; shapes (1,).

    Each may be within its own limit: an accelerometer 3 % high under a gyro 2.5 % high, and a support of 4 %.
    """
    value, sigma = _hidden(case)
    return np.array([abs(factor.off) + abs(value)]), np.array([math.hypot(factor.sigma, sigma)])


def _hidden(case: Case) -> tuple[float, float]:
    """Error of all rotors' thrust alike by the set, and its standard deviation.

    The change of thrust with speed off b w^2, or, where the set states that change, what is carried while no rotor
    turns: a curve of the rotors' own is no error of such a set.
    """
    slope, at_rest = case.left_out[:, :-1].mean(axis=1), case.left_out[:, -1]
    stated = TANGENT in case.parameters.names and abs(at_rest[0]) + Z95 * at_rest[1] < abs(slope[0]) + Z95 * slope[1]
    value, sigma = (at_rest if stated else slope).tolist()
    return float(value), float(sigma)


def _left_out(case: Case, settings: GateSettings) -> str | None:
    """Thrust that the set leaves out: the fit contains it, a user of the set does not."""
    value, sigma = case.left_out[:, :-1]
    own, (hidden, spread) = value - value.mean(), _hidden(case)
    if not _too_far(own + hidden, np.maximum(sigma, spread), settings)[0]:
        return None
    worst = int(np.argmax(np.abs(own)))
    if abs(own[worst]) > abs(value.mean()):
        off = f"rotor {worst + 1} gives {math.expm1(value[worst]):+.0%} against b"
        return f"{off}: it is not like the others, or its speed is read wrongly"
    off = f"thrust changes with rotor speed {math.expm1(value.mean()):+.0%} off b w^2"
    return f"{off}: a thrust curve that the vehicle file lacks, a support or pull, or an accelerometer's scale"


def _step(case: Case, settings: GateSettings, times: float = 1.0) -> str | None:
    """Steps beyond so many times the limits: a person may approve up to twice."""
    for reference, limit, what in (
        (case.in_force, times * settings.step, "the set in force"),
        (case.baseline, times * settings.creep, "the approved baseline"),
    ):
        if reference is None:
            continue
        for p in case.parameters:
            if p.name not in reference.parameters.names:
                continue
            old = reference.parameters[p.name]
            known = not UNKNOWN & {p.status, old.status}
            change = p.value / old.value - 1.0 if p.name in LIMITED and old.value > 0.0 else 0.0
            # A value that was only guessed before may be learned: it may move as far as its own interval.
            own = reference.told_by_flight(p.name)
            room = limit + (2.0 * own / old.value if known and old.value > 0.0 else math.inf)
            if abs(math.log1p(change)) > math.log1p(room):
                return f"{p.name} would change by {change:+.0%} from {what}, allowed {limit:.0%}"
    return None


def _reference(case: Case, settings: GateSettings) -> str | None:
    """First trusted values: inertias, and torque over inertia, a controller's gain, which mass leaves as it is.

    Room is left for what the reference did not know of itself. The estimate's own deviation gives none: rotor speeds
    that drift widen it, and what it cannot tell apart from the reference it has not shown to be near it. Nor does what
    a set's own reference left open: a support or another mass changes that from flight to flight.
    """
    known, common, what = case.stated, 0.0, "the vehicle file"
    if case.baseline is not None:
        known, common = case.baseline.parameters, case.baseline.reference_sd
        what = "the first accepted or last approved set"
    covariance = known.covariance / np.outer(known.values, known.values) - common**2
    slopes = [TANGENT if TANGENT in some.names else "b" for some in (known, case.parameters)]
    for name in ("J_xx", "J_yy"):
        for shares, limit, of, looks in (
            ({slopes[0]: 1.0, name: -1.0}, settings.reference, f"torque over inertia ({name})", "rotor speeds"),
            ({name: 1.0}, settings.width, name, "a mass, an accelerometer or a gyro"),
        ):
            at = [k for k, p in enumerate(known) if p.name in shares and p.status not in UNKNOWN]
            share = np.array([shares[known.names[k]] for k in at])
            names = [slopes[1] if known.names[k] == slopes[0] else known.names[k] for k in at]
            now = np.array([case.parameters[n].value for n in names])
            change = float(share @ np.log(now / known.values[at]))
            if _far(change, math.sqrt(max(share @ covariance[np.ix_(at, at)] @ share, 0.0)), limit):
                off = f"{of} is {math.expm1(change):+.1%} off {what}, allowed {limit:.1%}"
                return f"{off}: {looks} wrong by a factor would look like this"
    return None


def _far(change: float, sigma: float, limit: float) -> bool:
    return abs(change) > math.log1p(limit) + 2.0 * sigma


def _gain_text(case: Case) -> str:
    total, n = float(np.sum(case.held_out)), len(case.held_out)
    if n == 0:
        return "narrower intervals than before"
    how = "better" if total > 0.0 else "no better"
    return f"{how} on {n} held-out window{'s' * (n != 1)} (deviance {-total:+.1f})"


CHECKS: tuple[tuple[str, Check], ...] = (
    ("excitation", _excitation),
    ("model", lambda case, _: case.unexplained or None),
    ("physical_bounds", _bounds),
    ("interval_width", _width),
    ("agreement", _agreement),
    ("sensors", _unproven),
    ("held_out_gain", _held_out),
    ("step_limit", _step),
)
"""Name and function of every check, in the order in which they are asked."""
JUDGED: tuple[tuple[str, Check], ...] = (
    ("mass", lambda case, _: case.loaded or None),
    ("thrust", _left_out),
    ("sensors", _doubtful),
    ("reference", _reference),
)
"""Checks that no further flight settles: a person decides."""


# --- Set in force: numbering, approval, watching a new set against its predecessor, rollback


Action = Publish | Event
FORCE = 0.09
"""Standard deviation (log scale) of force where nothing else measures it. A support, and an accelerometer's scale that
hides it and is itself hidden by a bias, are not seen at any size: 15 % of the weight beside a scale of 1.17 (b +17 %)
are within two standard deviations. Accelerometers are sold with scales up to 10 % off."""
MOST_HELD = 60
"""Sets that wait and can still be approved by their numbers: at a refit a second, those of the last minute."""


@dataclass(frozen=True)
class Answer:
    """Answer to a command: whether it did something, and a sentence."""

    done: bool
    text: str
    actions: tuple[Action, ...] = ()


class ActiveSet:
    """Accepted sets of one vehicle.

    Attributes:
        in_force: the set that the parameter topic holds; None before the first.
        baseline: set from which creeping is measured: the last one a person approved, else the first.
        approval: auto or manual; a rollback by a person makes it manual.
        seen: end of the data that the set in force rests on [s, session time]; minus infinity for none of this flight.
        watched: deviance lost to the predecessor so far; gains do not pile up.
        load: mass over that of the vehicle file, as changes since a person last approved a set tell it.
    """

    def __init__(
        self,
        approval: str,
        restored: OnlineSet | None = None,
        next_sequence: int = 1,
        baseline: OnlineSet | None = None,
        load: float = 1.0,
    ) -> None:
        """Starts empty, or from the last accepted set of an earlier run, which is stale until revalidated.

        Args:
            approval: auto or manual.
            restored: set in force when the earlier run ended.
            next_sequence: first number not yet given.
            baseline: what creeping is measured from; default `restored`.
            load: as an earlier run left it.
        """
        self.approval, self.load = approval, load
        self._held: dict[int, tuple[OnlineSet, float]] = {}
        self.in_force: OnlineSet | None = None
        self._earlier: list[OnlineSet] = []
        self._next = max(next_sequence, restored.sequence + 1 if restored else 1)
        if restored is not None:
            reason = f"from an earlier run ({restored.reason}): not yet confirmed by this flight"
            # A number of its own: who uses the set already learns that it is stale now.
            self.in_force = replace(restored, sequence=self._number(), state=SetState.STALE, reason=reason)
        self.baseline = baseline or self.in_force
        self._trusted = self.baseline is not None
        self.seen = -math.inf
        self.watched, self._watch_from = 0.0, math.inf

    @property
    def pending(self) -> OnlineSet | None:
        """The newest set that waits for approval."""
        return next(reversed(self._held.values()))[0] if self._held else None

    @property
    def predecessor(self) -> OnlineSet | None:
        """The set a rollback would return to."""
        return self._earlier[-1] if self._earlier else None

    def reference(self, stated: ParameterSet) -> tuple[Reference, float]:
        """Reference of a set, and the standard deviation (log scale) of the force by it.

        Args:
            stated: parameters that the vehicle file claims to know.
        """
        if self.baseline is not None:
            return "history" if self._trusted else self.baseline.reference, self.baseline.reference_sd
        if "b" in stated.names:
            return "vehicle_file", min(stated["b"].sigma / stated["b"].value, FORCE)
        return "none", FORCE

    def accept(self, item: OnlineSet, by: str, t: float, stop: float) -> list[Action]:
        """Puts a set in force.

        Args:
            by: who approved it.
            t: now, as a stamp [s].
            stop: end of the data it rests on [s, session time].
        """
        accepted = replace(item, sequence=self._number(), state=SetState.ACCEPTED, approved_by=by)
        if self.in_force is not None and self.in_force.state is not SetState.STALE:
            self._earlier.append(self.in_force)
            del self._earlier[:-20]
        self.in_force = accepted
        self._held.clear()
        if self.baseline is None or by != "auto":
            self.baseline = accepted
        if by != "auto":
            self._trusted, self.load = True, 1.0
        self.watched, self._watch_from, self.seen = 0.0, stop, stop
        told = f"set {accepted.sequence} in force (reference: {accepted.reference}): {accepted.reason}"
        return [Publish("parameters", accepted), Event(t, "info", "accepted", told)]

    def withdraw(self, why: str, code: str) -> list[Action]:
        """Marks the set in force as out of date; it stays what there is until the next one.

        Args:
            why: one sentence.
            code: an effect's name, ``unknown_cause`` or ``disagreement``.
        """
        if self.in_force is None or self.in_force.outdated:
            return []
        self.in_force = replace(self.in_force, sequence=self._number(), outdated=why, outdated_code=code)
        return [Publish("parameters", self.in_force)]

    def hold(self, item: OnlineSet, stop: float) -> OnlineSet:
        """Keeps a set for approval, under a number that stands for it and no other; `stop` as in `accept`."""
        held = replace(item, sequence=self._number(), state=SetState.PENDING)
        self._held[held.sequence] = (held, stop)
        if len(self._held) > MOST_HELD:
            del self._held[next(iter(self._held))]
        return held

    def drop_pending(self) -> None:
        """Forgets the sets that wait for approval."""
        self._held.clear()

    def approve(self, t: float, by: str, sequence: int | None = None) -> Answer:
        """A person approves one of the sets that wait, by its number; without one the newest.

        A second approval, or one of a number that does not wait, does nothing.
        """
        if self.pending is None:
            return Answer(False, "nothing waits for approval")
        number = self.pending.sequence if sequence is None else sequence
        if number not in self._held:
            return Answer(
                False, f"set {number} does not wait for approval; the newest that does is {self.pending.sequence}"
            )
        waited, stop = self._held[number]
        item = replace(waited, reason=f"approved by {by}: {waited.reason.removeprefix(WAITS)}")
        actions = self.accept(item, by, t, stop)
        assert self.in_force is not None
        return Answer(True, f"set {number} approved, in force as set {self.in_force.sequence}", tuple(actions))

    def roll_back(self, t: float, by: str, why: str = "") -> Answer:
        """Returns to the set before the one in force, under a new number; what made that out of date made both."""
        if not self._earlier:
            return Answer(False, "there is no earlier set to return to")
        assert self.in_force is not None
        bad, good = self.in_force, self._earlier.pop()
        reason = f"set {good.sequence} again, in place of set {bad.sequence}: {why or 'asked for by ' + by}"
        self.in_force = replace(
            good,
            sequence=self._number(),
            state=SetState.ROLLED_BACK,
            reason=reason,
            approved_by=by,
            outdated=good.outdated or bad.outdated,
            outdated_code=good.outdated_code if good.outdated else bad.outdated_code,
        )
        self._held.clear()
        self._watch_from = math.inf
        if by != "auto":
            self.approval, self.baseline, self._trusted = "manual", self.in_force, True
        event = Event(t, "warning", "rollback", reason)
        return Answer(True, reason, (Publish("parameters", self.in_force), event))

    def watch(self, start: float, stop: float, loss: float) -> bool:
        """Adds what the set in force lost to its predecessor in a window it had not seen.

        Args:
            start: of the window [s, session time]; windows count once, and only after the set was made.
            stop: its end [s].
            loss: deviance of the set in force above that of its predecessor.

        Returns:
            The window was counted.
        """
        if start < self._watch_from - 1e-6:
            return False
        self._watch_from = stop
        self.watched = max(self.watched + loss, 0.0)
        return True

    def _number(self) -> int:
        self._next += 1
        return self._next - 1
