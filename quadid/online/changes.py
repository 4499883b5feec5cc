"""Sudden changes, seen within seconds: effective thrust per weight, and roll and pitch moments that nothing commands.

Every half second gives three numbers that need no fit: the specific force per sum of squared rotor speeds (its level is
b / m), and the roll and pitch acceleration that the rotors do not explain.  In wind they wander: how far, and for how
long, is learned from the flight before the last seconds, and a step is a change of mean of what does not follow from
the number before (generalised likelihood ratio for a step of unknown time in innovations: Basseville and Nikiforov,
*Detection of Abrupt Changes*, 1993, ch. 2.4 and 7.2).

All three also change with how the vehicle flies: thrust with rotor speed (thrust curve), climb (inflow, drag) and
sideways speed, moments with what is commanded (b / J is not known exactly), rate and sideways speed.  A step is what
these do not explain.  To first order in each effect of the catalogue (`quadid.model.equations`), with omega_h the hover
speed, N rotors, f the specific force along -z, u, v, w the velocity in body axes, and M the roll moment by b omega^2
(pitch alike, with u):

    log(f / sum omega^2) = const - 2 dead_speed sum omega / sum omega^2     thrust_curve
                           + k_z w sum omega / (N omega_h f)                axial_inflow: w < 0 in climb
                           + k (u^2 + v^2) / f                              translational_lift
                           + c_z |(u, v, w)| w / f                          parasitic_drag
    p' - M / J_xx        = const + error(b / J_xx) M                        what is known of b and J
                           - l_p p                                          rate_damping
                           - k_y h m v / J_xx                               rotor_drag h above the centre of gravity
"""

import math
from collections import deque
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadid.data.window import median
from quadid.model.layout import Layout
from quadid.online.grid_buffer import Rows
from quadid.rotation import conjugate, rotated
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle

CHUNK = 0.5
"""Time that gives one set of numbers [s]."""
BASELINE = 40.0
"""Time before a change that it is compared with, at most [s]; at least a fifth of it."""
LOOK_BACK = 8.0
"""A change is looked for in this much past [s], and compared with what was learned before."""
AFTER = 3
"""Chunks after that in which a change happens before it is believed."""
SIGNIFICANT = 5.0
"""Standard errors of a change."""
LAG = 0.05
"""Rotors may follow what is logged of them this much later [s]."""
LEAST = 0.03
"""Smallest step worth a word: share of thrust; roll and pitch moment over what losing half the thrust would give."""
ASTRAY = 0.5
"""Standard deviation, an axis, of a velocity that was integrated [m/s]."""
SETTLED = 0.01
"""A reweighted regression is done when no coefficient moves by more than this share of its standard deviation,"""
MOST_ROUNDS = 50
"""... or after so many fits."""
MOST_MEMORY = 0.9
"""Largest correlation of random forces from chunk to chunk: what lasts longer is no force, but a constant."""
_FREE = 1e-9
"""Precision of a constant of which nothing is known."""


# --- How a vehicle flies, as regressors of what a change is looked for in, and a step beside them


class Velocity:
    """Velocity of a vehicle, as well as it is known: measured, or integrated from the specific force.

    Attributes:
        sigma: standard deviation of the newest rows, an axis [m/s].
    """

    def __init__(self) -> None:
        """Starts at rest."""
        self._at, self.sigma = np.zeros(3), ASTRAY

    def body(self, rows: Rows) -> FloatArray:
        """Velocity in body axes [m/s] of the next rows, shape (n, 3); zero where no attitude shows what is up."""
        q, force = rows.columns.get("attitude"), rows.columns["accel"]
        if q is None or len(rows.t) < 2:
            return np.zeros_like(force)
        step, known = float(rows.t[1] - rows.t[0]), np.isfinite(q).all(axis=1)
        q = q[np.maximum.accumulate(np.where(known, np.arange(len(q)), np.argmax(known)))]
        gain = np.nan_to_num(rotated(q, force) + [0.0, 0.0, GRAVITY]) * step
        gained = np.cumsum(gain, axis=0) - 0.5 * gain
        # What nobody measures is integrated, and forgotten within 40 s.
        start = self._at * math.exp(-step * len(rows.t) / 40.0)
        measured, self.sigma = rows.columns.get("velocity"), ASTRAY
        if measured is not None and (here := np.isfinite(measured).all(axis=1)).any():
            start, self.sigma = np.mean(measured[here] - gained[here], axis=0), 0.0
        self._at = start + gain.sum(axis=0)
        return np.nan_to_num(rotated(conjugate(q), start + gained))


class FlightState:
    """Regressors of one vehicle.

    Attributes:
        typical: standard deviations of the coefficients of thrust before any data, shape (4,).
        typical_moment: of those of a moment but the first, shape (2,).
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Sizes are those of the table of effects, for `vehicle`."""
        layout, self._hover = Layout(vehicle), vehicle.hover_speed()
        dead, inflow, lift, drag, damping, along, high = (
            layout.entry(n).typical
            for n in (
                "thrust_curve.dead_speed",
                "axial_inflow.k_z",
                "translational_lift.k",
                "parasitic_drag.beside_z",
                "rate_damping.l_p",
                "rotor_drag.k_x",
                "rotor_drag_moment.h_x",
            )
        )
        self.typical = np.array([2.0 * dead, inflow, lift, drag])
        self.typical_moment = np.array([damping, along * high * vehicle.mass])

    def thrust(self, speed: FloatArray, velocity: FloatArray, lift: float) -> FloatArray:
        """Regressors of log thrust per squared speed over one stretch, shape (4,).

        Args:
            speed: rotor speeds [rad/s], shape (n, rotors).
            velocity: in body axes [m/s], shape (n, 3).
            lift: mean specific force along -z [m/s^2].
        """
        total, square = speed.sum(axis=1), (speed**2).sum(axis=1)
        flat, w = velocity[:, 0] ** 2 + velocity[:, 1] ** 2, velocity[:, 2]
        return np.array(
            [
                -total.mean() / square.mean(),
                np.mean(w * total) / (speed.shape[1] * self._hover * lift),
                flat.mean() / lift,
                np.mean(np.sqrt(flat + w * w) * w) / lift,
            ]
        )


class Learned(NamedTuple):
    """Constant and slopes of a series on its regressors, learned from its past, and the random forces in it.

    Attributes:
        middle: mean of the regressors, shape (k,).
        value: the series there, then its slopes, shape (k + 1,).
        covariance: of these, shape (k + 1, k + 1).
        memory: correlation of what is left with what was left one value before.
        spread: standard deviation of it beside what follows from the value before (innovation).
    """

    middle: FloatArray
    value: FloatArray
    covariance: FloatArray
    memory: float
    spread: float

    def design(self, x: FloatArray) -> FloatArray:
        """Factors of the coefficients, shape (n, k + 1)."""
        return np.column_stack([np.ones(len(x)), x - self.middle])


def learned(y: FloatArray, x: FloatArray, typical: FloatArray, least: float) -> Learned:
    """Regression beside first-order random forces, in which outliers count for next to nothing (Cauchy).

    A gust moves the vehicle, and its autopilot the rotors, within the same value: taken as they are, regressors that
    follow the gust would explain it, and later half of every step.  The part of a regressor that does not follow from
    its value before may be the gust's doing, so it has a coefficient of its own beside, as large as if all of the force
    were in it (control function: two-stage least squares where forces rule, least squares where the sticks do).

    Args:
        y: series, shape (n,).
        x: its regressors, shape (n, k).
        typical: standard deviations of their coefficients before any data, shape (k,).
        least: smallest spread.
    """
    size = x.shape[1] + 1
    middle = x.mean(axis=0)
    apart = x - middle
    follows = np.sum(apart[1:] * apart[:-1], axis=0) / np.maximum(np.sum(apart[:-1] ** 2, axis=0), 1e-300)
    sudden = apart[1:] - follows * apart[:-1]
    power = np.mean(sudden**2, axis=0)
    memory, spread, weight = 0.0, max(1.4826 * median(np.abs(y - median(y))), least), np.ones(len(y) - 1)
    found = Learned(middle, np.zeros(size), np.eye(size), memory, spread)
    for done in range(MOST_ROUNDS):
        rows = np.column_stack([np.full(len(y) - 1, 1.0 - memory), apart[1:] - memory * apart[:-1], sudden])
        prior = np.concatenate([[_FREE], typical**-2.0, power / spread**2 + 1e-300])
        # Weights of this kind leave a normal's mean 1.25 times as uncertain.
        weighted = rows.T * (weight / (1.25 * spread) ** 2)
        covariance = np.linalg.inv(weighted @ rows + np.diag(prior))
        value = (covariance @ (weighted @ (y[1:] - memory * y[:-1])))[:size]
        covariance = covariance[:size, :size]
        settled = np.abs(value - found.value) <= SETTLED * np.sqrt(np.diag(covariance))
        left = y - found.design(x) @ value
        new = left[1:] - memory * left[:-1]
        spread = max(1.4826 * median(np.abs(new)), least)
        weight = 1.0 / (1.0 + (new / (2.0 * spread)) ** 2)
        wide = 3.0 * spread / math.sqrt(1.0 - memory**2)
        tame = np.clip(left - median(left), -wide, wide)
        memory = min(max(float(tame[1:] @ tame[:-1]) / max(float(tame @ tame), 1e-300), 0.0), MOST_MEMORY)
        found = Learned(middle, value, covariance, memory, spread)
        if done and settled.all():
            break
    return found


def step_beside(
    y: FloatArray, x: FloatArray, typical: FloatArray, first: int, least: float, astray: FloatArray | None = None
) -> tuple[float, float, int]:
    """Clearest step of `y` from `first` on, beside what its regressors and random forces explain.

    Coefficients and random forces are those of the values before `first`.  A step is a change of the mean of the
    innovations after it (generalised likelihood ratio beside coloured noise); the value in which it happens holds any
    part of it.  Where these innovations scatter more than was learned, beside the step, their own scatter counts.

    Args:
        y: series, shape (n,).
        x: its regressors, shape (n, k).
        typical: standard deviations of their coefficients before any data, shape (k,).
        first: index of the first value in which a step is looked for.
        least: smallest step; a smaller one counts as none.  No value is trusted to better than a fifth of it, because
            what no regressor describes does not average out.
        astray: ways in which the regressors may all be off together, each by one standard deviation, shape (n, m, k).

    Returns:
        Its size in standard errors, the step, and the index of the value in which it happens.
    """
    found = learned(y[:first], x[:first], typical, least / 5.0)
    design = found.design(x)
    left = y - design @ found.value
    new = left[first:] - found.memory * left[first - 1 : -1]
    unsure = design[first:] - found.memory * design[first - 1 : -1]
    count, splits = len(new), len(new) - 1
    weight = np.linalg.inv(found.spread**2 * np.eye(count) + unsure @ found.covariance @ unsure.T)
    # Innovations by one odd value (a column for each), and by a step that lasts; the odd value is taken out of both.
    odd = np.eye(count) - found.memory * np.eye(count, k=-1)
    step, odd = (odd @ np.tri(count))[:, :splits], odd[:, :splits]
    seen, own = weight @ odd, np.sum(odd * (weight @ odd), axis=0)
    gain = weight @ step - seen * (np.sum(seen * step, axis=0) / own)
    power = np.sum(step * gain, axis=0)
    size = new @ gain / power
    rest = new @ weight @ new - (new @ seen) ** 2 / own - size**2 * power
    scatter = np.maximum(rest / (count - 2), 1.0)
    variance = scatter / power
    if astray is not None:
        after = np.array([astray[first + j :].mean(axis=0) @ found.value[1:] for j in range(splits)])
        variance += np.sum(after**2, axis=1)
    # Few values tell the spread: Student's t, as a normal deviate as rare (the part of the variance that rests on it).
    share = found.spread**2 * scatter * np.sum(gain**2, axis=0) / power**2 / variance
    freedom = (first - 1) / share**2
    errors = np.sqrt(freedom * np.log1p(size**2 / variance / freedom))
    # The size comes best from what is left: the test leans on the first moments, in which rotors lag and drag swings.
    lasting = np.array([left[first + j + 1 :].mean() for j in range(splits)])
    errors *= (np.abs(lasting) >= least) & (lasting * size > 0.0)
    best = int(np.argmax(errors))
    # Where the newest values alone would be the step, those to come tell it better.
    return float(errors[best]) * (best + AFTER < count), float(lasting[best]), first + best


# --- Numbers every half second, and the strongest step in them


CHANNELS = ("thrust", "roll moment", "pitch moment")
"""Signals in which a step is looked for."""
_Series = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Values, regressors, typical sizes of their coefficients, how regressors may be off (`step_beside`)."""


@dataclass(frozen=True)
class ChangePoint:
    """A step in what the rotors explain.

    Attributes:
        time: when [s]; to a row in thrust, to half a second in a moment.
        channel: thrust, roll moment or pitch moment.
        size: share of thrust (log), or moment over half the hover moment of one side.
        errors: its size in standard errors.
    """

    time: float
    channel: str
    size: float
    errors: float


@dataclass(frozen=True)
class Chunk:
    """Means over one chunk.

    Attributes:
        t: its middle [s].
        lift: specific force along -z [m/s^2].
        thrust: log thrust per squared speed; state: its regressors, shape (4,).
        astray: change of these by a standard deviation of each axis of velocity, shape (3, 4); sigma: that deviation
            [m/s].
        shared: covariance of log thrust and log squared speed within the chunk; power: variance of the latter.
        acceleration: slope of the rates [rad/s^2], shape (3,); rate: [rad/s], shape (3,).
        gyroscopic: q r, p r, p q [rad^2/s^2], shape (3,); across: velocity v, u [m/s], shape (2,).
        square: squared rotor speeds weighed as the slope weighs accelerations, and their slope, shape (rotors,).
    """

    t: float
    lift: float
    thrust: float
    state: FloatArray
    astray: FloatArray
    sigma: float
    shared: float
    power: float
    acceleration: FloatArray
    rate: FloatArray
    gyroscopic: FloatArray
    across: FloatArray
    square: FloatArray
    growth: FloatArray


class ChangeDetector:
    """Finds steps in the rows of one flight."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Watches flights of `vehicle`."""
        self._vehicle = vehicle
        self._arms = vehicle.torque_arms[:, :2]
        self._state = FlightState(vehicle)
        self._velocity = Velocity()
        self._chunks: deque[Chunk] = deque(maxlen=round((BASELINE + LOOK_BACK) / CHUNK))

    def restart(self) -> None:
        """Forgets the past: a change was dealt with, or the flight was interrupted."""
        self._chunks.clear()
        self._velocity = Velocity()

    def add(self, rows: Rows | None) -> None:
        """Takes the rows of one chunk; an incomplete one restarts the watch."""
        chunk = None if rows is None else self.chunk(rows)
        if chunk is None:
            self.restart()
        else:
            self._chunks.append(chunk)

    @property
    def since(self) -> float:
        """Begin of the data that are compared [s]."""
        return self._chunks[0].t - 0.5 * CHUNK

    def chunk(self, rows: Rows) -> Chunk | None:
        """Means over the rows that follow those of the last call; None where they are not complete."""
        gyro, accel = rows.columns.get("gyro"), rows.columns.get("accel")
        if gyro is None or accel is None or rows.fresh:
            return None
        speed = rows.columns["rotor_speed"]
        square, velocity = speed**2, self._velocity.body(rows)
        step = float(rows.t[1] - rows.t[0]) if len(rows.t) > 1 else 0.0
        if len(rows.t) < 4 or abs(step * len(rows.t) - CHUNK) > 1.5 * step:
            return None
        force = -accel[:, 2]
        good: BoolArray = np.isfinite(force) & np.isfinite(square).all(axis=1) & square.any(axis=1)
        rate: BoolArray = np.asarray(np.isfinite(gyro).all(axis=1))
        if np.count_nonzero(good) < 0.7 * len(good) or np.count_nonzero(rate) < 0.7 * len(rate):
            return None
        lift, total = float(force[good].mean()), float(square[good].sum(axis=1).mean())
        if not (lift > 0.0 and total > 0.0):
            return None
        t = rows.t - rows.t.mean()
        slope = _slope(t[rate], gyro[rate])
        # The slope of the rate weighs the acceleration with a parabola; the moments must be weighed alike.
        weight = np.maximum((t[-1] + 0.5 * step) ** 2 - t**2, 0.0) * good
        weight /= weight.sum()
        weighed = weight @ np.where(good[:, None], square, 0.0)
        p, q, r = gyro[rate].T
        state, sigma = self._state.thrust(speed[good], velocity[good], lift), self._velocity.sigma
        axes = sigma * np.eye(3)
        astray = [self._state.thrust(speed[good], velocity[good] + axis, lift) - state for axis in axes]
        logs = np.log([np.maximum(force[good], 0.1 * lift), square[good].sum(axis=1)])
        spread = np.cov(logs, bias=True)
        return Chunk(
            float(rows.t.mean()),
            lift,
            float(np.log(lift / total)),
            state,
            np.array(astray),
            sigma,
            float(spread[0, 1]),
            float(spread[1, 1]),
            slope,
            gyro[rate].mean(axis=0),
            np.array([np.mean(q * r), np.mean(p * r), np.mean(p * q)]),
            velocity[:, 1::-1].mean(axis=0),
            np.asarray(weighed),
            _slope(t[good], square[good]),
        )

    def look(self, b: float, inertia: FloatArray, doubt: FloatArray | None) -> ChangePoint | None:
        """The strongest significant step of the last seconds, or None.

        Args:
            b: thrust coefficient [N s^2/rad^2].
            inertia: J_xx, J_yy, J_zz [kg m^2].
            doubt: standard deviations of log(b / J_xx) and log(b / J_yy); None: nothing is known of them, and moments
                are not judged.
        """
        if len(self._chunks) <= BASELINE / 5.0 / CHUNK + AFTER:
            return None
        seen = [self._thrust()]
        if doubt is not None:
            seen += [self._moment(axis, b, inertia, float(doubt[axis])) for axis in (0, 1)]
        first = max(len(self._chunks) - round(LOOK_BACK / CHUNK), round(BASELINE / 5.0 / CHUNK))
        best: ChangePoint | None = None
        for name, (y, x, typical, astray) in zip(CHANNELS, seen, strict=False):
            errors, size, place = step_beside(y, x, typical, first, LEAST, astray)
            if errors > max(SIGNIFICANT, best.errors if best is not None else 0.0):
                best = ChangePoint(self._chunks[place].t, name, size, errors)
        return best

    def _thrust(self) -> _Series:
        y, x = np.array([c.thrust for c in self._chunks]), np.array([c.state for c in self._chunks])
        return y, x, self._state.typical, np.array([c.astray for c in self._chunks])

    def _moment(self, axis: int, b: float, inertia: FloatArray, doubt: float) -> _Series:
        """Roll (0) or pitch (1) acceleration that the rotors do not explain, over half the hover moment of one side."""
        j = inertia[axis]
        # No body couples its axes more than this (triangle inequality), whatever is guessed of its yaw inertia.
        couple = float(np.clip((inertia[2] - inertia[1], inertia[0] - inertia[2])[axis] / j, -1.0, 1.0))
        half = float(np.abs(self._arms[:, axis]).sum()) * 0.25 * b * self._vehicle.hover_speed(b) ** 2 / j
        chunks = self._chunks
        arms = b / j * self._arms[:, axis]
        moment, later = np.array([c.square for c in chunks]) @ arms, np.array([c.growth for c in chunks]) @ arms
        y = np.array([c.acceleration[axis] + couple * c.gyroscopic[axis] for c in chunks]) - moment
        beside = [(c.rate[axis], c.across[axis] / j, c.gyroscopic[axis]) for c in chunks]
        x = np.column_stack([moment, later, beside])
        astray = np.zeros((len(chunks), 1, 5))
        astray[:, 0, 3] = [c.sigma / j / half for c in chunks]
        return y / half, x / half, np.array([doubt, LAG, *self._state.typical_moment, 1.0]), astray


def _slope(t: FloatArray, values: FloatArray) -> FloatArray:
    """Least-squares slope of columns over time."""
    t = t - t.mean()
    return np.asarray(t @ (values - values.mean(axis=0)) / (t @ t))
