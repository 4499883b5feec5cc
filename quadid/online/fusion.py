"""Fusion of window estimates over time: information adds up, old information fades, changes are detected.

Every window gives a quadratic model of its cost around its estimate.  In scaled parameters z (logarithms of the nominal
six) that is a Fisher information matrix H and a vector h = H z - g; both add.  Windows overlap, so each counts with the
share of its time that no earlier window has counted.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass

import numpy as np

from quadid.chi_square import exceeded
from quadid.types import FloatArray

DRIFT = 0.02
"""Parameters may honestly differ this much (log scale) from window to window: what no simulation of this kind has."""
CHANGE_PROBABILITY = 1e-5
"""A window whose disagreement with the fused estimate is less probable than this tells a change, if the next agrees."""
SCATTER_PRIOR = 30.0
"""Degrees of freedom with which windows are believed to scatter as they claim."""
AGREEMENT_PROBABILITY = 1e-3
"""A window disagrees with the fused estimate when a distance like its own is less probable than this."""
KEPT_WINDOWS = 120
"""Window estimates kept for agreement and held-out gain."""


@dataclass(frozen=True)
class WindowEstimate:
    """What one window says.

    Attributes:
        start, stop: its time [s].
        z: scaled parameters where it was linearised, shape (P,).
        information: Fisher information there, without prior, shape (P, P).
        score: half the gradient of the cost there, shape (P,).
        cost: cost at z; rows: independent residuals, so that cost / rows is 1 at the noise floor.
        left_out: what the parameters leave out of each rotor's thrust, and its standard deviations, shape (2, R).
    """

    start: float
    stop: float
    z: FloatArray
    information: FloatArray
    score: FloatArray
    cost: float
    rows: float
    left_out: FloatArray

    @property
    def mse(self) -> float:
        """Mean squared whitened residual; 1 at the noise floor."""
        return self.cost / max(self.rows, 1.0)

    @property
    def scale(self) -> float:
        """Factor on its information: residuals above the noise floor make it count less."""
        return 1.0 / max(self.mse, 1.0)

    @property
    def optimum(self) -> FloatArray:
        """Where its cost is least, shape (P,)."""
        return np.asarray(self.z - np.linalg.solve(self.information, self.score))

    @property
    def finite(self) -> bool:
        """Whether every number of it is one."""
        arrays = (self.z, self.information, self.score, self.left_out)
        return math.isfinite(self.cost) and all(bool(np.isfinite(a).all()) for a in arrays)

    def deviance(self, z: FloatArray) -> float:
        """Cost of `z` in this window above that of its own estimate, in units of its residual level."""
        step = z - self.z
        return float(2.0 * self.score @ step + step @ self.information @ step) * self.scale


@dataclass(frozen=True)
class Fused:
    """A fused estimate: scaled parameters and covariance (prior included), shapes (P,) and (P, P)."""

    z: FloatArray
    covariance: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (P,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class _Sum:
    """Accumulated information up to a time."""

    stop: float
    matrix: FloatArray
    vector: FloatArray


class Fusion:
    """Running estimate of one vehicle.

    Attributes:
        windows: estimates that were taken in, oldest first.
        counted: end of the data taken in [s].
        drift: honest difference between windows by parameter, log scale, shape (P,).
    """

    def __init__(self, mean: FloatArray, sigma: FloatArray, memory: float) -> None:
        """Starts from the prior.

        Args:
            mean: scaled parameters of the prior, shape (P,).
            sigma: its standard deviations, shape (P,).
            memory: time constant of forgetting [s] of data taken in.
        """
        self._mean, self._precision = mean, np.diag(1.0 / sigma**2)
        self._memory = memory
        self.drift: FloatArray = np.full(len(mean), DRIFT)
        self.windows: deque[WindowEstimate] = deque(maxlen=KEPT_WINDOWS)
        self._sums: deque[_Sum] = deque(maxlen=KEPT_WINDOWS)
        self.counted = -math.inf

    def forget(self) -> None:
        """Drops everything learned: the vehicle has changed."""
        self.windows.clear()
        self._sums.clear()

    def agrees(self, window: WindowEstimate) -> bool:
        """Whether a window fits the estimate from data before it, where there is one (chi-square)."""
        earlier = self._before(window.start)
        if earlier is None:
            return True
        before = self._solve(earlier)
        distance = self._distance(window, before.z, before.covariance + np.diag(self.drift**2))
        return distance <= exceeded(CHANGE_PROBABILITY, len(self._mean))

    def add(self, window: WindowEstimate) -> None:
        """Takes a window in, with the share of its time that is new."""
        fresh = window.stop - max(window.start, self.counted)
        share = min(max(fresh / (window.stop - window.start), 0.0), 1.0)
        size = len(self._mean)
        old = self._sums[-1] if self._sums else _Sum(-math.inf, np.zeros((size, size)), np.zeros(size))
        fade = math.exp(-max(fresh, 0.0) / self._memory) if math.isfinite(old.stop) else 0.0
        weight = share * window.scale
        matrix = fade * old.matrix + weight * window.information
        vector = fade * old.vector + weight * (window.information @ window.z - window.score)
        self._sums.append(_Sum(window.stop, matrix, vector))
        self.windows.append(window)
        self.counted = max(self.counted, window.stop)

    def estimate(self) -> Fused | None:
        """The fused estimate, its covariance widened where windows scatter more than they should; None before data."""
        if not self._sums:
            return None
        fused = self._solve(self._sums[-1])
        return Fused(fused.z, fused.covariance * self.scatter(fused.z))

    def before(self, start: float) -> FloatArray | None:
        """Scaled parameters from windows that ended by `start`; None when there are none."""
        earlier = self._before(start)
        return None if earlier is None else self._solve(earlier).z

    def disjoint(self, most: int = 12) -> list[WindowEstimate]:
        """Newest windows that share no sample, newest first."""
        out: list[WindowEstimate] = []
        for window in reversed(self.windows):
            if not out or window.stop <= out[-1].start + 1e-6:
                out.append(window)
                if len(out) == most:
                    break
        return out

    def scatter(self, z: FloatArray) -> float:
        """Variance of disjoint windows about `z` relative to what they claim, at least 1, shrunk towards 1."""
        windows = self.disjoint()
        if len(windows) < 3:
            return 1.0
        total = sum(self._distance(window, z, 0.0) for window in windows)
        freedom = len(z) * (len(windows) - 1)
        return max((total + SCATTER_PRIOR) / (freedom + SCATTER_PRIOR), 1.0)

    def _distance(self, window: WindowEstimate, z: FloatArray, covariance: FloatArray | float) -> float:
        """Squared Mahalanobis distance of a window's own estimate from `z`, which has a covariance too."""
        own = self._alone(window)
        difference = own.z - z
        return float(difference @ np.linalg.solve(own.covariance + covariance, difference))

    def left_out(self) -> FloatArray | None:
        """Weighted mean of `WindowEstimate.left_out` of disjoint windows, shape (2, R), widened where they scatter."""
        told = np.array([w.left_out for w in self.disjoint()])
        if not len(told):
            return None
        weight = 1.0 / told[:, 1] ** 2
        mean = np.sum(weight * told[:, 0], axis=0) / weight.sum(axis=0)
        scatter = np.sum(weight * (told[:, 0] - mean) ** 2, axis=0) / max(len(told) - 1, 1)
        return np.stack([mean, np.sqrt(np.maximum(scatter, 1.0) / weight.sum(axis=0))])

    def agreement(self, most: int) -> tuple[int, tuple[int, float] | None]:
        """How many of the newest disjoint windows agree in a row with the fused estimate, `most` at most.

        And of the first that does not: which parameter is farthest off, and by how much, log scale.
        """
        fused = self.estimate()
        windows = self.disjoint(most) if fused is not None else []
        limit = exceeded(AGREEMENT_PROBABILITY, len(self._mean))
        for agreeing, window in enumerate(windows):
            if fused is not None and self._distance(window, fused.z, np.diag(self.drift**2)) > limit:
                spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(window.information)), 1e-12) + self.drift**2)
                away = window.z - fused.z
                farthest = int(np.argmax(np.abs(away) / spread))
                return agreeing, (farthest, float(away[farthest]))
        return len(windows), None

    def walked(self, share: FloatArray, most: int) -> tuple[float, float] | None:
        """Change of a sum of parameters from the oldest to the newest of disjoint windows, and its deviation.

        Args:
            share: of each parameter in the sum, shape (P,).
            most: windows at most; None where there are fewer than two.
        """
        windows = self.disjoint(most)
        if len(windows) < 2:
            return None
        newest, oldest = self._alone(windows[0]), self._alone(windows[-1])
        variance = share @ (newest.covariance + oldest.covariance) @ share
        return float(share @ (newest.z - oldest.z)), math.sqrt(variance)

    def _before(self, start: float) -> _Sum | None:
        return next((s for s in reversed(self._sums) if s.stop <= start + 1e-6), None)

    def _alone(self, window: WindowEstimate) -> Fused:
        """What a window says with nothing but the prior."""
        matrix = window.scale * window.information
        vector = window.scale * (window.information @ window.z - window.score)
        return self._solve(_Sum(window.stop, matrix, vector))

    def _solve(self, total: _Sum) -> Fused:
        matrix = total.matrix + self._precision
        z = np.linalg.solve(matrix, total.vector + self._precision @ self._mean)
        return Fused(np.asarray(z), np.asarray(np.linalg.inv(matrix)))
