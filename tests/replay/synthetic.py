"""A made-up flight that obeys rigid-body kinematics exactly, sampled at any rate, for tests of readers and grids."""

from dataclasses import dataclass

import numpy as np
from quadid_replay.columns import from_euler

from quadid.data.window import Channel, Recording
from quadid.rotation import continuous_sign
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

PELICAN = Vehicle.shipped("pelican")


def with_command(vehicle: Vehicle, **command: object) -> Vehicle:
    """The same vehicle with another meaning of its rotor columns."""
    data = vehicle.model_dump()
    data["command"] = {**data["command"], **command}
    return Vehicle.model_validate(data)


@dataclass(frozen=True)
class Flight:
    """Euler angles as sums of sines; everything else follows from them.

    Attributes:
        vehicle: its geometry turns torque into rotor speeds.
        amplitude: of the angles [rad].
    """

    vehicle: Vehicle = PELICAN
    amplitude: float = 0.25

    def angles(self, t: FloatArray) -> FloatArray:
        """Roll, pitch, yaw [rad], shape (n, 3)."""
        tones = ((0.7, 1.9), (0.9, 1.6), (0.3, 0.8))
        return np.column_stack(
            [self.amplitude * (np.sin(2 * np.pi * a * t) + 0.5 * np.sin(2 * np.pi * b * t + 1.0)) for a, b in tones]
        )

    def attitude(self, t: FloatArray) -> FloatArray:
        """Quaternions body to world, shape (n, 4)."""
        return continuous_sign(from_euler(self.angles(t)))

    def gyro(self, t: FloatArray) -> FloatArray:
        """Body rates [rad/s], shape (n, 3), by the kinematic equations."""
        h = 1e-4
        roll, pitch, _ = self.angles(t).T
        rates = (self.angles(t + h) - self.angles(t - h)) / (2 * h)
        d_roll, d_pitch, d_yaw = rates.T
        return np.column_stack(
            [
                d_roll - np.sin(pitch) * d_yaw,
                np.cos(roll) * d_pitch + np.sin(roll) * np.cos(pitch) * d_yaw,
                -np.sin(roll) * d_pitch + np.cos(roll) * np.cos(pitch) * d_yaw,
            ]
        )

    def thrust(self, t: FloatArray) -> FloatArray:
        """Specific thrust [m/s^2], shape (n,)."""
        return GRAVITY * (1.05 + 0.1 * np.sin(2 * np.pi * 0.4 * t))

    def accel(self, t: FloatArray) -> FloatArray:
        """Specific force [m/s^2], body FRD, shape (n, 3)."""
        return np.column_stack([0 * t, 0 * t, -self.thrust(t)])

    def velocity(self, t: FloatArray) -> FloatArray:
        """World NED velocity [m/s], shape (n, 3), integrated on a fine grid."""
        fine = np.linspace(min(t[0], 0.0), max(t[-1], 1.0), 20 * len(t) + 2001)
        w, x, y, z = self.attitude(fine).T
        down = np.column_stack([2 * (x * z + w * y), 2 * (y * z - w * x), 1 - 2 * (x * x + y * y)])
        force = down * -self.thrust(fine)[:, None] + np.array([0.0, 0.0, GRAVITY])
        area = np.cumsum(0.5 * (force[1:] + force[:-1]) * np.diff(fine)[:, None], axis=0)
        total = np.concatenate([np.zeros((1, 3)), area])
        return np.column_stack([np.interp(t, fine, c) for c in total.T])

    def rotor_speed(self, t: FloatArray) -> FloatArray:
        """Rotor speeds [rad/s] that give these moments and this thrust, shape (n, rotors)."""
        h = 1e-4
        spin_up = (self.gyro(t + h) - self.gyro(t - h)) / (2 * h)
        b, d, *inertia = self.vehicle.initial[:5]
        place = self.vehicle.rotor_positions
        mix = np.vstack([np.ones(len(place)), -place[:, 1], place[:, 0], self.vehicle.spins * d / b]) * b
        wanted = np.column_stack([self.vehicle.mass * self.thrust(t), spin_up * np.array(inertia)])
        return np.asarray(np.sqrt(np.maximum(wanted @ np.linalg.pinv(mix).T, 100.0)))

    def recording(
        self, seconds: float = 20.0, rate: float = 50.0, name: str = "made-up", kind: str = "csv", start: float = 0.0
    ) -> Recording:
        """All channels at one rate on the same instants."""
        t = start + np.arange(round(seconds * rate)) / rate
        return self.at(dict.fromkeys(("gyro", "accel", "attitude", "velocity", "rotor_speed"), t), name, kind)

    def at(self, times: dict[str, FloatArray], name: str = "made-up", kind: str = "mcap") -> Recording:
        """Each channel at its own times."""
        channels = {n: Channel(n, t, getattr(self, n)(t), "made-up") for n, t in times.items()}
        return Recording(name, kind, channels)


def full_recording(seconds: float = 4.0, rate: float = 100.0) -> Recording:
    """A recording that holds every channel."""
    flight = Flight()
    base = flight.recording(seconds, rate)
    t = base.channels["gyro"].t
    slow = t[::4]
    extra = {
        "position": (t, np.column_stack([np.sin(t), np.cos(t), -1.0 - 0.1 * t])),
        "motor_command": (t, 0.2 + 0.5 * flight.rotor_speed(t) / 800.0),
        "attitude_reference": (slow, np.column_stack([flight.angles(slow), 0.5 + 0.1 * np.sin(slow)])),
        "battery": (t[::25], (16.0 - 0.05 * t[::25])[:, None]),
    }
    channels = dict(base.channels) | {n: Channel(n, a, v, "made-up") for n, (a, v) in extra.items()}
    return Recording("full", "csv", channels)
