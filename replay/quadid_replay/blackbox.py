"""Betaflight blackbox logs (.bbl, .bfl)."""

from __future__ import annotations

import math
import re
import struct
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import groupby, islice
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.sanitise import plain
from quadid.types import FloatArray
from quadid_replay.columns import GRAVITY, LogClock, RawChannel, assemble, damage, flip_body
from quadid_replay.motors import RPM

# --- Frames of a Betaflight blackbox log: variable-length numbers, predicted from the frames before
#
# After the text header come main frames (I: complete, P: differences), slow, GPS and event frames.  A frame that cannot
# be decoded, after which no frame begins, or whose time is impossible, is skipped to the next I frame, for what follows
# builds on it.  There an I frame counts once the main frame after it decodes, too: its mark alone stands in any data.
# Format: docs of Cleanflight, "Blackbox logging internals".  Own, for orangebox is GPL, does not know encoding 10 (the
# accelerometer's) and neither wraps in 32 bits nor tests where it resumes.


MARKS = b"IPSGHE"
_LOG_END = b"End of log\x00"
_TURN = 1 << 32
"""All numbers have 32 bits, and predictions wrap in them as in the firmware."""
LONGEST_STEP = 10_000_000
"""Longest time [us] between main frames without an event that explains it: more is damage."""
_PACE = 2.0
"""Time for each iteration of the loop may differ by this factor from what it was."""
_EVENT_NUMBERS = {0: 1, 14: 2, 15: 1, 30: 2, 40: 1}
"""Events by the unsigned numbers that follow them."""
_RESUMED, _LOG_ENDS = 14, 255
"""The events that logging goes on, with iteration and time, and that it ends."""
_NEXT_FRAME = 1024
"""Within so many bytes of an I frame the next main frame begins."""


class BadFrameError(Exception):
    """Bytes that are no frame."""


@dataclass
class Reader:
    """A place in the bytes of a log."""

    data: bytes
    at: int

    def byte(self) -> int:
        """The next byte."""
        if self.at >= len(self.data):
            raise BadFrameError("end")
        self.at += 1
        return self.data[self.at - 1]

    def unsigned(self) -> int:
        """A number in groups of seven bits, lowest first."""
        value = shift = 0
        while True:
            b = self.byte()
            value |= (b & 0x7F) << shift
            if b < 0x80:
                return value
            shift += 7
            if shift > 28:
                raise BadFrameError("number too long")

    def signed(self) -> int:
        """A zigzag number."""
        value = self.unsigned()
        return (value >> 1) ^ -(value & 1)

    def little(self, width: int) -> int:
        """A signed little-endian number of `width` bytes."""
        self.at += width
        if self.at > len(self.data):
            raise BadFrameError("end")
        return int.from_bytes(self.data[self.at - width : self.at], "little", signed=True)


def extended(value: int, bits: int) -> int:
    """The lowest `bits` of a value as a signed number."""
    value &= (1 << bits) - 1
    return value - (1 << bits) if value >> (bits - 1) else value


def _split(r: Reader, value: int, more: int, widths: Sequence[int], most: int = 16) -> list[int]:
    """Signed numbers of at most `most` bits, highest first, that end where `value` and `more` bytes behind it do."""
    for _ in range(more):
        value = value << 8 | r.byte()
    out = []
    for bits in reversed(widths):
        out.append(extended(value, min(bits, most)) if bits else 0)
        value >>= bits
    return out[::-1]


def _three(widths: Sequence[Sequence[int]], most: int) -> Callable[[Reader, int], list[int]]:
    """Three numbers; the first byte's highest bits say how many bytes follow, and so how wide they are; 3: they are
    little-endian, of one to four bytes each."""

    def decode(r: Reader, count: int) -> list[int]:
        lead = r.byte()
        more = lead >> 6
        if more == 3:
            return [r.little(1 + (lead >> 2 * i & 3)) for i in range(3)]
        return _split(r, lead & 0x3F, more, widths[more], most)

    return decode


def _tag8_4s16(r: Reader, count: int) -> list[int]:
    """Four numbers of 0, 4, 8 or 16 bits, packed nibble by nibble, highest first."""
    selector = r.byte()
    widths = [(0, 4, 8, 16)[selector >> 2 * i & 3] for i in range(4)]
    unused = sum(widths) % 8  # half of the last byte
    return _split(r, 0, (sum(widths) + unused) // 8, [*widths, unused])[:4]


def _tag8_8svb(r: Reader, count: int) -> list[int]:
    if count == 1:
        return [r.signed()]
    present = r.byte()
    return [r.signed() if present >> i & 1 else 0 for i in range(count)]


_ENCODINGS: Mapping[int, tuple[int, Callable[[Reader, int], list[int]]]] = {
    0: (1, lambda r, count: [r.signed()]),
    1: (1, lambda r, count: [r.unsigned()]),
    3: (1, lambda r, count: [-extended(r.unsigned(), 14)]),
    6: (8, _tag8_8svb),
    7: (3, _three(((2, 2, 2), (4, 4, 4), (8, 8, 8)), 6)),
    8: (4, _tag8_4s16),
    9: (1, lambda r, count: [0]),
    10: (3, _three(((2, 2, 2), (5, 5, 4), (8, 7, 7)), 8)),
}
"""Encodings: most fields that are encoded together, and decoder."""


@dataclass(frozen=True)
class FrameDefinition:
    """Fields of one kind of frame: names, numbers of their predictors and encodings, whether they have a sign."""

    names: tuple[str, ...]
    predictors: tuple[int, ...]
    encodings: tuple[int, ...]
    signed: tuple[bool, ...] = ()

    @cached_property
    def _groups(self) -> list[tuple[Callable[[Reader, int], list[int]], int]]:
        """Decoders one after the other, and of how many fields each."""
        out = []
        for encoding, alike in groupby(self.encodings):
            (most, decode), left = _ENCODINGS[encoding], len([*alike])
            out += [(decode, min(most, left - k)) for k in range(0, left, most)]
        return out

    def raw(self, r: Reader) -> list[int]:
        """Decodes one frame, before prediction."""
        return [value for decode, count in self._groups for value in decode(r, count)[:count]]


class Decoded(NamedTuple):
    """Main frames as rows of numbers, the bytes that could not be read, and whether the log was ended."""

    rows: FloatArray
    skipped: int
    ended: bool


def decode_frames(
    data: bytes, start: int, stop: int, definitions: Mapping[str, FrameDefinition], constants: Mapping[int, int]
) -> Decoded:
    """Decodes the frames of one log.

    Args:
        data: the file.
        start: where the frames begin.
        stop: where the next log's header begins, or the end.
        definitions: by kind; I and P at least.
        constants: values of the predictors that the header holds: 4 minthrottle, 8 (1500), 9 vbatref, 11 minmotor.
    """
    names = definitions["I"].names
    rows, skipped, ended = array("q"), 0, False
    clock = _Clock(names.index("time"), names.index("loopIteration"))
    r = Reader(data[:stop], start)
    previous: list[int] | None = None
    before: list[int] = []
    resumed: int | None = None  # place of an I frame that the next main frame has to confirm
    while r.at < stop and not ended:
        place = r.at
        mark = chr(r.byte())
        try:
            if resumed is not None and place - resumed > _NEXT_FRAME:
                raise BadFrameError("no main frame follows")
            if mark == "E":
                kind, numbers = _event(r)
                ended = kind == _LOG_ENDS
                if kind == _RESUMED:
                    clock.last, previous, resumed = (numbers[1], numbers[0]), None, None
                continue
            if mark not in definitions or (mark == "P" and previous is None):
                raise BadFrameError(mark)
            frame = definitions[mark]
            raw = frame.raw(r)
            if mark not in "IP":
                continue
            values = _predicted(raw, frame, definitions["I"].signed, previous, before, constants)
            if r.at < stop and data[r.at] not in MARKS:
                raise BadFrameError("no frame follows")
            if not clock.follows(values, previous, whole=mark == "I"):
                raise BadFrameError("time")
            if previous is None:
                resumed = place
            else:
                if resumed is not None:
                    clock.take(previous)
                    rows.extend(previous)
                    resumed = None
                if mark == "I":
                    clock.take(values)
                rows.extend(values)
            before, previous = (values, values) if mark == "I" else (previous or values, values)
        except BadFrameError:
            # On to the next I frame, behind this place or behind the one that is not confirmed.
            place = place if resumed is None else resumed
            previous = resumed = None
            following = data.find(b"I", place + 1, stop)
            r.at = stop if following < 0 else following
            skipped += r.at - place
    if resumed is not None and previous is not None and not len(rows):
        rows.extend(previous)
    return Decoded(np.array(rows, dtype=np.float64).reshape(-1, len(names)), skipped, ended)


@dataclass
class _Clock:
    """Tells which main frames may follow: columns of time [us] and iteration, and both of the last I frame."""

    time: int
    iteration: int
    last: tuple[int, int] | None = None
    pace: float | None = None

    def follows(self, values: Sequence[int], previous: Sequence[int] | None, whole: bool) -> bool:
        """True if a frame, complete or not, may come after `previous`; None: after damage of any length."""
        if previous is not None and not 0 <= (values[self.time] - previous[self.time]) % _TURN <= LONGEST_STEP:
            return False
        if self.last is None or not whole:
            return True
        elapsed, turns = self._since(values)
        if self.pace is None:
            return elapsed <= LONGEST_STEP
        return turns * self.pace / _PACE <= elapsed <= turns * self.pace * _PACE

    def take(self, values: Sequence[int]) -> None:
        """Notes an I frame that is used."""
        if self.last is not None and (since := self._since(values))[1]:
            self.pace = since[0] / since[1]
        self.last = values[self.time], values[self.iteration]

    def _since(self, values: Sequence[int]) -> tuple[int, int]:
        assert self.last is not None
        return (values[self.time] - self.last[0]) % _TURN, (values[self.iteration] - self.last[1]) % _TURN


def _event(r: Reader) -> tuple[int, list[int]]:
    """Reads an event: its kind and its unsigned numbers."""
    kind = r.byte()
    if kind == _LOG_ENDS:
        if r.data[r.at : r.at + len(_LOG_END)] != _LOG_END:
            raise BadFrameError("end of log")
    elif kind == 13:
        r.little(4) if r.byte() & 0x80 else r.signed()
    elif kind not in _EVENT_NUMBERS:
        raise BadFrameError("event")
    return kind, [r.unsigned() for _ in range(_EVENT_NUMBERS.get(kind, 0))]


def _predicted(
    raw: Sequence[int],
    frame: FrameDefinition,
    signed: Sequence[bool],
    previous: Sequence[int] | None,
    before: Sequence[int],
    constants: Mapping[int, int],
) -> list[int]:
    """Adds, in 32 bits, to each number what its predictor expects of the header and the two main frames before."""
    out: list[int] = []
    names = frame.names
    for i, (value, predictor) in enumerate(zip(raw, frame.predictors, strict=True)):
        if predictor in constants:
            value += constants[predictor]
        elif predictor == 5:
            value += out[names.index("motor[0]")] if "motor[0]" in names[:i] else 0
        elif previous is not None and predictor:
            if predictor == 1:
                value += previous[i]
            elif predictor == 2:
                value += 2 * previous[i] - before[i]
            elif predictor == 3:
                value += int((previous[i] + before[i]) / 2)
            elif predictor == 6:
                value += previous[i] + 1
        out.append(extended(value, 32) if signed[i] else value % _TURN)
    return out


def number(text: str) -> float:
    """A header's number; one in hexadecimal is the bits of a float.  Raises ValueError."""
    if text.startswith("0x"):
        return float(struct.unpack("<f", struct.pack("<I", int(text, 16) & 0xFFFFFFFF))[0])
    return float(text)


# --- Headers, gyro, accelerometer, motors, eRPM and battery
#
# Betaflight's body axes are x forward, y left, z up, as ROS'; motors count rear right, front right, rear left, front
# left.  Attitude is not logged.  Of several logs in a file the longest is read.


MAGIC = b"H Product:Blackbox"
_DEGREE = np.pi / 180.0
_KEPT = (
    "gyro_scale",
    "acc_1G",
    "minthrottle",
    "vbatref",
    "motorOutput",
    "motor_poles",
    "maxthrottle",
    "blackbox_high_resolution",
    "yaw_motors_reversed",
)


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
    starts = [found.start() for found in islice(re.finditer(re.escape(MAGIC), data), 64)]
    best: tuple[_Header, Decoded] | None = None
    for start, stop in zip(starts, [*starts[1:], len(data)], strict=True):
        header = _header(data, start, stop, path.name)
        constants = {
            4: int(_value(header.values, "minthrottle", 1150.0)),
            8: 1500,
            9: int(_value(header.values, "vbatref", 0.0)),
            11: int(_value(header.values, "motorOutput", 0.0)),
        }
        decoded = decode_frames(data, header.end, stop, header.definitions, constants)
        if best is None or len(decoded.rows) > len(best[1].rows):
            best = header, decoded
    assert best is not None
    notes = []
    if len(starts) > 1:
        notes.append(f"{len(starts)} logs in this file: the longest is read")
    notes += damage(len(data), best[1].skipped, cut=False)
    if not best[1].ended:
        notes.append("no end-of-log mark: power was cut or the file is not whole; everything before is used")
    clock = LogClock(apart=0.0)
    values = best[0].values
    kept = {name: _value(values, name, math.nan) for name in _KEPT if name in values}
    return assemble(path.name, "blackbox", _channels(*best, clock), clock, notes, kept)


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
                if len({len(names), *map(len, parts)}) == 1:
                    definition = FrameDefinition(tuple(names), parts[0], parts[1], tuple(sign == "1" for sign in signs))
                    if {*definition.encodings} <= {*_ENCODINGS} and {*definition.predictors} <= {*range(12)}:
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
        "a log of Betaflight, Cleanflight or INAV",
        "copy the log from the flight controller again",
    )


def _value(values: dict[str, str], name: str, otherwise: float) -> float:
    """First number of a header entry."""
    try:
        found = number(values[name].split(",")[0])
    except (KeyError, ValueError):
        return otherwise
    return found if np.isfinite(found) and abs(found) < 1e9 else otherwise


def _channels(header: _Header, decoded: Decoded, clock: LogClock) -> list[RawChannel]:
    names = header.definitions["I"].names
    table = decoded.rows
    t = clock.times(np.unwrap(table[:, names.index("time")], period=2.0**32) * 1e-6)  # 71.6 minutes of 32 bits
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
