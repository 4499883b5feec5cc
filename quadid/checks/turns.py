"""Turns by the attitude over those by the gyro, from physics that needs no model of the vehicle.

By how much the turns over `TURN` change, as the gyro adds up to them and as the attitude has them, about each axis.
Changes of turns have neither the gyro's bias nor the slow pull of an attitude filter in them, and lie where inertias
are seen.  All axes of the gyro are regressors, so that one that leaks into another shows; the change of rate takes up a
delay, so that the factor is a ratio of sizes.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadid.rotation import integrated, turn
from quadid.types import FloatArray

ALLOWED = 0.03
"""Calibrated sensors differ by less than this share."""
ERRORS = 2.0
"""... and these many standard deviations, when they are compared."""
TURN = 0.2
"""Gyro and attitude are compared over turns of this length [s]."""
MOVING = 0.1
"""An axis that turns slower than this on average [rad/s] is not used: gyro noise would make the factor too small."""
FEWEST = 15
"""Turns from which a factor is computed, at least,"""
KNOWN = 0.05
"""... and the standard deviation from which on it is used: noise makes a ratio of small turns too large."""
AXES = ("roll", "pitch", "yaw")
TURN_FACTOR = "turn by the attitude over that by the gyro"


@dataclass(frozen=True)
class Factor:
    """Size of one channel over that of another.

    Attributes:
        what: the two, in words.
        value: of the factor; sigma: its standard deviation, infinite where no data show it.
        ideal: what it is where they agree.
    """

    what: str
    value: float
    sigma: float
    ideal: float = 1.0

    @property
    def known(self) -> bool:
        """True if it is known well enough to be compared."""
        return self.sigma <= KNOWN

    @property
    def off(self) -> float:
        """Distance from where it ought to be."""
        return self.value - self.ideal

    @property
    def disagrees(self) -> bool:
        """True if it is known, and cannot be what it ought to be."""
        return self.known and abs(self.off) > ALLOWED + ERRORS * self.sigma

    def __str__(self) -> str:
        return f"{self.what} = {self.value:.3f} +- {self.sigma:.3f}"


class Turns(NamedTuple):
    """Changes of turn by the gyro (n, 3), of its rate (n, 3), and of turn by the attitude (n, 3), from every row.

    `over` [s] is the length of each turn.
    """

    gyro: FloatArray
    rate: FloatArray
    attitude: FloatArray
    over: float

    @classmethod
    def of(cls, gyro: FloatArray, q: FloatArray, step: float, over: float = TURN) -> Turns:
        """Changes of turn of rates (n, 3) [rad/s] and attitudes (n, 4), `step` [s] apart; rows of NaN are left out."""
        long = max(round(over / step), 1)
        # A turn from every row: readings in step with the sticks would put all others at one phase of their motion.
        starts = np.arange(max(len(gyro) - long, 0))
        if len(starts) <= long:
            return cls(none := np.empty((0, 3)), none, none, over)
        turns = (
            integrated(np.stack([gyro[k : k + long + 1] for k in starts], axis=1), step),
            gyro[starts + long] - gyro[starts],
            turn(q[starts], q[starts + long]),
        )
        by_gyro, rate, by_attitude = (t[long:] - t[:-long] for t in turns)
        good = np.isfinite(by_gyro + rate + by_attitude).all(axis=1)
        return cls(by_gyro[good], rate[good], by_attitude[good], over)

    def moments(self, axis: int, step: float) -> FloatArray:
        """Sums of products of (changes of turn by the gyro about x, y, z, of rate, of turn by the attitude), (5, 5)."""
        rows = np.column_stack([self.gyro, self.rate[:, axis], self.attitude[:, axis]])
        return rows.T @ rows / max(round(self.over / step), 1)


def factors(axis: int, turns: float, moments: FloatArray) -> list[Factor]:
    """Size of the attitude's turns over the gyro's about an axis, then what it has of the gyro's other axes.

    Args:
        axis: 0, 1 or 2.
        turns: in the moments, by the seconds of data over the length of a turn.
        moments: as of `Turns.moments`, (5, 5).
    """
    gram, cross = moments[:4, :4], moments[:4, 4]
    inverse = np.linalg.pinv(gram, hermitian=True)
    slope = inverse @ cross
    left = max(float(moments[4, 4] - slope @ cross), 0.0) / (turns - 4.0)
    sigma = np.sqrt(left * np.diag(inverse))
    own = [axis, 3]
    size = math.sqrt(float(slope[own] @ gram[np.ix_(own, own)] @ slope[own]) / gram[axis, axis])
    found = [Factor(f"{AXES[axis]} {TURN_FACTOR}", math.copysign(size, slope[axis]), float(sigma[axis]))]
    return found + [
        Factor(f"part of the gyro's {AXES[k]} in the attitude's {AXES[axis]}", float(slope[k]), float(sigma[k]), 0.0)
        for k in range(3)
        if k != axis
    ]
