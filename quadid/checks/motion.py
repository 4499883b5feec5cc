"""Subject of all checks; times of flight, facts of channels and their timing; turns by gyro and attitude."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, TypeVar

import numpy as np

from quadid.checks.findings import ERROR, OK, WARNING, ChannelFacts, Check
from quadid.data.grid import holes, longest_step, moving_mean
from quadid.data.rotor_signal import RotorSignal, rotor_channel, rotor_signal
from quadid.data.window import CHANNELS, Channel, Recording, at_limit, copied, measured_period, sample_period, true_runs
from quadid.model.layout import ThrustModel
from quadid.rotation import euler, integrated, turn
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle

Answer = TypeVar("Answer")
Spans = tuple[tuple[float, float], ...]
FEWEST_SAMPLES = 20
"""Samples of each channel that a comparison needs."""


@dataclass(frozen=True, eq=False)
class Log:
    """Subject of the checks.

    Attributes:
        recording: in body axes.
        described: its vehicle, where one is given.
        spans: in which it flies [s].
        read: the recording as it was read, where that is another.
    """

    recording: Recording
    described: Vehicle | None = None
    spans: Spans = ()
    read: Recording | None = None
    _answers: dict[Callable[["Log"], Any], Any] = field(default_factory=dict, init=False, repr=False)

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle, for checks that are asked with one only."""
        assert self.described is not None
        return self.described

    @cached_property
    def signal(self) -> RotorSignal:
        """Rotor speeds; raises QuadidError where the log has none of this vehicle."""
        return rotor_signal(self.recording, self.vehicle)

    @property
    def commanded(self) -> bool:
        """True where the rotor signal is one of commands."""
        channel, _ = rotor_channel(self.recording, self.vehicle)
        return channel is not None and channel.name == "motor_command"

    def channels(self, *names: str, least: int = FEWEST_SAMPLES) -> tuple[Channel, ...] | None:
        """Channels of these names; None where one is absent or has fewer samples than `least`."""
        found = [self.recording.channels.get(name) for name in names]
        kept = tuple(channel for channel in found if channel is not None and len(channel.t) >= least)
        return kept if len(kept) == len(names) else None

    def once(self, compute: Callable[["Log"], Answer]) -> Answer:
        """Result of a function of this log, which is computed when first asked for."""
        if compute not in self._answers:
            self._answers[compute] = compute(self)
        answer: Answer = self._answers[compute]
        return answer


# --- When the vehicle flies, from its motors or its vibration


HOPELESS = 16.0
"""A thrust coefficient that is wrong by more does not show the weight."""
_SHORTEST = 1.0
"""Shorter spans are none [s]."""


def flying_spans(recording: Recording, vehicle: Vehicle | None) -> Spans:
    """Returns the spans [s] in which the vehicle flies; empty without evidence.

    Thrust and weight are those of the vehicle file where rotor speeds and a vehicle are known; else thrust grows with
    the square of the command, and hover is what is felt as one g.  A vehicle that feels less than its weight falls, and
    so flies, whatever its rotors do; one that feels it along an unusual direction for half a second lies somewhere.
    """
    accel, (rotors, _) = recording.channels.get("accel"), rotor_channel(recording, vehicle)
    if rotors is None:
        if accel is None or len(accel.t) <= 10:
            return ()
        # The accelerometer's length varies by more than at rest (0.3 m/s^2 over 25 samples).
        length = np.linalg.norm(accel.values, axis=1)
        mean, square = moving_mean(length, 25), moving_mean(length**2, 25)
        return _spans(accel.t, np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)) > 0.3))
    t, felt = rotors.t, None
    if accel is not None and len(accel.t) >= 10:
        # Specific force [g] over 0.2 s, whichever unit it is in
        length, width = np.linalg.norm(accel.values, axis=1), max(1, round(0.2 / sample_period(accel.t)))
        middle = float(np.median(length))
        unit = next((u for u in (GRAVITY, 1.0, 1e3) if 0.5 < middle / u < 4.0), None)
        felt = None if unit is None else np.interp(t, accel.t, moving_mean(length / unit, width))
    thrust, hover = _thrust(rotors, vehicle, felt)
    if hover <= 0.0:
        return ()
    on = thrust > 0.5 * hover  # flying carries half the weight at least
    if accel is not None and len(accel.t) > 10:
        # ... and feels the force, over half a second, along its usual direction.
        usually, width = np.median(accel.values, axis=0), max(1, round(0.5 / sample_period(accel.t)))
        share = accel.values @ usually / float(usually @ usually or 1.0)
        on &= np.interp(t, accel.t, moving_mean(share, width) > 0.3) > 0.5
    if not on.any():
        return ()
    # What carries the weight: where mostly more than that is felt, as in climbs, rotors usually give more.
    carrying = usual = float(np.median(thrust[on]))
    if felt is not None:
        usual = float(np.median((thrust / np.maximum(felt, 0.1))[on]))
        carrying = usual * min(1.0, float(np.median(felt[on])))
        on |= (t >= t[on][0]) & (t <= t[on][-1]) & (felt < 0.8)  # who feels less of his weight falls
        inside = (t > t[on][0] + _SHORTEST) & (t < t[on][-1] - _SHORTEST)
        on[inside] &= ~_stands(t[inside], thrust[inside] / usual, felt[inside], recording.channels.get("gyro"))
    # Each span begins where the rotors first carry: before, the ground still takes its share.
    carried, out = t[on & (thrust > 0.9 * carrying)], []
    for begin, end in _spans(t, on):
        first = carried[np.searchsorted(carried, begin) :][:1]
        out += [(float(first[0]), end)] if len(first) and end - first[0] >= _SHORTEST else []
    return tuple(out)


def _spans(t: FloatArray, on: BoolArray) -> Spans:
    runs = [(float(t[first]), float(t[end - 1])) for first, end in zip(*true_runs(on), strict=True)]
    # An interruption of half a second ends no span.
    return tuple((a, b) for a, b in _joined(runs, 0.5) if b - a >= _SHORTEST)


def _joined(spans: Sequence[tuple[float, float]], most: float) -> list[tuple[float, float]]:
    """Spans with those up to `most` [s] apart as one."""
    out: list[tuple[float, float]] = []
    for a, b in spans:
        if out and a - out[-1][1] <= most:
            out[-1] = (out[-1][0], b)
        else:
            out.append((a, b))
    return out


def proposed_cuts(spans: Spans, first: float, last: float) -> Spans:
    """Flights of 5 s or more without take-off and landing [s after `first`, to a tenth]; none where little else is.

    Left out are 2 s at either end: feet, ground and the air above it push, too.

    Args:
        spans: when it flies [s].
        first: sample that is used when nothing is cut [s].
        last: sample, likewise [s].
    """

    def trimmed(flights: Sequence[tuple[float, float]]) -> Spans:
        """Flights without the time next to the ground."""
        cuts = [
            (0.0 if a - first < 2.0 else a + 2.0 - first, (b if last - b < 2.0 else b - 2.0) - first)
            for a, b in flights
        ]
        return tuple((round(a, 1), round(b, 1)) for a, b in cuts if b - a >= 5.0)

    # Rotors that carry nothing for longer than 3 s stand on the ground; a log with more of it is worth trimming.
    flights, joined = _joined(spans, _SHORTEST), _joined(spans, 3.0)
    apart, whole = trimmed(flights), sum(b - a for a, b in joined)
    if len(flights) > len(joined) and sum(b - a for a, b in apart) > 0.7 * whole:
        return apart  # between them it stood somewhere
    return () if last - first - whole < 3.0 else trimmed(joined)


def within(t: FloatArray, spans: Spans) -> BoolArray:
    """True for the times [s], shape (n,), that lie in one of the spans."""
    return np.asarray(np.any([np.zeros(len(t), dtype=bool), *((t >= a) & (t <= b) for a, b in spans)], axis=0))


def is_turning(gyro: Channel | None, spans: Spans, least: float) -> bool:
    """True if rates about one axis vary by more than `least` [rad/s] in the spans, as standard deviation."""
    inside = np.zeros(0, dtype=bool) if gyro is None else within(gyro.t, spans)
    return gyro is not None and bool(inside.any() and np.max(np.std(gyro.values[inside], axis=0)) > least)


def _stands(t: FloatArray, thrust: FloatArray, felt: FloatArray, gyro: Channel | None) -> BoolArray:
    """Times at which something else carries the vehicle: its weight is felt, its rotors give less, it does not turn.

    For 0.3 s they give less than three quarters of what is felt, and rates stay below 0.15 rad/s; without rates nothing
    is found.  `thrust` is over what usually carries the weight, `felt` is the specific force [g], at times t [s].
    """
    if gyro is None or len(t) < 3:
        return np.zeros(len(t), dtype=bool)
    width = max(1, round(0.3 / sample_period(t)))
    fresh = np.append(~copied(gyro.values), True)  # a gyro that is stuck does not show that nothing turns
    turning = np.interp(t, gyro.t, np.where(fresh, np.linalg.norm(gyro.values, axis=1), 1.0))
    still = moving_mean(turning, width) < 0.15
    carried = moving_mean(np.abs(felt - 1.0), width) < 0.15  # where a fall ends it passes 1
    little = moving_mean(thrust / np.maximum(felt, 0.1), width) < 0.75
    if np.mean(little) > 0.3:  # then speeds disagree with the thrust, and nothing follows from them
        return np.zeros(len(t), dtype=bool)
    stands = little & still & carried
    return np.asarray(moving_mean(stands.astype(np.float64), 2 * width) > 0.0)


def _thrust(channel: Channel, vehicle: Vehicle | None, felt: FloatArray | None) -> tuple[FloatArray, float]:
    """Returns relative thrust and the value that hovers; `felt` is the specific force [g], shape (n,)."""
    values, commands = channel.values, channel.name == "motor_command"
    if commands and np.median(np.abs(values)) > 100.0:
        low, high = vehicle.command.range if vehicle is not None else (1000.0, 2000.0)
        values = np.clip((values - low) / (high - low), 0.0, None)
    # A rotor below a tenth of the others is dead, or its signal is, and has their median: no ground carries.
    usual = np.median(values, axis=1, keepdims=True)
    values = np.where(values < 0.1 * usual, usual, values)
    thrust = np.asarray(np.sum(values**2, axis=1))
    most = np.quantile(thrust, 0.95)
    # Commands that never exceed 15 % of full are idling motors.
    if commands and most < 0.15**2 * values.shape[1]:
        return thrust, 0.0
    if not commands and vehicle is not None and values.shape[1] == len(vehicle.rotors):
        modelled, hover = ThrustModel.stated(vehicle).total(values), vehicle.mass * GRAVITY
        highest = float(np.max(modelled))  # of losses that no rotor has it may be negative
        typical = float(np.median(modelled[modelled >= 0.25 * highest])) if highest > 0.0 else 0.0
        if 1.0 / HOPELESS < typical / hover < HOPELESS:
            return modelled, hover
    strong = thrust > 0.5 * most
    if felt is not None and (strong := strong & (felt > 0.5)).any():
        return thrust, float(np.median(thrust[strong] / felt[strong]))
    powered = thrust[thrust > 0.25 * most]
    return thrust, float(np.median(powered)) if len(powered) else 0.0


# --- Timing of channels and values that do not move: rates, gaps, jitter, stuck and saturated signals, clock faults


_GRID = 0.02
"""Step of the grid [s] for which gaps are reported, that of the fit."""
STUCK = 1.0
"""A sensor that repeats itself to the bit for longer than this [s] of moving flight is stuck."""


def channel_facts(recording: Recording, flying: Spans = ()) -> tuple[ChannelFacts, ...]:
    """Returns the facts of all channels of a recording.

    Args:
        recording: the log.
        flying: when it flies [s]; at rest a sensor may well repeat itself.
    """
    return tuple(_facts(recording.channels[name], flying) for name in CHANNELS if name in recording.channels)


def _facts(channel: Channel, flying: Spans) -> ChannelFacts:
    steps = np.diff(channel.t)
    median = float(np.median(steps)) if len(steps) else np.nan
    long = steps > (longest_step(channel.t, _GRID) if len(steps) else np.inf)
    usual = steps[~long]
    same = copied(channel.values)
    inside = within(channel.t, flying)
    first, end = true_runs(same & inside[:-1] & inside[1:])
    stuck = float(np.max(channel.t[end] - channel.t[first], initial=0.0))
    if inside.sum() > 1 and np.min(np.ptp(channel.values[inside], axis=0)) == 0.0:
        stuck = float(np.ptp(channel.t[inside]))  # one axis of it
    limited = channel.name in ("gyro", "accel", "motor_command")
    return ChannelFacts(
        name=channel.name,
        unit=CHANNELS[channel.name][1],
        source=channel.source,
        rate=1.0 / measured_period(channel.t, channel.values) if len(channel.t) > 1 else np.nan,
        count=len(channel.t),
        first=float(channel.t[0]),
        last=float(channel.t[-1]),
        jitter=float(np.std(usual) / median) if len(usual) else np.nan,
        gaps=int(np.count_nonzero(long)),
        bridged=holes(channel.t, _GRID) if len(steps) else 0,
        longest_gap=float(steps[long].max()) if long.any() else 0.0,
        repeated=float(np.mean(same)) if len(same) else 0.0,
        stuck=stuck,
        saturated=sum(end.samples for end in at_limit(channel.values)) if limited else 0,
        dropped=dict(channel.faults),
    )


def timing_checks(recording: Recording, facts: Sequence[ChannelFacts]) -> list[Check]:
    """Checks clocks, gaps, jitter, stuck and saturated sensors, and the resolution of the attitude.

    Args:
        recording: the log.
        facts: of its channels.
    """
    coarse = attitude_steps_check(recording)
    checks = [_clock_check(recording, facts), *([] if coarse is None else [coarse])]

    def warn(name: str, message: str, fix: str, **numbers: float) -> None:
        checks.append(Check(name, WARNING, message, fix, numbers))

    for f in facts:
        rows = (f.count - 1) / max(f.last - f.first, 1e-9)
        # A voltage may rest, and what rests between coarse steps is no interpolated value.
        resting = f.name == "battery" or f.name == "attitude" and coarse is not None
        if not f.gaps and rows > 1.5 * f.rate and not resting:
            between = f"{f.name}: {rows:.3g} rows a second were interpolated between samples at {f.rate:.3g} Hz"
            warn("timing", between, "log it at this rate, or without the interpolated rows")
    if gaps := [f for f in facts if f.gaps]:
        worst = max(gaps, key=lambda f: f.longest_gap)
        text = f"{', '.join(f'{f.name} {f.gaps}' for f in gaps)}; the longest lasts {worst.longest_gap:.3g} s"
        fix = "windows are cut there; log to a faster card or at a lower rate"
        numbers = {"gaps": float(sum(f.gaps for f in facts)), "longest_s": worst.longest_gap}
        warn("timing", f"gaps: {text} ({worst.name})", fix, **numbers)
    for f in facts:
        if f.name in ("gyro", "accel", "rotor_speed", "motor_command") and f.jitter > 0.25:
            varies = f"steps vary by {f.jitter:.0%} of their median: stamps are unsteady or samples are lost"
            warn("timing", f"{f.name}: {varies}", "stamp at the sensor", jitter=f.jitter)
    for f in facts:
        imu = f.name in ("gyro", "accel")
        # Half a second of an IMU, five of an estimate
        if imu and f.stuck > 0.5 * STUCK or f.name in ("velocity", "position") and f.stuck > 5.0 * STUCK:
            rests = f"does not change for {f.stuck:.2g} s of flight, or one axis does not ({f.source})"
            warn("stuck", f"{f.name}: {rests}", "check this sensor or topic", stuck_s=f.stuck)
        if imu and f.saturated:
            share = f.saturated / f.count
            # Inertias come out 2 % too large where 6 % of the rates are clipped, 8 % at 16 %.
            verdict = ERROR if f.name == "gyro" and share > 0.05 else WARNING
            clipped = f"{f.name}: {f.saturated} samples ({share:.2g} of all) at the limit of its range"
            fix = "choose a larger range or fly more gently"
            checks.append(Check("saturated", verdict, clipped, fix, {"share": share}))
    return checks


def _clock_check(recording: Recording, facts: Sequence[ChannelFacts]) -> Check:
    dropped: dict[str, int] = {}
    for f in facts:
        for reason, count in f.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
    breaks = len(recording.breaks)
    numbers = {"breaks": float(breaks), **{k: float(v) for k, v in dropped.items()}}
    if not breaks and not dropped:
        return Check("clock", OK, "time rises steadily, no sample was dropped", numbers=numbers)
    parts = [f"{breaks} breaks (reboots or clock steps)"] if breaks else []
    parts += [f"{count} samples dropped: {reason.replace('_', ' ')}" for reason, count in dropped.items()]
    return Check("clock", WARNING, "; ".join(parts), "nothing is joined across breaks" if breaks else "", numbers)


def attitude_steps_check(recording: Recording) -> Check | None:
    """A warning where angles or quaternions come in steps that are coarse beside usual noise; None for fine ones."""
    attitude = recording.channels.get("attitude")
    if attitude is None or len(attitude.t) < FEWEST_SAMPLES:
        return None
    step = 0.0
    for angle in euler(attitude.values).T:
        levels = np.diff(np.unique(angle))
        levels = levels[levels > 1e-6]  # equal but for rounding
        if 0 < len(levels) <= 0.2 * len(angle):  # else nearly every sample has a level of its own
            step = max(step, float(np.min(levels)))
    # Components of rounded quaternions are to each other as small whole numbers, also where they were made unit again.
    q = attitude.values[np.all(attitude.values != 0.0, axis=1)]
    q = q[:: len(q) // 500 + 1]
    if len(q) >= FEWEST_SAMPLES:
        largest, whole = np.max(np.abs(q), axis=1), np.arange(1.0, 400.0)
        ratios = whole[:, None, None] * (q / largest[:, None])
        found = np.all(np.abs(ratios - np.rint(ratios)) < 1e-4, axis=2)
        if found.any(axis=0).mean() > 0.9:
            step = max(step, float(2.0 * np.median(largest / whole[found.argmax(axis=0)])))
    if step < 0.005:
        return None
    message = f"attitude comes in steps of {np.degrees(step):.2g} deg ({attitude.source})"
    return Check("attitude_steps", WARNING, message, "log it with more digits", {"step_rad": step})


# --- Turns by the attitude over those by the gyro, from physics that needs no model of the vehicle
#
# By how much the turns over `TURN` change, as the gyro adds up to them and as the attitude has them, about each axis.
# Changes of turns have neither the gyro's bias nor the slow pull of an attitude filter in them, and lie where inertias
# are seen.  All axes of the gyro are regressors, so that one that leaks into another shows; the change of rate takes up
# a delay, so that the factor is a ratio of sizes.


ALLOWED = 0.03
"""Calibrated sensors differ by less than this share."""
TURN = 0.2
"""Gyro and attitude are compared over turns of this length [s]."""
MOVING = 0.1
"""An axis that turns slower than this [rad/s] is hardly moved: gyro noise would make a factor too small."""
FEWEST = 15
"""Turns from which a factor is computed, at least."""
AXES = ("roll", "pitch", "yaw")
TURN_FACTOR = "turn by the attitude over that by the gyro"


@dataclass(frozen=True)
class Factor:
    """Size of one channel over that of another.

    Attributes:
        what: the two, in words.
        value: of the factor; sigma: its standard deviation, infinite where no data show it.
        ideal: what it is where they agree.
    """

    what: str
    value: float
    sigma: float
    ideal: float = 1.0

    @property
    def known(self) -> bool:
        """True if it is known well enough to be compared: noise makes a ratio of small turns too large."""
        return self.sigma <= 0.05

    @property
    def off(self) -> float:
        """Distance from where it ought to be."""
        return self.value - self.ideal

    @property
    def disagrees(self) -> bool:
        """True if it is known, and cannot be what it ought to be, within two standard deviations."""
        return self.known and abs(self.off) > ALLOWED + 2.0 * self.sigma

    def __str__(self) -> str:
        return f"{self.what} = {self.value:.3f} +- {self.sigma:.3f}"


def changes_of_turn(gyro: FloatArray, q: FloatArray, step: float) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Changes, from every row, of turn by the gyro, of turn by the attitude and of rate, each (n, 3).

    Args:
        gyro: rates [rad/s], (m, 3).
        q: attitudes (m, 4); rows of NaN, here or there, are left out.
        step: of the rows [s].
    """
    long = max(round(TURN / step), 1)
    # A turn from every row: readings in step with the sticks would put all others at one phase of their motion.
    starts = np.arange(max(len(gyro) - long, 0))
    if len(starts) <= long:
        return np.empty((0, 3)), np.empty((0, 3)), np.empty((0, 3))
    turns = (
        integrated(np.stack([gyro[k : k + long + 1] for k in starts], axis=1), step),
        turn(q[starts], q[starts + long]),
        gyro[starts + long] - gyro[starts],
    )
    by_gyro, by_attitude, rate = (t[long:] - t[:-long] for t in turns)
    good = np.isfinite(by_gyro + rate + by_attitude).all(axis=1)
    return by_gyro[good], by_attitude[good], rate[good]


def turn_moments(changes: Sequence[FloatArray], axis: int, step: float) -> FloatArray:
    """Sums of products of (changes of turn by the gyro about x, y, z, of rate, of turn by the attitude), (5, 5).

    Args:
        changes: of `changes_of_turn`, from rows `step` [s] apart.
        axis: of rate and attitude: 0, 1 or 2.
    """
    by_gyro, by_attitude, rate = changes
    rows = np.column_stack([by_gyro, rate[:, axis], by_attitude[:, axis]])
    return rows.T @ rows / max(round(TURN / step), 1)


def factors(axis: int, seconds: float, moments: FloatArray) -> list[Factor]:
    """Size of the attitude's turns over the gyro's about an axis, then what it has of the gyro's other axes.

    Args:
        axis: 0, 1 or 2.
        seconds: of data in the moments.
        moments: as of `turn_moments`, (5, 5).
    """
    gram, cross = moments[:4, :4], moments[:4, 4]
    inverse = np.linalg.pinv(gram, hermitian=True)
    slope = inverse @ cross
    left = max(float(moments[4, 4] - slope @ cross), 0.0) / (seconds / TURN - 4.0)
    sigma = np.sqrt(left * np.diag(inverse))
    own = [axis, 3]
    size = math.sqrt(float(slope[own] @ gram[np.ix_(own, own)] @ slope[own]) / gram[axis, axis])
    found = [Factor(f"{AXES[axis]} {TURN_FACTOR}", math.copysign(size, slope[axis]), float(sigma[axis]))]
    return found + [
        Factor(f"part of the gyro's {AXES[k]} in the attitude's {AXES[axis]}", float(slope[k]), float(sigma[k]), 0.0)
        for k in range(3)
        if k != axis
    ]
