"""Which lengths of segments decide: the ladder that a search climbs as its model gets better."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.models import Model, fit_model
from quadid.identify.shooting import Shooting

FloatArray = NDArray[np.float64]

LINEAR_MISFIT = 4.0
"""Deviance per row above which segments are too long for the model: it does not follow the flight to their end."""
USUAL_SECONDS = 1.0
"""Longer segments decide only where airspeed matters and is not measured: every segment has a velocity of its own to
find, short ones hardly find it, and then drag comes out too large and one kind of it passes for another …"""
CLEAN_MISFIT = 1.2
"""… and where the model leaves hardly more than noise in them: a cause not found yet grows with their length."""


def is_long(shooting: Shooting) -> bool:
    """Whether segments are longer than usual: there the cost of a missing moment grows beyond all measure.

    What a search gains is therefore counted from the nominal model on usual ones.
    """
    return shooting.seconds > 1.5 * USUAL_SECONDS


class Climb:
    """Where on the ladder of segment lengths the search stands.

    Attributes:
        model: the selected model on this rung.
    """

    def __init__(self, ladder: Sequence[Shooting], theta: FloatArray, known: Model | None = None) -> None:
        """Begins on the longest segments that a model follows, or the shortest.

        Args:
            ladder: the data cut into segments of falling length.
            theta: nominal optimum.
            known: the model, fitted with a poorer noise model; None: the nominal one.
        """
        self._ladder, self._theta = ladder, theta
        self._nominal: dict[int, Model] = {}
        like = self.nominal_on(len(ladder) - 1) if known is None else known
        for rung in range(self._longest(like), len(ladder)):
            self._rung = rung
            self.model = self.nominal_on(rung) if known is None else self._refitted(rung, known)
            if self._follows(rung, self.model):
                break

    @property
    def shooting(self) -> Shooting:
        """The problem of this rung."""
        return self._ladder[self._rung]

    @property
    def nominal(self) -> Model:
        """Nominal model on this rung."""
        return self.nominal_on(self._rung)

    @property
    def base(self) -> Model:
        """Nominal model that gains are measured against; see `is_long`."""
        return self.nominal_on(max(self._rung, self._usual))

    def nominal_on(self, rung: int) -> Model:
        """Nominal model on a rung."""
        if rung not in self._nominal:
            self._nominal[rung] = fit_model(self._ladder[rung], self._theta, ())
        return self._nominal[rung]

    def _refitted(self, rung: int, model: Model) -> Model:
        """A model fitted on another rung."""
        fitted = fit_model(self._ladder[rung], model.theta, model.causes, iterations=10)
        return replace(fitted, worth=model.worth)

    def up(self) -> bool:
        """Goes to longer segments if the model follows them now."""
        for rung in range(self._longest(self.model), self._rung):
            model = self._refitted(rung, self.model)
            if self._follows(rung, model):
                self._rung, self.model = rung, model
                return True
        return False

    def farthest(self) -> tuple[Shooting, Model] | None:
        """The longest segments, and the model fitted on them; None where it does not follow them or they decide."""
        if self._rung == 0 or not is_long(self._ladder[0]):
            return None
        model = self._refitted(0, self.model)
        return (self._ladder[0], model) if self._follows(0, model) else None

    def go_far(self, model: Model) -> None:
        """Goes to the longest segments, with a model found on them."""
        self._rung, self.model = 0, model

    def _longest(self, model: Model) -> int:
        """Rung of the longest segments that may decide about a model."""
        return 0 if model.finds_velocity else self._usual

    @property
    def _usual(self) -> int:
        return next(rung for rung, shooting in enumerate(self._ladder) if not is_long(shooting))

    def _follows(self, rung: int, model: Model) -> bool:
        return model.reduced_chi_square < (CLEAN_MISFIT if is_long(self._ladder[rung]) else LINEAR_MISFIT)
