"""Gazebo (gz sim): a model with a motor plugin for every rotor; body FLU."""

from __future__ import annotations

from xml.sax.saxutils import escape, quoteattr

import numpy as np

from quadid_report.programs.facts import TENSOR, Facts, number

CARRIED = ("cg_offset", "product_of_inertia", "motor_lag", "motor_lag.tau_down", "rotor_drag", "weak_rotor")
ROTOR_MASS = 1e-3
"""Share of the mass that each rotor link gets; taken off the body, so that the whole vehicle keeps mass and inertia."""


def gazebo(facts: Facts) -> str:
    """Returns the SDF of a model: body, rotors, and ``MulticopterMotorModel`` plugins.

    The plugin's thrust is ``motorConstant omega^2``, its drag torque ``momentConstant`` times thrust, its rotor drag
    ``rotorDragCoefficient |omega| v``; hence ``rotorDragCoefficient = m k / sum(omega_hover)``.
    """
    name = escape(facts.vehicle.name)
    arms, comments = facts.arms_flu, facts.xml_comment(CARRIED)
    rotors = "".join(_rotor(facts, i, arm) for i, arm in enumerate(arms))
    plugins = "".join(_plugin(facts, i) for i in range(len(arms)))
    body, mass = _body_inertia(facts, arms)
    return (
        f'<?xml version="1.0"?>\n<!--\n{comments}\n'
        "  The origin is the centre of gravity; body axes forward, left, up.\n-->\n"
        f'<sdf version="1.9">\n  <model name={quoteattr(facts.vehicle.name)}>\n    <link name="base_link">\n'
        f"      <inertial>\n        <mass>{mass:.8g}</mass>\n{_tensor(body, 8)}      </inertial>\n    </link>\n"
        f"{rotors}{plugins}  </model>\n</sdf>\n".replace("@NAME@", name)
    )


def _body_inertia(facts: Facts, arms: np.ndarray) -> tuple[np.ndarray, float]:
    """Inertia and mass of the body without its rotor links, FLU."""
    part = ROTOR_MASS * facts.vehicle.mass
    body = facts.inertia_flu
    for arm in arms:
        body = body - part * (arm @ arm * np.eye(3) - np.outer(arm, arm)) - np.diag(_disc(facts))
    return body, facts.vehicle.mass - part * len(arms)


def _disc(facts: Facts) -> tuple[float, float, float]:
    """Principal inertias of a rotor, a thin disc about its axis [kg m^2]."""
    spin = facts.value("J_r")
    return 0.5 * spin, 0.5 * spin, spin


def _tensor(inertia: np.ndarray, indent: int) -> str:
    inner = "".join(f"{' ' * (indent + 2)}<{n}>{number(inertia[i, j])}</{n}>\n" for n, i, j in TENSOR)
    return f"{' ' * indent}<inertia>\n{inner}{' ' * indent}</inertia>\n"


def _rotor(facts: Facts, i: int, arm: np.ndarray) -> str:
    pose = " ".join(f"{float(v) + 0.0:.6g}" for v in arm)
    return (
        f'    <link name="rotor_{i}">\n      <pose>{pose} 0 0 0</pose>\n      <inertial>\n'
        f"        <mass>{ROTOR_MASS * facts.vehicle.mass:.8g}</mass>\n{_tensor(np.diag(_disc(facts)), 8)}"
        f'      </inertial>\n    </link>\n    <joint name="rotor_{i}_joint" type="revolute">\n'
        f"      <parent>base_link</parent>\n      <child>rotor_{i}</child>\n"
        "      <axis><xyz>0 0 1</xyz></axis>\n    </joint>\n"
    )


def _plugin(facts: Facts, i: int) -> str:
    # Spin +1 turns about -z of FRD, up: counterclockwise seen from above.
    turning = "ccw" if facts.vehicle.rotors[i].spin > 0 else "cw"
    entries = {
        "robotNamespace": "@NAME@",
        "jointName": f"rotor_{i}_joint",
        "linkName": f"rotor_{i}",
        "turningDirection": turning,
        "timeConstantUp": f"{facts.lag:.6g}",
        "timeConstantDown": f"{facts.lag_down:.6g}",
        "maxRotVelocity": f"{facts.fastest[0]:.6g}",
        "motorConstant": f"{float(facts.thrust[i]):.8g}",
        "momentConstant": f"{facts.torque_per_thrust:.8g}",
        "commandSubTopic": "command/motor_speed",
        "actuator_number": str(i),
        "rotorDragCoefficient": f"{facts.vehicle.mass * facts.mean_drag / facts.hover_speeds:.8g}",
        "rollingMomentCoefficient": "0",
        "rotorVelocitySlowdownSim": "10",
        "motorType": "velocity",
    }
    inner = "".join(f"      <{key}>{value}</{key}>\n" for key, value in entries.items())
    return (
        '    <plugin filename="gz-sim-multicopter-motor-model-system" name="gz::sim::systems::MulticopterMotorModel">\n'
        f"{inner}    </plugin>\n"
    )
