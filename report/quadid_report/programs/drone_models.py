"""drone-models and crazyflow: a section of ``params.toml``; body FLU, rotor speeds in rev/min."""

from __future__ import annotations

import math

import numpy as np

from quadid.errors import ParameterError
from quadid.vehicle import GRAVITY
from quadid_report.programs.facts import Facts, matrix

CARRIED = (
    "cg_offset", "product_of_inertia", "motor_lag", "motor_lag.tau_down", "rotor_drag", "rotor_drag.central",
    "axial_inflow", "axial_inflow.central",
)  # fmt: skip
ROTORS = 4
_PER_RPM = 2.0 * math.pi / 60.0


def drone_models(facts: Facts) -> str:
    """Returns the section, for the model ``first_principles``.

    Drag is that at hover speed.  The inertia of the rotors is left out: version 0.1 gives their gyroscopic torque the
    wrong sign about one axis, so that it does work.

    Raises:
        ParameterError: not four rotors, which the program takes for granted.
    """
    if len(facts.vehicle.rotors) != ROTORS:
        raise ParameterError(
            f"{len(facts.vehicle.rotors)} rotors", "four, which drone-models takes for granted", "use rotorpy or mujoco"
        )
    arms, m, up, down = facts.arms_flu, facts.vehicle.mass, facts.lag, facts.lag_down
    b, d = facts.value("b") * _PER_RPM**2, facts.value("d") * _PER_RPM**2
    # A rotor of spin +1 pushes the vehicle about +z of FRD, which is -z of FLU.
    mixing = np.array([arms[:, 1], -arms[:, 0], [-r.spin * facts.vehicle.arm for r in facts.vehicle.rotors]])
    drag = (facts.effect("rotor_drag", "k_x"), facts.effect("rotor_drag", "k_y"), facts.effect("axial_inflow", "k_z"))
    lines = [f"# {line}" for line in facts.header(CARRIED)]
    lines += [
        "#   Drag acts at the CG: what it damps of turning is left out.",
        f"#   J_r = {facts.value('J_r'):.6g} kg m^2 is left out: version 0.1 has a wrong sign of the gyroscopic torque",
        "", f"[{_bare(facts.vehicle.name)}]", f"gravity_vec = [0.0, 0.0, {-GRAVITY}]  # m/s^2",
        f"mass = {m:.8g}  # kg", f"L = {facts.vehicle.arm:.8g}  # m",
        f"J = {matrix(facts.inertia_flu)}  # kg m^2",
        f"rpm2thrust = [0.0, 0.0, {b:.8g}]  # N/rpm^2", f"rpm2torque = [0.0, 0.0, {d:.8g}]  # N m/rpm^2",
        f"thrust2torque = {facts.torque_per_thrust:.8g}  # m",
        f"rotor_dyn_coef = [{1.0 / up:.8g}, 0.0, {1.0 / down:.8g}, 0.0]  # 1/s, 1/s/rpm",
        f"rotor_dyn_coef_simple = {1.0 / up:.8g}  # 1/s", f"thrust_dyn_coef = {1.0 / up:.8g}  # 1/s",
        f"mixing_matrix = {matrix(mixing / facts.vehicle.arm)}",
        f"drag_matrix = {matrix(np.diag([-m * k for k in drag]))}  # N s/m, at hover speed",
        "prop_inertia = 0.0  # kg m^2, see above", "thrust_min = 0.0  # N",
    ]  # fmt: skip
    if facts.max_speed is not None:
        lines.append(f"thrust_max = {facts.value('b') * facts.max_speed**2:.8g}  # N, at full command")
    return "\n".join(lines) + "\n"


def _bare(name: str) -> str:
    """A name that TOML takes without quotes."""
    return "".join(c if c.isascii() and (c.isalnum() or c in "-_") else "_" for c in name) or "vehicle"
