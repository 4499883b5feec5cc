"""PX4: control allocation geometry and thrust model, as a parameter file that QGroundControl loads."""

from __future__ import annotations

from quadid.report.programs.facts import Facts

_FLOAT, _INT = 9, 6  # MAV_PARAM_TYPE
_CARRIED = ("cg_offset", "weak_rotor")


def px4(facts: Facts) -> str:
    """Returns the parameter file (tab separated: system, component, name, value, type).

    CA_ROTORn_KM is torque over thrust [m], positive for rotors that turn counterclockwise seen from above, as ours of
    spin +1 do; CA_ROTORn_CT is the thrust at full command [N], which needs the full rotor speed.
    """
    lines = [f"# {line}" for line in facts.header(_CARRIED)]
    lines += ["# Motor 1 of PX4 is rotor 1 of the vehicle file. Check with the propellers off.", "#"]
    rows: list[tuple[str, float, int]] = [("CA_ROTOR_COUNT", len(facts.vehicle.rotors), _INT)]
    for i, (rotor, arm) in enumerate(zip(facts.vehicle.rotors, facts.arms, strict=True)):
        rows += [(f"CA_ROTOR{i}_P{axis}", float(arm[j]), _FLOAT) for j, axis in enumerate("XYZ")]
        rows.append((f"CA_ROTOR{i}_KM", rotor.spin * facts.torque_per_thrust, _FLOAT))
        if facts.max_speed is not None:
            rows.append((f"CA_ROTOR{i}_CT", float(facts.thrust[i]) * facts.max_speed**2, _FLOAT))
    if facts.hover_thrust is None:
        lines.append("# No CA_ROTORn_CT, THR_MDL_FAC, MPC_THR_HOVER: the rotor speed at full command is not known")
        lines.append("# (command.max_speed in the vehicle file).")
    else:
        lines.append(
            "# THR_MDL_FAC 1: thrust goes with the square of the command, since rotor speed goes with the command."
        )
        rows += [("MPC_THR_HOVER", facts.hover_thrust, _FLOAT), ("THR_MDL_FAC", 1.0, _FLOAT)]
    lines += [f"1\t1\t{name}\t{value:.8g}\t{kind}" for name, value, kind in rows]
    return "\n".join(lines) + "\n"
