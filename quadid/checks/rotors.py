"""Checks of rotor signals, mass and geometry against each other and the motion."""

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from itertools import combinations, permutations
from typing import NamedTuple

import numpy as np

from quadid.checks.findings import Check, CheckResult, Off, estimates_off, farthest, rotors_off
from quadid.checks.motion import HOPELESS, Spans, is_turning, within
from quadid.chi_square import exceeded
from quadid.data.grid import bridged, linear, moving_mean, to_windows
from quadid.data.rotor_signal import INERTIA_RATE, RotorSignal, rotor_channel, rotor_signal
from quadid.data.window import Channel, Recording, Window, measured_period, sample_period, true_runs
from quadid.errors import QuadidError
from quadid.model.layout import ThrustModel, voltage_at
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle

# --- Whether the rotor signal stands in one place in time before the motion that it causes
#
# A motor answers its command late by its lag, always the same; measured speeds come a few milliseconds late.  A lag
# that wanders over the flight is a clock's, not a motor's, and a torque that follows its own effect is a wrong stamp.


_STEP = 0.01
"""Lags are compared at multiples of this [s]; the peak is found between them."""
_FARTHEST = 25
_BLOCK = 7.5
_QUIET = 0.1
"""A block with less than this share of the motion of the liveliest is a hover: what disturbs it has lags of its own."""
_CLEAR = 0.3
"""Correlation above which the peak of a block counts."""
_ABOUT = -0.45, 0.45, -0.9, 0.9, -1.35, 1.35, -1.8, 1.8
"""Lags [s] about which peaks are looked for where none is clear near 0."""
_LATE, _TOO_LATE = 0.015, 0.025
"""Torque after its effect [s] that is named, and that is refused."""


class _Peak(NamedTuple):
    """Lag [s] of angular acceleration behind the torque in one block, correlation there, and size of the motion."""

    lag: float
    correlation: float
    motion: float


def rotor_timing_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check:
    """Lag between roll and pitch torque and angular acceleration, block by block, and how far it wanders."""
    name = "rotor_timing"
    gyro = recording.channels.get("gyro")
    if gyro is None or not spans:
        return Check(name, CheckResult.UNKNOWN, "needs gyro and rotor signal in flight")
    signal = rotor_signal(recording, vehicle)
    slowest = max(measured_period(signal.t, signal.values), sample_period(gyro.t))
    if not slowest <= 1.0 / INERTIA_RATE:
        return Check(name, CheckResult.UNKNOWN, "rotor signal or gyro too slow to place them in time")
    found = _placed(signal, gyro, vehicle, spans, slowest, 0.0)
    if found is None:
        return Check(name, CheckResult.UNKNOWN, "too little flight to place the rotor signal in time")
    if found.correlation < 0.5:  # a clock of its own may be seconds off
        far = (_placed(signal, gyro, vehicle, spans, slowest, about) for about in _ABOUT)
        found = next((one for one in far if one is not None and one.sure), found)
    lags, placed, correlation = found.lags, found.clear, found.correlation
    clear = lags[placed]
    numbers = {"correlation": correlation}
    if len(clear) < max(2, found.lively // 2):
        message = f"torque and angular acceleration correlate by {correlation:.2f} only, at any lag"
        return Check(name, CheckResult.UNKNOWN, message, "fly with more roll and pitch motion", numbers)
    # Lags of each axis about their own median, for other motion excites it; a clock moves both alike.
    own = [np.median(lags[placed[:, axis], axis]) if placed[:, axis].any() else 0.0 for axis in range(2)]
    both = placed.any(axis=1)
    about = np.average(lags - own, axis=1, weights=placed + 1e-12)[both]
    low, high = np.quantile(about, [0.1, 0.9])
    lag = float(np.median(clear))
    numbers |= {"lag_s": lag, "wander_s": float(high - low)}
    message = (
        f"torque and angular acceleration correlate by {correlation:.2f} at a lag of {1e3 * lag:.0f} ms, "
        f"which wanders by {1e3 * (high - low):.0f} ms"
    )
    fix = "stamp the rotor signal by the clock that stamps the IMU, or log both on board"
    if high - low > 0.02 and correlation < 0.5:
        weak = f"{message}: too weak to be sure that it is the clock"
        return Check(name, CheckResult.UNKNOWN, weak, numbers=numbers)
    if high - low > 0.02:  # [s]; a centre of gravity a tenth of the arm off makes 16 ms
        return Check(name, CheckResult.ERROR, f"{message}: the rotor signal is not in time with the gyro", fix, numbers)
    if -_TOO_LATE < lag < -_LATE:
        smoothed = f"{message}: rotor speeds are late, or the states were smoothed without a delay"
        return Check(
            name, CheckResult.WARNING, smoothed, "log raw states; `rotor_telemetry_delay` models a delay", numbers
        )
    if lag < -_LATE:
        return Check(name, CheckResult.ERROR, f"{message}: the rotor signal lags its effect", fix, numbers)
    if lag > 0.2:
        return Check(name, CheckResult.ERROR, f"{message}: no motor answers that late", fix, numbers)
    return Check(name, CheckResult.OK, message, numbers=numbers)


class _Placed(NamedTuple):
    """Lags of roll and pitch by block [s], which are clear, both (blocks, 2); lively ones and their correlation."""

    lags: FloatArray
    clear: BoolArray
    lively: int
    correlation: float

    @property
    def sure(self) -> bool:
        """True where most lags are clear and one: no chance places them so."""
        own = self.lags[self.clear]
        return self.correlation > 0.7 and 2 * len(own) > self.lively > 1 and bool(np.ptp(own) < 2.0 * _LATE)


def _placed(
    signal: RotorSignal, gyro: Channel, vehicle: Vehicle, spans: Spans, slowest: float, about: float
) -> _Placed | None:
    """Peaks of every block near a lag [s] of signals that come every so often [s]; None without a block."""
    # Rows that no block takes are not read for each: the check of a long log takes time by its length.
    width, blocks = _smoothing(slowest), list[list[_Peak]]()
    for times in _blocks(spans):
        answered = _answered(signal._replace(t=signal.t + about), gyro, vehicle, times)
        torque, motion = (_quick(rows, width) for rows in answered)
        near = [_peak(torque[:, axis], motion[:, axis]) for axis in range(2)]
        blocks.append([peak._replace(lag=peak.lag + about) for peak in near])
        clearest = max(near, key=lambda peak: peak.correlation)
        if clearest.correlation > 0.5 and abs(clearest.lag) > 0.1:  # a clock that drifts leaves what is searched
            about += clearest.lag
    if not blocks:
        return None
    lags, scores, sizes = (np.array([[peak[k] for peak in axes] for axes in blocks]) for k in range(3))
    lively = sizes >= _QUIET * sizes.max(axis=0)
    return _Placed(lags, lively & (scores > _CLEAR), int(lively.sum()), float(np.median(scores[lively])))


def accel_timing_check(recording: Recording, vehicle: Vehicle, spans: Spans, timing: Check | None) -> Check | None:
    """A warning where the accelerometer answers the rotors at another time than the gyro does, else None.

    Args:
        recording: the log.
        vehicle: whose rotors they are.
        spans: when it flew [s].
        timing: of `rotor_timing_check`.
    """
    accel, signal = recording.channels.get("accel"), rotor_signal(recording, vehicle)
    if accel is None or timing is None or "lag_s" not in timing.numbers:
        return None
    width = _smoothing(max(measured_period(c.t, c.values) for c in (signal, accel)))
    peaks = []
    for at in _blocks(spans):
        felt, speeds = _around(accel.t, at), _around(signal.t, at)
        force = -linear(accel.t[felt], accel.values[felt, 2:], at)
        thrust = np.sum(linear(signal.t[speeds], signal.values[speeds] ** 2, at), axis=1, keepdims=True)
        peaks.append(_peak(*(_quick(rows, width)[:, 0] for rows in (thrust, force))))
    clear = [peak.lag for peak in peaks if peak.correlation > _CLEAR + 0.1]
    late = float(np.median(clear)) - timing.numbers["lag_s"] if clear and 2 * len(clear) >= len(peaks) else 0.0
    if abs(late) < _LATE:
        return None
    later, sooner = ("accelerometer", "gyro") if late > 0.0 else ("gyro", "accelerometer")
    message = f"{later} answers the rotors {1e3 * abs(late):.0f} ms after the {sooner}"
    fix = f"stamp the {later} when it is measured, and log it without a filter"
    return Check("accel_timing", CheckResult.WARNING, message, fix, {"late_s": late})


def _smoothing(slowest: float) -> int:
    """Rows over which signals that come every so often [s] are smoothed."""
    return max(3, round(2.5 * slowest / _STEP) | 1)


def rotors_earlier(recording: Recording, seconds: float) -> Recording:
    """The recording with its rotor signals so much earlier."""
    rotors = {n: c for n, c in recording.channels.items() if n in ("rotor_speed", "motor_command")}
    earlier = {name: replace(channel, t=channel.t - seconds) for name, channel in rotors.items()}
    return replace(recording, channels={**recording.channels, **earlier})


def _blocks(spans: Spans) -> list[FloatArray]:
    """Times on a uniform grid, in blocks of about `_BLOCK` seconds of uninterrupted flight."""
    out = []
    for a, b in spans:
        parts = max(1, int((b - a) // _BLOCK))
        bounds = np.linspace(a, b, parts + 1)
        out += [np.arange(c, d, _STEP) for c, d in zip(bounds[:-1], bounds[1:], strict=True)]
    return [times for times in out if len(times) > 8 * _FARTHEST]


def _answered(signal: RotorSignal, gyro: Channel, vehicle: Vehicle, at: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Roll and pitch torque over b and angular acceleration at the times of a block, both (n, 2)."""
    turning, speeds = _around(gyro.t, at), _around(signal.t, at)
    rates = linear(gyro.t[turning], gyro.values[turning, :2], at)
    squares = linear(signal.t[speeds], signal.values[speeds] ** 2, at)
    return squares @ vehicle.torque_arms[:, :2], np.gradient(rates, _STEP, axis=0)


def _around(t: FloatArray, at: FloatArray) -> slice:
    """Samples that straight lines to the times of a block need, of increasing times."""
    return slice(max(int(np.searchsorted(t, at[0], side="right")) - 1, 0), int(np.searchsorted(t, at[-1])) + 1)


def _quick(values: FloatArray, width: int) -> FloatArray:
    """Band of frequencies that both signals hold: smoothed over `width` rows, slow motion left out."""
    smooth = moving_mean(values, width)
    return np.asarray(smooth - moving_mean(smooth, round(_SLOW_MOTION / _STEP) | 1, mirrored=True))


def _peak(torque: FloatArray, motion: FloatArray) -> _Peak:
    n, far = len(torque), _FARTHEST
    later = motion[far : n - far]
    rows = [torque[far - k : n - far - k] for k in range(-far, far + 1)]
    scores = np.array([row @ later / np.sqrt(row @ row * (later @ later) + 1e-300) for row in rows])
    best = int(np.argmax(scores))
    shift = 0.0
    if 0 < best < 2 * far:
        before, here, after = scores[best - 1 : best + 2]
        shift = 0.5 * float((before - after) / (before - 2.0 * here + after))
    return _Peak((best - far + shift) * _STEP, float(scores[best]), float(np.std(later)))


_OCTAVES = 1.0, 1.5, 2.25, 3.4, 5.0, 7.5, 11.0
"""Edges of bands [Hz] in which the motion that torque makes is compared: its size over that of the torque."""
_FLAT = 0.4
"""Share of a slower band's answer that is left where the gyro was filtered; bodies answer torque alike at each."""


def gyro_filter_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check | None:
    """A warning where the gyro hardly answers quick torque that it answers when slow: it was low-passed; else None.

    What makes motion small makes it late, motors and sensors alike; only smoothing of a log does not.  With measured
    speeds no motor is between torque and motion, and what is late is the gyro's filter.
    """
    gyro = recording.channels.get("gyro")
    if gyro is None or not spans:
        return None
    signal = rotor_signal(recording, vehicle)
    rows = round(2.0 / _STEP)
    spectra = []
    for at in _blocks(spans):
        parts = np.hstack(_answered(signal, gyro, vehicle, at))
        parts = np.lib.stride_tricks.sliding_window_view(parts, rows, axis=0)[:: rows // 2]
        spectra.append(np.fft.rfft((parts - parts.mean(axis=-1, keepdims=True)) * np.hanning(rows)))
    if sum(map(len, spectra)) < 5:
        return None
    torque, motion = np.split(np.concatenate(spectra), 2, axis=1)
    cross, acted, turned = (
        np.sum(x, axis=0) for x in (motion * torque.conj(), np.abs(torque) ** 2, np.abs(motion) ** 2)
    )
    if not min(acted[1:].min(), turned[1:].min()) > 0.0:  # no torque, or no motion at all
        return None
    place = np.digitize(np.fft.rfftfreq(rows, _STEP), _OCTAVES)
    slowest = max(measured_period(signal.t, signal.values), sample_period(gyro.t))
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
    if left > _FLAT or not (smoothed or measured):
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
    return Check("gyro_source", CheckResult.WARNING, message, fix, {"left": left, "lag_rad": lag}, off)


# --- Rotor signals against each other, the thrust felt and the motion: dead, stuck, halved, and out of time
#
# All checks need flight only, no fit: a rotor that reads nothing, holds one value or half its speed, thrust per speed
# squared that changes by more than any battery or payload makes it, and torque that does not stand in one fixed place
# in time before the angular acceleration that it causes.


_BIN = 0.5
"""Means over this long [s] are compared: fast motion has passed by then."""
_LEVELS = 40
"""Rotors that read fewer different values may be too coarse."""
_STUCK = 1.0
"""A rotor that holds one value this long [s] while the vehicle moves is stuck …"""
_MOVING = 0.1
"""… by rates that vary so much [rad/s]."""

Bins = tuple[FloatArray, BoolArray]
"""Means (m, columns) and which bins hold samples (m,)."""


Problem = tuple[str, dict[str, float]]
_NAME = "rotor_speed"
_FIX = "repair that sensor or its wiring, leave it out with motor commands, or use the part of the flight before it"
_COMMANDED = "these are commands: a damaged rotor is driven harder, which `quadid health` measures; or they mean thrust"


def readings_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check | None:
    """A rotor that reads nothing or holds one value, all that read the same, coarse steps; None for none of these."""
    try:
        signal = rotor_signal(recording, vehicle)
    except QuadidError:
        return None
    inside = within(signal.t, spans)
    if np.count_nonzero(inside) < 20:
        return None
    # A command may rest for half of the flight, a speed for a twentieth.
    commands = _commanded(recording, vehicle)
    most = 0.5 if commands else 0.05
    values = signal.values[inside]
    if problem := _other_unit(values):
        return Check(_NAME, CheckResult.ERROR, f"{problem[0]} ({signal.source})", "log all in one unit", problem[1])
    problem = _dead(values, most) or _same(values, vehicle, commands)
    step, noise = _coarse(signal.t[inside], values)
    if step and not problem:  # such a signal rests between its steps
        return Check(
            _NAME,
            CheckResult.WARNING,
            f"rotor speeds come in steps of {step:.3g} rad/s: too coarse for the motion ({signal.source})",
            "log them finer, or motor commands",
            {"step_rad_s": step},
            estimates_off(torque=[1.0 / (1.0 + noise)] * 3, spinning=1.0 / (1.0 + noise)),
        )
    problem = problem or _stuck(signal, recording, inside)
    fix = "check which outputs drive the motors, and that all of them were logged" if commands else _FIX
    return problem and Check(_NAME, CheckResult.ERROR, f"{problem[0]} ({signal.source})", fix, problem[1])


def _coarse(t: FloatArray, speeds: FloatArray) -> tuple[float, float]:
    """Step [rad/s] between the few values that rotors read, and power of its noise over that of their quick motion.

    0 where the step is finer than half of that motion: then noise in the torque makes inertias 2 % too large.
    """
    levels = [np.unique(column) for column in speeds.T]
    if max(map(len, levels)) > _LEVELS or min(map(len, levels)) < 3:
        return 0.0, 0.0
    step = float(np.median(np.concatenate([np.diff(values) for values in levels])))
    quick = speeds - moving_mean(speeds, round(_SLOW_MOTION / sample_period(t)) | 1, mirrored=True)
    noise = step**2 / 12.0
    share = noise / max(float(np.median(np.var(quick, axis=0))) - noise, 0.1 * noise)
    return (step, share) if share > 0.02 else (0.0, 0.0)


def _other_unit(speeds: FloatArray) -> Problem | None:
    """A rotor that turns, and reads five times what the others read, or a fifth: no balance is so far."""
    usual = np.median(np.abs(speeds), axis=0)
    for rotor, own in enumerate(usual):
        others = float(np.median(np.delete(usual, rotor)))
        ratio = own / max(others, 1e-9)
        if np.ptp(speeds[:, rotor]) > 0.0 < own and others > 0.0 and not 0.2 < ratio < 5.0:
            likely = (
                ("in rpm", 30.0 / np.pi),
                ("a square", others),
                ("a command from 0 to 1", 0.5 / others),
                ("in rev/s", 0.5 / np.pi),
            )
            unit = next((f": is it {name}?" for name, r in likely if 0.5 < ratio / r < 2.0), "")
            return f"rotor {rotor + 1} reads {ratio:.3g} times what the others read{unit}", {"rotor": rotor + 1.0}
    return None


def _same(speeds: FloatArray, vehicle: Vehicle, commands: bool) -> Problem | None:
    """Columns that are one: their difference, which turns the vehicle, is lost; one command may go to one axle."""
    places = vehicle.rotor_positions[:, :2]
    for i, j in combinations(range(speeds.shape[1]), 2):
        axle = commands and np.linalg.norm(places[i] - places[j]) < 0.1 * vehicle.arm
        if np.ptp(speeds[:, i]) > 0.0 and np.array_equal(speeds[:, i], speeds[:, j]) and not axle:
            which = f"rotor columns {i + 1} and {j + 1}"
            which = "all rotor columns" if np.all(speeds == speeds[:, :1]) else which
            return f"{which} are the same: one was written for the other", {"rotor": i + 1.0, "other": j + 1.0}
    return None


def _commanded(recording: Recording, vehicle: Vehicle) -> bool:
    channel, _ = rotor_channel(recording, vehicle)
    return channel is not None and channel.name == "motor_command"


def rotor_speed_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check:
    """Each rotor against the others and all against the thrust felt; the first that cannot be true is named."""
    name = _NAME
    signal = rotor_signal(recording, vehicle)
    edges = np.arange(spans[0][0], spans[-1][1] + 0.5 * _BIN, _BIN) if spans else np.empty(0)
    inside = within(signal.t, spans)
    if len(edges) < 4 or np.count_nonzero(inside) < 20:
        return Check(name, CheckResult.UNKNOWN, "too little flight to compare the rotors")
    squares, known = _means(signal.t, signal.values**2, edges, spans)
    problem = (_unbalanced(squares[known], vehicle) if known.any() else None) or _against_thrust(
        recording, squares, known, edges, spans
    )
    if problem is not None and _commanded(recording, vehicle):
        return Check(name, CheckResult.WARNING, f"{problem[0]} ({signal.source})", _COMMANDED, problem[1])
    if problem is not None:
        return Check(name, CheckResult.ERROR, f"{problem[0]} ({signal.source})", _FIX, problem[1])
    return Check(name, CheckResult.OK, "the rotors agree with each other and with the thrust felt")


def _means(t: FloatArray, values: FloatArray, edges: FloatArray, spans: Spans) -> Bins:
    """Means of columns over the bins that lie in flight."""
    row = np.digitize(t, edges)
    count = np.bincount(row, minlength=len(edges) + 1)[1:-1]
    sums = [np.bincount(row, column, minlength=len(edges) + 1)[1:-1] for column in values.T]
    inside = np.any([(edges[:-1] >= a) & (edges[1:] <= b) for a, b in spans], axis=0)
    return np.column_stack(sums) / np.maximum(count, 1)[:, None], np.asarray(inside & (count > 2))


def _dead(speeds: FloatArray, most: float) -> Problem | None:
    """A rotor that reads nothing for a share `most` of the time in which the others turn (else it is closed)."""
    turning = speeds[speeds > 0.0]
    if not len(turning):
        return None
    still = 0.1 * np.median(turning)  # slower, a rotor stands still
    others = np.median(speeds, axis=1) > still
    share = np.mean(speeds[others] < still, axis=0) if others.any() else np.zeros(speeds.shape[1])
    if share.max() < most:
        return None
    rotor = int(np.argmax(share))
    return (
        f"rotor {rotor + 1} reads nothing for {share[rotor]:.0%} of the flight: its speed signal is dead",
        {"rotor": rotor + 1.0, "dead_share": float(share[rotor])},
    )


def _stuck(signal: RotorSignal, recording: Recording, inside: BoolArray) -> Problem | None:
    """A value held while the vehicle moves, unless it is a limit that all rotors share."""
    gyro = recording.channels.get("gyro")
    t, values = signal.t[inside], signal.values[inside]
    if np.ptp(values, axis=0).max() == 0.0 and is_turning(gyro, ((t[0], t[-1]),), _MOVING):
        return (
            "no rotor ever changes its speed, though the vehicle moves: the speed signal is stuck",
            {"stuck_s": float(t[-1] - t[0])},
        )
    for rotor, column in enumerate(values.T):
        others = np.delete(values, rotor, axis=1)
        same = np.append(column[1:] == column[:-1], False) & (column != others.min()) & (column != others.max())
        begin, end = _longest(t, same)
        if end - begin > _STUCK and is_turning(gyro, ((begin, end),), _MOVING):
            return (
                f"rotor {rotor + 1} holds {column[np.searchsorted(t, begin)]:.4g} rad/s for {end - begin:.2g} s of "
                "moving flight: its speed signal is stuck",
                {"rotor": rotor + 1.0, "stuck_s": end - begin},
            )
    return None


def _longest(t: FloatArray, same: BoolArray) -> tuple[float, float]:
    first, end = true_runs(same)
    if not len(first):
        return 0.0, 0.0
    begins, ends = t[first], t[np.minimum(end, len(t) - 1)]
    longest = int(np.argmax(ends - begins))
    return float(begins[longest]), float(ends[longest])


def _unbalanced(squares: FloatArray, vehicle: Vehicle) -> Problem | None:
    """Mean roll and pitch moment of the rotors: half a second without balance turns a vehicle over.

    Of one hovering rotor's moment, a rotor of four that reads half its speed makes 0.75; one that lost 45 % of its
    thrust, and turns faster for it, 0.64.  Yaw is left free, for a vehicle may turn for long.

    One rotor is named.
    """
    lever = vehicle.torque_arms[:, :2] / vehicle.arm
    share = squares / np.maximum(squares.sum(axis=1, keepdims=True), 1e-9)
    odd = np.linalg.norm(share @ lever, axis=1) > 0.72 / (len(lever) - 0.25)
    if odd.mean() < 0.1:
        return None
    found = _misread(np.median(share[odd], axis=0), lever)
    if found is None:
        return "the rotor speeds are far from balance", {"share": float(odd.mean())}
    return (
        f"rotor {found.rotor + 1} reads {found.ratio:.2f} times the speed that balance needs for {odd.mean():.0%} of "
        "the flight",
        {"rotor": found.rotor + 1.0, "speed_ratio": found.ratio, "share": float(odd.mean())},
    )


class _Odd(NamedTuple):
    """Remaining difference of the rotors' shares from each other and from balance, once one rotor is corrected.

    With that rotor (from 0) and its number as believed over that which balance needs.
    """

    misfit: float
    rotor: int
    ratio: float


def _misfit(share: FloatArray, lever: FloatArray) -> float:
    return float(np.hypot(np.std(share), np.linalg.norm(share @ lever)) / np.mean(share))


def _misread(share: FloatArray, lever: FloatArray) -> _Odd | None:
    """The rotor whose square, set to what balance needs, leaves the least, and its speed over that."""
    fits = []
    for rotor, arm in enumerate(lever):
        needed = share.copy()
        needed[rotor] -= float(share @ lever @ arm / (arm @ arm))
        if needed[rotor] > 0.0:
            fits.append(_Odd(_misfit(needed, lever), rotor, float(np.sqrt(share[rotor] / needed[rotor]))))
    return min(fits, default=None)


def balance_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check | None:
    """A warning where rotors balance on the average so far from the centre as a quarter more thrust of one moves it.

    With right files of recorded vehicles it is a fifth at most.  Named is what a rotor's reading or place explains.
    """
    signal = rotor_signal(recording, vehicle)
    inside = within(signal.t, spans)
    if not inside.any() or {"cg_offset", "weak_rotor"} & set(vehicle.effects):
        return None
    speeds = signal.values[inside]
    lever, squares = vehicle.torque_arms[:, :2] / vehicle.arm, np.mean(speeds**2, axis=0)
    share = squares / max(float(squares.sum()), 1e-9)
    off = float(np.linalg.norm(share @ lever))
    read = _misread(share, lever)
    if off < 0.25 / len(lever) or read is None:
        return None
    here = f"the rotors balance {100.0 * off:.2g} % of the arm from the centre, as if rotor"
    check = partial(Check, "balance", CheckResult.WARNING)
    # Each rotor with its arm set to what balance needs, and the arm's length over that
    fits = []
    for rotor, arm in enumerate(lever):
        needed = 1.0 - float(share @ lever @ arm / (share[rotor] * (arm @ arm)))
        if needed > 0.0:
            scale = np.where(np.arange(len(lever)) == rotor, needed, 1.0)[:, None]
            fits.append(_Odd(_misfit(share, lever * scale), rotor, 1.0 / needed))
    if placed := [odd for odd in sorted(fits) if odd < read]:
        farther = " or ".join(f"{odd.rotor + 1} stood {1.0 / odd.ratio:.2f}" for odd in placed)
        return check(
            f"{here} {farther} times as far from it as in the vehicle file: then inertias are wrong, else the centre "
            "of gravity is there",
            "measure where that rotor is, and where the vehicle balances",
            {"off": off, "rotor": placed[0].rotor + 1.0, "arm_ratio": placed[0].ratio},
            farthest([rotors_off(vehicle, speeds, speeds, _moved_rotor(vehicle, odd)) for odd in placed]),
        )
    true = speeds / np.where(np.arange(len(lever)) == read.rotor, read.ratio, 1.0)
    return check(
        f"{here} {read.rotor + 1} read {read.ratio:.2f} times its speed: then b and inertias are wrong, else the "
        "centre of gravity is there",
        "check that rotor's reading, propeller and place in the vehicle file, and where the vehicle balances",
        {"off": off, "rotor": read.rotor + 1.0, "speed_ratio": read.ratio},
        rotors_off(vehicle, speeds, true),
    )


def _moved_rotor(vehicle: Vehicle, odd: _Odd) -> Vehicle:
    """The vehicle with that rotor's arm as balance needs it."""
    rotors = [
        r.model_copy(update={"position": (r.position[0] / odd.ratio, r.position[1] / odd.ratio, r.position[2])})
        if k == odd.rotor
        else r
        for k, r in enumerate(vehicle.rotors)
    ]
    return vehicle.model_copy(update={"rotors": tuple(rotors)})


def _against_thrust(
    recording: Recording, squares: FloatArray, known: BoolArray, edges: FloatArray, spans: Spans
) -> Problem | None:
    accel = recording.channels.get("accel")
    if accel is None:
        return None
    force, felt = _means(accel.t, -accel.values[:, 2:], edges, spans)
    total = squares.sum(axis=1)
    used = known & felt & (total > 0.0)
    if np.count_nonzero(used) < 10:
        return None
    low, high = np.quantile(force[used, 0] / total[used], [0.1, 0.9])
    # A payload of half the weight makes 1.5.
    if low > 0.0 and high < 1.8 * low:
        return None
    ratio = float(high / low) if low > 0.0 else float("inf")
    return (
        f"thrust felt per rotor speed squared changes by a factor of {ratio:.2g} within the flight: "
        "the rotor speeds disagree with the accelerometer",
        {"thrust_range": ratio},
    )


# --- Rotor signals against weight and motion: unit of the speeds, order and spin of the motors


_UNITS = (
    ("in rpm", 2.0 * np.pi / 60.0),
    ("in rev/s", 2.0 * np.pi),
    ("of the electrical field (if 14 poles)", 1.0 / 7.0),
    ("ten times too low, or b to be per rpm^2", 10.0),
    ("in thousands of rpm", 1e3 * 2.0 * np.pi / 60.0),
)
"""Units that speeds may be in instead of rad/s, and the factor that mends each."""
_SLOW_MOTION = 0.4
"""Motion slower than about 1/0.4 s is left out: there aerodynamics and the controller rule [s]."""
_TURNING = 2.0, 0.2
"""Motion about z between these times [s] shows the spins: faster, it is mostly what a loop answers to its own noise."""
_LAGS = 5
"""Motors answer late: torque up to this many rows earlier is tried."""
_SETTLED = 0.25
"""Correlation in roll and pitch that settles an order."""
_GAIN, _CHANGE = 0.3, 0.1
"""Likelihood that another order or frame, or other spins, must gain for each sample; what each change costs."""
_CHANCE = 5e-3
"""Probability with which chance may gain as much."""
_TURNED = 8
"""Orders that are tried with a turned frame, too."""
_MOST_ROTORS = 6
"""Beyond this turns, mirror images and exchanges of the order are tried, not all permutations."""


def hover_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check:
    """Thrust by the vehicle file, with its effects, against weight in flight; separates rpm and rev/s from rad/s."""
    try:
        signal = rotor_signal(recording, vehicle)
    except QuadidError as error:
        return Check("hover", CheckResult.ERROR, error.found, error.fix or f"allowed: {error.allowed}")
    inside = within(signal.t, spans)
    if not inside.any():
        most = float(np.max(ThrustModel.stated(vehicle).total(signal.values))) / (vehicle.mass * GRAVITY)
        message = f"no flight in this log: its rotor speeds carry at most {most:.0%} of the weight"
        fix = "did it fly? Else check mass, the unit of the rotor speeds, and b"
        return Check("hover", CheckResult.WARNING, message, fix, {"most_load": most}, _heavier(1.0 / most))
    speeds = signal.values[inside] * _supply(recording, vehicle, signal.t[inside])
    guess, thrust = vehicle.parameters["b"], float(np.mean(ThrustModel.stated(vehicle).total(speeds)))
    needed = guess.initial * vehicle.mass * GRAVITY / thrust if thrust > 0.0 else np.inf
    low, high = guess.limits
    speed = float(np.sqrt(np.mean(speeds**2)))
    check = partial(Check, "hover", numbers={"b_from_hover": needed, "speed_rad_s": speed})
    message = f"rotors turn at {speed:.4g} rad/s in flight (rms), so b would be {needed:.3g} N s^2/rad^2"
    if low <= needed <= high:
        return check(CheckResult.OK, f"{message}; bounds {low:.3g} to {high:.3g}")
    fitting = [(unit, f"{factor:.6g}") for unit, factor in _UNITS if low <= needed / factor**2 <= high]
    units, factors = [unit for unit, _ in fitting], " or ".join(factor for _, factor in fitting)
    fixes = [f"multiply rotor speeds by {factors}"] * bool(units) + ["b by 91.2"] * ("rpm^2" in "".join(units))
    root = ThrustModel.stated(vehicle).total(np.sqrt(np.abs(speeds)))
    if low <= guess.initial * vehicle.mass * GRAVITY / max(float(np.mean(root)), 1e-300) <= high:
        units, fixes = [*units, "squared"], [*fixes, "take their square roots"]
    if 0.7 < float(np.mean(np.sum(speeds, axis=1))) / (vehicle.mass * GRAVITY) < 1.4:
        units, fixes = [*units, "thrusts in N"], [*fixes, "take the square roots of thrust over b"]
    if units:
        slip = f"{message}, outside {low:.3g} to {high:.3g}: speeds seem to be {' or '.join(units)}"
        return check(CheckResult.ERROR, slip, f"{', or '.join(fixes)}, or use the vehicle file of this log")
    few = "did it fly? Else " if needed > high else ""
    fix = few + "check mass, the unit of the rotor speeds, max_speed of the command, or the bounds of b"
    verdict = CheckResult.WARNING if low / HOPELESS < needed < high * HOPELESS else CheckResult.ERROR
    outside = f"{message}, outside its bounds {low:.3g} to {high:.3g}"
    return check(verdict, outside, fix, off=_heavier(needed / guess.initial))


def _heavier(factor: float) -> Off:
    """Errors of the estimates if the vehicle file's mass is so many times the true one; none without a factor."""
    return estimates_off(mass=factor) if 0.0 < factor < np.inf else {}


def _supply(recording: Recording, vehicle: Vehicle, t: FloatArray) -> FloatArray:
    """Factor on the speeds at times `t` [s] by the supply voltage, shape (n, 1) or (1,); 1 where none is known."""
    exponent = vehicle.effects.get("supply_voltage", {}).get("exponent", 0.0)
    battery = recording.channels.get("battery")
    volts = voltage_at(t, battery.t, battery.values[:, 0]) if exponent and battery is not None else None
    if volts is None:
        return np.ones(1)
    return np.asarray((volts / (vehicle.reference_voltage or float(volts.mean()))) ** exponent)[:, None]


Rows = tuple[FloatArray, FloatArray, FloatArray]
"""Thrust over b (n, rotors), angular acceleration (n, 3) and rotors' own (n, rotors)."""


class Lagged(NamedTuple):
    """Fast motion for each lag of the motors, and slower turning about z, without the noise that a loop answers."""

    fast: list[Rows]
    slow: Rows


def motor_order_check(lagged: Lagged | str, vehicle: Vehicle, other: "Other | None") -> Check:
    """Correlates roll, pitch and yaw torque with angular acceleration.

    Args:
        lagged: of `lagged_motion`.
        vehicle: whose geometry and order are judged.
        other: what explains the motion better, of `better_description`, if anything does.
    """
    if isinstance(lagged, str):
        return Check("motor_order", CheckResult.UNKNOWN, lagged)
    if _still(lagged):
        return Check("motor_order", CheckResult.UNKNOWN, "too little rotation to check the motor order")
    own = _best([_Gram.of(rows) for rows in lagged.fast], vehicle, [tuple(range(len(vehicle.rotors)))], 1.0)[0][1]
    numbers = {f"correlation_{axis}": float(c) for axis, c in zip(("roll", "pitch", "yaw"), own, strict=True)}
    numbers |= {} if other is None else {"turned_rad": other.turned}
    check = partial(Check, "motor_order", numbers=numbers)
    text = f"correlation of torque and angular acceleration: roll {own[0]:.2f}, pitch {own[1]:.2f}, yaw {own[2]:.2f}"
    if other is not None:
        r, p, y = other.correlation
        return check(CheckResult.ERROR, f"{text}; {other.told} ({r:.2f}, {p:.2f}, {y:.2f})", other.fix)
    if min(own[0], own[1]) <= _SETTLED:
        return check(CheckResult.UNKNOWN, f"{text}: too weak to judge")
    if pairs := _tilted_pairs(lagged, vehicle):
        pair = _listed(pairs)
        unclear = f"{text}; yaw follows roll and pitch as if rotor {pair} turned the other way, or the gyro were tilted"
        return check(CheckResult.WARNING, unclear, f"check the spins of rotor {pair}, and how the IMU is mounted")
    return check(CheckResult.OK, text)


def lagged_motion(recording: Recording, vehicle: Vehicle, spans: Spans) -> Lagged | str:
    """Thrust over b by the vehicle file, angular acceleration and that of the rotors in flight, slow parts left out.

    One entry for each lag of 0, 1, 2 … rows by which the motors may answer late; or why there is none.
    """
    if "gyro" not in recording.channels or not spans:
        return "needs gyro and rotor signal in flight"
    try:
        signal = rotor_signal(recording, vehicle)
        windows = to_windows(recording, vehicle, 50.0, spans[0][0], spans[-1][1])
    except QuadidError as error:
        return error.found
    return lagged_of(windows, vehicle, 1.0 / measured_period(signal.t, signal.values))


def lagged_of(windows: Sequence[Window], vehicle: Vehicle, rate: float) -> Lagged | str:
    """As `lagged_motion`, of windows in flight, with rotor readings at `rate` [Hz]."""
    if rate < 30.0:
        return f"rotor signal at {rate:.3g} Hz is too slow to check the motor order"
    windows = [replace(w, rotor_speed=_turned(w, vehicle)) for w in windows]
    thrust, b = ThrustModel.stated(vehicle), vehicle.parameters["b"].initial
    acted = [thrust.single(w.rotor_speed) / b for w in windows]
    fast = [_in_band(windows, acted, lag, _SLOW_MOTION, 0.0) for lag in range(_LAGS)]
    slow = _in_band(windows, acted, 0, *_TURNING)
    return Lagged(fast, slow) if len(fast[0][0]) >= 100 else "too little flight to check the motor order"


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
    """Returns thrust over b and rotor acceleration `lag` rows earlier, and angular acceleration.

    What is slower than one time [s] is left out, what is faster than the other smoothed away.
    """
    parts: list[Rows] = []
    for w, acted in zip(windows, thrust, strict=True):
        width, smooth = max(3, round(slowest / w.dt)), max(1, round(fastest / w.dt) | 1)
        if w.gyro is None or len(w) < 2 * width + lag or np.isnan(rates := bridged(w.gyro)).any():
            continue
        # The change over two steps against what acted in between: the row itself and its neighbours' halves.
        acted = (
            0.5 * (acted[:-2] + acted[1:-1])
            if w.sampling == "held"
            else 0.25 * (acted[:-2] + 2 * acted[1:-1] + acted[2:])
        )
        gained, spun = ((rows[2:] - rows[:-2]) / (2.0 * w.dt) for rows in (rates, w.rotor_speed))
        rows = acted[: len(acted) - lag], gained[lag:], spun[: len(spun) - lag]
        smoothed = [moving_mean(r, smooth) for r in rows]
        acted, gained, spun = (r - moving_mean(r, width, mirrored=True) for r in smoothed)
        parts.append((acted, gained, spun))
    if not parts:
        return np.empty((0, 0)), np.empty((0, 3)), np.empty((0, 0))
    acted, gained, spun = (np.concatenate(column) for column in zip(*parts, strict=True))
    return acted, gained, spun


class Other(NamedTuple):
    """A vehicle that explains the motion much better: what differs, what to do, correlations, its turn [rad]."""

    vehicle: Vehicle
    told: str
    fix: str
    correlation: FloatArray
    turned: float


def better_description(lagged: Lagged | str, vehicle: Vehicle) -> Other | None:
    """The order of the log's columns, spins or turn of the frame with which torque follows the motion much better.

    The gain is that of a likelihood, sum of -log(1 - correlation^2) over roll, pitch and yaw, less `_CHANGE` for each
    thing that is changed; None where nothing gains enough, or the better correlation is weak, too.
    """
    if isinstance(lagged, str) or _still(lagged):
        return None
    grams = [_Gram.of(rows) for rows in lagged.fast]
    rotors = tuple(range(len(vehicle.rotors)))
    named = [
        (float(_gain(axes)) - _CHANGE * (_moved(order) + (sign < 0.0)), 0.0, order, axes)
        for sign in (1.0, -1.0)
        for order, axes in _best(grams, vehicle, _orders(len(rotors)), sign)
    ]
    own = max((one for one in named if one[2] == rotors), key=lambda one: one[0])
    # The most likely orders, and the own one, with the frame turned as roll and pitch then answer.
    for order in {rotors, *(one[2] for one in sorted(named, key=lambda one: -one[0])[:_TURNED])}:
        angle = _answer(grams, reordered(vehicle, order)).turned
        if abs(angle) > math.radians(20.0):  # a smaller turn is none
            for sign in (1.0, -1.0):
                ((_, axes),) = _best(grams, _rotated(vehicle, angle), [order], sign)
                named.append((float(_gain(axes)) - _CHANGE * (_moved(order) + (sign < 0.0) + 1.5), angle, order, axes))
    # What is right explains neither roll nor pitch worse: one axis may be bought with the other.
    fair = [one for one in named if np.mean(one[3][:2]) >= _SETTLED and np.all(one[3][:2] > own[3][:2] - 0.1)]
    best = max(fair, key=lambda one: one[0], default=own)
    least = _GAIN - 1.5 * _CHANGE * (best[1] != 0.0)  # what a turn costs only puts it behind an order
    _, angle, order, axes = best if best[0] - own[0] >= least else own
    described = _rotated(vehicle, angle) if angle else vehicle
    spins, yaw = _spins(lagged, reordered(described, order))
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
    new = reordered(described, order)
    new = _spun(new, spins[0]) if spins else new
    return Other(new, " and ".join(told), " and ".join(fix), axes, angle)


def reordered(vehicle: Vehicle, order: tuple[int, ...]) -> Vehicle:
    """The vehicle whose rotor k is on column `order[k]` of the log, written for the log's columns."""
    return vehicle.model_copy(update={"rotors": tuple(vehicle.rotors[order.index(k)] for k in range(len(order)))})


def _still(lagged: Lagged) -> bool:
    return float(np.max(np.std(lagged.fast[0][1], axis=0))) < 0.05


class _Gram(NamedTuple):
    """Products of the rotors' thrusts, (n, n), of thrusts and motion, (n, 3), and power of the motion, (3,)."""

    thrust: FloatArray
    motion: FloatArray
    power: FloatArray

    @classmethod
    def of(cls, rows: Rows) -> "_Gram":
        """Products of one lag's rows."""
        thrust, motion, _ = rows
        return cls(thrust.T @ thrust, thrust.T @ motion, np.sum(motion**2, axis=0))


def _best(
    grams: Sequence[_Gram], vehicle: Vehicle, orders: Sequence[tuple[int, ...]], sign: float
) -> list[tuple[tuple[int, ...], FloatArray]]:
    """Orders with their correlations at their best lag; of many rotors also what exchanges of two lead to."""
    if not orders:
        return []
    found = _correlations(grams, vehicle, orders, sign)
    out = list(zip(orders, found, strict=True))
    while len(orders) > 1 and len(vehicle.rotors) > _MOST_ROTORS:
        order, axes = max(out, key=lambda one: _gain(one[1]))
        near = [_exchanged(order, i, j) for i, j in combinations(range(len(order)), 2)]
        closer = list(zip(near, _correlations(grams, vehicle, near, sign), strict=True))
        out += closer
        if max(_gain(one[1]) for one in closer) < _gain(axes) + 1e-3:
            break
    return out


def _moved(order: tuple[int, ...]) -> float:
    """Cost of an order beside its spins: two motors exchanged, or any other way of counting, less than a muddle."""
    moved = sum(k != place for k, place in enumerate(order))
    simple = moved == 2 or len(order) <= _MOST_ROTORS or order in _orders(len(order))
    return 0.0 if not moved else 1.2 if simple else 1.2 + 0.1 * moved


def _exchanged(order: tuple[int, ...], i: int, j: int) -> tuple[int, ...]:
    new = list(order)
    new[i], new[j] = new[j], new[i]
    return tuple(new)


def _gain(correlation: FloatArray) -> FloatArray:
    """Likelihood by which correlations (…, 3) explain the motion; a negative one counts against; shape (…,)."""
    bounded = np.clip(correlation, -0.999, 0.999)
    return np.asarray(-np.sum(np.log1p(-np.sign(bounded) * bounded**2), axis=-1))


def _correlations(
    grams: Sequence[_Gram], vehicle: Vehicle, orders: Sequence[tuple[int, ...]], sign: float
) -> FloatArray:
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


def _spun(vehicle: Vehicle, turned: Sequence[int]) -> Vehicle:
    """The vehicle with the spins of some rotors, counted from 0, the other way."""
    rotors = [r.model_copy(update={"spin": -r.spin if k in turned else r.spin}) for k, r in enumerate(vehicle.rotors)]
    return vehicle.model_copy(update={"rotors": tuple(rotors)})


def _spins(lagged: Lagged, vehicle: Vehicle) -> tuple[list[tuple[int, ...]], float]:
    """Alternatives of rotors (from 0) that turn the other way: one, two or all; or none.

    Also returns the correlation of yaw acceleration and drag that the change gives.
    """
    count = len(vehicle.rotors)
    turned = [which for size in (0, 1, 2, count) for which in combinations(range(count), size)]
    found = np.array([_drag_explains(lagged.slow, _spun(vehicle, which)) for which in turned])
    wrong = np.array([len(which) for which in turned])
    # Without turning on purpose, what yaw follows is a matter of chance.
    gain = np.where(found > 2.0 * _SETTLED, _gain(found[:, None]) - _CHANGE * wrong.clip(max=2), -np.inf)
    best = int(np.argmax(gain[1:])) + 1
    own, chance = _gain(found[:1]), exceeded(_CHANCE, 1) / _independent(lagged.slow, _spun(vehicle, turned[best]))
    if gain[best] <= own or _gain(found[best : best + 1]) <= own + chance:
        return [], float(found[0])
    # Roll and pitch show which of them it is, but for partners on one arm: they have one command.
    near = 1 + np.flatnonzero(gain[1:] > gain[best] - max(_CHANGE, chance))
    whole = _gain(np.array([[_drag_explains(lagged.slow, _spun(vehicle, turned[k]), alone=False)] for k in near]))
    return [turned[k] for k in near[whole > whole.max() - _CHANGE]], float(found[best])


def _tilted_pairs(lagged: Lagged, vehicle: Vehicle) -> list[tuple[int, ...]]:
    """Pairs of more than four rotors (from 0) whose spins, the other way, explain all that a tilted gyro does; or none.

    Torques of such a pair add up to roll and pitch, which `_spins` takes out.
    """
    pairs = list(combinations(range(len(vehicle.rotors)), 2))
    if len(vehicle.rotors) <= 4:
        return []
    found = [_drag_explains(lagged.slow, _spun(vehicle, pair), alone=False) for pair in pairs]
    own = [_drag_explains(lagged.slow, vehicle, alone) for alone in (False, True)]
    least = max(_gain(np.array(own)[:, None]) + [_GAIN, -_CHANGE])
    return [pair for pair, more in zip(pairs, _gain(np.array(found)[:, None]), strict=True) if more > least]


def _listed(rotors: Sequence[tuple[int, ...]]) -> str:
    """Alternatives of rotors, for people: "1 and 2 or 4"."""
    return " or ".join(" and ".join(str(k + 1) for k in one) for one in rotors)


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


def _independent(slow: Rows, vehicle: Vehicle) -> float:
    """Number of independent samples in the correlation of yaw acceleration and drag: neither is white.

    M. S. Bartlett, Journal of the Royal Statistical Society 98 (1935) 536.
    """
    both = _yaw_and_drag(slow, vehicle, True)
    power = np.abs(np.fft.rfft(both, 2 * both.shape[1])) ** 2
    memory = np.fft.irfft(power)[:, : both.shape[1]] / (np.sum(both**2, axis=1)[:, None] + 1e-300)
    return float(both.shape[1] / max(2.0 * float(memory[0] @ memory[1]) - 1.0, 1.0))


class _Answer(NamedTuple):
    """Answer of the vehicle in roll and pitch to torque over b: inertia times acceleration = A torque, A = k R(alpha).

    Attributes:
        explained: share of the variance of roll and pitch, (2,).
        scale: k, b times the factor by which arms (or inertias) are wrong.
        turned: alpha [rad]: the frame stands so much further about z.
    """

    explained: FloatArray
    scale: float
    turned: float


def _answer(grams: Sequence[_Gram], vehicle: Vehicle) -> _Answer:
    """Least-squares map from torque to motion at the lag at which it explains most."""
    arms, inertia, found = vehicle.torque_arms[:, :2], vehicle.initial[2:4], []
    for gram in grams:
        cross = arms.T @ gram.motion[:, :2] * inertia
        a = np.linalg.lstsq(arms.T @ gram.thrust @ arms, cross, rcond=None)[0]
        along, across = 0.5 * (a[0, 0] + a[1, 1]), 0.5 * (a[0, 1] - a[1, 0])
        explained = np.sum(a * cross, axis=0) / (gram.power[:2] * inertia**2 + 1e-300)
        found.append(_Answer(explained, math.hypot(along, across), math.atan2(across, along)))
    return max(found, key=lambda answer: float(np.sum(answer.explained)))


def _rotated(vehicle: Vehicle, angle: float) -> Vehicle:
    """The vehicle with its rotor positions turned about z by an angle [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    rotors = tuple(
        r.model_copy(update={"position": (cos * x - sin * y, sin * x + cos * y, z)})
        for r in vehicle.rotors
        for x, y, z in (r.position,)
    )
    return vehicle.model_copy(update={"rotors": rotors})


def _orders(rotors: int) -> list[tuple[int, ...]]:
    own = tuple(range(rotors))
    if rotors <= _MOST_ROTORS:
        return list(permutations(own))
    turns = [own[i:] + own[:i] for i in range(rotors)]
    return turns + [turn[::-1] for turn in turns]


# --- Mass and rotor positions against what the flight shows, as far as physics reveals them
#
# Mass and thrust coefficient only ever show as their ratio, arm and inertia likewise.  So a wrong mass is seen when
# the thrust coefficient is known (thrust stand, or a sigma of its own), a wrong arm when the inertias are known too;
# that the whole frame is turned is seen always.


_KNOWN = 0.1
"""Relative standard deviation up to which a parameter counts as known."""
_SHARE, _SPREAD = 0.2, (0.25, 0.2, 0.2)
"""J_xx over mass and squared arm of most vehicles (0.11 of a heavy octocopter, 0.32 of a light one), and how far it,
guesses of inertia and guesses of b spread (standard deviations of the logarithm, on twenty vehicles)."""
_ASKED, _DOUBTED = 1.9, 2.5
"""Standard deviations from which another arm or mass is so likely that it is asked for, and that intervals hold it."""


def mass_check(recording: Recording, vehicle: Vehicle, spans: Spans, b_from_hover: float | None) -> Check | None:
    """Weighs the vehicle by its known thrust coefficient; None where that is not known or nothing flew.

    Args:
        recording: the log.
        vehicle: with `thrust_stand`, or a sigma of b.
        spans: when it flew [s].
        b_from_hover: thrust coefficient that would carry the weight [N s^2/rad^2], of `hover_check`.
    """
    known = _known_thrust(vehicle)
    if known is None or b_from_hover is None or b_from_hover <= 0.0:
        return None
    b, sigma = known
    factor = b / b_from_hover / _load(recording, spans)
    mass = factor * vehicle.mass
    numbers = {"mass_factor": factor, "mass_kg": mass}
    message = (
        f"the known thrust coefficient {b:.3g} N s^2/rad^2 carries {mass:.3g} kg, {factor:.3f} times the stated mass"
    )
    if abs(factor - 1.0) <= max(0.08, 3.0 * sigma):
        return Check("mass", CheckResult.OK, message, numbers=numbers)
    fix = f"weigh the vehicle: {mass:.3g} kg would fit; or check the thrust stand and the unit of the rotor speeds"
    return Check("mass", CheckResult.WARNING, message, fix, numbers, _heavier(1.0 / factor))


def _known_thrust(vehicle: Vehicle) -> tuple[float, float] | None:
    """Thrust coefficient and its relative standard deviation, where it rests on more than a guess."""
    if vehicle.stand_thrust is not None:
        return vehicle.stand_thrust
    return _known(vehicle, "b")


def _known(vehicle: Vehicle, name: str) -> tuple[float, float] | None:
    prior = vehicle.parameters[name]
    if prior.sigma is None or prior.sigma > _KNOWN * prior.initial:
        return None
    return prior.initial, prior.sigma / prior.initial


def _load(recording: Recording, spans: Spans) -> float:
    """Mean thrust over weight in flight, by the accelerometer; 1 where that is implausible."""
    accel = recording.channels.get("accel")
    if accel is None:
        return 1.0
    inside = within(accel.t, spans)
    load = -float(np.mean(accel.values[inside, 2])) / GRAVITY if inside.any() else 1.0
    return load if 0.8 < load < 1.5 else 1.0


def geometry_check(lagged: Lagged | str, vehicle: Vehicle, b_from_hover: float | None = None) -> Check:
    """Roll and pitch acceleration (of `lagged_motion`) against the torque that the stated rotor positions give.

    With the b that carries the weight, inertia over mass and squared arm follows: where no vehicle has it, the arm is
    asked for.
    """
    name = "geometry"
    if isinstance(lagged, str):
        return Check(name, CheckResult.UNKNOWN, lagged)
    explained, scale, angle = _answer([_Gram.of(rows) for rows in lagged.fast], vehicle)
    if float(np.min(explained)) < 0.1:
        axis = ("roll", "pitch")[int(np.argmin(explained))]
        return Check(
            name,
            CheckResult.UNKNOWN,
            f"rotor torques explain only {np.min(explained):.0%} of the {axis} motion: too little to judge positions",
        )
    numbers = {"turned_rad": angle, "explained": float(np.min(explained))}
    return _judge_scale(vehicle, scale, b_from_hover or 0.0, numbers)


def _judge_scale(vehicle: Vehicle, scale: float, hover: float, numbers: dict[str, float]) -> Check:
    thrust, inertias = _known_thrust(vehicle), [_known(vehicle, n) for n in ("J_xx", "J_yy")]
    turned = f"rotor positions agree with the motion within {abs(math.degrees(numbers['turned_rad'])):.0f} deg"
    if thrust is None or not all(inertias):
        message = f"{turned}; the arm itself shows only relative to the inertia"
        asked = _unlikely(vehicle, scale, hover, numbers)
        return asked or Check("geometry", CheckResult.OK, message, numbers=numbers)
    factor = scale / thrust[0]
    numbers = {**numbers, "arm_factor": factor}
    if abs(factor - 1.0) <= 0.2:
        return Check("geometry", CheckResult.OK, f"{turned}, the arm within {abs(factor - 1.0):.0%}", numbers=numbers)
    message = (
        f"roll and pitch answer {factor:.2f} times as strongly as the stated arm of {vehicle.arm:.3g} m lets expect"
    )
    fix = f"measure the arm: {factor * vehicle.arm:.3g} m, {factor:.2f} times it, would fit; or the inertias are wrong"
    return Check("geometry", CheckResult.WARNING, message, fix, numbers, _farther(factor))


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
    asked = np.flatnonzero(surprise >= _ASKED)
    if not len(asked):
        return None
    # Where either would do, nothing shows which, or that both are wrong: both are asked for.
    stated, fits, doubts = [], [], []
    for k in asked.tolist():
        kind, now, unit = (("arm", vehicle.arm, "m"), ("mass", vehicle.mass, "kg"))[k]
        low, high = now * np.exp(-found[k] + np.array([-2.0, 2.0]) / np.sqrt(power[k]))
        stated.append(f"the {kind} {now:.3g} {unit}")
        fits.append(f"the {kind}: {low:.2g} to {high:.2g} {unit} would fit")
        doubts.append(_heavier(math.exp(found[k])) if k else _farther(math.exp(-found[k])))
    return Check(
        "geometry",
        CheckResult.WARNING,
        f"{'are' if len(stated) > 1 else 'is'} {' and '.join(stated)} right? Weight and motion make the inertia about "
        f"x and y {size:.2g} times mass times arm squared ({_SHARE:g} on most vehicles) and {hover / scale:.2g} times "
        f"its guess, and b {hover / guessed:.2g} times its guess",
        f"measure {', and '.join(fits)}",
        {**numbers, "size": size},
        farthest(doubts) if surprise.max() > _DOUBTED else {},
    )


def _farther(factor: float) -> Off:
    """Errors of the estimates if the rotors are so many times as far from the centre as in the vehicle file."""
    return estimates_off(torque=(factor, factor, 1.0))
