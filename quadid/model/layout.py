"""One vector for everything: the paper's six parameters, then every effect parameter at its neutral value.

The kernel reads this vector by index, people read it by name.  Extending a model frees more entries of the same
vector, so models nest exactly and one kernel serves all.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.effects import EFFECTS, rotor_losses
from quadid.errors import ParameterError, nearest
from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS
from quadid.vehicle import Vehicle

FloatArray = NDArray[np.float64]

(
    B, D, JXX, JYY, JZZ, JR, TAU, DELAY, IMU_PERIOD, ATT_DELAY, KX, KY, CPAR, HX, HY, LP, MQ, KZ, WN, WE,
    CGX, CGY, MASS_TIME, MASS_FRACTION, DROP_TIME, DROP_FRACTION, SAG, DEAD_SPEED, JXY, JXZ, JYZ, JSPIN,
    GBX, GBY, GBZ, ABX, ABY, ABZ, GSX, GSY, GSZ, MAX_, MAY, MAZ, LAX, LAY, LAZ, AHRS_K, GROUND, LOSS,
) = range(50)  # fmt: skip
"""Indices into the vector; rotor i (from 0) has its loss at LOSS + i."""

_EFFECT_INDEX: dict[str, int] = {
    "motor_lag.tau": TAU,
    "command_delay.delay": DELAY,
    "imu_lag.period": IMU_PERIOD,
    "attitude_delay.delay": ATT_DELAY,
    "rotor_drag.k_x": KX,
    "rotor_drag.k_y": KY,
    "parasitic_drag.c": CPAR,
    "rotor_drag_moment.h_x": HX,
    "rotor_drag_moment.h_y": HY,
    "rate_damping.l_p": LP,
    "rate_damping.m_q": MQ,
    "axial_inflow.k_z": KZ,
    "wind.north": WN,
    "wind.east": WE,
    "cg_offset.x": CGX,
    "cg_offset.y": CGY,
    "mass_change.time": MASS_TIME,
    "mass_change.fraction": MASS_FRACTION,
    "thrust_drop.time": DROP_TIME,
    "thrust_drop.fraction": DROP_FRACTION,
    "battery_sag.fraction": SAG,
    "thrust_curve.dead_speed": DEAD_SPEED,
    "product_of_inertia.J_xy": JXY,
    "product_of_inertia.J_xz": JXZ,
    "product_of_inertia.J_yz": JYZ,
    "rotor_spin_up.J": JSPIN,
    "gyro_bias.x": GBX,
    "gyro_bias.y": GBY,
    "gyro_bias.z": GBZ,
    "accel_bias.x": ABX,
    "accel_bias.y": ABY,
    "accel_bias.z": ABZ,
    "gyro_scale.x": GSX,
    "gyro_scale.y": GSY,
    "gyro_scale.z": GSZ,
    "imu_misalignment.x": MAX_,
    "imu_misalignment.y": MAY,
    "imu_misalignment.z": MAZ,
    "imu_lever_arm.x": LAX,
    "imu_lever_arm.y": LAY,
    "imu_lever_arm.z": LAZ,
    "ahrs_acceleration_error.k": AHRS_K,
    "ground_effect.radius_scale": GROUND,
}

IMU_PERIOD_UNIT = "s"
NEVER = 1e9
"""Stands for "no change in this log" in the times of mass_change and thrust_drop [s]."""


@dataclass(frozen=True)
class Entry:
    """One entry of the vector: dotted name, index, unit, neutral value, bounds, typical size."""

    name: str
    index: int
    unit: str
    neutral: float
    lower: float
    upper: float
    typical: float


class Layout:
    """Names and indices of the full parameter vector of one vehicle.

    Attributes:
        entries: by dotted name, for example ``b`` or ``rotor_drag.k_x``; rotor i from 1 is ``weak_rotor.loss_i``.
        size: length of the vector.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Lays out the vector for `vehicle`; its scale (arm, weight, inertia) sets bounds and typical sizes."""
        self.rotors = len(vehicle.rotors)
        self.size = LOSS + self.rotors
        scale = _scales(vehicle)
        entries: list[Entry] = []
        for index, name in enumerate(NOMINAL_NAMES):
            low, high = vehicle.parameters[name].limits
            entries.append(
                Entry(name, index, NOMINAL_UNITS[name], math.nan, low, high, vehicle.parameters[name].initial)
            )
        for dotted, index in _EFFECT_INDEX.items():
            entries.append(_effect_entry(dotted, index, scale))
        loss = EFFECTS["weak_rotor"].parameter("loss")
        entries.extend(
            Entry(f"weak_rotor.loss_{i + 1}", LOSS + i, "", 0.0, loss.lower, loss.upper, loss.typical)
            for i in range(self.rotors)
        )
        self.entries = {e.name: e for e in entries}

    def entry(self, name: str) -> Entry:
        """Returns the entry called `name`; raises ParameterError with the nearest valid name."""
        if name not in self.entries:
            raise ParameterError(f"unknown parameter '{name}'", fix=nearest(name, self.entries))
        return self.entries[name]

    def indices(self, names: list[str] | tuple[str, ...]) -> NDArray[np.intp]:
        """Returns the vector indices of `names`."""
        return np.array([self.entry(n).index for n in names], dtype=np.intp)

    def neutral(self) -> FloatArray:
        """Returns a vector with every effect neutral and the six nominal entries NaN, shape (size,)."""
        theta = np.zeros(self.size)
        for entry in self.entries.values():
            theta[entry.index] = entry.neutral
        return theta

    def initial(self, vehicle: Vehicle) -> FloatArray:
        """Returns the vehicle file's initial guess with its known effects, shape (size,)."""
        theta = self.neutral()
        theta[: len(NOMINAL_NAMES)] = vehicle.initial
        self.write_effects(theta, vehicle.effects)
        return theta

    def write_effects(self, theta: FloatArray, effects: Mapping[str, Mapping[str, float]]) -> None:
        """Writes effects, as in a vehicle file, into `theta` in place; missing numbers stay neutral."""
        for name, numbers in effects.items():
            if name == "weak_rotor":
                theta[LOSS : LOSS + self.rotors] = rotor_losses(numbers, self.rotors)
            elif name == "imu_lag":
                cutoff = numbers.get("cutoff", math.inf)
                if not cutoff > 0.0:
                    raise ParameterError(f"imu_lag: cutoff {cutoff} Hz", "a positive frequency")
                theta[IMU_PERIOD] = 1.0 / cutoff
            else:
                for key, value in numbers.items():
                    theta[self.entry(f"{name}.{key}").index] = min(value, NEVER)

    def read_effect(self, theta: FloatArray, name: str) -> dict[str, float]:
        """Reads one effect back in the vehicle file's form (cutoff in Hz, rotors numbered from 1)."""
        if name == "weak_rotor":
            losses = theta[LOSS : LOSS + self.rotors]
            if np.count_nonzero(losses) > 1:
                return {f"loss_{i + 1}": float(losses[i]) for i in np.flatnonzero(losses)}
            rotor = int(np.argmax(np.abs(losses)))
            return {"rotor": rotor + 1, "loss": float(losses[rotor])}
        if name == "imu_lag":
            period = float(theta[IMU_PERIOD])
            return {"cutoff": 1.0 / period if period > 0.0 else math.inf}
        return {p.name: float(theta[_EFFECT_INDEX[f"{name}.{p.name}"]]) for p in EFFECTS[name].parameters}


@dataclass(frozen=True)
class _Scales:
    arm: float
    inertia: float
    rotor_inertia: float
    hover_speed: float


def _scales(vehicle: Vehicle) -> _Scales:
    arm = float(np.max(np.linalg.norm(vehicle.rotor_positions[:, :2], axis=1)))
    p = vehicle.parameters
    return _Scales(arm, p["J_xx"].initial, p["J_r"].initial, vehicle.hover_speed())


def _effect_entry(dotted: str, index: int, scale: _Scales) -> Entry:
    effect, key = dotted.split(".")
    if effect == "imu_lag":
        return Entry(dotted, index, IMU_PERIOD_UNIT, 0.0, 0.0, 1.0, 0.03)
    spec = EFFECTS[effect].parameter(key)
    neutral, low, high, typical = spec.neutral, spec.lower, spec.upper, spec.typical
    if key == "time":
        return Entry(dotted, index, "s", NEVER, -NEVER, NEVER, 1.0)
    # The table's sizes are those of a Pelican; other airframes scale with arm, inertia and hover speed.
    factor = {
        "cg_offset": scale.arm / 0.21,
        "imu_lever_arm": scale.arm / 0.21,
        "rotor_drag_moment": scale.arm / 0.21,
        "product_of_inertia": scale.inertia / 8e-3,
        "rotor_spin_up": scale.rotor_inertia / 3e-5,
        "thrust_curve": scale.hover_speed / 400.0,
    }.get(effect, 1.0)
    return Entry(dotted, index, spec.unit, neutral, low * factor, high * factor, typical * factor)
