"""Do the sensors agree?  Factors of channels against each other, from physics that needs no model of the vehicle.

* Gyro against attitude, axis by axis: what the gyro adds up to over `TURN`, against the turn of the attitude.  Two more
  regressors take up what attitude filters do: the change of rate a delay, so that the factor is a ratio of sizes, and
  the tilt the pull of the accelerometer, which reads level in flight however the vehicle tilts.
* Accelerometer against gravity: the vertical specific force of a flight is g on average, because velocity stays small.

Every factor is estimated from the last data that tell it, with its standard deviation; 1 is what it ought to be.  A
factor that is not 1 has two channels that may be to blame: both are named.  Data fade, and in the end are dropped: a
channel that was wrong by a thousand would outweigh for minutes all that is right after it.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from quadid.online.rows import Rows
from quadid.rotation import down, integrated, turn
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY

ALLOWED = 0.03
"""Calibrated sensors differ by less than this share."""
ERRORS = 2.0
"""... and these many standard deviations, when they are compared."""
MEMORY, GONE = 30.0, 45.0
"""Data that tell a factor fade with this time constant, and are gone at this age [s of such data]."""
TURN = 0.2
"""Gyro and attitude are compared over turns of this length [s]."""
MOVING = 0.1
"""An axis that turns slower than this on average [rad/s] tells nothing: gyro noise would make the factor too small."""
VERTICAL = 1.5
"""Vertical velocity of a flight [m/s], as standard deviation."""
FEWEST = 25.0
"""Turns that tell a factor, at least,"""
KNOWN = 0.05
"""... and the standard deviation from which on it is told: noise makes a ratio of small turns too large."""
AXES = ("roll", "pitch", "yaw")


@dataclass(frozen=True)
class Factor:
    """Size of one channel over that of another.

    Attributes:
        what: the two, in words.
        value: 1 where they agree; sigma: its standard deviation, infinite where nothing tells it.
    """

    what: str
    value: float
    sigma: float

    @property
    def known(self) -> bool:
        """Whether it says anything."""
        return self.sigma <= KNOWN

    @property
    def disagrees(self) -> bool:
        """Whether it is known, and cannot be 1."""
        return self.known and abs(self.value - 1.0) > ALLOWED + ERRORS * self.sigma

    def __str__(self) -> str:
        return f"{self.what} = {self.value:.3f} +- {self.sigma:.3f}"


class _Fading:
    """Moments of data that tell a factor, fading; what is older than `GONE` leaves no trace."""

    def __init__(self, *shape: int) -> None:
        self._parts: deque[tuple[float, FloatArray]] = deque()
        self.seconds, self.sum = 0.0, np.zeros(shape)

    def add(self, seconds: float, moments: FloatArray) -> None:
        """Takes in the moments of some seconds of data."""
        self._parts.appendleft((seconds, moments))
        lengths = np.array([length for length, _ in self._parts])
        ages = np.cumsum(lengths) - lengths
        while ages[-1] > GONE - 0.5 * seconds:
            self._parts.pop()
            ages = ages[:-1]
        fade = np.exp(-ages / MEMORY)
        self.seconds = float(fade @ lengths[: len(ages)])
        self.sum = np.asarray(sum(f * part for f, (_, part) in zip(fade, self._parts, strict=True)))


class Consistency:
    """Factors of the channels of one stream."""

    def __init__(self) -> None:
        """Knows nothing yet."""
        self.restart()

    def restart(self) -> None:
        """Begins anew: another stream."""
        # Moments of (1, turn by gyro, change of rate, tilt, turn by attitude), an axis each.
        self._turns = [_Fading(5, 5) for _ in AXES]
        self._force = _Fading()

    def add(self, rows: Rows | None) -> None:
        """Takes in rows of a second or so."""
        if rows is None or len(rows.t) < 2 or "attitude" not in rows.columns:
            return
        step, q = float(rows.t[1] - rows.t[0]), rows.columns["attitude"]
        if "gyro" in rows.columns:
            self._add_turns(rows.columns["gyro"], q, step)
        if "accel" in rows.columns:
            force = -np.sum(down(q) * rows.columns["accel"], axis=1)
            force = force[np.isfinite(force)]
            if len(force):
                self._force.add(len(force) * step, np.asarray(force.sum() * step))

    def _add_turns(self, gyro: FloatArray, q: FloatArray, step: float) -> None:
        long = max(round(TURN / step), 1)
        # A turn from every row: readings in step with the sticks would put all others at one phase of their motion.
        starts = np.arange(len(gyro) - long)
        if not len(starts):
            return
        by_gyro = integrated(np.stack([gyro[k : k + long + 1] for k in starts], axis=1), step)
        by_attitude = turn(q[starts], q[starts + long])
        change = gyro[starts + long] - gyro[starts]
        x, y, _ = 0.5 * (down(q[starts]) + down(q[starts + long])).T
        tilt = np.column_stack([y, -x, np.zeros_like(x)])
        good = np.isfinite(by_gyro + by_attitude + change).all(axis=1)
        if not good.any():
            return
        rows = np.stack([np.ones_like(change), by_gyro, change, tilt, by_attitude], axis=-1)[good]
        moving = np.sqrt(np.mean(gyro[np.isfinite(gyro).all(axis=1)] ** 2, axis=0)) > MOVING
        for axis in np.flatnonzero(moving):
            self._turns[axis].add(len(rows) * step, rows[:, axis].T @ rows[:, axis] / long)

    def factors(self) -> tuple[Factor, ...]:
        """Every factor of which there are data: of the gyro by axis, of the accelerometer."""
        found = [_gyro_factor(axis, m) for axis, m in zip(AXES, (t.sum for t in self._turns), strict=True) if m.any()]
        if self._force.seconds > 0.0:
            # The mean of an acceleration is a change of velocity over a time.
            sigma = math.sqrt(2.0) * VERTICAL / self._force.seconds / GRAVITY
            mean = float(self._force.sum) / self._force.seconds / GRAVITY
            found.append(Factor("accelerometer over gravity by the attitude", mean, sigma))
        return tuple(found)

    @property
    def fault(self) -> str:
        """Which channels contradict each other, and what is waited for; empty where none do."""
        wrong = [f for f in self.factors() if f.disagrees]
        if not wrong:
            return ""
        worst = max(wrong, key=lambda f: abs(f.value - 1.0))
        return f"sensors disagree: {worst}, allowed 1 +- {ALLOWED:g}; nothing is learned until they agree"

    @property
    def unproven(self) -> str:
        """Which comparison is still too uncertain to say that the sensors agree; empty where none is.

        Yaw may turn too little for ever; a stream without an attitude allows no comparison at all.
        """
        vague = [f for f in self.factors() if not f.known and not f.what.startswith("yaw")]
        return f"{vague[0]}, wanted +- {KNOWN:g}: whether the sensors agree is not known yet" if vague else ""


def _gyro_factor(axis: str, moments: FloatArray) -> Factor:
    what = f"{axis} turn by the attitude over that by the gyro"
    count = float(moments[0, 0])
    if count < FEWEST:
        return Factor(what, math.nan, math.inf)
    mean = moments[0, 1:] / count
    centred = moments[1:, 1:] - count * np.outer(mean, mean)
    gram, cross = centred[:3, :3], centred[:3, 3]
    inverse = np.linalg.pinv(gram, hermitian=True)
    slope = inverse @ cross
    left = max(float(centred[3, 3] - slope @ cross), 0.0) / (count - 4.0)
    size = math.sqrt(float(slope[:2] @ gram[:2, :2] @ slope[:2]) / gram[0, 0])
    return Factor(what, math.copysign(size, slope[0]), math.sqrt(left * inverse[0, 0]))
