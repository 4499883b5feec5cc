"""Multiple shooting written out plainly, one segment at a time, with no elimination: the yardstick of the fast one.

The measured arrays and the simulation itself (`Rollout.roll`) are shared; differences, perturbed states, whitening and
least squares are not.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solve_triangular
from scipy.spatial.transform import Rotation

from quadid.identification.noise import SLOW_TIME, NoiseModel
from quadid.identification.problem import Free
from quadid.model.rollout import Rollout, Segments
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray

STATE_STEP = np.array([1e-5] * 6 + [1e-4] * 6)
PARAMETER_STEP = 1e-3


def perturbed(x0: FloatArray, a: FloatArray) -> FloatArray:
    """States (segments, 13) moved by a = rotation vector, rate, velocity, position in one and the same way."""
    out = x0.copy()
    turned = Rotation.from_quat(x0[:, [1, 2, 3, 0]]) * Rotation.from_rotvec(a[:3])
    out[:, :4] = turned.as_quat()[:, [3, 0, 1, 2]]
    out[:, 4:] += a[3:]
    return out


@dataclass(frozen=True)
class DenseProblem:
    """Residuals of all segments of one window, whitened, as functions of initial states and parameters."""

    rollout: Rollout
    segments: Segments
    noise: NoiseModel
    channels: int
    n_pre: int

    def residual(self, theta: FloatArray, x0: FloatArray) -> FloatArray:
        """Whitened residual of each segment, shape (segments, length * channels); unmeasured samples are 0."""
        out, _ = self.rollout.roll(self.segments, theta[None], x0, None, self.n_pre)
        return self.whitened(out[0, ..., : self.channels, 0])

    def whitened(self, raw: FloatArray) -> FloatArray:
        """Residuals (segments, length, channels) in standard deviations, correlated noise undone where complete."""
        length, dt = self.segments.length, self.rollout.window.dt
        rows = self.segments.starts[:, None] + np.arange(length)
        valid = self.rollout.valid[rows][..., : self.channels]
        lag = dt * np.abs(np.subtract.outer(np.arange(length), np.arange(length)))
        out = np.zeros_like(raw)
        for c in range(self.channels):
            white, slow = self.noise.white[c], self.noise.slow[c]
            factor = np.linalg.cholesky(white**2 * np.eye(length) + slow**2 * np.exp(-lag / SLOW_TIME))
            for s in range(len(raw)):
                if valid[s, :, c].all():
                    out[s, :, c] = solve_triangular(factor, raw[s, :, c], lower=True)
                else:
                    out[s, :, c] = np.where(valid[s, :, c], raw[s, :, c], 0.0) / np.hypot(white, slow)
        return out.reshape(len(raw), -1)

    def state_columns(self, theta: FloatArray, x0: FloatArray, k: int) -> FloatArray:
        """Central differences to the first `k` directions of the initial state, (segments, rows, k)."""
        columns = []
        for j in range(k):
            a = np.zeros(12)
            a[j] = STATE_STEP[j]
            plus, minus = self.residual(theta, perturbed(x0, a)), self.residual(theta, perturbed(x0, -a))
            columns.append((plus - minus) / (2.0 * STATE_STEP[j]))
        return np.stack(columns, axis=2)

    def parameter_columns(self, theta: FloatArray, x0: FloatArray, free: Free) -> FloatArray:
        """Central differences to the scaled parameters, (segments, rows, parameters)."""
        columns = []
        for e in free.entries:
            values = []
            for sign in (1.0, -1.0):
                moved = theta.copy()
                if e.name in NOMINAL_NAMES:
                    moved[e.index] *= np.exp(sign * PARAMETER_STEP)
                else:
                    moved[e.index] += sign * PARAMETER_STEP * e.typical
                values.append(self.residual(moved, x0))
            columns.append((values[0] - values[1]) / (2.0 * PARAMETER_STEP))
        return np.stack(columns, axis=2)
