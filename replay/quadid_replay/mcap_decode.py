"""From the messages of an MCAP to columns of numbers.

Messages are taken in batches.  Those of a topic that keeps its layout (`cdr_blocks.BlockReader`) are read at once,
column by column; where it changes within a batch, each half is read by itself, down to a single message, which the
library decodes and the layout is learnt from.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadid.types import BoolArray, FloatArray, IndexArray, IntArray
from quadid_replay.bag_topics import Topic
from quadid_replay.cdr_blocks import BlockReader, Read
from quadid_replay.clocks import LogClock
from quadid_replay.columns import Columns
from quadid_replay.mcap_messages import MessageType
from quadid_replay.signal_columns import UNDECODABLE, SignalColumns

Message = tuple[int, int, bytes]
"""Channel id, log time [ns], payload."""
ColumnsOf = dict[tuple[int, str], Columns]

BATCH, BATCH_BYTES = 8192, 8 << 20
"""Messages in a batch at most, and bytes of their payloads at which it ends."""
_EPOCH_NS = 10**17
"""Log times above this [ns, 1973] count from the UNIX epoch; recording time then counts from the log's first second."""
_OTHER_CLOCK = 3600.0
"""Stamps this far [s] from the log time belong to another clock (boot or simulation time)."""
_LARGEST_BASE = 1 << 62


class Source(NamedTuple):
    """A topic that is read: its description, its type, the library's decoder, the reader of its layout if any, and
    which columns of many messages are which signal."""

    topic: Topic
    kind: MessageType
    decode: Callable[[bytes], Any]
    layout: BlockReader | None
    columns: SignalColumns

    def read(self, data: bytes) -> Read:
        """Reads one message; raises what the library raises on damaged data."""
        if self.layout is not None:
            return self.layout.read(data)
        message = self.decode(data)
        assert self.kind.stamp is not None
        return Read(*self.kind.stamp(message), self.kind.blocks(message), self.kind.extra(message))


def source_of(topic: Topic, kind: MessageType, decode: Callable[[bytes], Any]) -> Source:
    """The reader of a topic; messages without a header have no layout that could be learnt."""
    layout = BlockReader(decode, kind.blocks, kind.extra) if kind.stamp is None else None
    return Source(topic, kind, decode, layout, SignalColumns(kind))


class Stamps:
    """Turns stamps of headers and of PX4 into recording time."""

    def __init__(self) -> None:
        self.clock = LogClock()
        self.base_ns: int | None = None
        self._offsets: dict[str, float] = {}

    def time(self, group: str, seconds: int, nanoseconds: int, log_time: int) -> float | None:
        """Returns recording time of a stamp; log time stands in for a stamp of zero."""
        if self.base_ns is None:
            self.base_ns = log_time // 10**9 * 10**9 if log_time > _EPOCH_NS else 0
        logged = (log_time - self.base_ns) * 1e-9
        if seconds == 0 and nanoseconds == 0:
            return self.clock.time(logged)
        stamped = (seconds * 10**9 + nanoseconds - self.base_ns) * 1e-9
        offset = self._offsets.get(group)
        if offset is None:
            # Boot or simulation time beside a log on UNIX time: the first message tells the distance.
            offset = logged - stamped if abs(logged - stamped) > _OTHER_CLOCK else 0.0
            self._offsets[group] = offset
        return self.clock.time(stamped + offset)

    def times(self, groups: Sequence[str], stamps: IntArray, logged: Sequence[int]) -> FloatArray:
        """As `time` for many stamps (n, 2), seconds and nanoseconds, in file order; NaN for those refused."""
        plain = self._plain_times(groups, stamps)
        if plain is not None:
            return plain
        pairs = stamps.tolist()
        each = [self.time(g, s, ns, log) for g, (s, ns), log in zip(groups, pairs, logged, strict=True)]
        return np.array([np.nan if t is None else t for t in each], dtype=np.float64)

    def _plain_times(self, groups: Sequence[str], stamps: IntArray) -> FloatArray | None:
        """None, and nothing has changed, unless every stamp follows plainly on a clock that is known."""
        if self.base_ns is None or self.base_ns > _LARGEST_BASE or not np.all(np.any(stamps != 0, axis=1)):
            return None
        known = set(groups)
        if not known <= self._offsets.keys() or np.any(np.abs(stamps[:, 0]) > _LARGEST_BASE // 10**9):
            return None
        offset = np.array([self._offsets[g] for g in groups]) if len(known) > 1 else self._offsets[groups[0]]
        stamped = (stamps[:, 0] * 10**9 + stamps[:, 1] - self.base_ns) * 1e-9
        return self.clock.plain_times(np.asarray(stamped + offset, dtype=np.float64))


class Decoded(NamedTuple):
    """Columns by topic and signal, the clock, and how many messages could not be decoded."""

    columns: ColumnsOf
    stamps: Stamps
    failed: int


def decode_messages(messages: Iterable[Message], sources: Mapping[int, Source]) -> Decoded:
    """Streams through messages and keeps their numbers.

    Args:
        messages: of the topics in `sources`, in file order.
        sources: readers by channel id.
    """
    columns: ColumnsOf = {}
    stamps, failed = Stamps(), 0
    for batch in _batches(messages):
        failed += _add_batch(batch, sources, columns, stamps)
    return Decoded(columns, stamps, failed)


def _batches(messages: Iterable[Message]) -> Iterator[list[Message]]:
    batch: list[Message] = []
    size = 0
    for message in messages:
        batch.append(message)
        size += len(message[2])
        if len(batch) >= BATCH or size >= BATCH_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


class _Part(NamedTuple):
    """Samples of one signal in a batch: which messages, and values (n, size)."""

    key: tuple[int, str]
    order: int
    rows: IndexArray
    values: FloatArray


def _add_batch(batch: list[Message], sources: Mapping[int, Source], columns: ColumnsOf, stamps: Stamps) -> int:
    """Adds the numbers of a batch to the columns; returns how many messages could not be decoded."""
    numbers = np.array([number for number, _, _ in batch])
    stamped, decoded = np.zeros((len(batch), 2), np.int64), np.ones(len(batch), np.bool_)
    parts: list[_Part] = []
    for number in dict.fromkeys(numbers.tolist()):
        source, rows = sources[number], np.flatnonzero(numbers == number)
        parts += _read(number, source, rows, [batch[row][2] for row in rows], stamped, decoded)
    groups = ["header" if sources[number].layout is not None else "px4" for number in numbers[decoded].tolist()]
    times = np.full(len(batch), np.nan)
    if groups:
        logged = [batch[row][1] for row in np.flatnonzero(decoded)]
        times[decoded] = stamps.times(groups, stamped[decoded], logged)
    failed = len(batch) - int(np.count_nonzero(decoded))
    for part in sorted(parts, key=lambda p: (p.rows[0], p.order)):
        kept = columns.get(part.key)
        if part.values.shape[1] == 0 or (kept is not None and kept.width != part.values.shape[1]):
            failed += len(part.rows)
            continue
        if kept is None:
            kept = columns[part.key] = Columns(part.values.shape[1])
        kept.add_many(times[part.rows], part.values)
    return failed


def _read(
    number: int, source: Source, rows: IndexArray, data: list[bytes], stamped: IntArray, decoded: BoolArray
) -> list[_Part]:
    """Reads messages of a topic, the `rows` of a batch; `decoded` becomes False where that is not possible."""
    read = source.layout.read_many(data) if source.layout is not None else None
    signals = None if read is None else source.columns.pick(read.blocks, read.extra)
    if read is not None and signals is not None:
        stamped[rows, 0], stamped[rows, 1] = read.seconds, read.nanoseconds
    elif len(rows) > 1:
        half = len(rows) // 2
        first = _read(number, source, rows[:half], data[:half], stamped, decoded)
        return first + _read(number, source, rows[half:], data[half:], stamped, decoded)
    else:
        try:
            message = source.read(data[0])
            told = source.kind.signals(message.blocks, message.extra)
            signals = [(name, np.array(values, dtype=np.float64)[None]) for name, values in told]
            stamped[rows] = message.seconds, message.nanoseconds
        except UNDECODABLE:
            decoded[rows] = False
            return []
    return [_Part((number, name), order, rows, values) for order, (name, values) in enumerate(signals)]
