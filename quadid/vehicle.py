"""The vehicle: geometry, mass, command, initial parameters, known effects; read from and written as YAML text."""

from __future__ import annotations

import math
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from pydantic import BaseModel, Field, PrivateAttr, ValidationError, field_validator, model_validator

from quadid.effects import EFFECTS, known_keys, rotor_drag_losses
from quadid.errors import ParameterError, VehicleError, nearest
from quadid.parameters import INERTIAS, MAY_VANISH, NOMINAL_NAMES, VANISHED, impossible_inertia
from quadid.provenance import Proof
from quadid.residual import MOST_TERMS, ResidualTerm
from quadid.sanitise import LONGEST_LINE, LONGEST_NAME, plain
from quadid.types import FloatArray
from quadid.vehicle_parts import (
    MIXERS,
    Command,
    Coordinate,
    Mounting,
    Noise,
    ParameterPrior,
    PositiveFloat,
    Rotor,
    Spread,
    Stabiliser,
    Strict,
    ThrustPoint,
)  # fmt: skip
from quadid.vehicle_size import impossible_hover, impossible_size
from quadid.yaml_text import read_mapping

GRAVITY = 9.80665
"""Standard gravity [m/s^2]."""
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
        residual: forces and moments beyond the catalogue, of a file that predicts.
        mass_sigma: standard deviation of the mass [kg]; 0 takes it for exact.
        arm_sigma: standard deviation of the arm [m], common to all rotors; 0 takes positions for exact.
        proof: what shows that the values predict; None for values that nobody fitted.
        thrust_stand: readings that give b before any flight; take the place of its guess as prior.
    """

    name: str = Field(max_length=LONGEST_NAME)
    mass: PositiveFloat
    mass_sigma: Spread = 0.0
    arm_sigma: Spread = 0.0
    thrust_stand: tuple[ThrustPoint, ...] = ()
    rotors: tuple[Rotor, ...] = Field(min_length=3, max_length=MOST_ROTORS)
    command: Command = Command()
    parameters: dict[str, ParameterPrior]
    effects: dict[str, dict[str, float]] = Field(default_factory=dict)
    reference_voltage: float | None = Field(default=None, gt=0.0)
    noise: Noise = Noise()
    stabiliser: Stabiliser | None = None
    mounting: Mounting = Mounting()
    columns: dict[str, str] = Field(default_factory=dict, max_length=64)
    mixer: str | tuple[tuple[Coordinate, ...], ...] | None = None
    residual: tuple[ResidualTerm, ...] = Field(default=(), max_length=MOST_TERMS)
    proof: Proof | None = None
    _remark: str = PrivateAttr("")

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
        except ParameterError as error:
            raise ValueError(str(error)) from error
        if why := impossible_inertia([self.parameters[n].initial for n in INERTIAS]):
            raise ValueError(f"impossible inertia: {why}")
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
    def bounds(self) -> FloatArray:
        """Where to look for the six: the file's bounds, else a factor of 4 each way, shape (6, 2)."""
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

    @classmethod
    def shipped(cls, name: str) -> Vehicle:
        """Loads a shipped vehicle by name; raises VehicleError naming the nearest one."""
        folder = resources.files("quadid") / "vehicles"
        names = sorted(p.name[:-5] for p in folder.iterdir() if p.name.endswith(".yaml"))
        if name not in names:
            raise VehicleError(
                f"no shipped vehicle '{name}'", ", ".join(names) + ", or a YAML file", nearest(name, names)
            )
        return cls.from_yaml((folder / f"{name}.yaml").read_text(encoding="utf-8"), f"{name}.yaml")

    def to_yaml(self) -> str:
        """Writes the vehicle as YAML that `from_yaml` reads back."""
        data = self.model_dump(mode="json", exclude_none=True)
        for name in ("mass_sigma", "arm_sigma", "thrust_stand", "residual", "columns"):
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
        target.write_text(self.to_yaml(), encoding="utf-8")
        return target


def _first_problem(error: ValidationError) -> tuple[str, str]:
    """What is wrong first of all, and what to do about it."""
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
        "rotors": Rotor, "thrust_stand": ThrustPoint, "mounting": Mounting,
        "command": Command, "parameters": ParameterPrior, "noise": Noise, "stabiliser": Stabiliser, "proof": Proof,
    }  # fmt: skip
    model = models.get(str(path[0]), Vehicle) if path else Vehicle
    return list(model.model_fields)
