"""Cause of a sudden change: every cause moves what the detector watches along a known direction.

To what `quadid.online.changes` looks for steps in, yaw is added, and how specific force follows the squared speeds
within each half second.  After a change each cause adds to them what is linear in its numbers (l lost thrust, q lost
drag torque, u logarithm of the mass, e change of inertias, x and y of the CG, a steady pull over the mass, v of lost
thrust, i.e. -log(1 - fraction)), with f the specific force, M_i b omega_i^2 by arms, M their sum:

    cause          log(f / sum omega^2)           roll; pitch and yaw alike               cov(log f, log sum omega^2)
    weak_rotor     -l omega_i^2 / sum omega^2     -l M_i / J, in yaw -q M_i / J
    mass_change    -u                             -e M / J, with an offset as cg_offset
    thrust_drop    -v                             -v M / J
    steady_pull    -a / f                                                                 a var(log sum omega^2) / f
    cg_offset                                     roll y b sum omega^2 / J_xx, pitch -x b sum omega^2 / J_yy

Random forces with what was learned of them before the change, their own scatter after it, and priors from physics give
the probability of each cause in closed form (Student t, as `quadid.condition.changes`): an explanation that needs more
numbers, or larger ones, has to spread its probability over more outcomes.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, NamedTuple

import numpy as np

from quadid.checks.motion import ALLOWED
from quadid.chi_square import Z95, survival
from quadid.condition.changes import DRAG_APART, LOSS, REACH, SHIFT, log_student
from quadid.data.rotor_signal import INERTIA_RATE
from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.model import layout as ix
from quadid.online.changes import (
    AFTER,
    BASELINE,
    CHUNK,
    LAG,
    LEAST,
    ChangeDetector,
    ChangePoint,
    Chunk,
    FlightState,
    learned,
)
from quadid.online.checks import Quality, judge
from quadid.online.fusion import DRIFT, Estimator
from quadid.online.grid_buffer import COMPLETE, GridBuffer, Rows
from quadid.online.records import MOST_ERRORS, Job, JobReply, OnlineAlternative, OnlineDiagnosis, OnlineFinding
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

if TYPE_CHECKING:
    from quadid.diagnosis.result import Finding

AFTER_CHANGE = 3.0
"""Data that a change is explained from [s]."""
ASK_FLYING = 2.2
"""Flight judged before a change is looked for [s]."""
SURE = 0.95
"""Probability from which a cause is named with confidence."""
PULL = "steady_pull"
"""Not an effect of a vehicle: what holds or draws it, such as a line; in the finding as a force downwards [N]."""
NOTHING = "nothing"
_ODDS = {"weak_rotor": 0.35, "mass_change": 0.4, PULL: 0.1, "cg_offset": 0.06, "thrust_drop": 0.06, NOTHING: 0.3}
"""Prior odds of what changes suddenly in flight, and of a step that was none."""
_SIZE = 0.2
"""Prior standard deviation of what a mass, a pull or lost thrust changes, as a share of the weight."""
_MASSES = 0.02 * np.exp(0.3 * np.arange(10))
"""Changes of mass that are tried, up and down (logarithms), each with half the step between them as deviation."""
_LOADED = 0.05
"""Prior standard deviation of the change of each inertia that comes with a mass."""
_FEWEST = 10
"""Half seconds of flight before a change without which nothing is known of its random forces."""
_EPS = 1e-6


@dataclass(frozen=True)
class ChangeReply(JobReply):
    """Answer: the most likely finding, or why there is none."""

    finding: OnlineFinding | None = None


@dataclass(frozen=True)
class ChangeRequest(Job):
    """A change to be explained.

    The windows hold data from before the change to after it.

    Attributes:
        theta: full vector known before; z_sigma: standard deviations of its nominal entries, log scale, shape (6,).
        change: what was seen.
        time: when; in the time of the stream's stamps [s].
    """

    reply = ChangeReply

    theta: FloatArray
    z_sigma: FloatArray
    change: ChangePoint
    time: float

    def answer(self) -> ChangeReply:
        """Compares all causes by the probability of what the data show after the change."""
        # 1. Half seconds on either side of the one around the change, which belongs to neither.
        before, after = _chunks(self)
        if len(before) < _FEWEST or len(after) < AFTER:
            return ChangeReply(self.number, "too little data before or after the change", _carried(self))
        # 2. What is left after the change of what was learned before it, with its covariance, by channel.
        b = self.vehicle.mass * float(np.median(np.exp([c.thrust for c in before])))
        channels = [_Left(series, len(before)) for series in _series(self, [*before, *after], b)]
        causes = _causes(self, after, b)
        for channel, effects in zip(channels, np.concatenate([c.columns for c in causes], axis=2), strict=True):
            channel.widened(effects)
        # 3. Probability of each explanation, those of one effect (and rotor) together.
        total, own = np.concatenate([c.left for c in channels]), np.concatenate([c.scale for c in channels])
        spread = np.zeros((len(total),) * 2)
        for k, channel in enumerate(channels):
            part = slice(k * len(after), (k + 1) * len(after))
            spread[part, part] = channel.covariance
        freedom = float(len(before) - 1)
        explained = [_explained(cause, channels, total, spread, freedom, own) for cause in causes]
        evidence = np.array([one.evidence for one in explained])
        shares = np.exp(evidence - evidence.max()) / np.sum(np.exp(evidence - evidence.max()))
        groups: dict[tuple[str, int], list[tuple[float, _Explained]]] = {}
        for share, one in zip(shares.tolist(), explained, strict=True):
            groups.setdefault((one.cause.effect, one.cause.rotor), []).append((share, one))
        ranked = sorted(
            ((sum(s for s, _ in group), max(group, key=lambda g: g[0])[1]) for group in groups.values()),
            key=lambda g: -g[0],
        )
        # 4. The most probable one, unless it is that nothing has changed.
        if ranked[0][1].cause.effect == NOTHING:
            return ChangeReply(self.number, "no known cause explains it", _carried(self))
        return ChangeReply(self.number, finding=_finding(self, ranked, len(groups)))


def _carried(request: ChangeRequest) -> OnlineFinding | None:
    """Finding for a step of thrust where no cause explains it: a force; None for a step of a moment."""
    change = request.change
    if change.channel != "thrust":
        return None
    fraction = float(np.expm1(-change.size))
    newtons = fraction * request.vehicle.mass * GRAVITY
    return OnlineFinding(
        "mass_change",
        {"time": request.time, "fraction": fraction},
        {"time": 0.5, "fraction": abs(fraction / change.errors)},
        {"time": "s", "fraction": ""},
        np.nan,
        np.nan,
        np.nan,
        tuple(OnlineAlternative(effect, np.nan) for effect in (PULL, "thrust_drop")),
        f"thrust per weight stepped by {change.size:+.1%}: {newtons:+.2f} N to hold the vehicle up; a payload, a "
        "steady pull and lost thrust cannot be told apart yet",
        False,
    )


# --- Series before and after a change


def _chunks(request: ChangeRequest) -> tuple[list[Chunk], list[Chunk]]:
    """Half seconds before and after the one around the change, of the stretch of data that holds it."""
    at, reader = request.change.time, ChangeDetector(request.vehicle)
    for window in request.windows:
        if not window.t0 < at < window.t[-1] or window.gyro is None or window.accel is None:
            continue
        size = round(CHUNK / window.dt)
        middle = int(np.searchsorted(window.t, at)) - size // 2
        before, after = list[Chunk](), list[Chunk]()
        for k in range(middle % size, len(window) - size + 1, size):
            chunk = reader.chunk(_rows(window, k, k + size))
            if chunk is not None and k != middle:
                (before if k < middle else after).append(chunk)
        return before, after
    return [], []


def _rows(window: Window, first: int, last: int) -> Rows:
    names = ("rotor_speed", "gyro", "accel", "attitude", "velocity")
    given = {name: getattr(window, name) for name in names}
    columns = {name: values[first:last] for name, values in given.items() if values is not None}
    return Rows(window.t[first:last], columns, window.sampling, "")


class _Series(NamedTuple):
    """Values (n,), regressors (n, k), deviations of their coefficients (k,), least spread, doubt (n, m, k) or None."""

    y: FloatArray
    x: FloatArray
    typical: FloatArray
    least: float
    astray: FloatArray | None = None


def _series(request: ChangeRequest, chunks: Sequence[Chunk], b: float) -> list[_Series]:
    """Thrust, roll, pitch, yaw, and how force follows squared speed."""
    state, vehicle = FlightState(request.vehicle), request.vehicle
    square, growth = np.array([c.square for c in chunks]), np.array([c.growth for c in chunks])
    rate, turning = np.array([c.rate for c in chunks]), np.array([c.gyroscopic for c in chunks])
    lagging = growth.sum(axis=1) / square.sum(axis=1)
    out = [
        _Series(
            np.array([c.thrust for c in chunks]),
            np.column_stack([[c.state for c in chunks], lagging]),
            np.append(state.typical, LAG),
            LEAST / 5.0,
            np.array([np.pad(c.astray, ((0, 0), (0, 1))) for c in chunks]),
        )
    ]
    j, scale = request.theta[2:5], _per_square(request, b)
    couple = np.clip([(j[2] - j[1]) / j[0], (j[0] - j[2]) / j[1], (j[1] - j[0]) / j[2]], -1.0, 1.0)
    sigma = request.z_sigma
    doubt = np.hypot(DRIFT, [*np.hypot(sigma[0], sigma[2:4]), math.hypot(sigma[1], sigma[4])])
    for axis in range(3):
        arms = scale[axis] * vehicle.torque_arms[:, axis]
        moment, half = square @ arms, 0.25 * float(np.abs(arms).sum() * square.mean())
        y = np.array([c.acceleration[axis] for c in chunks]) + couple[axis] * turning[:, axis] - moment
        damping, high = state.typical_moment
        beside, typical = [moment, growth @ arms, rate[:, axis], turning[:, axis]], [doubt[axis], LAG, damping, 1.0]
        if axis < 2:
            beside, typical = [*beside, np.array([c.across[axis] for c in chunks]) / j[axis]], [*typical, high]
        else:  # the rotors' own angular momentum
            spinning = growth @ vehicle.spins / (2.0 * np.sqrt(square.mean())) / j[2]
            beside, typical = [*beside, spinning], [*typical, float(request.theta[5])]
        out.append(_Series(y, np.column_stack(beside), np.array(typical), LEAST / 5.0 * half))
    shared, power = np.array([c.shared for c in chunks]), np.array([c.power for c in chunks])
    least = 1e-4 * math.sqrt(float(power.mean())) + 1e-9
    return [*out, _Series(shared - power, power[:, None], np.array([0.5]), least)]


def _per_square(request: ChangeRequest, b: float) -> FloatArray:
    """Acceleration per squared speed and arm, shape (3,): b / J_xx, b / J_yy, d / J_zz."""
    return np.array([b, b, float(request.theta[1])]) / request.theta[2:5]


class _Left:
    """Remainder of a series after the change, less what follows from the value before (innovations).

    Attributes:
        left: shape (n,).
        covariance: from random forces and coefficients as learned before, wider where the values themselves scatter
            more, beside any cause; shape (n, n).
        scale: deviations of the random forces alone, shape (n,).
    """

    def __init__(self, series: _Series, count: int) -> None:
        """Learns from the first `count` values; the change lies between them and the others, one value long."""
        found = learned(series.y[:count], series.x[:count], series.typical, series.least)
        left, design = series.y - found.design(series.x) @ found.value, found.design(series.x)
        memory, n = found.memory, len(series.y) - count
        # The first value follows one that is two back.
        self._memory = np.concatenate([[memory**2], np.full(n - 1, memory)])
        self.left = self._new(left[count:], left[count - 1 : count])
        unsure = self._new(design[count:], design[count - 1 : count])
        self.scale = found.spread * np.sqrt(np.concatenate([[1.0 + memory**2], np.ones(n - 1)]))
        self.covariance = np.diag(self.scale**2) + unsure @ found.covariance @ unsure.T
        if series.astray is not None:
            off = self._new(series.astray[count:] @ found.value[1:], np.zeros((1, series.astray.shape[1])))
            self.covariance += off @ off.T

    def _new(self, values: FloatArray, first: FloatArray) -> FloatArray:
        before = np.concatenate([first, values[:-1]])
        return np.asarray(values - (self._memory * before.T).T)

    def of(self, effect: FloatArray) -> FloatArray:
        """Innovations that an effect makes which is zero before the change, shape (n, numbers) as given."""
        return self._new(effect, np.zeros((1, effect.shape[1])))

    def widened(self, effects: FloatArray) -> None:
        """Lets the values' own scatter beside `effects`, shape (n, m), count where it is larger."""
        root = np.linalg.cholesky(self.covariance)
        basis, size, _ = np.linalg.svd(np.linalg.solve(root, self.of(effects)), full_matrices=False)
        basis = basis[:, size > 1e-6 * max(float(size[0]), 1e-300)]
        white = np.linalg.solve(root, self.left)
        rest = float(white @ white - np.sum((basis.T @ white) ** 2))
        self.covariance *= max(rest / max(len(white) - basis.shape[1], 1), 1.0)


# --- Explanations, and their probability


class _Cause(NamedTuple):
    """One explanation.

    Attributes:
        effect: its name; rotor: from 1, 0 for none.
        columns: change of the five series by its numbers, shape (5, n, numbers).
        prior: covariance of the numbers; centre: their mean.
        odds: prior probability, but for a factor.
    """

    effect: str
    rotor: int
    columns: FloatArray
    prior: FloatArray
    centre: FloatArray
    odds: float


def _causes(request: ChangeRequest, after: Sequence[Chunk], b: float) -> list[_Cause]:
    """Every explanation, by the table above."""
    vehicle, rotors, n = request.vehicle, len(request.vehicle.rotors), len(after)
    square = np.array([c.square for c in after])
    lift, power = np.array([c.lift for c in after]), np.array([c.power for c in after])
    # Acceleration by rotor and axis, shape (3, n, rotors).
    each = np.einsum("a,nr,ra->anr", _per_square(request, b), square, vehicle.torque_arms)
    whole, none, flat = each.sum(axis=2), np.zeros(n), -np.ones(n)
    along = _per_square(request, b)[:2, None] * square.sum(axis=1)

    def columns(*numbers: tuple[FloatArray, ...]) -> FloatArray:
        return np.stack([np.stack([*number, none][:5]) for number in numbers], axis=2)

    shift = (none, none, -along[1], none), (none, along[0], none, none)
    grown = (none, -whole[0], none, none), (none, none, -whole[1], none), (none, none, none, -whole[2])
    sigma = request.z_sigma
    out = [_Cause(NOTHING, 0, np.zeros((5, n, 0)), np.zeros((0, 0)), np.zeros(0), _ODDS[NOTHING])]

    def add(effect: str, effects: FloatArray, deviation: Sequence[float], part: float = 1.0, mean: float = 0.0) -> None:
        centre = np.zeros(len(deviation))
        centre[0] = mean
        out.append(_Cause(effect, 0, effects, np.diag(np.square(deviation)), centre, _ODDS[effect] * part))

    # What a thrust does to the motion goes by b / J, and a torque by d / J_zz, which may be mere guesses.
    unsure = np.hypot(sigma[[0, 0, 1]], sigma[2:5])
    for k in range(rotors):
        lift_lost = -square[:, k] / square.sum(axis=1)
        turned = [[none, *(-each[a, :, k] if a == axis else none for a in range(3))] for axis in range(3)]
        thrust = lift_lost, -each[0, :, k], -each[1, :, k], none
        effects = columns(thrust, *(tuple(turned[axis]) for axis in (2, 0, 1)))
        for apart, part in DRAG_APART:
            own = np.square([0.0, math.hypot(apart, LOSS * unsure[2]), *(LOSS * unsure[:2])])
            prior = np.diag(own)
            prior[:2, :2] += LOSS**2
            out.append(_Cause("weak_rotor", k + 1, effects, prior, np.zeros(4), _ODDS["weak_rotor"] * part / rotors))
    add("cg_offset", columns(*shift), [SHIFT * vehicle.arm] * 2)
    add("thrust_drop", columns((flat, *(-whole))), [_SIZE])
    add(PULL, columns((-1.0 / lift, none, none, none, power / lift)), [_SIZE * GRAVITY])
    weight = _MASSES * np.exp(-0.5 * (_MASSES / _SIZE) ** 2)
    for mass, part in zip(_MASSES.tolist(), (weight / weight.sum() / 4.0).tolist(), strict=True):
        for sign in (1.0, -1.0):  # in the middle, and somewhere
            sizes = [0.15 * mass, *[_LOADED] * 3]
            central = (flat, none, none, none), *grown
            add("mass_change", columns(*central), sizes, part, sign * mass)
            aside = [REACH * mass * vehicle.arm] * 2
            add("mass_change", columns(*central, *shift), [*sizes, *aside], part, sign * mass)
    return out


class _Explained(NamedTuple):
    """A cause after the fact: log evidence with its odds, numbers, their deviations, mean square left over noise."""

    cause: _Cause
    evidence: float
    value: FloatArray
    sigma: FloatArray
    left: float


def _explained(
    cause: _Cause, channels: Sequence[_Left], total: FloatArray, spread: FloatArray, freedom: float, own: FloatArray
) -> _Explained:
    """Student-t evidence of what is left after the change, and posterior of the cause's numbers."""
    effects = np.concatenate([c.of(part) for c, part in zip(channels, cause.columns, strict=True)])
    beyond = total - effects @ cause.centre
    expected = spread + effects @ cause.prior @ effects.T
    gain = np.linalg.solve(expected, effects @ cause.prior).T
    quadratic, size = beyond @ np.linalg.solve(expected, beyond), np.linalg.slogdet(expected)[1]
    evidence = float(log_student(quadratic, size, freedom, len(total))) + math.log(cause.odds)
    value = cause.centre + gain @ beyond
    sigma = np.sqrt(np.maximum(np.diag(cause.prior - gain @ effects @ cause.prior), 0.0))
    return _Explained(cause, evidence, value, sigma, float(np.mean(((total - effects @ value) / own) ** 2)))


def _finding(request: ChangeRequest, ranked: Sequence[tuple[float, _Explained]], tried: int) -> OnlineFinding:
    share, best = ranked[0]
    nothing = next(one for _, one in ranked if one.cause.effect == NOTHING)
    rivals: dict[str, OnlineAlternative] = {}
    for _, one in ranked[1:]:
        if one.cause.effect not in (best.cause.effect, NOTHING):
            rivals.setdefault(one.cause.effect, OnlineAlternative(one.cause.effect, one.left))
    values, sigma, units = _numbers(request, best)
    gained = 2.0 * max(best.evidence - nothing.evidence, 0.0)
    p_value = min(1.0, survival(gained, max(len(best.value), 1)) * tried)
    seen = request.change
    text = (
        f"{seen.channel} stepped by {seen.size:+.1%} ({seen.errors:.0f} standard errors) at {request.time:.1f} s; "
        f"residual {nothing.left:.2f} falls to {best.left:.2f} with {best.cause.effect}, which is {share:.0%} probable"
    )
    if "loss" in values:
        gone = values["loss"]
        text += f"; rotor {values['rotor']:.0f} gives {abs(gone):.0%} {'less' if gone > 0.0 else 'more'} than before"
        text += ": it has recovered" * (gone < 0.0)
    if seen.channel == "thrust":
        text += f" ({np.expm1(-seen.size) * request.vehicle.mass * GRAVITY:+.2f} N to hold the vehicle up)"
    return OnlineFinding(
        best.cause.effect,
        values,
        sigma,
        units,
        nothing.left,
        best.left,
        p_value,
        tuple(rivals.values()),
        text,
        share >= SURE,
    )


def _numbers(request: ChangeRequest, best: _Explained) -> tuple[dict[str, float], dict[str, float], dict[str, str]]:
    """Values, standard deviations and units in the form of the vehicle file."""
    effect, first, sigma = best.cause.effect, float(best.value[0]), float(best.sigma[0])
    if effect == "weak_rotor":
        left = 1.0 - float(request.theta[ix.LOSS + best.cause.rotor - 1])  # a recovery is a part of what was left
        values = {"rotor": float(best.cause.rotor), "loss": first / left}
        return values, {"loss": sigma / left}, {"rotor": "", "loss": ""}
    if effect == "cg_offset":
        place = {name: float(v) for name, v in zip("xy", best.value, strict=True)}
        return place, {name: float(v) for name, v in zip("xy", best.sigma, strict=True)}, {"x": "m", "y": "m"}
    if effect == PULL:
        mass, units = request.vehicle.mass, {"time": "s", "force": "N"}
        return {"time": request.time, "force": mass * first}, {"time": 0.05, "force": mass * sigma}, units
    fraction = math.expm1(first) if effect == "mass_change" else -math.expm1(-first)
    slope = 1.0 + fraction if effect == "mass_change" else 1.0 - fraction
    units = {"time": "s", "fraction": ""}
    return {"time": request.time, "fraction": fraction}, {"time": 0.05, "fraction": slope * sigma}, units


# --- When a change is looked for, and what is asked once it was seen


class ChangeWatch:
    """Watches one vehicle for sudden changes.

    Attributes:
        seen: the change that is being looked into, or None.
    """

    def __init__(self, vehicle: Vehicle, rows: GridBuffer) -> None:
        """Watches `rows`, which are of `vehicle`."""
        self._vehicle, self._rows = vehicle, rows
        self._detector = ChangeDetector(vehicle)
        self._carried = self._since = 0.0
        self.seen: ChangePoint | None = None

    def restart(self) -> None:
        """Begins anew: the stream was interrupted, or a change was dealt with."""
        self._detector.restart()
        self.seen = None

    def look(self, tick: float, length: float, estimator: Estimator) -> ChangePoint | None:
        """Takes in the last `length` [s] of rows before `tick` [s]; returns a change seen just now."""
        for i in reversed(range(round(length / CHUNK))):
            self._detector.add(self._rows.span(tick - (i + 1) * CHUNK - _EPS, tick - i * CHUNK - _EPS))
        if self.seen is not None:
            return None
        recent = self._rows.cut(tick - ASK_FLYING, tick - _EPS)
        quality = judge(recent, self._vehicle, estimator.thrust, estimator.in_order)
        # A load taken up or dropped in hover looks like a floor while the step is in what is judged, and no longer.
        self._carried = self._carried + length if quality.carried else 0.0
        if recent.reason or (quality != Quality() and not 0.0 < self._carried <= ASK_FLYING):
            self._detector.restart()
            return None
        if quality.carried:
            return None
        inertia = np.array([estimator.value(n) for n in ("J_xx", "J_yy", "J_zz")])
        doubt = np.hypot(DRIFT, estimator.torque_sigma) if estimator.confirmed else None
        step = self._detector.look(estimator.value("b"), inertia, doubt)
        if step is not None:
            self._since = self._detector.since
            if step.channel == "thrust":
                step = replace(step, time=self._rows.onset(step.time))
        self.seen = step
        return step

    def ask(self, number: int, tick: float, estimator: Estimator, stamp: float) -> ChangeRequest | None:
        """The question what the change was that is `seen`, once there is enough data after it.

        Args:
            number: of the request.
            tick: now [s].
            estimator: what was known before.
            stamp: time of the change as a stamp [s].
        """
        if self.seen is None or tick < self.seen.time + AFTER_CHANGE - _EPS:
            return None
        cut = self._rows.cut(max(self.seen.time - BASELINE, self._since) - _EPS, tick - _EPS)
        return ChangeRequest(
            number,
            estimator.vehicle,
            cut.windows,
            self.seen.time,
            tick,
            estimator.theta,
            estimator.z_sigma,
            self.seen,
            stamp,
        )


# --- The diagnosis of a flight while it lasts: now and then `quadid.diagnose` on the last minute, beside the fits
#
# It takes seconds of a processor, so the session does not wait for it: what it found is told once a fixed time of data
# has passed, later only when it took longer than that.


DIAGNOSED_SECONDS = 60.0
"""Flight that a diagnosis looks at [s]."""
ANSWER_AFTER = 30.0
"""Time of the data between question and published answer [s]."""


@dataclass(frozen=True)
class DiagnosisReply(JobReply):
    """Answer, or why there is none.

    Attributes:
        findings: most important first.
        verdict: of `quadid.diagnose`.
    """

    findings: tuple[OnlineFinding, ...] = ()
    verdict: str = ""


@dataclass(frozen=True)
class DiagnosisRequest(Job):
    """The last minute, to be diagnosed.

    Attributes:
        seed: of what is drawn.
        slow: rotors were read too slowly to show lags and delays.
    """

    background: ClassVar[bool] = True
    reply = DiagnosisReply

    seed: int
    slow: bool = False

    def answer(self) -> DiagnosisReply:
        """Diagnoses the windows."""
        from quadid.diagnosis import diagnose  # a large import that only the process which diagnoses needs

        result, _ = diagnose(self.windows, self.vehicle, seed=self.seed, swarm=True)
        findings = tuple(_online(f, self.slow) for f in result.findings)
        return DiagnosisReply(self.number, "", findings, result.verdict.value)


def _online(f: Finding, slow: bool) -> OnlineFinding:
    sure = f.confident and not (slow and EFFECTS[f.effect].needs_fast_rotors)
    return OnlineFinding(
        f.effect,
        {p.name: p.value for p in f.parameters},
        {p.name: (p.ci95[1] - p.ci95[0]) / (2.0 * Z95) for p in f.parameters},
        {p.name: p.unit for p in f.parameters},
        f.gain.mse_before,
        f.gain.mse_after,
        f.p_value,
        tuple(OnlineAlternative(a.effect, a.mse_after) for a in f.alternatives),
        f.evidence,
        sure,
    )


class BackgroundDiagnosis:
    """Asks for diagnoses of one vehicle, and reports what is new in their answers.

    Attributes:
        wrong_scale: a sensor's scale by the last answer, if too large for calibrated ones; else empty.
    """

    def __init__(
        self, vehicle: Vehicle, store: GridBuffer, every: float, seed: int, stamp: Callable[[float], float]
    ) -> None:
        """Studies the rows of `store` every so many seconds of flight [s]; 0: never; `stamp` as of `Outbox`."""
        self._vehicle, self._store, self._every, self._seed, self._stamp = vehicle, store, every, seed, stamp
        self.wrong_scale = ""
        self._asked: DiagnosisRequest | None = None
        self._reply: DiagnosisReply | None = None
        self._last, self._errors = -math.inf, 0
        self._told: DiagnosisReply | None = None

    def ask(self, number: int, tick: float, since: float) -> DiagnosisRequest | None:
        """The next question, if it is time for one.

        Args:
            tick: now [s].
            since: data before this belong to another vehicle [s].
        """
        start = max(tick - DIAGNOSED_SECONDS, since)
        early = tick - self._last < self._every or tick - start < DIAGNOSED_SECONDS
        if not self._every or self._asked is not None or early or self._errors >= MOST_ERRORS:
            return None
        cut = self._store.cut(start, tick)
        if cut.reason or cut.seconds < COMPLETE * (tick - start):
            return None
        self._last = tick
        slow = any(cut.spacing * window.dt > 1.0 / INERTIA_RATE for window in cut.windows)
        self._asked = DiagnosisRequest(number, self._vehicle, cut.windows, start, tick, self._seed, slow)
        return self._asked

    def deliver(self, reply: JobReply) -> None:
        """Takes the answer to the running question; an answer to any other is ignored."""
        if self._asked is not None and self._asked.is_answered_by(reply) and isinstance(reply, DiagnosisReply):
            self._reply = reply

    def answer(self, tick: float, since: float) -> OnlineDiagnosis | None:
        """Part of an answer to publish, when it is time to use it; None where it was published before.

        Args:
            tick: now [s].
            since: an answer about data from before this is no longer true [s].
        """
        asked, reply = self._asked, self._reply
        if asked is None or reply is None or tick < asked.stop + ANSWER_AFTER:
            return None
        self._asked = self._reply = None
        self._errors = self._errors + 1 if reply.is_unexpected else 0
        if asked.start < since:
            return None
        self.wrong_scale = next((f.evidence for f in reply.findings if f.confident and _is_wrong_scale(f)), "")
        if reply.problem or (self._told is not None and _same(self._told, reply)):
            return None
        self._told, stop = reply, self._stamp(asked.stop)
        return OnlineDiagnosis(
            stop, self._stamp(asked.start), stop, tuple(map(self._stamped, reply.findings)), reply.verdict
        )

    def _stamped(self, finding: OnlineFinding) -> OnlineFinding:
        if "time" not in finding.values:
            return finding
        return replace(finding, values={**finding.values, "time": self._stamp(finding.values["time"])})


def _is_wrong_scale(finding: OnlineFinding) -> bool:
    return finding.effect == "gyro_scale" and max(map(abs, finding.values.values()), default=0.0) > ALLOWED


def _same(old: DiagnosisReply, new: DiagnosisReply) -> bool:
    """No news: the same verdict and causes, and no number outside the interval reported before."""
    if old.verdict != new.verdict or [f.effect for f in old.findings] != [f.effect for f in new.findings]:
        return False
    return all(
        abs(b.values.get(name, math.inf) - value) <= Z95 * a.sigma.get(name, 0.0)
        for a, b in zip(old.findings, new.findings, strict=True)
        for name, value in a.values.items()
    )
