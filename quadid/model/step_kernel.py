"""Steps of the simulation for a batch of vehicles, each with a state and a command of its own.

Rotors, body and sensors are those of `quadid.model.rollout_kernel`.  Sensors are read at the end of a step, from what
has happened by then: the accelerometer is the mean over the step that ends there, and the filters work on that.
"""

from __future__ import annotations

import math
from typing import Any

import numba as nb
import numpy as np

from quadid.model.body_kernel import (
    N_SIGNALS,
    residual_coefficients,
    residual_forces,
    residual_signals,
    step_in_air,
)
from quadid.model.kernel import Flight, Needs, body_constants, flight_factors, load_payload
from quadid.model.rotor_kernel import input_constants, rotor_constants, turn_rotor
from quadid.types import BoolArray, FloatArray, IntArray

# isort: off
from quadid.model.work_array import (
    A_G, C_SHIFT, E_QW, F1_X, F2_X, G_BEND, G_DF, G_F, G_F0, G_FM, G_W, G_W0, HALF, N_QW, N_ROWS, N_STATE, ROTOR,
    R_NEXT, R_NOW, R_PAST, S_BENDX, S_FX, S_P, S_QW, T_A1, X_D, X_E, X_N, X_P, X_Q, X_QW, X_QX, X_QY, X_QZ, X_R, X_VD,
    X_VE, X_VN,
)  # fmt: skip

# isort: on
from quadid.model.sensor_kernel import (
    delay_attitude,
    distort_imu,
    sensor_constants,
    step_filter,
    step_tilt_error,
    tilt_attitude,
)
from quadid.model.simd import LANES, SOURCES, cache_aligned, cached, jit

STATE = X_QW
"""First row that belongs to the state; those before are constants and sums of one step."""
SENSED = S_QW
TURNS = 6
"""Random numbers of a lane and step: specific force 3, angular acceleration 3."""


@nb.njit(**jit)
def _scrambled(x: np.uint64) -> np.uint64:
    """Scrambles 64 bits: splitmix64's finaliser (Steele, Lea & Flood 2014, doi:10.1145/2660193.2660195)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


@nb.njit(**jit)
def _random_inputs(seed: int, vehicle: int, step: int, walk: FloatArray, state: FloatArray) -> None:
    """Advances one vehicle's random inputs, first-order Gauss-Markov processes, by a step.

    The numbers follow from seed, vehicle and step alone (a counter, not a stream), so that a step can be repeated.

    Args:
        seed: of all numbers.
        vehicle: place in the batch.
        step: number of the step.
        walk: exp(-dt / T) of each input, and the standard deviation of what a step adds, (2, TURNS).
        state: the inputs (TURNS,), advanced.
    """
    base = _scrambled(np.uint64(seed) + np.uint64(0x9E3779B97F4A7C15) * np.uint64(vehicle + 1))
    for pair in range(TURNS // 2):
        at = base + np.uint64(0x9E3779B97F4A7C15) * np.uint64(TURNS * step + 2 * pair + 1)
        first = (float(_scrambled(at) >> np.uint64(11)) + 0.5) * 2.0**-53
        second = float(_scrambled(at + np.uint64(0x9E3779B97F4A7C15)) >> np.uint64(11)) * 2.0**-53
        radius, angle = math.sqrt(-2.0 * math.log(first)), 2.0 * math.pi * second  # Box & Muller 1958
        for i in range(2):
            normal = radius * (math.cos(angle) if i == 0 else math.sin(angle))
            at_i = 2 * pair + i
            state[at_i] = walk[0, at_i] * state[at_i] + walk[1, at_i] * normal


@nb.njit(**jit)
def _push(dt: float, inputs: FloatArray, s: FloatArray) -> None:
    """Lets random specific force and angular acceleration (TURNS, LANES) act over a step that has just been made."""
    for lane in range(LANES):
        fx, fy, fz = inputs[0, lane], inputs[1, lane], inputs[2, lane]
        qw, qx, qy, qz = s[X_QW + lane], s[X_QX + lane], s[X_QY + lane], s[X_QZ + lane]
        n = (qw * qw + qx * qx - qy * qy - qz * qz) * fx + 2.0 * ((qx * qy - qw * qz) * fy + (qx * qz + qw * qy) * fz)
        e = (qw * qw - qx * qx + qy * qy - qz * qz) * fy + 2.0 * ((qx * qy + qw * qz) * fx + (qy * qz - qw * qx) * fz)
        d = (qw * qw - qx * qx - qy * qy + qz * qz) * fz + 2.0 * ((qx * qz - qw * qy) * fx + (qy * qz + qw * qx) * fy)
        s[X_VN + lane] += dt * n
        s[X_VE + lane] += dt * e
        s[X_VD + lane] += dt * d
        s[X_N + lane] += 0.5 * dt * dt * n
        s[X_E + lane] += 0.5 * dt * dt * e
        s[X_D + lane] += 0.5 * dt * dt * d
        p, q, r = dt * inputs[3, lane], dt * inputs[4, lane], dt * inputs[5, lane]
        s[X_P + lane] += p
        s[X_Q + lane] += q
        s[X_R + lane] += r
        a, b, c = 0.25 * dt * p, 0.25 * dt * q, 0.25 * dt * r  # half the angle that half the change of rate makes
        s[X_QW + lane] = qw - qx * a - qy * b - qz * c
        s[X_QX + lane] = qx + qw * a + qy * c - qz * b
        s[X_QY + lane] = qy + qw * b + qz * a - qx * c
        s[X_QZ + lane] = qz + qw * c + qx * b - qy * a
        for first in (F1_X, F2_X):
            s[first + lane] += fx
            s[first + LANES + lane] += fy
            s[first + 2 * LANES + lane] += fz


@nb.njit(**jit)
def _read_sensors(first: bool, dt: float, need: Needs, s: FloatArray, past: FloatArray) -> None:
    """Writes what the sensors read at the end of a step: rows S_QW to S_FZ.

    Args:
        first: no step has been made before; filters begin settled.
        dt: step [s].
        need: which parts of the model any lane needs.
        s: rows.
        past: attitude and rate at the ends of the last steps, (rows, 7, LANES), the newest last; moved on.
    """
    if need.ahrs:  # needs the attitude at both ends of the step
        step_tilt_error(s)
        for i in range(4 * LANES):
            s[E_QW + i] = s[N_QW + i]
    for i in range(7 * LANES):
        s[S_QW + i] = s[X_QW + i]
    for i in range(3 * LANES):
        s[S_FX + i] = 0.5 * (s[F1_X + i] + s[F2_X + i])
    if need.imu_lag:
        for i in range(3 * LANES):
            if first:
                s[G_F + i], s[G_DF + i], s[G_F0 + i] = s[S_FX + i], 0.0, s[S_FX + i]
            s[G_BEND + i], s[G_FM + i] = s[S_BENDX + i], 0.5 * (s[G_F0 + i] + s[S_FX + i])
        step_filter(dt, s)
        for i in range(3 * LANES):
            s[G_W0 + i], s[G_F0 + i] = s[S_P + i], s[S_FX + i]
            s[S_P + i], s[S_FX + i] = s[G_W + i], s[G_F + i]
    if need.att_delay:
        newest = len(past) - 1
        for i in range(newest):
            for row in range(7):
                for lane in range(LANES):
                    past[i, row, lane] = past[i + 1, row, lane]
        for row in range(7):
            for lane in range(LANES):
                past[newest, row, lane] = s[X_QW + row * LANES + lane]
        delay_attitude(newest, dt, past, s)
    if need.ahrs:
        tilt_attitude(s)
    if need.imu_static:
        distort_imu(s)


def _on_disk(sources: int) -> Any:
    @nb.njit(**cached)
    def write_constants(
        theta: FloatArray, flight: Flight, coefficients: FloatArray, constants: FloatArray, rot: FloatArray
    ) -> None:
        """Writes the constants of all blocks.

        Args:
            theta: parameter vectors (blocks, LANES, size).
            flight: numbers of the vehicle, and the step.
            coefficients: of the terms beyond the catalogue, (blocks, terms, LANES), written.
            constants: rows (blocks, STATE), written.
            rot: rows of the rotors (blocks, rotors, ROTOR); gains written.
        """
        _ = sources
        for block in range(len(theta)):
            s = np.zeros(N_ROWS * LANES)
            for half in range(2):
                for i in range(2 * LANES):
                    s[A_G + half * HALF + i] = 1.0
            body_constants(theta[block], flight, rot.shape[1], s)
            input_constants(theta[block], s)
            sensor_constants(theta[block], flight.dt, s)
            rotor_constants(theta[block], flight.dt, rot[block], s)
            residual_coefficients(theta[block], rot.shape[1], coefficients[block])
            constants[block] = s[:STATE]

    @nb.njit(**cached)
    def step_blocks(
        commands: FloatArray, geometry: FloatArray, theta: FloatArray, terms: IntArray, coefficients: FloatArray,
        needs: BoolArray, constants: FloatArray, walk: FloatArray, time: float, span: float, dt: float, seed: int,
        step: int, delayed: int, state: FloatArray, out: FloatArray,
    ) -> None:  # fmt: skip
        """Makes one step a row of commands with every vehicle of a batch.

        Args:
            commands: rotor speeds [rad/s], held over each step, (steps, vehicles, rotors).
            geometry: (rotors, 4), see `rotor_kernel.Drive`.
            theta: parameter vectors (blocks, LANES, size).
            terms: beyond the catalogue, (terms, 4).
            coefficients: of those, (blocks, terms, LANES).
            needs: which parts of the model any vehicle needs, in the order of `Needs`.
            constants: rows of each block, or of one for all of them, (blocks or 1, STATE).
            walk: of the random inputs, exp(-dt / T) and the standard deviation of what a step adds, (2, TURNS); no rows
                where there are none.
            time: at the start of the first step [s].
            span: time over which a battery sags [s].
            dt: step [s].
            seed: of the random inputs.
            step: number of steps made before.
            delayed: commands that are remembered.
            state: motion and filters, rotors, last commands, past attitudes, random inputs (blocks, width), advanced;
                see `quadid.model.step.State`.
            out: after each step (steps, vehicles, N_STATE + 10), written: motion, sensors; no rows: not wanted.
        """
        _ = sources
        count, rotors = commands.shape[1], commands.shape[2]
        need = Needs(
            needs[0], needs[1], needs[2], needs[3], needs[4], needs[5], needs[6], needs[7], needs[8], needs[9],
            needs[10], needs[11], needs[12], needs[13], needs[14], needs[15], needs[16],
        )  # fmt: skip
        plain = not (need.delayed or need.uneven)
        sensing = need.imu_lag or need.ahrs or need.learned
        moving = N_ROWS * LANES - STATE if sensing else SENSED + 10 * LANES - STATE
        own, signals = np.empty(TURNS), np.empty((N_SIGNALS, LANES))
        s = cache_aligned(N_ROWS * LANES)
        s[STATE:] = 0.0
        newest = delayed - 1
        at_rotors = N_ROWS * LANES - STATE
        at_sent = at_rotors + rotors * ROTOR
        at_inputs = at_sent + delayed * rotors * LANES
        at_past = at_inputs + TURNS * LANES
        for block in range(len(state)):
            now = state[block]
            rot = now[at_rotors:at_sent].reshape(rotors, ROTOR)
            sent = now[at_sent:at_inputs].reshape(delayed, rotors, LANES)
            inputs = now[at_inputs:at_past].reshape(TURNS, LANES)
            past = now[at_past:].reshape(-1, 7, LANES)
            if block < len(constants):
                for i in range(STATE):
                    s[i] = constants[block, i]
            for i in range(moving):
                s[STATE + i] = now[i]
            first, last = block * LANES, count - 1
            for k in range(len(commands)):
                if not plain:
                    for i in range(newest):
                        for r in range(rotors):
                            for lane in range(LANES):
                                sent[i, r, lane] = sent[i + 1, r, lane]
                    for r in range(rotors):
                        for lane in range(LANES):
                            sent[newest, r, lane] = commands[k, min(first + lane, last), r]
                for r in range(rotors):
                    if plain:
                        for lane in range(LANES):
                            s[T_A1 + lane] = commands[k, min(first + lane, last), r]
                    else:
                        for lane in range(LANES):
                            at = newest - int(s[C_SHIFT + lane])
                            rot[r, R_PAST + lane], rot[r, R_NOW + lane] = sent[at - 1, r, lane], sent[at, r, lane]
                            rot[r, R_NEXT + lane] = sent[at, r, lane]
                    turn_rotor(plain, r, True, False, geometry, dt, need, rot, s)
                begin = time + k * dt
                if need.factors:
                    flight_factors(begin, 0.0, span, dt, s)
                if need.payload:
                    load_payload(begin, dt, theta[block], s)
                if need.learned:
                    residual_signals(s, signals)
                    residual_forces(terms, coefficients[block], signals, step + k == 0, s)
                step_in_air(need, dt, s)
                if len(walk) > 0:
                    for lane in range(min(LANES, count - first)):
                        for i in range(TURNS):
                            own[i] = inputs[i, lane]
                        _random_inputs(seed, first + lane, step + k, walk, own)
                        for i in range(TURNS):
                            inputs[i, lane] = own[i]
                    _push(dt, inputs, s)
                _read_sensors(step + k == 0, dt, need, s, past)
                if len(out) > 0:
                    for lane in range(min(LANES, count - first)):
                        for i in range(N_STATE):
                            out[k, first + lane, i] = s[X_QW + i * LANES + lane]
                        for i in range(10):
                            out[k, first + lane, N_STATE + i] = s[SENSED + i * LANES + lane]
            for i in range(moving):
                now[i] = s[STATE + i]

    return write_constants, step_blocks


write_constants, step_blocks = _on_disk(SOURCES)
