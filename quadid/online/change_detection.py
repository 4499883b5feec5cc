"""Sudden changes, seen within seconds: effective thrust per weight, and roll and pitch moments that nothing commands.

Every half second gives three numbers that need no fit: the specific force per sum of squared rotor speeds (its level is
b / m), and the roll and pitch acceleration that the rotors do not explain.  A step in one of them is found by comparing
means before and after every moment of the last seconds (generalised likelihood ratio for a step in a mean of unknown
time: Basseville and Nikiforov, *Detection of Abrupt Changes*, 1993, ch. 2.4).
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from quadid.online.resampler import Rows
from quadid.resample import median
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
LEAST = np.array([0.03, 0.03, 0.03])
"""Smallest step worth a word: share of thrust; roll and pitch moment over what losing half the thrust would give."""
CHANNELS = ("thrust", "roll moment", "pitch moment")


@dataclass(frozen=True)
class Change:
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
    """Sums over one chunk: time of its middle [s], log thrust per weight, change of rates, moments of omega^2."""

    t: float
    thrust: float
    acceleration: FloatArray
    moment: FloatArray
    gyroscopic: FloatArray


class ChangeDetector:
    """Watches the rows of one flight for sudden changes."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Watches flights of `vehicle`."""
        self._vehicle = vehicle
        position = vehicle.rotor_positions
        self._arms = np.column_stack([-position[:, 1], position[:, 0]])
        self._chunks: deque[_Chunk] = deque(maxlen=round((BASELINE + LOOK_BACK) / CHUNK))

    def restart(self) -> None:
        """Forgets the past: a change was dealt with, or the flight was interrupted."""
        self._chunks.clear()

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
        square = rows.columns["rotor_speed"] ** 2
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
        return _Chunk(
            float(rows.t.mean()), float(np.log(lift / total)), np.asarray(slope), np.asarray(moment),
            np.array([np.mean(q * r), np.mean(p * r)]),
        )  # fmt: skip

    def look(self, b: float, inertia: FloatArray) -> Change | None:
        """The strongest significant step of the last seconds, or None.

        Args:
            b: thrust coefficient [N s^2/rad^2].
            inertia: J_xx, J_yy, J_zz [kg m^2].
        """
        if len(self._chunks) < BASELINE / 5.0 / CHUNK + AFTER:
            return None
        t = np.array([c.t for c in self._chunks])
        series = self._series(b, inertia)
        first = max(len(t) - round(LOOK_BACK / CHUNK), round(BASELINE / 5.0 / CHUNK))
        best: Change | None = None
        for split in range(first, len(t) - AFTER + 1):
            for c, name in enumerate(CHANNELS):
                errors, size = _step(series[:split, c], series[split:, c], LEAST[c])
                if errors > SIGNIFICANT and (best is None or errors > best.errors):
                    best = Change(float(t[split]) - 0.5 * CHUNK, name, size, errors)
        return best

    def _series(self, b: float, inertia: FloatArray) -> FloatArray:
        """Thrust per weight (log), and roll and pitch moments that the rotors do not explain, shape (chunks, 3)."""
        j = np.asarray(inertia)
        couple = np.array([(j[2] - j[1]) / j[0], (j[0] - j[2]) / j[1]])
        hover = b * self._vehicle.hover_speed(b) ** 2
        half = np.abs(self._arms).sum(axis=0) * 0.25 * hover / j[:2]
        rows = []
        for c in self._chunks:
            left = c.acceleration + couple * c.gyroscopic - b * c.moment / j[:2]
            rows.append([c.thrust, *(left / half)])
        return np.array(rows)


def _step(before: FloatArray, after: FloatArray, least: float) -> tuple[float, float]:
    """Size of a step in standard errors, and the step; every value after it must lie on the same side.

    A step smaller than `least` counts as none.
    """
    level = median(before)
    size = median(after) - level
    if abs(size) < least:
        return 0.0, size
    spread = max(1.4826 * median(np.abs(before - level)), 1e-6)
    if not np.all(np.sign(size) * (after - level) > 2.0 * spread):
        return 0.0, size
    error = 1.25 * spread * np.sqrt(1.0 / len(after) + 1.0 / len(before))
    return abs(size) / float(error), size
