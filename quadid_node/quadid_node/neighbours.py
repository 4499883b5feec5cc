"""Who else is on our topics: a second publisher of an input, others whose QoS or type does not match."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable

REMEMBERED = 30.0
"""A subscriber that cannot hear us is told of for so long [s] after it came."""
_CROWDED = "publishers on one topic: paused until there is one"


class Neighbours:
    """What is wrong on the topics.

    Attributes:
        notes: by topic.
        paused: an input has two publishers: taking samples would mix two vehicles.
    """

    def __init__(
        self, inputs: Iterable[str], count: Callable[[str], int], tell: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Watches the topics `inputs`.

        Args:
            inputs: full names.
            count: publishers on a topic.
            tell: takes a line for people.
            clock: seconds, monotonic.
        """
        self._inputs, self._count, self._tell, self._clock = tuple(inputs), count, tell, clock
        self._until: dict[str, float] = {}
        self.notes: dict[str, str] = {}
        self.paused = False

    def note(self, topic: str, text: str) -> None:
        """Notes what is wrong on a topic; an empty text: nothing is."""
        if not text:
            self.notes.pop(topic, None)
        elif self.notes.get(topic) != text:
            self._tell(f"{topic}: {text}")
            self.notes[topic] = text

    def deaf(self, topic: str) -> None:
        """A subscriber asks for more than we offer and will hear nothing."""
        who = f"{topic}, its subscriber"
        self._until[who] = self._clock() + REMEMBERED
        self.note(who, "asks for a QoS that is not offered here, and receives nothing")

    def matched(self, topic: str, publishers: int) -> None:
        """The number of publishers of an input has changed: at once, before the new one's first message."""
        if publishers > 1:
            self.paused = True
            self.note(topic, f"{publishers} {_CROWDED}")

    def look(self) -> None:
        """Counts publishers, and forgets what is over; once a second."""
        counts = {topic: self._count(topic) for topic in self._inputs}
        for topic, publishers in counts.items():
            if publishers > 1:
                self.matched(topic, publishers)
            elif publishers == 0 or _CROWDED in self.notes.get(topic, ""):
                self.note(topic, "")
        self.paused = any(n > 1 for n in counts.values())
        for topic, until in list(self._until.items()):
            if self._clock() > until:
                del self._until[topic]
                self.note(topic, "")
