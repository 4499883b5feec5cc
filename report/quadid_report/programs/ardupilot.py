"""ArduPilot: motor parameters for the vehicle, and a frame file for its simulator (SITL)."""

from __future__ import annotations

from quadid_report.programs.facts import Facts

CARRIED = ("thrust_curve",)
_SITL_PWM = (1000.0, 2000.0)


def ardupilot_parameters(facts: Facts) -> str:
    """Returns the parameter file (``NAME,VALUE``): hover thrust, and thrust curve where one was fitted."""
    lines = [f"# {line}" for line in facts.header(_carried(facts))]
    if facts.hover_thrust is None:
        lines.append(
            "# No MOT_THST_HOVER: the rotor speed at full command is not known (command.max_speed in the vehicle file)."
        )
        lines.append(
            "# ArduPilot has no parameters for mass and inertia; they are in the frame file for its simulator."
        )
        return "\n".join(lines) + "\n"
    lines.append(f"MOT_THST_HOVER,{facts.hover_thrust:.6g}")
    expo = thrust_expo(facts)
    if expo is not None:
        lines.append(f"MOT_THST_EXPO,{expo:.6g}")
    elif facts.hover_command is not None:
        lines.append(
            "# MOT_THST_HOVER is that of MOT_THST_EXPO 1, thrust as the square of command; for E set "
            f"(1 - E) c + E c^2, c = {facts.hover_command:.4g}."
        )
    return "\n".join(lines) + "\n"


def ardupilot_frame(facts: Facts) -> str:
    """Returns a frame file for SITL: mass [kg], arm [m], inertia [kg m^2], hover throttle and curve where known.

    Use, in the folder of the file: ``sim_vehicle.py -v ArduCopter --frame X:NAME.sitl.json``.  SITL's own motor order
    applies.  What it calls ``diagonal_size`` is the distance of the motors from the centre (`SIM_Frame.cpp`).
    """
    inertia = ", ".join(f"{v:.6g}" for v in [facts.inertia[i, i] for i in range(3)])
    entries = [
        f'"mass": {facts.vehicle.mass:.6g}',
        f'"diagonal_size": {facts.vehicle.arm:.6g}',
        f'"moment_inertia": [{inertia}]',
        f'"num_motors": {len(facts.vehicle.rotors)}',
    ]
    if facts.vehicle.command.kind == "pwm":
        low, high = ((v - _SITL_PWM[0]) / (_SITL_PWM[1] - _SITL_PWM[0]) for v in facts.vehicle.command.range)
        entries += [f'"pwmMin": {_SITL_PWM[0]:g}', f'"pwmMax": {_SITL_PWM[1]:g}']
        entries += [f'"spin_min": {low:.6g}', f'"spin_max": {high:.6g}']
    if facts.hover_thrust is not None:
        entries.append(f'"hoverThrOut": {facts.hover_thrust:.6g}')
    expo = thrust_expo(facts)
    if expo is not None:
        entries.append(f'"propExpo": {expo:.6g}')
    # SITL takes the first brace for the beginning.
    comments = [f"# {line}".translate({ord("{"): "(", ord("}"): ")"}) for line in facts.header(_carried(facts))]
    return "\n".join([*comments, "{", ",\n".join(f"  {e}" for e in entries), "}"]) + "\n"


def thrust_expo(facts: Facts) -> float | None:
    """Share e of the square in ArduPilot's curve thrust / full = (1 - e) c + e c^2; None where no curve was fitted.

    Of b (w - w0)^2 with w = c w_full, the linear part is -2 w0 c w_full; what is left at no command has no place.
    """
    if "thrust_curve" not in facts.vehicle.effects or facts.max_speed is None:
        return None
    bend = -2.0 * facts.effect("thrust_curve", "dead_speed") / facts.max_speed
    return 1.0 / (1.0 + bend) if bend > -1.0 else None


def _carried(facts: Facts) -> tuple[str, ...]:
    return CARRIED if thrust_expo(facts) is not None else ()
