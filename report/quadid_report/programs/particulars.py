"""What single programs want to know of a vehicle beside `Facts`, by the names that their templates use."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from markupsafe import Markup

from quadid.chi_square import Z95
from quadid.errors import ParameterError
from quadid.vehicle import GRAVITY
from quadid_report.programs.facts import Facts, RotorFacts

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


def own_file(facts: Facts) -> dict[str, Any]:
    """The vehicle file as it is written anywhere."""
    return {"file": Markup(facts.vehicle.to_yaml())}


def px4(facts: Facts) -> dict[str, Any]:
    """Rows of parameters that stand for the whole vehicle.

    CA_ROTORn_KM is torque over thrust [m], positive for rotors that turn counterclockwise seen from above, as ours of
    spin +1 do; CA_ROTORn_CT is the thrust at full command [N], which needs the full rotor speed and holds losses of
    single rotors.  PX4 sends its thrust setpoint to the ESCs as it is unless THR_MDL_FAC says otherwise, so
    MPC_THR_HOVER is a share of command, not of thrust.
    """
    lost = () if facts.max_speed is not None else ("weak_rotor",)
    refused = _not_sih(facts)
    rows = [] if refused else _in_hardware(facts)
    return {"lost": lost, "rows": [*rows, *_drag_fusion(facts)], "refused": refused}


def _not_sih(facts: Facts) -> str:
    """Why PX4's simulation in hardware cannot be this vehicle; empty where its X and motor order hold."""
    shape = "four alike rotors in an X: front right and back left counterclockwise, then front left and back right"
    if len(facts.rotors) != _SIH.shape[1]:
        return f"no SIH_*: PX4 simulates {shape}, this vehicle has {len(facts.rotors)} rotors"
    pull = facts.thrust / np.mean(facts.thrust)
    moments = np.array([-facts.arms[:, 1], facts.arms[:, 0], facts.vehicle.spins]) * pull
    size = np.mean(np.abs(facts.arms[:, 1])), np.mean(np.abs(facts.arms[:, 0])), 1.0
    wrong = np.abs(moments - _SIH * np.array(size)[:, None]).max(axis=1) > SAME_MOMENT * np.abs(moments).max(axis=1)
    axes = [axis for axis, off in zip(("roll", "pitch", "yaw"), wrong, strict=True) if off]
    return f"no SIH_*: PX4 simulates {shape}; {', '.join(axes)} of this vehicle would come out wrong" if axes else ""


def _in_hardware(facts: Facts) -> list[tuple[str, float]]:
    """Simulation in hardware (SIH), a quad X: mass, inertia, arms, full thrust and torque, damping, motor lag."""
    j, k, effects = facts.inertia, facts.effect, facts.vehicle.effects
    rows = [("SIH_MASS", facts.vehicle.mass)]
    rows += [(f"SIH_I{a}{b}", j["XYZ".index(a), "XYZ".index(b)]) for a, b in ("XX", "YY", "ZZ", "XY", "XZ", "YZ")]
    rows += [
        ("SIH_L_ROLL", float(np.mean(np.abs(facts.arms[:, 1])))),
        ("SIH_L_PITCH", float(np.mean(np.abs(facts.arms[:, 0])))),
    ]
    if facts.max_speed is not None and facts.full_thrust is not None:
        rows += [
            ("SIH_T_MAX", float(np.mean(facts.full_thrust))),
            ("SIH_Q_MAX", facts.torque_per_thrust * float(np.mean(facts.thrust)) * facts.max_speed**2),
        ]
    if "rotor_drag" in effects:
        rows.append(("SIH_KDV", facts.vehicle.mass * facts.mean_drag))
    if "rate_damping" in effects:
        rows.append(("SIH_KDW", 0.5 * (j[0, 0] * k("rate_damping", "l_p") + j[1, 1] * k("rate_damping", "m_q"))))
    if "motor_lag" in effects:
        rows.append(("SIH_T_TAU", k("motor_lag", "tau")))
    return rows


def _drag_fusion(facts: Facts) -> list[tuple[str, float]]:
    """Drag of EKF2: momentum drag of the propellers [1/s], ballistic coefficients [kg/m^2]; only what was fitted."""
    rows = [("EKF2_MCOEF", facts.mean_drag)] if "rotor_drag" in facts.vehicle.effects else []
    c = facts.effect("parasitic_drag", "c")
    return [*rows, *((f"EKF2_BCOEF_{axis}", 0.5 * AIR_DENSITY / c) for axis in "XY" if c > 0.0)]


def ardupilot(facts: Facts) -> dict[str, Any]:
    """Thrust curve, and the frame that the vehicle is in SITL with the rotor behind each of its motors.

    ``expo`` is the share e of the square in ArduPilot's curve thrust / full = (1 - e) c + e c^2; None: none is fitted.
    SITL, whose own e is 0.65 without ``propExpo``, is given 1 then, as rotor speed follows command; a flight controller
    that undoes the curve (kind ``thrust``) may have any.
    Of b (w - w0)^2 with w = c w_full, the linear part is -2 w0 c w_full; what is left at no command has no place.
    SITL calls the distance of the motors from the centre ``diagonal_size`` (`SIM_Frame.cpp`).
    """
    expo = None
    if "thrust_curve" in facts.vehicle.effects and facts.max_speed is not None:
        bend = -2.0 * facts.effect("thrust_curve", "dead_speed") / facts.max_speed
        expo = 1.0 / (1.0 + bend) if bend > -1.0 else None
    frame, motors = _sitl_frame(facts)
    refused = f"no .sitl.json: the rotors stand in none of the frames {', '.join(SITL_FRAMES)} of ArduPilot's simulator"
    return {
        "expo": expo, "sitl_expo": 1.0 if expo is None and facts.vehicle.command.kind != "thrust" else expo,
        "lost": () if expo is not None else ("thrust_curve",), "frame": frame, "motors": motors,
        "refused": "" if frame else refused, "without": () if frame else (".sitl.json",),
    }  # fmt: skip


def _sitl_frame(facts: Facts) -> tuple[str, list[int]]:
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
    places = {name: _in_quadrant(facts, x, y) for name, (x, y, _) in _AGILICIOUS.items()}
    wrong = [name for name, rotor in places.items() if rotor.spin != _AGILICIOUS[name][2]]
    if wrong:
        raise ParameterError(
            f"{facts.vehicle.name}: the rotors {', '.join(wrong)} turn the other way than Agilicious assumes",
            "front right and back left counterclockwise from above, the others clockwise",
            "change the allocation in Agilicious, or export to another form",
        )
    return {"places": list(places.items())}


def _in_quadrant(facts: Facts, x: int, y: int) -> RotorFacts:
    """The only rotor in a quadrant, FLU, about the geometric centre."""
    places = facts.vehicle.rotor_positions
    here = [r for r, p in zip(facts.rotors, places, strict=True) if p[0] * x > 0.0 and -p[1] * y > 0.0]
    if len(facts.rotors) != len(_AGILICIOUS) or len(here) != 1:
        raise ParameterError(
            f"{facts.vehicle.name}: {len(facts.rotors)} rotors, not one in each quadrant",
            "four rotors in a cross, as Agilicious has them", "export to another form",
        )  # fmt: skip
    return here[0]


def drone_models(facts: Facts) -> dict[str, Any]:
    """Numbers of the model ``first_principles``: drag is that at hover speed.

    The inertia of the rotors is left out: version 0.1 gives their gyroscopic torque the wrong sign about one axis, so
    that it does work.

    Raises:
        ParameterError: not four rotors, which the program takes for granted.
    """
    if len(facts.rotors) != 4:
        raise ParameterError(
            f"{len(facts.rotors)} rotors", "four, which drone-models takes for granted", "use rotorpy or mujoco"
        )
    arms, arm = facts.arms_flu, facts.vehicle.arm
    drag = (facts.effect("rotor_drag", "k_x"), facts.effect("rotor_drag", "k_y"), facts.effect("axial_inflow", "k_z"))
    mixing = np.array([arms[:, 1], -arms[:, 0], [r.turn_flu * arm for r in facts.rotors]]) / arm
    name = "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in facts.vehicle.name)
    return {
        "section": Markup(name or "vehicle"), "gravity": GRAVITY, "per_rpm": 2.0 * math.pi / 60.0, "mixing": mixing,
        "drag": -facts.vehicle.mass * np.diag(drag),
    }  # fmt: skip


def isaac_lab(facts: Facts) -> dict[str, Any]:
    """``allocation``: force and torque about the CG of unit thrusts, FLU, shape (6, rotors); thrust per (rev/s)^2."""
    arms, none = facts.arms_flu, np.zeros(len(facts.rotors))
    twist = facts.torque_per_thrust * np.array([r.turn_flu for r in facts.rotors])
    allocation = np.array([none, none, none + 1.0, arms[:, 1], -arms[:, 0], twist])
    return {"allocation": allocation, "turn": 2.0 * math.pi, "spread": Z95 * facts.vehicle.mass_sigma}
