"""The model in closed loop: the stabiliser turns the model's own motion and the pilot's references into rotor input.

A whole window is simulated from references and throttle only, as the paper does.
"""

from collections.abc import Mapping
from typing import NamedTuple

import numba as nb
import numpy as np

from quadid.attitude_controller import pack_gains, rotation_of, steer, write_rotation
from quadid.data.window import Window
from quadid.errors import ParameterError, WindowError
from quadid.model import layout as ix
from quadid.model.body_kernel import N_SIGNALS, residual_coefficients, residual_forces, residual_signals, step_full
from quadid.model.kernel import Flight, Needs, body_constants, copy, flight_factors, load_payload, needs_of, step_core
from quadid.model.layout import residual_terms
from quadid.model.rollout import Rollout, Segments
from quadid.model.rollout import _threads as worker_threads
from quadid.model.rotor_kernel import input_constants, rotor_constants, turn_rotor
from quadid.model.sensor_kernel import distort_imu, sensor_constants, step_tilt_error, tilt_attitude
from quadid.model.simd import LANES, aligned, cache_aligned, cached, jit
from quadid.rotation import down
from quadid.types import FloatArray, IntArray, check_shapes
from quadid.vehicle import GRAVITY, Vehicle, mixer_matrix

# isort: off
from quadid.model.simd import (
    A_G, C_GB, C_GS, C_R, C_SHIFT, E_QW, F1_X, F2_X, HALF, N_ROWS, N_STATE, ROTOR, R_NEXT, R_NOW, R_PAST, R_SPEED, S_FX,
    S_P, S_QW, X_P, X_QW,
)  # fmt: skip
# isort: on

# --- The kernel
#
# Each lane flies its own trajectory, so rotors are stepped lane by lane from what each lane's stabiliser commanded.
# The flight is kept whole because it is the order of events within a step.


OUTPUTS = 10
"""Rates 3, quaternion 4, mean specific force 3, as the sensors would read them."""
HISTORY = 256
"""Commands that are remembered; bounds the delay, in steps of the stabiliser."""


@nb.njit(**jit)
def _see(lane: int, tilted: bool, s: FloatArray, attitude: FloatArray, rate: FloatArray) -> None:
    """Writes what one lane's stabiliser sees: rotation matrix (3, 3) with the AHRS error, rate (3,) of the gyro."""
    w, x, y, z = s[X_QW + lane], s[X_QW + LANES + lane], s[X_QW + 2 * LANES + lane], s[X_QW + 3 * LANES + lane]
    if tilted:
        a, b, c, d = s[E_QW + lane], s[E_QW + LANES + lane], s[E_QW + 2 * LANES + lane], s[E_QW + 3 * LANES + lane]
        w, x, y, z = (
            a * w - b * x - c * y - d * z,
            a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x,
            a * z + b * y - c * x + d * w,
        )
    write_rotation(w, x, y, z, attitude)
    p, q, r = s[X_P + lane], s[X_P + LANES + lane], s[X_P + 2 * LANES + lane]
    for i in range(3):
        row = C_R + 3 * i * LANES + lane
        seen = s[row] * p + s[row + LANES] * q + s[row + 2 * LANES] * r
        rate[i] = seen * s[C_GS + i * LANES + lane] + s[C_GB + i * LANES + lane]


@nb.njit(**jit)
def _rotors(
    step: int, need: Needs, geometry: FloatArray, dt: float, sent: FloatArray, rot: FloatArray, s: FloatArray
) -> None:
    """Advances all rotors over one step of the stabiliser, from the commands each lane has sent."""
    for r in range(len(geometry)):
        for lane in range(LANES):
            shift = min(int(s[C_SHIFT + lane]), HISTORY - 2)
            rot[r, R_NOW + lane] = sent[(step - shift) % HISTORY, r, lane]
            rot[r, R_PAST + lane] = sent[(step - shift - 1) % HISTORY, r, lane]
            rot[r, R_NEXT + lane] = rot[r, R_NOW + lane]
        turn_rotor(False, r, True, False, geometry, dt, need, rot, s)


@nb.njit(**jit)
def _keep_half(half: int, halves: int, place: int, force: FloatArray, s: FloatArray) -> None:
    """Adds a half step's force, at `place`, to the mean over the first or second half of its row; (2, 3, LANES)."""
    part, share = (0 if half < halves else 1), 1.0 / halves
    for i in range(3):
        for lane in range(LANES):
            force[part, i, lane] += share * s[place + i * LANES + lane]


@cached
def fly_closed_loop(
    references: FloatArray,
    gains: FloatArray,
    mixer: FloatArray,
    substeps: int,
    lanes: int,
    geometry: FloatArray,
    terms: IntArray,
    flight: Flight,
    theta: FloatArray,
    need: Needs,
    x0: FloatArray,
    out: FloatArray,
) -> None:
    """Flies one block of lanes through a window.

    Args:
        references: roll, pitch, yaw [rad], throttle 0..1 of each row, held over it, (n, 4).
        gains: see `quadid.attitude_controller.pack_gains`.
        mixer: see `quadid.attitude_controller.mixer_matrix`.
        substeps: runs of the stabiliser a row.
        lanes: how many of the block's lanes are wanted.
        geometry: (rotors, 4), see `rotor_kernel.Drive`.
        terms: beyond the catalogue, (terms, 4), see `body_kernel.residual_forces`.
        theta: parameter vectors (LANES, size).
        x0: state at the first row (13,).
        out: (n, OUTPUTS, LANES), written: rates, quaternion, mean specific force at each row.
    """
    rotors, dt = len(geometry), flight.dt / substeps
    s = cache_aligned(N_ROWS * LANES)
    s[:] = 0.0
    s[A_G : A_G + 2 * LANES] = 1.0
    s[A_G + HALF : A_G + HALF + 2 * LANES] = 1.0
    rot = cache_aligned(rotors * ROTOR).reshape(rotors, ROTOR)
    rot[:] = 0.0
    body_constants(theta, flight, rotors, s)
    sensor_constants(theta, dt, s)
    rotor_constants(theta, dt, rot, s)
    input_constants(theta, s)
    for i in range(N_STATE):
        s[X_QW + i * LANES : X_QW + (i + 1) * LANES] = x0[i]
    s[E_QW : E_QW + LANES] = 1.0
    coefficients = cache_aligned(len(terms) * LANES).reshape(len(terms), LANES)
    signals = cache_aligned(N_SIGNALS * LANES).reshape(N_SIGNALS, LANES)
    residual_coefficients(theta, rotors, coefficients)
    sent, command = np.zeros((HISTORY, rotors, LANES)), np.zeros(rotors)
    integral, attitude, rate = np.zeros((LANES, 3)), np.zeros((3, 3)), np.zeros(3)
    wanted, torque = np.zeros((3, 3)), np.zeros(3)
    force, last, kept = np.zeros((2, 3, LANES)), np.zeros((3, LANES)), np.zeros((7, LANES))
    for k in range(len(references)):
        copy(force[1], last)
        force[:] = 0.0
        rotation_of(references[k, 0], references[k, 1], references[k, 2], wanted)
        throttle = references[k, 3]
        for sub in range(substeps):
            step = k * substeps + sub
            for lane in range(lanes):
                _see(lane, need.ahrs, s, attitude, rate)
                steer(gains, mixer, wanted, throttle, attitude, rate, dt, integral[lane], torque, command)
                for r in range(rotors):
                    sent[step % HISTORY, r, lane] = command[r]
            for lane in range(lanes, LANES):
                for r in range(rotors):
                    sent[step % HISTORY, r, lane] = sent[step % HISTORY, r, lanes - 1]
            if step == 0:  # as if the first command had acted for ever
                for i in range(1, HISTORY):
                    copy(sent[0], sent[i])
                for r in range(rotors):
                    for lane in range(LANES):
                        rot[r, R_SPEED + lane] = sent[0, r, lane]
            _rotors(step, need, geometry, dt, sent, rot, s)
            if need.factors:
                flight_factors(flight.t0 + dt * step, flight.span0, flight.span1, dt, s)
            if need.learned:
                residual_signals(s, signals)
                residual_forces(terms, coefficients, signals, step == 0, s)
            if need.payload:
                load_payload(flight.t0 + dt * step, dt, theta, s)
            if need.full:
                step_full(dt, s)
            else:
                step_core(dt, s)
            if need.ahrs:
                step_tilt_error(s)
                tilt_attitude(s)
            _keep_half(2 * sub, substeps, F1_X, force, s)
            _keep_half(2 * sub + 1, substeps, F2_X, force, s)
            if sub == 0:
                for i in range(7):
                    for lane in range(LANES):
                        kept[i, lane] = s[S_QW + i * LANES + lane]
        if k == 0:
            copy(force[0], last)
        for i in range(3):
            for lane in range(LANES):
                s[S_P + i * LANES + lane] = kept[4 + i, lane]
                # The accelerometer averages over one sample centred on t_k.
                s[S_FX + i * LANES + lane] = 0.5 * (last[i, lane] + force[0, i, lane])
        if need.imu_static:
            distort_imu(s)
        for i in range(3):
            for lane in range(LANES):
                out[k, i, lane] = s[S_P + i * LANES + lane]
                out[k, 7 + i, lane] = s[S_FX + i * LANES + lane]
        for i in range(4):
            for lane in range(LANES):
                out[k, 3 + i, lane] = kept[i, lane]


# --- Typed wrapper of the closed loop: a whole window simulated from references and throttle only, as the paper does


class Flown(NamedTuple):
    """Readings of the simulated vehicle's sensors, rows of the window.

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
                "roll, pitch, yaw [rad] and throttle 0..1 in every row",
                "log the references",
            )
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
            "fly_closed_loop",
            ("theta", full, (LANES, ix.LOSS + 2 * rotors + len(self._terms))),
            ("references", self._references, (len(self.window), 4)),
            ("mixer", self._mixer, (rotors, 4)),
        )
        fly_closed_loop(
            self._references,
            self._gains,
            self._mixer,
            self.substeps,
            lanes,
            self._geometry,
            self._terms,
            self._flight,
            full,
            needs_of(full, rotors, 9),
            self._x0,
            out,
        )
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
