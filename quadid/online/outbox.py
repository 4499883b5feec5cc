"""What a session says: its phase and reason, and the actions that wait to be handed out."""

from __future__ import annotations

import math
from collections.abc import Callable

from quadid.health.watch import HealthReport
from quadid.online.jobs import Job
from quadid.online.records import Event, HealthyFlight, OnlineDiagnosis, Phase, Publish

Action = Job | Publish | OnlineDiagnosis | HealthReport | HealthyFlight | Event


class Outbox:
    """Phase, reason and outgoing actions.

    Attributes:
        phase, reason: what the session is doing, and why.
    """

    def __init__(self, stamp: Callable[[float], float]) -> None:
        """Speaks in the time of the stream's stamps: `stamp` turns session time [s] into them."""
        self._stamp = stamp
        self.phase, self.reason = Phase.WAITING, "no samples yet"
        self._out: list[Action] = []

    def stamp(self, t: float) -> float:
        """Session time as a stamp [s]; NaN for no time."""
        return self._stamp(t) if math.isfinite(t) else math.nan

    def act(self, *actions: Action) -> None:
        """Queues actions."""
        self._out.extend(actions)

    def say(self, t: float, level: str, kind: str, text: str) -> None:
        """Queues an event at session time `t` [s]."""
        self._out.append(Event(self.stamp(t), level, kind, text))

    def state(self, phase: Phase, reason: str) -> None:
        """Notes phase and reason."""
        self.phase, self.reason = phase, reason

    def note(self, t: float, phase: Phase, reason: str) -> None:
        """Notes phase and reason, and journals them when they are of a new kind."""
        if (phase, reason.split(":")[0]) != (self.phase, self.reason.split(":")[0]):
            level = "warning" if phase in (Phase.BLOCKED, Phase.FAILED) else "info"
            self.say(t, level, phase.name.lower(), reason)
        self.state(phase, reason)

    def take(self) -> list[Action]:
        """Hands the queued actions out."""
        out, self._out = self._out, []
        return out
