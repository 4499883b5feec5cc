"""Vehicles in the forms of other programs: facts about a vehicle, worked out once, and a template a form."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from markupsafe import Markup

from quadid.chi_square import Z95
from quadid.effects import EFFECTS, rotor_losses
from quadid.errors import ParameterError, nearest
from quadid.model.layout import ThrustModel
from quadid.parameters import FLOOR, NOMINAL_UNITS
from quadid.report.templating import render
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- What other programs want to know of a vehicle, worked out once: geometry about the CG, inertia, origins


TO_FLU = np.diag([1.0, -1.0, -1.0])
"""Turns body FRD into body FLU (its own inverse)."""
SHORTEST_LAG = 1e-3
"""Programs divide by the time constant of the motors [s]."""


class RotorFacts(NamedTuple):
    """One rotor.

    Attributes:
        frd, flu: from the CG [m], shape (3,).
        spin: its sign in Omega_r; `turn_flu` the sign of its torque on the vehicle about +z of FLU, -z of FRD.
        thrust: coefficient [N s^2/rad^2].
        full_thrust: at full command [N], where the full rotor speed is known.
    """

    frd: FloatArray
    flu: FloatArray
    spin: int
    turn_flu: int
    thrust: float
    full_thrust: float | None


@dataclass(frozen=True)
class Facts:
    """A vehicle as other programs describe it."""

    vehicle: Vehicle
    source: str
    tensor = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    """Entries of an inertia tensor as SDF and URDF call them."""

    def value(self, name: str) -> float:
        """Value of a nominal parameter, SI."""
        return self.vehicle.parameters[name].initial

    def effect(self, name: str, key: str) -> float:
        """Value of an effect's parameter; 0 where the vehicle has no such effect."""
        return float(self.vehicle.effects.get(name, {}).get(key, 0.0))

    def origin(self, name: str) -> str:
        """Says whether a nominal parameter came from data, or from whoever stated its uncertainty in the file."""
        prior = self.vehicle.parameters[name]
        if prior.sigma is None:
            return "not from data: as the vehicle file has it, without a sigma"
        return f"fitted, or given with its uncertainty: 95 % within {100.0 * Z95 * prior.sigma / prior.initial:.2g} %"

    def interval(self, name: str, scale: float = 1.0) -> tuple[float, float]:
        """95 % interval of a nominal parameter on the log scale, times `scale`; see `around` for what has no sigma."""
        prior = self.vehicle.parameters[name]
        return self.around(scale * prior.initial, FLOOR if prior.sigma is None else prior.sigma / prior.initial)

    def around(self, value: float, sigma: float = FLOOR) -> tuple[float, float]:
        """95 % interval of a positive number; as `ParameterSet.sample` draws it, never without width."""
        return value * math.exp(-Z95 * sigma), value * math.exp(Z95 * sigma)

    def assumed(self, name: str) -> str:
        """Remark for a reader of `interval`; empty where the vehicle file has a sigma."""
        return "" if self.vehicle.parameters[name].sigma is not None else f"not measured: {FLOOR:.0%} assumed"

    @cached_property
    def rotors(self) -> list[RotorFacts]:
        """Every rotor, in the order of the vehicle file."""
        full = [None] * len(self.arms) if self.full_thrust is None else self.full_thrust.tolist()
        return [
            RotorFacts(frd, TO_FLU @ frd, rotor.spin, -rotor.spin, float(thrust), most)
            for frd, rotor, thrust, most in zip(self.arms, self.vehicle.rotors, self.thrust, full, strict=True)
        ]

    @cached_property
    def arms(self) -> FloatArray:
        """Rotor positions from the CG, FRD [m], shape (rotors, 3)."""
        cg = np.array([self.effect("cg_offset", "x"), self.effect("cg_offset", "y"), 0.0])
        return np.asarray(self.vehicle.rotor_positions - cg)

    @cached_property
    def inertia(self) -> FloatArray:
        """Inertia tensor about the CG, FRD [kg m^2], shape (3, 3)."""
        out = np.diag([self.value("J_xx"), self.value("J_yy"), self.value("J_zz")])
        for (i, j), key in (((0, 1), "J_xy"), ((0, 2), "J_xz"), ((1, 2), "J_yz")):
            out[i, j] = out[j, i] = 0.0 - self.effect("product_of_inertia", key)
        return out

    @cached_property
    def thrust(self) -> FloatArray:
        """Thrust coefficient of every rotor [N s^2/rad^2], shape (rotors,)."""
        losses = rotor_losses(self.vehicle.effects.get("weak_rotor", {}), len(self.vehicle.rotors))
        return self.value("b") * (1.0 - np.array(losses))

    @property
    def torque_per_thrust(self) -> float:
        """Drag torque over thrust, d / b [m]."""
        return self.value("d") / self.value("b")

    @property
    def hover_speed(self) -> float:
        """Rotor speed in hover [rad/s]."""
        return self.vehicle.hover_speed()

    @property
    def hover_speeds(self) -> float:
        """Sum of all rotor speeds in hover [rad/s]."""
        return self.hover_speed * len(self.vehicle.rotors)

    @property
    def arms_flu(self) -> FloatArray:
        """Rotor positions from the CG, FLU [m], shape (rotors, 3)."""
        return np.asarray(self.arms @ TO_FLU)

    @property
    def inertia_flu(self) -> FloatArray:
        """Inertia tensor about the CG, FLU [kg m^2], shape (3, 3)."""
        return np.asarray(TO_FLU @ self.inertia @ TO_FLU)

    @property
    def lag(self) -> float:
        """Time constant of a rotor that speeds up [s], for programs that divide by it."""
        return max(self.effect("motor_lag", "tau"), SHORTEST_LAG)

    @property
    def lag_remark(self) -> str:
        """Remark for a reader of `lag`; empty where the vehicle file has one."""
        return (
            ""
            if "motor_lag" in self.vehicle.effects
            else ", not measured: a small value, for rotors that follow at once"
        )

    @property
    def lag_down(self) -> float:
        """Time constant of a rotor that slows down [s]."""
        down = self.effect("motor_lag", "tau_down")
        return max(down, SHORTEST_LAG) if down else self.lag

    @property
    def mean_drag(self) -> float:
        """Rotor drag, mean of forward and sideways [1/s]."""
        return 0.5 * (self.effect("rotor_drag", "k_x") + self.effect("rotor_drag", "k_y"))

    @property
    def fastest(self) -> tuple[float, str]:
        """Rotor speed at full command [rad/s], for programs that need one, and where it comes from."""
        if self.max_speed is None:
            return 2.0 * self.hover_speed, "assumed: twice the hover speed"
        return self.max_speed, "rotor speed at full command"

    @property
    def max_speed(self) -> float | None:
        """Rotor speed at full command [rad/s], where the vehicle file has it."""
        return self.vehicle.command.max_speed

    @cached_property
    def full_thrust(self) -> FloatArray | None:
        """Thrust of every rotor at full command [N], shape (rotors,), where the full rotor speed is known."""
        return None if self.max_speed is None else ThrustModel.stated(self.vehicle).at_speed(self.max_speed)

    @property
    def hover_thrust(self) -> float | None:
        """Share of the full thrust that hovers, where the full rotor speed is known."""
        return None if self.full_thrust is None else self.vehicle.mass * GRAVITY / float(self.full_thrust.sum())

    @property
    def hover_command(self) -> float | None:
        """Share of full command that hovers, all rotors alike, where the full rotor speed is known.

        Of a flight controller that undoes the curve of its motors (kind ``thrust``) that is the share of thrust.
        """
        if self.max_speed is None or self.vehicle.command.kind == "thrust":
            return self.hover_thrust
        return ThrustModel.stated(self.vehicle).hover_speed(self.vehicle.mass * GRAVITY) / self.max_speed

    @property
    def thrust_expo(self) -> float | None:
        """Share e of the square in ArduPilot's curve thrust / full = (1 - e) c + e c^2; None where none is fitted.

        Of b (w - w0)^2 with w = c w_full, the linear part is -2 w0 c w_full; what is left at no command has no place.
        """
        if "thrust_curve" not in self.vehicle.effects or self.max_speed is None:
            return None
        bend = -2.0 * self.effect("thrust_curve", "dead_speed") / self.max_speed
        return 1.0 / (1.0 + bend) if bend > -1.0 else None

    @property
    def unproven(self) -> str:
        """Reason why nothing shows that the values predict; empty where something does."""
        proof = self.vehicle.proof
        if proof is not None:
            return proof.lacking
        guessed = any(p.sigma is None for p in self.vehicle.parameters.values())
        return "the values are guesses of the vehicle file" if guessed else ""

    def header(self, used: tuple[str, ...]) -> list[str]:
        """Lines that say what this is, what came from data, and which effects the other program cannot hold.

        Args:
            used: effects that the form carries, and those of their optional numbers that it does.
        """
        left = []
        for name, values in self.vehicle.effects.items():
            if name not in used:
                left.append(name)
                continue
            # Optional numbers that say something.
            for p in EFFECTS[name].parameters:
                silent = self.effect(name, p.beside) if p.beside else p.neutral
                if p.optional and p.name in values and values[p.name] != silent and f"{name}.{p.name}" not in used:
                    left.append(f"{name}.{p.name}")
        left += [f"residual ({t.formula})" for t in self.vehicle.residual if "residual" not in used]
        left += ["random"] if self.vehicle.random is not None and "random" not in used else []
        lines = [f"NOT PROVEN: {self.unproven}."] if self.unproven else []
        lines += [f"Written by quadid from {self.source} ({self.vehicle.name}); SI units.", "Sources of the values:"]
        lines += [f"  {n} = {self.value(n):.6g} {unit}: {self.origin(n)}" for n, unit in NOMINAL_UNITS.items()]
        lines.append(f"  mass = {self.vehicle.mass:g} kg and geometry: from the vehicle file, taken as known")
        return [*lines, f"Effects that have no place here: {', '.join(left)}"] if left else lines


# --- What single programs want to know of a vehicle beside `Facts`, by the names that their templates use


AIR_DENSITY = 1.225
"""Of the standard atmosphere [kg/m^3], in which a ballistic coefficient is stated."""
ROTOR_MASS = 1e-3
"""Share of the mass that each rotor link gets in Gazebo; taken off the body, so that the vehicle keeps its own."""
SAME_MOMENT = 0.01
"""Relative difference up to which a rotor's place or moment is that which a simulator gives it."""
_SIH = np.array([[-1.0, 1.0, 1.0, -1.0], [1.0, -1.0, 1.0, -1.0], [1.0, 1.0, -1.0, -1.0]])
"""Signs of roll, pitch, yaw moment of SIH's motors 1 to 4 (sih.cpp): an X; the first two turn counterclockwise."""
SITL_FRAMES = {
    "+": ((90, 1), (-90, 1), (0, -1), (180, -1)),
    "X": ((45, 1), (-135, 1), (-45, -1), (135, -1)),
    "hexa": ((0, -1), (180, 1), (-120, -1), (60, 1), (-60, 1), (120, -1)),
    "hexax": ((90, -1), (-90, 1), (-30, -1), (150, 1), (30, 1), (-150, -1)),
}
"""Motors 1, 2, ... of ArduPilot's frames (SIM_Frame.cpp): angle from forward, clockwise [deg], and spin in ours."""
_AGILICIOUS = {"fr": (1, -1, 1), "bl": (-1, 1, 1), "br": (-1, -1, -1), "fl": (1, 1, -1)}
"""Rotors of Agilicious in its order: signs of x forward and y left, and the spin, in ours, that it allocates for."""


def px4(facts: Facts) -> dict[str, Any]:
    """Rows of parameters that stand for the whole vehicle.

    CA_ROTORn_KM is torque over thrust [m], positive for rotors that turn counterclockwise seen from above, as ours of
    spin +1 do; CA_ROTORn_CT is the thrust at full command [N], which needs the full rotor speed and holds losses of
    single rotors.  PX4 sends its thrust setpoint to the ESCs as it is unless THR_MDL_FAC says otherwise, so
    MPC_THR_HOVER is a share of command, not of thrust.
    """
    refused = _no_cross(facts, "no SIH_*: PX4 simulates")
    effects, k, mass, speed = facts.vehicle.effects, facts.effect, facts.vehicle.mass, facts.max_speed
    rows = list[tuple[str, float]]()
    if not refused:
        # Simulation in hardware (SIH), a quad X: mass, inertia, arms, full thrust and torque, damping, motor lag.
        j, (across, along, _) = facts.inertia, np.mean(np.abs(facts.arms[:, [1, 0, 2]]), axis=0).tolist()
        rows.append(("SIH_MASS", mass))
        rows += [(f"SIH_I{a}{b}", j["XYZ".index(a), "XYZ".index(b)]) for a, b in ("XX", "YY", "ZZ", "XY", "XZ", "YZ")]
        rows += [("SIH_L_ROLL", across), ("SIH_L_PITCH", along)]
        if speed is not None and facts.full_thrust is not None:
            torque = facts.torque_per_thrust * float(np.mean(facts.thrust)) * speed**2
            rows += [("SIH_T_MAX", float(np.mean(facts.full_thrust))), ("SIH_Q_MAX", torque)]
        damping = 0.5 * (j[0, 0] * k("rate_damping", "l_p") + j[1, 1] * k("rate_damping", "m_q"))
        rows += [("SIH_KDV", mass * facts.mean_drag)] if "rotor_drag" in effects else []
        rows += [("SIH_KDW", damping)] if "rate_damping" in effects else []
        rows += [("SIH_T_TAU", k("motor_lag", "tau"))] if "motor_lag" in effects else []
    # Drag of EKF2: momentum drag of the propellers [1/s], ballistic coefficients [kg/m^2]; only what was fitted
    rows += [("EKF2_MCOEF", facts.mean_drag)] if "rotor_drag" in effects else []
    c = k("parasitic_drag", "c")
    rows += [(f"EKF2_BCOEF_{axis}", 0.5 * AIR_DENSITY / c) for axis in "XY" if c > 0.0]
    return {"lost": () if speed is not None else ("weak_rotor",), "rows": rows, "refused": refused}


def _no_cross(facts: Facts, what: str) -> str:
    """Reason why a program with only PX4's X and motor order cannot fly it, after `what`; empty where it can."""
    shape = f"{what} four alike rotors in an X, front right and back left counterclockwise, front left and back right"
    if len(facts.rotors) != _SIH.shape[1]:
        return f"{shape}; this vehicle has {len(facts.rotors)} rotors"
    pull = facts.thrust / np.mean(facts.thrust)
    moments = np.array([-facts.arms[:, 1], facts.arms[:, 0], facts.vehicle.spins]) * pull
    size = np.mean(np.abs(facts.arms[:, 1])), np.mean(np.abs(facts.arms[:, 0])), 1.0
    wrong = np.abs(moments - _SIH * np.array(size)[:, None]).max(axis=1) > SAME_MOMENT * np.abs(moments).max(axis=1)
    axes = [axis for axis, off in zip(("roll", "pitch", "yaw"), wrong, strict=True) if off]
    return f"{shape}; {', '.join(axes)} of this vehicle would come out wrong" if axes else ""


def ardupilot(facts: Facts) -> dict[str, Any]:
    """Thrust curve, and the frame that the vehicle is in SITL with the rotor behind each of its motors.

    ``expo`` is `Facts.thrust_expo`.
    SITL, whose own e is 0.65 without ``propExpo``, is given 1 then, as rotor speed follows command; a flight controller
    that undoes the curve (kind ``thrust``) may have any.
    SITL calls the distance of the motors from the centre ``diagonal_size`` (`SIM_Frame.cpp`).
    """
    expo = facts.thrust_expo
    frame, motors = sitl_frame(facts)
    refused = f"no .sitl.json: ArduPilot's simulator has no such frame, only {', '.join(SITL_FRAMES)}"
    return {
        "expo": expo,
        "sitl_expo": 1.0 if expo is None and facts.vehicle.command.kind != "thrust" else expo,
        "lost": () if expo is not None else ("thrust_curve",),
        "frame": frame,
        "motors": motors,
        "refused": "" if frame else refused,
        "without": () if frame else (".sitl.json",),
    }


def sitl_frame(facts: Facts) -> tuple[str, list[int]]:
    """The frame of SITL whose motors stand and turn as the rotors do, and the rotor (from 1) of each motor."""
    arm = facts.vehicle.arm
    for name, motors in SITL_FRAMES.items():
        angles, spins = np.radians([a for a, _ in motors]), np.array([s for _, s in motors])
        places = arm * np.column_stack([np.cos(angles), np.sin(angles)])
        far = np.linalg.norm(places[:, None] - facts.vehicle.rotor_positions[None, :, :2], axis=2)
        nearest = np.argmin(far, axis=1)
        if (
            len(motors) == len(facts.rotors) == len(set(nearest.tolist()))
            and far.min(axis=1).max() <= SAME_MOMENT * arm
            and (facts.vehicle.spins[nearest] == spins).all()
        ):
            return name, (nearest + 1).tolist()
    return "", []


def gazebo(facts: Facts) -> dict[str, Any]:
    """Mass and inertia of the body without its rotor links, FLU, and of a link: a thin disc about its axis.

    The plugin's thrust is ``motorConstant omega^2``, its drag torque ``momentConstant`` times thrust, its rotor drag
    ``rotorDragCoefficient |omega| v``; hence ``rotorDragCoefficient = m k / sum(omega_hover)``.
    """
    part, body = ROTOR_MASS * facts.vehicle.mass, facts.inertia_flu
    disc = facts.value("J_r") * np.diag([0.5, 0.5, 1.0])
    for arm in facts.arms_flu:
        body = body - part * (arm @ arm * np.eye(3) - np.outer(arm, arm)) - disc
    rest = facts.vehicle.mass - part * len(facts.rotors)
    return {"body_mass": rest, "body_inertia": body, "rotor_mass": part, "rotor_inertia": disc}


def agilicious(facts: Facts) -> dict[str, Any]:
    """``places``: our rotors by the names of Agilicious.

    Raises:
        ParameterError: not four rotors in a cross that turn as Agilicious assumes.
    """
    places = dict[str, RotorFacts]()
    for name, (x, y, _) in _AGILICIOUS.items():
        # The only rotor in a quadrant, FLU, about the geometric centre
        flu = facts.vehicle.rotor_positions @ TO_FLU
        here = [r for r, p in zip(facts.rotors, flu, strict=True) if p[0] * x > 0.0 and p[1] * y > 0.0]
        if len(facts.rotors) != len(_AGILICIOUS) or len(here) != 1:
            raise ParameterError(
                f"{facts.vehicle.name}: {len(facts.rotors)} rotors, not one in each quadrant",
                "four rotors in a cross, as Agilicious has them",
                "export to another form",
            )
        places[name] = here[0]
    wrong = [name for name, rotor in places.items() if rotor.spin != _AGILICIOUS[name][2]]
    if wrong:
        raise ParameterError(
            f"{facts.vehicle.name}: the rotors {', '.join(wrong)} turn the other way than Agilicious assumes",
            "front right and back left counterclockwise from above, the others clockwise",
            "change the allocation in Agilicious, or export to another form",
        )
    return {"places": list(places.items())}


def rotorpy(facts: Facts) -> dict[str, Any]:
    """Nothing beside `Facts`.

    Raises:
        ParameterError: not four rotors: RotorPy 3 inverts the allocation, and ends with a LinAlgError.
    """
    _four(facts, "RotorPy")
    return {}


def drone_models(facts: Facts) -> dict[str, Any]:
    """Numbers of the model ``first_principles``: drag is that at hover speed.

    The inertia of the rotors is left out: version 0.1 gives their gyroscopic torque the wrong sign about one axis, so
    that it does work.

    Raises:
        ParameterError: not four rotors, which the program takes for granted.
    """
    _four(facts, "drone-models")
    arms, arm = facts.arms_flu, facts.vehicle.arm
    drag = (facts.effect("rotor_drag", "k_x"), facts.effect("rotor_drag", "k_y"), facts.effect("axial_inflow", "k_z"))
    mixing = np.array([arms[:, 1], -arms[:, 0], [r.turn_flu * arm for r in facts.rotors]]) / arm
    name = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in facts.vehicle.name)
    return {
        "section": Markup(name or "vehicle"),
        "gravity": GRAVITY,
        "per_rpm": 2.0 * math.pi / 60.0,
        "mixing": mixing,
        "drag": -facts.vehicle.mass * np.diag(drag),
    }


def gym_pybullet_drones(facts: Facts) -> dict[str, Any]:
    """Rotors in the order of its Crazyflie's motors, clockwise from front right.

    Its drag is that of Gazebo's plugin, at the centre of gravity.

    Raises:
        ParameterError: not two pairs of rotors, which the program takes for granted.
    """
    front_right, back_left, front_left, back_right = _two_pairs(facts, "gym-pybullet-drones")
    order = [front_right, back_right, back_left, front_left]
    return _ordered(facts, order) | {"per_rpm": 2.0 * math.pi / 60.0, "gravity": GRAVITY}


def pyflyt(facts: Facts) -> dict[str, Any]:
    """Rotors in its order, which is PX4's, and a lag that is not shorter than a step of its physics.

    Raises:
        ParameterError: not two pairs of rotors, which the program takes for granted.
    """
    lag = max(facts.effect("motor_lag", "tau"), 1.0 / 240.0)
    return _ordered(facts, _two_pairs(facts, "PyFlyt")) | {"lag": lag, "density": AIR_DENSITY}


def _two_pairs(facts: Facts, program: str) -> list[int]:
    """Rotors (from 0) in PX4's order of an X; in any other shape too, the first two push the vehicle clockwise."""
    _four(facts, program)
    if facts.vehicle.spins.sum() != 0:
        raise ParameterError(
            f"spins {facts.vehicle.spins.tolist()}", f"two of each, which {program} takes for granted", "use jsbsim"
        )
    return sorted(range(4), key=lambda i: (-facts.rotors[i].spin, -facts.vehicle.rotor_positions[i, 0]))


def _ordered(facts: Facts, order: list[int]) -> dict[str, Any]:
    """The rotors in another order, which ``order`` states, and the inertia without products.

    Where there are products, Bullet reports the attitude of the principal axes; these programs take it for the body's.
    """
    tensor = np.diag(np.diag(facts.inertia))
    return {"rotors": [facts.rotors[i] for i in order], "order": [i + 1 for i in order], "tensor": tensor}


def jsbsim(facts: Facts) -> dict[str, Any]:
    """Units of its functions, drag along each axis [1/s], places and inertia in its own frame: aft, right, up."""
    k, structural = facts.effect, np.diag([-1.0, 1.0, -1.0])
    along = k("rotor_drag", "k_x"), k("rotor_drag", "k_y"), k("axial_inflow", "k_z")
    return {
        "pound": 1.0 / 4.4482216152605,
        "foot": 0.3048,
        "drags": list(zip("XYZ", "uvw", along, strict=True)),
        "places": [structural @ r.frd for r in facts.rotors],
        "tensor": structural @ facts.inertia @ structural,
    }


def _four(facts: Facts, program: str) -> None:
    if len(facts.rotors) != 4:
        raise ParameterError(
            f"{len(facts.rotors)} rotors", f"four, which {program} takes for granted", "use jsbsim, mujoco or urdf"
        )


def airsim(facts: Facts) -> dict[str, Any]:
    """Coefficients that are b and d with propellers as long as an arm, and drag that is right in level flight.

    The front that drag acts on is that of the box and of the propellers (`MultiRotorPhysicsBody.hpp`).
    """
    arm, turn, height = facts.vehicle.arm, 2.0 * math.pi, 0.01
    front = 0.2 * arm**2 + len(facts.rotors) * math.pi * arm * height
    return {
        "density": AIR_DENSITY,
        "turn": turn,
        "diameter": arm,
        "height": height,
        "box": (arm, arm, 0.2 * arm),
        "c_t": facts.value("b") * turn**2 / (AIR_DENSITY * arm**4),
        "c_p": facts.value("d") * turn**3 / (AIR_DENSITY * arm**5),
        "drag": 2.0 * facts.vehicle.mass * facts.effect("parasitic_drag", "c") / (AIR_DENSITY * front),
        "refused": _no_cross(facts, "not for SimpleFlight, but behind PX4 or ArduPilot: SimpleFlight mixes for"),
    }


def pegasus(facts: Facts) -> dict[str, Any]:
    """Links as for Gazebo; principal moments and axes (wxyz) of the body, torque of every rotor, drag at hover speed.

    Raises:
        ParameterError: not four rotors, which the program takes for granted.
    """
    from scipy.spatial.transform import Rotation  # slow to load

    _four(facts, "Pegasus")
    links = gazebo(facts)
    moments, axes = np.linalg.eigh(links["body_inertia"])
    x, y, z, w = Rotation.from_matrix(np.linalg.det(axes) * axes).as_quat()
    drag = (facts.effect("rotor_drag", "k_x"), facts.effect("rotor_drag", "k_y"), facts.effect("axial_inflow", "k_z"))
    return links | {
        "moments": moments,
        "axes": (w, x, y, z),
        "torques": facts.torque_per_thrust * facts.thrust,
        "drag": facts.vehicle.mass * np.array(drag),
    }


def isaac_lab(facts: Facts) -> dict[str, Any]:
    """``allocation``: force and torque about the CG of unit thrusts, FLU, shape (6, rotors); thrust per (rev/s)^2."""
    arms, none = facts.arms_flu, np.zeros(len(facts.rotors))
    twist = facts.torque_per_thrust * np.array([r.turn_flu for r in facts.rotors])
    allocation = np.array([none, none, none + 1.0, arms[:, 1], -arms[:, 0], twist])
    told = {"allocation": allocation, "turn": 2.0 * math.pi, "floor": FLOOR, "spread": Z95 * facts.vehicle.mass_sigma}
    if facts.vehicle.random is None:
        return told
    size, time = facts.vehicle.random.each_axis
    return told | {
        "random_force": facts.vehicle.mass * size[:3],
        "random_times": time,
        "random_torque": np.diag(facts.inertia) * size[3:],
    }


# --- Every form by name: whose it is, which effects it carries, its templates, and what only it wants to know


class Form(NamedTuple):
    """The form of another program.

    Attributes:
        carried: effects that it can hold, and optional numbers of these; all others are named in the file as left out.
        templates: name of the template of every file, by the ending of the file's name.
        particulars: what the templates need beside `Facts`; of this vehicle the form cannot hold the effects ``lost``
            and the files ``without``, and ``refused`` says what else it does not write, and why.
    """

    program: str
    carried: tuple[str, ...]
    templates: Mapping[str, str]
    particulars: Callable[[Facts], Mapping[str, Any]] = lambda facts: {}

    @property
    def effects(self) -> tuple[str, ...]:
        """Effects that it can hold."""
        return tuple(name for name in self.carried if name in EFFECTS)

    @property
    def names(self) -> set[str]:
        """Other names of a format: its programs, and the kinds of its files that are theirs alone."""
        kinds = {part for end in self.templates for part in end.split(".")[1:]} - {"json", "xml", "toml", "py", "hpp"}
        return {*kinds, *self.program.lower().split(", "), *self.program.lower().replace(",", "").split()}


ALL = (*EFFECTS, *(f"{e.name}.{p.name}" for e in EFFECTS.values() for p in e.parameters), "residual", "random")
"""Everything that a vehicle file holds."""
_BODY = ("cg_offset", "product_of_inertia")
_LAGS = ("motor_lag", "motor_lag.tau_down")

FORMS: dict[str, Form] = {
    "yaml": Form("quadid", ALL, {".yaml": "quadid.yaml"}, lambda facts: {"file": Markup(facts.vehicle.to_yaml())}),
    "px4": Form(
        "PX4, SIH, EKF2",
        (*_BODY, "weak_rotor", "rotor_drag", "parasitic_drag", "rate_damping", "motor_lag"),
        {".params": "px4.params"},
        px4,
    ),
    "ardupilot": Form(
        "ArduPilot, SITL",
        ("thrust_curve",),
        {".param": "ardupilot.param", ".sitl.json": "ardupilot.sitl.json"},
        ardupilot,
    ),
    "gazebo": Form("Gazebo", (*_BODY, *_LAGS, "rotor_drag", "weak_rotor"), {".sdf": "gazebo.sdf"}, gazebo),
    "rotorpy": Form(
        "RotorPy",
        (*_BODY, "motor_lag", "rotor_drag", "axial_inflow", "parasitic_drag", "imu_lever_arm"),
        {"_params.py": "rotorpy.py"},
        rotorpy,
    ),
    "agilicious": Form(
        "Agilicious", ("cg_offset", "motor_lag", "rotor_drag"), {".agilicious.yaml": "agilicious.yaml"}, agilicious
    ),
    "mujoco": Form("MuJoCo", (*_BODY, "weak_rotor"), {".mjcf.xml": "mujoco.mjcf.xml"}),
    "urdf": Form("URDF", _BODY, {".urdf": "vehicle.urdf"}, lambda facts: {"tensor": facts.inertia_flu}),
    "gym-pybullet-drones": Form(
        "gym-pybullet-drones",
        ("cg_offset", "rotor_drag", "rotor_drag.central", "axial_inflow", "axial_inflow.central"),
        {".cf2x.urdf": "gym_pybullet_drones.urdf"},
        gym_pybullet_drones,
    ),
    "pyflyt": Form(
        "PyFlyt",
        ("cg_offset", "motor_lag", "parasitic_drag"),
        {".pyflyt.urdf": "pyflyt.urdf", ".pyflyt.yaml": "pyflyt.yaml"},
        pyflyt,
    ),
    "jsbsim": Form(
        "JSBSim",
        (
            *(*_BODY, "weak_rotor", "motor_lag", "parasitic_drag"),
            *("rotor_drag", "rotor_drag.central", "axial_inflow", "axial_inflow.central"),
        ),
        {".jsbsim.xml": "jsbsim.xml"},
        jsbsim,
    ),
    "drone-models": Form(
        "drone-models, crazyflow",
        (*_BODY, *_LAGS, "rotor_drag", "rotor_drag.central", "axial_inflow", "axial_inflow.central"),
        {".params.toml": "drone_models.toml"},
        drone_models,
    ),
    "fmu": Form(
        "FMU 3.0",
        tuple(name for name in ALL if not name.startswith(("random", "battery_sag"))),
        {"_fmu.py": "fmu.py"},
        lambda facts: {"vehicle_file": facts.vehicle.to_yaml()},
    ),
    "airsim": Form(
        "AirSim, Colosseum, Cosys-AirSim, cosysairsim",
        (*_BODY, "motor_lag", "parasitic_drag"),
        {".airsim.hpp": "airsim.hpp"},
        airsim,
    ),
    "pegasus": Form(
        "Pegasus, Isaac-Sim",
        (*_BODY, "weak_rotor", "rotor_drag", "rotor_drag.central", "axial_inflow", "axial_inflow.central"),
        {".usda": "pegasus.usda", "_pegasus.py": "pegasus.py"},
        pegasus,
    ),
    "isaac-lab": Form("Isaac Lab", (*_BODY, *_LAGS, "random"), {"_isaaclab.py": "isaac_lab.py"}, isaac_lab),
}
FORMATS = tuple(FORMS)


def form_of(name: str) -> str:
    """The form of that name, program or kind of file (``sdf``, ``crazyflow``).

    Raises:
        ParameterError: no form, or several.
    """
    asked = name.lower().lstrip(".")
    if asked in FORMS:
        return asked
    found = [form for form, about in FORMS.items() if asked in about.names]
    if len(found) != 1:
        raise ParameterError(f"unknown format '{name}'", ", ".join(FORMATS), nearest(name, FORMATS))
    return found[0]


def refused(vehicle: Vehicle, form: str) -> str:
    """Parts of this vehicle that a form does not write, and why; empty where it writes all."""
    return str(FORMS[form_of(form)].particulars(Facts(vehicle, "")).get("refused", ""))


def export(vehicle: Vehicle, form: str, source: str) -> dict[str, str]:
    """Writes a vehicle in the form of another program.

    Args:
        vehicle: with its fitted values as initial values.
        form: one of `FORMATS`, or what `form_of` takes for one.
        source: what the vehicle was read from, for the header.

    Returns:
        Text by the ending of the file name it belongs in.

    Raises:
        ParameterError: unknown form, or a vehicle that it cannot hold.
    """
    facts, asked = Facts(vehicle, source), FORMS[form_of(form)]
    own = asked.particulars(facts)
    header = facts.header(tuple(name for name in asked.carried if name not in own.get("lost", ())))
    values = {"f": facts, "v": vehicle, "rotors": facts.rotors, "header": header, **own}
    without = own.get("without", ())
    return {end: render(f"programs/{name}", values) for end, name in asked.templates.items() if end not in without}
