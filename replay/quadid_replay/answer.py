"""Carries a recording, or the reason why there is none, from the process that reads a log to the one that asked.

An answer is a line of JSON and, behind it, the numbers of the channels as little-endian doubles: first the times, then
the rows of each.  It is data and nothing else: the process that wrote it has read a stranger's file.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from quadid.data.window import CHANNELS, Channel, Recording
from quadid.errors import LogError, QuadidError
from quadid.sanitise import LONGEST_LINE, plain
from quadid.types import FloatArray

_DOUBLE = "<f8"
_MOST_ROWS = 1 << 40


class BadAnswerError(ValueError):
    """An answer that is none: sizes that do not fit, numbers that are not finite, a name that is not known."""


class ReaderError(LogError):
    """A reader that failed on a log in a way that it should have reported; a fault of the program."""


def pack(recording: Recording) -> Iterable[bytes | memoryview]:
    """A recording as the parts of an answer."""
    channels = [[c.name, c.source, dict(c.faults), *c.values.shape] for c in recording.channels.values()]
    yield _line({
        "name": recording.name, "format": recording.format, "breaks": recording.breaks,
        "warnings": recording.warnings, "sha256": recording.sha256, "grid": recording.grid,
        "autopilot": dict(recording.autopilot), "epoch": recording.epoch, "modes": recording.modes,
        "channels": channels,
    })  # fmt: skip
    for channel in recording.channels.values():
        yield np.ascontiguousarray(channel.t, _DOUBLE).data.cast("B")
        yield np.ascontiguousarray(channel.values, _DOUBLE).data.cast("B")


def pack_error(error: QuadidError) -> bytes:
    """A refusal as an answer."""
    return _line({"refused": [error.found, error.allowed, error.fix]})


def pack_fault(what: str) -> bytes:
    """A failure of the reader, in words, as an answer."""
    return _line({"fault": what})


def pack_limit(name: str) -> bytes:
    """A limit of the process that the reader met and noticed, as an answer."""
    return _line({"limit": name})


def _line(content: Mapping[str, Any]) -> bytes:
    return json.dumps(content).encode() + b"\n"


def unpack(answer: memoryview) -> Recording | str:
    """Checks an answer; returns the recording, or the name of the limit that its reader met.

    Raises:
        LogError: the refusal that the answer holds.
        ReaderError: the failure that it holds.
        BadAnswerError: anything that is no answer.
    """
    try:
        end = bytes(answer[: 64 << 20]).index(b"\n")
        told = json.loads(bytes(answer[:end]))
        if "limit" in told:
            return _text(told["limit"])
        if "refused" in told:
            raise LogError(*(_text(part) for part in told["refused"]))
        if "fault" in told:
            raise ReaderError(
                _text(told["fault"]), "", "report it with the file: the reader of this format failed on it"
            )  # fmt: skip
        channels, rest = {}, answer[end + 1 :]
        for name, source, faults, rows, columns in told["channels"]:
            (t, values), rest = _numbers(rest, _count(rows), _count(columns))
            counts = {_text(reason): _count(n) for reason, n in faults.items()}
            channels[_known(name)] = Channel(name, t, values, _text(source), counts)
        if len(rest):
            raise BadAnswerError(f"{len(rest)} bytes too many")
        return Recording(
            _text(told["name"]), _text(told["format"]), channels, tuple(_number(b) for b in told["breaks"]),
            tuple(_text(w) for w in told["warnings"]), _text(told["sha256"]), _number_or_none(told["grid"]),
            {_text(name): _number(value, finite=False) for name, value in told["autopilot"].items()},
            _number_or_none(told["epoch"]), tuple((_number(t), _text(mode)) for t, mode in told["modes"]),
        )  # fmt: skip
    except (BadAnswerError, LogError):
        raise
    except (ValueError, TypeError, LookupError, AttributeError, RecursionError, QuadidError) as error:
        raise BadAnswerError(f"{type(error).__name__}: {error}") from error


def _numbers(data: memoryview, rows: int, columns: int) -> tuple[tuple[FloatArray, FloatArray], memoryview]:
    """Times (rows,) and values (rows, columns) at the beginning of the data, and what is behind them."""
    size = 8 * rows * (1 + columns)
    if size > len(data):
        raise BadAnswerError(f"{size - len(data)} bytes too few")
    numbers = np.frombuffer(data[:size], _DOUBLE)
    if not np.isfinite(numbers).all():
        raise BadAnswerError("numbers that are not finite")
    return (numbers[:rows], numbers[rows:].reshape(rows, columns)), data[size:]


def _text(value: Any) -> str:
    if not isinstance(value, str):
        raise BadAnswerError(f"{type(value).__name__} instead of a text")
    return plain(value, LONGEST_LINE)


def _known(name: Any) -> str:
    if name not in CHANNELS:
        raise BadAnswerError("a channel that is not known")
    return str(name)


def _count(value: Any) -> int:
    if type(value) is not int or not 0 <= value < _MOST_ROWS:
        raise BadAnswerError("a count that is none")
    return value


def _number(value: Any, finite: bool = True) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float) or (finite and not math.isfinite(value)):
        raise BadAnswerError("a number that is none")
    return float(value)


def _number_or_none(value: Any) -> float | None:
    return None if value is None else _number(value)
