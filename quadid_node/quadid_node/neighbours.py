"""Who else is on our topics: a second publisher of an input, others whose QoS or type does not match."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

from quadid.plain import plain

REMEMBERED = 30.0
"""A subscriber that cannot hear us is told of for so long [s] after it came."""
_CROWDED = "publishers on one topic: paused until there is one"
_STRANGE = "a publisher of another type"


class Neighbours:
    """What is wrong on the topics.

    Attributes:
        notes: by topic.
        paused: an input has two publishers: taking samples would mix two vehicles.
    """

    def __init__(
        self, inputs: Mapping[str, str], offered: Callable[[str], Sequence[str]], tell: Callable[[str], None],
        clock: Callable[[], float] = time.monotonic,
    ) -> None:  # fmt: skip
        """Watches the topics `inputs`.

        Args:
            inputs: type of messages by full name.
            offered: types of a topic's publishers, one entry each.
            tell: takes a line for people.
            clock: seconds, monotonic.
        """
        self._inputs, self._offered, self._tell, self._clock = dict(inputs), offered, tell, clock
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
        """Counts publishers, and forgets what is over; once a second.

        DDS tells some of it by events, but no type that differs: what nobody can receive has to be looked for.
        """
        most = 0
        for topic, kind in self._inputs.items():
            types = self._offered(topic)
            strange = sorted({*types} - {kind})
            most = max(most, types.count(kind))
            if types.count(kind) > 1:
                self.matched(topic, types.count(kind))
            elif strange:
                self.note(topic, f"{_STRANGE} ({plain(strange[0], 80)} for {kind}), which is not listened to")
            elif not types or any(told in self.notes.get(topic, "") for told in (_CROWDED, _STRANGE)):
                self.note(topic, "")
        self.paused = most > 1
        for topic, until in list(self._until.items()):
            if self._clock() > until:
                del self._until[topic]
                self.note(topic, "")
