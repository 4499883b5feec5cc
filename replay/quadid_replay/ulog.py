"""PX4 ULog."""

import mmap
import re
import struct
from collections.abc import Mapping
from dataclasses import replace
from io import BytesIO
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from quadid.data.rotor_signal import px4_allocation
from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import FloatArray
from quadid_replay.columns import (
    LogClock,
    RawChannel,
    Source,
    assemble,
    channels_of,
    damage,
    fastest_first,
    mode_changes,
    to_euler,
)
from quadid_replay.motors import (
    DSHOT,
    MOST_ROTORS,
    PX4_BANKS,
    RPM,
    UAVCAN,
    active_outputs,
    esc_columns,
    in_pulses,
    motor_columns,
    no_multirotor,
    px4_motor_outputs,
    px4_rotor_count,
)

# --- Walks through the records of a PX4 ULog and hands pyulog only whole ones, of the topics that are wanted
#
# To pyulog a file is not corrupt when it simply ends inside a record (26 of 30 random cuts), and loops for ever on
# some damaged definitions.


_KNOWN = "BFIMPQARDLCSO"
"""Kinds of records."""
_SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_HEADER = 16
_NEAR = 65536
"""Distance behind a damaged place in which records are looked for byte by byte; further on only sync marks are."""
_CHAIN = 3
"""So many plausible records in a row are believed to be records."""


class UlogRecords(NamedTuple):
    """Result of a walk.

    Attributes:
        clean: header and whole records of definitions, parameters, and data of the wanted topics.
        skipped: bytes that belong to no record.
        cut: whether the file ends inside a record.
        described_anew: a message that the file describes twice, differently; what follows is not read. Empty for none.
    """

    clean: BytesIO
    skipped: int
    cut: bool
    described_anew: str


def collect_records(path: Path, topics: frozenset[str]) -> UlogRecords:
    """Walks through all records and keeps those that matter for `topics`.

    Raises:
        LogError: an encrypted or future log, or a file without any record.
    """
    if path.stat().st_size <= _HEADER:
        raise LogError(f"{path.name}: holds a header and nothing else", "a complete ULog", "copy it again")
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    clean = BytesIO()
    clean.write(data[:_HEADER])
    formats: dict[str, str] = {}
    instances: set[tuple[str, int]] = set()
    wanted: set[int] = set()
    lengths: dict[int, int] = {}  # of the data records, by the number of their topic
    boundaries: tuple[int, ...] = ()
    skipped, sync, anew = 0, 0, ""
    offset, size = _HEADER, len(data)
    while offset + 3 <= size and not anew:
        length, kind = data[offset] | data[offset + 1] << 8, chr(data[offset + 2])
        end = offset + 3 + length
        # The logger stopped here and went on at a boundary.
        appended = next((b for b in boundaries if offset < b < end), None)
        if appended is not None:
            offset = appended
            continue
        # Damage: records go on after the next sync mark, or nearby where several plausible ones follow.
        if kind not in _KNOWN or length == 0 or (end > size and skipped):
            if sync <= offset:
                sync = data.find(_SYNC, offset + 1)
                sync = size if sync < 0 else sync
            after = min(sync + len(_SYNC), size)
            near = range(offset + 1, min(offset + 1 + _NEAR, after))
            following = next((place for place in near if _plausible(data, place, lengths)), after)
            skipped += following - offset
            offset = following
            continue
        if end > size:
            break
        body = data[offset + 3 : end]
        offset = end
        # Which of the whole records are kept.
        if kind == "B":
            boundaries = _boundaries(path.name, body)
            continue
        if kind == "F":
            name, _, fields = body.decode("utf-8", "replace").partition(":")
            if formats.setdefault(name, fields) != fields:
                anew = plain(name, 40)
                continue
        elif kind == "A":
            topic = unversioned(body[3:].decode("utf-8", "replace"))
            if topic not in topics or (topic, body[0]) in instances:  # the first one of a topic's instance is read
                continue
            instances.add((topic, body[0]))
            wanted.add(body[1] | body[2] << 8)
        elif kind == "D" and length > 2:
            number = body[0] | body[1] << 8
            lengths.setdefault(number, length)
            if number not in wanted:
                continue
        elif kind != "P":
            continue
        clean.write(data[end - 3 - length : end])
    clean.seek(0)
    return UlogRecords(clean, skipped, offset < size and not anew, anew)


def unversioned(topic: str) -> str:
    """Name of a topic without the version that newer PX4 appends (`vehicle_status_v1`)."""
    return re.sub(r"_v\d{1,3}$", "", topic)


def _plausible(data: mmap.mmap, offset: int, lengths: Mapping[int, int]) -> bool:
    """True if a data record seems to begin here, with others behind it."""
    for k in range(_CHAIN):
        if offset + 5 > len(data):
            return False
        length, kind = data[offset] | data[offset + 1] << 8, chr(data[offset + 2])
        if kind not in (_KNOWN if k else "D") or not 0 < length <= 10000:
            return False
        if kind == "D" and lengths.get(data[offset + 3] | data[offset + 4] << 8) != length:
            return False
        offset += 3 + length
    return True


def _boundaries(name: str, body: bytes) -> tuple[int, ...]:
    """Offsets at which data were appended, of a record of flags; raises LogError for flags of a future format."""
    if len(body) < 40:
        return ()
    if body[8] & ~1 or any(body[9:16]):
        raise LogError(f"{name}: flags that this version cannot read", "ULog version 1", "update quadid")
    return struct.unpack("<3Q", body[16:40]) if body[8] & 1 else ()


# --- PX4's control allocation: from torque and thrust setpoints, logged at 50 Hz, to the motors, logged at 10 Hz
#
# By the rotors' geometry in the log's own parameters (`px4_allocation`; ActuatorEffectivenessRotors of its sources).
# Where a motor would leave 0 to 1 PX4 gives up torque for it in steps that are not repeated here; such rows have no
# value.


_DEFAULTS = {"AX": 0.0, "AY": 0.0, "AZ": -1.0, "PX": 0.0, "PY": 0.0, "PZ": 0.0, "CT": 6.5, "KM": 0.05}


def allocation(parameters: Mapping[str, float]) -> FloatArray | None:
    """Matrix from torque and thrust setpoints (x, y, z each, FRD) to motors, shape (rotors, 6).

    Args:
        parameters: of the autopilot, by name (CA_AIRFRAME, CA_ROTORn_*).

    Returns:
        None where these are not told, or not of a multirotor.
    """
    count = px4_rotor_count(parameters)
    if not count or parameters.get("CA_AIRFRAME") != 0.0:  # a multirotor, whose rotors alone make forces and moments
        return None
    rotors = [
        {k: float(parameters.get(f"CA_ROTOR{i}_{k}", default)) for k, default in _DEFAULTS.items()}
        for i in range(count)
    ]
    place, axis = (np.array([[r[f"{kind}{a}"] for a in "XYZ"] for r in rotors]) for kind in "PA")
    strength, drag = (np.array([r[k] for r in rotors]) for k in ("CT", "KM"))
    return px4_allocation(place, axis, strength, drag) if np.all(np.any(axis != 0.0, axis=1)) else None


def allocated(mix: FloatArray, setpoints: FloatArray) -> FloatArray:
    """Motors, relative thrust 0 to 1, shape (n, rotors); rows in which PX4 would have limited one are not finite.

    Args:
        mix: of `allocation`.
        setpoints: torque and thrust, shape (n, 6).
    """
    motors = setpoints @ mix.T
    limited = np.any((motors < 0.0) | (motors > 1.0), axis=1)
    motors[limited] = np.nan
    return motors


# --- PX4 ULog: which topic holds which channel
#
# Body FRD and world NED are PX4's own; time is microseconds since boot, `timestamp_sample` where a topic has it.


def _numbered(name: str, count: int) -> tuple[str, ...]:
    return tuple(f"{name}[{i}]" for i in range(count))


def _increments(rows: FloatArray) -> FloatArray:
    """Mean rates of increments and the interval [us] that each is of."""
    with np.errstate(divide="ignore", invalid="ignore"):
        return rows[:, :3] / (rows[:, 3:] * 1e-6)


def _reference(rows: FloatArray) -> FloatArray:
    return np.column_stack([to_euler(rows[:, :4]), -rows[:, 4]])


def _volts(rows: FloatArray) -> FloatArray:
    return rows if np.any(rows > 0.0) else np.full_like(rows, np.nan)


_XYZ = _numbered("xyz", 3)
_SETPOINTS = ("torque", "thrust")
SOURCES = (
    Source("gyro", "sensor_combined", (*_numbered("gyro_rad", 3), "gyro_integral_dt"), lambda rows: rows[:, :3]),
    Source("gyro", "vehicle_imu", (*_numbered("delta_angle", 3), "delta_angle_dt"), _increments),
    Source("gyro", "vehicle_angular_velocity", _XYZ, note="(filtered on board)"),
    Source(
        "accel",
        "sensor_combined",
        (*_numbered("accelerometer_m_s2", 3), "accelerometer_integral_dt"),
        lambda rows: rows[:, :3],
    ),
    Source("accel", "vehicle_imu", (*_numbered("delta_velocity", 3), "delta_velocity_dt"), _increments),
    Source("accel", "vehicle_acceleration", _XYZ, note="(filtered on board)"),
    Source("attitude", "vehicle_attitude", _numbered("q", 4)),
    Source("attitude_reference", "vehicle_attitude_setpoint", (*_numbered("q_d", 4), "thrust_body[2]"), _reference),
    Source("velocity", "vehicle_local_position", ("vx", "vy", "vz")),
    Source("position", "vehicle_local_position", ("x", "y", "z")),
    Source("battery", "battery_status", ("voltage_v",), _volts),
)
"""In order of preference."""
_TOPICS = frozenset(
    {
        *(source.records for source in SOURCES),
        *(f"vehicle_{name}_setpoint" for name in _SETPOINTS),
        *("actuator_motors", "actuator_outputs"),
        *("esc_status", "vehicle_status"),
    }
)
_MODES = {
    0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return", 10: "Acro", 12: "Descend",
    13: "Termination", 14: "Offboard", 15: "Stabilized", 17: "Takeoff", 18: "Land", 19: "Follow", 20: "Precision land",
    21: "Orbit", 22: "VTOL takeoff",
}  # fmt: skip
"""Names of flight modes: nav_state of vehicle_status."""
_VALID = {"vx": "v_xy_valid", "x": "xy_valid"}
"""Fields that say whether another is known."""
_UAVCAN_OUTPUTS = 3
"""UAVCAN_ENABLE from which motors are on it."""
_FEWEST_COMPARED = 20
"""Logged rows of motors that must show how the vehicle allocates."""
_ALLOCATED_ALIKE = 0.005
"""Largest difference of allocated and logged motors, in nine rows of ten."""


class _Log(NamedTuple):
    """Topic instances by (name, instance), and parameters."""

    topics: dict[tuple[str, int], dict[str, NDArray[Any]]]
    parameters: dict[str, float]

    def columns(self, topic: str, *names: str, instance: int = 0) -> FloatArray | None:
        """Fields of a topic, shape (n, len(names)); None where the log lacks one of them."""
        data = self.topics.get((topic, instance), {})
        if not {"timestamp", *names} <= data.keys():
            return None
        with np.errstate(invalid="ignore"):  # damaged records hold signalling NaN
            return np.column_stack([data[name].astype(np.float64) for name in names])

    def times(self, topic: str, stamp: str = "timestamp", instance: int = 0) -> FloatArray:
        """Times [s] of a topic; NaN for stamps far from their neighbours.

        A ULog is written by one boot, so each topic has its own clock and a step back is damage, not a reboot.
        """
        data = self.topics[topic, instance]
        raw = data[stamp if stamp in data and np.any(data[stamp]) else "timestamp"].astype(np.float64) * 1e-6
        return np.where(LogClock().times(raw) == raw, raw, np.nan)

    def motors(self, topic: str, values: FloatArray, note: str, instance: int = 0) -> RawChannel:
        """Outputs in a topic, shape (n, rotors)."""
        name = f"{topic} {instance}" if instance else topic
        return RawChannel("motor_command", self.times(topic, instance=instance), values, f"{name} ({note})")


def read_ulog(path: Path) -> Recording:
    """Reads a ULog, whole or damaged.

    Raises:
        LogError: nothing usable in it.
    """
    records = collect_records(path, _TOPICS)
    try:
        ulog = ULog(records.clean)
    except (ULogException, ValueError, LookupError, TypeError, ArithmeticError, struct.error, RecursionError) as error:
        raise LogError(
            f"{path.name}: its definitions are damaged ({type(error).__name__}: {plain(str(error), 80)})",
            "a PX4 ULog",
            "copy the file again from the vehicle",
        ) from error
    topics = {(unversioned(d.name), d.multi_id): d.data for d in reversed(ulog.data_list)}
    parameters = {str(k): float(v) for k, v in ulog.initial_parameters.items() if isinstance(v, int | float)}
    log = _Log(topics, parameters)
    again = records.described_anew
    notes = damage(
        path.stat().st_size,
        records.skipped,
        records.cut,
        again and f"{again} redefined within the log: data after the change are not used",
    )
    raw = channels_of(SOURCES, lambda source: _rows(log, source), 2.0)
    other = no_multirotor(log.parameters)
    if not other:
        raw += fastest_first([*_actuator_motors(log), *_actuator_outputs(log), *_allocated(log)], 2.0)
        raw += _esc(log, notes)
    recording = assemble(path.name, "ulog", raw, LogClock(), notes, log.parameters, other)
    states = log.columns("vehicle_status", "nav_state")
    if states is None:
        return recording
    return replace(recording, modes=mode_changes(log.times("vehicle_status"), states[:, 0], _MODES))


def _rows(log: _Log, source: Source) -> tuple[FloatArray, FloatArray] | None:
    """Times and columns of a topic's first instance; a mean over an interval before its stamp counts at the middle."""
    values = log.columns(source.records, *source.columns)
    if values is None:
        return None
    t = log.times(source.records, "timestamp_sample")
    valid = log.columns(source.records, _VALID.get(source.columns[0], ""))
    if valid is not None:
        values[valid[:, 0] == 0.0] = np.nan
    if source.columns[-1].endswith("_dt"):
        t = t - 0.5e-6 * values[:, -1]
    relative = log.columns(source.records, "accelerometer_timestamp_relative")
    if source.channel == "accel" and relative is not None:
        t = t + relative[:, 0] * 1e-6
        values[np.abs(relative[:, 0] * 1e-6) >= 1.0] = np.nan  # a huge one marks an invalid sample
    return t, values


def _actuator_motors(log: _Log) -> list[RawChannel]:
    values = log.columns("actuator_motors", *_numbered("control", 12))
    if values is None:
        return []
    count = px4_rotor_count(log.parameters) or int(np.count_nonzero(np.isfinite(values).any(axis=0)))
    return [log.motors("actuator_motors", *_commanded(log, values[:, :count], "normalized"))]


def _commanded(log: _Log, thrust: FloatArray, how: str) -> tuple[FloatArray, str]:
    """Output to the ESCs of relative thrust (n, rotors), as PX4 itself makes it with THR_MDL_FAC."""
    factor = log.parameters.get("THR_MDL_FAC", 0.0)
    if factor <= 0.0:
        return thrust, how
    rest = 1.0 - factor
    command = (np.sqrt(rest**2 + 4.0 * factor * np.maximum(thrust, 0.0)) - rest) / (2.0 * factor)
    return command, f"{how}, THR_MDL_FAC {factor:g} undone"


def _allocated(log: _Log) -> list[RawChannel]:
    """Motors as PX4 allocates them, of torque and thrust setpoints of one moment; only where logged motors agree."""
    mix = allocation(log.parameters)
    torque, thrust = (log.columns(f"vehicle_{name}_setpoint", "timestamp_sample", *_XYZ) for name in _SETPOINTS)
    if mix is None or torque is None or thrust is None:
        return []
    moment, of_torque, of_thrust = np.intersect1d(torque[:, 0], thrust[:, 0], return_indices=True)
    motors = allocated(mix, np.hstack([torque[of_torque, 1:], thrust[of_thrust, 1:]]))
    # Logged motors must be those allocated, where both are there.
    logged = log.columns("actuator_motors", "timestamp_sample", *_numbered("control", len(mix)))
    if logged is None:
        return []
    _, here, there = np.intersect1d(moment, logged[:, 0], return_indices=True)
    off = motors[here] - logged[there, 1:]
    off = off[np.isfinite(off).all(axis=1)]
    if len(off) < _FEWEST_COMPARED or np.quantile(np.abs(off), 0.9) >= _ALLOCATED_ALIKE:
        return []
    values = np.full((len(torque), len(mix)), np.nan)
    values[of_torque] = motors
    how = "allocated as actuator_motors, normalized"
    return [log.motors("vehicle_torque_setpoint", *_commanded(log, values, how))]


def _actuator_outputs(log: _Log) -> list[RawChannel]:
    """Columns that go to the ESCs; of the banks and several instances the first whose motor columns look like it.

    Pulse widths, but with DShot or UAVCAN numbers up to their full command.
    """
    topic, count = "actuator_outputs", px4_rotor_count(log.parameters)
    full = DSHOT if log.parameters.get("DSHOT_CONFIG", 0.0) > 0.0 else None
    if log.parameters.get("UAVCAN_ENABLE", 0.0) >= _UAVCAN_OUTPUTS:
        full = UAVCAN
    for instance in range(4):
        outputs = log.columns(topic, *_numbered("output", 16), instance=instance)
        if outputs is None:
            continue
        values, how = in_pulses(outputs)
        pulses = values
        if full is not None and np.max(values) <= full:  # made to look like pulses, to find those that vary
            values, how, pulses = values / full, f"of {full:g}", 1000.0 + 1000.0 / full * values
        for bank in PX4_BANKS:
            motors = px4_motor_outputs(log.parameters, bank)
            if motors and len(active_outputs(pulses[:, motors])) == len(motors):
                return [log.motors(topic, values[:, motors], f"{how or 'us'}, {bank}", instance)]
        motors = active_outputs(pulses)
        if motors and (not count or len(motors) >= count):
            return [log.motors(topic, values[:, : count or len(motors)], how or "us", instance)]
    return []


def _esc(log: _Log, notes: list[str]) -> list[RawChannel]:
    topic, count = "esc_status", px4_rotor_count(log.parameters)
    if log.columns(topic, "esc[0].esc_rpm") is None:
        return []
    data = log.topics[topic, 0]
    rpm = [data[name] for k in range(MOST_ROTORS) if (name := f"esc[{k}].esc_rpm") in data]
    functions = [int(data.get(f"esc[{k}].actuator_function", [0])[-1]) for k in range(len(rpm))]
    columns, problem = motor_columns(functions), ""
    if not columns:  # older logs do not say which motor an ESC drives
        columns, problem, _ = esc_columns(log.parameters, count, [bool(np.any(r)) for r in rpm], topic)
    if not problem and (not columns or max(columns) >= len(rpm) or (count and len(columns) != count)):
        problem = f"{topic}: speeds of {len(columns)} motors, but the vehicle has {count}: they are not used"
    speeds = None if problem else log.columns(topic, *(f"esc[{k}].esc_rpm" for k in columns))
    if speeds is None:
        notes.append(problem)
        return []
    return [RawChannel("rotor_speed", log.times(topic), np.abs(speeds) * RPM, f"{topic} (rpm)")]
