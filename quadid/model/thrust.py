"""Thrust of the rotors by a full parameter vector."""

from __future__ import annotations

import math
from copy import copy

import numpy as np

from quadid.model.layout import LOSS, Layout
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


class ThrustModel:
    """Thrust of the rotors by a full parameter vector: thrust curve and weak rotors included, inflow left out."""

    def __init__(self, layout: Layout, theta: FloatArray) -> None:
        """Thrust by `theta`, shape (layout.size,)."""
        curve = layout.read_effect(theta, "thrust_curve")
        self._b, self._dead_speed = float(theta[0]), curve["dead_speed"]
        self._offset = curve.get("offset", 0.0)
        self._share = 1.0 - theta[LOSS : LOSS + layout.rotors]

    @classmethod
    def stated(cls, vehicle: Vehicle) -> ThrustModel:
        """Thrust by the vehicle file's guess and known effects."""
        layout = Layout(vehicle)
        return cls(layout, layout.initial(vehicle))

    def with_b(self, b: float) -> ThrustModel:
        """The same with another `b` [N s^2/rad^2]."""
        other = copy(self)
        other._b = b
        return other

    def at_speed(self, speed: float) -> FloatArray:
        """Thrust of each rotor [N], shape (rotors,), where all turn at `speed` [rad/s]."""
        return np.asarray(self.single(np.full((1, len(self._share)), speed))[0])

    def single(self, rotor_speed: FloatArray) -> FloatArray:
        """Thrust of each rotor [N], shape (n, rotors), of speeds [rad/s], shape (n, rotors)."""
        thrust = self._b * np.maximum(rotor_speed - self._dead_speed, 0.0) ** 2 + self._offset
        return np.asarray(np.where(rotor_speed > 0.0, thrust, 0.0) * self._share)

    def total(self, rotor_speed: FloatArray) -> FloatArray:
        """Sum over the rotors [N], shape (n,), of speeds [rad/s], shape (n, rotors)."""
        return np.asarray(self.single(rotor_speed).sum(axis=1))

    def hover_speed(self, weight: float) -> float:
        """Speed [rad/s] at which the rotors, all alike, carry `weight` [N]."""
        return self._dead_speed + math.sqrt(max(self._each(weight) - self._offset, 1e-9) / self._b)

    def like(self, stated: ThrustModel, weight: float) -> float:
        """The `b` with which `stated` carries `weight` [N] at the speed at which this one does [N s^2/rad^2].

        Losses of single rotors count with their mean, a curve with what it gives at hover.
        """
        beyond = max(self.hover_speed(weight) - stated._dead_speed, 1e-9)
        return max(stated._each(weight) - stated._offset, 1e-9) / beyond**2

    def slope(self, weight: float) -> FloatArray:
        """Change of each rotor's thrust with its speed where they carry `weight` [N], shape (rotors,) [N s/rad]."""
        return np.asarray(2.0 * self._b * (self.hover_speed(weight) - self._dead_speed) * self._share)

    def _each(self, weight: float) -> float:
        return weight / max(float(self._share.sum()), 1e-9)
