"""The flown vehicle stepped from outside: any controller closes the loop around the truth."""

from __future__ import annotations

import numpy as np

from quadid.errors import ParameterError
from quadid.flight.airframe import PUSHES, STATES, Oddity
from quadid.flight.loop import EPSILON, NO_TIME, Track, apply_due, power_at, quaternion_of, supply
from quadid.flight.rotors import advance
from quadid.flight.setup import Effects, TruthParameters, prepare
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

LONGEST_STEP = 1e-3
"""As `fly` integrates [s]."""


class SteppedFlight:
    """One vehicle in the air, with the equations of `fly` and a command from whoever calls.

    Sensors are the caller's: effects that act in sensors alone change nothing here.

    Attributes:
        time: [s].
        rotor_speed: [rad/s], shape (rotors,).
    """

    def __init__(
        self, vehicle: Vehicle, truth: TruthParameters | None = None, *, effects: Effects | None = None,
        height: float = 30.0, span: float = 60.0,
    ) -> None:  # fmt: skip
        """Begins level, at rest, in hover.

        Args:
            vehicle: geometry.
            truth: true parameters; default `TruthParameters.of(vehicle)`.
            effects: hidden effects of the catalogue, name -> parameter -> value.
            height: above the ground [m].
            span: over which a battery sags [s].
        """
        base = TruthParameters.of(vehicle) if truth is None else truth
        still = np.zeros((6, len(vehicle.rotors), 2))
        self._setup = prepare(vehicle, base, effects or {}, span, 0.0, (0.0, 0.0), still)
        self._y = np.zeros(STATES)
        self._y[2], self._y[6], self._y[10], self._y[14] = -height, 1.0, 1.0, 1.0
        speed = base.hover_speed(len(vehicle.rotors)) + self._setup.body.dead_speed
        self.rotor_speed: FloatArray = np.full(len(vehicle.rotors), speed)
        self.time = 0.0
        self._level, self._slope = self.rotor_speed.copy(), np.zeros_like(self.rotor_speed)
        self._waiting: list[tuple[float, FloatArray]] = []
        self._changed, self._dropped, self._mass = 0, False, 1.0

    @property
    def position(self) -> FloatArray:
        """Of the CG, NED [m], shape (3,)."""
        return self._y[0:3].copy()

    @property
    def velocity(self) -> FloatArray:
        """Of the CG, NED [m/s], shape (3,)."""
        return self._y[3:6].copy()

    @property
    def rotation(self) -> FloatArray:
        """Body to world, shape (3, 3)."""
        return self._y[6:15].reshape(3, 3).copy()

    @property
    def quaternion(self) -> FloatArray:
        """Body to world, wxyz, shape (4,)."""
        out = np.empty(4)
        quaternion_of(self.rotation, out)
        return out

    @property
    def rate(self) -> FloatArray:
        """In body axes [rad/s], shape (3,)."""
        return self._y[15:18].copy()

    def step(self, command: FloatArray, dt: float) -> None:
        """Gives a command, which reaches the rotors after their delay, and flies on for `dt` [s].

        Args:
            command: rotor speeds [rad/s], shape (rotors,), held until the next.
            dt: [s].

        Raises:
            ParameterError: a command of another shape or not finite, or a step that is not positive.
        """
        given = np.asarray(command, dtype=np.float64)
        if given.shape != self.rotor_speed.shape or not np.isfinite(given).all() or not dt > 0.0:
            raise ParameterError(
                f"command {given} for {dt} s", f"{len(self.rotor_speed)} finite rotor speeds, a positive time"
            )
        self._waiting.append((self.time + self._setup.delay, given))
        end = self.time + dt
        while end - self.time > EPSILON:
            self._piece(end)

    def _piece(self, end: float) -> None:
        """One step that no event cuts."""
        s, now = self._setup, self.time
        boost = supply(now, self.rotor_speed, s.body.hover_speed, s.events) ** s.events.supply_exponent
        while self._waiting and self._waiting[0][0] <= now + EPSILON:
            _, goal = self._waiting.pop(0)
            none = np.empty((0, 0))
            due = Track(none, none, none, goal[None], none, none, none)
            apply_due(
                now, 0, 1, NO_TIME, np.zeros(1), self._y, self.rotor_speed, self._level, self._slope,
                np.zeros_like(goal), self._changed, due, s.body, s.drive, boost,
            )  # fmt: skip
        if self._changed == 0 and s.events.mass_time <= now + EPSILON:
            self._changed, self._mass = 1, 1.0 + s.events.mass_fraction
        self._dropped |= s.events.drop_time <= now + EPSILON
        cuts = [end, now + LONGEST_STEP, *(at for at, _ in self._waiting[:1])]
        cuts += [s.events.mass_time] * (self._changed == 0) + [s.events.drop_time] * (not self._dropped)
        h = min(cuts) - now
        powers = np.array([power_at(now + share * h, self._dropped, s.events) for share in (0.0, 0.5, 1.0)])
        advance(
            self._y, self.rotor_speed, self._level, self._slope, s.efficiency, powers, self._mass, self._changed,
            np.zeros(PUSHES), s.drive, s.body, s.air, Oddity(), h, np.zeros((5, max(STATES, len(self.rotor_speed)))),
        )  # fmt: skip
        self.time = now + h
