"""On the disk before on the wire: numbered sets, and what is said of them, wait until their row is committed."""

from __future__ import annotations

from quadid.condition.watch import HealthReport
from quadid.online.records import Event, HealthyFlight, OnlineDiagnosis, OnlineSet, Publish
from quadid_node.history import Store

Output = Publish | OnlineDiagnosis | HealthReport | HealthyFlight | Event
"""What a service hands out; its `topic` says which it is, and is what the tables of the links are keyed by."""
OF_SETS = ("accepted", "rollback")
"""Kinds of events that say which set is in force."""
MOST_WAITING = 64
"""Outputs that wait for the disk; beyond, the oldest are never published, but the newest set in force always is."""


class Publication:
    """Hands outputs out, in order, once they may be published.

    Attributes:
        in_force: the set that was handed out last for the parameter topic; None before the first.
    """

    def __init__(self, store: Store | None) -> None:
        """Asks `store` which sets are on the disk; without one nothing waits."""
        self._store = store
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
            waits = isinstance(output, Publish) and output.item.sequence > 0
            waits |= output.topic == "event" and output.kind in OF_SETS and bool(self._waiting)
            (self._waiting if waits and self._store is not None else free).append(output)
        out = [*self._released(), *free]
        while len(self._waiting) > MOST_WAITING:  # the oldest but the newest set in force
            newest = next((o for o in reversed(self._waiting) if o.topic == "parameters"), None)
            self._waiting.remove(next(o for o in self._waiting if o is not newest))
        for output in out:
            if output.topic == "parameters":
                self.in_force = output.item
        return out

    def _released(self) -> list[Output]:
        """What waits up to the first set that is not on the disk yet; one that never will be holds up no other."""
        store, out = self._store, list[Output]()
        while store is not None and self._waiting:
            output = self._waiting[0]
            if not isinstance(output, Publish) or output.item.sequence in store.written:
                out.append(output)
            elif output.item.sequence not in store.lost:
                break
            del self._waiting[0]
        return out
