"""Set in force: numbering, approval, watching a new set against its predecessor, rollback."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from quadid.online.records import WAITS, Event, OnlineSet, Publish, Reference, SetState
from quadid.parameters import ParameterSet

Action = Publish | Event
FORCE = 0.09
"""Standard deviation (log scale) of force where nothing else measures it. A support, and an accelerometer's scale that
hides it and is itself hidden by a bias, are not seen at any size: 15 % of the weight beside a scale of 1.17 (b +17 %)
are within two standard deviations. Accelerometers are sold with scales up to 10 % off."""
MOST_HELD = 60
"""Sets that wait and can still be approved by their numbers: at a refit a second, those of the last minute."""


@dataclass(frozen=True)
class Answer:
    """Answer to a command: whether it did something, and a sentence."""

    done: bool
    text: str
    actions: tuple[Action, ...] = ()


class ActiveSet:
    """Accepted sets of one vehicle.

    Attributes:
        in_force: the set that the parameter topic holds; None before the first.
        baseline: set from which creeping is measured: the last one a person approved, else the first.
        approval: auto or manual; a rollback by a person makes it manual.
        seen: end of the data that the set in force rests on [s, session time]; minus infinity for none of this flight.
        watched: deviance lost to the predecessor so far; gains do not pile up.
        load: mass over that of the vehicle file, as changes since a person last approved a set tell it.
    """

    def __init__(
        self,
        approval: str,
        restored: OnlineSet | None = None,
        next_sequence: int = 1,
        baseline: OnlineSet | None = None,
        load: float = 1.0,
    ) -> None:
        """Starts empty, or from the last accepted set of an earlier run, which is stale until revalidated.

        Args:
            approval: auto or manual.
            restored: set in force when the earlier run ended.
            next_sequence: first number not yet given.
            baseline: what creeping is measured from; default `restored`.
            load: as an earlier run left it.
        """
        self.approval, self.load = approval, load
        self._held: dict[int, tuple[OnlineSet, float]] = {}
        self.in_force: OnlineSet | None = None
        self._earlier: list[OnlineSet] = []
        self._next = max(next_sequence, restored.sequence + 1 if restored else 1)
        if restored is not None:
            reason = f"from an earlier run ({restored.reason}): not yet confirmed by this flight"
            # A number of its own: who uses the set already learns that it is stale now.
            self.in_force = replace(restored, sequence=self._number(), state=SetState.STALE, reason=reason)
        self.baseline = baseline or self.in_force
        self._trusted = self.baseline is not None
        self.seen = -math.inf
        self.watched, self._watch_from = 0.0, math.inf

    @property
    def pending(self) -> OnlineSet | None:
        """The newest set that waits for approval."""
        return next(reversed(self._held.values()))[0] if self._held else None

    @property
    def predecessor(self) -> OnlineSet | None:
        """The set a rollback would return to."""
        return self._earlier[-1] if self._earlier else None

    def reference(self, stated: ParameterSet) -> tuple[Reference, float]:
        """Reference of a set, and the standard deviation (log scale) of the force by it.

        Args:
            stated: parameters that the vehicle file claims to know.
        """
        if self.baseline is not None:
            return "history" if self._trusted else self.baseline.reference, self.baseline.reference_sd
        if "b" in stated.names:
            return "vehicle_file", min(stated["b"].sigma / stated["b"].value, FORCE)
        return "none", FORCE

    def accept(self, item: OnlineSet, by: str, t: float, stop: float) -> list[Action]:
        """Puts a set in force.

        Args:
            by: who approved it.
            t: now, as a stamp [s].
            stop: end of the data it rests on [s, session time].
        """
        accepted = replace(item, sequence=self._number(), state=SetState.ACCEPTED, approved_by=by)
        if self.in_force is not None and self.in_force.state is not SetState.STALE:
            self._earlier.append(self.in_force)
            del self._earlier[:-20]
        self.in_force = accepted
        self._held.clear()
        if self.baseline is None or by != "auto":
            self.baseline = accepted
        if by != "auto":
            self._trusted, self.load = True, 1.0
        self.watched, self._watch_from, self.seen = 0.0, stop, stop
        told = f"set {accepted.sequence} in force (reference: {accepted.reference}): {accepted.reason}"
        return [Publish("parameters", accepted), Event(t, "info", "accepted", told)]

    def withdraw(self, why: str, code: str) -> list[Action]:
        """Marks the set in force as out of date; it stays what there is until the next one.

        Args:
            why: one sentence.
            code: an effect's name, ``unknown_cause`` or ``disagreement``.
        """
        if self.in_force is None or self.in_force.outdated:
            return []
        self.in_force = replace(self.in_force, sequence=self._number(), outdated=why, outdated_code=code)
        return [Publish("parameters", self.in_force)]

    def hold(self, item: OnlineSet, stop: float) -> OnlineSet:
        """Keeps a set for approval, under a number that stands for it and no other; `stop` as in `accept`."""
        held = replace(item, sequence=self._number(), state=SetState.PENDING)
        self._held[held.sequence] = (held, stop)
        if len(self._held) > MOST_HELD:
            del self._held[next(iter(self._held))]
        return held

    def drop_pending(self) -> None:
        """Forgets the sets that wait for approval."""
        self._held.clear()

    def approve(self, t: float, by: str, sequence: int | None = None) -> Answer:
        """A person approves one of the sets that wait, by its number; without one the newest.

        A second approval, or one of a number that does not wait, does nothing.
        """
        if self.pending is None:
            return Answer(False, "nothing waits for approval")
        number = self.pending.sequence if sequence is None else sequence
        if number not in self._held:
            return Answer(
                False, f"set {number} does not wait for approval; the newest that does is {self.pending.sequence}"
            )
        waited, stop = self._held[number]
        item = replace(waited, reason=f"approved by {by}: {waited.reason.removeprefix(WAITS)}")
        actions = self.accept(item, by, t, stop)
        assert self.in_force is not None
        return Answer(True, f"set {number} approved, in force as set {self.in_force.sequence}", tuple(actions))

    def roll_back(self, t: float, by: str, why: str = "") -> Answer:
        """Returns to the set before the one in force, under a new number; what made that out of date made both."""
        if not self._earlier:
            return Answer(False, "there is no earlier set to return to")
        assert self.in_force is not None
        bad, good = self.in_force, self._earlier.pop()
        reason = f"set {good.sequence} again, in place of set {bad.sequence}: {why or 'asked for by ' + by}"
        self.in_force = replace(
            good,
            sequence=self._number(),
            state=SetState.ROLLED_BACK,
            reason=reason,
            approved_by=by,
            outdated=good.outdated or bad.outdated,
            outdated_code=good.outdated_code if good.outdated else bad.outdated_code,
        )
        self._held.clear()
        self._watch_from = math.inf
        if by != "auto":
            self.approval, self.baseline, self._trusted = "manual", self.in_force, True
        event = Event(t, "warning", "rollback", reason)
        return Answer(True, reason, (Publish("parameters", self.in_force), event))

    def watch(self, start: float, stop: float, loss: float) -> bool:
        """Adds what the set in force lost to its predecessor in a window it had not seen.

        Args:
            start: of the window [s, session time]; windows count once, and only after the set was made.
            stop: its end [s].
            loss: deviance of the set in force above that of its predecessor.

        Returns:
            The window was counted.
        """
        if start < self._watch_from - 1e-6:
            return False
        self._watch_from = stop
        self.watched = max(self.watched + loss, 0.0)
        return True

    def _number(self) -> int:
        self._next += 1
        return self._next - 1
