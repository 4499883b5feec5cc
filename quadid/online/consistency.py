"""Do the sensors agree?  Factors of channels against each other, from physics that needs no model of the vehicle.

* Gyro against attitude: by how much the turns over `TURN` change, as the gyro adds up to them and as the attitude has
  them, about each axis.  Changes of turns have neither the gyro's bias nor the slow pull of an attitude filter in them,
  and lie where inertias are seen.  All axes of the gyro are regressors, so that one that leaks into another shows;
  the change of rate takes up a delay, so that the factor is a ratio of sizes.
* Accelerometer against gravity: the vertical specific force of a flight is g on average, because velocity stays small.

Every factor is estimated from the last data that tell it, with its standard deviation; it ought to be 1, what leaks 0.
One that is not has two channels that may be to blame: both are named.  Data fade, and in the end are dropped: a channel
that was wrong by a thousand would outweigh for minutes all that is right after it.
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
LEAD = 2.0 * TURN
"""A change of turn needs so much of the past [s]."""
MOVING = 0.1
"""An axis that turns slower than this on average [rad/s] tells nothing: gyro noise would make the factor too small."""
VERTICAL = 1.5
"""Vertical velocity of a flight [m/s], as standard deviation."""
FEWEST = 15
"""Turns that tell a factor, at least,"""
KNOWN = 0.05
"""... and the standard deviation from which on it is told: noise makes a ratio of small turns too large."""
AXES = ("roll", "pitch", "yaw")
TURN_FACTOR = "turn by the attitude over that by the gyro"
GRAVITY_FACTOR = "accelerometer over gravity by the attitude"


@dataclass(frozen=True)
class Factor:
    """Size of one channel over that of another.

    Attributes:
        what: the two, in words.
        value: of the factor; sigma: its standard deviation, infinite where nothing tells it.
        ideal: what it is where they agree.
    """

    what: str
    value: float
    sigma: float
    ideal: float = 1.0

    @property
    def known(self) -> bool:
        """Whether it says anything."""
        return self.sigma <= KNOWN

    @property
    def off(self) -> float:
        """How far it is from where it ought to be."""
        return self.value - self.ideal

    @property
    def disagrees(self) -> bool:
        """Whether it is known, and cannot be what it ought to be."""
        return self.known and abs(self.off) > ALLOWED + ERRORS * self.sigma

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
        # Moments of (changes of turn by the gyro about x, y, z, of rate, of turn by the attitude), for each axis.
        self._turns = [_Fading(5, 5) for _ in AXES]
        self._force = _Fading()
        self._compared = False

    def add(self, rows: Rows | None, seconds: float) -> None:
        """Takes in the last `seconds` of the rows, before which there should be `LEAD` that were taken in earlier."""
        if rows is None or len(rows.t) < 2 or "attitude" not in rows.columns:
            return
        step, q, self._compared = float(rows.t[1] - rows.t[0]), rows.columns["attitude"], True
        if "gyro" in rows.columns:
            self._add_turns(rows.columns["gyro"], q, step)
        if "accel" in rows.columns:
            new = round(seconds / step)
            force = -np.sum(down(q[-new:]) * rows.columns["accel"][-new:], axis=1)
            force = force[np.isfinite(force)]
            if len(force):
                self._force.add(len(force) * step, np.asarray(force.sum() * step))

    def _add_turns(self, gyro: FloatArray, q: FloatArray, step: float) -> None:
        long = max(round(TURN / step), 1)
        # A turn from every row: readings in step with the sticks would put all others at one phase of their motion.
        starts = np.arange(len(gyro) - long)
        if len(starts) <= long:
            return
        turns = (
            integrated(np.stack([gyro[k : k + long + 1] for k in starts], axis=1), step),
            gyro[starts + long] - gyro[starts],
            turn(q[starts], q[starts + long]),
        )
        by_gyro, rate, by_attitude = (t[long:] - t[:-long] for t in turns)
        good = np.isfinite(by_gyro + rate + by_attitude).all(axis=1)
        moving = np.sqrt(np.mean(gyro[np.isfinite(gyro).all(axis=1)] ** 2, axis=0)) > MOVING
        for axis in np.flatnonzero(moving) if good.any() else ():
            rows = np.column_stack([by_gyro, rate[:, axis], by_attitude[:, axis]])[good]
            self._turns[axis].add(len(rows) * step, rows.T @ rows / long)

    def factors(self) -> tuple[Factor, ...]:
        """Every factor of which there are data: of the gyro by axis, what leaks into it, of the accelerometer."""
        found = [f for axis, t in enumerate(self._turns) if t.seconds > FEWEST * TURN for f in _gyro_factors(axis, t)]
        if self._force.seconds > 0.0:
            # The mean of an acceleration is a change of velocity over a time.
            sigma = math.sqrt(2.0) * VERTICAL / self._force.seconds / GRAVITY
            mean = float(self._force.sum) / self._force.seconds / GRAVITY
            found.append(Factor(GRAVITY_FACTOR, mean, sigma))
        return tuple(found)

    @property
    def fault(self) -> str:
        """Which channels contradict each other, and what is waited for; empty where none do."""
        wrong = [f for f in self.factors() if f.disagrees]
        if not wrong:
            return ""
        worst = max(wrong, key=lambda f: abs(f.off))
        return f"sensors disagree: {worst}, allowed {worst.ideal:g} +- {ALLOWED:g}; nothing is learned until they agree"

    def doubts(self) -> tuple[Factor, ...]:
        """Products that b, J_xx and J_yy are off by: of the accelerometer alone, and of it and the gyro about an axis.

        Each channel may be within its own limit and all together not.  Yaw may turn too little for ever; a stream
        without an attitude allows no comparison at all.
        """
        if not self._compared:
            return ()
        found = {f.what: f for f in self.factors()}
        force = found.get(GRAVITY_FACTOR)
        turns = [
            found.get(what, Factor(what, 1.0, math.inf)) for what in (f"{axis} {TURN_FACTOR}" for axis in AXES[:2])
        ]
        if force is None:
            return tuple(turns)
        both = [
            Factor(f"{force.what} times {t.what}", force.value * t.value, math.hypot(force.sigma, t.sigma))
            for t in turns
        ]  # fmt: skip
        return (force, *both)


def _gyro_factors(axis: int, told: _Fading) -> list[Factor]:
    """Size of the attitude's turns over the gyro's about an axis, then what it has of the gyro's other axes."""
    gram, cross = told.sum[:4, :4], told.sum[:4, 4]
    inverse = np.linalg.pinv(gram, hermitian=True)
    slope = inverse @ cross
    left = max(float(told.sum[4, 4] - slope @ cross), 0.0) / (told.seconds / TURN - 4.0)
    sigma = np.sqrt(left * np.diag(inverse))
    own = [axis, 3]
    size = math.sqrt(float(slope[own] @ gram[np.ix_(own, own)] @ slope[own]) / gram[axis, axis])
    found = [Factor(f"{AXES[axis]} {TURN_FACTOR}", math.copysign(size, slope[axis]), float(sigma[axis]))]
    return found + [
        Factor(f"part of the gyro's {AXES[k]} in the attitude's {AXES[axis]}", float(slope[k]), float(sigma[k]), 0.0)
        for k in range(3) if k != axis
    ]  # fmt: skip
