"""Health in flight: every second the trim of the last seconds against the vehicle's own healthy flights.

Two questions, each with its own yardstick from these flights: does this flight differ from them more than they differ
from each other, and do the last seconds differ from this flight so far more than seconds of a healthy flight do?  The
second is the sharper one, for propellers, battery and landing are the same within a flight.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
from scipy.special import stdtrit

from quadid.condition.changes import Change, changes_of, compare, distance, exact, hypotheses, p_healthy
from quadid.condition.trim import AXES, FlightTrim, Healthy, healthy_spread, trim_of_load, wander
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

RECENT = 3
"""Seconds that are compared, as many as `FlightTrim.wander` is of."""
RARE = 1e-8
"""An alarm is a second that healthy flight has less often than this, twice in a row: 100 h hold 3.6e5 seconds."""
MOST_FLIGHTS = 40
"""Newest healthy flights that are compared with."""
ENOUGH = 3
"""So many healthy flights before a flight is judged at all; until then each one is kept."""
_NO_MASS = (math.nan, math.nan, math.nan)
"""Said by one object: reports of equal content are equal."""


@dataclass(frozen=True)
class HealthReport:
    """Report of the vehicle's health in flight.

    Attributes:
        t: time of the last second that it rests on [s].
        verdict: unchanged, changed or unknown.
        has_baseline: whether there are enough healthy flights to compare with.
        score: as `Health.score`; NaN without a baseline.
        changes: what changed, the most probable explanation; empty where nothing did.
        rotor_loss: fraction of thrust that each rotor lost, shape (rotors,); NaN without a baseline.
        rotor_interval: 95 % intervals, shape (rotors, 2).
        mass: mass that the rotors carry by the thrust of the baseline, and its 95 % interval [kg], shape (3,); NaN
            without a baseline, where commands do not indicate thrust, and where a rotor or all of them lost thrust.
    """

    topic: ClassVar[Literal["vehicle_health"]] = "vehicle_health"
    t: float
    verdict: str
    has_baseline: bool
    score: float
    changes: tuple[Change, ...]
    rotor_loss: tuple[float, ...]
    rotor_interval: tuple[tuple[float, float], ...]
    mass: tuple[float, float, float]
    text: str


class HealthWatch:
    """Watches one vehicle's flights.

    Attributes:
        history: healthy flights, the oldest first.
    """

    def __init__(self, vehicle: Vehicle, history: Sequence[FlightTrim] = ()) -> None:
        """Starts with the healthy flights that are known, the oldest first."""
        self.history = list(history[-MOST_FLIGHTS:])
        self._vehicle, self._aloft, self._grounded = vehicle, 0, 0
        self._healthy: Healthy | None = None
        self._land()

    def look(self, t: float, speed: FloatArray, accel: FloatArray | None) -> HealthReport | FlightTrim | None:
        """Looks at the rows of one second of data, in flight or not.

        Args:
            t: its end [s].
            speed: rotor speeds [rad/s], shape (n, rotors), NaN where nothing was measured.
            accel: specific force [m/s^2], shape (n, 3), alike; or None.

        Returns:
            A report as of `second`, the trim of a flight that has ended and is kept, or None.
        """
        good = np.isfinite(speed).all(axis=1)
        if good.mean() < 0.6:  # too few rows to tell
            return None
        load = np.asarray((speed[good] ** 2).mean(axis=0))
        if self.airborne(load):
            self._grounded, self._aloft = 0, self._aloft + 1
            felt = accel is not None and np.isfinite(accel[:, 2]).any()
            force = -float(np.nanmean(accel[:, 2])) if accel is not None and felt else GRAVITY
            # The climb after take-off is not judged.
            return self.second(t, load, force) if self._aloft > 3 else None
        self._grounded += 1
        if self._grounded != 3:  # seconds without lift end a flight
            return None
        self._aloft = 0
        return self.landed()

    def second(self, t: float, load: FloatArray, force: float) -> HealthReport | None:
        """Takes one second of flight.

        Args:
            t: its end [s].
            load: mean squared speed of each rotor, shape (rotors,).
            force: mean specific force along -z [m/s²].

        Returns:
            A report on the first steady second, on an alarm, and every ten seconds between.
        """
        # What is felt in steady flight is gravity to a tenth.
        if abs(force / GRAVITY - 1.0) > 0.1 or not load.min() > 0.0:
            return None
        self._trims.append(trim_of_load(load, force, self._vehicle))
        self._shares.append(load / load.sum())
        if self._healthy is None:
            if len(self._trims) > 1:
                return None
            none = (math.nan,) * len(self._vehicle.rotors)
            text = f"no baseline: {len(self.history)} of {ENOUGH} healthy flights are known; this flight becomes one"
            ranges = ((math.nan, math.nan),) * len(none)
            return HealthReport(t, "unknown", False, math.nan, (), none, ranges, _NO_MASS, text)
        return self._judged(t, self._healthy)

    def airborne(self, load: FloatArray) -> bool:
        """True if the rotors carry the vehicle, as far as the healthy flights or the first guess of b indicate."""
        usual = self._vehicle.mass / self._vehicle.parameters["b"].initial
        if self._healthy is not None:
            usual = float(np.exp(self._healthy.mean[AXES.index("effort")]))
        return bool(load.sum() > 0.5 * usual * GRAVITY)

    def landed(self) -> FlightTrim | None:
        """Ends a flight; returns its trim where it is healthy and long enough to be kept, and keeps it."""
        trims, kept = np.array(self._trims), None
        if len(trims) >= 30 and self._alarm is None:  # steady seconds that make a flight worth keeping
            parts = np.array([part.mean(axis=0) for part in np.array_split(trims, 3)])
            shares = np.mean(self._shares, axis=0)
            kept = FlightTrim("", trims.mean(axis=0), parts, shares, wander(trims), float(len(trims)), "in flight")
            self.history.append(kept)
        self._land()
        return kept

    def _land(self) -> None:
        """Forgets the flight; looks at the history anew."""
        self._trims: list[FloatArray] = []
        self._before = np.zeros(len(AXES))
        self._shares: list[FloatArray] = []
        self._suspect = False
        self._alarm: HealthReport | None = None
        if len(self.history) >= ENOUGH:
            self._healthy = healthy_spread(self.history)
            squares = np.mean([flight.wander**2 for flight in self.history], axis=0)
            self._wander = np.maximum(np.sqrt(squares), [0.002, 0.002, 0.002, 0.005])

    def _judged(self, t: float, healthy: Healthy) -> HealthReport | None:
        if self._alarm is not None or len(self._trims) < RECENT:
            return None
        now = np.mean(self._trims[-RECENT:], axis=0)
        against = [self._of_history(healthy)]
        before = len(self._trims) - RECENT - 2  # two seconds count neither as recent nor as before
        if before > 0:
            self._before += self._trims[before - 1]
        if before >= 10:
            # The yardstick for seconds of the same flight
            mean, freedom = self._before / before, np.full(len(AXES), 10.0 * len(self.history))
            against.append(Healthy(mean, self._wander, freedom, max(before // RECENT, 1), healthy.shares))
        chances = [p_healthy(now - one.mean, one.predictive(1), one.freedom) for one in against]
        worst = int(np.argmin(chances))
        rare = chances[worst] < RARE
        if rare and self._suspect:
            self._alarm = self._report(t, now, against[worst], "changed")
            return self._alarm
        self._suspect = rare
        if len(self._trims) == RECENT or len(self._trims) % 10 == 0:
            return self._report(t, now, against[0], "unchanged")
        return None

    def _of_history(self, healthy: Healthy) -> Healthy:
        """The yardstick for seconds of another flight: between flights, and within one."""
        between, within = healthy.deviation**2 * (1.0 + 1.0 / healthy.flights), self._wander**2
        return healthy._replace(deviation=np.sqrt((between + within) / 2.0), flights=1)

    def _report(self, t: float, now: FloatArray, against: Healthy, verdict: str) -> HealthReport:
        change = now - against.mean
        changes: tuple[Change, ...] = ()
        if verdict == "changed":
            shares = np.mean(self._shares[-RECENT:], axis=0)
            found = compare(exact(change), against, 1, hypotheses(self._vehicle, shares, against.mean))
            changes = changes_of(found, self._vehicle, changed=True)
        n = len(self._vehicle.rotors)
        loss, interval = [0.0] * n, [(0.0, 0.0)] * n
        for one in changes:
            if one.effect == "weak_rotor":
                (_, _, rotor, _), (_, _, value, ci), *_ = one.parameters
                loss[int(rotor) - 1], interval[int(rotor) - 1] = value, ci or (np.nan, np.nan)
        far = distance(change, against.predictive(1), against.freedom)
        text = " ".join(one.evidence for one in changes) or "as in healthy flights"
        score, mass = float(np.sqrt((far**2).sum())), self._mass(now, changes)
        return HealthReport(t, verdict, True, score, changes, tuple(loss), tuple(interval), mass, text)

    def _mass(self, now: FloatArray, changes: Sequence[Change]) -> tuple[float, float, float]:
        """Mass by the thrust of the baseline and its 95 % interval [kg], from effort against the healthy flights'."""
        known = self._vehicle.command.kind == "rotor_speed"
        if self._healthy is None or not known or any(one.effect in ("weak_rotor", "thrust_drop") for one in changes):
            return _NO_MASS
        k, healthy = AXES.index("effort"), self._of_history(self._healthy)
        half = float(stdtrit(healthy.freedom[k], 0.975) * healthy.predictive(1)[k])
        more = float(now[k] - healthy.mean[k])
        low, value, high = (self._vehicle.mass * math.exp(more + side) for side in (-half, 0.0, half))
        return value, low, high
