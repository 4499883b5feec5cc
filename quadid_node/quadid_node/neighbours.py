"""Who else is on our topics: a second publisher of an input, others whose QoS or type does not match."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from quadid.sanitise import plain

ALONE = 1.0
"""An input with several publishers is used when only one of them was heard for this long [s].  One that was killed
stays listed until its lease ends (20 s with Fast DDS), while its successor already speaks."""


class Offer(NamedTuple):
    """One publisher of a topic: the type of its messages, and whether its QoS lets us hear them."""

    kind: str
    heard: bool


class Neighbours:
    """What is wrong on the topics.

    Attributes:
        notes: by topic.
        paused: two publishers of an input are heard: taking samples would mix two vehicles.
    """

    def __init__(
        self, inputs: Mapping[str, str], offered: Callable[[str], Sequence[Offer]],
        unbroken: Callable[[str], float], tell: Callable[[str], None],
    ) -> None:  # fmt: skip
        """Watches the topics `inputs`.

        Args:
            inputs: type of messages by full name.
            offered: a topic's publishers.
            unbroken: for how long [s] a topic's messages have been one publisher's.
            tell: takes a line for people.
        """
        self._inputs, self._offered, self._unbroken, self._tell = dict(inputs), offered, unbroken, tell
        self.notes: dict[str, str] = {}
        self.paused = False

    def note(self, topic: str, text: str) -> None:
        """Notes what is wrong on a topic; an empty text: nothing is."""
        if not text:
            self.notes.pop(topic, None)
        elif self.notes.get(topic) != text:
            self._tell(f"{topic}: {text}")
            self.notes[topic] = text

    def count(self, topic: str, publishers: int) -> None:
        """So many publishers send to an input: two are noted, and pause it at once while both are heard."""
        if publishers <= 1:
            return
        if self._unbroken(topic) < ALONE:
            self.paused = True
            self.note(topic, f"{publishers} publishers on one topic: paused until only one publishes")
        else:
            self.note(topic, f"{publishers} publishers on one topic, only one publishes")

    def look(self, deaf: Mapping[str, bool]) -> None:
        """Looks at every topic, once a second.

        Args:
            deaf: for each topic of ours, whether somebody subscribes with a QoS that is not offered.
        """
        self.paused = False
        for topic, kind in self._inputs.items():
            offers = self._offered(topic)
            ours = [offer for offer in offers if offer.kind == kind]
            strange = sorted({offer.kind for offer in offers} - {kind})
            if len(ours) > 1:
                self.count(topic, len(ours))
            elif strange:
                told = f"a publisher of another type ({plain(strange[0], 80)} for {kind}), which is not listened to"
                self.note(topic, told)
            else:
                self.note(topic, "" if all(offer.heard for offer in ours) else "its publisher's QoS does not match")
        for topic, found in deaf.items():
            why = "asks for a QoS that is not offered here, and receives nothing" if found else ""
            self.note(f"{topic}, its subscriber", why)
