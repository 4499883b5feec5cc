"""What other programs want to know of a vehicle, worked out once: geometry about the CG, inertia, origins."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quadid.chi_square import Z95
from quadid.effects import EFFECTS, rotor_losses
from quadid.model.thrust import ThrustModel
from quadid.parameters import NOMINAL_UNITS
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

TO_FLU = np.diag([1.0, -1.0, -1.0])
"""Turns body FRD into body FLU (its own inverse)."""
SHORTEST_LAG = 1e-3
"""Programs divide by the time constant of the motors [s]."""


class RotorFacts(NamedTuple):
    """One rotor.

    Attributes:
        frd, flu: from the CG [m], shape (3,).
        spin: its sign in Omega_r; `turn_flu` the sign of its torque on the vehicle about +z of FLU, -z of FRD.
        thrust: coefficient [N s^2/rad^2].
        full_thrust: at full command [N], where the full rotor speed is known.
    """

    frd: FloatArray
    flu: FloatArray
    spin: int
    turn_flu: int
    thrust: float
    full_thrust: float | None


@dataclass(frozen=True)
class Facts:
    """A vehicle as other programs describe it.

    Attributes:
        vehicle: the vehicle file.
        source: its name, for headers.
        doubt: what speaks against its values beside their proof, for headers.
    """

    vehicle: Vehicle
    source: str
    doubt: str = ""
    tensor = (("ixx", 0, 0), ("ixy", 0, 1), ("ixz", 0, 2), ("iyy", 1, 1), ("iyz", 1, 2), ("izz", 2, 2))
    """Entries of an inertia tensor as SDF and URDF call them."""

    def value(self, name: str) -> float:
        """Value of a nominal parameter, SI."""
        return self.vehicle.parameters[name].initial

    def effect(self, name: str, key: str) -> float:
        """Value of an effect's parameter; 0 where the vehicle has no such effect."""
        return float(self.vehicle.effects.get(name, {}).get(key, 0.0))

    def origin(self, name: str) -> str:
        """Says whether a nominal parameter came from data, or from whoever stated its uncertainty in the file."""
        prior = self.vehicle.parameters[name]
        if prior.sigma is None:
            return "not from data: as the vehicle file has it, without a sigma"
        return f"fitted, or given with its uncertainty: 95 % within {100.0 * Z95 * prior.sigma / prior.initial:.2g} %"

    def interval(self, name: str, scale: float = 1.0) -> tuple[float, float]:
        """95 % interval of a nominal parameter on the log scale, times `scale`; no width for what was not measured."""
        prior = self.vehicle.parameters[name]
        half = Z95 * (prior.sigma or 0.0) / prior.initial
        return scale * prior.initial * math.exp(-half), scale * prior.initial * math.exp(half)

    @cached_property
    def rotors(self) -> list[RotorFacts]:
        """Every rotor, in the order of the vehicle file."""
        full = [None] * len(self.arms) if self.full_thrust is None else self.full_thrust.tolist()
        return [
            RotorFacts(frd, TO_FLU @ frd, rotor.spin, -rotor.spin, float(thrust), most)
            for frd, rotor, thrust, most in zip(self.arms, self.vehicle.rotors, self.thrust, full, strict=True)
        ]

    @cached_property
    def arms(self) -> FloatArray:
        """Rotor positions from the CG, FRD [m], shape (rotors, 3)."""
        cg = np.array([self.effect("cg_offset", "x"), self.effect("cg_offset", "y"), 0.0])
        return np.asarray(self.vehicle.rotor_positions - cg)

    @cached_property
    def inertia(self) -> FloatArray:
        """Inertia tensor about the CG, FRD [kg m^2], shape (3, 3)."""
        out = np.diag([self.value("J_xx"), self.value("J_yy"), self.value("J_zz")])
        for (i, j), key in (((0, 1), "J_xy"), ((0, 2), "J_xz"), ((1, 2), "J_yz")):
            out[i, j] = out[j, i] = 0.0 - self.effect("product_of_inertia", key)
        return out

    @cached_property
    def thrust(self) -> FloatArray:
        """Thrust coefficient of every rotor [N s^2/rad^2], shape (rotors,)."""
        losses = rotor_losses(self.vehicle.effects.get("weak_rotor", {}), len(self.vehicle.rotors))
        return self.value("b") * (1.0 - np.array(losses))

    @property
    def torque_per_thrust(self) -> float:
        """Drag torque over thrust, d / b [m]."""
        return self.value("d") / self.value("b")

    @property
    def hover_speed(self) -> float:
        """Rotor speed in hover [rad/s]."""
        return self.vehicle.hover_speed()

    @property
    def hover_speeds(self) -> float:
        """Sum of all rotor speeds in hover [rad/s]."""
        return self.hover_speed * len(self.vehicle.rotors)

    @property
    def arms_flu(self) -> FloatArray:
        """Rotor positions from the CG, FLU [m], shape (rotors, 3)."""
        return np.asarray(self.arms @ TO_FLU)

    @property
    def inertia_flu(self) -> FloatArray:
        """Inertia tensor about the CG, FLU [kg m^2], shape (3, 3)."""
        return np.asarray(TO_FLU @ self.inertia @ TO_FLU)

    @property
    def lag(self) -> float:
        """Time constant of a rotor that speeds up [s], for programs that divide by it."""
        return max(self.effect("motor_lag", "tau"), SHORTEST_LAG)

    @property
    def lag_remark(self) -> str:
        """What a reader of `lag` must know; empty where the vehicle file has one."""
        return "" if "motor_lag" in self.vehicle.effects else ", not measured: stands for rotors that follow at once"

    @property
    def lag_down(self) -> float:
        """Time constant of a rotor that slows down [s]."""
        return self.effect("motor_lag", "tau_down") or self.lag

    @property
    def mean_drag(self) -> float:
        """Rotor drag, mean of forward and sideways [1/s]."""
        return 0.5 * (self.effect("rotor_drag", "k_x") + self.effect("rotor_drag", "k_y"))

    @property
    def fastest(self) -> tuple[float, str]:
        """Rotor speed at full command [rad/s], for programs that need one, and where it comes from."""
        if self.max_speed is None:
            return 2.0 * self.hover_speed, "assumed: twice the hover speed"
        return self.max_speed, "rotor speed at full command"

    @property
    def max_speed(self) -> float | None:
        """Rotor speed at full command [rad/s], where the vehicle file knows it."""
        return self.vehicle.command.max_speed

    @cached_property
    def full_thrust(self) -> FloatArray | None:
        """Thrust of every rotor at full command [N], shape (rotors,), where the full rotor speed is known."""
        return None if self.max_speed is None else ThrustModel.stated(self.vehicle).at_speed(self.max_speed)

    @property
    def hover_thrust(self) -> float | None:
        """Share of the full thrust that hovers, where the full rotor speed is known."""
        return None if self.full_thrust is None else self.vehicle.mass * GRAVITY / float(self.full_thrust.sum())

    @property
    def hover_command(self) -> float | None:
        """Share of full command that hovers, all rotors alike, where the full rotor speed is known.

        Of a flight controller that undoes the curve of its motors (kind ``thrust``) that is the share of thrust.
        """
        if self.max_speed is None or self.vehicle.command.kind == "thrust":
            return self.hover_thrust
        return ThrustModel.stated(self.vehicle).hover_speed(self.vehicle.mass * GRAVITY) / self.max_speed

    @property
    def unproven(self) -> str:
        """Why nothing shows that the values predict; empty where something does."""
        proof = self.vehicle.proof
        if self.doubt:
            return self.doubt
        if proof is not None:
            return proof.lacking
        guessed = any(p.sigma is None for p in self.vehicle.parameters.values())
        return "the values are guesses of the vehicle file" if guessed else ""

    def header(self, used: tuple[str, ...]) -> list[str]:
        """Lines that say what this is, what came from data, and which effects the other program cannot hold.

        Args:
            used: effects that the form carries, and those of their optional numbers that it does.
        """
        left = [name for name in self.vehicle.effects if name not in used]
        left += [number for name in self.vehicle.effects if name in used for number in self._optional(name, used)]
        left += [f"residual ({t.formula})" for t in self.vehicle.residual if "residual" not in used]
        lines = [f"NOT PROVEN: {self.unproven}."] if self.unproven else []
        lines += [
            f"Written by quadid from {self.source} ({self.vehicle.name}); SI units.",
            "Sources of the values:",
        ]
        lines += [f"  {n} = {self.value(n):.6g} {unit}: {self.origin(n)}" for n, unit in NOMINAL_UNITS.items()]
        lines.append(f"  mass = {self.vehicle.mass:g} kg and geometry: from the vehicle file, taken as known")
        if left:
            lines.append(f"Effects that have no place here: {', '.join(left)}")
        return lines

    def _optional(self, name: str, used: tuple[str, ...]) -> list[str]:
        """Optional numbers of an effect that say something and are not among `used`."""
        there = [p for p in EFFECTS[name].parameters if p.optional and p.name in self.vehicle.effects[name]]
        said = [
            p for p in there if self.effect(name, p.name) != (self.effect(name, p.beside) if p.beside else p.neutral)
        ]
        return [f"{name}.{p.name}" for p in said if f"{name}.{p.name}" not in used]
