"""The numbers the flown vehicle really has; an identification tries to find them."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from quadid.errors import ParameterError
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import GRAVITY, Vehicle

TABLE_2 = {"b": 2.33e-5, "d": 4.96e-7, "J_xx": 1.00e-2, "J_yy": 1.36e-2, "J_zz": 2.92e-2, "J_r": 5.00e-5}
"""The paper's identified Pelican (Table 2), SI."""
PELICANS = ("pelican", "pelican_x")


@dataclass(frozen=True)
class TruthParameters:
    """True physical parameters of a flown vehicle, SI.  The default is the paper's Pelican (Table 2).

    Attributes:
        b: thrust coefficient [N s^2/rad^2], f = b omega^2 (Eq. 3).
        d: drag torque coefficient [N m s^2/rad^2], tau = d omega^2 (Eq. 4).
        J_xx, J_yy, J_zz: moments of inertia about the CG, body FRD [kg m^2].
        J_r: moment of inertia of one rotor about its axis [kg m^2].
        mass: vehicle mass [kg].
        payload_arm: distance below the CG at which a mass of `mass_change` sits [m]; J_xx and J_yy change by
            mass * fraction * payload_arm^2.
    """

    b: float = TABLE_2["b"]
    d: float = TABLE_2["d"]
    J_xx: float = TABLE_2["J_xx"]
    J_yy: float = TABLE_2["J_yy"]
    J_zz: float = TABLE_2["J_zz"]
    J_r: float = TABLE_2["J_r"]
    mass: float = 1.30
    payload_arm: float = 0.0

    def __post_init__(self) -> None:
        """Checks that all six and the mass are positive and finite; raises ParameterError."""
        for name in (*NOMINAL_NAMES, "mass"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} = {value:g}", "a positive finite number")

    @classmethod
    def of(cls, vehicle: Vehicle) -> TruthParameters:
        """Returns the type's truth: Table 2 for a Pelican, else the initial values of the vehicle file."""
        values = TABLE_2 if vehicle.name in PELICANS else {n: vehicle.parameters[n].initial for n in NOMINAL_NAMES}
        return cls(**values, mass=vehicle.mass)

    def as_dict(self) -> dict[str, float]:
        """Returns the six identified parameters by name."""
        return {name: float(getattr(self, name)) for name in NOMINAL_NAMES}

    def hover_speed(self, rotors: int) -> float:
        """Speed [rad/s] of each of `rotors` rotors at which thrust equals weight."""
        return float(np.sqrt(self.mass * GRAVITY / (self.b * rotors)))


def draw_truth(vehicle: Vehicle, seed: int, spread: float = 0.15) -> TruthParameters:
    """Draws one individual of the vehicle's type.

    Args:
        vehicle: type of the vehicle.
        seed: decides the draw.
        spread: each of b, d, J_xx, J_yy, J_zz, J_r is uniform within (1 +- spread) of `TruthParameters.of`.

    Returns:
        Truth with the vehicle's own (known) mass.
    """
    if not 0.0 <= spread < 1.0:
        raise ParameterError(f"spread {spread:g}", "0 <= spread < 1")
    base = TruthParameters.of(vehicle)
    factors = np.random.default_rng([seed, 0x7247]).uniform(1.0 - spread, 1.0 + spread, len(NOMINAL_NAMES))
    return replace(base, **{n: float(getattr(base, n) * f) for n, f in zip(NOMINAL_NAMES, factors, strict=True)})
