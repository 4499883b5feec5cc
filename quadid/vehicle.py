"""Vehicle files: geometry, mass, command, initial parameters, known effects; YAML in and out."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from importlib import resources
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import yaml
from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from quadid.effects import EFFECTS, Scale, known_keys, rotor_drag_losses
from quadid.errors import ParameterError, VehicleError, nearest
from quadid.files import read_regular, written_whole
from quadid.parameters import INERTIAS, MAY_VANISH, NOMINAL_NAMES, VANISHED, impossible_inertia
from quadid.sanitise import LONGEST_LINE, LONGEST_NAME, plain
from quadid.types import FloatArray
from quadid.yaml_text import read_mapping

# --- Parts of a vehicle file: rotors, the meaning of rotor columns, priors, noise, stabiliser, IMU, thrust stand


_FILL_IN = "FILL IN"
"""Marks in the file of `quadid init` what its user has to write."""
DEFAULT_BOUND_FACTOR = 4.0
"""A bare initial guess may be wrong by this factor each way."""
_LARGEST = 1e30
"""Numbers of a vehicle are smaller, and positive ones larger than its reciprocal [SI]: so products are finite."""


def _possible(value: float) -> float:
    if not abs(value) < _LARGEST:
        raise ValueError(f"{value:g} is no number of a vehicle, all of which are below {_LARGEST:g} in SI units")
    return value


PositiveFloat = Annotated[float, Field(gt=1.0 / _LARGEST), AfterValidator(_possible)]
Spread = Annotated[float, Field(ge=0.0), AfterValidator(_possible)]
Coordinate = Annotated[float, AfterValidator(_possible)]
Correlation = Annotated[float, Field(ge=-1.0, le=1.0, allow_inf_nan=False)]
Angle = Annotated[float, Field(ge=-6.3, le=6.3, allow_inf_nan=False)]

MIXERS: dict[str, tuple[tuple[float, ...], ...]] = {
    "crazyflie": ((1.0, -0.5, 0.5, 1.0), (1.0, -0.5, -0.5, -1.0), (1.0, 0.5, -0.5, 1.0), (1.0, 0.5, 0.5, -1.0))
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
    """Meaning of the rotor columns of a log.

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

    gains: dict[str, Coordinate]
    rate: PositiveFloat | None = None


class RandomInput(Strict):
    """A first-order Gauss-Markov process: standard deviation `sigma`, and correlation time `time` [s]."""

    sigma: Spread
    time: PositiveFloat


class RandomForces(Strict):
    """Random forces on the vehicle, beyond its model, in body axes.

    Attributes:
        horizontal, vertical: specific force along x and y, along z, sigma in m/s^2.
        roll_pitch, yaw: angular acceleration about x and y, about z, sigma in rad/s^2.
    """

    horizontal: RandomInput
    vertical: RandomInput
    roll_pitch: RandomInput
    yaw: RandomInput

    @property
    def numbers(self) -> FloatArray:
        """Standard deviations and correlation times in the order of the attributes, shape (2, 4)."""
        parts = (self.horizontal, self.vertical, self.roll_pitch, self.yaw)
        return np.array([[p.sigma for p in parts], [p.time for p in parts]])

    @property
    def each_axis(self) -> FloatArray:
        """The same of force x, y, z and angular acceleration x, y, z, shape (2, 6)."""
        return self.numbers[:, [0, 0, 1, 2, 2, 3]]


class Mounting(Strict):
    """The IMU in the body: rotation (roll, pitch, yaw) [rad] and position from the geometric centre, FRD [m]."""

    rotation: tuple[Angle, Angle, Angle] = (0.0, 0.0, 0.0)
    position: tuple[Coordinate, Coordinate, Coordinate] = (0.0, 0.0, 0.0)


class ThrustPoint(Strict):
    """One reading of a thrust stand, one rotor: speed [rad/s], thrust [N]."""

    speed: PositiveFloat
    thrust: PositiveFloat


# --- Whether mass, size and first guesses of a vehicle file can belong to one flying machine; names the slip of unit
#
# Multirotors from 3 g to 1 t carry between 20 and 1500 kg for each cubic metre of arm; a slip of unit is off by a
# thousand and more.  The limits leave a factor of twenty on both sides.


DENSITY, USUAL_DENSITY = (1.0, 3.0e4), 170.0
"""Mass over the cube of the arm [kg/m^3]."""
MASSES = (1e-3, 5e3)
"""[kg]."""
SPEEDS = (5.0, 2.0e4)
"""Rotor speed in hover [rad/s]: helicopters of 10 m and motors of a gram lie inside."""
_UNITS = (
    ("mass", 1e-3, "grams", "mass", "kg"),
    ("arm", 1e-3, "millimetres", "rotor positions", "m"),
    ("arm", 1e-2, "centimetres", "rotor positions", "m"),
    ("arm", 0.1, "decimetres, or slipped by one digit", "rotor positions", "m"),
    ("arm", 0.0254, "inches", "rotor positions", "m"),
)


def impossible_size(mass: float, arm: float) -> str:
    """Says which unit a mass [kg] or an arm [m] seems to be in; empty for what can fly.

    Args:
        arm: mean horizontal distance of the rotors from the centre.
    """
    if _fits(mass, arm):
        return ""
    found = f"mass {mass:.4g} kg with rotors {arm:.4g} m from the centre"
    slips = [
        (abs(math.log(m / a**3 / USUAL_DENSITY)), f"{where} in {unit}? {m if what == 'mass' else a:.4g} {si} would fit")
        for what, factor, unit, where, si in _UNITS
        for m, a in [(mass * factor, arm) if what == "mass" else (mass, arm * factor)]
        if _fits(m, a)
    ]
    if slips:
        return f"{found}: {min(slips)[1]}"
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


# --- Terms beyond the catalogue: forces and moments, each a coefficient times a printed product of known signals
#
# A residual term is called by its formula, not by a cause.  Those that a diagnosis learns are products of motions and
# rotor speeds, never of the rotors' own thrust or torque (`quadid.estimate.residual`), so that the file may fly.


SIGNALS: dict[str, str] = {
    **dict.fromkeys(("v_x", "v_y", "v_z"), "m/s"),
    **dict.fromkeys("pqr", "rad/s"),
    **dict.fromkeys(("g_x", "g_y", "g_z"), ""),
    **{"T": "N", "W": "rad/s", "V": "m/s"},
}
"""Factors of a term, with units, all in body axes (FRD): velocity through the air, rates, direction of gravity,
thrust and speeds of all rotors together, airspeed.  In the order of `quadid.model.body_kernel`, after the one."""
TARGETS: dict[str, str] = {f"{kind}_{a}": unit for kind, unit in (("force", "N"), ("moment", "N m")) for a in "xyz"}
"""Targets of a term, with units: force and moment in body axes at the centre of gravity."""
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
    value: Coordinate

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


# --- What shows that the values of a vehicle file predict, and which flights they were fitted to


MOST_FLIGHTS = 100
"""Flights that a file remembers."""


class FittedFlight(Strict):
    """A flight that values were fitted to, so that it is known again under another name, in another format, in part.

    Attributes:
        log: its file name.
        seconds: length of the part that was fitted.
        begin: UNIX time of its first sample [s]; None where its clock has no date.
        marks: short hashes of some stretches of its gyro, see `quadid.app.logs`.
    """

    log: str = Field(max_length=LONGEST_NAME)
    seconds: Annotated[float, Field(ge=0.0, allow_inf_nan=False)]
    begin: Annotated[float, Field(allow_inf_nan=False)] | None = None
    marks: Annotated[str, Field(max_length=600)] = ""


class Proof(Strict):
    """Proof that the values of this file predict.

    Attributes:
        verdict: on the result that the file was written by: good (green), fair (amber), poor (red).
        unseen: flights that were predicted and not fitted.
        error: largest of their errors: `identify` in what the model expects, `diagnose` in noise variances; 1 is none.
        fitted: flights that the values rest on; their standard deviations are no knowledge beside the same flights.
        doubt: what else speaks against the values, as of a set that a service has withdrawn.
    """

    verdict: Literal["good", "fair", "poor"]
    unseen: tuple[str, ...] = ()
    error: Annotated[float, Field(gt=0.0, allow_inf_nan=False)] | None = None
    fitted: Annotated[tuple[FittedFlight, ...], Field(max_length=MOST_FLIGHTS)] = ()
    doubt: str = ""

    @property
    def lacking(self) -> str:
        """Reason why the values are not proven; empty when they are."""
        if self.doubt:
            return self.doubt
        if self.verdict == "poor":
            error = f": error {self.error:.3g} times what is expected on an unseen flight" if self.error else ""
            return f"its fit was judged poor{error}"
        return "" if self.unseen else "no flight was predicted that was not fitted"


# --- The vehicle: geometry, mass, command, initial parameters, known effects; read from and written as YAML text


GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""
INERTIA_SHARE = 0.1, 0.5
"""J_xx over mass and squared arm: 0.11 (a heavy octocopter) to 0.32 of known ones, 0.5 with all mass at the rotors."""
STAND_ERROR = 0.02
"""Smallest relative error of a thrust stand: its scale, and air that the vehicle meets elsewhere."""
MOST_ROTORS = 16


class Vehicle(Strict):
    """Everything known about a vehicle before its log is read.

    Attributes:
        name: identifier, of at most 200 characters.
        mass: kg, known; fixes the force scale.
        rotors: at least three.
        command: meaning of the rotor columns.
        parameters: initial guess of b, d, J_xx, J_yy, J_zz, J_r.
        effects: effects that are part of the model, name -> parameter -> value.
        reference_voltage: supply voltage that effects count from [V]; the mean of the training flights.
        noise: known sensor noise, or None.
        stabiliser: known stabiliser gains, or None.
        mounting: the IMU in the body; its position is the effect `imu_lever_arm`.
        columns: names in a CSV for those of the contract, such as {p: gyro_x}.
        mixer: from logged mixer inputs to rotors, a name of `MIXERS` or a matrix with a row a rotor; or None.
        residual: forces and moments beyond the catalogue.
        random: what acts at random beyond all of these, as a fit found it; None where nobody looked.
        correlation: of values that have a sigma, name -> name -> correlation; pairs that are not there have none.
        mass_sigma: standard deviation of the mass [kg]; 0 takes it for exact.
        arm_sigma: standard deviation of the arm [m], common to all rotors; 0 takes positions for exact.
        proof: what shows that the values predict; None for values that nobody fitted.
        thrust_stand: readings that give b before any flight; take the place of its guess as prior.
    """

    name: str = Field(max_length=LONGEST_NAME)
    mass: Annotated[float, Field(gt=0.0, allow_inf_nan=False)]  # `impossible_size` says what is possible
    mass_sigma: Spread = 0.0
    arm_sigma: Spread = 0.0
    thrust_stand: tuple[ThrustPoint, ...] = ()
    rotors: tuple[Rotor, ...] = Field(min_length=3, max_length=MOST_ROTORS)
    command: Command = Command()
    parameters: dict[str, ParameterPrior]
    effects: dict[str, dict[str, Coordinate]] = Field(default_factory=dict)
    reference_voltage: PositiveFloat | None = None
    noise: Noise = Noise()
    stabiliser: Stabiliser | None = None
    mounting: Mounting = Mounting()
    columns: dict[str, str] = Field(default_factory=dict, max_length=64)
    mixer: str | tuple[tuple[Coordinate, ...], ...] | None = None
    residual: tuple[ResidualTerm, ...] = Field(default=(), max_length=MOST_TERMS)
    random: RandomForces | None = None
    correlation: dict[str, dict[str, Correlation]] = Field(default_factory=dict)
    proof: Proof | None = None
    _remark: str = PrivateAttr("")
    _file: str = PrivateAttr("")

    @field_validator("parameters", mode="before")
    @classmethod
    def _bare_numbers(cls, value: Any) -> Any:
        if not isinstance(value, dict):
            raise ValueError("parameters must map b, d, J_xx, J_yy, J_zz, J_r to numbers")
        for key in value:
            if key not in NOMINAL_NAMES:
                raise ValueError(f"unknown parameter '{key}'; {nearest(str(key), NOMINAL_NAMES)}")
        missing = [name for name in NOMINAL_NAMES if name not in value]
        if missing:
            raise ValueError(f"parameters lack {', '.join(missing)}; add an initial guess for each")
        return {k: v if isinstance(v, dict | ParameterPrior) else {"initial": v} for k, v in value.items()}

    @field_validator("correlation", mode="after")
    @classmethod
    def _known_pairs(cls, value: dict[str, dict[str, float]]) -> dict[str, dict[str, float]]:
        for name in (n for one, others in value.items() for n in (one, *others)):
            if name not in NOMINAL_NAMES:
                raise ValueError(f"unknown parameter '{name}'; {nearest(name, NOMINAL_NAMES)}")
        if own := [name for name, others in value.items() if name in others]:
            raise ValueError(f"{own[0]} beside itself, which is always 1; leave that entry out")
        return value

    @field_validator("effects", mode="before")
    @classmethod
    def _known_effects(cls, value: Any) -> Any:
        if not isinstance(value or {}, dict):
            raise ValueError("effects must map names of effects to their parameters, as {motor_lag: {tau: 0.03}}")
        for name, numbers in (value or {}).items():
            if name not in EFFECTS:
                raise ValueError(f"unknown effect '{name}'; {nearest(str(name), EFFECTS)}")
            known = known_keys(name, MOST_ROTORS)
            if not isinstance(numbers, dict):
                raise ValueError(f"effect '{name}' needs its parameters, for example {{{known[0]}: ...}}")
            for key, number in numbers.items():
                if key not in known:
                    raise ValueError(f"effect '{name}' has no parameter '{key}'; {nearest(str(key), known)}")
                if not isinstance(number, int | float) or math.isnan(number):
                    raise ValueError(f"effect '{name}': {key} = {number!r} is not a number")
        return value or {}

    @model_validator(mode="before")
    @classmethod
    def _lever_arm(cls, value: Any) -> Any:
        """The position of the IMU is the effect `imu_lever_arm`, which the file may not give twice."""
        mounting = value.get("mounting") if isinstance(value, dict) else None
        place = mounting.get("position") if isinstance(mounting, dict) else None
        effects = value.get("effects") or {} if place else {}
        if not place or not isinstance(effects, dict) or not isinstance(place, list | tuple) or len(place) != 3:
            return value
        arm = dict(zip("xyz", place, strict=True))
        if effects.get("imu_lever_arm", arm) != arm:
            raise ValueError("mounting.position and effects.imu_lever_arm differ; keep one of them")
        return {**value, "effects": {**effects, "imu_lever_arm": arm}}

    @model_validator(mode="after")
    def _physical(self) -> Vehicle:
        low, high = self.parameters["b"].limits
        slip = impossible_size(self.mass, self.arm) or impossible_hover(self.hover_speed(high), self.hover_speed(low))
        if slip:
            raise ValueError(slip)
        try:
            rotor_drag_losses(self.effects.get("weak_rotor", {}), len(self.rotors))
            self._check_effects()
        except ParameterError as error:
            raise ValueError(str(error)) from error
        if (lever := self.parameters["d"].initial / self.parameters["b"].initial) > self.arm:
            raise ValueError(
                f"d / b, drag torque over thrust of a rotor, is {lever:.3g} m, beyond the arm of {self.arm:.3g} m: "
                "are b and d exchanged, or one over rpm^2?"
            )
        if why := impossible_inertia([self.parameters[n].initial for n in INERTIAS]):
            raise ValueError(f"impossible inertia: {why}")
        small, large = (share * self.mass * self.arm**2 for share in INERTIA_SHARE)
        for name in INERTIAS[:2]:
            least, most = self.parameters[name].limits
            if least > 4.0 * large or most < 0.2 * small:
                raise ValueError(
                    f"impossible inertia: {name} is {least:.3g} to {most:.3g}, but {self.mass:g} kg with rotors "
                    f"{self.arm:.3g} m from the centre have {small:.2g} to {large:.2g} kg m^2; "
                    "is it in g m^2, kg cm^2 or g cm^2?"
                )
        for name, sigma, size in (("mass", self.mass_sigma, self.mass), ("arm", self.arm_sigma, self.arm)):
            if sigma >= size:
                raise ValueError(f"{name}_sigma {sigma:g} is no less than the {name}, {size:.3g}; give one sigma in SI")
        if self.stand_thrust is not None and not low < self.stand_thrust[0] < high:
            raise ValueError(
                f"thrust_stand yields b = {self.stand_thrust[0]:.3g}, outside its bounds [{low:.3g}, {high:.3g}]; "
                "check rad/s and N, one rotor a reading"
            )
        if isinstance(self.mixer, str) and self.mixer not in MIXERS:
            raise ValueError(f"no mixer '{self.mixer}'; {nearest(self.mixer, MIXERS)}, or write its matrix")
        if self.mixer is not None and self.mixing.shape[0] != len(self.rotors):
            raise ValueError(f"mixer with {self.mixing.shape[0]} rows for {len(self.rotors)} rotors; one row a rotor")
        arms = self.rotor_positions[:, :2]
        if np.linalg.svd(arms - arms.mean(axis=0), compute_uv=False)[-1] < 1e-4:
            raise ValueError(
                "all rotors lie on one line: roll and pitch cannot both be controlled; check positions [m]"
            )
        if np.ptp(self.spins) == 0.0:
            raise ValueError("all rotors spin the same way: yaw cannot be balanced; use both +1 and -1")
        return self

    def _check_effects(self) -> None:
        """Refuses numbers beyond the catalogue's bounds for any vehicle of this size that the priors allow.

        Raises:
            ParameterError: with entry, value and range.
        """
        # A fit moves the guesses that give its box, within their bounds: so these, in which every fitted value lies.
        most = {name: prior.limits[1] for name, prior in self.parameters.items()}
        scales = self.scales(most | {"b": self.parameters["b"].limits[0]})
        scales["rotor_inertia"] = max(scales["rotor_inertia"], most["J_zz"] / 1.5e-2)  # a fitted J_r may vanish
        for name, numbers in self.effects.items():
            for key, value in numbers.items():
                # Bounds are those of the parameter vector, where a number may be counted from another one.
                plain_key, _, rotor = key.partition("loss_")
                p = EFFECTS[name].parameter(f"{plain_key}loss" if rotor else key)
                beside = f"{p.beside}_{rotor}" if p.beside and rotor else p.beside
                low, high = (numbers.get(beside, 0.0) + bound * scales[p.scale] for bound in (p.lower, p.upper))
                inside = low <= value <= high or any(math.isclose(value, end, rel_tol=1e-4) for end in (low, high))
                if not (inside or value == p.neutral or p.name == "time"):  # files round, and times are of any clock
                    allowed = f"{low:.3g} to {high:.3g}{p.unit and ' '}{p.unit} on a vehicle of this size"
                    raise ParameterError(f"effects.{name}.{key} = {value:g}", allowed)

    def scales(self, at: Mapping[str, float]) -> dict[Scale, float]:
        """Factors from the sizes in the table of effects, a Pelican's, to this airframe's with parameters `at`."""
        return {
            "": 1.0,
            "arm": float(np.max(np.linalg.norm(self.rotor_positions[:, :2], axis=1))) / 0.21,
            "inertia": at["J_xx"] / 8e-3,
            "rotor_inertia": at["J_r"] / 3e-5,
            "hover_speed": self.hover_speed(at["b"]) / 400.0,
            "rotor_weight": self.mass * GRAVITY / len(self.rotors) / 3.2,
        }

    @property
    def mixing(self) -> FloatArray:
        """Mixer matrix, shape (rotors, inputs): command of each rotor = matrix x mixer input; raises VehicleError."""
        if self.mixer is None:
            raise VehicleError(f"'{self.name}' has no mixer", "mixer: a name or a matrix", "add it to the vehicle file")
        rows = MIXERS[self.mixer] if isinstance(self.mixer, str) else self.mixer
        if len({len(row) for row in rows}) != 1:
            raise ValueError("mixer with rows of different lengths; one number an input in every row")
        return np.array(rows, dtype=np.float64)

    @property
    def rotor_positions(self) -> FloatArray:
        """Shape (rotors, 3) [m], FRD."""
        return np.array([r.position for r in self.rotors])

    @property
    def spins(self) -> FloatArray:
        """Shape (rotors,), +1 or -1."""
        return np.array([float(r.spin) for r in self.rotors])

    @property
    def torque_arms(self) -> FloatArray:
        """Roll and pitch torque over thrust, which acts along -z, and yaw torque over drag, shape (rotors, 3)."""
        x, y, _ = self.rotor_positions.T
        return np.column_stack([-y, x, self.spins])

    @property
    def arm(self) -> float:
        """Mean horizontal distance of the rotors from the geometric centre [m]."""
        return float(np.mean(np.linalg.norm(self.rotor_positions[:, :2], axis=1)))

    @property
    def stand_thrust(self) -> tuple[float, float] | None:
        """Thrust coefficient [N s^2/rad^2] and its relative standard deviation from the thrust stand, or None.

        Least squares of thrust / speed^2 with equal relative errors; a stand is never trusted below `STAND_ERROR`.
        """
        if not self.thrust_stand:
            return None
        logs = np.log([p.thrust / p.speed**2 for p in self.thrust_stand])
        spread = float(np.std(logs, ddof=1) / math.sqrt(len(logs))) if len(logs) > 1 else 0.0
        return float(np.exp(np.mean(logs))), max(spread, STAND_ERROR)

    @property
    def initial(self) -> FloatArray:
        """Initial guess of (b, d, J_xx, J_yy, J_zz, J_r), shape (6,)."""
        return np.array([self.parameters[n].initial for n in NOMINAL_NAMES])

    @property
    def covariance(self) -> FloatArray:
        """Covariance of the six by their sigmas and correlations, shape (6, 6); zero where there is no sigma."""
        sigma = np.array([self.parameters[n].sigma or 0.0 for n in NOMINAL_NAMES])
        out = np.diag(sigma**2)
        for one, others in self.correlation.items():
            for other, value in others.items():
                i, j = NOMINAL_NAMES.index(one), NOMINAL_NAMES.index(other)
                out[i, j] = out[j, i] = value * sigma[i] * sigma[j]
        return out

    @property
    def bounds(self) -> FloatArray:
        """Search range of the six: the file's bounds, else a factor of 4 each way, shape (6, 2)."""
        return np.array([self.parameters[n].limits for n in NOMINAL_NAMES])

    def limits(self, name: str) -> tuple[float, float]:
        """Bounds of a nominal parameter in a fit: those of the file, else a factor of 4 each way; J_r may vanish."""
        given = self.parameters[name]
        low, high = given.limits
        return (VANISHED * given.initial if name == MAY_VANISH and given.bounds is None else low), high

    def hover_speed(self, b: float | None = None) -> float:
        """Rotor speed [rad/s] at which thrust equals weight, for thrust coefficient `b` (default: initial guess)."""
        coefficient = self.parameters["b"].initial if b is None else b
        return math.sqrt(self.mass * GRAVITY / (coefficient * len(self.rotors)))

    @classmethod
    def from_yaml(cls, text: str, origin: str = "vehicle file") -> Vehicle:
        """Parses a vehicle file.

        Args:
            text: YAML of `docs/contract` form.
            origin: name used in errors.

        Raises:
            VehicleError: with the key, what is allowed, and the nearest valid one.
        """
        raw = read_mapping(text, origin, "a mapping with name, mass, rotors, parameters")
        try:
            return cls.model_validate(raw)
        except ValidationError as error:
            problem, fix = _first_problem(error)
            raise VehicleError(f"{origin}: {problem}", fix=fix) from error

    @staticmethod
    def shipped_texts() -> dict[str, str]:
        """Files of the vehicles that ship, by name, sorted."""
        folder = resources.files("quadid") / "vehicles"
        names = sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".yaml"))
        return {name: (folder / f"{name}.yaml").read_text(encoding="utf-8") for name in names}

    @classmethod
    def shipped(cls, name: str) -> Vehicle:
        """Loads a shipped vehicle by name; raises VehicleError naming the nearest one."""
        texts = cls.shipped_texts()
        if name not in texts:
            raise VehicleError(
                f"no shipped vehicle '{name}'", ", ".join(texts) + ", or a YAML file", nearest(name, list(texts))
            )
        return cls.from_yaml(texts[name], f"{name}.yaml")

    @classmethod
    def named(cls, given: str | Path | Vehicle) -> Vehicle:
        """Loads a vehicle file, or the shipped vehicle of that name; of a vehicle, the vehicle itself.

        Raises:
            VehicleError: no such file or name, or a file that describes no vehicle.
        """
        if isinstance(given, Vehicle):
            return given
        name, path = str(given), Path(given)
        looks_like_file = path.suffix.lower() in (".yaml", ".yml") or "/" in name
        if not looks_like_file and not path.is_file() and (name in cls.shipped_texts() or not path.is_dir()):
            return cls.shipped(name)
        if path.is_dir():
            raise VehicleError(f"{name} is a directory", "a shipped name or a YAML file", "name the file in it")
        try:
            text = read_regular(path).decode("utf-8")
        except FileNotFoundError as error:
            raise VehicleError(f"no vehicle file {name}", "a shipped name or a YAML file", "check the path") from error
        except OSError as error:
            raise VehicleError(f"{name} cannot be read ({error.strerror})", fix="check its permissions") from error
        except UnicodeDecodeError as error:
            raise VehicleError(f"{name}: not text", "a YAML file", "if this is the log, pass it as LOG") from error
        if blanks := to_fill_in(text):
            raise VehicleError(
                f"{name}: {' and '.join(blanks)} {'is a guess' if len(blanks) == 1 else 'are guesses'} of "
                f"`quadid init`, marked {_FILL_IN}",
                "measured values",
                f"write your vehicle's and delete the words {_FILL_IN}",
            )
        out = cls.from_yaml(text, path.name)
        out._file = name
        return out

    @property
    def label(self) -> str:
        """The file that it was read from, as it was named; without one, its own name."""
        return self._file or self.name

    def to_yaml(self) -> str:
        """Writes the vehicle as YAML that `from_yaml` reads back."""
        data = self.model_dump(mode="json", exclude_none=True)
        for name in ("mass_sigma", "arm_sigma", "thrust_stand", "residual", "columns", "correlation"):
            if not data[name]:
                del data[name]
        if self.mounting == Mounting():
            del data["mounting"]
        head = "".join(f"# {plain(line, LONGEST_LINE)}\n" for line in self._remark.splitlines())
        return head + str(yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120))

    def with_remark(self, remark: str) -> Vehicle:
        """The same vehicle with lines that head its file as comments: where its values come from."""
        out = self.model_copy()
        out._remark = remark
        return out

    def save(self, path: str | Path) -> Path:
        """Writes the vehicle file; returns its absolute path."""
        target = Path(path).absolute()
        with written_whole(target) as part:
            part.write_text(self.to_yaml(), encoding="utf-8")
        return target


def to_fill_in(text: str) -> list[str]:
    """Keys of a file of `quadid init` that its user has yet to write."""
    return [line.split(":")[0].strip(" -#") for line in text.splitlines() if _FILL_IN in line]


def mixer_matrix(vehicle: Vehicle, gains: Mapping[str, float]) -> FloatArray:
    """Pseudo-inverse of the geometry: (thrust [N], roll, pitch, yaw torque [N m]) to omega^2, shape (rotors, 4)."""
    b, d = gains["thrust_coefficient"], gains["drag_coefficient"]
    effect = np.vstack([np.ones(len(vehicle.rotors)), vehicle.torque_arms.T]) * [[b], [b], [b], [d]]
    return np.ascontiguousarray(np.linalg.pinv(effect))


def _first_problem(error: ValidationError) -> tuple[str, str]:
    """First problem of a file, and what to do about it."""
    details = error.errors()
    detail = next((d for d in details if d["type"] == "extra_forbidden"), details[0])  # a slip explains what is missing
    place = ".".join(str(part) for part in detail["loc"])
    if detail["type"] == "missing":
        return f"no '{place}'", "add it, as docs/new-vehicle.md shows"
    problem = detail["msg"].removeprefix("Value error, ")
    if detail["type"] == "extra_forbidden":
        problem = f"unknown key '{place}'; {nearest(str(detail['loc'][-1]), _valid_keys(detail['loc'][:-1]))}"
    elif place:
        problem = f"{place}: {problem} (found {detail['input']!r:.60})"
    return problem, "correct that entry"


def _valid_keys(path: tuple[int | str, ...]) -> list[str]:
    models: dict[str, type[BaseModel]] = {
        "rotors": Rotor,
        "thrust_stand": ThrustPoint,
        "mounting": Mounting,
        "command": Command,
        "parameters": ParameterPrior,
        "noise": Noise,
        "stabiliser": Stabiliser,
        "proof": Proof,
        "random": RandomForces,
    }
    model = models.get(str(path[0]), Vehicle) if path else Vehicle
    model = RandomInput if model is RandomForces and len(path) > 1 else model
    return list(model.model_fields)
