"""Result of an inspection: channels, checks, what is missing and how to log it, what a doubt means for estimates."""

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

import numpy as np

from quadid.data.rotor_signal import INERTIA_RATE, SLOWEST_RATE
from quadid.jsonable import jsonable
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- Result of an inspection: facts of channels, checks, what is missing and how to get it


class CheckResult(StrEnum):
    """Outcome of one check."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"
    UNKNOWN = "unknown"


OK, WARNING, ERROR, UNKNOWN = CheckResult


@dataclass(frozen=True)
class ChannelFacts:
    """One channel of a log.

    Attributes:
        name: key of `quadid.data.window.CHANNELS`.
        unit: of its values.
        source: topic, message or column names it came from.
        rate: measured samples a second inside stretches without gaps, interpolated rows not counted [Hz].
        count: samples kept.
        first, last: times of the first and last one [s].
        jitter: standard deviation of the step over its median (gaps left out).
        gaps: steps longer than the gap limit.
        longest_gap: [s], 0 when there is none.
        bridged: lost samples too few for a gap.
        repeated: fraction of rows equal to the row before.
        stuck: longest time in flight without any change, or of the flight if an axis has none [s]; 0 without flight.
        saturated: samples at a limit that the channel hits several times.
        dropped: samples the reader dropped, by reason.
    """

    name: str
    unit: str
    source: str
    rate: float
    count: int
    first: float
    last: float
    jitter: float
    gaps: int
    longest_gap: float
    bridged: int
    repeated: float
    stuck: float
    saturated: int
    dropped: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Check:
    """One question put to the data.

    Attributes:
        name: of the check: gravity, gyro_attitude, gyro_source, attitude_steps, velocity_attitude, position_velocity,
            rotor_speed, hover, motor_order, rotor_timing, accel_timing, geometry, mass, clock, timing, stuck,
            saturated, data (what `identify` would refuse).
        verdict: the answer.
        message: one sentence with numbers and units.
        fix: what to do, empty when nothing.
        numbers: the numbers behind it.
        off: natural logarithm of estimate over truth of each parameter if its doubt is right; empty where nothing is.
    """

    name: str
    verdict: CheckResult
    message: str
    fix: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)
    off: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Missing:
    """A signal that is absent or too slow, why it matters, and how to log it."""

    channel: str
    why: str
    how: str


@dataclass(frozen=True)
class Outlook:
    """Outlook of a parameter: do the channels allow it to be identified at all?  Excitation is another question."""

    parameter: str
    possible: bool
    reason: str


@dataclass(frozen=True)
class Inspection:
    """Everything an inspection found.

    Attributes:
        name, format, sha256: of the log.
        seconds: first to last sample [s].
        channels: facts by channel, in the order of `quadid.data.window.CHANNELS`.
        breaks: times across which nothing is joined [s].
        flying: spans in which the vehicle flies [s].
        checks: unit, frame, motor and clock checks.
        missing: signals to add to the log.
        parameters: what the channels allow.
        excitation: rows computed elsewhere, as given.
        warnings: of the reader.
        zero: time of the log's first IMU sample [s]: ``LOG@from:to``, and tables for people, count from there.
    """

    name: str
    format: str
    sha256: str
    seconds: float
    channels: tuple[ChannelFacts, ...]
    breaks: tuple[float, ...]
    flying: tuple[tuple[float, float], ...]
    checks: tuple[Check, ...]
    missing: tuple[Missing, ...]
    parameters: tuple[Outlook, ...]
    excitation: tuple[Mapping[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()
    zero: float = 0.0

    @property
    def usable(self) -> bool:
        """True where something flies, a parameter can be identified, and no check finds the data wrong."""
        wrong = any(check.verdict is ERROR for check in self.checks)
        return bool(self.flying) and any(outlook.possible for outlook in self.parameters) and not wrong

    def to_dict(self) -> dict[str, Any]:
        """Returns the inspection as JSON-ready data, schema ``quadid.inspect/1``; NaN and infinity become null."""
        data = {"schema": "quadid.inspect/1", "usable": self.usable, **asdict(self)}
        return dict(jsonable(data))


# --- What the channels of a log allow to identify, what is missing, and how to log it


_HOW: dict[str, dict[str, str]] = {
    "rotor": {
        "ulog": "set SDLOG_PROFILE to 17 (default + high rate), or list actuator_motors and esc_status in "
        "etc/logging/logger_topics.txt",
        "dataflash": "ArduCopter writes RCOU at 10 Hz: log rotor speeds of the ESCs (bidirectional DShot, ESC), "
        "or record SERVO_OUTPUT_RAW at 80 Hz as telemetry (.tlog)",
        "tlog": "ask for SERVO_OUTPUT_RAW and ESC_STATUS at 50 Hz with SET_MESSAGE_INTERVAL, or use the on-board log",
        "mcap": "record rotor_speeds (sensor_msgs/JointState) or motor_command; PX4's bridge needs actuator_motors and "
        "esc_status added to dds_topics.yaml; mavros: rc/out and esc_status/status",
        "csv": "add columns w1 … wN [rad/s] or u1 … uN",
    },
    "gyro": {
        "ulog": "set SDLOG_PROFILE to 17 (default + high rate): sensor_combined at full rate",
        "dataflash": "add IMU_FAST to LOG_BITMASK: IMU at loop rate",
        "tlog": "ask for HIGHRES_IMU or RAW_IMU at 50 Hz or more, or use the on-board log",
        "mcap": "record imu/data_raw (sensor_msgs/Imu) at 50 Hz or more; sensor_combined for PX4",
        "csv": "add columns p, q, r [rad/s]",
    },
    "accel": {"csv": "add columns ax, ay, az [m/s^2], specific force"},
    "attitude": {
        "ulog": "log vehicle_attitude (in every SDLOG_PROFILE)",
        "dataflash": "add ATTITUDE_FAST to LOG_BITMASK",
        "tlog": "ask for ATTITUDE_QUATERNION at 50 Hz",
        "mcap": "record attitude (geometry_msgs/QuaternionStamped) or an imu with orientation",
        "csv": "add columns qw, qx, qy, qz or phi, theta, psi [rad]",
    },
}


def missing_signals(log_format: str, facts: tuple[ChannelFacts, ...]) -> tuple[Missing, ...]:
    """Names absent and slow signals with the reason and the way to log them for this kind of log."""
    rates = {f.name: f.rate for f in facts}
    rotor = max((rates[n] for n in ("rotor_speed", "motor_command") if n in rates), default=None)
    out = [*_one(log_format, "rotor", rotor, "without rotor speeds or motor commands nothing can be identified")]
    out += _one(log_format, "gyro", rates.get("gyro"), "inertias and the drag coefficient show in rotation rates")
    if "accel" not in rates:
        how = _HOW["accel"].get(log_format) or _HOW["gyro"].get(log_format, "log the IMU")
        out.append(Missing("accel", "the thrust coefficient shows in the accelerometer", how))
    if "attitude" not in rates:
        why = "attitude constrains the fit over longer segments and reveals wrong units"
        out.append(Missing("attitude", why, _HOW["attitude"].get(log_format, "log the attitude")))
    return tuple(out)


def _one(log_format: str, channel: str, rate: float | None, why: str) -> list[Missing]:
    how = _HOW[channel].get(log_format, "log it")
    if rate is None:
        return [Missing(channel, why, how)]
    if rate >= INERTIA_RATE:
        return []
    slow = "one sample is too little" if math.isnan(rate) else f"{rate:.3g} Hz is too slow"
    return [Missing(channel, f"{slow} for inertias, which need {INERTIA_RATE:g} Hz or more", how)]


def parameter_outlook(facts: tuple[ChannelFacts, ...]) -> tuple[Outlook, ...]:
    """Outlook of each parameter of the nominal model by the channels and their rates."""
    rates = {f.name: f.rate for f in facts}
    rotor = max((rates[n] for n in ("rotor_speed", "motor_command") if n in rates), default=0.0)
    gyro = rates.get("gyro", 0.0)
    out = []
    for name in NOMINAL_NAMES:
        if rotor < SLOWEST_RATE:
            reason = "no rotor signal" if rotor == 0.0 else f"rotor signal at {rotor:.2g} Hz is too slow"
            out.append(Outlook(name, False, reason))
        elif name == "b":
            possible = "accel" in rates
            out.append(Outlook(name, possible, "rotor signal and accelerometer" if possible else "no accelerometer"))
        elif gyro == 0.0:
            out.append(Outlook(name, False, "no gyro"))
        elif min(rotor, gyro) < INERTIA_RATE:
            slow, rate = ("rotor signal", rotor) if rotor < gyro else ("gyro", gyro)
            out.append(Outlook(name, False, f"{slow} at {rate:.3g} Hz is too slow, {INERTIA_RATE:g} Hz needed"))
        else:
            out.append(Outlook(name, True, "rotor signal and gyro; needs motion about its axis"))
    return tuple(out)


# --- Errors of the estimates of a fit if a doubt about a log is right
#
# With believed (') and true numbers in b'S'/m' = bS/m (S: sum of the squared speeds), J' s dw/dt = b' tau' + gyroscopic
# terms, and J dw/dt = b tau + the same ones (tau: torque over thrust or drag; s: gyro reading over true rate).


Off = dict[str, float]
"""Natural logarithm of estimate over truth by parameter."""


def estimates_off(
    mass: float = 1.0,
    thrust: float = 1.0,
    torque: Sequence[float] = (1.0, 1.0, 1.0),
    spinning: float = 1.0,
    turning: Sequence[float] = (1.0, 1.0, 1.0),
) -> Off:
    """Natural logarithm of estimate over truth of the six parameters of a flat vehicle, J_zz = 2 J_xx = 2 J_yy.

    Args:
        mass: believed over true.
        thrust: true over believed sum of the squared speeds.
        torque: true over believed torque about x, y, z by a unit of thrust or drag.
        spinning: true over believed sum of the rotors' speeds with their spins.
        turning: read over true angular rate about x, y, z.
    """
    b = mass * thrust
    (x, y, z), (s_x, s_y, s_z) = torque, turning
    xx, yy = b / (x * s_x), b / (y * s_y)
    # In a turn roll and pitch show J_zz beside J_yy and J_xx (J_zz - J_yy goes as J_xx s_x / (s_y s_z)), yaw all three:
    # where these contradict each other, what moves it most; yaw shows d by J_zz.
    beside = 0.25 * (xx + yy + xx * s_x / (s_y * s_z) + yy * s_y / (s_x * s_z))
    zz = max(beside, xx, yy, key=lambda ratio: abs(math.log(ratio)))
    off = (b, zz * s_z * z, xx, yy, zz, math.sqrt(xx * yy) * spinning)
    return {name: math.log(ratio) for name, ratio in zip(NOMINAL_NAMES, off, strict=True)}


def rotors_off(vehicle: Vehicle, speeds: FloatArray, true: FloatArray, other: Vehicle | None = None) -> Off:
    """The same where rotors turn at `true` speeds and not at those read [rad/s], both (n, rotors), or stand elsewhere.

    Rotors turn a vehicle by changes of their squared speeds as their true arms; what the centre of gravity makes of all
    together is fitted along.

    Args:
        other: the vehicle with its rotors where they are.
    """
    squares, turned = np.mean(speeds**2, axis=0), np.mean(true**2, axis=0)
    placed = (other or vehicle).torque_arms
    torque = np.sum(placed**2, axis=0) / np.sum((squares / turned)[:, None] * placed * vehicle.torque_arms, axis=0)
    read, spinning = speeds @ vehicle.spins, true @ vehicle.spins
    share = float(read @ spinning) / max(float(read @ read), 1e-300)
    return estimates_off(thrust=float(turned.sum() / squares.sum()), torque=torque.tolist(), spinning=max(share, 1e-3))


def farthest(offs: Iterable[Mapping[str, float]]) -> Off:
    """Of several doubts, how far each parameter is off by that which moves it most."""
    out: Off = {}
    for name, step in (item for off in offs for item in off.items()):
        out[name] = max(out.get(name, 0.0), step, key=abs)
    return out
