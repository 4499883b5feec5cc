"""PX4 ULog: which topic holds which channel.

Body FRD and world NED are PX4's own; time is microseconds since boot, `timestamp_sample` where a topic has it.
"""

from __future__ import annotations

import struct
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pyulog import ULog
from pyulog.exceptions import ULogException

from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import FloatArray, IntArray
from quadid.window import Recording
from quadid_replay.clocks import LogClock
from quadid_replay.columns import RawChannel, assemble, fastest_first
from quadid_replay.flight_modes import PX4, mode_changes
from quadid_replay.frames import to_euler
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
)  # fmt: skip
from quadid_replay.px4_allocation import allocated, allocation
from quadid_replay.ulog_check import UlogRecords, collect_records, unversioned

_TOPICS = frozenset((
    "sensor_combined", "vehicle_imu", "vehicle_angular_velocity", "vehicle_acceleration", "vehicle_attitude",
    "vehicle_attitude_setpoint", "vehicle_local_position", "battery_status", "actuator_motors", "actuator_outputs",
    "esc_status", "vehicle_status", "vehicle_torque_setpoint", "vehicle_thrust_setpoint",
))  # fmt: skip
_XYZ = ("xyz[0]", "xyz[1]", "xyz[2]")
_UAVCAN_OUTPUTS = 3
"""UAVCAN_ENABLE from which motors are on it."""
_FEWEST_COMPARED = 20
"""Logged rows of motors that must show how the vehicle allocates."""
_ALLOCATED_ALIKE = 0.005
"""Largest difference of allocated and logged motors, in nine rows of ten."""


class _Log(NamedTuple):
    """Topic instances by (name, instance), parameters, and the clock that counts wild stamps."""

    topics: dict[tuple[str, int], dict[str, NDArray[Any]]]
    parameters: dict[str, float]
    clock: LogClock


def read_ulog(path: Path) -> Recording:
    """Reads a ULog, whole or damaged.

    Raises:
        LogError: nothing usable in it.
    """
    records = collect_records(path, _TOPICS)
    log = _load(path, records)
    notes = _notes(records, path.stat().st_size)
    raw = [
        *fastest_first(_gyro(log), 2.0),
        *fastest_first(_accel(log), 2.0),
        *_simple(log, "attitude", "vehicle_attitude", tuple(f"q[{i}]" for i in range(4))),
        *_reference(log),
        *_simple(log, "velocity", "vehicle_local_position", ("vx", "vy", "vz"), "v_xy_valid"),
        *_simple(log, "position", "vehicle_local_position", ("x", "y", "z"), "xy_valid"),
        *_battery(log),
    ]
    if other := no_multirotor(log.parameters):
        notes.append(other)
    else:
        raw += fastest_first([*_actuator_motors(log), *_actuator_outputs(log), *_allocated(log)], 2.0)
        raw += _esc(log, notes)
    recording = assemble(path.name, "ulog", raw, log.clock, notes, log.parameters)
    return replace(recording, modes=_modes(log))


def _modes(log: _Log) -> tuple[tuple[float, str], ...]:
    key = ("vehicle_status", 0)
    if not _has(log, key, "nav_state"):
        return ()
    t, accepted = LogClock().times(log.topics[key]["timestamp"].astype(np.float64) * 1e-6)
    return mode_changes(np.where(accepted, t, np.nan), log.topics[key]["nav_state"].astype(np.float64), PX4)


def _notes(records: UlogRecords, size: int) -> list[str]:
    notes = []
    if records.skipped:
        notes.append(f"{records.skipped} of {size} bytes are damaged and were skipped")
    if records.described_anew:
        notes.append(f"{records.described_anew} redefined within the log: data after the change are not used")
    if records.cut:
        notes.append("the file ends inside a record: it was cut; everything before is used")
    return notes


def _load(path: Path, records: UlogRecords) -> _Log:
    try:
        ulog = ULog(records.clean)
    except (ULogException, ValueError, LookupError, TypeError, ArithmeticError, struct.error, RecursionError) as error:
        raise LogError(
            f"{path.name}: its definitions are damaged ({type(error).__name__}: {plain(str(error), 80)})",
            "a PX4 ULog", "copy the file again from the vehicle",
        ) from error  # fmt: skip
    topics = {(unversioned(d.name), d.multi_id): d.data for d in reversed(ulog.data_list)}
    parameters = {
        str(k): float(v) for k, v in ulog.initial_parameters.items() if isinstance(v, int | float)
    }  # fmt: skip
    return _Log(topics, parameters, LogClock())


def _raw(
    log: _Log, channel: str, key: tuple[str, int], values: FloatArray, stamp: str = "timestamp_sample", note: str = ""
) -> RawChannel:
    """Makes a channel of one topic instance; stamps far from their neighbours are refused.

    A ULog is written by one boot, so each topic has its own clock and a step back is damage, not a reboot.
    """
    data = log.topics[key]
    raw = data[stamp if stamp in data and np.any(data[stamp]) else "timestamp"].astype(np.float64) * 1e-6
    t, accepted = LogClock().times(raw)
    accepted &= t == raw
    log.clock.wild += int(np.count_nonzero(~accepted))
    source = f"{key[0]}{f' {key[1]}' if key[1] else ''}{f' ({note})' if note else ''}"
    return RawChannel(channel, t[accepted], values[accepted], source)


def _stack(data: dict[str, NDArray[Any]], columns: tuple[str, ...]) -> FloatArray:
    with np.errstate(invalid="ignore"):  # damaged records hold signalling NaN
        return np.column_stack([data[c].astype(np.float64) for c in columns])


def _has(log: _Log, key: tuple[str, int], *columns: str) -> bool:
    return key in log.topics and "timestamp" in log.topics[key] and all(c in log.topics[key] for c in columns)


def _simple(log: _Log, channel: str, topic: str, columns: tuple[str, ...], valid: str = "") -> list[RawChannel]:
    key = (topic, 0)
    if not _has(log, key, *columns):
        return []
    values = _stack(log.topics[key], columns)
    if valid and _has(log, key, valid):
        values[log.topics[key][valid] == 0] = np.nan
        if np.isnan(values).all():
            return []
    return [_raw(log, channel, key, values)]


def _gyro(log: _Log) -> list[RawChannel]:
    out = _means(log, "gyro", "sensor_combined", "gyro_rad", "gyro_integral_dt")
    out += _means(log, "gyro", "vehicle_imu", "delta_angle", "delta_angle_dt")
    for entry in _simple(log, "gyro", "vehicle_angular_velocity", _XYZ):
        out.append(entry._replace(source="vehicle_angular_velocity (filtered on board)"))
    return out


def _accel(log: _Log) -> list[RawChannel]:
    out = _means(log, "accel", "sensor_combined", "accelerometer_m_s2", "accelerometer_integral_dt")
    out += _means(log, "accel", "vehicle_imu", "delta_velocity", "delta_velocity_dt")
    for entry in _simple(log, "accel", "vehicle_acceleration", _XYZ):
        out.append(entry._replace(source="vehicle_acceleration (filtered on board)"))
    return out


def _means(log: _Log, channel: str, topic: str, field: str, interval: str) -> list[RawChannel]:
    """Means over an interval [us] that ends at the stamp count at its middle; increments are divided by it first."""
    key = (topic, 0)
    columns = tuple(f"{field}[{i}]" for i in range(3))
    if not _has(log, key, *columns, interval):
        return []
    data = log.topics[key]
    width = data[interval].astype(np.float64) * 1e-6
    values = _stack(data, columns)
    if field.startswith("delta"):
        with np.errstate(divide="ignore", invalid="ignore"):
            values = values / width[:, None]
    shift = -0.5 * width
    if channel == "accel" and _has(log, key, "accelerometer_timestamp_relative"):
        relative = data["accelerometer_timestamp_relative"].astype(np.float64) * 1e-6
        shift = np.where(np.abs(relative) < 1.0, shift + relative, np.nan)  # a huge one marks an invalid sample
    entry = _raw(log, channel, key, np.column_stack([values, shift]))
    return [entry._replace(t=entry.t + entry.values[:, 3], values=entry.values[:, :3])]


def _reference(log: _Log) -> list[RawChannel]:
    key = ("vehicle_attitude_setpoint", 0)
    columns = tuple(f"q_d[{i}]" for i in range(4))
    if not _has(log, key, *columns, "thrust_body[2]"):
        return []
    throttle = -_stack(log.topics[key], ("thrust_body[2]",))
    values = np.column_stack([to_euler(_stack(log.topics[key], columns)), throttle])
    return [_raw(log, "attitude_reference", key, values, "timestamp")]


def _battery(log: _Log) -> list[RawChannel]:
    key = ("battery_status", 0)
    if not _has(log, key, "voltage_v") or not np.any(log.topics[key]["voltage_v"] > 0.0):
        return []
    return [_raw(log, "battery", key, _stack(log.topics[key], ("voltage_v",)), "timestamp")]


def _actuator_motors(log: _Log) -> list[RawChannel]:
    key = ("actuator_motors", 0)
    columns = tuple(f"control[{i}]" for i in range(12))
    if not _has(log, key, *columns):
        return []
    values = _stack(log.topics[key], columns)
    count = px4_rotor_count(log.parameters) or int(np.count_nonzero(np.isfinite(values).any(axis=0)))
    return [_motor_command(log, key, values[:, :count])]


def _motor_command(log: _Log, key: tuple[str, int], thrust: FloatArray, how: str = "normalized") -> RawChannel:
    """What goes to the ESCs of relative thrust (n, rotors), as PX4 itself makes it with THR_MDL_FAC."""
    factor = log.parameters.get("THR_MDL_FAC", 0.0)
    if factor > 0.0:
        rest = 1.0 - factor
        thrust = (np.sqrt(rest**2 + 4.0 * factor * np.maximum(thrust, 0.0)) - rest) / (2.0 * factor)
        how += f", THR_MDL_FAC {factor:g} undone"
    return _raw(log, "motor_command", key, thrust, "timestamp", how)


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
    """Whether logged motors are those allocated (n, rotors) of setpoints at `moment` (n,), where both are there."""
    motors, columns = ("actuator_motors", 0), tuple(f"control[{i}]" for i in range(thrust.shape[1]))
    if not _has(log, motors, *columns, "timestamp_sample"):
        return False
    _, here, there = np.intersect1d(moment, log.topics[motors]["timestamp_sample"], return_indices=True)
    off = thrust[here] - _stack(log.topics[motors], columns)[there]
    off = off[np.isfinite(off).all(axis=1)]
    return len(off) >= _FEWEST_COMPARED and bool(np.quantile(np.abs(off), 0.9) < _ALLOCATED_ALIKE)


def _actuator_outputs(log: _Log) -> list[RawChannel]:
    """What goes to the ESCs; of the banks and several instances the first whose motor columns look like it.

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
                return [_raw(log, "motor_command", key, values[:, motors], "timestamp", f"{how or 'us'}, {bank}")]
        motors = active_outputs(pulses)
        if motors and (not count or len(motors) >= count):
            return [_raw(log, "motor_command", key, values[:, : count or len(motors)], "timestamp", how or "us")]
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
    return [_raw(log, "rotor_speed", key, values, "timestamp", "rpm")]
