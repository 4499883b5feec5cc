"""Messages of an MCAP file in order of their log time, whatever order its chunks are in."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterable, Iterator

Message = tuple[int, int, bytes]
"""Channel id, log time [ns], payload."""
Part = tuple[int, Iterator[Message]]
"""Log time [ns] before which there is none, and messages."""
_FEWEST = 1000


def in_log_time(parts: Iterable[Part]) -> Iterator[Message]:
    """Merges parts whose starts rise; no message of a part comes before its start.

    What is ready is handed out whenever as much again has come as was left the last time, so that the work stays
    proportional to the number of messages even where every part overlaps every other.
    """
    waiting: list[Message] = []
    enough = _FEWEST
    for start, messages in parts:
        if len(waiting) >= enough:
            waiting.sort(key=_log_time)  # stable, and quick where it is nearly in order
            ready = bisect_left(waiting, start, key=_log_time)
            yield from waiting[:ready]
            waiting = waiting[ready:]
            enough = 2 * len(waiting) + _FEWEST
        waiting.extend(messages)
    waiting.sort(key=_log_time)
    yield from waiting


def _log_time(message: Message) -> int:
    return message[1]
