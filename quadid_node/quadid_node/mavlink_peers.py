"""Who speaks on a MAVLink link: one source for the vehicle, and the few peers that are answered."""

from __future__ import annotations

from collections import deque
from collections.abc import Hashable

import numpy as np
from quadid_replay.frame_numbers import two_rows

Address = Hashable
SILENT = 3.0
"""A source that is silent for so long [s] may be replaced by another: the vehicle came back from elsewhere.

Time counts only while we listened (`Wire.listened`): who sent during a stall of ours was not silent."""
JUDGED, ROWS = 40, 160
"""Whether frame numbers come in two rows is judged after so many frames, of the last so many."""
CALM = 2.0
"""Frame numbers must follow for so long [s] before a stream that two had mixed is believed again."""
REPEATS, REPEAT_SECONDS = 3, 10.0
"""A number that comes again with something else in it, so often within this time [s], comes from a second sender: one
that follows the first one's numbers, which then look like those of one."""
PAUSE = 0.1
"""After so long without a frame [s] numbers may have run on unheard: none is known then."""
HELLOS, HELLO_SECONDS = 2, 0.5
"""A peer is answered after so many believable heartbeats that span this time [s],"""
FORGOTTEN = 15.0
"""... until it is silent for so long [s],"""
MOST_PEERS = 8
"""... and never more of them at a time."""


class Source:
    """Holds that all frames of the vehicle come from one sender.

    Attributes:
        problem: what speaks against it now, or empty.
    """

    def __init__(self) -> None:
        self.problem = ""
        self._address: Address | None = None
        self._heard, self._mixed_until, self._refused_at = -1e9, -1e9, -1e9
        self._numbers: deque[int] = deque(maxlen=ROWS)
        self._frames = 0
        self._contents: dict[int, int] = {}
        self._newest, self._counted = 0, -1e9
        self._repeated: deque[float] = deque(maxlen=REPEATS)

    def is_from(self, address: Address | None) -> bool:
        """Whether this is the address of the vehicle."""
        return address == self._address

    def take(self, address: Address | None, now: float) -> bool:
        """Whether a frame of the vehicle from an address may be believed now [s]; None where a link tells none."""
        if now - self._heard > SILENT:
            self._address = address
            self._numbers.clear()
        if address != self._address:
            self._refused_at = now
            self.problem = f"a second source {address} sends as our vehicle ({self._address}): its frames are refused"
            return False
        self._heard = now
        if now < self._mixed_until:
            self.problem = "two sources are mixed in one stream (by their frame numbers): nothing is believed"
            return False
        if now - self._refused_at > SILENT:
            self.problem = ""
        return True

    def count(self, address: Address | None, sequence: int, now: float, frame: bytes = b"") -> None:
        """Looks at the number of every frame: those of one sender follow each other, those of two alternate or repeat.

        Bits turn over on a serial line, so that there, without an address, repeated numbers are not looked at.
        """
        if address != self._address:
            return
        if address is not None and self._repeats(sequence, now, hash(frame)):
            self._mixed_until = now + REPEAT_SECONDS
        self._numbers.append(sequence)
        self._frames += 1
        if self._frames >= JUDGED:
            self._frames = 0
            if two_rows(np.array(self._numbers)):
                self._mixed_until = now + CALM

    def _repeats(self, sequence: int, now: float, content: int) -> bool:
        """Whether numbers used a moment ago have come with something else in them again and again."""
        if now - self._counted > PAUSE:
            self._contents.clear()
        self._counted = now
        behind = (self._newest - sequence) % 256
        if not self._contents or behind >= 128:
            for number in range(1, 257 - behind if self._contents else 1):
                self._contents.pop((self._newest + number) % 256, None)
            self._newest, self._contents[sequence] = sequence, content
            return False
        if self._contents.setdefault(sequence, content) == content:
            return False
        self._contents.clear()
        self._repeated.append(now)
        return len(self._repeated) == REPEATS and now - self._repeated[0] <= REPEAT_SECONDS


class Peers:
    """Addresses that are answered: the vehicle's, and those that have shown to be ground stations."""

    def __init__(self) -> None:
        self._hellos: dict[Address, list[float]] = {}
        self._vehicle: Address | None = None

    def hello(self, address: Address, now: float, vehicle: bool) -> None:
        """Notes a believable heartbeat."""
        if vehicle:
            self._vehicle = address
        known = self._hellos.get(address)
        if known is not None:
            self._hellos[address] = [known[0], now, known[2] + 1.0]
        elif len(self._hellos) < 4 * MOST_PEERS:
            self._hellos[address] = [now, now, 1.0]

    def answered(self, now: float) -> set[Address]:
        """Who gets what we send."""
        self._hellos = {a: seen for a, seen in self._hellos.items() if now - seen[1] <= FORGOTTEN}
        steady = [a for a, (first, last, n) in self._hellos.items() if n >= HELLOS and last - first >= HELLO_SECONDS]
        return {*steady[:MOST_PEERS], *([self._vehicle] if self._vehicle in self._hellos else [])}
