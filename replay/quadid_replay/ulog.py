"""PX4 ULog."""

import mmap
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
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
from quadid.types import FloatArray, IntArray
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

# isort: off
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
# isort: on

# --- Walks through the records of a PX4 ULog and hands pyulog only whole ones, of the topics that are wanted
#
# To pyulog a file is not corrupt when it simply ends inside a record (26 of 30 random cuts), and loops for ever on
# some damaged definitions.


_KNOWN = frozenset(b"BFIMPQARDLCSO")
_DEFINITIONS = frozenset(b"FP")
_SYNC = bytes((0x2F, 0x73, 0x13, 0x20, 0x25, 0x0C, 0xBB, 0x12))
_HEADER = 16
_NEAR = 65536
"""Distance behind a damaged place in which records are looked for byte by byte; further on only sync marks are."""
_CHAIN = 3
"""So many plausible records in a row are believed to be records."""


@dataclass
class UlogRecords:
    """Result of a walk.

    Attributes:
        clean: header and whole records of definitions, parameters, and data of the wanted topics.
        skipped: bytes that belong to no record.
        cut: whether the file ends inside a record.
        described_anew: a message that the file describes twice, differently; what follows is not read. Empty for none.
    """

    clean: BytesIO
    skipped: int = 0
    cut: bool = False
    described_anew: str = ""
    formats: dict[str, str] = field(default_factory=dict)
    topics: dict[tuple[str, int], str] = field(default_factory=dict)
    """Message by topic without its version and instance."""
    wanted: set[int] = field(default_factory=set)
    lengths: dict[int, int] = field(default_factory=dict)
    boundaries: list[int] = field(default_factory=list)
    sync: int = 0
    """Begin of the next sync mark, as far as it was looked for; the end of the file when there is none."""


def collect_records(path: Path, topics: frozenset[str]) -> UlogRecords:
    """Walks through all records and keeps those that matter for `topics`.

    Raises:
        LogError: an encrypted or future log, or a file without any record.
    """
    if path.stat().st_size <= _HEADER:
        raise LogError(f"{path.name}: holds a header and nothing else", "a complete ULog", "copy it again")
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    found = UlogRecords(BytesIO())
    found.clean.write(data[:_HEADER])
    offset, size = _HEADER, len(data)
    while offset + 3 <= size:
        length, kind = data[offset] | data[offset + 1] << 8, data[offset + 2]
        end = offset + 3 + length
        appended = next((b for b in found.boundaries if offset < b < end), None)
        if appended is not None:  # the logger stopped here and went on at the boundary
            offset = appended
        elif kind not in _KNOWN or length == 0 or (end > size and found.skipped):
            following = _next_record(data, offset + 1, found)
            found.skipped += following - offset
            offset = following
        elif end > size:
            found.cut = True
            break
        else:
            _take(found, path.name, kind, data[offset + 3 : end], topics)
            offset = size if found.described_anew else end
    found.cut |= offset < size
    found.clean.seek(0)
    return found


def _take(found: UlogRecords, name: str, kind: int, body: bytes, topics: frozenset[str]) -> None:
    if kind == ord("B"):
        _note_flags(found, name, body)
        return
    if kind == ord("F"):
        name, _, fields = body.decode("utf-8", "replace").partition(":")
        if found.formats.setdefault(name, fields) != fields:
            found.described_anew = plain(name, 40)
            return
    elif kind == ord("A"):
        message = body[3:].decode("utf-8", "replace")
        if unversioned(message) not in topics or len(body) < 4:
            return
        if (unversioned(message), body[0]) in found.topics:  # the first one of a topic's instance is read
            return
        found.topics[unversioned(message), body[0]] = message
        found.wanted.add(body[1] | body[2] << 8)
    elif kind == ord("D") and len(body) > 2:
        number = body[0] | body[1] << 8
        found.lengths.setdefault(number, len(body))
        if number not in found.wanted:
            return
    elif kind not in _DEFINITIONS:
        return
    found.clean.write(struct.pack("<HB", len(body), kind) + body)


def unversioned(topic: str) -> str:
    """Name of a topic without the version that newer PX4 appends (`vehicle_status_v1`)."""
    return re.sub(r"_v\d{1,3}$", "", topic)


def _next_record(data: mmap.mmap, offset: int, found: UlogRecords) -> int:
    """Returns where records go on: after the next sync mark, or nearby where several plausible ones follow."""
    if found.sync < offset:
        sync = data.find(_SYNC, offset)
        found.sync = len(data) if sync < 0 else sync
    after = min(found.sync + len(_SYNC), len(data))
    for place in range(offset, min(offset + _NEAR, after)):
        if data[place + 2 : place + 3] == b"D" and _plausible(data, place, found):
            return place
    return after


def _plausible(data: mmap.mmap, offset: int, found: UlogRecords) -> bool:
    for _ in range(_CHAIN):
        if offset + 5 > len(data):
            return False
        length, kind = data[offset] | data[offset + 1] << 8, data[offset + 2]
        if kind not in _KNOWN or not 0 < length <= 10000:
            return False
        if kind == ord("D") and found.lengths.get(data[offset + 3] | data[offset + 4] << 8) != length:
            return False
        offset += 3 + length
    return True


def _note_flags(found: UlogRecords, name: str, body: bytes) -> None:
    if len(body) < 40:
        return
    if body[8] & ~1 or any(body[9:16]):
        raise LogError(f"{name}: flags that this version cannot read", "ULog version 1", "update quadid")
    if body[8] & 1:
        found.boundaries = [b for b in struct.unpack("<3Q", body[16:40]) if b]


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


_TOPICS = frozenset((
    "sensor_combined", "vehicle_imu", "vehicle_angular_velocity", "vehicle_acceleration", "vehicle_attitude",
    "vehicle_attitude_setpoint", "vehicle_local_position", "battery_status", "actuator_motors", "actuator_outputs",
    "esc_status", "vehicle_status", "vehicle_torque_setpoint", "vehicle_thrust_setpoint",
))  # fmt: skip


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
    status = log.topics.get(("vehicle_status", 0), {})
    if not {"timestamp", "nav_state"} <= status.keys():
        return recording
    modes = mode_changes(_times(status, "timestamp"), status["nav_state"].astype(np.float64), _MODES)
    return replace(recording, modes=modes)


def _raw(log: _Log, channel: str, key: tuple[str, int], values: FloatArray, note: str = "") -> RawChannel:
    source = f"{key[0]}{f' {key[1]}' if key[1] else ''}{f' ({note})' if note else ''}"
    return RawChannel(channel, _times(log.topics[key], "timestamp"), values, source)


def _times(data: dict[str, NDArray[Any]], stamp: str = "timestamp_sample") -> FloatArray:
    """Times [s] of a topic; NaN for stamps far from their neighbours.

    A ULog is written by one boot, so each topic has its own clock and a step back is damage, not a reboot.
    """
    raw = data[stamp if stamp in data and np.any(data[stamp]) else "timestamp"].astype(np.float64) * 1e-6
    return np.where(LogClock().times(raw) == raw, raw, np.nan)


def _rows(log: _Log, source: Source) -> tuple[FloatArray, FloatArray] | None:
    """Times and columns of a topic's first instance; a mean over an interval before its stamp counts at the middle."""
    key, first = (source.records, 0), source.columns[0]
    if not _has(log, key, *source.columns):
        return None
    data = log.topics[key]
    t, values = _times(data), _stack(data, source.columns)
    if first in _VALID and _has(log, key, _VALID[first]):
        values[data[_VALID[first]] == 0] = np.nan
    if source.columns[-1].endswith("_dt"):
        t = t - 0.5e-6 * values[:, -1]
    if source.channel == "accel" and _has(log, key, "accelerometer_timestamp_relative"):
        relative = data["accelerometer_timestamp_relative"].astype(np.float64) * 1e-6
        t = t + relative
        values[np.abs(relative) >= 1.0] = np.nan  # a huge one marks an invalid sample
    return t, values


def _stack(data: dict[str, NDArray[Any]], columns: tuple[str, ...]) -> FloatArray:
    with np.errstate(invalid="ignore"):  # damaged records hold signalling NaN
        return np.column_stack([data[c].astype(np.float64) for c in columns])


def _has(log: _Log, key: tuple[str, int], *columns: str) -> bool:
    return key in log.topics and "timestamp" in log.topics[key] and all(c in log.topics[key] for c in columns)


def _actuator_motors(log: _Log) -> list[RawChannel]:
    key = ("actuator_motors", 0)
    columns = tuple(f"control[{i}]" for i in range(12))
    if not _has(log, key, *columns):
        return []
    values = _stack(log.topics[key], columns)
    count = px4_rotor_count(log.parameters) or int(np.count_nonzero(np.isfinite(values).any(axis=0)))
    return [_motor_command(log, key, values[:, :count])]


def _motor_command(log: _Log, key: tuple[str, int], thrust: FloatArray, how: str = "normalized") -> RawChannel:
    """Output to the ESCs of relative thrust (n, rotors), as PX4 itself makes it with THR_MDL_FAC."""
    factor = log.parameters.get("THR_MDL_FAC", 0.0)
    if factor > 0.0:
        rest = 1.0 - factor
        thrust = (np.sqrt(rest**2 + 4.0 * factor * np.maximum(thrust, 0.0)) - rest) / (2.0 * factor)
        how += f", THR_MDL_FAC {factor:g} undone"
    return _raw(log, "motor_command", key, thrust, note=how)


def _allocated(log: _Log) -> list[RawChannel]:
    """Motors as PX4 allocates them, of torque and thrust setpoints of one moment; only where logged motors agree."""
    torque, thrust = ("vehicle_torque_setpoint", 0), ("vehicle_thrust_setpoint", 0)
    mix = allocation(log.parameters)
    columns = (*_XYZ, "timestamp_sample")
    if mix is None or not (_has(log, torque, *columns) and _has(log, thrust, *columns)):
        return []
    moment, of_torque, of_thrust = np.intersect1d(
        log.topics[torque]["timestamp_sample"], log.topics[thrust]["timestamp_sample"], return_indices=True
    )
    setpoints = np.hstack([_stack(log.topics[torque], _XYZ)[of_torque], _stack(log.topics[thrust], _XYZ)[of_thrust]])
    values = np.full((len(log.topics[torque]["timestamp"]), len(mix)), np.nan)
    values[of_torque] = allocated(mix, setpoints)
    if not _motors_agree(log, moment, values[of_torque]):
        return []
    return [_motor_command(log, torque, values, "allocated as actuator_motors, normalized")]


def _motors_agree(log: _Log, moment: IntArray, thrust: FloatArray) -> bool:
    """True if logged motors are those allocated (n, rotors) of setpoints at `moment` (n,), where both are there."""
    motors, columns = ("actuator_motors", 0), tuple(f"control[{i}]" for i in range(thrust.shape[1]))
    if not _has(log, motors, *columns, "timestamp_sample"):
        return False
    _, here, there = np.intersect1d(moment, log.topics[motors]["timestamp_sample"], return_indices=True)
    off = thrust[here] - _stack(log.topics[motors], columns)[there]
    off = off[np.isfinite(off).all(axis=1)]
    return len(off) >= _FEWEST_COMPARED and bool(np.quantile(np.abs(off), 0.9) < _ALLOCATED_ALIKE)


def _actuator_outputs(log: _Log) -> list[RawChannel]:
    """Columns that go to the ESCs; of the banks and several instances the first whose motor columns look like it.

    Pulse widths, but with DShot or UAVCAN numbers up to their full command.
    """
    count = px4_rotor_count(log.parameters)
    full = DSHOT if log.parameters.get("DSHOT_CONFIG", 0.0) > 0.0 else None
    if log.parameters.get("UAVCAN_ENABLE", 0.0) >= _UAVCAN_OUTPUTS:
        full = UAVCAN
    for instance in range(4):
        key = ("actuator_outputs", instance)
        columns = tuple(f"output[{i}]" for i in range(16))
        if not _has(log, key, *columns):
            continue
        values, how = in_pulses(_stack(log.topics[key], columns))
        pulses = values
        if full is not None and np.max(values) <= full:  # made to look like pulses, to find those that vary
            values, how, pulses = values / full, f"of {full:g}", 1000.0 + 1000.0 / full * values
        for bank in PX4_BANKS:
            motors = px4_motor_outputs(log.parameters, bank)
            if motors and len(active_outputs(pulses[:, motors])) == len(motors):
                return [_raw(log, "motor_command", key, values[:, motors], note=f"{how or 'us'}, {bank}")]
        motors = active_outputs(pulses)
        if motors and (not count or len(motors) >= count):
            return [_raw(log, "motor_command", key, values[:, : count or len(motors)], note=how or "us")]
    return []


def _esc(log: _Log, notes: list[str]) -> list[RawChannel]:
    key = ("esc_status", 0)
    count = px4_rotor_count(log.parameters)
    if not _has(log, key, "esc[0].esc_rpm"):
        return []
    data = log.topics[key]
    rpm = [data[name] for k in range(MOST_ROTORS) if (name := f"esc[{k}].esc_rpm") in data]
    functions = [int(data.get(f"esc[{k}].actuator_function", [0])[-1]) for k in range(len(rpm))]
    columns, problem = motor_columns(functions), ""
    if not columns:  # older logs do not say which motor an ESC drives
        columns, problem, _ = esc_columns(log.parameters, count, [bool(np.any(r)) for r in rpm], "esc_status")
    if not problem and (not columns or max(columns) >= len(rpm) or (count and len(columns) != count)):
        problem = f"esc_status: speeds of {len(columns)} motors, but the vehicle has {count}: they are not used"
    if problem:
        notes.append(problem)
        return []
    values = np.abs(_stack(data, tuple(f"esc[{k}].esc_rpm" for k in columns))) * RPM
    return [_raw(log, "rotor_speed", key, values, note="rpm")]
