"""The model in closed loop: the stabiliser turns the model's own motion and the pilot's references into rotor input.

Rotors, body and sensors are those of `quadid.model.rollout_kernel`; the control law is `quadid.attitude_controller`.
Each lane flies its own trajectory, so rotors are stepped lane by lane from what each lane's stabiliser commanded.
The flight is kept whole because it is the order of events within a step.
"""

from __future__ import annotations

from typing import Any

import numba as nb
import numpy as np

from quadid.model.body_kernel import N_SIGNALS, residual_coefficients, residual_forces, residual_signals, step_full
from quadid.model.kernel import Flight, Needs, body_constants, copy, flight_factors, load_payload, step_core
from quadid.model.rotor_kernel import input_constants, rotor_constants, turn_rotor
from quadid.types import FloatArray, IntArray

# isort: off
from quadid.model.work_array import (
    A_G, C_GB, C_GS, C_R, C_SHIFT, E_QW, F1_X, F2_X, HALF, N_ROWS, N_STATE, R_NEXT, R_NOW, R_PAST, R_SPEED, ROTOR,
    S_FX, S_P, S_QW, X_P, X_QW,
)  # fmt: skip
from quadid.model.sensor_kernel import distort_imu, sensor_constants, step_tilt_error, tilt_attitude

# isort: on
from quadid.attitude_controller import rotation_of, steer, write_rotation
from quadid.model.simd import LANES, SOURCES, cache_aligned, cached, jit

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
            a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y,
            a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w,
        )  # fmt: skip
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


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def fly_closed_loop(
        references: FloatArray, gains: FloatArray, mixer: FloatArray, substeps: int, lanes: int, geometry: FloatArray,
        terms: IntArray, flight: Flight, theta: FloatArray, need: Needs, x0: FloatArray, out: FloatArray,
    ) -> None:  # fmt: skip
        """Flies one block of lanes through a window.

        Args:
            references: roll, pitch, yaw [rad], throttle 0..1 of each row, held over it, (n, 4).
            gains: see `quadid.attitude_controller.pack_gains`.
            mixer: see `quadid.attitude_controller.mixer_matrix`.
            substeps: runs of the stabiliser a row.
            lanes: how many of the block's lanes are wanted.
            geometry: (rotors, 4), see `rotor_kernel.Drive`.
            terms: beyond the catalogue, (terms, 4), see `body_kernel.residual_forces`.
            flight: numbers of the window.
            theta: parameter vectors (LANES, size).
            need: which parts of the model any lane needs.
            x0: state at the first row (13,).
            out: (n, OUTPUTS, LANES), written: rates, quaternion, mean specific force at each row.
        """
        _ = sources
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

    return fly_closed_loop


fly_closed_loop = _on_disk(SOURCES)
