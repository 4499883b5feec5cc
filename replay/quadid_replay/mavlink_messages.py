"""MAVLink messages: channels, units, frames and stamps of each kind."""

import math
import struct
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any, Generic, NamedTuple, TypeAlias, TypeVar

import numpy as np
from pymavlink.generator.mavgen_python import mavfmt, native_mavfmt
from pymavlink.generator.mavparse import MAVXML, PROTOCOL_2_0

from quadid.types import FloatArray, IntArray
from quadid_replay.columns import GRAVITY, from_euler, to_euler
from quadid_replay.motors import ESCS, RPM

# --- ESC_INFO (290) and ESC_STATUS (291) of MAVLink's common dialect, which pymavlink lacks, added at run time


ESC_INFO, ESC_STATUS = 290, 291
_DEFINITIONS = Path(__file__).parent / "dialects" / "quadid.xml"


def extend_dialect(dialect: ModuleType) -> ModuleType:
    """Adds both messages to a MAVLink 2 dialect module of pymavlink, unless it has them; returns the module.

    The module gains ``MAVLink_esc_info_message`` and ``MAVLink_esc_status_message``, whose arguments are the fields in
    the order of the XML, and decodes both.
    """
    if ESC_INFO not in dialect.mavlink_map or ESC_STATUS not in dialect.mavlink_map:
        for described in MAVXML(str(_DEFINITIONS), PROTOCOL_2_0).message:
            message = _message_class(dialect, described)
            dialect.mavlink_map[message.id] = message
            setattr(dialect, message.__name__, message)
            setattr(dialect, f"MAVLINK_MSG_ID_{message.msgname}", message.id)
    return dialect


def _message_class(dialect: ModuleType, m: Any) -> type[Any]:
    """Builds the class that mavgen would have written of a described message; a test compares both."""
    unpacker = struct.Struct("<" + "".join(map(mavfmt, m.ordered_fields)))

    def initialise(self: Any, *values: Any) -> None:
        dialect.MAVLink_message.__init__(self, m.id, m.name)
        self._fieldnames, self._instance_field, self._instance_offset = m.fieldnames, "index", m.field_offsets["index"]
        for name, value in zip(m.fieldnames, values, strict=True):
            setattr(self, name, value)

    def pack(self: Any, mav: Any, force_mavlink1: bool = False) -> bytes:
        flat: list[Any] = []
        for field in m.ordered_fields:
            value = getattr(self, field.name)
            flat += value if field.array_length else [value]
        return bytes(self._pack(mav, m.crc_extra, unpacker.pack(*flat), force_mavlink1=force_mavlink1))

    attributes = {
        "id": m.id,
        "msgname": m.name,
        "fieldnames": m.fieldnames,
        "ordered_fieldnames": m.ordered_fieldnames,
        "fieldtypes": m.fieldtypes,
        "fielddisplays_by_name": {},
        "fieldenums_by_name": {},
        "fieldunits_by_name": {},
        "native_format": bytearray(("<" + "".join(map(native_mavfmt, m.ordered_fields))).encode()),
        "orders": [m.ordered_fieldnames.index(name) for name in m.fieldnames],
        "lengths": [field.array_length or 1 for field in m.ordered_fields],
        "array_lengths": [field.array_length for field in m.ordered_fields],
        "crc_extra": m.crc_extra,
        "unpacker": unpacker,
        "instance_field": "index",
        "instance_offset": m.field_offsets["index"],
        "__init__": initialise,
        "pack": pack,
    }
    return type(f"MAVLink_{m.name_lower}_message", (dialect.MAVLink_message,), attributes)


# --- What frame numbers tell of who sent them: one sender counts from 0 to 255 over and over, two do so each by itself


FAR = 8
"""Frame numbers that jump by no more come from frames that are lost, late or there twice."""
FEWEST, SHARE = 6, 3
"""Two rows are seen by more returns than so many, and than one in so many jumps: of one sender whose frames are lost it
is one in thirty, and of two every second one, or each where the second one counts its frames."""


def two_rows(number: IntArray) -> bool:
    """True if frame numbers of one id jump to and fro between two rows: jumps land where an earlier one had left off.

    Numbers of one sender jump over what was lost, and seldom return to where they were before.

    Args:
        number: frame numbers, 0 to 255, in the order in which the frames came, shape (n,).
    """
    step = np.diff(number) % 256
    jumps = np.flatnonzero((step > FAR) & (step < 256 - FAR))
    onward = (number[jumps[1:] + 1] - number[jumps[:-1]]) % 256
    returns = int(np.count_nonzero((onward >= 1) & (onward <= FAR)))
    return returns > max(FEWEST, len(jumps) // SHARE)


# --- Contents of each MAVLink message: channel, values in core units and frames, and its own stamp
#
# MAVLink bodies are FRD and worlds NED, as the core's; only units differ (mG, mrad/s, rpm, mV, cm/s).


MILLI = 1e-3
SERVO_TURN = 2.0**32 * 1e-6
"""SERVO_OUTPUT_RAW counts microseconds in 32 bits: [s] until it starts over."""
ZERO_IS_BOOT = 1.0
"""A stamp of zero farther than this [s] from the newest one stands for unknown."""
_UNIX_US = 1e14
"""Stamps above this [us] count from the UNIX epoch."""
_NO_VOLTAGE = 65535
ESC_GROUPS = tuple(f"ESC_TELEMETRY_{k + 1}_TO_{k + 4}" for k in range(0, ESCS, 4))
"""ArduPilot's messages of four ESCs each."""


class Reading(NamedTuple):
    """Values of one signal, of one message or of many alike.

    Attributes:
        signal: channel name, or a name of the reader's own (``esc``, ``servo``, ``actuator``).
        values: a number a column, or an array of shape (n,); in core units.
        source: message name.
        place: first column, for signals that come in several messages.
        known: whether the message holds the signal.
    """

    signal: str
    values: Sequence[Any]
    source: str
    place: Any = 0
    known: Any = True


def _imu(m: Any, rate: float, force: float, name: str) -> list[Reading]:
    return [
        Reading("gyro", (m.xgyro * rate, m.ygyro * rate, m.zgyro * rate), name),
        Reading("accel", (m.xacc * force, m.yacc * force, m.zacc * force), name),
    ]


def _highres_imu(m: Any) -> list[Reading]:
    updated = (0x38, 0x07)  # bits of fields_updated: gyro, accel
    return [
        r._replace(known=(m.fields_updated & bits == bits) | (m.fields_updated == 0))
        for r, bits in zip(_imu(m, 1.0, 1.0, "HIGHRES_IMU"), updated, strict=True)
    ]


def _turned(turn: Callable[[FloatArray], FloatArray], columns: Sequence[Any]) -> tuple[Any, ...]:
    """Columns of what `turn` makes of rows."""
    rows = np.stack([np.asarray(c, dtype=np.float64) for c in columns], axis=-1)
    return tuple(turn(rows[None])[0]) if rows.ndim == 1 else tuple(turn(rows).T)


def _attitude(m: Any) -> list[Reading]:
    return [
        Reading("attitude", _turned(from_euler, (m.roll, m.pitch, m.yaw)), "ATTITUDE"),
        Reading("gyro", (m.rollspeed, m.pitchspeed, m.yawspeed), "ATTITUDE (filtered on board)"),
    ]


def _attitude_quaternion(m: Any) -> list[Reading]:
    return [
        Reading("attitude", (m.q1, m.q2, m.q3, m.q4), "ATTITUDE_QUATERNION"),
        Reading("gyro", (m.rollspeed, m.pitchspeed, m.yawspeed), "ATTITUDE_QUATERNION (filtered on board)"),
    ]


def _attitude_target(m: Any) -> list[Reading]:
    return [Reading("attitude_reference", (*_turned(to_euler, m.q), m.thrust), "ATTITUDE_TARGET")]


def _local_position(m: Any) -> list[Reading]:
    read = {"position": (m.x, m.y, m.z), "velocity": (m.vx, m.vy, m.vz)}
    # Three NaN stand for what is not measured; a number equals itself.
    return [
        Reading(n, (a, b, c), "LOCAL_POSITION_NED", known=(a == a) | (b == b) | (c == c))
        for n, (a, b, c) in read.items()
    ]


def _servo_output(m: Any) -> list[Reading]:
    outputs = [getattr(m, f"servo{i}_raw", 0) for i in range(1, 17)]
    return [Reading("servo", outputs, "SERVO_OUTPUT_RAW", 16 * m.port, known=m.port < 2)]


def _battery_status(m: Any) -> list[Reading]:
    millivolts = sum(v * ((v != 0) & (v != _NO_VOLTAGE)) for v in m.voltages)
    known = (m.id == 0) & (millivolts > 0)
    return [Reading("battery", (millivolts * MILLI,), "BATTERY_STATUS", known=known)]


def _system_status(m: Any) -> list[Reading]:
    known = (m.voltage_battery != 0) & (m.voltage_battery != _NO_VOLTAGE)
    return [Reading("battery", (m.voltage_battery * MILLI,), "SYS_STATUS", known=known)]


def _escs(m: Any, place: Any, name: str) -> list[Reading]:
    return [Reading("esc", [abs(rpm) * RPM for rpm in m.rpm], name, place)]


READERS: dict[str, Callable[[Any], list[Reading]]] = {
    "HIGHRES_IMU": _highres_imu,
    "SCALED_IMU": lambda m: _imu(m, MILLI, MILLI * GRAVITY, "SCALED_IMU (mG, mrad/s)"),
    "RAW_IMU": lambda m: _imu(m, MILLI, MILLI * GRAVITY, "RAW_IMU (ArduPilot: mG, mrad/s)"),
    "ATTITUDE": _attitude,
    "ATTITUDE_QUATERNION": _attitude_quaternion,
    "ATTITUDE_TARGET": _attitude_target,
    "LOCAL_POSITION_NED": _local_position,
    "GLOBAL_POSITION_INT": lambda m: [
        Reading("velocity", (m.vx * 0.01, m.vy * 0.01, m.vz * 0.01), "GLOBAL_POSITION_INT")
    ],
    "SERVO_OUTPUT_RAW": _servo_output,
    "ACTUATOR_OUTPUT_STATUS": lambda m: [Reading("actuator", list(m.actuator), "ACTUATOR_OUTPUT_STATUS")],
    "ESC_STATUS": lambda m: _escs(m, m.index, "ESC_STATUS"),
    **{name: partial(_escs, place=4 * k, name="ESC_TELEMETRY") for k, name in enumerate(ESC_GROUPS)},
    "BATTERY_STATUS": _battery_status,
    "SYS_STATUS": _system_status,
}
"""Messages with measurements, each with the function that reads one, or many whose fields are arrays."""

STATE_MESSAGES = ("HEARTBEAT", "PARAM_VALUE", "SYSTEM_TIME", "ESC_INFO")
"""Messages about the vehicle and its clock."""

PREFERENCE: dict[str, tuple[str, ...]] = {
    "gyro": ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU", "ATTITUDE_QUATERNION", "ATTITUDE"),
    "accel": ("HIGHRES_IMU", "SCALED_IMU", "RAW_IMU"),
    "attitude": ("ATTITUDE_QUATERNION", "ATTITUDE"),
    "attitude_reference": ("ATTITUDE_TARGET",),
    "velocity": ("LOCAL_POSITION_NED", "GLOBAL_POSITION_INT"),
    "position": ("LOCAL_POSITION_NED",),
    "battery": ("BATTERY_STATUS", "SYS_STATUS"),
}
"""Messages from which a channel is taken; a later one only when it comes twice as fast."""


def boot_seconds(m: Any) -> Any:
    """Returns the messages' own stamps [s] since boot, NaN where they have none or count UNIX time."""
    stamp = getattr(m, "time_boot_ms", None)
    if stamp is not None:
        return stamp * MILLI
    stamp = getattr(m, "time_usec", None)
    return math.nan if stamp is None else np.where(stamp > _UNIX_US, math.nan, stamp * 1e-6)


def unix_seconds(m: Any) -> Any:
    """Returns the messages' own stamps as UNIX time [s], NaN where they do not count that."""
    stamp = getattr(m, "time_usec", None)
    return math.nan if stamp is None else np.where(stamp > _UNIX_US, stamp * 1e-6, math.nan)


def boot_stamp(raw: float, servo: bool, newest: float | None) -> float | None:
    """Returns a message's own stamp [s] since boot, with whole turns of a 32-bit counter added; None without one.

    Args:
        raw: result of `boot_seconds`.
        servo: it is SERVO_OUTPUT_RAW, whose counter has 32 bits.
        newest: newest stamp known of this vehicle [s].
    """
    if raw != raw:
        return None
    if newest is None or (raw != 0.0 and not servo):
        return raw
    boot = raw + SERVO_TURN * round((newest - raw) / SERVO_TURN) if servo else raw
    return None if raw == 0.0 and abs(boot - newest) > ZERO_IS_BOOT else boot


# --- Times of messages without a stamp of their own, from the stamped ones around them
#
# An autopilot writes its messages in order, so a message without a stamp was written between the stamped ones before
# and after it.  The link only shows how long after the earlier one it came; nothing older than that one counts, so
# neither a slow drift of the receiver's clock nor a simulation that runs faster than time moves it.  Who reads late
# knows only after when a message came, and that counts: no lag of his moves it into the next round.  Messages of one
# moment come one after the other, and a slow or shared link draws them out: each of them shows how late the link is by
# then.


T = TypeVar("T")

FARTHEST = 1.0
"""A message that comes more than this [s] after the last stamped one has no known time."""
MOMENT = 1e-3
"""Stamps no farther apart than this [s] are of one moment: some messages count milliseconds, others microseconds."""
MOST_WAITING = 4096
"""Messages without a stamp that wait for one; more are given up."""


Placed: TypeAlias = tuple[T, float | None]
"""An item and its time [s] on the boot clock; None where it is unknown."""


class BootClock(Generic[T]):
    """Gives every message a time; those without a stamp wait for the next stamped one."""

    def __init__(self) -> None:
        self.newest: float | None = None
        """Time of the newest stamped message [s]."""
        self._newest_received = 0.0
        """When the last message of that moment came [s]."""
        self._strange = math.nan
        """Time of the last stamped message, where its clock seems to be another."""
        self._waiting: list[tuple[T, float]] = []

    def stamped(self, item: T, time: float, received: float) -> list[Placed[T]]:
        """Takes a message with a stamp; returns those that waited for one newer than all before, then itself.

        Args:
            item: the message.
            time: its stamp [s], unwrapped.
            received: when it came at the latest [s], on any clock.
        """
        if self.newest is not None:
            step, passed, before = time - self.newest, received - self._newest_received, self._strange
            self._strange = math.nan
            if -FARTHEST <= step <= 0.0:
                if step >= -MOMENT:
                    self._newest_received = received
                return [(item, time)]
            # A clock of one message is no clock of others; two messages in a row may be a reboot.
            if not (0.0 < step <= FARTHEST or abs(step - passed) <= FARTHEST or abs(time - before) <= FARTHEST):
                self._strange = time
                return [(item, time)]
        placed = self._release(time) if self._waiting else []
        self.newest, self._newest_received = time, received
        return [*placed, (item, time)]

    def unstamped(self, item: T, received: float) -> list[Placed[T]]:
        """Takes a message without a stamp, which came after `received` [s]; returns those that waited too long."""
        early = self._release(None) if len(self._waiting) >= MOST_WAITING else []
        self._waiting.append((item, max(0.0, received - self._newest_received)))
        return early

    def finish(self) -> list[Placed[T]]:
        """Returns the messages that still wait, when no other will come."""
        return self._release(None)

    def _release(self, following: float | None) -> list[Placed[T]]:
        placed: list[Placed[T]] = [(item, self._between(later, following)) for item, later in self._waiting]
        self._waiting.clear()
        return placed

    def _between(self, later: float, following: float | None) -> float | None:
        """Time of a message that came `later` than the stamped one before it, before a stamp of `following` [s]."""
        if self.newest is None:
            return None
        if following is not None and following >= self.newest:
            return min(self.newest + later, following)
        return self.newest + later if later <= FARTHEST else None
