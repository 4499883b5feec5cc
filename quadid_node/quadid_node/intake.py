"""Messages wait here, topic by topic, until the service next looks: many of a kind are read for little more than one.

A subscription's callback only appends the serialized message to a list, so that no message waits for the work on
another one.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

from quadid.window import Block, Sample
from quadid_node.convert import Decoder
from quadid_node.presets import Input

Record = Callable[[str, str, bytes], None]


class Intake:
    """The messages of all topics of one vehicle.

    Attributes:
        decoders: by topic name as resolved.
    """

    def __init__(self) -> None:
        self.decoders: dict[str, Decoder] = {}
        self._topics: list[tuple[Input, Decoder, list[bytes]]] = []

    def open(self, entry: Input, topic: str, decoder: Decoder) -> Callable[[bytes], None]:
        """Adds a topic; returns what takes its messages."""
        waiting: list[bytes] = []
        self.decoders[topic] = decoder
        self._topics.append((entry, decoder, waiting))
        # The gyro sets the pace of the grid: what came with it has been taken in before it.
        self._topics.sort(key=lambda item: any(channel == "gyro" for channel, _ in item[0].channels))
        return waiting.append

    def take(self, record: Record | None = None) -> Iterator[Sample | Block]:
        """Empties the lists, topic by topic.

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
        for _ in self._emptied():
            pass

    def clear(self) -> None:
        """Forgets the topics as well."""
        self._topics.clear()
        self.decoders.clear()

    def _emptied(self) -> Iterator[tuple[Input, Decoder, Sequence[bytes]]]:
        for entry, decoder, waiting in self._topics:
            if waiting:
                messages = waiting.copy()
                waiting.clear()
                yield entry, decoder, messages
