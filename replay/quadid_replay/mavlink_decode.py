"""Decoding of the MAVLink messages that are read, from the dialect's own descriptions, without its message objects.

The library's decoder spends most of its time on what a log does not need (headers, signatures, copies).  Fields, their
order, padding, text and checksum are the library's, message by message; a test compares both.
"""

from __future__ import annotations

import struct
from collections import namedtuple
from collections.abc import Callable, Iterable, Sequence
from functools import cache
from types import ModuleType
from typing import Any

from pymavlink.generator.mavcrc import x25crc

_VERSION_1 = 0xFE
_SIGNED, _SIGNATURE = 1, 13
_CRC = struct.Struct("<H")
_tuple_of: Callable[[str, Sequence[str]], Any] = namedtuple


class Decoder:
    """Decodes frames of some messages.

    Args:
        dialect: a dialect module of pymavlink.
        numbers: ids of the messages.
    """

    def __init__(self, dialect: ModuleType, numbers: Iterable[int]) -> None:
        self._layouts = {n: _layout(dialect.mavlink_map[n]) for n in numbers}

    def decode(self, number: int, frame: memoryview) -> Any | None:
        """The message in a whole frame, with its fields and `get_type` as pymavlink has them; None for a wrong sum.

        Args:
            number: of the message, as the frame says.
            frame: from the mark to the checksum or signature.
        """
        head, tail = (6, 0) if frame[0] == _VERSION_1 else (10, _SIGNATURE if frame[2] & _SIGNED else 0)
        end = len(frame) - 2 - tail
        extra, unpacker, build = self._layouts[number]
        if x25crc(bytes(frame[1:end]) + extra).crc != _CRC.unpack_from(frame, end)[0]:
            return None
        payload = bytes(frame[head:end])
        if len(payload) < unpacker.size:
            payload = payload.ljust(unpacker.size, b"\0")
        return build(unpacker.unpack_from(payload))


@cache
def _layout(kind: Any) -> tuple[bytes, struct.Struct, Callable[[tuple[Any, ...]], Any]]:
    """Checksum seed, numbers in a payload, and what makes a message of them; the same for every log."""
    fields = _tuple_of(kind.msgname, kind.fieldnames)
    message: Any = type(kind.msgname, (fields,), {"get_type": lambda self: kind.msgname})
    takes: list[tuple[int, int, bool]] = []
    for order, length in zip(kind.orders, (kind.array_lengths[o] for o in kind.orders), strict=True):
        before = sum(kind.lengths[:order])
        text = kind.fieldtypes[len(takes)] == "char"
        takes.append((before, before + length if length and not text else 0, text))
    plain = [at for at, _, _ in takes] if not any(end or text for _, end, text in takes) else None

    def build(t: tuple[Any, ...]) -> Any:
        if plain is not None:
            return message._make([t[at] for at in plain])
        return message._make([
            t[at].split(b"\0", 1)[0].decode("ascii", "replace") if text else list(t[at:end]) if end else t[at]
            for at, end, text in takes
        ])  # fmt: skip

    return bytes([kind.crc_extra]), kind.unpacker, build
