"""Agilicious (agilib): the quadrotor's YAML; body FLU, rotors in its own order and sense of rotation."""

from __future__ import annotations

from quadid.errors import ParameterError
from quadid_report.programs.facts import TO_FLU, Facts, number

CARRIED = ("cg_offset", "motor_lag", "rotor_drag")
_PLACES = {"fr": (1, -1), "bl": (-1, 1), "br": (-1, -1), "fl": (1, 1)}
"""Its rotors in its order: signs of x forward and y left."""
_SPINS = {"fr": 1, "bl": 1, "br": -1, "fl": -1}
"""The sense of rotation that its allocation assumes, in ours: +1 pushes the vehicle about +z of FRD."""


def agilicious(facts: Facts) -> str:
    """Returns the YAML.

    ``thrust_map`` is thrust [N] over rotor speed [rad/s]: quadratic, linear, constant; ``kappa`` torque over thrust
    [m]; ``aero_coeff_1`` the linear drag m k [kg/s].

    Raises:
        ParameterError: not four rotors in a cross that turn as Agilicious assumes.
    """
    order = {name: _rotor(facts, signs) for name, signs in _PLACES.items()}
    wrong = [n for n, i in order.items() if facts.vehicle.rotors[i].spin != _SPINS[n]]
    if wrong:
        raise ParameterError(
            f"{facts.vehicle.name}: the rotors {', '.join(wrong)} turn the other way than Agilicious assumes",
            "front right and back left counterclockwise from above, the others clockwise",
            "change the allocation in Agilicious, or export to another form",
        )
    arms, (fastest, origin) = facts.arms_flu, facts.fastest
    b = float(facts.thrust.mean())
    m = facts.vehicle.mass
    rows = [("mass", _number(m), "kg")]
    rows += [(f"tbm_{name}", _row(arms[i]), "m, from the CG, FLU") for name, i in order.items()]
    rows += [
        ("inertia", _row(facts.inertia.diagonal()), "kg m^2"),
        ("motor_omega_min", "0.0", "rad/s"),
        ("motor_omega_max", _number(fastest), f"rad/s, {origin}"),
        ("motor_tau", _number(facts.lag), "s"),
        ("thrust_map", _row((b, 0.0, 0.0)), "N over (rad/s)^2, rad/s, 1"),
        ("kappa", _number(facts.torque_per_thrust), "m, torque over thrust"),
        ("thrust_min", "0.0", "N, each rotor"),
        ("thrust_max", _number(b * fastest**2), "N, each rotor"),
        ("rotors_config", '"cross"', ""),
        ("aero_coeff_1", _row([m * facts.effect("rotor_drag", k) for k in ("k_x", "k_y")] + [0.0]), "kg/s"),
        ("aero_coeff_3", _row((0.0, 0.0, 0.0)), "kg s/m^2"),
        ("aero_coeff_h", "0.0", "kg/m"),
    ]
    lines = [f"# {line}" for line in facts.header(CARRIED)]
    lines.append("# omega_max [rad/s] and the control gains are not in the flight: keep your own.")
    return "\n".join([*lines, *(f"{n}: {value}{f'  # {unit}' if unit else ''}" for n, value, unit in rows)]) + "\n"


def _rotor(facts: Facts, signs: tuple[int, int]) -> int:
    """Index of the only rotor in a quadrant, FLU."""
    places = facts.vehicle.rotor_positions @ TO_FLU
    here = [i for i, p in enumerate(places) if p[0] * signs[0] > 0.0 and p[1] * signs[1] > 0.0]
    if len(facts.vehicle.rotors) != 4 or len(here) != 1:
        raise ParameterError(
            f"{facts.vehicle.name}: {len(facts.vehicle.rotors)} rotors, not one in each quadrant",
            "four rotors in a cross, as Agilicious has them", "export to another form",
        )  # fmt: skip
    return here[0]


def _number(value: float) -> str:
    """A number that every YAML reader takes for one: 2.0e-05, since 2e-05 is text to YAML 1.1."""
    mantissa, e, exponent = number(value).partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"


def _row(values: object) -> str:
    return f"[{', '.join(_number(v) for v in values)}]"  # type: ignore[attr-defined]
