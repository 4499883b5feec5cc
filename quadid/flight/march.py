"""The march through a flight: one numerical kernel, kept whole because it is the order of events."""

from __future__ import annotations

import numpy as np

from quadid.attitude_controller import stabilise
from quadid.flight.airframe import Air, Body, Oddity
from quadid.flight.jit import kernel
from quadid.flight.loop import (
    NO_TIME,
    Events,
    OnBoard,
    Plan,
    Progress,
    Track,
    Turning,
    fly_on,
    pull_attitude,
    quaternion_of,
    shake,
    turned,
)
from quadid.flight.pilot import Pilot, fly_by_hand
from quadid.flight.rotors import Drive
from quadid.types import FloatArray

FLEW, CRASHED = 0, 1


@kernel
def copy_into(values: FloatArray, out: FloatArray) -> None:
    """Copies numbers one by one: assigning a slice would compile a message about shapes for seconds."""
    for i in range(values.shape[0]):
        out[i] = values[i]


@kernel
def march(
    plan: Plan, body: Body, air: Air, odd: Oddity, drive: Drive, events: Events, on_board: OnBoard, pilot: Pilot,
    gains: FloatArray, mixer: FloatArray, sticks: FloatArray, gyro_noise: FloatArray, tilt_noise: FloatArray,
    arrival: FloatArray, pushes: FloatArray, efficiency: FloatArray, y: FloatArray, rotors: Turning, track: Track,
) -> tuple[int, float]:  # fmt: skip
    """Flies the closed loop.

    Args:
        gains: of the stabiliser, see `pack_gains`.
        mixer: of the stabiliser, see `mixer_matrix`.
        sticks: shape (pilot instants, 4).
        gyro_noise: shape (control instants, 3) [rad/s].
        tilt_noise: AHRS error as body rotation vector, shape (control instants, 3) [rad].
        arrival: when each command reaches the rotors [s], non-decreasing, shape (control instants,).
        pushes: disturbance, see `airframe.derivative`: shape (1, 9) for a constant one, or one row a step.
        efficiency: factors on thrust and drag torque, shape (rotors, 2).
        y: state at the start, shape (33,); in place.
        rotors: at the start; in place.
        track: written.

    Returns:
        `FLEW` or `CRASHED` (hit the ground, overturned or diverged), and the time of the end [s].
    """
    dt, hover = plan.dt, air.hover_sum / rotors.speed.shape[0]
    integral, trim = np.zeros(3), np.zeros(3)
    reference, measured = np.zeros(4), np.zeros(3)
    error = np.zeros(9)
    error[0] = error[4] = error[8] = 1.0
    truth, ahrs, seen = np.zeros((3, 3)), np.zeros((3, 3)), np.zeros((3, 3))
    force, shaken, trembling = np.zeros(3), np.zeros(3), np.zeros(6)
    shaking = on_board.gyro_shake > 0.0 or on_board.accel_shake > 0.0
    progress, issued, row = Progress(0, NO_TIME, 0, False), 0, 0

    for n in range(plan.steps):
        now = plan.start + n * dt
        # --- sensors, just before the command of this instant acts
        for i in range(3):
            for j in range(3):
                truth[i, j] = y[6 + 3 * i + j]
        for axis in range(3):
            track.gyro[n, axis] = y[15 + axis] + on_board.gyro_shake * trembling[axis]
            track.accel[n, axis] = y[18 + axis] + shaken[axis]
        if on_board.pull != 0.0:
            for i in range(3):
                for j in range(3):
                    ahrs[i, j] = (
                        error[3 * i] * truth[0, j] + error[3 * i + 1] * truth[1, j] + error[3 * i + 2] * truth[2, j]
                    )
            if n > 0:
                for i in range(3):
                    force[i] = on_board.accel_bias[i]
                    for j in range(3):
                        raw = (track.accel[n, j] - track.accel[n - 1, j]) / dt
                        force[i] += on_board.accel_matrix[i, j] * raw
                pull_attitude(error, ahrs, force, on_board.pull * dt)
        else:
            for i in range(3):
                for j in range(3):
                    ahrs[i, j] = truth[i, j]
        quaternion_of(ahrs, track.attitude[n])

        # --- pilot and stabiliser
        if n % plan.pilot_every == 0:
            stick = sticks[min(n // plan.pilot_every, sticks.shape[0] - 1)]
            fly_by_hand(pilot, y[0:3], y[3:6], truth, stick, trim, reference)
            tilted = truth[2, 2] < 0.1 or y[2] > 0.0 or not np.isfinite(y[15] + y[2] + y[3])
            if tilted:
                return CRASHED, now
        if row < plan.rows and n == plan.first_log + row * plan.log_every:
            copy_into(y, track.state[row])
            copy_into(reference, track.reference[row])
            copy_into(rotors.speed, track.rotor[row])
            row += 1
        if n % plan.control_every == 0:
            c = n // plan.control_every
            turned(ahrs, tilt_noise[c], seen)
            for i in range(3):
                measured[i] = on_board.gyro_bias[i] + gyro_noise[c, i]
                for j in range(3):
                    measured[i] += on_board.gyro_matrix[i, j] * track.gyro[n, j]
            stabilise(gains, mixer, reference, seen, measured, plan.control_every * dt, integral, track.command[c])
            issued = c + 1

        # --- the step
        push = pushes[min(n, pushes.shape[0] - 1)]
        progress = fly_on(
            now, now + dt, issued, progress, track.command, arrival, efficiency, push, body, air, odd, drive, events,
            y, rotors,
        )  # fmt: skip
        if shaking:
            shake(rotors.phase, rotors.speed, on_board.shake_mode, hover, trembling)
            for axis in range(3):
                shaken[axis] += dt * on_board.accel_shake * trembling[3 + axis]
    return FLEW, plan.start + plan.steps * dt
