"""The whole table of effects in the filter: what `quadid.model` makes of each filtered state, beyond the filter's own.

The filter carries the nominal vehicle and a few effects in its own equations.  Of any other model it takes the means:
every filtered state is simulated by one step with `quadid.model`, all rows at once, and the difference to the filter's
own step is added there.  The filter then runs anew, and its states change a little; a few rounds settle both
(fixed-point iteration, as in an iterated Kalman filter).  Derivatives stay those of the filter's own equations.
"""

from __future__ import annotations

import numpy as np

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.kalman import Track
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.rotation import turn
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

IN_SENSORS = (
    "imu_lag", "attitude_delay", "imu_lever_arm", "imu_misalignment", "gyro_scale", "gyro_bias", "accel_bias",
    "ahrs_acceleration_error", "velocity_scale",
)  # fmt: skip
"""Effects that leave the motion alone."""


class WholeModel:
    """A parameter vector of `quadid.model` along one window, as additions to the filter's own equations.

    Attributes:
        theta: full parameter vector.
        motion: the same without what happens in sensors.
    """

    def __init__(self, window: Window, vehicle: Vehicle, theta: FloatArray) -> None:
        n, zero = len(window), np.zeros((len(window), 3))
        level = np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
        # Against measurements of zero, residuals are the measurements that the model predicts.
        blank = Window(
            window.t0, window.dt, window.rotor_speed, zero, level, zero, zero, zero, window.battery,
            sampling=window.sampling, rotor_slope=window.rotor_slope, log_span=window.log_span,
        )  # fmt: skip
        self._rollout = Rollout(blank, vehicle)
        self._height = window.position
        layout = Layout(vehicle)
        self.theta, self.motion = theta, theta.copy()
        for entry in layout.entries.values():
            if entry.name.split(".")[0] in IN_SENSORS:
                self.motion[entry.index] = entry.neutral

    def beyond(self, track: Track, p: FloatArray, means: FloatArray) -> FloatArray:
        """`Track.beyond` at filtered means (n, N_MEAN); the filter's own physics is p."""
        n = len(means)
        rows = np.arange(1, n - 1)
        states = np.zeros((n - 2, 13))
        states[:, :4], states[:, 4:7], states[:, 7:10] = means[:-2, :4], means[:-2, 4:7], means[:-2, 7:10]
        if self._height is not None:
            states[:, 10:] = np.nan_to_num(self._height[:-2])
        cut = Segments(1, 1, rows.astype(np.int64))
        residual, _ = self._rollout.roll(cut, np.stack([self.motion, self.theta]), states)
        moved, read = residual[0, :, 0, :, 0], residual[0, :, 0, :, 1]
        there = np.zeros((n, k.N_MEAN))
        there[:, 0] = 1.0
        there[rows, :4], there[rows, 4:7], there[rows, 7:10] = _quaternion(moved[:, 3:6]), moved[:, :3], moved[:, 9:12]
        own = k.single_steps(track, p, means)[:-2]
        out = np.zeros((n, 9 + k.M))
        out[rows - 1, :3] = moved[:, :3] - own[:, 4:7]
        out[rows - 1, 3:6] = turn(own[:, :4], there[rows, :4])
        out[rows - 1, 6:9] = moved[:, 9:12] - own[:, 7:10]
        out[rows, 9:12] = read[:, :3] - moved[:, :3]
        out[rows, 12:15] = turn(there[rows, :4], _quaternion(read[:, 3:6]))
        out[rows, 15:18] = read[:, 6:9] - k.specific_force(track, p, there)[rows]
        out[rows, 18:21] = read[:, 9:12] - moved[:, 9:12]
        return out


def _quaternion(twice_vector: FloatArray) -> FloatArray:
    """Unit quaternions of residuals against no rotation: twice their vector parts, shape (n, 3) to (n, 4)."""
    half = 0.5 * twice_vector
    scalar = np.sqrt(np.maximum(1.0 - np.sum(half**2, axis=1), 0.0))
    return np.column_stack([scalar, half])
