"""ArduPilot: motor parameters for the vehicle, and a frame file for its simulator (SITL)."""

from __future__ import annotations

import numpy as np

from quadid.report.programs.facts import Facts

_CARRIED = ("weak_rotor",)


def ardupilot_parameters(facts: Facts) -> str:
    """Returns the parameter file (``NAME,VALUE``): hover thrust and curve, where the full rotor speed is known."""
    lines = [f"# {line}" for line in facts.header(_CARRIED)]
    if facts.hover_thrust is None:
        lines.append(
            "# No MOT_THST_HOVER: the rotor speed at full command is not known (command.max_speed in the vehicle file)."
        )
        lines.append(
            "# ArduPilot has no parameters for mass and inertia; they are in the frame file for its simulator."
        )
        return "\n".join(lines) + "\n"
    lines.append(
        "# MOT_THST_EXPO 1: thrust goes with the square of the command, since rotor speed goes with the command."
    )
    lines.append(f"MOT_THST_HOVER,{facts.hover_thrust:.6g}")
    lines.append("MOT_THST_EXPO,1")
    return "\n".join(lines) + "\n"


def ardupilot_frame(facts: Facts) -> str:
    """Returns a frame file for SITL: mass [kg], size [m], inertia [kg m^2], hover throttle where known.

    Use: ``sim_vehicle.py -v ArduCopter --frame X:/path/to/this.json``.  SITL's own motor order applies.
    """
    span = 2.0 * float(np.max(np.linalg.norm(facts.vehicle.rotor_positions[:, :2], axis=1)))
    inertia = ", ".join(f"{v:.6g}" for v in np.diag(facts.inertia))
    entries = [
        f'"mass": {facts.vehicle.mass:.6g}',
        f'"diagonal_size": {span:.6g}',
        f'"moment_inertia": [{inertia}]',
        f'"num_motors": {len(facts.vehicle.rotors)}',
    ]
    if facts.hover_thrust is not None:
        entries += [f'"hoverThrOut": {facts.hover_thrust:.6g}', '"propExpo": 1.0']
    # SITL takes the first brace for the beginning.
    comments = [f"# {line}".translate({ord("{"): "(", ord("}"): ")"}) for line in facts.header(_CARRIED)]
    return "\n".join([*comments, "{", ",\n".join(f"  {e}" for e in entries), "}"]) + "\n"
