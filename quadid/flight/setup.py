"""Preparation of a flight: true numbers, drawn effects, and everything a flight is made of."""

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np

from quadid.effects import EFFECTS, known_keys, rotor_drag_losses, rotor_losses
from quadid.errors import ParameterError, nearest
from quadid.flight.airframe import Air, Body, Drive, Oddity
from quadid.flight.loop import NO_TIME, Events, OnBoard
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- The numbers the flown vehicle really has; an identification tries to find them


TABLE_2 = {"b": 2.33e-5, "d": 4.96e-7, "J_xx": 1.00e-2, "J_yy": 1.36e-2, "J_zz": 2.92e-2, "J_r": 5.00e-5}
"""The paper's identified Pelican (Table 2), SI."""
PELICANS = ("pelican", "pelican_x")


@dataclass(frozen=True)
class TruthParameters:
    """True physical parameters of a flown vehicle, SI.  The default is the paper's Pelican (Table 2).

    Attributes:
        b: thrust coefficient [N s^2/rad^2], f = b omega^2 (Eq. 3).
        d: drag torque coefficient [N m s^2/rad^2], tau = d omega^2 (Eq. 4).
        J_xx, J_yy, J_zz: moments of inertia about the CG, body FRD [kg m^2].
        J_r: moment of inertia of one rotor about its axis [kg m^2].
        mass: vehicle mass [kg].
        payload_arm: distance below the CG at which a mass of `mass_change` sits [m]; J_xx and J_yy change by
            mass * fraction * payload_arm^2.
    """

    b: float = TABLE_2["b"]
    d: float = TABLE_2["d"]
    J_xx: float = TABLE_2["J_xx"]
    J_yy: float = TABLE_2["J_yy"]
    J_zz: float = TABLE_2["J_zz"]
    J_r: float = TABLE_2["J_r"]
    mass: float = 1.30
    payload_arm: float = 0.0

    def __post_init__(self) -> None:
        """Checks that all six and the mass are positive and finite; raises ParameterError."""
        for name in (*NOMINAL_NAMES, "mass"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise ParameterError(f"{name} = {value:g}", "a positive finite number")

    @classmethod
    def of(cls, vehicle: Vehicle) -> "TruthParameters":
        """Returns the type's truth: Table 2 for a Pelican, else the initial values of the vehicle file."""
        values = TABLE_2 if vehicle.name in PELICANS else {n: vehicle.parameters[n].initial for n in NOMINAL_NAMES}
        return cls(**values, mass=vehicle.mass)

    def as_dict(self) -> dict[str, float]:
        """Returns the six identified parameters by name."""
        return {name: float(getattr(self, name)) for name in NOMINAL_NAMES}

    def hover_speed(self, rotors: int) -> float:
        """Speed [rad/s] of each of `rotors` rotors at which thrust equals weight."""
        return float(np.sqrt(self.mass * GRAVITY / (self.b * rotors)))


def draw_truth(vehicle: Vehicle, seed: int, spread: float = 0.15) -> TruthParameters:
    """Draws one individual of the vehicle's type.

    Args:
        spread: each of b, d, J_xx, J_yy, J_zz, J_r is uniform within (1 +- spread) of `TruthParameters.of`.

    Returns:
        Truth with the vehicle's own (known) mass.
    """
    if not 0.0 <= spread < 1.0:
        raise ParameterError(f"spread {spread:g}", "0 <= spread < 1")
    base = TruthParameters.of(vehicle)
    factors = np.random.default_rng([seed, 0x7247]).uniform(1.0 - spread, 1.0 + spread, len(NOMINAL_NAMES))
    return replace(base, **{n: float(getattr(base, n) * f) for n, f in zip(NOMINAL_NAMES, factors, strict=True)})


# --- Draws catalogue effects at the sizes met on real vehicles (docs/diagnosis.md), for blinded campaigns


SIZES: dict[str, dict[str, tuple[float, float]]] = {
    "motor_lag": {"tau": (0.02, 0.06)},
    "command_delay": {"delay": (0.012, 0.04)},
    "imu_lag": {"cutoff": (4.0, 12.0)},
    "attitude_delay": {"delay": (0.015, 0.06)},
    "rotor_drag": {"k_x": (0.12, 0.45), "k_y": (0.12, 0.45)},
    "parasitic_drag": {"c": (0.01, 0.06)},
    "translational_lift": {"k": (0.005, 0.03)},
    "rotor_drag_moment": {"h_x": (0.01, 0.05), "h_y": (0.01, 0.05)},
    "rate_damping": {"l_p": (0.3, 2.0), "m_q": (0.3, 2.0), "n_r": (0.1, 0.6)},
    "axial_inflow": {"k_z": (0.1, 0.5)},
    "wind": {"north": (1.0, 5.0), "east": (1.0, 5.0)},
    "weak_rotor": {"loss": (0.03, 0.15)},
    "cg_offset": {"x": (0.002, 0.012), "y": (0.002, 0.012)},
    "mass_change": {"fraction": (0.05, 0.25)},
    "thrust_drop": {"fraction": (0.04, 0.15)},
    "battery_sag": {"fraction": (0.05, 0.15)},
    "supply_voltage": {"exponent": (0.7, 1.3)},
    "rotor_telemetry_delay": {"delay": (0.005, 0.015)},
    "drag_torque_curve": {"growth": (0.5, 1.2)},
    "no_gyroscopic_coupling": {"share": (0.9, 1.0)},
    "thrust_curve": {"dead_speed": (18.0, 70.0)},
    "product_of_inertia": {"J_xy": (5e-4, 2e-3), "J_xz": (5e-4, 2e-3), "J_yz": (5e-4, 2e-3)},
    "rotor_spin_up": {"J": (2e-5, 8e-5)},
    "gyro_bias": {"x": (0.005, 0.03), "y": (0.005, 0.03), "z": (0.005, 0.03)},
    "accel_bias": {"x": (0.1, 0.5), "y": (0.1, 0.5), "z": (0.1, 0.5)},
    "gyro_scale": {"x": (0.01, 0.05), "y": (0.01, 0.05), "z": (0.01, 0.05)},
    "imu_misalignment": {"x": (0.0175, 0.07), "y": (0.0175, 0.07), "z": (0.0175, 0.07)},
    "imu_lever_arm": {"x": (0.02, 0.08), "y": (0.02, 0.08), "z": (0.02, 0.08)},
    "ahrs_acceleration_error": {"k": (0.05, 0.5)},
    "ground_effect": {"radius_scale": (1.5, 3.0)},
    "velocity_scale": {"horizontal": (0.03, 0.12), "vertical": (0.03, 0.12)},
}
"""Realistic magnitudes on a Pelican, in contract units."""
SIGNED = frozenset(
    (
        *("rotor_drag_moment", "wind", "cg_offset", "mass_change", "product_of_inertia"),
        *("gyro_bias", "accel_bias", "gyro_scale", "imu_misalignment", "imu_lever_arm", "velocity_scale"),
    )
)
"""Effects whose numbers may have either sign (mass is dropped or taken up)."""
COMPANION = {"rotor_drag_moment": "rotor_drag", "wind": "rotor_drag"}
"""Effects that cannot be seen alone: without drag there is no in-plane force and no feeling of wind."""


def vehicle_scales(vehicle: Vehicle | None) -> dict[str, float]:
    """Factors from a Pelican's sizes to this vehicle's, None being a Pelican.

    Keys: length; lever (inertia over mass: a force at a lever turns as much); balance (lever over length: one rotor's
    thrust turns as much); inertia; rotor (inertia); speed (of the rotors).
    """
    if vehicle is None:
        return dict.fromkeys(("length", "lever", "balance", "inertia", "rotor", "speed"), 1.0)
    arm = float(np.mean(np.linalg.norm(vehicle.rotor_positions[:, :2], axis=1)))
    length = arm / 0.21
    lever = min(1.0, vehicle.parameters["J_xx"].initial / vehicle.mass / (8.0e-3 / 1.30))
    return {
        "length": length,
        "lever": lever,
        "balance": min(1.0, lever / length),
        "inertia": min(1.0, vehicle.parameters["J_xx"].initial / 8.0e-3),
        "rotor": vehicle.parameters["J_r"].initial / 3.0e-5,
        "speed": vehicle.hover_speed() / 370.0,
    }


SCALED_BY = {
    "rotor_drag_moment": "lever",
    "cg_offset": "lever",
    "imu_lever_arm": "length",
    "product_of_inertia": "inertia",
    "rotor_spin_up": "rotor",
    "thrust_curve": "speed",
}
"""Effects whose size depends on the vehicle's; a moment's lever goes with inertia over mass, as the response does."""


def _one(
    name: str, rng: np.random.Generator, scale: float, vehicle: Vehicle | None, seconds: float
) -> dict[str, float]:
    factor = vehicle_scales(vehicle)[SCALED_BY[name]] if name in SCALED_BY else 1.0
    values: dict[str, float] = {}
    for key, (low, high) in SIZES[name].items():
        value = float(rng.uniform(low, high)) * factor
        value = value / scale if name == "imu_lag" else value * scale
        sign = float(rng.choice([-1.0, 1.0]))
        values[key] = value * sign if name in SIGNED else value
    if name in ("mass_change", "thrust_drop"):
        values["time"] = float(rng.uniform(0.3, 0.7)) * seconds
    if name == "weak_rotor":
        values["rotor"] = float(rng.integers(1, (4 if vehicle is None else len(vehicle.rotors)) + 1))
    return {p.name: values[p.name] for p in EFFECTS[name].parameters if p.name in values}


def draw_effect(
    name: str, seed: int, scale: float = 1.0, vehicle: Vehicle | None = None, seconds: float = 120.0
) -> dict[str, dict[str, float]]:
    """Draws one catalogue effect at realistic size, ready for ``fly(..., effects=...)``.

    Args:
        name: key of `quadid.effects.EFFECTS`.
        scale: multiplies the size (divides the cut-off of imu_lag); companions are not scaled.
        vehicle: scales lengths, inertias and speeds from a Pelican's; default a Pelican.
        seconds: length of the flight, for effects that happen at a time (30 to 70 % of it).

    Returns:
        Effect name -> parameters.  Holds `rotor_drag` too where the effect is invisible without it (`COMPANION`).

    Raises:
        ParameterError: unknown name.
    """
    if name not in SIZES:
        raise ParameterError(f"unknown effect '{name}'", fix=nearest(name, SIZES))
    rng = np.random.default_rng([seed, zlib.crc32(name.encode()), 0xEFF])
    drawn = {name: _one(name, rng, scale, vehicle, seconds)}
    if name in COMPANION:
        drawn[COMPANION[name]] = _one(COMPANION[name], rng, 1.0, vehicle, seconds)
    return drawn


# --- Everything a flight is made of before it is flown, and how catalogue effects change it (contract section 6)
#
# This is the truth's own reading of each effect; the model under test has another.


Effects = Mapping[str, Mapping[str, float]]


def check_effects(effects: Effects, rotors: int) -> dict[str, dict[str, float]]:
    """Completes effects with neutral values, optional numbers left out, and checks names and ranges.

    Args:
        effects: effect name -> parameter name -> value; parameters left out are neutral.
        rotors: number of rotors of the vehicle.

    Returns:
        A complete copy.

    Raises:
        ParameterError: unknown name, a value that is not a number, or a rotor that is not there.
    """
    complete: dict[str, dict[str, float]] = {}
    for name, given in effects.items():
        if name not in EFFECTS:
            raise ParameterError(f"unknown effect '{name}'", fix=nearest(name, EFFECTS))
        known = known_keys(name, rotors)
        for key, value in given.items():
            if key not in known:
                raise ParameterError(f"effect '{name}' has no parameter '{key}'", ", ".join(known), nearest(key, known))
            if np.isnan(value):
                raise ParameterError(f"{name}.{key} is not a number", "a number")
        values = {p.name: p.neutral for p in EFFECTS[name].parameters if not p.optional}
        values |= {k: float(v) for k, v in given.items()}
        for key, value in values.items():
            p = EFFECTS[name].parameter(key.rstrip("0123456789").rstrip("_"))
            if value != p.neutral and not p.lower <= value <= p.upper:
                raise ParameterError(f"{name}.{key} = {value:g} {p.unit}", f"{p.lower:g} to {p.upper:g}")
        complete[name] = values
    rotor_losses(complete.get("weak_rotor", {}), rotors)
    return complete


@dataclass
class Setup:
    """Constants of one flight, ready for `march`; the only mutable thing here, and only until take-off.

    Attributes:
        vehicle, truth: what flies.
        body, air, odd, drive, events, on_board: constants of the kernel.
        efficiency: factors on thrust and drag torque of each rotor, shape (rotors, 2).
        delay: delay from command to rotor [s].
        reading_delay: by which logged rotor speeds come late [s].
        imu_cutoff: Butterworth cut-off in the IMU's telemetry path [Hz]; infinite for none.
        attitude_delay: of the attitude's telemetry path [s].
        velocity_gain: factors on the logged velocity, north, east, down, shape (3,).
    """

    vehicle: Vehicle
    truth: TruthParameters
    effects: dict[str, dict[str, float]]
    body: Body
    air: Air
    drive: Drive
    events: Events
    on_board: OnBoard
    efficiency: FloatArray
    delay: float
    reading_delay: float
    imu_cutoff: float
    attitude_delay: float
    velocity_gain: FloatArray
    odd: Oddity = field(default_factory=Oddity)


def propeller_radius(vehicle: Vehicle) -> float:
    """Largest propeller radius that fits the geometry [m]: half the smallest distance between two rotors."""
    at = vehicle.rotor_positions
    gaps = np.linalg.norm(at[:, None, :] - at[None, :, :], axis=2)
    return float(0.5 * gaps[gaps > 1e-6].min())


def small_rotation(vector: FloatArray) -> FloatArray:
    """Rotation matrix exp([vector]x), shape (3, 3), for a rotation vector [rad] (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    x, y, z = vector
    cross = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    if angle == 0.0:
        return np.eye(3)
    return np.asarray(np.eye(3) + np.sin(angle) / angle * cross + (1.0 - np.cos(angle)) / angle**2 * (cross @ cross))


class _Lookup:
    """Reads effect values, neutral where an effect or an optional number is absent."""

    def __init__(self, effects: Mapping[str, Mapping[str, float]]) -> None:
        self.effects = effects

    def __call__(self, effect: str, parameter: str) -> float:
        return self.effects.get(effect, {}).get(parameter, EFFECTS[effect].parameter(parameter).neutral)

    def beside(self, effect: str, parameter: str, base: str) -> float:
        """Value of a parameter that is another one's unless it is given."""
        return self.effects.get(effect, {}).get(parameter, self(effect, base))

    def vector(self, effect: str, names: str) -> FloatArray:
        return np.array([self(effect, name) for name in names.split()])


def _tensor(truth: TruthParameters, value: _Lookup, extra: FloatArray) -> FloatArray:
    j_xy, j_xz, j_yz = value.vector("product_of_inertia", "J_xy J_xz J_yz")
    tensor = np.diag(np.array([truth.J_xx, truth.J_yy, truth.J_zz]) + extra)
    tensor[0, 1] = tensor[1, 0] = -j_xy
    tensor[0, 2] = tensor[2, 0] = -j_xz
    tensor[1, 2] = tensor[2, 1] = -j_yz
    if np.linalg.eigvalsh(tensor)[0] <= 0.0:
        raise ParameterError("product_of_inertia makes the inertia tensor indefinite", "smaller products of inertia")
    return tensor


def _hover_speed(vehicle: Vehicle, truth: TruthParameters, value: _Lookup) -> float:
    """Rotor speed [rad/s] at which the thrust curve carries the weight."""
    each = truth.mass * GRAVITY / len(vehicle.rotors) - value("thrust_curve", "offset")
    speed = float(np.sqrt(max(each, 0.0) / truth.b)) + value("thrust_curve", "dead_speed")
    if speed <= 0.0:
        raise ParameterError(f"thrust_curve: hovers at {speed:.3g} rad/s", "a positive speed", "a smaller dead_speed")
    return speed


def _body(vehicle: Vehicle, truth: TruthParameters, value: _Lookup) -> Body:
    cg = np.array([value("cg_offset", "x"), value("cg_offset", "y"), 0.0])
    later = cg + np.array([value("mass_change", "x"), value("mass_change", "y"), 0.0])
    payload = truth.mass * value("mass_change", "fraction") * truth.payload_arm**2
    grown = np.array([getattr(truth, key) * value("mass_change", key) for key in ("J_xx", "J_yy", "J_zz")])
    inertia = np.stack([_tensor(truth, value, np.zeros(3)), _tensor(truth, value, grown + [payload, payload, 0.0])])
    at, imu = vehicle.rotor_positions, value.vector("imu_lever_arm", "x y z")
    return Body(
        mass=truth.mass,
        inertia=inertia,
        inverse=np.ascontiguousarray(np.linalg.inv(inertia)),
        rotor_inertia=truth.J_r,
        spin_up=value("rotor_spin_up", "J"),
        arms=np.stack([at - cg, at - later]),
        spins=vehicle.spins,
        b=truth.b,
        d=truth.d,
        dead_speed=value("thrust_curve", "dead_speed"),
        offset=value("thrust_curve", "offset"),
        growth=value("drag_torque_curve", "growth"),
        imu=np.stack([imu - cg, imu - later]),
        coupling=1.0 - value("no_gyroscopic_coupling", "share"),
        hover_speed=_hover_speed(vehicle, truth, value),
    )


def _air(vehicle: Vehicle, truth: TruthParameters, value: _Lookup) -> Air:
    return Air(
        drag_x=value("rotor_drag", "k_x"),
        drag_y=value("rotor_drag", "k_y"),
        drag_reach=1.0 - value("rotor_drag", "central"),
        axial_reach=1.0 - value("axial_inflow", "central"),
        parasitic=value("parasitic_drag", "c"),
        parasitic_z=value.beside("parasitic_drag", "c_z", "c"),
        lift=value("translational_lift", "k"),
        moment_x=value("rotor_drag_moment", "h_x"),
        moment_y=value("rotor_drag_moment", "h_y"),
        damping_p=value("rate_damping", "l_p"),
        damping_q=value("rate_damping", "m_q"),
        damping_r=value("rate_damping", "n_r"),
        axial=value("axial_inflow", "k_z"),
        climb=value("axial_inflow", "k_climb"),
        wind_north=value("wind", "north"),
        wind_east=value("wind", "east"),
        ground_radius=value("ground_effect", "radius_scale") * propeller_radius(vehicle),
        hover_sum=len(vehicle.rotors) * _hover_speed(vehicle, truth, value),
    )


def _events(value: _Lookup, last: float) -> Events:
    def time(effect: str) -> float:
        moment = value(effect, "time")
        return moment if np.isfinite(moment) and value(effect, "fraction") != 0.0 else NO_TIME

    return Events(
        mass_time=time("mass_change"),
        mass_fraction=value("mass_change", "fraction"),
        drop_time=time("thrust_drop"),
        drop_fraction=value("thrust_drop", "fraction"),
        sag_fraction=value("battery_sag", "fraction"),
        sag_start=0.0,
        sag_end=max(last, 1e-9),
        supply_exponent=value("supply_voltage", "exponent"),
        faint_rotor=-1,
        faint_share=0.0,
        faint_times=np.zeros((0, 2)),
    )


def prepare(
    vehicle: Vehicle,
    truth: TruthParameters,
    effects: Effects,
    last: float,
    ramp: float,
    shakes: tuple[float, float],
    shake_mode: FloatArray,
) -> Setup:
    """Builds the constants of a flight.

    Args:
        effects: hidden effects, see `check_effects`.
        last: time of the last log row [s]; the battery sags until then.
        ramp: time the rotors take to reach a command [s]; 0 for held commands.
        shakes: rms vibration of gyro [rad/s] and accelerometer [m/s^2] in hover.
        shake_mode: how every rotor's imbalance shows on the six IMU axes, see `loop.shake`.
    """
    n = len(vehicle.rotors)
    complete = check_effects(effects, n)
    value = _Lookup(complete)
    weak = complete.get("weak_rotor", {})
    efficiency = 1.0 - np.column_stack([rotor_losses(weak, n), rotor_drag_losses(weak, n)])
    mounting = small_rotation(value.vector("imu_misalignment", "x y z"))
    on_board = OnBoard(
        gyro_matrix=np.ascontiguousarray(np.diag(1.0 + value.vector("gyro_scale", "x y z")) @ mounting),
        gyro_bias=value.vector("gyro_bias", "x y z"),
        accel_matrix=mounting,
        accel_bias=value.vector("accel_bias", "x y z"),
        pull=value("ahrs_acceleration_error", "k"),
        gyro_shake=shakes[0],
        accel_shake=shakes[1],
        shake_mode=shake_mode,
    )
    return Setup(
        vehicle=vehicle,
        truth=truth,
        effects=complete,
        body=_body(vehicle, truth, value),
        air=_air(vehicle, truth, value),
        drive=Drive(tau=value("motor_lag", "tau"), tau_down=value.beside("motor_lag", "tau_down", "tau"), ramp=ramp),
        events=_events(value, last),
        on_board=on_board,
        efficiency=efficiency,
        delay=value("command_delay", "delay"),
        reading_delay=value("rotor_telemetry_delay", "delay"),
        imu_cutoff=value("imu_lag", "cutoff"),
        attitude_delay=value("attitude_delay", "delay"),
        velocity_gain=1.0 + value.vector("velocity_scale", "horizontal horizontal vertical"),
    )
