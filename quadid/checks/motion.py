"""Times of flight, facts of channels, checks of their timing and resolution; turns by gyro and attitude."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadid.checks.findings import ChannelFacts, Check, CheckResult
from quadid.data.grid import holes, longest_step, moving_mean
from quadid.data.rotor_signal import rotor_channel
from quadid.data.window import CHANNELS, Channel, Recording, at_limit, copied, measured_period, sample_period, true_runs
from quadid.model.layout import ThrustModel
from quadid.rotation import euler, integrated, turn
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- When the vehicle flies, from its motors or its vibration


Spans = tuple[tuple[float, float], ...]

HOPELESS = 16.0
"""A thrust coefficient that is wrong by more does not show the weight."""
_NOTHING = 0.1
"""A rotor below this share of the median speed of all is ignored."""
_SHORTEST = 1.0
"""Shorter spans are none [s]."""
_GROUND = 3.0
"""Rotors that carry nothing for longer than this [s] stand on the ground; a log with more of it is worth trimming."""
_MARGIN = 2.0
"""Left out after take-off and before landing [s]: feet, ground and the air above it push, too."""


def flying_spans(recording: Recording, vehicle: Vehicle | None) -> Spans:
    """Returns the spans [s] in which the vehicle flies; empty without evidence.

    Thrust and weight are those of the vehicle file where rotor speeds and a vehicle are known; else thrust grows with
    the square of the command, and hover is what is felt as one g.  A vehicle that feels less than its weight falls, and
    so flies, whatever its rotors do; one that feels it along an unusual direction for half a second lies somewhere.
    """
    channels = recording.channels
    rotors, _ = rotor_channel(recording, vehicle)
    if rotors is not None:
        accel = channels.get("accel")
        load = None if accel is None or len(accel.t) < 10 else _load(accel)
        felt = None if load is None or accel is None else np.interp(rotors.t, accel.t, load)
        thrust, hover = _thrust(rotors, vehicle, felt)
        if hover <= 0.0:
            return ()
        t, on = rotors.t, thrust > 0.5 * hover  # flying carries half the weight at least
        if accel is not None and len(accel.t) > 10:
            on &= np.interp(t, accel.t, _felt(accel)) > 0.5
        if not on.any():
            return ()
        # What carries the weight: where mostly more than that is felt, as in climbs, rotors usually give more.
        carrying = usual = float(np.median(thrust[on]))
        if felt is not None:
            usual = float(np.median((thrust / np.maximum(felt, 0.1))[on]))
            carrying = usual * min(1.0, float(np.median(felt[on])))
            inside = (t >= t[on][0]) & (t <= t[on][-1])
            # Who feels less than this share of his weight falls.
            on |= inside & (felt < 0.8)
            inside = (t > t[on][0] + _SHORTEST) & (t < t[on][-1] - _SHORTEST)
            on[inside] &= ~_stands(t[inside], thrust[inside] / usual, felt[inside], channels.get("gyro"))
        # Below, the ground still carries its share.
        carried = t[on & (thrust > 0.9 * carrying)]
        return tuple(later for span in _spans(t, on) if (later := _from_carried(span, carried)))
    if "accel" in channels and len(channels["accel"].t) > 10:
        # True where the accelerometer's length varies by more than at rest (0.3 m/s^2 over 25 samples)
        length = np.linalg.norm(channels["accel"].values, axis=1)
        mean, square = moving_mean(length, 25), moving_mean(length**2, 25)
        return _spans(channels["accel"].t, np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)) > 0.3))
    return ()


def proposed_cuts(spans: Spans, first: float, last: float) -> Spans:
    """Flights without take-off and landing [s after `first`, to a tenth]; none where the log holds little else.

    Args:
        spans: when it flies [s].
        first: sample that is used when nothing is cut [s].
        last: sample, likewise [s].
    """
    flights, joined = _joined(spans, _SHORTEST), _joined(spans, _GROUND)
    apart, whole = _trimmed(flights, first, last), sum(b - a for a, b in joined)
    if len(flights) > len(joined) and sum(b - a for a, b in apart) > 0.7 * whole:
        return apart  # between them it stood somewhere
    return () if last - first - whole < _GROUND else _trimmed(joined, first, last)


def _joined(spans: Sequence[tuple[float, float]], most: float) -> list[tuple[float, float]]:
    """Spans with those up to `most` [s] apart as one."""
    out: list[tuple[float, float]] = []
    for a, b in spans:
        if out and a - out[-1][1] <= most:
            out[-1] = (out[-1][0], b)
        else:
            out.append((a, b))
    return out


def _trimmed(flights: Sequence[tuple[float, float]], first: float, last: float) -> Spans:
    """Flights of 5 s or more, without the time next to the ground [s after `first`, to a tenth]."""
    cuts = [
        (0.0 if a - first < _MARGIN else a + _MARGIN - first, (b if last - b < _MARGIN else b - _MARGIN) - first)
        for a, b in flights
    ]
    return tuple((round(a, 1), round(b, 1)) for a, b in cuts if b - a >= 5.0)


def within(t: FloatArray, spans: Spans) -> BoolArray:
    """True for the times [s], shape (n,), that lie in one of the spans."""
    return np.asarray(np.any([np.zeros(len(t), dtype=bool), *((t >= a) & (t <= b) for a, b in spans)], axis=0))


def is_turning(gyro: Channel | None, spans: Spans, least: float) -> bool:
    """True if rates about one axis vary by more than `least` [rad/s] in the spans, as standard deviation."""
    inside = np.zeros(0, dtype=bool) if gyro is None else within(gyro.t, spans)
    return gyro is not None and bool(inside.any() and np.max(np.std(gyro.values[inside], axis=0)) > least)


def _stands(t: FloatArray, thrust: FloatArray, felt: FloatArray, gyro: Channel | None) -> BoolArray:
    """Times at which something else carries the vehicle: its weight is felt, its rotors give less, it does not turn.

    For 0.3 s they give less than three quarters of what is felt, and rates stay below 0.15 rad/s.

    Args:
        t: times (n,).
        thrust: over what usually carries the weight (n,).
        felt: specific force [g] (n,).
        gyro: rates; without them nothing is found.
    """
    if gyro is None or len(t) < 3:
        return np.zeros(len(t), dtype=bool)
    width = max(1, round(0.3 / sample_period(t)))
    fresh = np.append(~copied(gyro.values), True)  # a gyro that is stuck does not show that nothing turns
    turning = np.interp(t, gyro.t, np.where(fresh, np.linalg.norm(gyro.values, axis=1), 1.0))
    load, still = moving_mean(thrust / np.maximum(felt, 0.1), width), moving_mean(turning, width) < 0.15
    carried = moving_mean(np.abs(felt - 1.0), width) < 0.15  # where a fall ends it passes 1
    little = load < 0.75
    if np.mean(little) > 0.3:  # then speeds disagree with the thrust, and nothing follows from them
        return np.zeros(len(t), dtype=bool)
    stands = little & still & carried
    return np.asarray(moving_mean(stands.astype(np.float64), 2 * width) > 0.0)


def _thrust(channel: Channel, vehicle: Vehicle | None, felt: FloatArray | None) -> tuple[FloatArray, float]:
    """Returns relative thrust and the value that hovers; `felt` is the specific force [g], shape (n,)."""
    values = channel.values
    if channel.name == "motor_command" and np.median(np.abs(values)) > 100.0:
        low, high = vehicle.command.range if vehicle is not None else (1000.0, 2000.0)
        values = np.clip((values - low) / (high - low), 0.0, None)
    # A rotor that is ignored, for it is dead or its signal is, has the others' median; no ground carries.
    usual = np.median(values, axis=1, keepdims=True)
    values = np.where(values < _NOTHING * usual, usual, values)
    thrust = np.asarray(np.sum(values**2, axis=1))
    # Commands that never exceed 15 % of full are idling motors.
    if channel.name == "motor_command" and np.quantile(thrust, 0.95) < 0.15**2 * values.shape[1]:
        return thrust, 0.0
    if channel.name == "rotor_speed" and vehicle is not None and values.shape[1] == len(vehicle.rotors):
        modelled, hover = ThrustModel.stated(vehicle).total(values), vehicle.mass * GRAVITY
        highest = float(np.max(modelled))  # of losses that no rotor has it may be negative
        typical = float(np.median(modelled[modelled >= 0.25 * highest])) if highest > 0.0 else 0.0
        if 1.0 / HOPELESS < typical / hover < HOPELESS:
            return modelled, hover
    strong = thrust > 0.5 * np.quantile(thrust, 0.95)
    if felt is not None and (strong := strong & (felt > 0.5)).any():
        return thrust, float(np.median(thrust[strong] / felt[strong]))
    powered = thrust[thrust > 0.25 * np.quantile(thrust, 0.95)]
    return thrust, float(np.median(powered)) if len(powered) else 0.0


def _load(accel: Channel) -> FloatArray | None:
    """Specific force [g] averaged over 0.2 s, shape (n,), whichever unit it is in; None where it is in none."""
    length = np.linalg.norm(accel.values, axis=1)
    middle = float(np.median(length))
    unit = next((u for u in (GRAVITY, 1.0, 1e3) if 0.5 < middle / u < 4.0), None)
    width = max(1, round(0.2 / sample_period(accel.t)))
    return None if unit is None else np.asarray(moving_mean(length / unit, width))


def _felt(accel: Channel) -> FloatArray:
    """Returns 1 where the specific force, averaged over 0.5 s, points along its usual direction, else 0; any unit."""
    usual = np.median(accel.values, axis=0)
    share = accel.values @ usual / float(usual @ usual or 1.0)
    width = max(1, round(0.5 / sample_period(accel.t)))
    return np.asarray(moving_mean(share, width) > 0.3, dtype=np.float64)


def _from_carried(span: tuple[float, float], carried: FloatArray) -> tuple[float, float] | None:
    """A span from the first of the rising times [s] in it at which rotors carry; None where that is too short."""
    first = float(carried[at]) if (at := int(np.searchsorted(carried, span[0]))) < len(carried) else np.inf
    return (first, span[1]) if span[1] - first >= _SHORTEST else None


def _spans(t: FloatArray, on: BoolArray) -> Spans:
    runs = [(float(t[first]), float(t[end - 1])) for first, end in zip(*true_runs(on), strict=True)]
    # An interruption of half a second ends no span.
    return tuple((a, b) for a, b in _joined(runs, 0.5) if b - a >= _SHORTEST)


# --- Timing of channels and values that do not move: rates, gaps, jitter, stuck and saturated signals, clock faults


FEWEST_SAMPLES = 20
"""Samples of each channel that a comparison needs."""
_GRID = 0.02
"""Step of the grid [s] for which gaps are reported, that of the fit."""
IMU = "gyro", "accel"
_STUCK = 0.5
"""An IMU channel that does not change for this long [s] in flight is stuck; others after ten times as long."""


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
        saturated=sum(end.samples for end in at_limit(channel.values))
        if channel.name in ("gyro", "accel", "motor_command")
        else 0,
        dropped=dict(channel.faults),
    )


def timing_checks(recording: Recording, facts: tuple[ChannelFacts, ...]) -> list[Check]:
    """Checks clocks, gaps, jitter and stuck sensors.

    Args:
        recording: the log.
        facts: of its channels.
    """
    checks = [_clock_check(recording, facts)]
    coarse = attitude_steps_check(recording)
    checks += [] if coarse is None else [coarse]
    for f in facts:
        rows = (f.count - 1) / max(f.last - f.first, 1e-9)
        if f.name == "attitude" and coarse is not None:
            continue  # a value that rests between its steps is no interpolated one
        if not f.gaps and rows > 1.5 * f.rate and f.name != "battery":  # a voltage may rest
            message = f"{f.name}: {rows:.3g} rows a second were interpolated between samples at {f.rate:.3g} Hz"
            checks.append(
                Check("timing", CheckResult.WARNING, message, "log it at this rate, or without the interpolated rows")
            )
    gaps = {f.name: f for f in facts if f.gaps}
    if gaps:
        worst = max(gaps.values(), key=lambda f: f.longest_gap)
        text = ", ".join(f"{f.name} {f.gaps}" for f in gaps.values())
        checks.append(
            Check(
                "timing",
                CheckResult.WARNING,
                f"gaps: {text}; the longest lasts {worst.longest_gap:.3g} s ({worst.name})",
                "windows are cut there; log to a faster card or at a lower rate",
                {"gaps": float(sum(f.gaps for f in facts)), "longest_s": worst.longest_gap},
            )
        )
    unsteady = [f for f in facts if f.name in ("gyro", "accel", "rotor_speed", "motor_command") and f.jitter > 0.25]
    for f in unsteady:
        message = f"{f.name}: steps vary by {f.jitter:.0%} of their median: stamps are unsteady or samples are lost"
        checks.append(Check("timing", CheckResult.WARNING, message, "stamp at the sensor", {"jitter": f.jitter}))
    for f in facts:
        if f.name in IMU and f.stuck > _STUCK or f.stuck > 10.0 * _STUCK and f.name in ("velocity", "position"):
            message = f"{f.name}: does not change for {f.stuck:.2g} s of flight, or one axis does not ({f.source})"
            checks.append(
                Check("stuck", CheckResult.WARNING, message, "check this sensor or topic", {"stuck_s": f.stuck})
            )
        if f.name in IMU and f.saturated:
            share = f.saturated / f.count
            # Inertias come out 2 % too large where 6 % of the rates are clipped, 8 % at 16 %.
            verdict = CheckResult.ERROR if f.name == "gyro" and share > 0.05 else CheckResult.WARNING
            message = f"{f.name}: {f.saturated} samples ({share:.2g} of all) at the limit of its range"
            fix = "choose a larger range or fly more gently"
            checks.append(Check("saturated", verdict, message, fix, {"share": share}))
    return checks


def _clock_check(recording: Recording, facts: tuple[ChannelFacts, ...]) -> Check:
    dropped: dict[str, int] = {}
    for f in facts:
        for reason, count in f.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
    numbers = {"breaks": float(len(recording.breaks)), **{k: float(v) for k, v in dropped.items()}}
    if not recording.breaks and not dropped:
        return Check("clock", CheckResult.OK, "time rises steadily, no sample was dropped", numbers=numbers)
    parts = [f"{len(recording.breaks)} breaks (reboots or clock steps)"] if recording.breaks else []
    parts += [f"{count} samples dropped: {reason.replace('_', ' ')}" for reason, count in dropped.items()]
    return Check(
        "clock",
        CheckResult.WARNING,
        "; ".join(parts),
        "nothing is joined across breaks" if recording.breaks else "",
        numbers,
    )


def _quantum(values: FloatArray) -> float:
    """Step between the levels of a coarse signal, shape (n,), in its unit; 0 where nearly every sample has its own."""
    levels = np.unique(values)
    steps = np.diff(levels)[np.diff(levels) > 1e-6]  # equal but for rounding
    return 0.0 if not len(steps) or len(steps) > 0.2 * len(values) else float(np.min(steps))


def _turn_quantum(q: FloatArray) -> float:
    """Step of rounded quaternions, shape (n, 4), [rad]; 0 for others.

    Their components are to each other as small whole numbers, also where they were made unit again.
    """
    q = q[np.all(q != 0.0, axis=1)]
    q = q[:: len(q) // 500 + 1]
    if len(q) < FEWEST_SAMPLES:
        return 0.0
    largest = np.max(np.abs(q), axis=1)
    whole = np.arange(1.0, 400.0)
    ratios = whole[:, None, None] * (q / largest[:, None])
    found = np.all(np.abs(ratios - np.rint(ratios)) < 1e-4, axis=2)
    rounded = found.any(axis=0)
    return float(2.0 * np.median(largest / whole[found.argmax(axis=0)])) if rounded.mean() > 0.9 else 0.0


def attitude_steps_check(recording: Recording) -> Check | None:
    """A warning where angles or quaternions come in steps that are coarse beside usual noise; None for fine ones."""
    attitude = recording.channels.get("attitude")
    if attitude is None or len(attitude.t) < FEWEST_SAMPLES:
        return None
    step = max(*(_quantum(c) for c in euler(attitude.values).T), _turn_quantum(attitude.values))
    if step < 0.005:
        return None
    return Check(
        "attitude_steps",
        CheckResult.WARNING,
        f"attitude comes in steps of {np.degrees(step):.2g} deg ({attitude.source})",
        "log it with more digits",
        {"step_rad": step},
    )


# --- Turns by the attitude over those by the gyro, from physics that needs no model of the vehicle
#
# By how much the turns over `TURN` change, as the gyro adds up to them and as the attitude has them, about each axis.
# Changes of turns have neither the gyro's bias nor the slow pull of an attitude filter in them, and lie where inertias
# are seen.  All axes of the gyro are regressors, so that one that leaks into another shows; the change of rate takes up
# a delay, so that the factor is a ratio of sizes.


ALLOWED = 0.03
"""Calibrated sensors differ by less than this share."""
ERRORS = 2.0
"""... and these many standard deviations, when they are compared."""
TURN = 0.2
"""Gyro and attitude are compared over turns of this length [s]."""
MOVING = 0.1
"""An axis that turns slower than this on average [rad/s] is not used: gyro noise would make the factor too small."""
FEWEST = 15
"""Turns from which a factor is computed, at least,"""
KNOWN = 0.05
"""... and the standard deviation from which on it is used: noise makes a ratio of small turns too large."""
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
        """True if it is known well enough to be compared."""
        return self.sigma <= KNOWN

    @property
    def off(self) -> float:
        """Distance from where it ought to be."""
        return self.value - self.ideal

    @property
    def disagrees(self) -> bool:
        """True if it is known, and cannot be what it ought to be."""
        return self.known and abs(self.off) > ALLOWED + ERRORS * self.sigma

    def __str__(self) -> str:
        return f"{self.what} = {self.value:.3f} +- {self.sigma:.3f}"


class Turns(NamedTuple):
    """Changes of turn by the gyro (n, 3), of its rate (n, 3), and of turn by the attitude (n, 3), from every row.

    `over` [s] is the length of each turn.
    """

    gyro: FloatArray
    rate: FloatArray
    attitude: FloatArray
    over: float

    @classmethod
    def of(cls, gyro: FloatArray, q: FloatArray, step: float, over: float = TURN) -> "Turns":
        """Changes of turn of rates (n, 3) [rad/s] and attitudes (n, 4), `step` [s] apart; rows of NaN are left out."""
        long = max(round(over / step), 1)
        # A turn from every row: readings in step with the sticks would put all others at one phase of their motion.
        starts = np.arange(max(len(gyro) - long, 0))
        if len(starts) <= long:
            return cls(none := np.empty((0, 3)), none, none, over)
        turns = (
            integrated(np.stack([gyro[k : k + long + 1] for k in starts], axis=1), step),
            gyro[starts + long] - gyro[starts],
            turn(q[starts], q[starts + long]),
        )
        by_gyro, rate, by_attitude = (t[long:] - t[:-long] for t in turns)
        good = np.isfinite(by_gyro + rate + by_attitude).all(axis=1)
        return cls(by_gyro[good], rate[good], by_attitude[good], over)

    def moments(self, axis: int, step: float) -> FloatArray:
        """Sums of products of (changes of turn by the gyro about x, y, z, of rate, of turn by the attitude), (5, 5)."""
        rows = np.column_stack([self.gyro, self.rate[:, axis], self.attitude[:, axis]])
        return rows.T @ rows / max(round(self.over / step), 1)


def factors(axis: int, turns: float, moments: FloatArray) -> list[Factor]:
    """Size of the attitude's turns over the gyro's about an axis, then what it has of the gyro's other axes.

    Args:
        axis: 0, 1 or 2.
        turns: in the moments, by the seconds of data over the length of a turn.
        moments: as of `Turns.moments`, (5, 5).
    """
    gram, cross = moments[:4, :4], moments[:4, 4]
    inverse = np.linalg.pinv(gram, hermitian=True)
    slope = inverse @ cross
    left = max(float(moments[4, 4] - slope @ cross), 0.0) / (turns - 4.0)
    sigma = np.sqrt(left * np.diag(inverse))
    own = [axis, 3]
    size = math.sqrt(float(slope[own] @ gram[np.ix_(own, own)] @ slope[own]) / gram[axis, axis])
    found = [Factor(f"{AXES[axis]} {TURN_FACTOR}", math.copysign(size, slope[axis]), float(sigma[axis]))]
    return found + [
        Factor(f"part of the gyro's {AXES[k]} in the attitude's {AXES[axis]}", float(slope[k]), float(sigma[k]), 0.0)
        for k in range(3)
        if k != axis
    ]
