"""RotorPy: a Python module with the dictionary ``quad_params``; body FLU."""

from __future__ import annotations

from quadid_report.programs.facts import TO_FLU, Facts, number, row

CARRIED = (
    "cg_offset",
    "product_of_inertia",
    "motor_lag",
    "rotor_drag",
    "axial_inflow",
    "parasitic_drag",
    "imu_lever_arm",
)


def rotorpy(facts: Facts) -> str:
    """Returns the module.

    RotorPy's rotor drag is ``-k_d omega v`` for every rotor, ours ``-m k v sum(omega) / sum(omega_hover)``, hence
    ``k_d = m k / sum(omega_hover)``; parasitic drag ``c_D = m c``.
    """
    m = facts.vehicle.mass
    inertia = facts.inertia_flu
    parasitic = m * facts.effect("parasitic_drag", "c")
    fastest, origin = facts.fastest
    imu = TO_FLU @ [facts.effect("imu_lever_arm", k) for k in "xyz"]
    positions = [f'        "r{i + 1}": np.array([{row(arm)}]),' for i, arm in enumerate(facts.arms_flu)]
    # A rotor of spin +1 pushes the vehicle about +z of FRD, which is -z of FLU.
    directions = ", ".join(str(-rotor.spin) for rotor in facts.vehicle.rotors)
    entries = [
        ("mass", m, "kg"), ("Ixx", inertia[0, 0], "kg m^2"), ("Iyy", inertia[1, 1], "kg m^2"),
        ("Izz", inertia[2, 2], "kg m^2"), ("Ixy", inertia[0, 1], "kg m^2"), ("Iyz", inertia[1, 2], "kg m^2"),
        ("Ixz", inertia[0, 2], "kg m^2"), ("c_Dx", parasitic, "N/(m/s)^2"), ("c_Dy", parasitic, "N/(m/s)^2"),
        ("c_Dz", parasitic, "N/(m/s)^2"), ("k_eta", facts.value("b"), "N/(rad/s)^2"),
        ("k_m", facts.value("d"), "N m/(rad/s)^2"), ("k_d", m * facts.mean_drag / facts.hover_speeds, "kg/rad"),
        ("k_z", m * facts.effect("axial_inflow", "k_z") / facts.hover_speeds, "kg/rad"), ("k_h", 0.0, "kg/m"),
        ("k_flap", 0.0, "kg m/rad"), ("tau_m", facts.lag, "s"),
        ("rotor_speed_min", 0.0, "rad/s"), ("rotor_speed_max", fastest, f"rad/s, {origin}"),
        ("motor_noise_std", 0.0, "rad/s"),
    ]  # fmt: skip
    lines = [f"# {line}" for line in facts.header(CARRIED)]
    lines += ["", "import numpy as np", "", "quad_params = {"]
    lines += [f'    "{name}": {number(value)},  # {unit}' for name, value, unit in entries]
    lines += [
        f'    "num_rotors": {len(facts.vehicle.rotors)},',
        '    "rotor_pos": {  # from the CG, FLU [m]',
        *positions,
        "    },",
    ]
    lines.append(f'    "rotor_directions": np.array([{directions}]),')
    lines.append(f'    "rI": np.array([{row(imu)}]),  # IMU, FLU [m]')
    return "\n".join([*lines, "}"]) + "\n"
