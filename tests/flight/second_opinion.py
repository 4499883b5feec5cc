"""The equations of motion written a second time, for tests: vectors and quaternions, integrated by SciPy's DOP853.

Shares nothing with `quadid.flight` but the contract's wording of each effect.
"""

from collections.abc import Mapping

import numpy as np
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from quadid.flight import Flight, propeller_radius
from quadid.types import FloatArray

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
        each = self.truth.mass * G / self.n - self.get("thrust_curve", "offset")
        self.omega_h = np.sqrt(each / self.truth.b) + self.get("thrust_curve", "dead_speed")
        self.tau = self.get("motor_lag", "tau")
        self.slower = self.get("motor_lag", "tau_down", self.tau)
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
        grown = 1.0 + self.loaded(t) * self.vector("mass_change", "J_xx J_yy J_zz")
        J_xx, J_yy, J_zz = grown * [p.J_xx, p.J_yy, p.J_zz]
        return np.array([[J_xx, -j_xy, -j_xz], [-j_xy, J_yy, -j_yz], [-j_xz, -j_yz, J_zz]])

    def loaded(self, t: float) -> bool:
        """Checks whether mass has been taken up by time t."""
        return bool(t >= self.get("mass_change", "time", np.inf))

    def cg(self, t: float) -> FloatArray:
        """Centre of gravity from the geometric centre [m]."""
        shift = self.loaded(t) * self.vector("mass_change", "x y")
        return np.append(self.vector("cg_offset", "x y") + shift, 0.0)

    def command(self, t: float) -> FloatArray:
        """Held command that acts at time t."""
        row = int(np.floor((t - self.delay) / self.flight.window.dt + 1e-9))
        return np.asarray(self.flight.window.rotor_speed[row])

    def wrench(
        self, t: float, omega: FloatArray, omega_dot: FloatArray, v_body: FloatArray, nu: FloatArray, height: float
    ) -> tuple[FloatArray, FloatArray]:
        """Force and torque about the CG, body axes."""
        p = self.truth
        power = 1.0
        if t >= self.get("thrust_drop", "time", np.inf):
            power -= self.get("thrust_drop", "fraction")
        power *= 1.0 - self.get("battery_sag", "fraction") * np.clip(t / self.last, 0.0, 1.0)
        cg = self.cg(t)
        ground = self.get("ground_effect", "radius_scale") * propeller_radius(self.flight.vehicle)
        lift = 1.0 / (1.0 - (ground / (4.0 * height)) ** 2)
        force, torque = np.zeros(3), np.zeros(3)
        k = np.array([self.get("rotor_drag", "k_x"), self.get("rotor_drag", "k_y"), self.get("axial_inflow", "k_z")])
        h_x, h_y = self.vector("rotor_drag_moment", "h_x h_y")
        spin_sum = spin_dot = 0.0
        for i, rotor in enumerate(self.rotors):
            weak, loss = self.get("weak_rotor", "rotor") == i + 1, self.get("weak_rotor", "loss")
            lifting = p.b * max(omega[i] - self.get("thrust_curve", "dead_speed"), 0.0) ** 2
            thrust = power * (1.0 - loss * weak) * lift * (lifting + self.get("thrust_curve", "offset"))
            arm = np.array(rotor.position) - cg
            pull = np.array([0.0, 0.0, -thrust])
            at_hub = v_body + np.cross(nu, arm)
            pull[2] -= p.mass / self.n * self.get("translational_lift", "k") * float(at_hub[:2] @ at_hub[:2])
            force += pull
            torque += np.cross(arm, pull)
            for effect, acts in {"rotor_drag": [1.0, 1.0, 0.0], "axial_inflow": [0.0, 0.0, 1.0]}.items():
                nearer = arm * (1.0 - self.get(effect, "central"))
                air = -p.mass / self.n * k * acts * (v_body + np.cross(nu, nearer)) * omega[i] / self.omega_h
                if effect == "axial_inflow":
                    climbs = max(0.0, -(v_body + np.cross(nu, nearer))[2])
                    air[2] += p.mass / self.n * self.get(effect, "k_climb") * climbs**2
                force += air
                torque += np.cross(nearer, air) + [h_y * air[1], -h_x * air[0], 0.0]
            dragging = 1.0 - self.get("weak_rotor", "drag_loss", loss) * weak
            grown = 1.0 + self.get("drag_torque_curve", "growth") * (omega[i] / self.omega_h - 1.0)
            torque += rotor.spin * power * dragging * p.d * omega[i] ** 2 * grown * DOWN
            spin_sum += rotor.spin * omega[i]
            spin_dot += rotor.spin * omega_dot[i]
        torque += p.J_r * spin_sum * np.cross(nu, DOWN)
        torque += self.get("rotor_spin_up", "J") * spin_dot * DOWN
        c = self.get("parasitic_drag", "c")
        drag = -p.mass * np.linalg.norm(v_body) * v_body * [c, c, self.get("parasitic_drag", "c_z", c)]
        return force + drag, torque

    def rhs(self, t: float, s: FloatArray, now: float) -> FloatArray:
        """Time derivative; `now` picks the command, which does not change inside one integration."""
        velocity, nu, omega = s[3:6], s[10:13], s[13 : 13 + self.n]
        attitude = Rotation.from_quat(s[6:10])
        goal = self.command(now)
        lag = np.where(goal >= omega, self.tau, self.slower)
        omega_dot = (goal - omega) / lag if self.tau > 0.0 else np.zeros(self.n)
        wind = np.array([self.get("wind", "north"), self.get("wind", "east"), 0.0])
        v_body = attitude.inv().apply(velocity - wind)
        force, torque = self.wrench(t, omega, omega_dot, v_body, nu, -s[2])
        mass = self.truth.mass
        if self.loaded(now):
            mass *= 1.0 + self.get("mass_change", "fraction")
        inertia = self.inertia(now)
        coupling = 1.0 - self.get("no_gyroscopic_coupling", "share")
        nu_dot = np.linalg.solve(inertia, torque - coupling * np.cross(nu, inertia @ nu))
        nu_dot -= self.vector("rate_damping", "l_p m_q n_r") * nu
        w, v = s[9], s[6:9]
        q_dot = np.append(0.5 * (w * nu + np.cross(v, nu)), -0.5 * v @ nu)
        arm = self.vector("imu_lever_arm", "x y z") - self.cg(now)
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
