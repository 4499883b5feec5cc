"""PX4: control allocation, thrust model, simulation in hardware, drag fusion; a file that QGroundControl loads."""

from __future__ import annotations

import numpy as np

from quadid_report.programs.facts import Facts

_FLOAT, _INT = 9, 6  # MAV_PARAM_TYPE
CARRIED = (
    "cg_offset",
    "weak_rotor",
    "product_of_inertia",
    "rotor_drag",
    "parasitic_drag",
    "rate_damping",
    "motor_lag",
)
AIR_DENSITY = 1.225
"""Of the standard atmosphere [kg/m^3], in which a ballistic coefficient is stated."""


def px4(facts: Facts) -> str:
    """Returns the parameter file (tab separated: system, component, name, value, type).

    CA_ROTORn_KM is torque over thrust [m], positive for rotors that turn counterclockwise seen from above, as ours of
    spin +1 do; CA_ROTORn_CT is the thrust at full command [N], which needs the full rotor speed.  PX4 sends its thrust
    setpoint to the ESCs as it is unless THR_MDL_FAC says otherwise, so MPC_THR_HOVER is a share of command, not of
    thrust.
    """
    # Losses of single rotors stand in CA_ROTORn_CT, which needs the full rotor speed.
    carried = CARRIED if facts.max_speed is not None else tuple(n for n in CARRIED if n != "weak_rotor")
    lines = [f"# {line}" for line in facts.header(carried)]
    lines += ["# Motor 1 of PX4 is rotor 1 of the vehicle file. Check with the propellers off.", "#"]
    rows: list[tuple[str, float, int]] = [("CA_ROTOR_COUNT", len(facts.vehicle.rotors), _INT)]
    for i, (rotor, arm) in enumerate(zip(facts.vehicle.rotors, facts.arms, strict=True)):
        rows += [(f"CA_ROTOR{i}_P{axis}", float(arm[j]), _FLOAT) for j, axis in enumerate("XYZ")]
        rows.append((f"CA_ROTOR{i}_KM", rotor.spin * facts.torque_per_thrust, _FLOAT))
        if facts.full_thrust is not None:
            rows.append((f"CA_ROTOR{i}_CT", float(facts.full_thrust[i]), _FLOAT))
    if facts.hover_command is None:
        lines.append("# No CA_ROTORn_CT, MPC_THR_HOVER: the rotor speed at full command is not known")
        lines.append("# (command.max_speed in the vehicle file).")
    else:
        rows.append(("MPC_THR_HOVER", facts.hover_command, _FLOAT))
        if facts.vehicle.command.kind != "thrust":
            lines.append("# MPC_THR_HOVER h is that of THR_MDL_FAC 0, the default; for F set F h^2 + (1 - F) h.")
    rows += [(name, value, _FLOAT) for name, value in (*_in_hardware(facts), *_drag_fusion(facts))]
    lines += [f"1\t1\t{name}\t{value:.8g}\t{kind}" for name, value, kind in rows]
    return "\n".join(lines) + "\n"


def _in_hardware(facts: Facts) -> list[tuple[str, float]]:
    """Simulation in hardware (SIH), a quad X: mass, inertia, arms, full thrust and torque, damping, motor lag."""
    j, k = facts.inertia, facts.effect
    rows = [("SIH_MASS", facts.vehicle.mass)]
    rows += [
        (f"SIH_I{a}{b}", float(j["XYZ".index(a), "XYZ".index(b)])) for a, b in ("XX", "YY", "ZZ", "XY", "XZ", "YZ")
    ]
    rows += [
        ("SIH_L_ROLL", float(np.mean(np.abs(facts.arms[:, 1])))),
        ("SIH_L_PITCH", float(np.mean(np.abs(facts.arms[:, 0])))),
    ]
    if facts.max_speed is not None and facts.full_thrust is not None:
        rows += [
            ("SIH_T_MAX", float(np.mean(facts.full_thrust))),
            ("SIH_Q_MAX", facts.torque_per_thrust * float(np.mean(facts.thrust)) * facts.max_speed**2),
        ]
    if "rotor_drag" in facts.vehicle.effects:
        rows.append(("SIH_KDV", facts.vehicle.mass * facts.mean_drag))
    if "rate_damping" in facts.vehicle.effects:
        rows.append(
            ("SIH_KDW", 0.5 * (float(j[0, 0]) * k("rate_damping", "l_p") + float(j[1, 1]) * k("rate_damping", "m_q")))
        )
    if "motor_lag" in facts.vehicle.effects:
        rows.append(("SIH_T_TAU", k("motor_lag", "tau")))
    return rows


def _drag_fusion(facts: Facts) -> list[tuple[str, float]]:
    """Drag of EKF2: momentum drag of the propellers [1/s], ballistic coefficients [kg/m^2]; only what was fitted."""
    rows = []
    if "rotor_drag" in facts.vehicle.effects:
        rows.append(("EKF2_MCOEF", facts.mean_drag))
    c = facts.effect("parasitic_drag", "c")
    if c > 0.0:
        rows += [(f"EKF2_BCOEF_{axis}", 0.5 * AIR_DENSITY / c) for axis in "XY"]
    return rows
