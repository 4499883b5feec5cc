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

    def take(self, record: Record | None = None) -> Iterator[Sample | Block]:
        """Takes all messages that wait.

        Args:
            record: writes a message down (topic, type, bytes), in the order in which they are taken in.
        """
        slices, waiting = self._emptied()
        for k in range(slices):
            for (entry, decoder, _), messages in zip(self._topics, waiting, strict=True):
                piece = messages[k * len(messages) // slices : (k + 1) * len(messages) // slices]
                if record is not None:
                    for data in piece:
                        record(entry.topic, entry.type.replace("/", "/msg/"), data)
                yield from decoder.take(piece)

    def drop(self) -> None:
        """Forgets what waits."""
        self._emptied()

    def clear(self) -> None:
        """Forgets the topics as well."""
        self._topics.clear()
        self.decoders.clear()

    def _emptied(self) -> tuple[int, list[list[bytes]]]:
        """How many slices of time passed since the last look, and the messages of each topic."""
        before, self._looked = self._looked, self._clock()
        waiting = [list(islice(iter(topic.take, None), DEPTH)) for topic in self._topics]
        return max(1, math.ceil((self._looked - before) / SLICE)), waiting
