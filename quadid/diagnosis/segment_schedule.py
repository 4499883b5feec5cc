"""Which lengths of segments decide: continuation from short ones to long ones as the model gets better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from quadid.diagnosis.model import Model, fit_model, refit
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray

LINEAR_MISFIT = 4.0
"""Deviance per row above which segments are too long for the model: it does not follow the flight to their end."""
USUAL_SECONDS = 1.0
"""Longer segments decide only where airspeed matters and is not measured: every segment has a velocity of its own to
find, short ones hardly find it, and then drag comes out too large and one kind of it passes for another …"""
CLEAN_MISFIT = 1.2
"""… and where the model leaves hardly more than noise in them: a cause not found yet grows with their length."""


def is_long(shooting: Shooting) -> bool:
    """Whether segments are longer than usual: there the cost of a missing moment grows beyond all measure."""
    return shooting.seconds > 1.5 * USUAL_SECONDS


@dataclass(frozen=True)
class Stage:
    """Where the continuation stands.

    Attributes:
        schedule: the data cut into segments of falling length.
        rung: the one in use.
        model: fitted on it.
    """

    schedule: Sequence[Shooting]
    rung: int
    model: Model

    @classmethod
    def begin(cls, schedule: Sequence[Shooting], theta: FloatArray, known: Model | None = None) -> Stage:
        """The longest segments that the nominal model at `theta`, or the `known` one, follows; else the shortest."""
        shortest = len(schedule) - 1
        if known is None:
            return cls(schedule, shortest, fit_model(schedule[shortest], theta, ())).continued()
        return cls(schedule, shortest, known).at(shortest).continued()

    @property
    def shooting(self) -> Shooting:
        """The problem in use."""
        return self.schedule[self.rung]

    @property
    def follows(self) -> bool:
        """Whether segments are not too long for the model to decide on them."""
        return self.model.lin.reduced_chi_square < (CLEAN_MISFIT if is_long(self.shooting) else LINEAR_MISFIT)

    def at(self, rung: int) -> Stage:
        """On another rung, the model refitted there."""
        return replace(self, rung=rung, model=refit(self.schedule[rung], self.model, None, iterations=10))

    def continued(self) -> Stage:
        """On the longest segments that may decide about the model and that it follows, never shorter without need."""
        usual = next(rung for rung, shooting in enumerate(self.schedule) if not is_long(shooting))
        longest = 0 if self.model.finds_velocity else usual
        for rung in range(longest, self.rung):
            if (longer := self.at(rung)).follows:
                return longer
        return self if self.rung >= longest else self.at(longest)

    def longest(self) -> Stage | None:
        """The longest segments of all, where the model leaves hardly more than noise in them."""
        if self.rung == 0 or not is_long(self.schedule[0]):
            return None
        far = self.at(0)
        return far if far.follows else None
