"""Isaac Lab: a ``ThrusterCfg`` whose ranges are our 95 % intervals, with what ``MultirotorCfg`` needs beside it."""

from __future__ import annotations

import math

import numpy as np

from quadid.chi_square import Z95
from quadid_report.programs.facts import Facts, matrix

CARRIED = ("cg_offset", "product_of_inertia", "motor_lag", "motor_lag.tau_down")


def isaac_lab(facts: Facts) -> str:
    """Returns a Python module; body FLU, thrust per (rev/s)^2.

    An interval of a value that was not fitted has no width: what nobody measured is not drawn at random.
    """
    b, arms, fastest = facts.value("b"), facts.arms_flu, facts.fastest[0]
    origin = "at full command" if facts.max_speed is not None else "assumed: at twice the hover speed"
    # A rotor of spin +1 pushes the vehicle about +z of FRD, which is -z of FLU.
    twist = [-rotor.spin for rotor in facts.vehicle.rotors]
    n = len(arms)
    allocation = np.array(
        [np.zeros(n), np.zeros(n), np.ones(n), arms[:, 1], -arms[:, 0], facts.torque_per_thrust * np.array(twist)]
    )
    mass = facts.vehicle.mass
    spread = Z95 * facts.vehicle.mass_sigma
    lines = [f"# {line}" for line in facts.header(CARRIED)]
    lines += [
        "# Ranges are 95 % intervals, to randomise over; equal ends: not measured, or known exactly.", "",
        "from isaaclab_contrib.actuators import ThrusterCfg", "", "THRUSTERS = ThrusterCfg(",
        "    dt=0.005,  # [s] set it to your physics step",
        f"    thrust_range=(0.0, {b * fastest**2:.8g}),  # [N] {origin}",
        f"    thrust_const_range={_pair(*_interval(facts, 'b', (2.0 * math.pi) ** 2))},  # [N s^2]",
        f"    tau_inc_range={_pair(facts.lag, facts.lag)},  # [s]",
        f"    tau_dec_range={_pair(facts.lag_down, facts.lag_down)},  # [s]",
        f"    torque_to_thrust_ratio={facts.torque_per_thrust:.8g},  # [m]",
        f"    thruster_names_expr={[f'rotor_{i + 1}' for i in range(n)]!r},  # frames of `--format urdf`", ")", "",
        "# For MultirotorCfg: force and torque about the CG of unit thrusts, (6, rotors), and the turning sense.",
        f"ALLOCATION_MATRIX = {matrix(allocation)}", f"ROTOR_DIRECTIONS = {twist!r}", "",
        "# For randomisation events: mass [kg], J_xx, J_yy, J_zz and the inertia tensor [kg m^2].",
        f"MASS_RANGE = {_pair(mass - spread, mass + spread)}",
        *(f"{name.upper()}_RANGE = {_pair(*_interval(facts, name))}" for name in ("J_xx", "J_yy", "J_zz")),
        f"INERTIA = {matrix(facts.inertia_flu)}",
    ]  # fmt: skip
    return "\n".join(lines) + "\n"


def _interval(facts: Facts, name: str, scale: float = 1.0) -> tuple[float, float]:
    """95 % interval of a nominal parameter on the log scale, times `scale`."""
    prior = facts.vehicle.parameters[name]
    half = Z95 * (prior.sigma or 0.0) / prior.initial
    return scale * prior.initial * math.exp(-half), scale * prior.initial * math.exp(half)


def _pair(low: float, high: float) -> str:
    return f"({low:.8g}, {high:.8g})"
