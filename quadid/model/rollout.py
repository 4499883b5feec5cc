"""Typed wrapper of the kernel: segments of a window, initial states, many parameter vectors at once."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from quadid.errors import WindowError
from quadid.model import layout as ix
from quadid.model.kernel import LANES, N_STATE
from quadid.model.rollout_kernel import N_TANGENT, roll_segments
from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]

CHANNEL_NAMES = ("p", "q", "r", "phi", "theta", "psi", "a_x", "a_y", "a_z", "v_n", "v_e", "v_d", "x", "y", "z")
"""Residual channels: rates, attitude error as a body rotation vector, specific force, velocity, position."""
CHANNEL_UNITS = ("rad/s",) * 3 + ("rad",) * 3 + ("m/s^2",) * 3 + ("m/s",) * 3 + ("m",) * 3

_VELOCITY_PARAMETERS = [ix.KX, ix.KY, ix.CPAR, ix.KZ, ix.HX, ix.HY, ix.GROUND]
_BODY_PARAMETERS = [ix.LP, ix.MQ, ix.CGX, ix.CGY, ix.JXY, ix.JXZ, ix.JYZ, ix.JSPIN, ix.LAX, ix.LAY, ix.LAZ]
_FACTOR_PARAMETERS = [ix.SAG, ix.DROP_FRACTION, ix.MASS_FRACTION]
_IMU_PARAMETERS = list(range(ix.GBX, ix.MAZ + 1))
_ROTOR_PARAMETERS = [ix.TAU, ix.DELAY, ix.DEAD_SPEED]


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=2, thread_name_prefix="rollout")


@dataclass(frozen=True)
class Segments:
    """How a window is cut for multiple shooting.

    Attributes:
        length: scored rows a segment.
        lead: rows before the first scored one, available to roll in filters and delays.
        starts: first scored row of each segment.
    """

    length: int
    lead: int
    starts: NDArray[np.int64]

    @classmethod
    def cut(cls, rows: int, length: int, lead: int = 1) -> Segments:
        """Cuts `rows` rows into back-to-back segments of `length`, leaving `lead` rows before the first.

        Raises:
            WindowError: when not one segment fits.
        """
        starts = np.arange(lead, rows - length, length, dtype=np.int64)
        if len(starts) == 0:
            raise WindowError(f"window of {rows} rows", f"at least {length + lead + 1} rows", "use a longer stretch")
        return cls(length, lead, starts)


@dataclass(frozen=True)
class _Needs:
    """Which parts of the model any lane uses."""

    full: bool
    rotor_lanes: bool
    factors: bool
    imu_lag: bool
    att_delay: bool
    imu_static: bool
    ahrs: bool


def _needs(theta: FloatArray, channels: int) -> _Needs:
    used = np.any(theta != 0.0, axis=0)
    losses = slice(ix.LOSS, theta.shape[1])
    vary = np.ptp(theta, axis=0) > 0.0
    factors = bool(used[_FACTOR_PARAMETERS].any())
    return _Needs(
        full=bool(
            channels > 9 or factors or used[_VELOCITY_PARAMETERS].any() or used[_BODY_PARAMETERS].any()
        ),
        rotor_lanes=bool(vary[_ROTOR_PARAMETERS].any() or vary[losses].any()),
        factors=factors,
        imu_lag=bool(used[ix.IMU_PERIOD]),
        att_delay=bool(used[ix.ATT_DELAY]),
        imu_static=bool(used[_IMU_PARAMETERS].any()),
        ahrs=bool(used[ix.AHRS_K]),
    )


class Rollout:
    """The simulation of one window: residuals of many parameter vectors against its measurements.

    Attributes:
        window: the data.
        channels: 9, 12 with velocity, 15 with position.
        valid: shape (n, channels), True where there is a measurement.
    """

    def __init__(self, window: Window, vehicle: Vehicle) -> None:
        """Prepares measured arrays; raises WindowError when rotor columns do not match the vehicle."""
        rotors = len(vehicle.rotors)
        if window.rotor_speed.shape[1] != rotors:
            raise WindowError(
                f"{window.name or 'window'}: {window.rotor_speed.shape[1]} rotor columns",
                f"{rotors}, as vehicle '{vehicle.name}' has",
                "choose the vehicle that flew, or map the columns",
            )
        self.window = window
        self.mass = vehicle.mass
        positions = vehicle.rotor_positions
        self.geometry = np.column_stack([positions[:, :2], vehicle.spins])
        gaps = [float(np.linalg.norm(a - b)) for i, a in enumerate(positions) for b in positions[:i]]
        self.reach = 0.5 * min(gaps)
        self.channels = 9
        if window.velocity is not None or window.position is not None:
            self.channels = 15 if window.position is not None else 12
        self.measured, self.valid = _measured(window, self.channels)

    def __len__(self) -> int:
        return len(self.window)

    def roll(
        self, segments: Segments, theta: FloatArray, x0: FloatArray, dx: FloatArray | None = None, n_pre: int = 1
    ) -> tuple[FloatArray, FloatArray]:
        """Simulates every segment for every parameter vector.

        Args:
            segments: the cut.
            theta: parameter vectors, shape (m, size).
            x0: initial states `n_pre` rows before each segment: quaternion, rates [rad/s], velocity [m/s],
                position [m] (NED); shape (segments, 13).
            dx: tangent offset of the initial state of each vector, shape (m, 12); none by default.
            n_pre: rows rolled before the first scored one.

        Returns:
            Residuals predicted - measured, shape (blocks, segments, length, channels, LANES), vector i at
            [i // LANES, ..., i % LANES] (surplus lanes repeat the last vector; unmeasured samples hold 0), and the
            states one step after each segment, shape (blocks, segments, 13, LANES).
        """
        if not 1 <= n_pre <= segments.lead:
            raise ValueError(f"n_pre = {n_pre}; allowed: 1 to the segments' lead, {segments.lead}")
        m = len(theta)
        blocks = -(-m // LANES)
        take = np.minimum(np.arange(blocks * LANES), m - 1)
        th = np.ascontiguousarray(theta[take]).reshape(blocks, LANES, -1)
        offsets = np.zeros((m, N_TANGENT)) if dx is None else dx
        off = np.ascontiguousarray(offsets[take]).reshape(blocks, LANES, N_TANGENT)
        count = len(segments.starts)
        out = np.empty((blocks, count, segments.length, self.channels, LANES))
        ends = np.empty((blocks, count, N_STATE, LANES))

        def run(block: int) -> None:
            self._run(segments, n_pre, x0, th[block], off[block], out[block], ends[block])

        if blocks == 1:
            run(0)
        else:
            list(_threads().map(run, range(blocks)))
        return out, ends

    def _run(
        self, segments: Segments, n_pre: int, x0: FloatArray, theta: FloatArray, dx: FloatArray, out: FloatArray,
        ends: FloatArray,
    ) -> None:  # fmt: skip
        w, need = self.window, _needs(theta, self.channels)
        roll_segments(
            w.rotor_speed, w.sampling == "held", self.geometry, self.mass, self.reach, w.t0, w.dt, w.log_span[0],
            w.log_span[1], self.measured, segments.starts, n_pre, segments.length, x0, theta.T.ravel(), dx, need.full,
            need.rotor_lanes, need.factors, need.imu_lag, need.att_delay, need.imu_static, need.ahrs, self.channels,
            out.reshape(out.shape[0], out.shape[1], -1), ends.reshape(len(ends), -1),
        )  # fmt: skip

    def initial_states(self, segments: Segments, n_pre: int = 1) -> FloatArray:
        """First guess of the states `n_pre` rows before each segment from the measurements, shape (segments, 13).

        Unmeasured parts start level, at rest, at the origin; an isolated missing sample takes its nearest neighbour.
        """
        rows = segments.starts - n_pre
        x0 = np.zeros((len(rows), N_STATE))
        x0[:, 0] = 1.0
        w = self.window
        for values, place in ((w.attitude, 0), (w.gyro, 4), (w.velocity, 7), (w.position, 10)):
            if values is not None and np.isfinite(values).all(axis=1).any():
                good = np.flatnonzero(np.isfinite(values).all(axis=1))
                nearest = good[np.argmin(np.abs(rows[:, None] - good[None, :]), axis=1)] if len(good) < len(w) else rows
                x0[:, place : place + values.shape[1]] = values[nearest]
        return x0


def _measured(window: Window, channels: int) -> tuple[FloatArray, NDArray[np.bool_]]:
    n = len(window)
    measured = np.zeros((n, 16))
    measured[:, 3] = 1.0
    valid = np.zeros((n, channels), dtype=bool)
    places = ((window.gyro, 0, 0), (window.attitude, 3, 3), (window.accel, 7, 6), (window.velocity, 10, 9),
              (window.position, 13, 12))  # fmt: skip
    for values, column, channel in places:
        if values is None:
            continue
        good = np.isfinite(values).all(axis=1)
        measured[good, column : column + values.shape[1]] = values[good]
        valid[good, channel : channel + 3] = True
    return measured, valid
