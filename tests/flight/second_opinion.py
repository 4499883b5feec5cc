"""The equations of motion written a second time, for tests: vectors and quaternions, integrated by SciPy's DOP853.

Shares nothing with `quadid.flight` but the contract's wording of each effect.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
from numpy.typing import NDArray
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadid.flight import Flight, propeller_radius

FloatArray = NDArray[np.float64]
G = 9.80665
DOWN = np.array([0.0, 0.0, 1.0])


class SecondOpinion:
    """Flies a noise-free flight's logged commands again.

    State: position, velocity (world), quaternion xyzw, body rates, rotor speeds, integral of the specific force at the
    IMU (body axes).
    """

    def __init__(self, flight: Flight) -> None:
        self.flight = flight
        self.truth = flight.truth.parameters
        self.rotors = flight.vehicle.rotors
        self.n = len(self.rotors)
        self.effects: Mapping[str, Mapping[str, float]] = flight.truth.effects
        self.omega_h = np.sqrt(self.truth.mass * G / (self.n * self.truth.b))
        self.tau = self.get("motor_lag", "tau")
        self.delay = self.get("command_delay", "delay")
        self.last = float(flight.window.t[-1])

    def get(self, effect: str, name: str, neutral: float = 0.0) -> float:
        """Value of an effect, neutral where it is absent."""
        return self.effects.get(effect, {}).get(name, neutral)

    def vector(self, effect: str, names: str) -> FloatArray:
        """Several values of an effect."""
        return np.array([self.get(effect, name) for name in names.split()])

    def inertia(self, t: float) -> FloatArray:
        """Inertia tensor [kg m^2]; off-diagonal entries are the negative products."""
        j_xy, j_xz, j_yz = self.vector("product_of_inertia", "J_xy J_xz J_yz")
        p = self.truth
        return np.array([[p.J_xx, -j_xy, -j_xz], [-j_xy, p.J_yy, -j_yz], [-j_xz, -j_yz, p.J_zz]])

    def command(self, t: float) -> FloatArray:
        """Held command that acts at time t."""
        row = int(np.floor((t - self.delay) / self.flight.window.dt + 1e-9))
        return np.asarray(self.flight.window.rotor_speed[row])

    def wrench(self, t: float, omega: FloatArray, omega_dot: FloatArray, v_body: FloatArray, nu: FloatArray,
               height: float) -> tuple[FloatArray, FloatArray]:  # fmt: skip
        """Force and torque about the CG, body axes."""
        p = self.truth
        power = 1.0
        if t >= self.get("thrust_drop", "time", np.inf):
            power -= self.get("thrust_drop", "fraction")
        power *= 1.0 - self.get("battery_sag", "fraction") * np.clip(t / self.last, 0.0, 1.0)
        cg = np.array([self.get("cg_offset", "x"), self.get("cg_offset", "y"), 0.0])
        ground = self.get("ground_effect", "radius_scale") * propeller_radius(self.flight.vehicle)
        lift = 1.0 / (1.0 - (ground / (4.0 * height)) ** 2)
        force, torque = np.zeros(3), np.zeros(3)
        spin_sum = spin_dot = 0.0
        for i, rotor in enumerate(self.rotors):
            share = 1.0 - self.get("weak_rotor", "loss") * (self.get("weak_rotor", "rotor") == i + 1)
            thrust = power * share * lift * p.b * max(omega[i] - self.get("thrust_curve", "dead_speed"), 0.0) ** 2
            pull = np.array([0.0, 0.0, -thrust])
            force += pull
            torque += np.cross(np.array(rotor.position) - cg, pull)
            torque += rotor.spin * power * share * p.d * omega[i] ** 2 * DOWN
            spin_sum += rotor.spin * omega[i]
            spin_dot += rotor.spin * omega_dot[i]
        torque += p.J_r * spin_sum * np.cross(nu, DOWN)
        torque += self.get("rotor_spin_up", "J") * spin_dot * DOWN
        activity = omega.sum() / (self.n * self.omega_h)
        k = np.array([self.get("rotor_drag", "k_x"), self.get("rotor_drag", "k_y"), 0.0])
        in_plane = -p.mass * k * v_body * activity
        h_x, h_y = self.vector("rotor_drag_moment", "h_x h_y")
        torque += np.array([h_y * in_plane[1], -h_x * in_plane[0], 0.0])
        climb = -v_body[2]
        lost = p.mass * self.get("axial_inflow", "k_z") * climb * activity * DOWN
        torque += np.cross(-cg, lost)
        drag = -p.mass * self.get("parasitic_drag", "c") * np.linalg.norm(v_body) * v_body
        return force + in_plane + lost + drag, torque

    def rhs(self, t: float, s: FloatArray, now: float) -> FloatArray:
        """Time derivative; `now` picks the command, which does not change inside one integration."""
        velocity, nu, omega = s[3:6], s[10:13], s[13 : 13 + self.n]
        attitude = Rotation.from_quat(s[6:10])
        goal = self.command(now)
        omega_dot = (goal - omega) / self.tau if self.tau > 0.0 else np.zeros(self.n)
        wind = np.array([self.get("wind", "north"), self.get("wind", "east"), 0.0])
        v_body = attitude.inv().apply(velocity - wind)
        force, torque = self.wrench(t, omega, omega_dot, v_body, nu, -s[2])
        mass = self.truth.mass
        if t >= self.get("mass_change", "time", np.inf):
            mass *= 1.0 + self.get("mass_change", "fraction")
        inertia = self.inertia(t)
        nu_dot = np.linalg.solve(inertia, torque - np.cross(nu, inertia @ nu))
        nu_dot -= np.array([self.get("rate_damping", "l_p") * nu[0], self.get("rate_damping", "m_q") * nu[1], 0.0])
        w, v = s[9], s[6:9]
        q_dot = np.append(0.5 * (w * nu + np.cross(v, nu)), -0.5 * v @ nu)
        cg = np.array([self.get("cg_offset", "x"), self.get("cg_offset", "y"), 0.0])
        arm = self.vector("imu_lever_arm", "x y z") - cg
        at_imu = force / mass + np.cross(nu_dot, arm) + np.cross(nu, np.cross(nu, arm))
        acceleration = attitude.apply(force / mass) + G * DOWN
        return np.concatenate([velocity, acceleration, q_dot, nu_dot, omega_dot, at_imu])

    def start(self, row: int) -> FloatArray:
        """State of the flown truth at a log row."""
        t = self.flight.truth
        q = t.quaternion[row]
        return np.concatenate(
            [t.position[row], t.velocity[row], q[1:], q[:1], t.rates[row], t.rotor_speed[row], np.zeros(3)]
        )

    def breaks(self, begin: float, end: float) -> list[float]:
        """Times at which something jumps, with both ends."""
        dt = self.flight.window.dt
        rows = np.arange(np.floor((begin - self.delay) / dt), np.ceil((end - self.delay) / dt) + 1)
        times = [
            *(rows * dt + self.delay),
            self.get("mass_change", "time", -1.0),
            self.get("thrust_drop", "time", -1.0),
        ]
        return [begin, *sorted(t for t in times if begin + 1e-9 < t < end - 1e-9), end]

    def fly(self, state: FloatArray, begin: float, end: float) -> FloatArray:
        """Moves a state from `begin` to `end` [s], piece by piece between jumps."""
        times = self.breaks(begin, end)
        for a, b in zip(times[:-1], times[1:], strict=True):
            if self.tau == 0.0:
                state = self.jump(state, self.command(a))
            piece = solve_ivp(self.rhs, (a, b), state, args=(0.5 * (a + b),), method="DOP853", rtol=1e-10, atol=1e-11)
            state = piece.y[:, -1]
        return state

    def jump(self, state: FloatArray, goal: FloatArray) -> FloatArray:
        """Rotors without lag take their command at once; spinning them up kicks the vehicle in yaw."""
        state = state.copy()
        spins = np.array([r.spin for r in self.rotors])
        kick = self.get("rotor_spin_up", "J") * float(spins @ (goal - state[13 : 13 + self.n]))
        change = np.linalg.solve(self.inertia(0.0), kick * DOWN)
        state[10:13] += change
        cg = np.array([self.get("cg_offset", "x"), self.get("cg_offset", "y"), 0.0])
        state[13 + self.n :] += np.cross(change, self.vector("imu_lever_arm", "x y z") - cg)
        state[13 : 13 + self.n] = goal
        return state
