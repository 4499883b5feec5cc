"""The whole table of effects in the filter: what `quadid.model` makes of each filtered state, beyond the filter's own.

The filter carries the nominal vehicle and a few effects in its own equations.  Any other effect it takes as an addition
to its means: from every filtered state `quadid.model` simulates one step with it and one without, all rows at once, and
the difference is added there.  The filter then runs anew, and its states change a little; a few rounds settle both
(fixed-point iteration, as in an iterated Kalman filter).  The filter's covariance is that of its own equations;
sensitivities by any entry of the vector are those of both (`problem.Problem.normal_equations`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.model.layout import ATT_DELAY, IMU_PERIOD, Layout
from quadid.model.rollout import Rollout, Segments
from quadid.rotation import turn
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

IN_SENSORS = (
    "imu_lag", "attitude_delay", "imu_lever_arm", "imu_misalignment", "gyro_scale", "gyro_bias", "accel_bias",
    "ahrs_acceleration_error", "velocity_scale",
)  # fmt: skip
"""Effects that leave the motion alone."""
_SETTLED = 1.0
"""Periods of the cutoff after which a low-pass has forgotten how it began."""


class WholeModel:
    """Parameter vectors of `quadid.model` along one window, as additions to the filter's own equations."""

    def __init__(self, window: Window, vehicle: Vehicle, own: Collection[str]) -> None:
        """Prepares a window; `own` names the entries that the filter has in its own equations."""
        zero = np.zeros((len(window), 3))
        level = np.tile([1.0, 0.0, 0.0, 0.0], (len(window), 1))
        # Against measurements of zero, residuals are the measurements that the model predicts.
        blank = Window(
            window.t0, window.dt, window.rotor_speed, zero, level, zero, zero, zero, window.battery,
            sampling=window.sampling, rotor_slope=window.rotor_slope, log_span=window.log_span,
        )  # fmt: skip
        self._window, self._vehicle, self._own, self._rollout = window, vehicle, own, Rollout(blank, vehicle)
        entries = Layout(vehicle).entries.values()
        self._sensors = [(e.index, e.neutral) for e in entries if e.name.split(".")[0] in IN_SENSORS]
        self._more = [(e.index, e.neutral) for e in entries if e.name not in own]

    def cut(self, first: int, last: int) -> WholeModel:
        """The same along rows `first` to before `last`."""
        return WholeModel(self._window.slice(first, last), self._vehicle, self._own)

    def beyond(self, thetas: FloatArray, means: FloatArray) -> FloatArray:
        """`Track.beyond` of full parameter vectors (m, size) at filtered means (n, N_MEAN), shape (m, n, 9 + M).

        The difference of two models, so that it holds no difference of two integrations.
        """
        motion, plain = thetas.copy(), thetas.copy()
        for index, neutral in self._sensors:
            motion[:, index] = neutral
        for index, neutral in self._more:
            plain[:, index] = neutral
        # 1. One step of the motion from every mean, beside one without what the filter has not.
        late = _SETTLED * max(thetas[:, IMU_PERIOD].max(), 0.0) + max(thetas[:, ATT_DELAY].max(), 0.0)
        sensed = not np.array_equal(thetas, motion)
        own, moved, *read = self._rolled([plain, motion, *([thetas] if sensed and late == 0.0 else [])], means, 1)
        out = np.zeros((len(thetas), len(means), 9 + k.M))
        out[:, :-2, :3] = moved[..., :3] - own[..., :3]
        out[:, :-2, 3:6] = turn(_attitude(own), _attitude(moved))
        out[:, :-2, 6:9] = moved[..., 9:12] - own[..., 9:12]
        out[:, 1:-1, 15:18] = moved[..., 6:9] - own[..., 6:9]
        # 2. What sensors make of it; those with a memory look back over as many steps.
        if sensed:
            lead = 1 + int(np.ceil(late / self._window.dt))
            true, sensors = self._rolled([motion, thetas], means, lead) if late > 0.0 else (moved, read[0])
            out[:, lead:-1, 9:12] = sensors[..., :3] - true[..., :3]
            out[:, lead:-1, 12:15] = turn(_attitude(true), _attitude(sensors))
            out[:, lead:-1, 15:21] += sensors[..., 6:12] - true[..., 6:12]
        return out

    def _rolled(self, vectors: Sequence[FloatArray], means: FloatArray, lead: int) -> list[FloatArray]:
        """Measurements `lead` steps after every mean but the last two, a (m, n - 1 - lead, 12) array each."""
        states = np.zeros((len(means) - 1 - lead, 13))
        states[:, :10] = means[: len(states), :10]
        if self._window.position is not None:
            states[:, 10:] = np.nan_to_num(self._window.position[: len(states)])
        cut = Segments(1, lead, np.arange(lead, len(means) - 1, dtype=np.int64))
        lanes, _ = self._rollout.roll(cut, np.concatenate(vectors), states, n_pre=lead)
        each = np.moveaxis(lanes[:, :, 0], 3, 1).reshape(-1, *lanes.shape[1:2], lanes.shape[3])
        return [each[i : i + len(v)] for v, i in zip(vectors, range(0, len(each), len(vectors[0])), strict=False)]


def _attitude(read: FloatArray) -> FloatArray:
    """Unit quaternions of residuals against no rotation, which are twice their vector parts, shape (..., 4)."""
    half = 0.5 * read[..., 3:6]
    scalar = np.sqrt(np.maximum(1.0 - np.sum(half**2, axis=-1, keepdims=True), 0.0))
    return np.concatenate([scalar, half], axis=-1)
