"""The on-board attitude stabiliser: angle P, rate PI, mixer.

    rate reference = angle_p * rotation error
    torque         = rate_p * (rate reference - rate) + integral
    omega^2        = mixer (thrust, torque)

Gains are plain numbers by name, so that a vehicle file can carry them under ``stabiliser: {gains: {...}}``.

A controller is software: it is the same in the flown vehicle and in a simulation of it, and belongs to neither
`quadid.flight` nor `quadid.model`, which share nothing else.
"""

from collections.abc import Mapping

import numpy as np

from quadid.errors import ParameterError, nearest
from quadid.on_disk import kept
from quadid.types import FloatArray


@kept(inline="always")
def write_rotation(w: float, x: float, y: float, z: float, out: FloatArray) -> None:
    """Writes the rotation matrix of a unit quaternion into `out`, shape (3, 3)."""
    out[0, 0], out[0, 1], out[0, 2] = 1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - w * z), 2.0 * (x * z + w * y)
    out[1, 0], out[1, 1], out[1, 2] = 2.0 * (x * y + w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - w * x)
    out[2, 0], out[2, 1], out[2, 2] = 2.0 * (x * z - w * y), 2.0 * (y * z + w * x), 1.0 - 2.0 * (x * x + y * y)


GAIN_UNITS: dict[str, str] = {
    "roll_p": "1/s",
    "pitch_p": "1/s",
    "yaw_p": "1/s",
    "roll_rate_p": "N m s/rad",
    "pitch_rate_p": "N m s/rad",
    "yaw_rate_p": "N m s/rad",
    "roll_rate_i": "N m/rad",
    "pitch_rate_i": "N m/rad",
    "yaw_rate_i": "N m/rad",
    "yaw_rate_limit": "rad/s",
    "roll_pitch_rate_limit": "rad/s",
    "yaw_torque_limit": "N m",
    "thrust_coefficient": "N s^2/rad^2",
    "drag_coefficient": "N m s^2/rad^2",
    "min_speed": "rad/s",
    "max_speed": "rad/s",
}
"""Gains in vector order with units.  The last four are what the mixer believes about the rotors."""
GAIN_NAMES = tuple(GAIN_UNITS)
(
    ROLL_P, PITCH_P, YAW_P, ROLL_RATE_P, PITCH_RATE_P, YAW_RATE_P, ROLL_RATE_I, PITCH_RATE_I, YAW_RATE_I,
    YAW_LIMIT, TILT_LIMIT, YAW_TORQUE, THRUST_COEFFICIENT, DRAG_COEFFICIENT, MIN_SPEED, MAX_SPEED,
) = range(len(GAIN_NAMES))  # fmt: skip


def pack_gains(gains: Mapping[str, float]) -> FloatArray:
    """Orders gains as the kernel wants them, shape (16,); raises ParameterError for unknown or missing names."""
    for name in gains:
        if name not in GAIN_UNITS:
            raise ParameterError(f"unknown stabiliser gain '{name}'", fix=nearest(name, GAIN_NAMES))
    missing = [name for name in GAIN_NAMES if name not in gains]
    if missing:
        raise ParameterError(f"stabiliser gains lack {', '.join(missing)}", ", ".join(GAIN_NAMES))
    return np.array([float(gains[name]) for name in GAIN_NAMES])


@kept()
def rotation_of(roll: float, pitch: float, yaw: float, out: FloatArray) -> None:
    """Writes the rotation matrix (body to world, 3-2-1 Euler angles [rad]) into `out`, shape (3, 3)."""
    sr, cr = np.sin(roll), np.cos(roll)
    sp, cp = np.sin(pitch), np.cos(pitch)
    sy, cy = np.sin(yaw), np.cos(yaw)
    out[0, 0], out[0, 1], out[0, 2] = cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr
    out[1, 0], out[1, 1], out[1, 2] = sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr
    out[2, 0], out[2, 1], out[2, 2] = -sp, cp * sr, cp * cr


@kept()
def steer(
    gains: FloatArray,
    mixer: FloatArray,
    wanted: FloatArray,
    throttle: float,
    attitude: FloatArray,
    rate: FloatArray,
    dt: float,
    integral: FloatArray,
    torque: FloatArray,
    command: FloatArray,
) -> None:
    """One step of the stabiliser towards a wanted rotation matrix, in place; spares the caller's inner loop memory.

    Args:
        gains: `pack_gains`.
        mixer: `quadid.vehicle.mixer_matrix`.
        wanted: rotation matrix, body to world, shape (3, 3).
        throttle: 0..1 (fraction of the thrust at `max_speed`).
        attitude: measured rotation matrix, body to world, shape (3, 3).
        rate: measured body rates [rad/s].
        dt: time since the last step [s].
        integral: integral torques [N m], shape (3,); updated.
        torque: torques [N m], shape (3,); written.
        command: rotor speeds [rad/s], shape (n,); written.
    """
    rotors = mixer.shape[0]
    ceiling = gains[MAX_SPEED] * gains[MAX_SPEED]
    floor = gains[MIN_SPEED] * gains[MIN_SPEED]
    thrust = throttle * ceiling * gains[THRUST_COEFFICIENT] * rotors
    for axis in range(3):
        # rotation error in body axes: half the vee of R'Rd - Rd'R
        i, j = (axis + 1) % 3, (axis + 2) % 3
        error = 0.0
        for k in range(3):
            error += 0.5 * (attitude[k, j] * wanted[k, i] - attitude[k, i] * wanted[k, j])
        limit = gains[YAW_LIMIT] if axis == 2 else gains[TILT_LIMIT]
        wish = min(max(gains[ROLL_P + axis] * error, -limit), limit)
        miss = wish - rate[axis]
        # against wind-up: enough for any trim, such as a weak rotor or a CG off centre
        bound = gains[YAW_TORQUE] if axis == 2 else 4.0 * gains[ROLL_RATE_P + axis]
        integral[axis] = min(max(integral[axis] + gains[ROLL_RATE_I + axis] * miss * dt, -bound), bound)
        torque[axis] = gains[ROLL_RATE_P + axis] * miss + integral[axis]
    torque[2] = min(max(torque[2], -gains[YAW_TORQUE]), gains[YAW_TORQUE])
    for i in range(rotors):
        square = mixer[i, 0] * thrust + mixer[i, 1] * torque[0] + mixer[i, 2] * torque[1] + mixer[i, 3] * torque[2]
        command[i] = np.sqrt(min(max(square, floor), ceiling))


@kept()
def stabilise(
    gains: FloatArray,
    mixer: FloatArray,
    reference: FloatArray,
    attitude: FloatArray,
    rate: FloatArray,
    dt: float,
    integral: FloatArray,
    command: FloatArray,
) -> None:
    """One step of the stabiliser, in place.

    Args:
        gains: `pack_gains`.
        mixer: `quadid.vehicle.mixer_matrix`.
        reference: roll, pitch, yaw [rad], throttle 0..1 (fraction of the thrust at `max_speed`).
        attitude: measured rotation matrix, body to world, shape (3, 3).
        rate: measured body rates [rad/s].
        dt: time since the last step [s].
        integral: integral torques [N m], shape (3,); updated.
        command: rotor speeds [rad/s], shape (n,); written.
    """
    wanted, torque = np.empty((3, 3)), np.empty(3)
    rotation_of(reference[0], reference[1], reference[2], wanted)
    steer(gains, mixer, wanted, reference[3], attitude, rate, dt, integral, torque, command)


@kept()
def stabilise_rows(
    gains: FloatArray,
    mixer: FloatArray,
    reference: FloatArray,
    attitude: FloatArray,
    rate: FloatArray,
    dt: FloatArray,
    integral: FloatArray,
    command: FloatArray,
) -> None:
    """Many steps in place: of one vehicle in a row, or one step of each of many vehicles.

    Args:
        gains: `pack_gains`.
        mixer: `quadid.vehicle.mixer_matrix`.
        reference: roll, pitch, yaw [rad], throttle 0..1, shape (n, 4).
        attitude: measured unit quaternions, body to world, scalar first, shape (n, 4).
        rate: measured body rates [rad/s], shape (n, 3).
        dt: time that each step acts for [s], shape (n,).
        integral: integral torques [N m], shape (1, 3) of one vehicle, (n, 3) of many; updated.
        command: rotor speeds [rad/s], shape (n, rotors); written.
    """
    matrix = np.empty((3, 3))
    for k in range(reference.shape[0]):
        write_rotation(attitude[k, 0], attitude[k, 1], attitude[k, 2], attitude[k, 3], matrix)
        own = integral[k % integral.shape[0]]
        stabilise(gains, mixer, reference[k], matrix, rate[k], dt[k], own, command[k])
