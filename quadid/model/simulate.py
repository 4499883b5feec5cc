"""The identified vehicle as a simulator for one's own use: rotor speeds in, states out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.errors import WindowError
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout
from quadid.model.segments import Segments
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Window

LEVEL = np.array([1.0, 0.0, 0.0, 0.0])
STILL = np.zeros(3)


@dataclass(frozen=True)
class Trajectory:
    """States after each step; world NED, body FRD.

    Attributes:
        t: times [s], shape (n,); the first is one step after the start.
        attitude: unit quaternions wxyz, body to world, shape (n, 4), scalar part not negative.
        rate: [rad/s], shape (n, 3).
        force: specific force as an accelerometer reads it [m/s^2], mean over one step, shape (n, 3).
        velocity: [m/s], shape (n, 3).
        position: [m], shape (n, 3).
    """

    t: FloatArray
    attitude: FloatArray
    rate: FloatArray
    force: FloatArray
    velocity: FloatArray
    position: FloatArray


def simulate(
    vehicle: Vehicle, rotor_speed: FloatArray, dt: float, *, attitude: FloatArray = LEVEL, rate: FloatArray = STILL,
    velocity: FloatArray = STILL, position: FloatArray = STILL, theta: FloatArray | None = None,
) -> Trajectory:  # fmt: skip
    """Simulates a vehicle file, effects included, from given rotor speeds.

    Args:
        vehicle: as read from a (fitted, extended) vehicle file.
        rotor_speed: shape (n, rotors) [rad/s]; row k acts from k dt to (k + 1) dt.
        dt: step [s]; the integrator is that of the fit, of fourth order, so 0.02 s is fine.
        attitude: at the start, quaternion wxyz, body to world, shape (4,).
        rate: at the start [rad/s], body, shape (3,).
        velocity: at the start [m/s], NED, shape (3,).
        position: at the start [m], NED, shape (3,).
        theta: full parameter vector instead of the vehicle file's values, shape (size,).

    Raises:
        WindowError: fewer than two rows, a shape that does not fit the vehicle, or a step that is not positive.
    """
    rows = np.asarray(rotor_speed, dtype=np.float64)
    if rows.ndim != 2 or len(rows) < 2 or rows.shape[1] != len(vehicle.rotors):
        raise WindowError(f"rotor speeds of shape {rows.shape}", f"(n >= 2, {len(vehicle.rotors)})")
    n = len(rows)
    # Two rows more than are asked for: where the first step starts and where the last one ends.
    padded = np.concatenate([rows, rows[-1:], rows[-1:]])
    zero, level = np.zeros((n + 2, 3)), np.tile(LEVEL, (n + 2, 1))
    # Against measurements of zero, and of the identity, residuals are states.
    window = Window(0.0, dt, padded, zero, level, zero, zero, zero, sampling="held")
    start = np.concatenate([np.asarray(attitude) / np.linalg.norm(attitude), rate, velocity, position])
    point = Layout(vehicle).initial(vehicle) if theta is None else theta
    out, _ = Rollout(window, vehicle).roll(Segments(n, 1, np.array([1])), point[None], start[None])
    y = out[0, 0, :, :, 0]
    half = 0.5 * y[:, 3:6]
    scalar = np.sqrt(np.maximum(1.0 - np.sum(half**2, axis=1), 0.0))
    t = dt * np.arange(1, n + 1, dtype=np.float64)
    return Trajectory(t, np.column_stack([scalar, half]), y[:, :3], y[:, 6:9], y[:, 9:12], y[:, 12:15])
