"""Typed wrapper of the closed loop: a whole window simulated from references and throttle only, as the paper does."""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple

import numpy as np

from quadid.attitude_controller import mixer_matrix, pack_gains
from quadid.data.window import Window
from quadid.errors import ParameterError, WindowError
from quadid.model import layout as ix
from quadid.model.closed_loop_kernel import OUTPUTS, fly_closed_loop
from quadid.model.kernel import needs_of
from quadid.model.layout import residual_terms
from quadid.model.rollout import Rollout, Segments
from quadid.model.rollout import _threads as worker_threads
from quadid.model.simd import LANES, aligned
from quadid.rotation import down
from quadid.types import FloatArray, check_shapes
from quadid.vehicle import GRAVITY, Vehicle


class Flown(NamedTuple):
    """What the simulated vehicle's sensors read, rows of the window.

    Attributes:
        rates: body rates [rad/s], shape (m, n, 3).
        attitude: quaternions body to world, shape (m, n, 4).
        accel: mean specific force over one sample centred on the row [m/s^2], shape (m, n, 3).
    """

    rates: FloatArray
    attitude: FloatArray
    accel: FloatArray


class ClosedLoop:
    """The model of one window under its stabiliser."""

    def __init__(self, window: Window, vehicle: Vehicle, gains: Mapping[str, float], rate: float | None = None) -> None:
        """Prepares a window.

        Args:
            window: with `attitude_reference`, finite throughout.
            vehicle: geometry and mass.
            gains: of the stabiliser, see `quadid.attitude_controller.GAIN_UNITS`.
            rate: how often the stabiliser runs [Hz], a multiple of the grid's rate; None: once a row.

        Raises:
            WindowError: no references, or gaps in them.
            ParameterError: unknown gains or an impossible rate.
        """
        if window.attitude_reference is None or not np.isfinite(window.attitude_reference).all():
            raise WindowError(
                f"{window.name or 'window'}: no complete attitude and throttle references",
                "roll, pitch, yaw [rad] and throttle 0..1 in every row", "log the references",
            )  # fmt: skip
        self.substeps = 1 if rate is None else round(rate * window.dt)
        if self.substeps < 1 or (rate is not None and abs(rate * window.dt - self.substeps) > 1e-6):
            raise ParameterError(f"stabiliser rate {rate} Hz", f"a whole multiple of {1.0 / window.dt:g} Hz")
        rollout = Rollout(window, vehicle)
        self.window, self.channels = window, rollout.channels
        self._geometry, self._terms, self._gains = rollout.geometry, residual_terms(vehicle), pack_gains(gains)
        self._mixer = mixer_matrix(vehicle, gains)
        self._references = np.ascontiguousarray(window.attitude_reference)
        self._flight = rollout.flight
        self._x0 = rollout.initial_states(Segments(1, 1, np.array([1], dtype=np.int64)), 1)[0]

    def fly(self, theta: FloatArray) -> Flown:
        """Simulates the whole window for every parameter vector, shape (m, size)."""
        m = len(theta)
        blocks = [theta[i : i + LANES] for i in range(0, m, LANES)]
        parts = list(worker_threads().map(self._block, blocks)) if len(blocks) > 1 else [self._block(blocks[0])]
        out = np.concatenate(parts)
        flown = Flown(*(np.ascontiguousarray(out[:, :, columns]) for columns in (_RATES, _ATTITUDE, _ACCEL)))
        for i in range(m):
            _telemetry(flown, i, theta[i], self.window.dt)
        return flown

    def _block(self, theta: FloatArray) -> FloatArray:
        lanes = len(theta)
        full = np.concatenate([theta, np.repeat(theta[-1:], LANES - lanes, axis=0)])
        out = aligned((len(self.window), OUTPUTS, LANES))
        rotors = len(self._geometry)
        check_shapes(
            "fly_closed_loop", ("theta", full, (LANES, ix.LOSS + 2 * rotors + len(self._terms))),
            ("references", self._references, (len(self.window), 4)), ("mixer", self._mixer, (rotors, 4)),
        )  # fmt: skip
        fly_closed_loop(
            self._references, self._gains, self._mixer, self.substeps, lanes, self._geometry, self._terms, self._flight,
            full, needs_of(full, rotors, 9), self._x0, out,
        )  # fmt: skip
        return np.ascontiguousarray(np.moveaxis(out[..., :lanes], 2, 0))


_RATES, _ATTITUDE, _ACCEL = slice(0, 3), slice(3, 7), slice(7, 10)


def _telemetry(flown: Flown, i: int, theta: FloatArray, dt: float) -> None:
    """Applies what delays a reading on its way to the log but not to the stabiliser, in place: IMU lag, attitude."""
    if theta[ix.IMU_PERIOD] > 0.0:
        for values in (flown.rates[i], flown.accel[i]):
            values[:] = _lagged(values, 1.0 / theta[ix.IMU_PERIOD], dt)
    if theta[ix.ATT_DELAY] > 0.0:
        rows = np.clip(np.arange(len(flown.attitude[i])) - theta[ix.ATT_DELAY] / dt, 0.0, None)
        low = np.floor(rows).astype(np.int64)
        part = (rows - low)[:, None]
        q = flown.attitude[i]
        mixed = (1.0 - part) * q[low] + part * q[np.minimum(low + 1, len(q) - 1)]
        q[:] = mixed / np.linalg.norm(mixed, axis=1, keepdims=True)


def _lagged(values: FloatArray, cutoff: float, dt: float) -> FloatArray:
    """Second-order Butterworth of columns known at the rows, linear in between; settled at the first row."""
    from scipy.signal import butter, cont2discrete, lfilter, lfiltic  # slow to import, rarely needed

    matrix, bottom, _ = cont2discrete(butter(2, 2.0 * np.pi * cutoff, analog=True), dt, method="foh")
    top = np.ravel(matrix)
    out = np.empty_like(values)
    for c, column in enumerate(values.T):
        start = lfiltic(top, bottom, np.full(2, column[0]), np.full(2, column[0]))
        out[:, c] = lfilter(top, bottom, column, zi=start)[0]
    return out


def kinematic_acceleration(force: FloatArray, attitude: FloatArray) -> FloatArray:
    """Gravity-corrected acceleration in body axes [m/s^2]: specific force plus gravity seen through the attitude.

    Args:
        force: specific force [m/s^2], shape (..., 3).
        attitude: unit quaternions body to world, shape (..., 4).
    """
    return np.asarray(force + GRAVITY * down(attitude))
