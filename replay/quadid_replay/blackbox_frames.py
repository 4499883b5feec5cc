"""Frames of a Betaflight blackbox log: variable-length numbers, predicted from the frames before.

After the text header come main frames (I: complete, P: differences), slow, GPS and event frames.  A frame that cannot
be decoded, after which no frame begins, or whose time is impossible, is skipped to the next I frame, for what follows
builds on it.  There an I frame counts once the main frame after it decodes, too: its mark alone stands in any data.
Format: docs of Cleanflight, "Blackbox logging internals".  Own, for orangebox is GPL, does not know encoding 10 (the
accelerometer's) and neither wraps in 32 bits nor tests where it resumes.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

MAIN, MARKS = b"IP", b"IPSGHE"
_LOG_END = b"End of log\x00"
_TURN = 1 << 32
"""All numbers have 32 bits, and predictions wrap in them as in the firmware."""
LONGEST_STEP = 10_000_000
"""Time [us] between main frames without an event that says why: more is damage."""
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


def _tag2_3s32(r: Reader, count: int) -> list[int]:
    lead = r.byte()
    kind = lead >> 6
    if kind == 0:
        return [extended(lead >> 4, 2), extended(lead >> 2, 2), extended(lead, 2)]
    if kind == 1:
        second = r.byte()
        return [extended(lead, 4), extended(second >> 4, 4), extended(second, 4)]
    if kind == 2:
        return [extended(lead, 6), extended(r.byte(), 6), extended(r.byte(), 6)]
    return [r.little(1 + (lead >> 2 * i & 3)) for i in range(3)]


def _tag2_3svariable(r: Reader, count: int) -> list[int]:
    lead = r.byte()
    kind = lead >> 6
    if kind == 0:
        return [extended(lead >> 4, 2), extended(lead >> 2, 2), extended(lead, 2)]
    if kind == 1:
        second = r.byte()
        return [extended(lead >> 1, 5), extended((lead & 1) << 4 | second >> 4, 5), extended(second, 4)]
    if kind == 2:
        second, third = r.byte(), r.byte()
        return [
            extended((lead & 0x3F) << 2 | second >> 6, 8), extended((second & 0x3F) << 1 | third >> 7, 7),
            extended(third, 7),
        ]  # fmt: skip
    return [r.little(1 + (lead >> 2 * i & 3)) for i in range(3)]


def _tag8_4s16(r: Reader, count: int) -> list[int]:
    """Four numbers of 0, 4, 8 or 16 bits, packed nibble by nibble, highest first."""
    selector, out = r.byte(), []
    nibbles: list[int] = []

    def take(n: int) -> int:
        value = 0
        for _ in range(n):
            if not nibbles:
                b = r.byte()
                nibbles.extend((b >> 4, b & 0xF))
            value = value << 4 | nibbles.pop(0)
        return value

    for i in range(4):
        bits = (0, 4, 8, 16)[selector >> 2 * i & 3]
        out.append(extended(take(bits // 4), bits) if bits else 0)
    return out


def _tag8_8svb(r: Reader, count: int) -> list[int]:
    if count == 1:
        return [r.signed()]
    present = r.byte()
    return [r.signed() if present >> i & 1 else 0 for i in range(count)]


_GROUPS: Mapping[int, tuple[int, Callable[[Reader, int], list[int]]]] = {
    6: (8, _tag8_8svb), 7: (3, _tag2_3s32), 8: (4, _tag8_4s16), 10: (3, _tag2_3svariable),
}  # fmt: skip
"""Encodings of several fields at once: most fields in a group, and decoder."""
_SINGLE: Mapping[int, Callable[[Reader], int]] = {
    0: Reader.signed,
    1: Reader.unsigned,
    3: lambda r: -extended(r.unsigned(), 14),
    9: lambda r: 0,
}


@dataclass(frozen=True)
class FrameDefinition:
    """Fields of one kind of frame: names, numbers of their predictors and encodings, whether they have a sign."""

    names: tuple[str, ...]
    predictors: tuple[int, ...]
    encodings: tuple[int, ...]
    signed: tuple[bool, ...] = ()

    def raw(self, r: Reader) -> list[int]:
        """Decodes one frame, before prediction."""
        out: list[int] = []
        while len(out) < len(self.encodings):
            encoding = self.encodings[len(out)]
            if encoding in _SINGLE:
                out.append(_SINGLE[encoding](r))
                continue
            most, decode = _GROUPS[encoding]
            same = 1
            while same < most and len(out) + same < len(self.encodings) and self.encodings[len(out) + same] == encoding:
                same += 1
            out += decode(r, same)[:same]
        return out


def known_encodings(definition: FrameDefinition) -> bool:
    """Tells whether all encodings and predictors are known."""
    known = set(_SINGLE) | set(_GROUPS)
    return set(definition.encodings) <= known and set(definition.predictors) <= {*range(12)}


@dataclass
class Decoded:
    """Main frames as rows of numbers, and what could not be read."""

    width: int
    rows: array[int] = field(default_factory=lambda: array("q"))
    skipped: int = 0
    ended: bool = False


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
    out, clock = Decoded(len(names)), _Clock(names.index("time"), names.index("loopIteration"))
    r = Reader(data[:stop], start)
    previous: list[int] | None = None
    before: list[int] = []
    resumed: int | None = None  # place of an I frame that the next main frame has to confirm
    while r.at < stop:
        place = r.at
        mark = chr(r.byte())
        try:
            if resumed is not None and place - resumed > _NEXT_FRAME:
                raise BadFrameError("no main frame follows")
            if mark == "E":
                kind, numbers = _event(r)
                out.ended = kind == _LOG_ENDS
                if out.ended:
                    break
                if kind == _RESUMED:
                    clock.last, previous, resumed = (numbers[1], numbers[0]), None, None
                continue
            if mark not in definitions or (mark == "P" and previous is None):
                raise BadFrameError(mark)
            frame = definitions[mark]
            raw = frame.raw(r)
            if mark in "IP":
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
                        out.rows.extend(previous)
                        resumed = None
                    if mark == "I":
                        clock.take(values)
                    out.rows.extend(values)
                before, previous = (values, values) if mark == "I" else (previous or values, values)
        except BadFrameError:
            previous = None
            place, resumed = place if resumed is None else resumed, None
            following = data.find(b"I", place + 1, stop)
            following = stop if following < 0 else following
            out.skipped += following - place
            r.at = following
    if resumed is not None and previous is not None and not len(out.rows):
        out.rows.extend(previous)
    return out


@dataclass
class _Clock:
    """Tells which main frames may follow: columns of time [us] and iteration, and both of the last I frame."""

    time: int
    iteration: int
    last: tuple[int, int] | None = None
    pace: float | None = None

    def follows(self, values: Sequence[int], previous: Sequence[int] | None, whole: bool) -> bool:
        """Whether a frame, complete or not, may come after `previous`; None: after damage of any length."""
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
    raw: Sequence[int], frame: FrameDefinition, signed: Sequence[bool], previous: Sequence[int] | None,
    before: Sequence[int], constants: Mapping[int, int],
) -> list[int]:  # fmt: skip
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
