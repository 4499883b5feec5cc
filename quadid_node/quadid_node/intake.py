"""Messages are taken from the middleware many at a time, topic by topic, whenever the service looks for them.

Nobody is woken for a message: each carries its own time, and the rows of the grid wait half a second for the slowest
channel anyway.  Many of a kind are read for little more than one.
"""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Iterator
from itertools import islice
from typing import NamedTuple

from quadid.window import Block, Sample
from quadid_node.convert import Decoder
from quadid_node.presets import Input

Record = Callable[[str, str, bytes], None]

SLICE = 0.2
"""When longer than this [s] nobody looked, the messages of that time are taken in by slices of this length, so that no
topic runs far ahead of the others, which would then come too late."""
DEPTH = 4000
"""Messages of a topic that are kept for the next look, and the most that one look takes."""


class _Topic(NamedTuple):
    entry: Input
    decoder: Decoder
    take: Callable[[], bytes | None]


class Waiting(NamedTuple):
    """Messages that were taken and not read yet: of each topic, and in how many slices of time they came."""

    slices: int
    messages: list[list[bytes]]


class Intake:
    """The messages of all topics of one vehicle.

    Attributes:
        decoders: by topic name as resolved.
    """

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        """Takes a clock that never steps [s]."""
        self.decoders: dict[str, Decoder] = {}
        self._topics: list[_Topic] = []
        self._clock, self._looked = clock, clock()

    def open(self, entry: Input, topic: str, decoder: Decoder, take: Callable[[], bytes | None]) -> None:
        """Adds a topic.

        Args:
            entry: topic, type, channels with ranks.
            topic: its name as resolved.
            decoder: of its messages.
            take: gives the next serialized message that waits; None when there is none.
        """
        self.decoders[topic] = decoder
        self._topics.append(_Topic(entry, decoder, take))
        # The gyro sets the pace of the grid: what came with it has been taken in before it.
        self._topics.sort(key=lambda item: any(channel == "gyro" for channel, _ in item.entry.channels))

    def take(self) -> Waiting:
        """Takes all messages that wait; those that are not read are forgotten."""
        before, self._looked = self._looked, self._clock()
        messages = [list(islice(iter(topic.take, None), DEPTH)) for topic in self._topics]
        for topic, taken in zip(self._topics, messages, strict=True):
            topic.decoder.pace.look(self._looked, before, len(taken))
        return Waiting(max(1, math.ceil((self._looked - before) / SLICE)), messages)

    def read(self, waiting: Waiting, record: Record | None = None) -> Iterator[list[Sample | Block]]:
        """Reads what was taken, one topic after the other.

        Args:
            waiting: what `take` gave.
            record: writes a message down (topic, type, bytes), in the order in which they are read.
        """
        for k in range(waiting.slices):
            for (entry, decoder, _), messages in zip(self._topics, waiting.messages, strict=True):
                piece = messages[k * len(messages) // waiting.slices : (k + 1) * len(messages) // waiting.slices]
                if record is not None:
                    for data in piece:
                        record(entry.topic, entry.type.replace("/", "/msg/"), data)
                if piece:
                    yield list(decoder.take(piece))

    def troubles(self) -> dict[str, str]:
        """What is wrong with the messages of topics, by topic name as resolved."""
        return {topic: why for topic, decoder in self.decoders.items() if (why := decoder.trouble)}

    def clear(self) -> None:
        """Forgets the topics."""
        self._topics.clear()
        self.decoders.clear()
