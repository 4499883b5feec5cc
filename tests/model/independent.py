"""The model written a second time, for tests: the paper's Eqs. 1-10 in Euler angles, and every effect of the contract.

Vectors and cross products, integrated by SciPy's DOP853 between the jumps of its input; shares nothing with the kernel.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.integrate import OdeSolution, solve_ivp
from scipy.spatial.transform import Rotation

from quadid.data.window import Sampling, Window
from quadid.types import FloatArray, IntArray
from quadid.vehicle import Vehicle

G = 9.80665
DOWN = np.array([0.0, 0.0, 1.0])
EULER, RATE, VELOCITY, POSITION, FORCE = (slice(i, i + 3) for i in (0, 3, 6, 9, 12))
ROTORS = 15


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross product of two vectors; quicker than NumPy's for single ones."""
    return np.array([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def body_to_world(euler: FloatArray) -> FloatArray:
    """Rotation matrix of roll, pitch, yaw: R_z(psi) R_y(theta) R_x(phi)."""
    (a, b, c), (d, e, f) = np.cos(euler), np.sin(euler)
    roll = np.array([[1.0, 0.0, 0.0], [0.0, a, -d], [0.0, d, a]])
    pitch = np.array([[b, 0.0, e], [0.0, 1.0, 0.0], [-e, 0.0, b]])
    yaw = np.array([[c, -f, 0.0], [f, c, 0.0], [0.0, 0.0, 1.0]])
    return np.asarray(yaw @ pitch @ roll)


def quaternion(euler: FloatArray) -> FloatArray:
    """Unit quaternions wxyz of roll, pitch, yaw, shapes (n, 3) -> (n, 4)."""
    return np.asarray(Rotation.from_euler("ZYX", euler[:, ::-1]).as_quat()[:, [3, 0, 1, 2]])


@dataclass(frozen=True)
class Input:
    """Rotor columns (n, rotors) [rad/s] on a grid, and how to read between its rows."""

    rows: FloatArray
    dt: float
    t0: float = 0.0
    sampling: Sampling = "held"

    @property
    def t(self) -> FloatArray:
        """Times of the rows [s]."""
        return np.asarray(self.t0 + self.dt * np.arange(len(self.rows)), dtype=np.float64)

    def at(self, t: float, just_before: bool = False) -> FloatArray:
        """Input at time t; end values hold outside."""
        place = (t - self.t0) / self.dt
        if self.sampling == "held":
            row = int(np.ceil(place - 1e-6)) - 1 if just_before else int(np.floor(place + 1e-6))
            return np.asarray(self.rows[min(max(row, 0), len(self.rows) - 1)])
        return np.array([float(np.interp(place, np.arange(len(self.rows)), column)) for column in self.rows.T])


class Flown:
    """A flight: state as a function of time, and what perfect sensors would log."""

    def __init__(self, given: Input, times: list[float], pieces: list[OdeSolution]) -> None:
        self.given, self._times, self._pieces = given, np.array(times), pieces

    def at(self, t: FloatArray) -> FloatArray:
        """States at times t, shape (len(t), states)."""
        which = np.clip(np.searchsorted(self._times, t, side="right") - 1, 0, len(self._pieces) - 1)
        return np.array([self._pieces[i](x) for i, x in zip(which, t, strict=True)])

    def mean_force(self, t: FloatArray, over: float) -> FloatArray:
        """Specific force at the IMU, body axes, mean over `over` seconds centred on t."""
        return np.asarray(self.at(t + 0.5 * over)[:, FORCE] - self.at(t - 0.5 * over)[:, FORCE]) / over

    def states(self, rows: IntArray) -> FloatArray:
        """Initial states of the rollout at rows: quaternion, rate, velocity, position, shape (len(rows), 13)."""
        y = self.at(self.given.t[rows])
        return np.column_stack([quaternion(y[:, EULER]), y[:, RATE], y[:, VELOCITY], y[:, POSITION]])

    def window(self, **channels: FloatArray | None) -> Window:
        """Log of perfect sensors at the rows but the first and the last, which have no whole sample around them."""
        t = self.given.t
        y = self.at(t)
        accel = np.full((len(t), 3), np.nan)
        accel[1:-1] = self.mean_force(t[1:-1], self.given.dt)
        logged: dict[str, Any] = {
            "gyro": y[:, RATE],
            "attitude": quaternion(y[:, EULER]),
            "accel": accel,
            "velocity": y[:, VELOCITY],
            "position": y[:, POSITION],
        }
        logged.update(channels)
        return Window(self.given.t0, self.given.dt, self.given.rows, sampling=self.given.sampling, **logged)


class Independent:
    """The model of one vehicle with given parameters, keyed by dotted names; missing ones are neutral."""

    def __init__(self, vehicle: Vehicle, values: Mapping[str, float]) -> None:
        self.vehicle, self.values = vehicle, values
        self.m, self.n = vehicle.mass, len(vehicle.rotors)
        self.b, self.d = self["b"], self["d"]
        self.J = np.diag([self["J_xx"], self["J_yy"], self["J_zz"]])
        for (i, j), name in {(0, 1): "J_xy", (0, 2): "J_xz", (1, 2): "J_yz"}.items():
            self.J[i, j] = self.J[j, i] = -self[f"product_of_inertia.{name}"]
        self.cg = np.array([self["cg_offset.x"], self["cg_offset.y"], 0.0])
        self.arms, self.spins = vehicle.rotor_positions - self.cg, vehicle.spins
        self.gains = np.array([1.0 - self[f"weak_rotor.loss_{i + 1}"] for i in range(self.n)])
        self.torque_gains = self.gains - [self[f"weak_rotor.extra_{i + 1}"] for i in range(self.n)]
        self.imu = np.array([self[f"imu_lever_arm.{a}"] for a in "xyz"]) - self.cg
        each = self.m * G / self.n - self["thrust_curve.offset"]
        self.hover = np.sqrt(each / self.b) + self["thrust_curve.dead_speed"]
        self.tau, self.down = self["motor_lag.tau"], self["motor_lag.tau"] + self["motor_lag.slower"]
        self.delay = self["command_delay.delay"] - self["rotor_telemetry_delay.delay"]
        gaps = [
            float(np.linalg.norm(np.subtract(p.position, q.position))) for p in vehicle.rotors for q in vehicle.rotors
        ]
        self.radius = self["ground_effect.radius_scale"] * 0.5 * min(g for g in gaps if g > 0.0)

    def __getitem__(self, name: str) -> float:
        return self.values.get(name, 0.0)

    def wrench(
        self,
        t: float,
        omega: FloatArray,
        turning: FloatArray,
        v_air: FloatArray,
        nu: FloatArray,
        height: float,
        span: tuple[float, float],
    ) -> tuple[FloatArray, FloatArray]:
        """Force and torque about the CG, body axes; v_air: velocity relative to the air, body axes."""
        power = 1.0 - self["battery_sag.fraction"] * (t - span[0]) / (span[1] - span[0])
        if t > self.values.get("thrust_drop.time", np.inf):
            power *= 1.0 - self["thrust_drop.fraction"]
        ratio = self.radius / (4.0 * max(height, 0.5 * abs(self.radius), 1e-9))
        near_ground = 1.0 / (1.0 - ratio * abs(ratio))  # Cheeseman and Bennett 1955
        thrust = power * near_ground * self.b * self.gains * (omega - self["thrust_curve.dead_speed"]) ** 2  # Eq. 3
        thrust += power * near_ground * self.gains * self["thrust_curve.offset"]
        force = -thrust.sum() * DOWN  # Eq. 5
        cg = self.cg + self.loaded(t) * np.array([self["mass_change.x"], self["mass_change.y"], 0.0])
        arms = self.arms + self.cg - cg
        torque = cross(thrust @ arms, -DOWN)  # Eq. 6: sum of arm x (0, 0, -thrust)
        grown = 1.0 + self["drag_torque_curve.growth"] * (omega / self.hover - 1.0)
        torque += power * self.d * (self.spins @ (self.torque_gains * grown * omega**2)) * DOWN  # Eqs. 4 and 6
        torque += cross(nu, self["J_r"] * (self.spins @ omega) * DOWN)  # Eq. 7
        torque += self["rotor_spin_up.J"] * (self.spins @ turning) * DOWN
        drag, inflow = np.array([self["rotor_drag.k_x"], self["rotor_drag.k_y"], 0.0]), self["axial_inflow.k_z"] * DOWN
        higher = np.array([self["rotor_drag_moment.h_y"], -self["rotor_drag_moment.h_x"], 0.0])
        for arm, speed in zip(arms, omega, strict=True):
            wind = v_air + cross(nu, arm)
            lift = -self.m / self.n * self["translational_lift.k"] * float(wind[:2] @ wind[:2]) * DOWN
            force = force + lift
            torque += cross(arm, lift)
            for k, effect in ((drag, "rotor_drag"), (inflow, "axial_inflow")):
                nearer = arm * (1.0 - self[f"{effect}.central"])
                hub = -self.m / self.n * k * (v_air + cross(nu, nearer)) * speed / self.hover
                if effect == "axial_inflow":
                    square = self.climb_square(v_air, nu, nearer, arms)
                    hub = hub + self.m / self.n * self["axial_inflow.k_climb"] * square
                force = force + hub
                torque += cross(nearer, hub) + higher * hub[[1, 0, 2]]
        c = self["parasitic_drag.c"]
        drag = np.array([c, c, c + self["parasitic_drag.beside_z"]]) * np.linalg.norm(v_air) * v_air
        return force - self.m * drag, torque

    def climb_square(self, v_air: FloatArray, nu: FloatArray, arm: FloatArray, arms: FloatArray) -> FloatArray:
        """Squared climb speed of a hub along z, as its tangent at the climb speed of the middle of all hubs."""
        middle = arms.mean(axis=0) * (1.0 - self["axial_inflow.central"])
        climbs = max(-(v_air + cross(nu, middle))[2], 0.0)
        return np.asarray((climbs**2 + 2.0 * climbs * -cross(nu, arm - middle)[2]) * DOWN)

    def loaded(self, t: float) -> bool:
        """Checks whether the payload has been taken up at time t."""
        return bool(t > self.values.get("mass_change.time", np.inf))

    def rhs(
        self, t: float, y: FloatArray, u: FloatArray, slope: FloatArray, t_u: float, span: tuple[float, float]
    ) -> FloatArray:
        """Eqs. 1, 8 and 9, and omega' = (u - omega) / tau."""
        phi, theta, _ = y[EULER]
        nu = y[RATE]
        goal = u + slope * (t - t_u)
        lag = np.where(goal >= y[ROTORS:], self.tau, self.down)
        omega, turning = (y[ROTORS:], (goal - y[ROTORS:]) / lag) if self.tau > 0.0 else (goal, slope)
        R = body_to_world(y[EULER])
        wind = np.array([self["wind.north"], self["wind.east"], 0.0])
        force, torque = self.wrench(t, omega, turning, R.T @ (y[VELOCITY] - wind), nu, -y[POSITION][2], span)
        mass = self.m * (1.0 + self["mass_change.fraction"] * self.loaded(t))
        J = self.J + self.loaded(t) * np.diag([self[f"mass_change.J_{a}"] * self[f"J_{a}"] for a in ("xx", "yy", "zz")])
        turned = (1.0 - self["no_gyroscopic_coupling.share"]) * cross(nu, J @ nu)
        nu_dot = np.linalg.solve(J, torque - turned)
        nu_dot -= np.array([self[f"rate_damping.{a}"] for a in ("l_p", "m_q", "n_r")]) * nu
        euler_dot = np.array(
            [
                nu[0] + np.tan(theta) * (np.sin(phi) * nu[1] + np.cos(phi) * nu[2]),
                np.cos(phi) * nu[1] - np.sin(phi) * nu[2],
                (np.sin(phi) * nu[1] + np.cos(phi) * nu[2]) / np.cos(theta),
            ]
        )
        felt = force / mass
        imu = self.imu - self.loaded(t) * np.array([self["mass_change.x"], self["mass_change.y"], 0.0])
        at_imu = felt + cross(np.asarray(nu_dot), imu) + cross(nu, cross(nu, imu))
        rotors = turning if self.tau > 0.0 else np.zeros(self.n)
        return np.concatenate([euler_dot, nu_dot, R @ felt + G * DOWN, y[VELOCITY], at_imu, rotors])

    def fly(
        self,
        given: Input,
        euler: FloatArray,
        nu: FloatArray,
        velocity: FloatArray,
        position: FloatArray,
        span: tuple[float, float] | None = None,
        tolerance: float = 1e-10,
    ) -> Flown:
        """Integrates from the first row to the last; rotors start at the first row's input."""
        t, dt = given.t, given.dt
        span = span or (float(t[0]), float(t[-1]))
        jumps = [t, t[:-1] + (self.delay % dt)]
        jumps += [np.array([self.values[k]]) for k in ("thrust_drop.time", "mass_change.time") if k in self.values]
        times = np.unique(np.round(np.concatenate(jumps), 12))
        times = times[(times >= t[0]) & (times <= t[-1])]
        y = np.concatenate([euler, nu, velocity, position, np.zeros(3), given.rows[0]])
        pieces: list[Any] = []
        for start, end in zip(times[:-1], times[1:], strict=True):
            u, later = given.at(start - self.delay), given.at(end - self.delay, just_before=True)
            slope = (later - u) / (end - start)
            solved = solve_ivp(
                self.rhs,
                (start, end),
                y,
                "DOP853",
                dense_output=True,
                rtol=tolerance,
                atol=tolerance,
                args=(u, slope, start, span),
            )
            pieces.append(solved.sol)
            y = solved.y[:, -1]
        return Flown(given, list(times), pieces)
