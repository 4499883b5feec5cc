"""Parts of a vehicle file: rotors, the meaning of rotor columns, priors, noise, stabiliser, IMU, thrust stand."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, field_validator, model_validator

from quadid.sanitise import plain
from quadid.types import FloatArray

DEFAULT_BOUND_FACTOR = 4.0
"""A bare initial guess may be wrong by this factor each way."""
PositiveFloat = Annotated[float, Field(gt=0.0, allow_inf_nan=False)]
Spread = Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
Coordinate = Annotated[float, Field(allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-6.3, le=6.3, allow_inf_nan=False)]

MIXERS: dict[str, tuple[tuple[float, ...], ...]] = {
    "crazyflie": ((1.0, -0.5, 0.5, 1.0), (1.0, -0.5, -0.5, -1.0), (1.0, 0.5, -0.5, 1.0), (1.0, 0.5, 0.5, -1.0)),
}
"""Mixers by name: rows are rotors, columns the inputs.  Crazyflie takes thrust, roll, pitch, yaw."""


class Strict(BaseModel):
    """A frozen part of a file that allows no other keys, and no text but printable text of one line."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    @field_validator("*", mode="after")
    @classmethod
    def _printable(cls, value: Any) -> Any:
        for text in _texts(value):
            if not text.isprintable():
                raise ValueError(f"'{plain(text, 60)}' has a line break or another character that does not print")
        return value


def _texts(value: Any) -> Iterator[str]:
    """All texts in a value, keys too."""
    if isinstance(value, str):
        yield value
    elif isinstance(value, Mapping):
        yield from _texts([*value.keys(), *value.values()])
    elif isinstance(value, list | tuple):
        for item in value:
            yield from _texts(item)


class Rotor(Strict):
    """One rotor.

    Attributes:
        position: from the geometric centre, FRD [m].
        spin: +1 or -1, its sign in Omega_r; +1 turns about -z and pushes the vehicle about +z.
    """

    position: tuple[Coordinate, Coordinate, Coordinate]
    spin: Literal[-1, 1]


class Command(Strict):
    """What the rotor columns of a log mean.

    Attributes:
        kind: ``rotor_speed`` [rad/s], ``normalized`` [0..1], ``thrust`` [0..1, proportional to thrust, where the
            flight controller undoes the motor's curve] or ``pwm`` [us].
        sampling: ``held``: a row acts until the next; ``instant``: a reading, linear in between.
        max_speed: rotor speed at full command [rad/s]; normalized and pwm need it, exports of hover thrust use it.
        range: pulse widths of zero and full command [us], for pwm.
    """

    kind: Literal["rotor_speed", "normalized", "thrust", "pwm"] = "rotor_speed"
    sampling: Literal["held", "instant"] = "held"
    max_speed: PositiveFloat | None = None
    range: tuple[PositiveFloat, PositiveFloat] = (1000.0, 2000.0)

    @model_validator(mode="after")
    def _complete(self) -> Command:
        if self.kind != "rotor_speed" and self.max_speed is None:
            raise ValueError(f"command kind '{self.kind}' needs max_speed [rad/s], the rotor speed at full command")
        if self.range[1] <= self.range[0]:
            raise ValueError(f"command range {list(self.range)} must rise, for example [1000, 2000]")
        return self

    def to_rotor_speed(self, values: FloatArray) -> FloatArray:
        """Converts logged rotor columns, shape (n, rotors), to rotor speed [rad/s]."""
        if self.kind == "rotor_speed":
            return values
        assert self.max_speed is not None
        if self.kind == "pwm":
            low, high = self.range
            values = (values - low) / (high - low)
        if self.kind == "thrust":
            values = np.sqrt(np.maximum(values, 0.0))  # below zero a rotor stands still
        return values * self.max_speed

    def from_rotor_speed(self, speed: FloatArray) -> FloatArray:
        """Converts rotor speeds [rad/s], shape (n, rotors), to logged rotor columns."""
        if self.kind == "rotor_speed":
            return speed
        assert self.max_speed is not None
        share = speed / self.max_speed
        if self.kind == "thrust":
            return share**2
        low, high = self.range if self.kind == "pwm" else (0.0, 1.0)
        return low + share * (high - low)


class ParameterPrior(Strict):
    """Initial guess of one parameter: value, bounds, and standard deviation where known (same unit)."""

    initial: PositiveFloat
    bounds: tuple[PositiveFloat, PositiveFloat] | None = None
    sigma: PositiveFloat | None = None

    @model_validator(mode="after")
    def _ordered(self) -> ParameterPrior:
        if self.bounds is not None and not self.bounds[0] <= self.initial <= self.bounds[1]:
            raise ValueError(f"initial {self.initial:g} lies outside bounds [{self.bounds[0]:g}, {self.bounds[1]:g}]")
        return self

    @property
    def limits(self) -> tuple[float, float]:
        """Bounds, by default a factor of 4 each way."""
        return self.bounds or (self.initial / DEFAULT_BOUND_FACTOR, self.initial * DEFAULT_BOUND_FACTOR)

    @property
    def log_halfwidth(self) -> float:
        """Half the distance of the bounds on the log scale."""
        return 0.5 * math.log(self.limits[1] / self.limits[0])

    @property
    def log_sigma(self) -> float:
        """Standard deviation of the logarithm: that of the file, else `log_halfwidth`."""
        return self.sigma / self.initial if self.sigma else self.log_halfwidth


class Noise(Strict):
    """Known 1-sigma noise: gyro [rad/s], attitude [rad], accel [m/s^2], velocity [m/s], position [m]."""

    gyro: PositiveFloat | None = None
    attitude: PositiveFloat | None = None
    accel: PositiveFloat | None = None
    velocity: PositiveFloat | None = None
    position: PositiveFloat | None = None


class Stabiliser(Strict):
    """The on-board attitude stabiliser, where known.

    Attributes:
        gains: by name, as in `quadid.attitude_controller`.
        rate: how often it runs [Hz]; None for once a log row.
    """

    gains: dict[str, float]
    rate: PositiveFloat | None = None


class Mounting(Strict):
    """The IMU in the body: rotation (roll, pitch, yaw) [rad] and position from the geometric centre, FRD [m]."""

    rotation: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    position: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)


class ThrustPoint(Strict):
    """One reading of a thrust stand, one rotor: speed [rad/s], thrust [N]."""

    speed: PositiveFloat
    thrust: PositiveFloat
