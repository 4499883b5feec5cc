"""The flown vehicle stepped from outside: any controller closes the loop around the truth."""

from __future__ import annotations

import numpy as np

from quadid.errors import ParameterError
from quadid.flight.airframe import PUSHES, STATES, Oddity
from quadid.flight.loop import BEGUN, EPSILON, fly_on, quaternion_of, turning_at
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
        self,
        vehicle: Vehicle,
        truth: TruthParameters | None = None,
        *,
        effects: Effects | None = None,
        height: float = 30.0,
        span: float = 60.0,
    ) -> None:
        """Begins level, at rest, in hover.

        Args:
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
        self._rotors, self._progress = turning_at(self.rotor_speed, self._setup.efficiency), BEGUN
        self._arrival, self._commands = np.zeros(0), np.zeros((0, len(vehicle.rotors)))

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

        Raises:
            ParameterError: a command of another shape or not finite, or a step that is not positive.
        """
        given = np.asarray(command, dtype=np.float64)
        if given.shape != self.rotor_speed.shape or not np.isfinite(given).all() or not dt > 0.0:
            raise ParameterError(
                f"command {given} for {dt} s", f"{len(self.rotor_speed)} finite rotor speeds, a positive time"
            )
        self._arrival = np.append(self._arrival, self.time + self._setup.delay)
        self._commands = np.concatenate([self._commands, given[None]])
        end, s = self.time + dt, self._setup
        while end - self.time > EPSILON:
            stop = min(end, self.time + LONGEST_STEP)
            progress = fly_on(
                self.time, stop, len(self._arrival), self._progress, self._commands, self._arrival, s.efficiency,
                np.zeros(PUSHES), s.body, s.air, Oddity(), s.drive, s.events, self._y, self._rotors,
            )  # fmt: skip
            # Commands that act already are forgotten.
            self._arrival, self._commands = self._arrival[progress.head :], self._commands[progress.head :]
            self._progress, self.time = progress._replace(head=0), stop
