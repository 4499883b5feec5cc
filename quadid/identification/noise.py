"""Sensor noise: white plus slowly coloured, per channel; whitening; estimation from residuals; random moments.

Each channel's noise is modelled as ``white^2 I + slow^2 R`` within a segment, R the correlation of a first-order
Gauss-Markov process.  The two variances are found by equating two quadratic forms of the residual with their
expectation given that the segment's initial state was fitted (minimum-norm quadratic unbiased estimation, C. R. Rao,
J. Multivariate Analysis 1 (1971) 257).

Rates carry random moments beside their noise: what no model of the vehicle makes, such as turbulence and the wake of
rotors.  How much of a rate is theirs shows whether `quadid.identification.filter_error` is asked.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np

from quadid.chi_square import lower_mean
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import Noise

# --- Noise of all channels, and its whitener


SLOW_TIME = 0.66
"""Correlation time of the slow attitude error [s] until a filter has estimated it."""
ATTITUDE = (3, 4, 5)
"""Channels that may have a slow part; elsewhere slow structure is left for the diagnosis to see."""
SHAPE_POINTS = 51
"""Frequencies on which a noise spectrum is kept."""
_DEFAULT = np.array([0.02] * 3 + [0.005] * 3 + [0.2] * 3 + [0.1] * 3 + [0.05] * 3)
TREND = (1, 2, 0, 1, 2)
"""Order of the trend that fitting a segment's initial state takes out of rate, attitude, specific force, velocity,
position."""


@dataclass(frozen=True, eq=False)
class NoiseModel:
    """Noise of every residual channel; the same only as itself, so that its whiteners are kept with it.

    Attributes:
        white: standard deviation of the white part, shape (channels,), channel's unit.
        slow: standard deviation of the slow part, shape (channels,).
        slow_time: correlation time of the slow part [s].
        shape: relative spectrum of the white part on `SHAPE_POINTS` frequencies from 0 to Nyquist, mean 1, shape
            (channels, SHAPE_POINTS); None when all is white.
    """

    white: FloatArray
    slow: FloatArray
    slow_time: float = SLOW_TIME
    shape: FloatArray | None = None

    @classmethod
    def guess(cls, channels: int, known: Noise | None = None) -> NoiseModel:
        """Typical MEMS noise, or what the vehicle file gives."""
        white = _DEFAULT[:channels].copy()
        for i, name in enumerate(("gyro", "attitude", "accel", "velocity", "position")):
            value = getattr(known, name) if known is not None else None
            if value is not None and 3 * i < channels:
                white[3 * i : 3 * i + 3] = value
        return cls(white, np.zeros(channels))

    def first(self, channels: int) -> NoiseModel:
        """Noise of the first so many channels; itself where it has no more."""
        if channels == len(self.white):
            return self
        shape = None if self.shape is None else self.shape[:channels]
        return replace(self, white=self.white[:channels], slow=self.slow[:channels], shape=shape)

    def extended(self, other: NoiseModel) -> NoiseModel:
        """Noise with the channels of `other` where it has none."""
        own = len(self.white)
        shape = None
        if self.shape is not None:
            shape = np.concatenate([self.shape, np.ones((len(other.white) - own, SHAPE_POINTS))])
        white, slow = np.append(self.white, other.white[own:]), np.append(self.slow, other.slow[own:])
        return replace(self, white=white, slow=slow, shape=shape)

    @property
    def variance(self) -> FloatArray:
        """Total variance of the noise of each channel, shape (channels,)."""
        return np.asarray(self.white**2 + self.slow**2)

    def whitener(self, length: int, dt: float) -> FloatArray:
        """Returns W, shape (channels, length, length): W[c] @ r has unit variance and is white for pure noise r.

        Rows look back only (inverse of a Cholesky factor), so a whitened residual keeps its order in time.  Read-only.
        """
        return _whitener(self, length, dt)

    def whitened(
        self, rows: FloatArray, weights: FloatArray, dt: float, channels: Sequence[int] | None = None
    ) -> FloatArray:
        """Rows weighted and whitened; a channel of a segment with masked samples stays unwhitened.

        Args:
            rows: shape (segments, length, channels, columns).
            weights: 1 where measured, 0 elsewhere, shape (segments, length, channels).
            dt: time between samples [s].
            channels: whose rows they are; by default those of the model, in order.
        """
        of = np.arange(len(self.white)) if channels is None else np.asarray(channels)
        out = rows * (weights / self.deviation[of])[..., None]
        whole = np.all(weights > 0.0, axis=1)
        for i in np.flatnonzero(self.coloured[of]):
            white = np.matmul(self.deviation[of[i]] * self.whitener(rows.shape[1], dt)[of[i]], out[:, :, i])
            out[:, :, i] = white if whole[:, i].all() else np.where(whole[:, i, None, None], white, out[:, :, i])
        return np.asarray(out)

    @cached_property
    def deviation(self) -> FloatArray:
        """Standard deviation of each channel, shape (channels,)."""
        return np.asarray(np.sqrt(self.variance))

    @cached_property
    def coloured(self) -> BoolArray:
        """True for channels that are not white, shape (channels,)."""
        mask = self.slow > 0.0
        return mask if self.shape is None else mask | (np.ptp(self.shape, axis=1) > 0.0)


@lru_cache(maxsize=16)
def _whitener(noise: NoiseModel, length: int, dt: float) -> FloatArray:
    """`NoiseModel.whitener`, read-only; computed once for the same arguments."""
    out = np.zeros((len(noise.white), length, length))
    for c, (white, slow) in enumerate(zip(noise.white, noise.slow, strict=True)):
        if not noise.coloured[c]:
            out[c] = np.eye(length) / white
            continue
        covariance = white**2 * np.eye(length)
        if noise.shape is not None and not slow > 0.0:
            # Covariance (length, length) of noise whose spectrum is `shape` from 0 to the Nyquist frequency (Wiener-
            # Khinchin). The spectrum is linear between its points, on a grid fine enough for the longest lag.
            points = max(4 * length, SHAPE_POINTS)
            frequency = (np.arange(points) + 0.5) / points
            level = np.interp(frequency, np.linspace(0.0, 1.0, SHAPE_POINTS), noise.shape[c])
            lag = np.cos(np.pi * np.outer(np.arange(length), frequency)) @ level / points
            covariance = white**2 * np.asarray(lag[np.abs(np.subtract.outer(np.arange(length), np.arange(length)))])
        covariance += slow**2 * correlation(length, dt / noise.slow_time)
        out[c] = np.tril(np.linalg.inv(np.linalg.cholesky(covariance)))
    out.setflags(write=False)
    return out


@lru_cache(maxsize=32)
def correlation(length: int, step: float) -> FloatArray:
    """Of Gauss-Markov noise between rows `step` correlation times apart, shape (length, length)."""
    lag = np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
    return np.asarray(np.exp(-step * lag))


def estimate_noise(residuals: FloatArray, weights: FloatArray, dt: float, freedom: float) -> NoiseModel:
    """Estimates the noise from residuals of a fit flexible enough to leave only noise.

    Args:
        residuals: predicted - measured, shape (segments, length, channels).
        weights: 0 for samples to leave out, shape as residuals.
        dt: grid step [s].
        freedom: fraction of the residual's degrees of freedom left after the parameters were fitted, 0..1.

    Returns:
        The noise; a channel without enough data keeps the typical value.
    """
    segments, length, channels = residuals.shape
    guess = NoiseModel.guess(channels)
    white, lasting = guess.white.copy(), np.zeros(channels)
    for c in range(channels):
        complete = np.all(weights[:, :, c] > 0.0, axis=1)
        basis, forms = _forms(length, round(float(dt) / SLOW_TIME, 9), min(TREND[c // 3], length - 2))
        if np.count_nonzero(complete) < 5:
            used = weights[:, :, c] > 0.0
            if np.count_nonzero(used) > 20:
                # Scattered samples: fitting the initial state takes `order` of each segment's samples.
                order = TREND[c // 3]
                left = np.count_nonzero(used) - order * np.count_nonzero(used.any(axis=1))
                white[c] = np.sqrt(np.sum(residuals[:, :, c][used] ** 2) / max(float(left), 1.0) / freedom)
            continue
        # What the initial state fits anyway goes first: the trend.
        r = residuals[complete, :, c]
        r = r - (r @ basis) @ basis.T
        # Trim segments with outliers: the middle 98 % of segment powers.
        power = np.sum(r * r, axis=1)
        r = r[power <= np.quantile(power, 0.98)]
        keep = 1.0 if len(r) < 50 else lower_mean(0.98, length - basis.shape[1])
        # Rao's two quadratic forms r' I r and r' R r, set equal to their expectations.
        moments = np.array([np.mean(np.sum((r @ f) * r, axis=1)) for f in forms[:2]]) / (freedom * keep)
        var_white, var_slow = moments[0] / forms[2][0, 0], 0.0
        if c in ATTITUDE and length >= 8:
            solution = np.linalg.solve(forms[2], moments)
            if solution[1] > 0.0 and solution[0] > 0.0:
                var_white, var_slow = float(solution[0]), float(solution[1])
        white[c], lasting[c] = np.sqrt(max(var_white, 1e-18)), np.sqrt(var_slow)
    return NoiseModel(white, lasting)


@lru_cache(maxsize=64)
def _forms(length: int, step: float, order: int) -> tuple[FloatArray, tuple[FloatArray, FloatArray, FloatArray]]:
    """Trend basis (length, order), quadratic forms (I, R), and their expectations under unit white and slow noise."""
    t = np.linspace(-1.0, 1.0, length)
    basis = np.linalg.qr(np.vander(t, order, increasing=True))[0] if order else np.zeros((length, 0))
    project = np.eye(length) - basis @ basis.T
    slow = correlation(length, step)
    forms = [np.eye(length), slow]
    expectation = np.array([[np.trace(project @ f), np.trace(project @ f @ project @ slow)] for f in forms])
    return basis, (forms[0], forms[1], expectation)
