"""A flight of the identified vehicle: rotor speeds in, states out; a loop over `quadid.model.step`."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.errors import WindowError
from quadid.model.step import LEVEL, STILL, Simulator
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


@dataclass(frozen=True)
class Trajectory:
    """States after each step; world NED, body FRD.

    Attributes:
        t: times [s], shape (n,); the first is one step after the start.
        attitude: unit quaternions wxyz, body to world, shape (n, 4), scalar part not negative.
        rate: [rad/s], shape (n, 3).
        force: specific force as an accelerometer reads it [m/s^2], mean over the step that ends there, shape (n, 3).
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
        WindowError: a shape that does not fit the vehicle, or a step that is not positive.
    """
    rows = np.asarray(rotor_speed, dtype=np.float64)
    if rows.ndim != 2 or len(rows) < 1 or rows.shape[1] != len(vehicle.rotors):
        raise WindowError(f"rotor speeds of shape {rows.shape}", f"(n, {len(vehicle.rotors)})")
    simulator = Simulator(vehicle, theta, span=len(rows) * dt)
    state = simulator.start(
        attitude=attitude, rate=rate, velocity=velocity, position=position, rotor_speed=rows[0], dt=dt
    )
    y = simulator.run(state, rows, dt)[:, 0]
    reported = np.where(y[:, 13:14] < 0.0, -y[:, 13:17], y[:, 13:17])
    t = dt * np.arange(1, len(rows) + 1, dtype=np.float64)
    return Trajectory(t, reported, y[:, 17:20], y[:, 20:23], y[:, 7:10], y[:, 10:13])
