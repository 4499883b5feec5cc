"""What one vehicle of a telemetry log tells: its signals on one clock, parameters and type."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadid.types import BoolArray, FloatArray, IntArray
from quadid_replay.clocks import LogClock
from quadid_replay.mavlink_decode import Messages
from quadid_replay.motors import ESCS, MOST_ROTORS, changed_within
from quadid_replay.tlog_messages import READERS, Reading, boot_seconds, unix_seconds
from quadid_replay.tlog_times import Stamps, place

_INVALID, _ARDUPILOT = 8, 3
_BACKWARDS = 0.5
"""Boot time that falls by more than this [s] is counted."""
_EPOCH_US = 1e14
"""SYSTEM_TIME tells the date where it counts more than this [us]."""
_WIDTH = {"esc": ESCS, "servo": ESCS, "actuator": 32, "attitude": 4, "attitude_reference": 4, "battery": 1}


class Told(NamedTuple):
    """Messages of one kind, and which frames of the log they are, rising, shape (n,)."""

    which: IntArray
    messages: Messages


class Signal(NamedTuple):
    """Times [s] of n samples, shape (n,), their values, shape (n, columns), and how many the clock refused."""

    t: FloatArray
    values: FloatArray
    refused: int


@dataclass(frozen=True)
class VehicleLog:
    """What one MAVLink component told.

    Attributes:
        clock: of the log.
        signals: by channel and message.
        parameters: of the autopilot, by name.
        changed: which of them that name a motor change within the log; empty for none.
        ardupilot: whether it calls itself one.
        kind: its MAV_TYPE; 0 for unknown.
        rotors: as ESC_INFO says; 0 for unknown, and for more than a vehicle has.
        heard: whether a measurement has its time before the log ends.
        backwards: how often the boot time fell.
    """

    clock: LogClock
    signals: Mapping[tuple[str, str], Signal]
    parameters: Mapping[str, float]
    changed: str
    ardupilot: bool
    kind: int
    rotors: int
    heard: bool
    backwards: int


class _Batch(NamedTuple):
    """Messages of one kind that tell something: n frames, and of all messages of the kind which tell each reading."""

    which: IntArray
    readings: list[tuple[Reading, BoolArray]]
    rows: IntArray
    stamps: Stamps


class _Part(NamedTuple):
    """What messages of one kind tell of a signal: n places in the order of their times, first columns, values."""

    position: IntArray
    place: IntArray
    values: FloatArray


def vehicle_log(told: Mapping[str, Told], received: FloatArray) -> VehicleLog:
    """Gathers what a vehicle tells.

    Args:
        told: its messages, by name.
        received: receive times of all frames of the log [s, UNIX].
    """
    beats = told.get("HEARTBEAT")
    escs = told.get("ESC_INFO")
    clock = LogClock()
    batches = [b for b in (_batch(name, told, received) for name in READERS if name in told) if len(b.which)]
    signals, heard, backwards = _signals(batches, clock) if batches else ({}, False, 0)
    names, values = _parameters(told)
    rotors = 0 if escs is None else int(escs.messages.count.max())
    return VehicleLog(
        clock, signals, dict(zip(names, values, strict=True)), changed_within(names, values),
        beats is not None and int(beats.messages.autopilot[-1]) == _ARDUPILOT,
        0 if beats is None else int(beats.messages.type[-1]), rotors if rotors <= MOST_ROTORS else 0, heard, backwards,
    )  # fmt: skip


def _parameters(told: Mapping[str, Told]) -> tuple[list[str], list[float]]:
    if "PARAM_VALUE" not in told:
        return [], []
    m = told["PARAM_VALUE"].messages
    return list(m.param_id), m.param_value.tolist()


def _batch(name: str, told: Mapping[str, Told], received: FloatArray) -> _Batch:
    which, m = told[name]
    readings = [(r, np.broadcast_to(r.known, len(which))) for r in READERS[name](m)]
    known = np.any([k for _, k in readings], axis=0)
    if name == "RAW_IMU" and "HEARTBEAT" in told:  # elsewhere than in ArduPilot it counts in sensor units
        beats = told["HEARTBEAT"]
        known = known & (_latest(beats.which, beats.messages.autopilot, which, _INVALID) == _ARDUPILOT)
    elif name == "RAW_IMU":
        known = np.zeros(len(which), dtype=np.bool_)
    rows = np.flatnonzero(known)
    which = which[rows]
    unix = np.broadcast_to(unix_seconds(m), len(known))[rows]
    stamps = Stamps(
        received[which], np.broadcast_to(boot_seconds(m), len(known))[rows], unix - _unix_offset(told, which),
        np.full(len(rows), name == "SERVO_OUTPUT_RAW"),
    )  # fmt: skip
    return _Batch(which, readings, rows, stamps)


def _unix_offset(told: Mapping[str, Told], which: IntArray) -> FloatArray:
    """UNIX time of boot [s] as the last SYSTEM_TIME before each frame says; NaN before the first."""
    if "SYSTEM_TIME" not in told:
        return np.full(len(which), np.nan)
    at, m = told["SYSTEM_TIME"]
    dated = m.time_unix_usec > _EPOCH_US
    offset = m.time_unix_usec * 1e-6 - m.time_boot_ms * 1e-3
    return _latest(at[dated], offset[dated], which, np.nan)


def _latest(at: IntArray, values: FloatArray, which: IntArray, otherwise: float) -> FloatArray:
    """The value of the last of the frames `at` before each of `which`."""
    return np.asarray(np.concatenate([[otherwise], values])[np.searchsorted(at, which)], dtype=np.float64)


def _signals(batches: list[_Batch], clock: LogClock) -> tuple[dict[tuple[str, str], Signal], bool, int]:
    """Signals in the order in which they are first told; whether one is before the log ends; falls of boot time."""
    which = np.concatenate([b.which for b in batches])
    in_file = np.argsort(which)
    stamps = Stamps(*(np.concatenate(column)[in_file] for column in zip(*(b.stamps for b in batches), strict=True)))
    placing = place(stamps)
    position = np.empty(len(which), dtype=np.int64)
    position[in_file[placing.order]] = np.arange(len(which))
    known = ~np.isnan(placing.time)
    t = np.full(len(which), np.nan)
    t[known] = clock.in_order(placing.time[known])
    own = placing.boot[~stamps.servo & ~np.isnan(placing.boot)]
    backwards = int(np.count_nonzero(own < np.concatenate([[0.0], own[:-1]]) - _BACKWARDS))

    parts: dict[tuple[str, str], list[_Part]] = {}
    first: dict[tuple[str, str], tuple[int, int]] = {}
    for batch, its in zip(batches, np.split(position, np.cumsum([len(b.which) for b in batches])[:-1]), strict=True):
        for number, (reading, tells) in enumerate(batch.readings):
            key = reading.signal, reading.source
            part = _part(reading, tells, batch.rows, its)
            if len(part.position):
                parts.setdefault(key, []).append(part)
                first[key] = min(first.get(key, (len(t), 0)), (int(part.position.min()), number))
    signals = {key: _signal(key[0], parts[key], t) for key in sorted(parts, key=first.__getitem__)}
    return signals, placing.waited < len(t), backwards


def _part(reading: Reading, tells: BoolArray, rows: IntArray, position: IntArray) -> _Part:
    values = np.empty((len(tells), len(reading.values)))
    for column, value in enumerate(reading.values):
        values[:, column] = value
    places = np.broadcast_to(reading.place, len(tells))
    if len(rows) == len(tells) and tells.all():
        return _Part(position, places, values)
    here = tells[rows]
    rows = rows[here]
    return _Part(position[here], places[rows], values[rows])


def _signal(signal: str, parts: list[_Part], t: FloatArray) -> Signal:
    """The rows of a signal in the order of their times, zeros in columns that its messages lack."""
    position, places, values = parts[0]
    if len(parts) > 1 or np.any(position[1:] < position[:-1]):
        position, places, values = (np.concatenate(column) for column in zip(*parts, strict=True))
        order = np.argsort(position)
        position, places, values = position[order], places[order], values[order]
    width = _WIDTH.get(signal, 3)
    t = t[position]
    if signal in ("esc", "servo"):
        t, values = _rounds(t, places, values, width)
    elif values.shape[1] < width:
        values = np.pad(values, ((0, 0), (0, width - values.shape[1])))
    known = ~np.isnan(t)
    return Signal(t, values, 0) if known.all() else Signal(t[known], values[known], int(np.count_nonzero(~known)))


def _rounds(t: FloatArray, places: IntArray, values: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Joins the messages of one round (four ESCs or sixteen outputs each, rising) to a row at the time of the first."""
    real = places < width  # what no vehicle has is left out
    t, places, values = t[real], places[real], values[real]
    begins = np.ones(len(t), dtype=np.bool_)
    begins[1:] = places[1:] <= places[:-1]
    rows = np.full((int(np.count_nonzero(begins)), width + values.shape[1]), np.nan)
    rows[(np.cumsum(begins) - 1)[:, None], places[:, None] + np.arange(values.shape[1])] = values
    return t[begins], rows[:, :width]
