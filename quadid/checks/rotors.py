"""Checks of rotor signals, mass and geometry against each other and the motion."""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from quadid.checks.findings import ERROR, OK, UNKNOWN, WARNING, Check, Off, estimates_off, farthest, rotors_off
from quadid.checks.frames import tapered_spectra
from quadid.checks.motion import FEWEST_SAMPLES, HOPELESS, MOVING, STUCK, Log, Spans, is_turning, within
from quadid.chi_square import exceeded
from quadid.data.grid import bridged, linear, moving_mean, to_windows
from quadid.data.rotor_signal import INERTIA_RATE, RotorSignal
from quadid.data.window import Channel, Recording, Window, measured_period, sample_period, true_runs
from quadid.errors import QuadidError
from quadid.model.layout import ThrustModel, voltage_at
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- Rotor signals by themselves: dead, stuck, coarse, or copies of each other


_FIX = "repair that sensor or its wiring, leave it out with motor commands, or use the part of the flight before it"
_speeds_are = partial(Check, "rotor_speed")


def readings_check(log: Log) -> Check | None:
    """A rotor that reads nothing or holds one value, all that read the same, coarse steps; None for none of these."""
    try:
        signal = log.signal
    except QuadidError:
        return None
    inside = within(signal.t, log.spans)
    t, speeds = signal.t[inside], signal.values[inside]
    if len(t) < FEWEST_SAMPLES:
        return None
    commands, gyro = log.commanded, log.recording.channels.get("gyro")

    def error(message: str, fix: str = "", **numbers: float) -> Check:
        fix = fix or ("check which outputs drive the motors, and that all of them were logged" if commands else _FIX)
        return _speeds_are(ERROR, f"{message} ({signal.source})", fix, numbers)

    # A rotor that turns, and reads five times what the others read, or a fifth: no balance is so far.
    usual = np.median(np.abs(speeds), axis=0)
    for rotor, own in enumerate(usual):
        others = float(np.median(np.delete(usual, rotor)))
        ratio = own / max(others, 1e-9)
        if np.ptp(speeds[:, rotor]) > 0.0 < own and others > 0.0 and not 0.2 < ratio < 5.0:
            likely = {"in rpm": 30.0 / np.pi, "a square": others, "a command from 0 to 1": 0.5 / others}
            likely["in rev/s"] = 0.5 / np.pi
            unit = next((f": is it {name}?" for name, r in likely.items() if 0.5 < ratio / r < 2.0), "")
            text = f"rotor {rotor + 1} reads {ratio:.3g} times what the others read{unit}"
            return error(text, "log all in one unit", rotor=rotor + 1.0)
    # One that reads nothing while the others turn: a command may rest for half of the flight, a speed for a twentieth.
    if (turning := speeds[speeds > 0.0]).size:
        still = 0.1 * np.median(turning)
        others_turn = np.median(speeds, axis=1) > still
        share = np.mean(speeds[others_turn] < still, axis=0) if others_turn.any() else np.zeros(speeds.shape[1])
        if share.max() >= (0.5 if commands else 0.05):
            rotor = int(np.argmax(share))
            text = f"rotor {rotor + 1} reads nothing for {share[rotor]:.0%} of the flight: its speed signal is dead"
            return error(text, rotor=rotor + 1.0, dead_share=float(share[rotor]))
    # Columns that are one: their difference, which turns the vehicle, is lost; one command may go to one axle.
    places = log.vehicle.rotor_positions[:, :2]
    for i, j in combinations(range(speeds.shape[1]), 2):
        axle = commands and np.linalg.norm(places[i] - places[j]) < 0.1 * log.vehicle.arm
        if np.ptp(speeds[:, i]) > 0.0 and np.array_equal(speeds[:, i], speeds[:, j]) and not axle:
            every = np.all(speeds == speeds[:, :1])
            which = "all rotor columns" if every else f"rotor columns {i + 1} and {j + 1}"
            return error(f"{which} are the same: one was written for the other", rotor=i + 1.0, other=j + 1.0)
    # Few levels, and noise of the steps between them of 2 % of the power of quick motion: inertias come out so large.
    levels = [np.unique(column) for column in speeds.T]
    if min(map(len, levels)) >= 3 and max(map(len, levels)) <= 40:
        step = float(np.median(np.concatenate([np.diff(values) for values in levels])))
        quick = speeds - moving_mean(speeds, round(_SLOW_MOTION / sample_period(t)) | 1, mirrored=True)
        noise = step**2 / 12.0
        noise /= max(float(np.median(np.var(quick, axis=0))) - noise, 0.1 * noise)
        if noise > 0.02:  # such a signal rests between its steps
            text = f"rotor speeds come in steps of {step:.3g} rad/s: too coarse for the motion ({signal.source})"
            off = estimates_off(torque=[1.0 / (1.0 + noise)] * 3, spinning=1.0 / (1.0 + noise))
            return _speeds_are(WARNING, text, "log them finer, or motor commands", {"step_rad_s": step}, off)
    # A value held while the vehicle moves, unless it is a limit that all rotors share
    if np.ptp(speeds, axis=0).max() == 0.0 and is_turning(gyro, ((t[0], t[-1]),), MOVING):
        text = "no rotor ever changes its speed, though the vehicle moves: the speed signal is stuck"
        return error(text, stuck_s=float(t[-1] - t[0]))
    for rotor, column in enumerate(speeds.T):
        rest = np.delete(speeds, rotor, axis=1)
        same = np.append(column[1:] == column[:-1], False) & (column != rest.min()) & (column != rest.max())
        held = [(float(t[a]), float(t[min(b, len(t) - 1)])) for a, b in zip(*true_runs(same), strict=True)]
        begin, end = max(held, key=lambda run: run[1] - run[0], default=(0.0, 0.0))
        if end - begin > STUCK and is_turning(gyro, ((begin, end),), MOVING):
            value = column[np.searchsorted(t, begin)]
            text = f"rotor {rotor + 1} holds {value:.4g} rad/s for {end - begin:.2g} s of moving flight"
            return error(f"{text}: its speed signal is stuck", rotor=rotor + 1.0, stuck_s=end - begin)
    return None


# --- Rotors against each other and against the thrust felt: half a second without balance turns a vehicle over


def rotor_speed_check(log: Log) -> Check:
    """Each rotor against the others and all against the thrust felt; the first that cannot be true is named."""
    signal, spans, accel = log.signal, log.spans, log.recording.channels.get("accel")
    # Means over half a second are compared: fast motion has passed by then.
    edges = np.arange(spans[0][0], spans[-1][1] + 0.25, 0.5) if spans else np.empty(0)
    if len(edges) < 4 or np.count_nonzero(within(signal.t, spans)) < FEWEST_SAMPLES:
        return _speeds_are(UNKNOWN, "too little flight to compare the rotors")
    flown = np.any([(edges[:-1] >= a) & (edges[1:] <= b) for a, b in spans], axis=0)

    def means(t: FloatArray, values: FloatArray) -> tuple[FloatArray, BoolArray]:
        """Means of columns over the bins (m, columns), and which bins of flight hold samples (m,)."""
        row = np.digitize(t, edges)
        count = np.bincount(row, minlength=len(edges) + 1)[1:-1]
        sums = [np.bincount(row, column, minlength=len(edges) + 1)[1:-1] for column in values.T]
        return np.column_stack(sums) / np.maximum(count, 1)[:, None], np.asarray(flown & (count > 2))

    def wrong(message: str, **numbers: float) -> Check:
        driven = "a damaged rotor is driven harder, which `quadid health` measures; or they mean thrust"
        verdict, fix = (WARNING, f"these are commands: {driven}") if log.commanded else (ERROR, _FIX)
        return _speeds_are(verdict, f"{message} ({signal.source})", fix, numbers)

    # Mean roll and pitch moment of the rotors; yaw is left free, for a vehicle may turn for long.  Of one hovering
    # rotor's moment, a rotor of four that reads half its speed makes 0.75; one that lost 45 % of its thrust, and turns
    # faster for it, 0.64.
    squares, known = means(signal.t, signal.values**2)
    lever, total = log.vehicle.torque_arms[:, :2] / log.vehicle.arm, squares.sum(axis=1)
    share = (squares / np.maximum(total, 1e-9)[:, None])[known]
    odd = np.linalg.norm(share @ lever, axis=1) > 0.72 / (len(lever) - 0.25)
    if known.any() and odd.mean() >= 0.1:
        part = float(odd.mean())
        found = _misread(np.median(share[odd], axis=0), lever)
        if found is None:
            return wrong("the rotor speeds are far from balance", share=part)
        _, rotor, ratio = found
        text = f"rotor {rotor + 1} reads {ratio:.2f} times the speed that balance needs for {part:.0%} of the flight"
        return wrong(text, rotor=rotor + 1.0, speed_ratio=ratio, share=part)
    # Thrust felt over squared speeds: a payload of half the weight changes it by 1.5.
    if accel is not None:
        force, felt = means(accel.t, -accel.values[:, 2:])
        used = known & felt & (total > 0.0)
        low, high = np.quantile(force[used, 0] / total[used], [0.1, 0.9]) if used.any() else (1.0, 1.0)
        if np.count_nonzero(used) >= 10 and not (low > 0.0 and high < 1.8 * low):
            change = float(high / low) if low > 0.0 else math.inf
            text = f"thrust felt per rotor speed squared changes by a factor of {change:.2g} within the flight"
            return wrong(f"{text}: the rotor speeds disagree with the accelerometer", thrust_range=change)
    return _speeds_are(OK, "the rotors agree with each other and with the thrust felt")


Odd = tuple[float, int, float]
"""Remaining difference of the rotors' shares from each other and from balance, once one rotor is corrected; that rotor
(from 0), and its number as believed over that which balance needs."""


def _misfit(share: FloatArray, lever: FloatArray) -> float:
    return float(np.hypot(np.std(share), np.linalg.norm(share @ lever)) / np.mean(share))


def _misread(share: FloatArray, lever: FloatArray) -> Odd | None:
    """The rotor whose square, set to what balance needs, leaves the least, and its speed over that."""
    fits = []
    for rotor, arm in enumerate(lever):
        needed = share.copy()
        needed[rotor] -= float(share @ lever @ arm / (arm @ arm))
        if needed[rotor] > 0.0:
            fits.append((_misfit(needed, lever), rotor, float(np.sqrt(share[rotor] / needed[rotor]))))
    return min(fits, default=None)


def balance_check(log: Log) -> Check | None:
    """A warning where rotors balance on the average so far from the centre as a quarter more thrust of one moves it.

    With right files of recorded vehicles it is a fifth at most.  Named is what a rotor's reading or place explains.
    """
    vehicle, speeds = log.vehicle, log.signal.values[within(log.signal.t, log.spans)]
    if not len(speeds) or {"cg_offset", "weak_rotor"} & set(vehicle.effects):
        return None
    lever, squares = vehicle.torque_arms[:, :2] / vehicle.arm, np.mean(speeds**2, axis=0)
    share = squares / max(float(squares.sum()), 1e-9)
    off = float(np.linalg.norm(share @ lever))
    read = _misread(share, lever)
    if off < 0.25 / len(lever) or read is None:
        return None
    here = f"the rotors balance {100.0 * off:.2g} % of the arm from the centre, as if rotor"
    check = partial(Check, "balance", WARNING)
    # Each rotor with its arm set to what balance needs, and the arm's length over that
    fits = []
    for rotor, arm in enumerate(lever):
        needed = 1.0 - float(share @ lever @ arm / (share[rotor] * (arm @ arm)))
        if needed > 0.0:
            scale = np.where(np.arange(len(lever)) == rotor, needed, 1.0)[:, None]
            fits.append((_misfit(share, lever * scale), rotor, 1.0 / needed))
    if placed := [odd for odd in sorted(fits) if odd < read]:
        farther = " or ".join(f"{rotor + 1} stood {1.0 / ratio:.2f}" for _, rotor, ratio in placed)
        message = f"{here} {farther} times as far from it as in the vehicle file: then inertias are wrong"
        moved = [_built(vehicle, {k: vehicle.rotor_positions[k, :2] / ratio}) for _, k, ratio in placed]
        doubt = farthest([rotors_off(vehicle, speeds, speeds, other) for other in moved])
        numbers = {"off": off, "rotor": placed[0][1] + 1.0, "arm_ratio": placed[0][2]}
        fix = "measure where that rotor is, and where the vehicle balances"
        return check(f"{message}, else the centre of gravity is there", fix, numbers, doubt)
    _, rotor, ratio = read
    message = f"{here} {rotor + 1} read {ratio:.2f} times its speed: then b and inertias are wrong"
    fix = "check that rotor's reading, propeller and place in the vehicle file, and where the vehicle balances"
    doubt = rotors_off(vehicle, speeds, speeds / np.where(np.arange(len(lever)) == rotor, ratio, 1.0))
    numbers = {"off": off, "rotor": rotor + 1.0, "speed_ratio": ratio}
    return check(f"{message}, else the centre of gravity is there", fix, numbers, doubt)


# --- Whether the rotor signal stands in one place in time before the motion that it causes
#
# A motor answers its command late by its lag, always the same; measured speeds come a few milliseconds late.  A lag
# that wanders over the flight is a clock's, not a motor's, and a torque that follows its own effect is a wrong stamp.


_STEP = 0.01
"""Lags are compared at multiples of this [s]; the peak is found between them."""
_FARTHEST = 25
_BLOCK = 7.5
_CLEAR = 0.3
"""Correlation above which the peak of a block counts."""
_LATE = 0.015
"""Torque after its effect [s] that is named; 10 ms more is refused."""
_SLOW_MOTION = 0.4
"""Motion slower than about 1/0.4 s is left out: there aerodynamics and the controller rule [s]."""


class _Placed(NamedTuple):
    """Lags of roll and pitch by block [s], which are clear, both (blocks, 2); lively ones and their correlation."""

    lags: FloatArray
    clear: BoolArray
    lively: int
    correlation: float


def rotor_timing_check(log: Log) -> Check:
    """Lag between roll and pitch torque and angular acceleration, block by block, and how far it wanders."""
    gyro, check = log.recording.channels.get("gyro"), partial(Check, "rotor_timing")
    if gyro is None or not log.spans:
        return check(UNKNOWN, "needs gyro and rotor signal in flight")
    slowest = max(measured_period(log.signal.t, log.signal.values), sample_period(gyro.t))
    if not slowest <= 1.0 / INERTIA_RATE:
        return check(UNKNOWN, "rotor signal or gyro too slow to place them in time")
    found = _placed(log, gyro, slowest, 0.0)
    if found is None:
        return check(UNKNOWN, "too little flight to place the rotor signal in time")
    if found.correlation < 0.5:  # a clock of its own may be seconds off; no chance makes most lags clear and one
        for about in (0.45 * sign * step for step in (1.0, 2.0, 3.0, 4.0) for sign in (-1.0, 1.0)):
            far = _placed(log, gyro, slowest, about) or found
            own = far.lags[far.clear]
            if far.correlation > 0.7 and 2 * len(own) > far.lively > 1 and np.ptp(own) < 2.0 * _LATE:
                found = far
                break
    lags, placed, lively, correlation = found
    clear = lags[placed]
    check = partial(check, numbers={"correlation": correlation})
    if len(clear) < max(2, lively // 2):
        message = f"torque and angular acceleration correlate by {correlation:.2f} only, at any lag"
        return check(UNKNOWN, message, "fly with more roll and pitch motion")
    # Lags of each axis about their own median, for other motion excites it; a clock moves both alike.
    usual = [np.median(lags[placed[:, axis], axis]) if placed[:, axis].any() else 0.0 for axis in range(2)]
    moved = np.average(lags - usual, axis=1, weights=placed + 1e-12)[placed.any(axis=1)]
    low, high = np.quantile(moved, [0.1, 0.9])
    lag, wander = float(np.median(clear)), float(high - low)
    check = partial(check, numbers={"correlation": correlation, "lag_s": lag, "wander_s": wander})
    message = (
        f"torque and angular acceleration correlate by {correlation:.2f} at a lag of {1e3 * lag:.0f} ms, "
        f"which wanders by {1e3 * wander:.0f} ms"
    )
    fix = "stamp the rotor signal by the clock that stamps the IMU, or log both on board"
    if wander > 0.02 and correlation < 0.5:
        return check(UNKNOWN, f"{message}: too weak to be sure that it is the clock")
    if wander > 0.02:  # [s]; a centre of gravity a tenth of the arm off makes 16 ms
        return check(ERROR, f"{message}: the rotor signal is not in time with the gyro", fix)
    if -_LATE - 0.01 < lag < -_LATE:
        smoothed = f"{message}: rotor speeds are late, or the states were smoothed without a delay"
        return check(WARNING, smoothed, "log raw states; `rotor_telemetry_delay` models a delay")
    if lag < -_LATE:
        return check(ERROR, f"{message}: the rotor signal lags its effect", fix)
    if lag > 0.2:
        return check(ERROR, f"{message}: no motor answers that late", fix)
    return check(OK, message)


def _placed(log: Log, gyro: Channel, slowest: float, about: float) -> _Placed | None:
    """Peaks of every block near a lag [s] of signals that come every so often [s]; None without a block."""
    signal, blocks = log.signal, []
    for times in _blocks(log.spans):
        answered = _answered(signal._replace(t=signal.t + about), gyro, log.vehicle, times)
        torque, motion = (_quick(rows, slowest) for rows in answered)
        peaks = np.array([_peak(torque[:, axis], motion[:, axis]) for axis in range(2)])
        blocks.append(peaks + [about, 0.0, 0.0])
        lag, score, _ = max(peaks.tolist(), key=lambda peak: peak[1])
        if score > 0.5 and abs(lag) > 0.1:  # a clock that drifts leaves what is searched
            about += lag
    if not blocks:
        return None
    lags, scores, sizes = np.moveaxis(np.array(blocks), -1, 0)
    lively = sizes >= 0.1 * sizes.max(axis=0)  # less is a hover: what disturbs it has lags of its own
    return _Placed(lags, lively & (scores > _CLEAR), int(lively.sum()), float(np.median(scores[lively])))


def accel_timing_check(log: Log) -> Check | None:
    """A warning where the accelerometer answers the rotors at another time than the gyro does, else None."""
    accel, signal, timing = log.recording.channels.get("accel"), log.signal, log.once(order_checks).get("rotor_timing")
    if accel is None or timing is None or "lag_s" not in timing.numbers:
        return None
    slowest = max(measured_period(c.t, c.values) for c in (signal, accel))
    peaks = []
    for at in _blocks(log.spans):
        thrust = np.sum(_read(signal.t, signal.values, at, power=2), axis=1, keepdims=True)
        both = (_quick(rows, slowest)[:, 0] for rows in (thrust, -_read(accel.t, accel.values[:, 2:], at)))
        peaks.append(_peak(*both))
    clear = [lag for lag, correlation, _ in peaks if correlation > _CLEAR + 0.1]
    late = float(np.median(clear)) - timing.numbers["lag_s"] if clear and 2 * len(clear) >= len(peaks) else 0.0
    if abs(late) < _LATE:
        return None
    later, sooner = ("accelerometer", "gyro") if late > 0.0 else ("gyro", "accelerometer")
    message = f"{later} answers the rotors {1e3 * abs(late):.0f} ms after the {sooner}"
    fix = f"stamp the {later} when it is measured, and log it without a filter"
    return Check("accel_timing", WARNING, message, fix, {"late_s": late})


def _blocks(spans: Spans) -> Iterator[FloatArray]:
    """Times on a uniform grid, in blocks of about `_BLOCK` seconds of uninterrupted flight."""
    for a, b in spans:
        bounds = np.linspace(a, b, max(1, int((b - a) // _BLOCK)) + 1)
        for c, d in zip(bounds[:-1], bounds[1:], strict=True):
            if len(times := np.arange(c, d, _STEP)) > 8 * _FARTHEST:
                yield times


def _answered(signal: RotorSignal, gyro: Channel, vehicle: Vehicle, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Roll and pitch torque over b and angular acceleration at the times of a block, both (n, 2)."""
    torque = _read(signal.t, signal.values, at, power=2) @ vehicle.torque_arms[:, :2]
    return torque, np.gradient(_read(gyro.t, gyro.values[:, :2], at), _STEP, axis=0)


def _read(t: FloatArray, values: FloatArray, at: FloatArray, power: int = 1) -> FloatArray:
    """Powers of a signal at the times of a block, by straight lines between the samples that these need alone."""
    near = slice(max(int(np.searchsorted(t, at[0], side="right")) - 1, 0), int(np.searchsorted(t, at[-1])) + 1)
    return linear(t[near], values[near] ** power, at)


def _quick(values: FloatArray, slowest: float) -> FloatArray:
    """Band of frequencies that signals hold which come every so often [s]: smoothed, and slow motion left out."""
    smooth = moving_mean(values, max(3, round(2.5 * slowest / _STEP) | 1))
    return np.asarray(smooth - moving_mean(smooth, round(_SLOW_MOTION / _STEP) | 1, mirrored=True))


def _peak(torque: FloatArray, motion: FloatArray) -> tuple[float, float, float]:
    """Lag [s] of angular acceleration behind the torque in one block, correlation there, and size of the motion."""
    n, far = len(torque), _FARTHEST
    later = motion[far : n - far]
    rows = [torque[far - k : n - far - k] for k in range(-far, far + 1)]
    scores = np.array([row @ later / np.sqrt(row @ row * (later @ later) + 1e-300) for row in rows])
    best = int(np.argmax(scores))
    shift = 0.0
    if 0 < best < 2 * far:
        before, here, after = scores[best - 1 : best + 2]
        shift = 0.5 * float((before - after) / (before - 2.0 * here + after))
    return (best - far + shift) * _STEP, float(scores[best]), float(np.std(later))


_OCTAVES = 1.0, 1.5, 2.25, 3.4, 5.0, 7.5, 11.0
"""Edges of bands [Hz] in which the motion that torque makes is compared: its size over that of the torque."""


def gyro_filter_check(log: Log) -> Check | None:
    """A warning where the gyro hardly answers quick torque that it answers when slow: it was low-passed; else None.

    What makes motion small makes it late, motors and sensors alike; only smoothing of a log does not.  With measured
    speeds no motor is between torque and motion, and what is late is the gyro's filter.
    """
    gyro, vehicle = log.recording.channels.get("gyro"), log.vehicle
    if gyro is None or not log.spans:
        return None
    rows = round(2.0 / _STEP)
    answers = (_answered(log.signal, gyro, vehicle, at) for at in _blocks(log.spans))
    spectra = [tapered_spectra(np.hstack(both), rows) for both in answers]
    if sum(map(len, spectra)) < 5:
        return None
    torque, motion = np.split(np.concatenate(spectra), 2, axis=1)
    cross, acted, turned = (
        np.sum(x, axis=0) for x in (motion * torque.conj(), np.abs(torque) ** 2, np.abs(motion) ** 2)
    )
    if not min(acted[1:].min(), turned[1:].min()) > 0.0:  # no torque, or no motion at all
        return None
    place = np.digitize(np.fft.rfftfreq(rows, _STEP), _OCTAVES)
    slowest = max(measured_period(log.signal.t, log.signal.values), sample_period(gyro.t))
    bands = [k for k in range(1, len(_OCTAVES)) if _OCTAVES[k] < 0.4 / slowest]
    sums = [
        [np.sum(x[:, place == k], axis=1) for x in (cross, acted, turned, np.abs(cross) ** 2 / acted)] for k in bands
    ]
    found = []
    for (low, (along, *slow)), (high, (then, *fast)) in combinations(zip(bands, sums, strict=True), 2):
        clear, clear_then = slow[2] / slow[1], fast[2] / fast[1]
        if min(clear.min(), clear_then.min()) > _CLEAR + 0.2:  # the least answer that is likely, and the most
            left = np.sqrt(fast[1] / fast[0] / clear_then / (slow[1] / slow[0] * clear))
            found.append((float(left.max()), low, high, float(np.abs(np.angle(then * along.conj())).max())))
    left, low, high, lag = min(found, default=(1.0, 0, 0, 0.0))
    smoothed = lag < 0.75 * math.acos(min(left, 1.0))
    measured = vehicle.command.sampling == "instant" and "imu_lag" not in vehicle.effects
    # Bodies answer torque alike at each frequency; motors leave more than two fifths.
    if left > 0.4 or not (smoothed or measured):
        return None
    slower, quicker = (math.sqrt(_OCTAVES[k - 1] * _OCTAVES[k]) for k in (low, high))
    # With what is late fitted along, inertias are too large by what the gyro misses of all acceleration by torque.
    along, acted = (np.array([band[k] for band in sums]) for k in (0, 1))
    answer = np.abs(along) / acted
    read = np.sum(np.abs(along), axis=0) / np.sum(acted * answer[bands.index(low)], axis=0)
    message = f"gyro answers torque at {quicker:.2g} Hz by {left:.0%} of what it does at {slower:.2g} Hz: it was "
    message += "smoothed without a delay" if smoothed else "low-passed"
    fix = "log the raw gyro, else inertias come out too large" + ("" if smoothed else "; `imu_lag` models a filter")
    off = estimates_off(turning=(*np.minimum(read, 1.0).tolist(), min(1.0, float(read.mean()))))
    return Check("gyro_source", WARNING, message, fix, {"left": left, "lag_rad": lag}, off)


# --- Rotor signals against the weight: unit of the speeds


_UNITS = (
    ("in rpm", 2.0 * np.pi / 60.0),
    ("in rev/s", 2.0 * np.pi),
    ("of the electrical field (if 14 poles)", 1.0 / 7.0),
    ("ten times too low, or b to be per rpm^2", 10.0),
    ("in thousands of rpm", 1e3 * 2.0 * np.pi / 60.0),
)
"""Units that speeds may be in instead of rad/s, and the factor that mends each."""


def hover_check(log: Log) -> Check:
    """Thrust by the vehicle file, with its effects, against weight in flight; separates rpm and rev/s from rad/s."""
    vehicle, check = log.vehicle, partial(Check, "hover")
    try:
        signal = log.signal
    except QuadidError as error:
        return check(ERROR, error.found, error.fix or f"allowed: {error.allowed}")
    inside, model, weight = within(signal.t, log.spans), ThrustModel.stated(vehicle), vehicle.mass * GRAVITY
    if not inside.any():
        most = float(np.max(model.total(signal.values))) / weight
        message = f"no flight in this log: its rotor speeds carry at most {most:.0%} of the weight"
        fix = "did it fly? Else check mass, the unit of the rotor speeds, and b"
        return check(WARNING, message, fix, {"most_load": most}, _heavier(1.0 / most))
    speeds, t = signal.values[inside], signal.t[inside]
    exponent = vehicle.effects.get("supply_voltage", {}).get("exponent", 0.0)
    battery = log.recording.channels.get("battery")
    volts = voltage_at(t, battery.t, battery.values[:, 0]) if exponent and battery is not None else None
    if volts is not None:
        speeds = speeds * ((volts / (vehicle.reference_voltage or float(volts.mean()))) ** exponent)[:, None]
    guess, thrust = vehicle.parameters["b"], float(np.mean(model.total(speeds)))
    needed = guess.initial * weight / thrust if thrust > 0.0 else np.inf
    low, high = guess.limits
    speed = float(np.sqrt(np.mean(speeds**2)))
    check = partial(check, numbers={"b_from_hover": needed, "speed_rad_s": speed})
    message = f"rotors turn at {speed:.4g} rad/s in flight (rms), so b would be {needed:.3g} N s^2/rad^2"
    if low <= needed <= high:
        return check(OK, f"{message}; bounds {low:.3g} to {high:.3g}")
    fitting = [(unit, f"{factor:.6g}") for unit, factor in _UNITS if low <= needed / factor**2 <= high]
    units, factors = [unit for unit, _ in fitting], " or ".join(factor for _, factor in fitting)
    fixes = [f"multiply rotor speeds by {factors}"] * bool(units) + ["b by 91.2"] * ("rpm^2" in "".join(units))
    root = float(np.mean(model.total(np.sqrt(np.abs(speeds)))))
    if low <= guess.initial * weight / max(root, 1e-300) <= high:
        units, fixes = [*units, "squared"], [*fixes, "take their square roots"]
    if 0.7 < float(np.mean(np.sum(speeds, axis=1))) / weight < 1.4:
        units, fixes = [*units, "thrusts in N"], [*fixes, "take the square roots of thrust over b"]
    if units:
        slip = f"{message}, outside {low:.3g} to {high:.3g}: speeds seem to be {' or '.join(units)}"
        return check(ERROR, slip, f"{', or '.join(fixes)}, or use the vehicle file of this log")
    few = "did it fly? Else " if needed > high else ""
    fix = few + "check mass, the unit of the rotor speeds, max_speed of the command, or the bounds of b"
    verdict = WARNING if low / HOPELESS < needed < high * HOPELESS else ERROR
    outside = f"{message}, outside its bounds {low:.3g} to {high:.3g}"
    return check(verdict, outside, fix, off=_heavier(needed / guess.initial))


def _heavier(factor: float) -> Off:
    """Errors of the estimates if the vehicle file's mass is so many times the true one; none without a factor."""
    return estimates_off(mass=factor) if 0.0 < factor < np.inf else {}


# --- Torque against motion at each lag of the motors: their order and spins, and the turn of the frame


_SETTLED = 0.25
"""Correlation in roll and pitch that settles an order."""
_GAIN, _CHANGE = 0.3, 0.1
"""Likelihood that another order or frame, or other spins, must gain for each sample; what each change costs."""
_MOST_ROTORS = 6
"""Beyond this turns, mirror images and exchanges of the order are tried, not all permutations."""

Rows = tuple[FloatArray, FloatArray, FloatArray]
"""Thrust over b (n, rotors), angular acceleration (n, 3) and rotors' own (n, rotors)."""
Order = tuple[int, ...]
"""Column of the log that drives each rotor, from 0."""


class _Gram(NamedTuple):
    """Products of the rotors' thrusts, (n, n), of thrusts and motion, (n, 3), and power of the motion, (3,)."""

    thrust: FloatArray
    motion: FloatArray
    power: FloatArray


class Lagged(NamedTuple):
    """Fast motion for each lag of the motors, and slower turning about z, without the noise that a loop answers.

    `still`: too little rotation to judge by.
    """

    fast: list[_Gram]
    slow: Rows
    still: bool


def lagged_motion(log: Log) -> Lagged | str:
    """Thrust over b by the vehicle file, angular acceleration and that of the rotors in flight, slow parts left out.

    One entry for each lag of 0, 1, 2 … rows by which the motors may answer late; or why there is none.
    """
    recording = log.read or log.recording
    if "gyro" not in recording.channels or not log.spans:
        return "needs gyro and rotor signal in flight"
    try:
        rate = 1.0 / measured_period(log.signal.t, log.signal.values)
        windows = to_windows(recording, log.vehicle, 50.0, log.spans[0][0], log.spans[-1][1])
    except QuadidError as error:
        return error.found
    return lagged_of(windows, log.vehicle, rate)


def lagged_of(windows: Sequence[Window], vehicle: Vehicle, rate: float) -> Lagged | str:
    """As `lagged_motion`, of windows in flight, with rotor readings at `rate` [Hz]."""
    if rate < INERTIA_RATE:
        return f"rotor signal at {rate:.3g} Hz is too slow to check the motor order"
    windows = [replace(w, rotor_speed=_turned(w, vehicle)) for w in windows]
    thrust, b = ThrustModel.stated(vehicle), vehicle.parameters["b"].initial
    acted = [thrust.single(w.rotor_speed) / b for w in windows]
    # Motors answer late: torque up to four rows earlier is tried.
    fast = [_in_band(windows, acted, lag, _SLOW_MOTION, 0.0) for lag in range(5)]
    if len(fast[0][0]) < 100:
        return "too little flight to check the motor order"
    grams = [_Gram(f.T @ f, f.T @ motion, np.sum(motion**2, axis=0)) for f, motion, _ in fast]
    still = float(np.max(np.std(fast[0][1], axis=0))) < 0.05
    # Motion about z between 2 s and 0.2 s shows the spins: faster, it is mostly what a loop answers to its own noise.
    return Lagged(grams, _in_band(windows, acted, 0, 2.0, 0.2), still)


def _turned(w: Window, vehicle: Vehicle) -> FloatArray:
    """Rotor speeds as the motor lag of the file leaves them: means over each step of commands, else at instants."""
    lag = vehicle.effects.get("motor_lag", {})
    tau = 0.5 * (lag.get("tau", 0.0) + lag.get("tau_down", lag.get("tau", 0.0)))
    if not tau > 0.0:
        return w.rotor_speed
    from scipy.signal import lfilter  # slow to load

    keep, u = math.exp(-w.dt / tau), w.rotor_speed
    if w.sampling == "held":  # omega' = (u - omega) / tau from u_0 on, u the same over a step
        begun = lfilter([0.0, 1.0 - keep], [1.0, -keep], u, axis=0, zi=u[:1])[0]
        return np.asarray(u + (begun - u) * (tau / w.dt) * (1.0 - keep))
    each = 0.5 * (1.0 - keep)
    return np.asarray(lfilter([each, each], [1.0, -keep], u, axis=0, zi=(1.0 - each) * u[:1])[0])


def _in_band(windows: Sequence[Window], thrust: list[FloatArray], lag: int, slowest: float, fastest: float) -> Rows:
    """Returns thrust over b `lag` rows earlier, angular acceleration, and that of the rotors, earlier, too.

    What is slower than one time [s] is left out, what is faster than the other smoothed away.
    """
    parts: list[Rows] = []
    for w, acted in zip(windows, thrust, strict=True):
        width, smooth = max(3, round(slowest / w.dt)), max(1, round(fastest / w.dt) | 1)
        if w.gyro is None or len(w) < 2 * width + lag or np.isnan(rates := bridged(w.gyro)).any():
            continue
        # The change over two steps against what acted in between: the row itself and its neighbours' halves.
        before, at, after = acted[:-2], acted[1:-1], acted[2:]
        acted = 0.5 * (before + at) if w.sampling == "held" else 0.25 * (before + 2 * at + after)
        gained, spun = ((rows[2:] - rows[:-2]) / (2.0 * w.dt) for rows in (rates, w.rotor_speed))
        rows = acted[: len(acted) - lag], gained[lag:], spun[: len(spun) - lag]
        smoothed = [moving_mean(r, smooth) for r in rows]
        acted, gained, spun = (r - moving_mean(r, width, mirrored=True) for r in smoothed)
        parts.append((acted, gained, spun))
    if not parts:
        return np.empty((0, 0)), np.empty((0, 3)), np.empty((0, 0))
    acted, gained, spun = (np.concatenate(column) for column in zip(*parts, strict=True))
    return acted, gained, spun


def order_checks(log: Log) -> dict[str, Check]:
    """Time, order and spins of the motors, and rotors one by one.

    Another order is only judged, and advised, of a signal that is in time with it and in balance: else the time is
    wrong, or a rotor.  Where no order is in time, the same is asked of an earlier signal: then both are wrong.
    """
    lagged, time, balance = log.once(lagged_motion), rotor_timing_check(log), rotor_speed_check(log)
    first = better_description(lagged, log.vehicle)
    for early in (0.0, 0.05, 0.1) if first is not None else ():
        turned, read = (_rotors_earlier(one, early) for one in (log.recording, log.read or log.recording))
        moved = replace(log, recording=turned, read=read)
        other = better_description(lagged_motion(moved), log.vehicle) if early else first
        if other is None:
            break
        moved = replace(moved, described=other.vehicle)
        again = rotor_timing_check(moved)
        own, its = (check.numbers.get("correlation", 0.0) for check in (time, again))
        fits = again.verdict is OK and its >= own - 1e-9
        if fits and rotor_speed_check(moved).verdict not in (ERROR, WARNING):
            late = {"rotor_timing": rotor_timing_check(replace(log, described=other.vehicle))} if early else {}
            return {"motor_order": motor_order_check(lagged, log.vehicle, other)} | late
    if time.verdict is ERROR and log.once(readings_check) is not None:  # coarse steps have lags of their own
        time = replace(time, verdict=UNKNOWN, message=f"{time.message}; its steps are too coarse to be sure", fix="")
    for wrong in (time, balance):
        if wrong.verdict is ERROR:
            return {wrong.name: wrong}
    order = motor_order_check(lagged, log.vehicle, None)
    if first is not None:
        order = Check("motor_order", UNKNOWN, "no order of the motors explains the motion at one lag")
    return {check.name: check for check in (order, time, balance)}


def _rotors_earlier(recording: Recording, seconds: float) -> Recording:
    """The recording with its rotor signals so much earlier."""
    rotors = {n: c for n, c in recording.channels.items() if n in ("rotor_speed", "motor_command")}
    earlier = {name: replace(channel, t=channel.t - seconds) for name, channel in rotors.items()}
    return replace(recording, channels={**recording.channels, **earlier})


class Other(NamedTuple):
    """A vehicle that explains the motion much better: what differs, what to do, correlations, its turn [rad]."""

    vehicle: Vehicle
    told: str
    fix: str
    correlation: FloatArray
    turned: float


def motor_order_check(lagged: Lagged | str, vehicle: Vehicle, other: Other | None) -> Check:
    """Correlates roll, pitch and yaw torque with angular acceleration.

    Args:
        lagged: of `lagged_motion`.
        vehicle: whose geometry and order are judged.
        other: what explains the motion better, of `better_description`, if anything does.
    """
    check = partial(Check, "motor_order")
    if isinstance(lagged, str):
        return check(UNKNOWN, lagged)
    if lagged.still:
        return check(UNKNOWN, "too little rotation to check the motor order")
    (own,) = _correlations(lagged.fast, vehicle, [tuple(range(len(vehicle.rotors)))], 1.0)
    numbers = {f"correlation_{axis}": float(c) for axis, c in zip(("roll", "pitch", "yaw"), own, strict=True)}
    check = partial(check, numbers=numbers | ({} if other is None else {"turned_rad": other.turned}))
    text = f"correlation of torque and angular acceleration: roll {own[0]:.2f}, pitch {own[1]:.2f}, yaw {own[2]:.2f}"
    if other is not None:
        r, p, y = other.correlation
        return check(ERROR, f"{text}; {other.told} ({r:.2f}, {p:.2f}, {y:.2f})", other.fix)
    if min(own[0], own[1]) <= _SETTLED:
        return check(UNKNOWN, f"{text}: too weak to judge")
    # Pairs of more than four rotors whose spins, the other way, explain all that a tilted gyro does: their torques add
    # up to roll and pitch, which `_spins` takes out.
    if len(vehicle.rotors) > 4:
        pairs = list(combinations(range(len(vehicle.rotors)), 2))
        now = [_drag_explains(lagged.slow, vehicle, alone) for alone in (False, True)]
        found = [_drag_explains(lagged.slow, _built(vehicle, spun=pair), alone=False) for pair in pairs]
        least, gains = max(_gain(np.array(now)[:, None]) + [_GAIN, -_CHANGE]), _gain(np.array(found)[:, None])
        if tilted := [pair for pair, more in zip(pairs, gains, strict=True) if more > least]:
            pair = _listed(tilted)
            as_if = f"yaw follows roll and pitch as if rotor {pair} turned the other way, or the gyro were tilted"
            return check(WARNING, f"{text}; {as_if}", f"check the spins of rotor {pair}, and how the IMU is mounted")
    return check(OK, text)


def better_description(lagged: Lagged | str, vehicle: Vehicle) -> Other | None:
    """The order of the log's columns, spins or turn of the frame with which torque follows the motion much better.

    The gain is that of a likelihood, sum of -log(1 - correlation^2) over roll, pitch and yaw, less `_CHANGE` for each
    thing that is changed; None where nothing gains enough, or the better correlation is weak, too.
    """
    if isinstance(lagged, str) or lagged.still:
        return None
    grams, rotors = lagged.fast, tuple(range(len(vehicle.rotors)))

    def named(angle: float, order: Order, sign: float, axes: FloatArray) -> tuple[float, float, Order, FloatArray]:
        """Gain, turn, order and correlations; two motors exchanged, or another way of counting, beat a muddle."""
        moved = sum(k != place for k, place in enumerate(order))
        simple = moved == 2 or len(order) <= _MOST_ROTORS or order in _orders(len(order))
        changes = 0.0 if not moved else 1.2 if simple else 1.2 + 0.1 * moved
        changes += (sign < 0.0) + 1.5 * (angle != 0.0)
        return float(_gain(axes)) - _CHANGE * changes, angle, order, axes

    tried = [
        named(0.0, order, sign, axes)
        for sign in (1.0, -1.0)
        for order, axes in _best(grams, vehicle, _orders(len(rotors)), sign)
    ]
    own = max((one for one in tried if one[2] == rotors), key=lambda one: one[0])
    # The most likely orders, and the own one, with the frame turned as roll and pitch then answer.
    for order in {rotors, *(one[2] for one in sorted(tried, key=lambda one: -one[0])[:8])}:
        angle = _answer(grams, reordered(vehicle, order))[2]
        if abs(angle) > math.radians(20.0):  # a smaller turn is none
            for sign in (1.0, -1.0):
                (axes,) = _correlations(grams, _rotated(vehicle, angle), [order], sign)
                tried.append(named(angle, order, sign, axes))
    # What is right explains neither roll nor pitch worse: one axis may be bought with the other.
    fair = [one for one in tried if np.mean(one[3][:2]) >= _SETTLED and np.all(one[3][:2] > own[3][:2] - 0.1)]
    best = max(fair, key=lambda one: one[0], default=own)
    least = _GAIN - 1.5 * _CHANGE * (best[1] != 0.0)  # what a turn costs only puts it behind an order
    _, angle, order, axes = best if best[0] - own[0] >= least else own
    new = reordered(_rotated(vehicle, angle) if angle else vehicle, order)
    spins, yaw = _spins(lagged, new)
    if not angle and order == rotors and (min(axes[0], axes[1]) < _SETTLED or not spins):
        return None
    axes = np.append(axes[:2], yaw)
    # By the same measure, with yaw judged by drag alone, it must be better, too.
    gained = _gain(axes) - _gain(np.append(own[3][:2], _drag_explains(lagged.slow, vehicle)))
    if gained <= (least if angle or order != rotors else 0.0):
        return None
    told, fix = [], []
    if angle:
        degrees = math.degrees(angle)
        told.append(f"the vehicle answers as if its rotors stood {degrees:+.0f} deg further about z")
        fix.append(f"turn the rotor positions of the vehicle file by {degrees:+.0f} deg (x towards y)")
    if order != rotors:
        columns = ", ".join(str(i + 1) for i in order)
        told.append(f"much better with the log's columns in the order {columns}")
        fix.append(f"reorder the rotors of the vehicle file to take columns {columns}")
    if spins == [rotors]:
        told.append("yaw is reversed")
        fix.append("negate the spins in the vehicle file")
    elif spins:
        which = _listed(spins)
        told.append(f"rotor {which} {'turns' if max(map(len, spins)) == 1 else 'turn'} the other way")
        fix.append(f"negate the spin of rotor {which} in the vehicle file")
    return Other(_built(new, spun=spins[0]) if spins else new, " and ".join(told), " and ".join(fix), axes, angle)


def _orders(rotors: int) -> list[Order]:
    own = tuple(range(rotors))
    if rotors <= _MOST_ROTORS:
        return list(permutations(own))
    turns = [own[i:] + own[:i] for i in range(rotors)]
    return turns + [turn[::-1] for turn in turns]


def _best(grams: Sequence[_Gram], vehicle: Vehicle, orders: list[Order], sign: float) -> list[tuple[Order, FloatArray]]:
    """Orders with their correlations at their best lag; of many rotors also what exchanges of two lead to."""
    out = list(zip(orders, _correlations(grams, vehicle, orders, sign), strict=True))
    while len(vehicle.rotors) > _MOST_ROTORS:
        order, axes = max(out, key=lambda one: _gain(one[1]))
        near = []
        for i, j in combinations(range(len(order)), 2):
            exchanged = list(order)
            exchanged[i], exchanged[j] = order[j], order[i]
            near.append(tuple(exchanged))
        closer = list(zip(near, _correlations(grams, vehicle, near, sign), strict=True))
        out += closer
        if max(_gain(one[1]) for one in closer) < _gain(axes) + 1e-3:
            break
    return out


def _gain(correlation: FloatArray) -> FloatArray:
    """Likelihood by which correlations (…, 3) explain the motion; a negative one counts against; shape (…,)."""
    bounded = np.clip(correlation, -0.999, 0.999)
    return np.asarray(-np.sum(np.log1p(-np.sign(bounded) * bounded**2), axis=-1))


def _correlations(grams: Sequence[_Gram], vehicle: Vehicle, orders: Sequence[Order], sign: float) -> FloatArray:
    """Correlation of torque and angular acceleration at each order's best lag, shape (orders, 3); spins times `sign`.

    Orders in which the rotors' torques cancel, by commands that a mixer makes of four, explain nothing.
    """
    arms = vehicle.torque_arms[np.argsort(orders, axis=1)] * [1.0, 1.0, sign]
    found = []
    for gram in grams:
        along = np.einsum("ora,ra->oa", arms, gram.motion)
        power = np.einsum("ora,rq,oqa->oa", arms, gram.thrust, arms, optimize=True)
        # Less power beside that of the rotors one by one is rounding.
        least = 1e-3 * np.einsum("ora,r->oa", arms**2, np.diag(gram.thrust)) + 1e-300
        found.append(along / np.sqrt(np.maximum(power, least) * np.maximum(gram.power, 1e-300)))
    at_lag = np.array(found)
    return np.asarray(at_lag[_gain(at_lag).argmax(axis=0), np.arange(len(orders))])


def _spins(lagged: Lagged, vehicle: Vehicle) -> tuple[list[Order], float]:
    """Alternatives of rotors (from 0) that turn the other way: one, two or all; or none.

    Also returns the correlation of yaw acceleration and drag that the change gives.
    """
    count = len(vehicle.rotors)
    turned = [which for size in (0, 1, 2, count) for which in combinations(range(count), size)]
    found = np.array([_drag_explains(lagged.slow, _built(vehicle, spun=which)) for which in turned])
    wrong = np.array([len(which) for which in turned])
    # Without turning on purpose, what yaw follows is a matter of chance.
    gain = np.where(found > 2.0 * _SETTLED, _gain(found[:, None]) - _CHANGE * wrong.clip(max=2), -np.inf)
    best = int(np.argmax(gain[1:])) + 1
    # Neither yaw acceleration nor drag is white: independent samples in their correlation are fewer, after M. S.
    # Bartlett, Journal of the Royal Statistical Society 98 (1935) 536.
    both = _yaw_and_drag(lagged.slow, _built(vehicle, spun=turned[best]), True)
    rows = both.shape[1]
    memory = np.fft.irfft(np.abs(np.fft.rfft(both, 2 * rows)) ** 2)[:, :rows] / (
        np.sum(both**2, axis=1)[:, None] + 1e-300
    )
    independent = rows / max(2.0 * float(memory[0] @ memory[1]) - 1.0, 1.0)
    own, chance = _gain(found[:1]), exceeded(5e-3, 1) / independent  # chance gains more once in 200 logs
    if gain[best] <= own or _gain(found[best : best + 1]) <= own + chance:
        return [], float(found[0])
    # Roll and pitch show which of them it is, but for partners on one arm: they have one command.
    near = 1 + np.flatnonzero(gain[1:] > gain[best] - max(_CHANGE, chance))
    whole = _gain(np.array([[_drag_explains(lagged.slow, _built(vehicle, spun=turned[k]), alone=False)] for k in near]))
    return [turned[k] for k in near[whole > whole.max() - _CHANGE]], float(found[best])


def _drag_explains(slow: Rows, vehicle: Vehicle, alone: bool = True) -> float:
    """Correlation of yaw acceleration with the drag of the rotors; 0 where all turn the same way, or little is flown.

    What follows spin-up of any rotor has no part in it: a loop against disturbances makes drag look reversed by it, and
    motors that lag by less than a row or two answer by it.  All spins are judged without the same motion: were it only
    the spin-up by the spins at hand, others would keep what these lose.  Nor, `alone`, has what follows roll and pitch:
    a tilted gyro makes it.
    """
    yaw, drag = _yaw_and_drag(slow, vehicle, alone)
    return float(yaw @ drag / np.sqrt(yaw @ yaw * (drag @ drag) + 1e-300))


def _yaw_and_drag(slow: Rows, vehicle: Vehicle, alone: bool) -> FloatArray:
    """Yaw acceleration and drag torque over b without what `_drag_explains` leaves out, shape (2, n); else zeros."""
    squares, motion, spun = slow
    if len(squares) < 100 or len(set(vehicle.spins)) < 2:
        return np.zeros((2, 1))
    both = np.column_stack([motion[:, 2], squares @ vehicle.torque_arms[:, 2]])
    others = np.linalg.qr(np.column_stack([*motion[:, : 2 * alone].T, spun]))[0]
    return np.asarray((both - others @ (others.T @ both)).T)


def _answer(grams: Sequence[_Gram], vehicle: Vehicle) -> tuple[FloatArray, float, float]:
    """Answer in roll and pitch to torque over b: inertia times acceleration = A torque, A = k R(alpha) least-squares.

    Returns:
        At the lag that explains most: its shares of the variance of roll and pitch, (2,); k, b times the factor by
        which arms (or inertias) are wrong; and alpha [rad]: the frame stands so much further about z.
    """
    arms, inertia, found = vehicle.torque_arms[:, :2], vehicle.initial[2:4], []
    for gram in grams:
        cross = arms.T @ gram.motion[:, :2] * inertia
        a = np.linalg.lstsq(arms.T @ gram.thrust @ arms, cross, rcond=None)[0]
        along, across = 0.5 * (a[0, 0] + a[1, 1]), 0.5 * (a[0, 1] - a[1, 0])
        explained = np.sum(a * cross, axis=0) / (gram.power[:2] * inertia**2 + 1e-300)
        found.append((np.asarray(explained), math.hypot(along, across), math.atan2(across, along)))
    return max(found, key=lambda answer: float(np.sum(answer[0])))


def reordered(vehicle: Vehicle, order: Order) -> Vehicle:
    """The vehicle whose rotor k is on column `order[k]` of the log, written for the log's columns."""
    return vehicle.model_copy(update={"rotors": tuple(vehicle.rotors[order.index(k)] for k in range(len(order)))})


def _built(vehicle: Vehicle, places: Mapping[int, FloatArray] | None = None, spun: Order = ()) -> Vehicle:
    """The vehicle with some rotors, counted from 0, at other places (x, y) [m], or with their spins the other way."""
    rotors, places = list(vehicle.rotors), places or {}
    for k in {*places, *spun}:
        x, y = np.asarray(places.get(k, rotors[k].position[:2])).tolist()
        spin = -rotors[k].spin if k in spun else rotors[k].spin
        rotors[k] = rotors[k].model_copy(update={"position": (x, y, rotors[k].position[2]), "spin": spin})
    return vehicle.model_copy(update={"rotors": tuple(rotors)})


def _rotated(vehicle: Vehicle, angle: float) -> Vehicle:
    """The vehicle with its rotor positions turned about z by an angle [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    return _built(vehicle, dict(enumerate(vehicle.rotor_positions[:, :2] @ [[cos, sin], [-sin, cos]])))


def _listed(rotors: Sequence[Order]) -> str:
    """Alternatives of rotors, for people: "1 and 2 or 4"."""
    return " or ".join(" and ".join(str(k + 1) for k in one) for one in rotors)


# --- Mass and rotor positions against what the flight shows, as far as physics reveals them
#
# Mass and thrust coefficient only ever show as their ratio, arm and inertia likewise.  So a wrong mass is seen when
# the thrust coefficient is known (thrust stand, or a sigma of its own), a wrong arm when the inertias are known too;
# that the whole frame is turned is seen always.


_SHARE, _SPREAD = 0.2, (0.25, 0.2, 0.2)
"""J_xx over mass and squared arm of most vehicles (0.11 of a heavy octocopter, 0.32 of a light one), and how far it,
guesses of inertia and guesses of b spread (standard deviations of the logarithm, on twenty vehicles)."""


def mass_check(log: Log) -> Check | None:
    """Weighs the vehicle by its known thrust coefficient; None where that is not known or nothing flew."""
    vehicle, known = log.vehicle, log.vehicle.stand_thrust or _known(log.vehicle, "b")
    from_hover = log.once(hover_check).numbers.get("b_from_hover", 0.0)
    if known is None or from_hover <= 0.0:
        return None
    # Mean thrust over weight in flight, by the accelerometer; 1 where that is implausible
    accel, load = log.recording.channels.get("accel"), 1.0
    if accel is not None and (inside := within(accel.t, log.spans)).any():
        felt = -float(np.mean(accel.values[inside, 2])) / GRAVITY
        load = felt if 0.8 < felt < 1.5 else 1.0
    b, sigma = known
    factor = b / from_hover / load
    mass = factor * vehicle.mass
    check = partial(Check, "mass", numbers={"mass_factor": factor, "mass_kg": mass})
    message = (
        f"the known thrust coefficient {b:.3g} N s^2/rad^2 carries {mass:.3g} kg, {factor:.3f} times the stated mass"
    )
    if abs(factor - 1.0) <= max(0.08, 3.0 * sigma):
        return check(OK, message)
    fix = f"weigh the vehicle: {mass:.3g} kg would fit; or check the thrust stand and the unit of the rotor speeds"
    return check(WARNING, message, fix, off=_heavier(1.0 / factor))


def _known(vehicle: Vehicle, name: str) -> tuple[float, float] | None:
    """A parameter and its relative standard deviation, where that is a tenth at most."""
    prior = vehicle.parameters[name]
    return (
        None
        if prior.sigma is None or prior.sigma > 0.1 * prior.initial
        else (prior.initial, prior.sigma / prior.initial)
    )


def geometry_check(log: Log) -> Check:
    """Roll and pitch acceleration (of `lagged_motion`) against the torque that the stated rotor positions give.

    With the b that carries the weight, inertia over mass and squared arm follows: where no vehicle has it, the arm is
    asked for.
    """
    vehicle, lagged, check = log.vehicle, log.once(lagged_motion), partial(Check, "geometry")
    if isinstance(lagged, str):
        return check(UNKNOWN, lagged)
    shares, scale, angle = _answer(lagged.fast, vehicle)
    explained = float(np.min(shares))
    if explained < 0.1:
        axis = ("roll", "pitch")[int(np.argmin(shares))]
        few = f"rotor torques explain only {explained:.0%} of the {axis} motion: too little to judge positions"
        return check(UNKNOWN, few)
    numbers = {"turned_rad": angle, "explained": explained}
    turned = f"rotor positions agree with the motion within {abs(math.degrees(angle)):.0f} deg"
    thrust = vehicle.stand_thrust or _known(vehicle, "b")
    if thrust is None or not all(_known(vehicle, name) for name in ("J_xx", "J_yy")):
        hover = log.once(hover_check).numbers.get("b_from_hover", 0.0)
        message = f"{turned}; the arm itself shows only relative to the inertia"
        return _unlikely(vehicle, scale, hover, numbers) or check(OK, message, numbers=numbers)
    factor = scale / thrust[0]
    check = partial(check, numbers={**numbers, "arm_factor": factor})
    if abs(factor - 1.0) <= 0.2:
        return check(OK, f"{turned}, the arm within {abs(factor - 1.0):.0%}")
    message = (
        f"roll and pitch answer {factor:.2f} times as strongly as the stated arm of {vehicle.arm:.3g} m lets expect"
    )
    fix = f"measure the arm: {factor * vehicle.arm:.3g} m, {factor:.2f} times it, would fit; or the inertias are wrong"
    return check(WARNING, message, fix, off=estimates_off(torque=(factor, factor, 1.0)))


def _unlikely(vehicle: Vehicle, scale: float, hover: float, numbers: dict[str, float]) -> Check | None:
    """A question where another arm, or another mass, makes thrust, size and inertia more likely together; else None.

    Weight gives b, and motion with it the inertia about x and y: with the stated arm over its true one, a, and m of the
    mass, inertia over mass and squared arm comes out 1 / a times, over its guess a m times, b over its guess m times.
    """
    if vehicle.command.kind != "rotor_speed" or not hover > 0.0 or not scale > 0.0:
        return None
    inertia = float(np.mean(vehicle.initial[2:4])) * hover / scale
    guessed, size = vehicle.parameters["b"].initial, inertia / (vehicle.mass * vehicle.arm**2)
    off = np.log([size / _SHARE, hover / scale, hover / guessed])
    # How far vehicles and guesses spread; what noise or lag takes from the motion is in both inertias alike.
    hidden = math.log(max(numbers["explained"], 1e-3)) ** 2 + (0.01 if vehicle.command.sampling == "held" else 0.0)
    weights = np.linalg.inv(np.diag(np.square(_SPREAD)) + hidden * np.outer([1.0, 1.0, 0.0], [1.0, 1.0, 0.0]))
    ways = np.array([[-1.0, 1.0, 0.0], [0.0, 1.0, 1.0]])
    power = np.einsum("ki,ij,kj->k", ways, weights, ways)
    found = ways @ weights @ off / power
    surprise = np.abs(found) * np.sqrt(power)
    # What is so likely is asked for: both where either would do, for nothing shows which, or that both are wrong.
    asked = np.flatnonzero(surprise >= 1.9)
    if not len(asked):
        return None
    stated, fits, doubts = [], [], []
    for k in asked.tolist():
        kind, now, unit = (("arm", vehicle.arm, "m"), ("mass", vehicle.mass, "kg"))[k]
        low, high = now * np.exp(-found[k] + np.array([-2.0, 2.0]) / np.sqrt(power[k]))
        stated.append(f"the {kind} {now:.3g} {unit}")
        fits.append(f"the {kind}: {low:.2g} to {high:.2g} {unit} would fit")
        farther = math.exp(-found[k])
        doubts.append(_heavier(1.0 / farther) if k else estimates_off(torque=(farther, farther, 1.0)))
    message = (
        f"{'are' if len(stated) > 1 else 'is'} {' and '.join(stated)} right? Weight and motion make the inertia about "
        f"x and y {size:.2g} times mass times arm squared ({_SHARE:g} on most vehicles) and {hover / scale:.2g} times "
        f"its guess, and b {hover / guessed:.2g} times its guess"
    )
    doubt = farthest(doubts) if surprise.max() > 2.5 else {}  # then intervals hold it, too
    return Check("geometry", WARNING, message, f"measure {', and '.join(fits)}", {**numbers, "size": size}, doubt)
