"""Layout of the parameter vector: the paper's six parameters, then every effect parameter at its neutral value."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from copy import copy
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS, NEVER, Effect, EffectParameter, Scale, parameter_of, rotor_drag_losses, rotor_losses
from quadid.errors import ParameterError, WindowError, nearest
from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS
from quadid.types import FloatArray, IntArray
from quadid.vehicle import MOST_FACTORS, SIGNALS, TARGETS, Vehicle

# --- One vector for everything: the paper's six parameters, then every effect parameter at its neutral value
#
# The kernel reads this vector by index, people read it by name.  Extending a model frees more entries of the same
# vector, so models nest exactly and one kernel serves all.


B, D, JXX, JYY, JZZ, JR = range(6)
_ENTRIES: tuple[tuple[str, Effect, EffectParameter], ...] = tuple(
    (f"{e.name}.{p.entry or p.name}", e, p) for e in EFFECTS.values() if e.name != "weak_rotor" for p in e.parameters
)
_INDEX = {dotted: len(NOMINAL_NAMES) + i for i, (dotted, _, _) in enumerate(_ENTRIES)}
LOSS = len(NOMINAL_NAMES) + len(_ENTRIES)
"""Rotor i (from 0) has its loss at LOSS + i, and at LOSS + rotors + i what its drag torque loses beyond."""


def places(*effects: str) -> tuple[int, ...]:
    """Indices of all entries of these effects, or of single entries (``mass_change.time``), in the given order."""
    return tuple(i for e in effects for name, i in _INDEX.items() if e in (name, name.split(".")[0]))


TAU, SLOWER = places("motor_lag")
(TELEMETRY,) = places("rotor_telemetry_delay")
(EXPONENT,) = places("supply_voltage.exponent")
(DELAY,) = places("command_delay")
(IMU_PERIOD,) = places("imu_lag")
(ATT_DELAY,) = places("attitude_delay")
KX, KY, DRAG_CENTRAL = places("rotor_drag")
(CPAR,) = places("parasitic_drag.c")
HX, HY = places("rotor_drag_moment")
LP, MQ, NR = places("rate_damping")
KZ, KCLIMB, FLOW_CENTRAL = places("axial_inflow")
WN, WE = places("wind")
CGX, CGY = places("cg_offset")
MASS_TIME, MASS_FRACTION, *_ = places("mass_change")
DROP_TIME, DROP_FRACTION = places("thrust_drop")
(SAG,) = places("battery_sag")
DEAD_SPEED, OFFSET = places("thrust_curve")
JXY, JXZ, JYZ = places("product_of_inertia")
(JSPIN,) = places("rotor_spin_up")
GBX, GBY, GBZ = places("gyro_bias")
ABX, ABY, ABZ = places("accel_bias")
GSX, GSY, GSZ = places("gyro_scale")
MAX_, MAY, MAZ = places("imu_misalignment")
LAX, LAY, LAZ = places("imu_lever_arm")
(AHRS_K,) = places("ahrs_acceleration_error")
(GROUND,) = places("ground_effect")
VEL_SCALE, VEL_SCALE_Z = places("velocity_scale")


@dataclass(frozen=True)
class Entry:
    """One entry of the vector: dotted name, index, unit, neutral value, bounds, typical size, sign (see the table)."""

    name: str
    index: int
    unit: str
    neutral: float
    lower: float
    upper: float
    typical: float
    sign: int = 0


class Layout:
    """Names and indices of the full parameter vector of one vehicle.

    Attributes:
        entries: by dotted name, for example ``b`` or ``rotor_drag.k_x``; rotor i from 1 is ``weak_rotor.loss_i``.
        size: length of the vector.
    """

    def __init__(self, vehicle: Vehicle) -> None:
        """Lays out the vector for `vehicle`; its scale (arm, weight, inertia) sets bounds and typical sizes."""
        self.rotors = len(vehicle.rotors)
        self.size = LOSS + 2 * self.rotors + len(vehicle.residual)
        scale = vehicle.scales({name: p.initial for name, p in vehicle.parameters.items()})
        entries: list[Entry] = []
        for index, name in enumerate(NOMINAL_NAMES):
            low, high = vehicle.limits(name)
            entries.append(
                Entry(name, index, NOMINAL_UNITS[name], math.nan, low, high, vehicle.parameters[name].initial)
            )
        for dotted, _, parameter in _ENTRIES:
            entries.append(_effect_entry(dotted, parameter, scale))
        for k, key in enumerate(("loss", "drag_loss")):
            p = EFFECTS["weak_rotor"].parameter(key)
            entries.extend(
                Entry(
                    f"weak_rotor.{p.entry or key}_{i + 1}",
                    LOSS + k * self.rotors + i,
                    "",
                    0.0,
                    p.lower,
                    p.upper,
                    p.typical,
                    p.sign,
                )
                for i in range(self.rotors)
            )
        entries.extend(
            Entry(f"residual.{i + 1}", LOSS + 2 * self.rotors + i, term.unit, 0.0, -math.inf, math.inf, 1.0)
            for i, term in enumerate(vehicle.residual)
        )
        self.entries = {e.name: e for e in entries}

    def entry(self, name: str) -> Entry:
        """Returns the entry called `name`; raises ParameterError with the nearest valid name."""
        if name not in self.entries:
            raise ParameterError(f"unknown parameter '{name}'", fix=nearest(name, self.entries))
        return self.entries[name]

    def neutral(self) -> FloatArray:
        """Returns a vector with every effect neutral and the six nominal entries NaN, shape (size,)."""
        theta = np.zeros(self.size)
        for entry in self.entries.values():
            theta[entry.index] = entry.neutral
        return theta

    def without(self, theta: FloatArray, names: Iterable[str]) -> FloatArray:
        """Returns a copy of `theta`, shape (size,), with these entries neutral."""
        out = theta.copy()
        for entry in map(self.entry, names):
            out[entry.index] = entry.neutral
        return out

    def initial(self, vehicle: Vehicle) -> FloatArray:
        """Returns the vehicle file's initial guess with its known effects, shape (size,)."""
        theta = self.neutral()
        theta[: len(NOMINAL_NAMES)] = vehicle.initial
        self.write_effects(theta, vehicle.effects)
        theta[LOSS + 2 * self.rotors :] = [term.value for term in vehicle.residual]
        return theta

    def write_effects(self, theta: FloatArray, effects: Mapping[str, Mapping[str, float]]) -> None:
        """Writes effects, as in a vehicle file, into `theta` in place; missing numbers stay neutral."""
        for name, numbers in effects.items():
            if name == "weak_rotor":
                losses = np.array(rotor_losses(numbers, self.rotors))
                theta[LOSS : LOSS + self.rotors] = losses
                theta[LOSS + self.rotors : LOSS + 2 * self.rotors] = (
                    np.array(rotor_drag_losses(numbers, self.rotors)) - losses
                )
            elif name == "imu_lag":
                cutoff = numbers.get("cutoff", math.inf)
                if not cutoff > 0.0:
                    raise ParameterError(f"imu_lag: cutoff {cutoff} Hz", "a positive frequency")
                theta[IMU_PERIOD] = 1.0 / cutoff
            else:
                for key, value in numbers.items():
                    p = parameter_of(name, key)
                    base = numbers.get(p.beside, 0.0)
                    theta[self.entry(f"{name}.{p.entry or key}").index] = min(value - base, NEVER)

    def read_effect(self, theta: FloatArray, name: str) -> dict[str, float]:
        """Reads one effect back in the vehicle file's form (cutoff in Hz, rotors numbered from 1).

        Optional numbers are there where they are not neutral.
        """
        if name == "weak_rotor":
            return self._read_rotors(theta)
        if name == "imu_lag":
            period = float(theta[IMU_PERIOD])
            return {"cutoff": 1.0 / period if period > 0.0 else math.inf}
        out: dict[str, float] = {}
        for p in EFFECTS[name].parameters:
            value = float(theta[_INDEX[f"{name}.{p.entry or p.name}"]])
            if not p.optional or value != p.neutral:
                out[p.name] = out.get(p.beside, 0.0) + value
        return out

    def _read_rotors(self, theta: FloatArray) -> dict[str, float]:
        losses, extra = theta[LOSS : LOSS + self.rotors], theta[LOSS + self.rotors : LOSS + 2 * self.rotors]
        weak = np.flatnonzero((losses != 0.0) | (extra != 0.0))
        if len(weak) > 1:
            out = {f"loss_{i + 1}": float(losses[i]) for i in weak}
            return out | {f"drag_loss_{i + 1}": float(losses[i] + extra[i]) for i in np.flatnonzero(extra)}
        rotor = int(weak[0]) if len(weak) else 0
        out = {"rotor": float(rotor + 1), "loss": float(losses[rotor])}
        return out | ({"drag_loss": float(losses[rotor] + extra[rotor])} if extra[rotor] else {})


def residual_terms(vehicle: Vehicle) -> IntArray:
    """Terms beyond the catalogue as numbers for the kernel, shape (terms, 4): target, three signals, 0 for none."""
    signals, targets = ["", *SIGNALS], list(TARGETS)
    rows = [
        [targets.index(t.acts_on), *(signals.index(x) for x in t.product), *[0] * (MOST_FACTORS - len(t.product))]
        for t in vehicle.residual
    ]
    return np.array(rows, dtype=np.int64).reshape(-1, 1 + MOST_FACTORS)


def _effect_entry(dotted: str, p: EffectParameter, scale: Mapping[Scale, float]) -> Entry:
    index = _INDEX[dotted]
    if index == IMU_PERIOD:
        return Entry(dotted, index, "s", 0.0, 0.0, 1.0, 0.03)
    if p.name == "time":
        return Entry(dotted, index, "s", NEVER, -NEVER, NEVER, 1.0)
    factor = scale[p.scale]
    return Entry(dotted, index, p.unit, p.neutral, p.lower * factor, p.upper * factor, p.typical * factor, p.sign)


# --- Thrust of the rotors by a full parameter vector


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

    def with_tangent(self, share: float, weight: float) -> ThrustModel:
        """The same where the rotors carry `weight` [N], and `share` times the slope there."""
        hover, other = self.hover_speed(weight), copy(self)
        other._b = self._b * share**2
        other._dead_speed = hover - (hover - self._dead_speed) / share
        return other

    @property
    def curve(self) -> tuple[float, float]:
        """B [N s^2/rad^2] and dead speed [rad/s]."""
        return self._b, self._dead_speed

    @property
    def at_rest(self) -> float:
        """Thrust [N] that the law has where nothing turns: no rotor has any, so it is a support, or a sensor's."""
        return float(self._share.sum()) * (self._b * min(self._dead_speed, 0.0) ** 2 + self._offset)

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


# --- The supply voltage that scales commands: relative to a reference, row by row


def voltage_at(times: FloatArray, t: FloatArray, volts: FloatArray) -> FloatArray | None:
    """Voltage at `times` [V], linear between readings `volts` at `t`; None where no reading is above zero."""
    good = np.isfinite(volts) & (volts > 0.0)
    return np.interp(times, t[good], volts[good]) if good.any() else None


def _voltage(window: Window) -> FloatArray | None:
    """Voltage at every row [V], shape (n,); None without any."""
    rows = np.arange(len(window), dtype=np.float64)
    return None if window.battery is None else voltage_at(rows, rows, np.ravel(window.battery))


def with_reference_voltage(vehicle: Vehicle, windows: Sequence[Window]) -> Vehicle:
    """`vehicle` with its reference voltage: its own, or the mean over `windows` where each of them has a voltage."""
    known = [_voltage(w) for w in windows]
    volts = [v for v in known if v is not None]
    if vehicle.reference_voltage is not None or not volts or len(volts) < len(known):
        return vehicle
    return vehicle.model_copy(update={"reference_voltage": float(np.mean(np.concatenate(volts)))})


def relative_voltage(window: Window, vehicle: Vehicle) -> FloatArray:
    """Logarithm of the supply voltage over the vehicle's reference at each row; 0 where either is not known.

    Raises:
        WindowError: the vehicle's rotors follow the voltage, and it is not known.
    """
    volts = _voltage(window)
    if vehicle.reference_voltage is not None and volts is not None:
        return np.asarray(np.log(volts / vehicle.reference_voltage))
    if vehicle.effects.get("supply_voltage", {}).get("exponent"):
        raise WindowError(
            f"{window.name or 'window'}: no supply voltage, which scales this vehicle's commands (supply_voltage)",
            "battery voltage in the log and reference_voltage in the vehicle file",
            "log the battery, or leave supply_voltage out",
        )
    return np.zeros(len(window))
