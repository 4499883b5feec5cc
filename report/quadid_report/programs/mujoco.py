"""MuJoCo: an MJCF model whose actuators are the rotors' thrusts; body FLU, world z up."""

from __future__ import annotations

from xml.sax.saxutils import quoteattr

from quadid_report.programs.facts import Facts, number, row

CARRIED = ("cg_offset", "product_of_inertia", "weak_rotor")


def mujoco(facts: Facts) -> str:
    """Returns the MJCF text of a free body with one actuator a rotor, whose control is that rotor's thrust [N].

    Thrust is b omega^2 (`weak_rotor` taken off), drag torque d / b times thrust.  The limit of the control is the
    thrust at full command where the full rotor speed is known.
    """
    comments, inertia, arms = facts.xml_comment(CARRIED), facts.inertia_flu, facts.arms_flu
    full = row((inertia[i, j] for i, j in ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))), " ")
    sites = "".join(f'      <site name="rotor_{i + 1}" pos="{row(arm, " ")}"/>\n' for i, arm in enumerate(arms))
    actuators = "".join(_actuator(facts, i) for i in range(len(arms)))
    return (
        f"<!--\n{comments}\n  The origin is the centre of gravity; body axes forward, left, up.\n"
        f"  Control: thrust of each rotor [N], b omega^2.\n-->\n<mujoco model={quoteattr(facts.vehicle.name)}>\n"
        '  <option timestep="0.002" integrator="RK4" density="0" viscosity="0"/>\n  <worldbody>\n'
        '    <body name="base_link">\n      <freejoint/>\n'
        f'      <inertial pos="0 0 0" mass="{facts.vehicle.mass:.8g}" fullinertia="{full}"/>\n{sites}'
        f"    </body>\n  </worldbody>\n  <actuator>\n{actuators}  </actuator>\n</mujoco>\n"
    )


def _actuator(facts: Facts, i: int) -> str:
    # Spin +1 turns about -z of FRD and pushes the vehicle about +z of FRD, -z of FLU.
    twist = -facts.vehicle.rotors[i].spin * facts.torque_per_thrust
    limit = ""
    if facts.full_thrust is not None:
        limit = f' ctrllimited="true" ctrlrange="0 {number(facts.full_thrust[i])}"'
    return f'    <motor name="rotor_{i + 1}" site="rotor_{i + 1}" gear="0 0 1 0 0 {twist:.8g}"{limit}/>\n'
