"""Whether mass, size and first guesses of a vehicle file can belong to one flying machine; names the slip of unit.

Multirotors from 3 g to 1 t carry between 20 and 1500 kg for each cubic metre of arm; a slip of unit is off by a
thousand and more.  The limits leave a factor of twenty on both sides.
"""

from __future__ import annotations

import math

DENSITY = (1.0, 3.0e4)
"""Mass over the cube of the arm [kg/m^3]."""
MASSES = (1e-3, 5e3)
"""[kg]."""
SPEEDS = (5.0, 2.0e4)
"""Rotor speed in hover [rad/s]: helicopters of 10 m and motors of a gram lie inside."""
_UNITS = (
    ("mass", 1e-3, "grams", "mass"),
    ("arm", 1e-3, "millimetres", "rotor positions"),
    ("arm", 1e-2, "centimetres", "rotor positions"),
    ("arm", 0.1, "decimetres, or slipped by one digit", "rotor positions"),
    ("arm", 0.0254, "inches", "rotor positions"),
)


def impossible_size(mass: float, arm: float) -> str:
    """Says which unit a mass [kg] or an arm [m] seems to be in; empty for what can fly.

    Args:
        mass: of the vehicle.
        arm: mean horizontal distance of the rotors from the centre.
    """
    if _fits(mass, arm):
        return ""
    found = f"mass {mass:.4g} kg with rotors {arm:.4g} m from the centre"
    for what, factor, unit, where in _UNITS:
        scaled = (mass * factor, arm) if what == "mass" else (mass, arm * factor)
        if _fits(*scaled):
            value, si = (scaled[0], "kg") if what == "mass" else (scaled[1], "m")
            return f"{found}: {where} in {unit}? {value:.4g} {si} would fit"
    return f"{found}: such a vehicle cannot fly; write mass in kg and positions in m"


def _fits(mass: float, arm: float) -> bool:
    return MASSES[0] <= mass <= MASSES[1] and 0.005 <= arm <= 20.0 and DENSITY[0] <= mass / arm**3 <= DENSITY[1]


def impossible_hover(low: float, high: float) -> str:
    """Says that no thrust coefficient within its bounds hovers at a speed rotors have; empty where one does.

    Args:
        low: rotor speed [rad/s] at which the upper bound of b carries the weight.
        high: that of the lower bound.
    """
    if math.isfinite(low) and high >= SPEEDS[0] and low <= SPEEDS[1]:
        return ""
    return (
        f"b within its bounds hovers at {low:.3g} to {high:.3g} rad/s, rotors turn at {SPEEDS[0]:g} to {SPEEDS[1]:g}: "
        "b is N of one rotor over (rad/s)^2, not over rpm^2 or a command"
    )
