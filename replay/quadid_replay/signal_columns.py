"""Signals of many messages at once: which columns of their numbers are which signal.

The type's own `signals` says so of one message.  It holds for all that have runs of the same lengths, as long as the
numbers that decide which signals a message tells say the same.
"""

from __future__ import annotations

import struct
from collections.abc import Hashable

import numpy as np
from mcap.exceptions import McapError

from quadid.types import FloatArray
from quadid_replay.cdr_blocks import Blocks
from quadid_replay.mcap_messages import MessageType

Places = tuple[str, list[tuple[int, int]]]
"""A signal, and where each of its numbers stands: run and place in it."""
UNDECODABLE = (
    McapError, struct.error, ValueError, LookupError, TypeError, AttributeError, RecursionError, OverflowError,
)  # fmt: skip
"""What the library and the types' functions raise on damaged data."""


class _Number(float):
    """A number of a message that knows where it stands: run of numbers and place in it."""

    at: tuple[int, int]

    @classmethod
    def placed(cls, value: float, at: tuple[int, int]) -> _Number:
        """A number and where it stands."""
        number = cls(value)
        number.at = at
        return number


class SignalColumns:
    """The columns of one message type; what the type's `signals` says is asked once for each kind of message met."""

    def __init__(self, kind: MessageType) -> None:
        self._kind = kind
        self._known: dict[Hashable, list[Places] | None] = {}

    def pick(self, blocks: list[FloatArray], extra: Hashable) -> list[tuple[str, FloatArray]] | None:
        """Names and values (n, size) of the signals; None where the messages must be looked at one by one.

        Args:
            blocks: runs of numbers of n messages, shapes (n, length).
            extra: what was noted of all of them.
        """
        told = []
        for run, column in self._kind.deciding:
            values = blocks[run][:, column]
            if (values == values[0]).all():  # as nearly always
                told.append((bool(values[0] == -1.0), False))
                continue
            absent, unknown = values == -1.0, np.isnan(values)
            if (absent != absent[0]).any() or (unknown != unknown[0]).any():
                return None
            told.append((bool(absent[0]), bool(unknown[0])))
        met = (*(block.shape[1] for block in blocks), extra, *told)
        if met not in self._known:
            self._known[met] = self._places(blocks, extra)
        places = self._known[met]
        return None if places is None else [(name, _taken(blocks, at)) for name, at in places]

    def _places(self, blocks: list[FloatArray], extra: Hashable) -> list[Places] | None:
        """Where the first message's signals stand; None where they are not simply numbers of the message."""
        first: Blocks = [
            [_Number.placed(value, (run, column)) for column, value in enumerate(block[0])]
            for run, block in enumerate(blocks)
        ]
        try:
            told = self._kind.signals(first, extra)
        except UNDECODABLE:
            return None
        out: list[Places] = []
        for name, picked in told:
            at = [one.at for one in picked if isinstance(one, _Number)]
            if len(at) != len(picked):
                return None
            out.append((name, at))
        return out


def _taken(blocks: list[FloatArray], at: list[tuple[int, int]]) -> FloatArray:
    if len({run for run, _ in at}) == 1:
        return blocks[at[0][0]][:, [column for _, column in at]]
    columns = [blocks[run][:, column] for run, column in at]
    return np.stack(columns, axis=1) if columns else np.empty((len(blocks[0]), 0))
