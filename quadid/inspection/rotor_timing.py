"""Whether the rotor signal stands in one place in time before the motion that it causes.

A motor answers its command late by its lag, always the same; measured speeds come a few milliseconds late.  A lag that
wanders over the flight is a clock's, not a motor's, and a torque that follows its own effect is a wrong stamp.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadid.errors import QuadidError
from quadid.inspection.airborne import Spans
from quadid.inspection.findings import Check, CheckResult
from quadid.resample import linear, measured_period, moving_mean, sample_period
from quadid.rotor_signal import INERTIA_RATE, RotorSignal, rotor_signal
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Channel, Recording

_STEP = 0.01
"""Lags are compared at multiples of this [s]; the peak is found between them."""
_FARTHEST = 25
_BLOCK = 15.0
_SLOW = 0.4
"""Motion slower than this [s] is left out, as in `motor_checks`."""
_CLEAR = 0.3
"""Correlation above which the peak of a block counts."""
_WANDER, _EARLY = 0.012, 0.2
"""Limits [s] of the spread of the lag over the flight, and of torque before its effect."""
_LATE, _TOO_LATE = 0.015, 0.025
"""Torque after its effect [s] that is named, and that is refused."""


class _Peak(NamedTuple):
    """Axis, lag [s] of its angular acceleration behind the torque in one block, and their correlation there."""

    axis: int
    lag: float
    correlation: float


def rotor_timing_check(recording: Recording, vehicle: Vehicle, spans: Spans) -> Check:
    """Lag between roll and pitch torque and angular acceleration, block by block, and how far it wanders."""
    name = "rotor_timing"
    gyro = recording.channels.get("gyro")
    if gyro is None or not spans:
        return Check(name, CheckResult.UNKNOWN, "needs gyro and rotor signal in flight")
    try:
        signal = rotor_signal(recording, vehicle)
    except QuadidError as error:
        return Check(name, CheckResult.UNKNOWN, error.found)
    slowest = max(measured_period(signal.t, signal.values), sample_period(gyro.t))
    if not slowest <= 1.0 / INERTIA_RATE:
        return Check(name, CheckResult.UNKNOWN, "rotor signal or gyro too slow to place them in time")
    # Rows that no block takes are not read for each: the check of a long log takes time by its length.
    width = max(3, round(2.5 * slowest / _STEP) | 1)
    peaks = [peak for times in _blocks(spans) for peak in _peaks(signal, gyro, vehicle, times, width)]
    return _judge(name, peaks)


def _judge(name: str, peaks: list[_Peak]) -> Check:
    if not peaks:
        return Check(name, CheckResult.UNKNOWN, "too little flight to place the rotor signal in time")
    correlation = float(np.median([p.correlation for p in peaks]))
    clear = np.array([p.lag for p in peaks if p.correlation > _CLEAR])
    about = [_about_median([p.lag for p in peaks if p.axis == axis and p.correlation > _CLEAR]) for axis in range(2)]
    numbers = {"correlation": correlation}
    if len(clear) < max(2, len(peaks) // 2):
        message = f"torque and angular acceleration correlate by {correlation:.2f} only, at any lag"
        return Check(name, CheckResult.UNKNOWN, message, "fly with more roll and pitch motion", numbers)
    low, high = np.quantile(np.concatenate(about), [0.1, 0.9])
    lag = float(np.median(clear))
    numbers |= {"lag_s": lag, "wander_s": float(high - low)}
    message = (
        f"torque and angular acceleration correlate by {correlation:.2f} at a lag of {1e3 * lag:.0f} ms, "
        f"which wanders by {1e3 * (high - low):.0f} ms"
    )
    fix = "stamp the rotor signal by the clock that stamps the IMU, or log both on board"
    if high - low > _WANDER:
        return Check(name, CheckResult.ERROR, f"{message}: the rotor signal is not in time with the gyro", fix, numbers)
    if -_TOO_LATE < lag < -_LATE:
        smoothed = f"{message}: rotor speeds are late, or the states were smoothed without a delay"
        return Check(
            name, CheckResult.WARNING, smoothed, "log raw states; `rotor_telemetry_delay` models a delay", numbers
        )
    if lag < -_LATE:
        return Check(name, CheckResult.ERROR, f"{message}: the rotor signal lags its effect", fix, numbers)
    if lag > _EARLY:
        return Check(name, CheckResult.ERROR, f"{message}: no motor answers that late", fix, numbers)
    return Check(name, CheckResult.OK, message, numbers=numbers)


def _about_median(lags: list[float]) -> FloatArray:
    """Lags of one axis about their own median: axes may differ, for other motion excites them."""
    return np.array(lags) - np.median(lags) if lags else np.empty(0)


def _blocks(spans: Spans) -> list[FloatArray]:
    """Times on a uniform grid, in blocks of about `_BLOCK` seconds of uninterrupted flight."""
    out = []
    for a, b in spans:
        parts = max(1, int((b - a) // _BLOCK))
        bounds = np.linspace(a, b, parts + 1)
        out += [np.arange(c, d, _STEP) for c, d in zip(bounds[:-1], bounds[1:], strict=True)]
    return [times for times in out if len(times) > 8 * _FARTHEST]


def _peaks(signal: RotorSignal, gyro: Channel, vehicle: Vehicle, at: FloatArray, width: int) -> list[_Peak]:
    """Peaks of one block at times `at`, with both signals smoothed over `width` of its rows."""
    turning, speeds = _around(gyro.t, at), _around(signal.t, at)
    rates = linear(gyro.t[turning], gyro.values[turning, :2], at)
    squares = linear(signal.t[speeds], signal.values[speeds] ** 2, at)
    motion = _quick(np.gradient(rates, _STEP, axis=0), width)
    torque = _quick(squares @ vehicle.torque_arms[:, :2], width)
    return [_peak(axis, torque[:, axis], motion[:, axis]) for axis in range(2)]


def _around(t: FloatArray, at: FloatArray) -> slice:
    """Samples that straight lines to the times of a block need, of increasing times."""
    return slice(max(int(np.searchsorted(t, at[0], side="right")) - 1, 0), int(np.searchsorted(t, at[-1])) + 1)


def _quick(values: FloatArray, width: int) -> FloatArray:
    """Band of frequencies that both signals hold: smoothed over `width` rows, slow motion left out."""
    smooth = moving_mean(values, width)
    return np.asarray(smooth - moving_mean(smooth, round(_SLOW / _STEP) | 1, mirrored=True))


def _peak(axis: int, torque: FloatArray, motion: FloatArray) -> _Peak:
    n, far = len(torque), _FARTHEST
    later = motion[far : n - far]
    rows = [torque[far - k : n - far - k] for k in range(-far, far + 1)]
    scores = np.array([row @ later / np.sqrt(row @ row * (later @ later) + 1e-300) for row in rows])
    best = int(np.argmax(scores))
    shift = 0.0
    if 0 < best < 2 * far:
        before, here, after = scores[best - 1 : best + 2]
        shift = 0.5 * float((before - after) / (before - 2.0 * here + after))
    return _Peak(axis, (best - far + shift) * _STEP, float(scores[best]))
