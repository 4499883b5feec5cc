"""Everything a flight is made of before it is flown, and how catalogue effects change it (contract section 6).

This is the truth's own reading of each effect; the model under test has another.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from quadid.effects import EFFECTS, known_keys, rotor_drag_losses, rotor_losses
from quadid.errors import ParameterError, nearest
from quadid.flight.airframe_constants import Air, Body, Oddity
from quadid.flight.loop import NO_TIME, Events, OnBoard
from quadid.flight.rotors import Drive
from quadid.flight.truth import TruthParameters
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

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
        effects: complete effects.
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
        vehicle: geometry.
        truth: true parameters.
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
