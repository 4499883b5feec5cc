"""Messages wait here, topic by topic, until the service next looks: many of a kind are read for little more than one.

A subscription's callback only appends the serialized message to a list, so that no message waits for the work on
another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator

from quadid.window import Block, Sample
from quadid_node.convert import Decoder
from quadid_node.presets import Input

Record = Callable[[str, str, bytes], None]
Waiting = tuple[Input, Decoder, list[bytes]]

MOST = 20
"""Messages of one topic that are taken in before those of the others: when a busy machine has let seconds of them pile
up, no topic runs far ahead, which would look as if the clock had stepped back."""


class Intake:
    """The messages of all topics of one vehicle.

    Attributes:
        decoders: by topic name as resolved.
    """

    def __init__(self) -> None:
        self.decoders: dict[str, Decoder] = {}
        self._topics: list[Waiting] = []
        self._full: list[Waiting] = []

    def open(self, entry: Input, topic: str, decoder: Decoder) -> Callable[[bytes], None]:
        """Adds a topic; returns what takes its messages."""
        waiting: list[bytes] = []
        self.decoders[topic] = decoder
        self._topics.append((entry, decoder, waiting))
        # The gyro sets the pace of the grid: what came with it has been taken in before it.
        self._topics.sort(key=lambda item: any(channel == "gyro" for channel, _ in item[0].channels))

        def keep(data: bytes) -> None:
            if len(waiting) >= MOST:
                self._set_aside()
            waiting.append(data)

        return keep

    def take(self, record: Record | None = None) -> Iterator[Sample | Block]:
        """Empties the lists, at most `MOST` messages of each topic at a time.

        Args:
            record: writes a message down (topic, type, bytes), in the order in which they are taken in.
        """
        for entry, decoder, messages in self._emptied():
            if record is not None:
                for data in messages:
                    record(entry.topic, entry.type.replace("/", "/msg/"), data)
            yield from decoder.take(messages)

    def drop(self) -> None:
        """Forgets what waits."""
        self._emptied()

    def clear(self) -> None:
        """Forgets the topics as well."""
        self._topics.clear()
        self._full.clear()
        self.decoders.clear()

    def _set_aside(self) -> None:
        """What waits is taken in before anything that comes later."""
        self._full += [(entry, decoder, waiting.copy()) for entry, decoder, waiting in self._topics if waiting]
        for _, _, waiting in self._topics:
            waiting.clear()

    def _emptied(self) -> list[Waiting]:
        self._set_aside()
        full, self._full = self._full, []
        return full
