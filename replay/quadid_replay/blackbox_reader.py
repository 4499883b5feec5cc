"""Betaflight blackbox logs (.bbl, .bfl): headers, gyro, accelerometer, motors, eRPM and battery.

Betaflight's body axes are x forward, y left, z up, as ROS'; motors count rear right, front right, rear left, front
left.  Attitude is not logged.  Of several logs in a file the longest is read.
"""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np

from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import FloatArray
from quadid.window import Recording
from quadid_replay.blackbox_frames import Decoded, FrameDefinition, decode_frames, known_encodings, number
from quadid_replay.clocks import LogClock
from quadid_replay.columns import RawChannel, assemble
from quadid_replay.frames import GRAVITY, flip_body
from quadid_replay.motors import RPM

MAGIC = b"H Product:Blackbox"
_DEGREE = np.pi / 180.0
_MOST_FIELDS = 256
_KEPT = (
    "gyro_scale", "acc_1G", "minthrottle", "vbatref", "motorOutput", "motor_poles", "maxthrottle",
    "blackbox_high_resolution", "yaw_motors_reversed",
)  # fmt: skip


class _Header(NamedTuple):
    """Definitions of frames, values of the header by name, and where the frames begin."""

    definitions: dict[str, FrameDefinition]
    values: dict[str, str]
    end: int


def read_blackbox(path: Path) -> Recording:
    """Reads a blackbox log, whole or damaged.

    Raises:
        LogError: a header that is damaged or of another dialect, or no frame that can be read.
    """
    data = path.read_bytes()
    starts = _starts(data)
    best: tuple[_Header, Decoded] | None = None
    for start, stop in zip(starts, [*starts[1:], len(data)], strict=True):
        header = _header(data, start, stop, path.name)
        decoded = decode_frames(data, header.end, stop, header.definitions, _constants(header))
        if best is None or len(decoded.rows) * best[1].width > len(best[1].rows) * decoded.width:
            best = header, decoded
    assert best is not None
    notes = []
    if len(starts) > 1:
        notes.append(f"{len(starts)} logs in this file: the longest is read")
    if best[1].skipped:
        notes.append(f"{best[1].skipped} of {len(data)} bytes are damaged and were skipped")
    if not best[1].ended:
        notes.append("no end-of-log mark: power was cut or the file is not whole; everything before is used")
    clock = LogClock()
    return assemble(path.name, "blackbox", _channels(*best, clock), clock, notes, _parameters(best[0]))


def _starts(data: bytes) -> list[int]:
    out, at = [], data.find(MAGIC)
    while at >= 0:
        out.append(at)
        at = data.find(MAGIC, at + 1)
    return out[:64]


def _header(data: bytes, start: int, stop: int, origin: str) -> _Header:
    values: dict[str, str] = {}
    at = start
    while data[at : at + 2] == b"H ":
        end = data.find(b"\n", at, min(at + 8192, stop))
        if end < 0:
            break
        name, _, value = data[at + 2 : end].decode("latin-1").partition(":")
        values[name.strip()] = value.strip()
        at = end + 1
    definitions: dict[str, FrameDefinition] = {}
    try:
        for kind in "IPSGH":
            names = values.get(f"Field {'I' if kind == 'P' else kind} name", "").split(",")
            if f"Field {kind} encoding" in values and names != [""]:
                parts = [
                    tuple(int(v) for v in values[f"Field {kind} {w}"].split(",")) for w in ("predictor", "encoding")
                ]
                signs = values.get(f"Field {kind} signed", "").split(",")
                if len(signs) != len(names):  # P frames have those of I frames
                    signs = ["0" if name in ("loopIteration", "time") else "1" for name in names]
                if len({len(names), *map(len, parts)}) == 1 and len(names) <= _MOST_FIELDS:
                    definition = FrameDefinition(tuple(names), parts[0], parts[1], tuple(sign == "1" for sign in signs))
                    if known_encodings(definition):
                        definitions[kind] = definition
    except (KeyError, ValueError) as error:
        raise _bad_header(origin, str(error)) from error
    main = definitions.get("I")
    if main is None or "P" not in definitions or not {"time", "loopIteration"} <= {*main.names}:
        raise _bad_header(origin, "no main frame that is described whole")
    return _Header(definitions, values, at)


def _bad_header(origin: str, why: str) -> LogError:
    return LogError(
        f"{origin}: its blackbox header is damaged or of another dialect ({plain(why, 60)})",
        "a log of Betaflight, Cleanflight or INAV", "copy the log from the flight controller again",
    )  # fmt: skip


def _constants(header: _Header) -> dict[int, int]:
    values = header.values
    return {
        4: int(_value(values, "minthrottle", 1150.0)),
        8: 1500,
        9: int(_value(values, "vbatref", 0.0)),
        11: int(_value(values, "motorOutput", 0.0)),
    }


def _value(values: dict[str, str], name: str, otherwise: float) -> float:
    """First number of a header entry."""
    try:
        found = number(values[name].split(",")[0])
    except (KeyError, ValueError):
        return otherwise
    return found if np.isfinite(found) and abs(found) < 1e9 else otherwise


def _parameters(header: _Header) -> dict[str, float]:
    return {name: _value(header.values, name, float("nan")) for name in _KEPT if name in header.values}


def _channels(header: _Header, decoded: Decoded, clock: LogClock) -> list[RawChannel]:
    names = header.definitions["I"].names
    table = np.array(decoded.rows, dtype=np.float64).reshape(-1, decoded.width)
    t, _ = clock.times(np.unwrap(table[:, names.index("time")], period=2.0**32) * 1e-6)  # 71.6 minutes of 32 bits
    out: list[RawChannel] = []

    def columns(name: str, count: int) -> FloatArray | None:
        wanted = [f"{name}[{i}]" for i in range(count)]
        return table[:, [names.index(w) for w in wanted]] if all(w in names for w in wanted) else None

    def add(channel: str, values: FloatArray | None, source: str) -> None:
        if values is not None and len(values):
            out.append(RawChannel(channel, t, values, source))

    gyro, accel = columns("gyroADC", 3), columns("accSmooth", 3)
    unfiltered = columns("gyroUnfilt", 3)
    used = gyro if unfiltered is None else unfiltered
    scale = _value(header.values, "gyro_scale", 1.0) * _DEGREE
    if _value(header.values, "blackbox_high_resolution", 0.0) > 0.0:
        scale *= 0.1
    label = "gyroADC (filtered on board)" if unfiltered is None else "gyroUnfilt"
    add("gyro", None if used is None else flip_body(used * scale), label)
    one = _value(header.values, "acc_1G", 0.0)
    add("accel", None if accel is None or one <= 0.0 else flip_body(accel * (GRAVITY / one)), "accSmooth")
    motors = sum(1 for i in range(8) if f"motor[{i}]" in names)
    if motors:
        add("motor_command", _normalized(header, columns("motor", motors)), f"motor[0..{motors - 1}] (normalized)")
        poles = _value(header.values, "motor_poles", 14.0)
        turns = columns("eRPM", motors)
        if turns is not None and poles >= 2.0:
            add("rotor_speed", turns * (100.0 * 2.0 / poles * RPM), f"eRPM, {poles:g} poles")
    if "vbatLatest" in names and len(table):
        volts = table[:, [names.index("vbatLatest")]]
        add("battery", volts * (0.01 if np.median(volts) > 300.0 else 0.1), "vbatLatest")
    return out


def _normalized(header: _Header, motors: FloatArray | None) -> FloatArray | None:
    """Motor outputs over the range that the header names (`motorOutput:48,2047`), else that of pulse widths."""
    pair = header.values.get("motorOutput", "").split(",")
    try:
        low, high = (number(v) for v in pair)
    except ValueError:
        low, high = _value(header.values, "minthrottle", 1000.0), _value(header.values, "maxthrottle", 2000.0)
    if motors is None or not low < high:
        return None
    return (motors - low) / (high - low)
