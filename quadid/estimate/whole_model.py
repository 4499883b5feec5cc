"""The whole table of effects in the filter: what `quadid.model` makes of each filtered state, beyond the filter's own.

The filter carries the nominal vehicle and a few effects in its own equations.  Any other effect it takes as an addition
to its means: from every filtered state `quadid.model` simulates one step with it and one without, all rows at once, and
the difference is added there, with its slope by rates and velocity, so that air which brakes does so in the filter too.
The filter then runs anew, and its states change a little; a few rounds settle both (Newton's, as in an iterated Kalman
filter).  Sensitivities by any entry of the vector are those of both (`problem.Problem.normal_equations`).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import numpy as np

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.kalman import Beyond
from quadid.model.layout import AHRS_K, ATT_DELAY, IMU_PERIOD, Layout
from quadid.model.rollout import Rollout, Segments
from quadid.model.sensor_kernel import tilt_errors
from quadid.model.simd import LANES, N_ROWS
from quadid.rotation import product, turn
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

IN_SENSORS = (
    "imu_lag",
    "attitude_delay",
    "imu_lever_arm",
    "imu_misalignment",
    "gyro_scale",
    "gyro_bias",
    "accel_bias",
    "ahrs_acceleration_error",
    "velocity_scale",
)
"""Effects that leave the motion alone."""
NUDGE = 1e-3
"""Step of derivatives by rates [rad/s] and velocity [m/s]."""
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
            window.t0,
            window.dt,
            window.rotor_speed,
            zero,
            level,
            zero,
            zero,
            zero,
            window.battery,
            sampling=window.sampling,
            rotor_slope=window.rotor_slope,
            log_span=window.log_span,
        )
        self._window, self._vehicle, self._own, self._rollout = window, vehicle, own, Rollout(blank, vehicle)
        entries = Layout(vehicle).entries.values()
        self._sensors = [(e.index, e.neutral) for e in entries if e.name.split(".")[0] in IN_SENSORS]
        self._more = [(e.index, e.neutral) for e in entries if e.name not in own]

    def cut(self, first: int, last: int) -> WholeModel:
        """The same along rows `first` to before `last`."""
        return WholeModel(self._window.slice(first, last), self._vehicle, self._own)

    def beyond(self, thetas: FloatArray, means: FloatArray) -> FloatArray:
        """`Beyond.added` of full parameter vectors (m, size) at filtered means (n, N_MEAN), shape (m, n, 9 + M).

        The difference of two models, so that it holds no difference of two integrations.
        """
        return self._beyond(thetas, means, np.zeros((1, 12)))[0]

    def _beyond(self, thetas: FloatArray, means: FloatArray, moves: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Additions of several vectors, and steps (moves, n - 2, 12) of the first; `moves` are added to the means."""
        plain, motion = self._models(thetas)
        beside = np.repeat(moves, len(thetas), axis=0)
        # 1. One step of the motion from every mean, beside one without what the filter has not.
        late = _SETTLED * max(thetas[:, IMU_PERIOD].max(), 0.0) + max(thetas[:, ATT_DELAY].max(), 0.0)
        pull, thetas = thetas[:, AHRS_K], thetas.copy()
        thetas[:, AHRS_K] = 0.0
        sensed = not np.array_equal(thetas, motion)
        both = [np.tile(v, (len(moves), 1)) for v in (plain, motion)]
        own, moved, *read = self._rolled([*both, *([thetas] if sensed and late == 0.0 else [])], means, 1, beside)
        out, step = np.zeros((len(thetas), len(means), 9 + k.M)), _step(own, moved)
        moved = moved[: len(thetas)]
        out[:, :-2, :9] = step[: len(thetas), :, :9]
        out[:, 1:-1, 9 + k.ACCEL : 9 + k.VELOCITY] = step[: len(thetas), :, 9:]
        # 2. What sensors make of it; those with a memory look back over as many steps.
        lead = 1 + int(np.ceil(late / self._window.dt))
        if sensed and lead < len(means) - 1:  # of a stretch shorter than the memory nothing is known
            true, sensors = self._rolled([motion, thetas], means, lead) if late > 0.0 else (moved, read[0])
            out[:, lead:-1, 9:12] = sensors[..., :3] - true[..., :3]
            out[:, lead:-1, 12:15] = turn(_attitude(true), _attitude(sensors))
            out[:, lead:-1, 15:21] += sensors[..., 6:12] - true[..., 6:12]
        # 3. The attitude filter remembers a whole flight.
        if pull.any():
            out[:, 1:-1, 12:15] += self._pulled(pull, means, moved[0, :, 6:9])
        return out, step[:: len(thetas)]

    def _pulled(self, gain: FloatArray, means: FloatArray, force: FloatArray) -> FloatArray:
        """Rotation vectors by which an AHRS of each gain (m,) [1/s] is off in body axes, shape (m, n - 2, 3).

        Args:
            gain: of the accelerometer in the attitude filter [1/s].
            means: filtered means, shape (n, N_MEAN).
            force: mean specific force over the step to each of the samples in between [m/s^2], shape (n - 2, 3).
        """
        attitude, out = np.ascontiguousarray(means[:-1, :4]), np.zeros((len(gain), len(means) - 2, 3))
        for first in range(0, len(gain), LANES):
            some = gain[first : first + LANES]
            error, work = np.zeros((LANES, len(attitude), 4)), np.zeros(N_ROWS * LANES)
            tilt_errors(np.resize(some, LANES), self._window.dt, attitude, np.ascontiguousarray(force), work, error)
            out[first : first + LANES] = turn(attitude, product(error, attitude))[: len(some), 1:]
        return out

    def along(self, theta: FloatArray, means: FloatArray) -> Beyond:
        """Addition of a full parameter vector (size,) along filtered means (n, N_MEAN), with its slope there."""
        moves = np.zeros((7, 12))
        moves[1:, 3:9] = NUDGE * np.eye(6)
        added, step = self._beyond(theta[None], means, moves)
        slope = np.zeros((len(means), 12, 6))
        slope[:-2] = np.moveaxis((step[1:] - step[0]) / NUDGE, 0, -1)
        return Beyond(added[0], slope, means[:, 4:10].copy())

    def _models(self, thetas: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Full vectors of the filter's own equations, and of the motion with all effects, of (m, size) each."""
        plain, motion = thetas.copy(), thetas.copy()
        for index, neutral in self._sensors:
            motion[:, index] = neutral
        for index, neutral in self._more:
            plain[:, index] = neutral
        return plain, motion

    def _rolled(
        self, vectors: Sequence[FloatArray], means: FloatArray, lead: int, moves: FloatArray | None = None
    ) -> list[FloatArray]:
        """Measurements `lead` steps after every mean but the last two, a (m, n - 1 - lead, 12) array each.

        `moves` (m, 12) are added to the means of the first two, as rotation vector, rates, velocity and position.
        """
        states = np.zeros((len(means) - 1 - lead, 13))
        states[:, :10] = means[: len(states), :10]
        if self._window.position is not None:
            states[:, 10:] = np.nan_to_num(self._window.position[: len(states)])
        cut = Segments(1, lead, np.arange(lead, len(means) - 1, dtype=np.int64))
        every = np.concatenate(vectors)
        beside = np.zeros((len(every), 12))
        if moves is not None:
            beside[: 2 * len(moves)] = np.tile(moves, (2, 1))
        # Most entries change one of the models only: what is the same is simulated once.
        kinds, which = np.unique(np.hstack([every, beside]), axis=0, return_inverse=True)
        lanes, _ = self._rollout.roll(cut, kinds[:, :-12], states, kinds[:, -12:], n_pre=lead)
        block, lane = np.divmod(which.ravel(), LANES)
        return np.split(lanes[block, :, 0, :, lane], np.cumsum([len(v) for v in vectors])[:-1])


def _step(own: FloatArray, moved: FloatArray) -> FloatArray:
    """Differences in rate, rotation vector, velocity and specific force of predicted measurements, shape (..., 12)."""
    turned = turn(_attitude(own), _attitude(moved))
    return np.concatenate([(moved - own)[..., :3], turned, (moved - own)[..., 9:12], (moved - own)[..., 6:9]], axis=-1)


def _attitude(read: FloatArray) -> FloatArray:
    """Unit quaternions of residuals against no rotation, which are twice their vector parts, shape (..., 4)."""
    half = 0.5 * read[..., 3:6]
    scalar = np.sqrt(np.maximum(1.0 - np.sum(half**2, axis=-1, keepdims=True), 0.0))
    return np.concatenate([scalar, half], axis=-1)
