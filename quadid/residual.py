"""Terms beyond the catalogue: forces and moments, each a coefficient times a printed product of known signals.

They belong to a file that predicts, never to the physics: a residual term is called by its formula, not by a cause.
"""

from __future__ import annotations

from typing import Annotated

from pydantic import Field, field_validator

from quadid.errors import nearest
from quadid.vehicle_parts import Strict

SIGNALS: dict[str, str] = {
    "v_x": "m/s", "v_y": "m/s", "v_z": "m/s", "p": "rad/s", "q": "rad/s", "r": "rad/s", "g_x": "", "g_y": "",
    "g_z": "", "T": "N", "tau_x": "N m", "tau_y": "N m", "tau_z": "N m", "V": "m/s",
}  # fmt: skip
"""What may be multiplied, with units, all in body axes (FRD): velocity through the air, rates, direction of gravity,
thrust of all rotors, their moments, airspeed.  In the order of `quadid.model.residual_kernel`, after the number one."""
TARGETS: dict[str, str] = {
    "force_x": "N", "force_y": "N", "force_z": "N", "moment_x": "N m", "moment_y": "N m", "moment_z": "N m",
}  # fmt: skip
"""What a term acts on, with units: force and moment in body axes at the centre of gravity."""
MOST_FACTORS = 3
"""Signals in one product, at most."""
MOST_TERMS = 500


class ResidualTerm(Strict):
    """A force or moment beyond the catalogue: `value` times a product of signals.

    Attributes:
        acts_on: one of `TARGETS`.
        product: up to three of `SIGNALS`; empty for a constant.
        value: coefficient, in the SI unit `unit`.
    """

    acts_on: str
    product: tuple[str, ...] = Field(default=(), max_length=MOST_FACTORS)
    value: Annotated[float, Field(allow_inf_nan=False)]

    @field_validator("acts_on")
    @classmethod
    def _known_target(cls, name: str) -> str:
        if name not in TARGETS:
            raise ValueError(f"'{name}' is none of {', '.join(TARGETS)}; {nearest(name, TARGETS)}")
        return name

    @field_validator("product")
    @classmethod
    def _known_signals(cls, names: tuple[str, ...]) -> tuple[str, ...]:
        for name in names:
            if name not in SIGNALS:
                raise ValueError(f"signal '{name}' is none of {', '.join(SIGNALS)}; {nearest(name, SIGNALS)}")
        return names

    @property
    def unit(self) -> str:
        """SI unit of the coefficient."""
        factors = [SIGNALS[name] for name in self.product if SIGNALS[name]]
        return " / ".join([TARGETS[self.acts_on], *(f"({unit})" for unit in factors)])

    @property
    def formula(self) -> str:
        """As printed: ``moment_x += -1.2e-05 v_y T``."""
        return " ".join([f"{self.acts_on} += {self.value:.4g}", *self.product])

    def typical(self, weight: float, arm: float) -> float:
        """Coefficient with which the term matters on a vehicle of `weight` [N] and `arm` [m].

        A twentieth of its weight, for moments at its arm, when rates, velocities and directions are one, the rotors
        carry the weight and their moments are a tenth of it at the arm (a hundredth in yaw).
        """
        size = 0.05 * weight * (arm if self.acts_on.startswith("moment") else 1.0)
        usual = {"T": weight, "tau_x": 0.1 * weight * arm, "tau_y": 0.1 * weight * arm, "tau_z": 0.01 * weight * arm}
        for name in self.product:
            size /= usual.get(name, 1.0)
        return size
