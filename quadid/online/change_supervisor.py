"""From a step in the numbers to a question for the fit: the watch for sudden changes on the walk of a session."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass

import numpy as np

from quadid.online.change_detection import CHUNK, ChangeDetector, ChangePoint
from quadid.online.checks import Quality, judge
from quadid.online.estimator import Estimator
from quadid.online.fault_isolation import ChangeReply, ChangeRequest, carried
from quadid.online.fusion import DRIFT
from quadid.online.grid_buffer import GridBuffer
from quadid.vehicle import Vehicle

AFTER_CHANGE = 3.0
"""Data that a change is explained from [s]."""
ASK_FLYING = 2.2
"""Flight judged before a change is looked for [s]."""
CONFIRMED = 2
"""Windows without a common sample that must agree before moments are judged."""
_EPS = 1e-6


@dataclass(frozen=True)
class Seen:
    """A change that was seen: the step, and when it began, to a row [s]."""

    change: ChangePoint
    at: float


class ChangeSupervisor:
    """Watches one vehicle for sudden changes.

    Attributes:
        seen: the change that is being looked into, or None.
    """

    def __init__(self, vehicle: Vehicle, store: GridBuffer) -> None:
        """Watches the rows of `store`, which are of `vehicle`."""
        self._vehicle, self._store = vehicle, store
        self._detector = ChangeDetector(vehicle)
        self._carried = 0.0
        self.seen: Seen | None = None

    def restart(self) -> None:
        """Begins anew: the stream was interrupted, or a change was dealt with."""
        self._detector.restart()
        self.seen = None

    def look(self, tick: float, length: float, estimator: Estimator) -> Generator[None, None, Seen | None]:
        """Takes in the last `length` [s] of rows before `tick` [s], piece by piece; returns a change seen just now."""
        for i in reversed(range(round(length / CHUNK))):
            self._detector.add(self._store.span(tick - (i + 1) * CHUNK - _EPS, tick - i * CHUNK - _EPS))
        if self.seen is not None:
            return None
        yield
        recent = self._store.cut(tick - ASK_FLYING, tick - _EPS)
        yield
        quality = judge(recent, self._vehicle, estimator.thrust, estimator.learned)
        # A load taken up or dropped in hover looks like a floor while the step is in what is judged, and no longer.
        self._carried = self._carried + length if quality.carried else 0.0
        if recent.reason or (quality != Quality() and not 0.0 < self._carried <= ASK_FLYING):
            self._detector.restart()
            return None
        if quality.carried:
            return None
        yield
        inertia = np.array([estimator.value(n) for n in ("J_xx", "J_yy", "J_zz")])
        # One window may have moved too little for its own interval to be right: another has to say the same.
        known = estimator.learned and estimator.fusion.agreement(CONFIRMED)[0] == CONFIRMED
        doubt = np.hypot(DRIFT, estimator.torque_sigma) if known else None
        change = self._detector.look(estimator.value("b"), inertia, doubt)
        if change is None:
            return None
        self.seen = Seen(change, self._store.onset(change.time) if change.channel == "thrust" else change.time)
        return self.seen

    def ask(self, number: int, tick: float, estimator: Estimator, stamp: float) -> ChangeRequest | None:
        """The question what a change was, once there is enough data after it.

        Args:
            number: of the request.
            tick: now [s].
            estimator: what was known before.
            stamp: time of the change as a stamp [s].
        """
        if self.seen is None or tick < self.seen.at + AFTER_CHANGE - _EPS:
            return None
        cut = self._store.cut(self.seen.at + 0.1, tick - _EPS)
        before = self._store.span(self.seen.at - ASK_FLYING, self.seen.at - 0.1) if estimator.flexible else None
        speed = None if before is None else np.sqrt(np.nanmean(before.columns["rotor_speed"] ** 2, axis=0))
        return ChangeRequest(
            number, estimator.model, cut.windows, self.seen.at, tick, estimator.theta, estimator.z_sigma,
            estimator.noise_of(cut.windows), self.seen.change, stamp, speed,
        )  # fmt: skip

    @staticmethod
    def answer_without_fit(request: ChangeRequest, estimator: Estimator) -> ChangeReply | None:
        """The answer where a fit could say nothing: no data, or nothing known before."""
        if not request.windows:
            return ChangeReply(request.number, "too little data after the change")
        if not estimator.learned:
            return ChangeReply(request.number, finding=carried(request))
        return None
