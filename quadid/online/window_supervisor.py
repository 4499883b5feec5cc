"""From rows to the request of a fit: when the next window is due, what it holds, and whether it may be learned from."""

from __future__ import annotations

import math
from collections.abc import Generator

from quadid.online.checks import Quality, judge, mistake
from quadid.online.estimator import Estimator
from quadid.online.grid_buffer import GridBuffer, WindowCut
from quadid.online.records import MOST_ERRORS, Outbox, Phase
from quadid.online.settings import SessionSettings
from quadid.online.supervisor import Supervisor
from quadid.online.window_fit import FitRequest
from quadid.vehicle import Vehicle

LEAD = 0.22
"""Flight before a window in which filters and delays settle [s]."""
STARTING = 3.0
"""Time from the begin of a stream [s] in which channels may still come, once the vehicle sends what was asked."""
SHORT_WINDOW = 4.0
"""Least data for a fit that a person asked for [s]."""
_EPS = 1e-6


class WindowSupervisor:
    """Cuts the windows of one session.

    Attributes:
        cut: the newest window, complete or not.
        quality: of the newest complete one.
        errors: fits in a row that failed by an error of this program; after `MOST_ERRORS` none begins by itself.
    """

    def __init__(
        self, vehicle: Vehicle, store: GridBuffer, settings: SessionSettings, outbox: Outbox, supervisor: Supervisor
    ) -> None:
        """Cuts the rows of `store`, which are of `vehicle`."""
        self._vehicle, self._store, self._settings = vehicle, store, settings
        self._outbox, self._supervisor = outbox, supervisor
        self.cut, self.quality = WindowCut((), 0.0, 0), Quality()
        self._last_fit, self._asked_now, self.errors = -math.inf, False, 0

    def fit_now(self) -> None:
        """Makes the next tick due, without waiting for a full window, whatever failed before."""
        self._asked_now, self.errors = True, 0

    def due(self, tick: float) -> bool:
        """Whether it is time for a fit."""
        by_itself = self.errors < MOST_ERRORS
        return self._asked_now or (by_itself and tick - self._last_fit >= self._settings.refit - _EPS)

    def ask(self, number: int, tick: float, estimator: Estimator) -> Generator[None, None, FitRequest | None]:
        """The fit of the window before `tick` [s], piece by piece; None, and the outbox says why, where it cannot be.

        Args:
            number: of the request.
            tick: now [s].
            estimator: what asks for the fit.
        """
        wanted = self._settings.window
        if self._asked_now:
            self._asked_now, wanted = False, min(SHORT_WINDOW, wanted)
        start = max(tick - self._settings.window - LEAD, self._supervisor.learn_from)
        self.cut = self._store.cut(start - _EPS, tick - _EPS)
        if self.cut.reason or tick - start < wanted - 0.5:
            self._incomplete(tick, start)
            return None
        yield
        self.quality = judge(self.cut, self._vehicle, estimator.thrust, estimator.learned)
        if self.quality != Quality():
            phase = Phase.BLOCKED if self.quality.fault else Phase.NOT_FLYING
            self._outbox.note(tick, phase, self.quality.fault or self.quality.grounded)
            return None
        yield
        self._last_fit = tick
        start = max(start, tick - self._settings.window)
        return estimator.request(number, self.cut, start, tick)

    def mistake(self, tick: float) -> str:
        """The wrong unit, frame or motor order in the rows before `tick` [s], learned from or not; empty: none."""
        return mistake(self._store.cut(tick - self._settings.window - _EPS, tick - _EPS), self._vehicle, known=False)

    def _incomplete(self, tick: float, start: float) -> None:
        if self.cut.blocked:
            if tick - start < STARTING:
                self._outbox.state(Phase.COLLECTING, self.cut.reason)
            else:
                self._outbox.note(tick, Phase.BLOCKED, self.cut.reason)
            return
        have = f"{max(tick - start, 0.0):.0f} of {self._settings.window:g} s of flight"
        self._outbox.state(Phase.COLLECTING, f"{have}; {self.cut.reason or 'no gaps'}")
