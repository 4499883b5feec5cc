"""On the disk before on the wire: numbered sets, and what is said of them, wait until their row is committed."""

from __future__ import annotations

from typing import Protocol

from quadid.condition.watch import HealthReport
from quadid.online.records import Event, HealthyFlight, OnlineDiagnosis, OnlineSet, Publish

Output = Publish | OnlineDiagnosis | HealthReport | HealthyFlight | Event
"""What a service hands out; its `topic` says which it is, and is what the tables of the links are keyed by."""
OF_SETS = ("accepted", "rollback")
"""Kinds of events that say which set is in force."""
MOST_WAITING = 64
"""Outputs that wait for the disk; beyond, the oldest are never published, but the newest set in force always is."""


class Disk(Protocol):
    """What is asked of the history."""

    def written(self, number: int) -> bool:
        """Whether the set of that number is on the disk."""

    def lost(self, number: int) -> bool:
        """Whether it will never be there."""


class Publication:
    """Hands outputs out, in order, once they may be published.

    Attributes:
        in_force: the set that was handed out last for the parameter topic; None before the first.
    """

    def __init__(self, disk: Disk | None) -> None:
        """Asks `disk`; without one nothing waits."""
        self._disk = disk
        self._waiting: list[Output] = []
        self.in_force: OnlineSet | None = None

    @property
    def waiting(self) -> int:
        """How many outputs wait for the disk."""
        return len(self._waiting)

    def take(self, outputs: list[Output]) -> list[Output]:
        """Takes further outputs; returns those that may be published now."""
        free = list[Output]()
        for output in outputs:
            (self._waiting if self._waits(output) else free).append(output)
        out = [*self._released(), *free]
        self._forget_oldest()
        for output in out:
            if output.topic == "parameters":
                self.in_force = output.item
        return out

    def _waits(self, output: Output) -> bool:
        if self._disk is None:
            return False
        if isinstance(output, Publish):
            return output.item.sequence > 0
        return output.topic == "event" and output.kind in OF_SETS and bool(self._waiting)

    def _forget_oldest(self) -> None:
        ours = [o for o in self._waiting if o.topic == "parameters"]
        while len(self._waiting) > MOST_WAITING:
            self._waiting.remove(next(o for o in self._waiting if not any(o is newest for newest in ours[-1:])))

    def _released(self) -> list[Output]:
        """What waits up to the first set that is not on the disk yet; one that never will be holds up no other."""
        disk, out = self._disk, list[Output]()
        while disk is not None and self._waiting:
            output = self._waiting[0]
            if not isinstance(output, Publish) or disk.written(output.item.sequence):
                out.append(output)
            elif not disk.lost(output.item.sequence):
                break
            del self._waiting[0]
        return out
