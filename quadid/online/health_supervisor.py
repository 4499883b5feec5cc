"""Health while flying: seconds cut from the grid go to the watch; what it finds goes out, healthy flights are kept."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from quadid.condition.trim import FlightTrim
from quadid.condition.watch import HealthReport, HealthWatch
from quadid.online.grid_buffer import GridBuffer
from quadid.online.records import HealthyFlight, Outbox
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

MOST_FLIGHTS = 40
"""Newest healthy flights that are compared with."""
_CLIMB = 3
"""Seconds after take-off that are not judged."""
_LANDED = 3
"""Seconds without lift that end a flight."""
_PRESENT = 0.6
"""A second needs this share of its rows."""


class HealthSupervisor:
    """Health of one vehicle over its flights."""

    def __init__(self, vehicle: Vehicle, rows: GridBuffer, outbox: Outbox, history: Sequence[FlightTrim]) -> None:
        """Starts with the healthy flights of earlier runs, the oldest first."""
        self._watch = HealthWatch(vehicle, history[-MOST_FLIGHTS:])
        self._rows, self._outbox = rows, outbox
        self._until, self._aloft, self._grounded = math.nan, 0, 0

    def look(self, tick: float) -> None:
        """Looks at the second before `tick` [s], where one has passed since the last look."""
        if tick - self._until < 1.0 - 1e-6:
            return
        self._until = tick
        second = self._second(tick)
        if second is None:
            return
        load, force = second
        if not self._watch.airborne(load):
            self._grounded += 1
            if self._grounded == _LANDED:
                self._land(tick)
            return
        self._grounded = 0
        self._aloft += 1
        if self._aloft > _CLIMB:
            report = self._watch.second(tick, load, force)
            if report is not None:
                self._tell(tick, report)

    def _second(self, tick: float) -> tuple[FloatArray, float] | None:
        """Mean squared rotor speeds and mean specific force of the last second; None where they are not there."""
        rows = self._rows.span(tick - 1.0, tick)
        if rows is None or "rotor_speed" not in rows.columns:
            return None
        speed, accel = rows.columns["rotor_speed"], rows.columns.get("accel")
        good = np.isfinite(speed).all(axis=1)
        if good.mean() < _PRESENT:
            return None
        force = GRAVITY
        if accel is not None and np.isfinite(accel[:, 2]).any():
            force = -float(np.nanmean(accel[:, 2]))
        return np.asarray((speed[good] ** 2).mean(axis=0)), force

    def _tell(self, tick: float, report: HealthReport) -> None:
        self._outbox.act(replace(report, t=self._outbox.stamp(tick)))
        if report.verdict == "changed":
            self._outbox.say(tick, "warning", "health", report.text)
        elif not report.has_baseline:
            self._outbox.say(tick, "info", "health", report.text)

    def _land(self, tick: float) -> None:
        self._aloft = 0
        kept = self._watch.landed()
        if kept is not None:
            self._outbox.act(HealthyFlight(self._outbox.stamp(tick), kept))
