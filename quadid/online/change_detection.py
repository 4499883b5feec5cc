"""Sudden changes, seen within seconds: effective thrust per weight, and roll and pitch moments that nothing commands.

Every half second gives three numbers that need no fit: the specific force per sum of squared rotor speeds (its level is
b / m), and the roll and pitch acceleration that the rotors do not explain.  A step in one of them is found by comparing
means before and after every moment of the last seconds (generalised likelihood ratio for a step in a mean of unknown
time: Basseville and Nikiforov, *Detection of Abrupt Changes*, 1993, ch. 2.4).

All three also change with how the vehicle flies: thrust with rotor speed (thrust curve), climb (inflow, drag) and
sideways speed, moments with what is commanded (b / J is not known exactly), rate and sideways speed.  A step is what
these do not explain (`quadid.online.flight_state`).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from quadid.online.flight_state import FlightState, Velocity, step_beside
from quadid.online.grid_buffer import Rows
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import Vehicle

CHUNK = 0.5
"""Time that gives one set of numbers [s]."""
BASELINE = 40.0
"""Time before a change that it is compared with, at most [s]; at least a fifth of it."""
LOOK_BACK = 4.0
"""A change is looked for in this much past [s]."""
AFTER = 3
"""Chunks after a change before it is believed."""
SIGNIFICANT = 7.0
"""Standard errors by which the means must differ."""
LEAST = 0.03
"""Smallest step worth a word: share of thrust; roll and pitch moment over what losing half the thrust would give."""
CHANNELS = ("thrust", "roll moment", "pitch moment")
_Series = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
"""Values, regressors, typical sizes of their coefficients, how regressors may be off (`step_beside`)."""


@dataclass(frozen=True)
class ChangePoint:
    """A step.

    Attributes:
        time: when [s], to half a chunk.
        channel: one of `CHANNELS`.
        size: share of thrust (log), or moment over half the hover moment of one side.
        errors: its size in standard errors.
    """

    time: float
    channel: str
    size: float
    errors: float


@dataclass(frozen=True)
class _Chunk:
    """Means over one chunk: time [s], log thrust per squared speed, its regressors; by roll and pitch the rest.

    `astray`: change of the regressors of thrust by a standard deviation of each axis of velocity, shape (3, 4);
    `sigma`: that deviation [m/s].
    """

    t: float
    thrust: float
    state: FloatArray
    acceleration: FloatArray
    moment: FloatArray
    gyroscopic: FloatArray
    rate: FloatArray
    across: FloatArray
    astray: FloatArray
    sigma: float


class ChangeDetector:
    """Watches the rows of one flight for sudden changes."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Watches flights of `vehicle`."""
        self._vehicle = vehicle
        self._arms = vehicle.torque_arms[:, :2]
        self._state = FlightState(vehicle)
        self._velocity = Velocity()
        self._chunks: deque[_Chunk] = deque(maxlen=round((BASELINE + LOOK_BACK) / CHUNK))

    def restart(self) -> None:
        """Forgets the past: a change was dealt with, or the flight was interrupted."""
        self._chunks.clear()
        self._velocity = Velocity()

    def add(self, rows: Rows | None) -> None:
        """Takes the rows of one chunk; an incomplete one restarts the watch."""
        chunk = None if rows is None else self._chunk(rows)
        if chunk is None:
            self.restart()
        else:
            self._chunks.append(chunk)

    def _chunk(self, rows: Rows) -> _Chunk | None:
        gyro, accel = rows.columns.get("gyro"), rows.columns.get("accel")
        if gyro is None or accel is None or rows.fresh:
            return None
        speed = rows.columns["rotor_speed"]
        square, velocity = speed**2, self._velocity.body(rows)
        step = float(rows.t[1] - rows.t[0]) if len(rows.t) > 1 else 0.0
        if len(rows.t) < 4 or abs(step * len(rows.t) - CHUNK) > 1.5 * step:
            return None
        force = -accel[:, 2]
        good: BoolArray = np.isfinite(force) & np.isfinite(square).all(axis=1)
        rate: BoolArray = np.asarray(np.isfinite(gyro).all(axis=1))
        if np.count_nonzero(good) < 0.7 * len(good) or np.count_nonzero(rate) < 0.7 * len(rate):
            return None
        lift, total = float(force[good].mean()), float(square[good].sum(axis=1).mean())
        if not (lift > 0.0 and total > 0.0):
            return None
        t = rows.t - rows.t.mean()
        slope = (t[rate] @ (gyro[rate, :2] - gyro[rate, :2].mean(axis=0))) / (t[rate] @ t[rate])
        # The slope of the rate weighs the acceleration with a parabola; the moments must be weighed alike.
        weight = np.maximum((t[-1] + 0.5 * step) ** 2 - t**2, 0.0) * good
        weight /= weight.sum()
        moment = weight @ np.where(good[:, None], square @ self._arms, 0.0)
        p, q, r = gyro[rate].T
        state, sigma = self._state.thrust(speed[good], velocity[good], lift), self._velocity.sigma
        axes = sigma * np.eye(3)
        astray = [self._state.thrust(speed[good], velocity[good] + axis, lift) - state for axis in axes]
        return _Chunk(
            float(rows.t.mean()), float(np.log(lift / total)), state, np.asarray(slope), np.asarray(moment),
            np.array([np.mean(q * r), np.mean(p * r)]), gyro[rate, :2].mean(axis=0), velocity[:, 1::-1].mean(axis=0),
            np.array(astray), sigma,
        )  # fmt: skip

    def look(self, b: float, inertia: FloatArray, doubt: FloatArray | None) -> ChangePoint | None:
        """The strongest significant step of the last seconds, or None.

        Args:
            b: thrust coefficient [N s^2/rad^2].
            inertia: J_xx, J_yy, J_zz [kg m^2].
            doubt: standard deviations of log(b / J_xx) and log(b / J_yy); None: nothing is known of them, and moments
                are not judged.
        """
        if len(self._chunks) < BASELINE / 5.0 / CHUNK + AFTER:
            return None
        t = np.array([c.t for c in self._chunks])
        seen = [self._thrust()]
        if doubt is not None:
            seen += [self._moment(axis, b, inertia, float(doubt[axis])) for axis in (0, 1)]
        first = max(len(t) - round(LOOK_BACK / CHUNK), round(BASELINE / 5.0 / CHUNK))
        best: ChangePoint | None = None
        for split in range(first, len(t) - AFTER + 1):
            for name, (y, x, typical, astray) in zip(CHANNELS, seen, strict=False):
                errors, size = step_beside(y, x, typical, split, LEAST, astray)
                if errors > SIGNIFICANT and (best is None or errors > best.errors):
                    best = ChangePoint(float(t[split]) - 0.5 * CHUNK, name, size, errors)
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
        moment = b / j * np.array([c.moment[axis] for c in chunks])
        y = np.array([c.acceleration[axis] + couple * c.gyroscopic[axis] for c in chunks]) - moment
        beside = [(c.rate[axis], c.across[axis] / j, c.gyroscopic[axis]) for c in chunks]
        x = np.column_stack([moment, beside])
        astray = np.zeros((len(chunks), 1, 4))
        astray[:, 0, 2] = [c.sigma / j / half for c in chunks]
        return y / half, x / half, np.array([doubt, *self._state.typical_moment, 1.0]), astray
