"""Crazyflie µSD logs."""

import math
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import FloatArray, IntArray
from quadid_replay.columns import GRAVITY, LogClock, Source, assemble, channels_of, flip_body, from_euler
from quadid_replay.motors import RPM

# --- Walks through a Crazyflie µSD log: declared event types, then records of them, then a CRC-32 of all that
#
# The layout is in the file: byte 0xBC, version (uint16), number of event types (uint16); per type its id (uint16), its
# name and its variables, zero-ended names with the type of the number in brackets, such as ``gyro.x(f)``.  Each record
# is id (uint16), time (uint64, µs) and the values, little-endian without padding.


MOST_TYPES, MOST_VARIABLES, LONGEST_NAME = 256, 512, 128
_NUMBERS = dict(zip("bBhHiIqQfd", ("i1", "u1", "i2", "u2", "i4", "u4", "i8", "u8", "f4", "f8"), strict=True))
_STAMP = [("id", "<u2"), ("t", "<u8")]
_CRC = 4
_FIRST_LOOK = 16


class UsdRecords(NamedTuple):
    """Result of a walk.

    Attributes:
        tables: records by event type's name: structured arrays with ``t`` [µs] and the variables by their full name.
        places: where in the file each of these records stands.
        notes: what is wrong with the file, in sentences.
    """

    tables: dict[str, NDArray[np.void]]
    places: dict[str, IntArray]
    notes: list[str]


def collect_usd_records(data: bytes, name: str) -> UsdRecords:
    """Reads all whole records.

    Raises:
        LogError: declarations that are damaged: without them no record can be read.
    """
    types, at = _declarations(data, name)
    parts: dict[int, list[NDArray[np.void]]] = {}
    places: dict[int, list[IntArray]] = {}
    notes = []
    end = len(data)
    if end - at >= _CRC and zlib.crc32(data[:-_CRC]) == int.from_bytes(data[-_CRC:], "little"):
        end -= _CRC
    else:
        notes.append("checksum does not match: the log was cut off or damaged")
    while at + 2 <= end and (number := int.from_bytes(data[at : at + 2], "little")) in types:
        _, layout = types[number]
        run = _run(data, at, end, layout)
        if len(run) == 0:
            break
        parts.setdefault(number, []).append(run)
        places.setdefault(number, []).append(at + layout.itemsize * np.arange(len(run), dtype=np.int64))
        at += run.nbytes
    if at < end:
        notes.append(f"{end - at} bytes at the end belong to no record")
    found = [(number, title) for number, (title, _) in types.items() if number in parts]
    tables = {title: np.concatenate(parts[number]) for number, title in found}
    return UsdRecords(tables, {title: np.concatenate(places[number]) for number, title in found}, notes)


def _run(data: bytes, at: int, end: int, layout: np.dtype[np.void]) -> NDArray[np.void]:
    """The records of one type that follow each other from `at` on, without one of another between them.

    It is looked for in stretches that double, so that the work is that of its own length, however much follows.
    """
    rows = np.frombuffer(data, layout, max((end - at) // layout.itemsize, 0), at)
    known, looked = 0, _FIRST_LOOK
    while known < len(rows):
        other = np.flatnonzero(rows["id"][known:looked] != rows["id"][0])
        if len(other):
            return rows[: known + other[0]]
        known, looked = looked, 2 * looked
    return rows


def _declarations(data: bytes, name: str) -> tuple[dict[int, tuple[str, np.dtype[np.void]]], int]:
    """Name and layout of the records of each event type, by id, and where the records begin."""
    at, types = 5, {}
    try:
        (count,) = struct.unpack_from("<H", data, 3)
        if not 0 < count <= MOST_TYPES:
            raise ValueError(f"{count} event types")
        for _ in range(count):
            (number,) = struct.unpack_from("<H", data, at)
            title, at = _text(data, at + 2)
            (width,) = struct.unpack_from("<H", data, at)
            if width > MOST_VARIABLES:
                raise ValueError(f"{width} variables in '{plain(title)}'")
            at += 2
            fields = list(_STAMP)
            for _ in range(width):
                variable, at = _text(data, at)
                # Name and layout of a variable such as ``gyro.x(f)``
                if len(variable) < 4 or variable[-3] != "(" or variable[-1] != ")" or variable[-2] not in _NUMBERS:
                    raise ValueError(f"variable '{plain(variable)}' of unknown type")
                fields.append((variable[:-3], "<" + _NUMBERS[variable[-2]]))
            if number in types:
                raise ValueError(f"event type {number} twice")
            types[number] = title, np.dtype(fields)
    except (struct.error, ValueError) as error:
        raise LogError(
            f"{name}: damaged list of variables ({error})", "a Crazyflie µSD log, version 2", "copy the file again"
        ) from error
    return types, at


def _text(data: bytes, at: int) -> tuple[str, int]:
    """A zero-ended name and where the next thing begins."""
    end = data.find(b"\0", at, at + LONGEST_NAME)
    if end < 0:
        raise ValueError("a name without end")
    return data[at:end].decode("ascii"), end + 1


# --- Crazyflie µSD logs: which of the firmware's variables are which channel, in core units and frames
#
# The firmware's body frame is x forward, y left, z up and its world z up; what its `controller` group holds is in the
# frame of the old controllers: roll and pitch positive to the right and nose up, yaw positive to the left.  World and
# body are turned alike, about their x axis.


FULL_SCALE = 65535.0
"""The firmware's full motor command."""


def _axes(prefix: str, names: str) -> tuple[str, ...]:
    return tuple(f"{prefix}{name}" for name in names.split())


def _scaled(factor: float) -> Callable[[FloatArray], FloatArray]:
    return lambda rows: rows * factor


def _specific_force(rows: FloatArray) -> FloatArray:
    """Acceleration without gravity [g], world, z up, to specific force [m/s²], z down."""
    return flip_body((rows + np.array([0.0, 0.0, 1.0])) * GRAVITY)


def _attitude(rows: FloatArray) -> FloatArray:
    """Roll, pitch (nose up), yaw (to the left) [deg] to quaternions."""
    return from_euler(np.deg2rad(rows) * np.array([1.0, 1.0, -1.0]))


def _quaternion(rows: FloatArray) -> FloatArray:
    """Body FLU to a world with z up, to body FRD to a world with z down: y and z change their signs."""
    return np.asarray(rows * np.array([1.0, 1.0, -1.0, -1.0]))


def _reference(rows: FloatArray) -> FloatArray:
    """Desired roll, pitch, yaw [deg] and thrust (16 bit)."""
    return np.column_stack([np.deg2rad(rows[:, :3]) * np.array([1.0, 1.0, -1.0]), rows[:, 3] / FULL_SCALE])


SOURCES: tuple[Source, ...] = (
    Source("gyro", "", _axes("gyro.", "x y z"), lambda rows: flip_body(np.deg2rad(rows))),
    Source("gyro", "", _axes("controller.r_", "roll pitch yaw"), lambda rows: rows * np.array([1.0, 1.0, -1.0])),
    Source("accel", "", _axes("acc.", "x y z"), lambda rows: flip_body(rows * GRAVITY)),
    Source("accel_z", "", ("controller.accelz",), _scaled(-GRAVITY)),
    Source("accel_world", "", _axes("stateEstimate.", "ax ay az"), _specific_force),
    Source("attitude", "", _axes("stateEstimate.", "qw qx qy qz"), _quaternion),
    Source("attitude", "", _axes("stateEstimate.", "roll pitch yaw"), _attitude),
    Source("attitude", "", _axes("stabilizer.", "roll pitch yaw"), _attitude),
    Source("velocity", "", _axes("stateEstimate.", "vx vy vz"), flip_body),
    Source("position", "", _axes("stateEstimate.", "x y z"), flip_body),
    Source("rotor_speed", "", _axes("rpm.", "m1 m2 m3 m4"), _scaled(RPM)),
    Source("motor_command", "", _axes("motor.", "m1 m2 m3 m4"), _scaled(1.0 / FULL_SCALE)),
    Source("motor_command", "", _axes("pwm.", "m1_pwm m2_pwm m3_pwm m4_pwm"), _scaled(1.0 / FULL_SCALE)),
    Source("mixer_input", "", _axes("controller.cmd_", "thrust roll pitch yaw"), _scaled(1.0 / FULL_SCALE)),
    Source("attitude_reference", "", _axes("controller.", "roll pitch yaw actuatorThrust"), _reference),
    Source("battery", "", ("pm.vbatMV",), _scaled(1e-3)),
    Source("battery", "", ("pm.vbat",)),
)
"""In order of preference: of several sources of one channel the first that a log holds is taken."""


def read_usd(path: Path) -> Recording:
    """Reads a Crazyflie µSD log by the variables that it holds.

    Raises:
        LogError: a damaged list of variables, or no variable that is known.
    """
    records = collect_usd_records(path.read_bytes(), path.name)
    clock = LogClock()
    tables = {  # the others are events, such as a change of mode
        title: table
        for title, table in records.tables.items()
        if title == "fixedFrequency" or any(_holds(table, s) for s in SOURCES)
    }
    times = clock.times_of({title: table["t"] * 1e-6 for title, table in tables.items()}, records.places)

    def rows(source: Source) -> tuple[FloatArray, FloatArray] | None:
        title = next((title for title, table in tables.items() if _holds(table, source)), None)
        if title is None:
            return None
        with np.errstate(invalid="ignore"):
            values = np.column_stack([tables[title][v].astype(np.float64) for v in source.columns])
        return times[title], values

    raw = channels_of(SOURCES, rows, math.inf)
    used = {"id", "t", *(variable for entry in raw for variable in entry.source.split())}
    left = [name for table in tables.values() for name in table.dtype.names or () if name not in used]
    if not raw:
        raise LogError(
            f"{path.name}: none of its variables is known ({plain(', '.join(left))[:120] or 'no record'})",
            "motor.m1 … m4 or controller.cmd_thrust, cmd_roll, cmd_pitch, cmd_yaw; gyro.x y z; acc.x y z; pm.vbatMV",
            "list them in the µSD card's config.txt",
        )
    return assemble(path.name, "usdlog", raw, clock, [*records.notes, *_partial(left, {entry.name for entry in raw})])


def _holds(table: NDArray[np.void], source: Source) -> bool:
    return set(source.columns) <= set(table.dtype.names or ())


def _partial(left: list[str], made: set[str]) -> list[str]:
    """Says which groups of variables are incomplete, and therefore not used, of channels that nothing else made."""
    out = []
    for source in SOURCES:
        there = [name for name in source.columns if name in left]
        missing = [name for name in source.columns if name not in left]
        if source.channel not in made and there and missing:
            lack, rest = (f"{', '.join(names)} {'is' if len(names) == 1 else 'are'}" for names in (missing, there))
            out.append(f"{source.channel}: {lack} missing, so {rest} not used")
    return out
