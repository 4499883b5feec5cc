"""Gyro and accelerometer behind a low-pass: found by the attitude, and brought back in time.

Autopilots log an IMU behind a Butterworth filter of second order, so it is late: by 11 ms at ArduPilot's 20 Hz.  The
attitude is integrated from samples before that filter, and is not.  To second order in its delay tau such a filter,
like a delay, is undone by

    omega = y + tau y' + tau^2 y'' / 2                                                                        (1)

and tau is found by kinematics alone: least squares of the attitude's mean rate from row to row on the right side.  Left
in, it would pass for motors that lag, and for inertias that are too small, since it takes quick motion away.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from quadid.chi_square import exceeded
from quadid.data.window import Window
from quadid.rotation import turn
from quadid.types import FloatArray

CHANCE = 1e-4
"""Probability of a delay in a flight whose gyro has none."""
MOST = 0.05
"""Longest delay that is undone [s]: an IMU that is later is not behind such a filter.  Left at 31 to 45 ms, inertias
were published up to 4.4 % too small; later ones show in how thrust follows rotor speed."""
BLOCK = 50
"""Rows whose errors may go together."""
MARGIN = 50
"""Rows by which a window is continued, mirrored, beyond its ends."""


def delay_of(windows: Sequence[Window]) -> float:
    """Delay of the gyro behind the attitude [s]; 0 where none is proven, or it is not that of such a filter."""
    tau = 0.0
    for _ in range(4):  # Eq. 1 is quadratic in tau: Gauss-Newton steps
        square, along, scores = 0.0, 0.0, list[float]()
        for window in windows:
            if window.gyro is None or window.attitude is None or len(window) < BLOCK:
                continue
            off, first, second = _rates(window)
            if not np.isfinite(off).any():  # never two attitudes in neighbouring rows
                continue
            off = off - np.nanmean(off, axis=0)
            slope, left = first + tau * second, off - tau * first - 0.5 * tau**2 * second
            good = np.isfinite(slope) & np.isfinite(left)
            left, slope = np.where(good, left, 0.0), np.where(good, slope, 0.0)
            square, along = square + float(np.sum(slope**2)), along + float(np.sum(slope * left))
            rows = len(slope) // BLOCK * BLOCK
            scores += np.sum((slope * left)[:rows].reshape(-1, BLOCK, 3), axis=1).ravel().tolist()
        if square == 0.0:
            return 0.0
        tau += along / square
        if not 0.0 < tau < MOST:
            return 0.0
    sigma = float(np.sqrt(np.sum((np.array(scores) - np.mean(scores)) ** 2))) / square
    return tau if tau**2 > exceeded(CHANCE, 1) * sigma**2 else 0.0


def _rates(window: Window) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Of each step but the outermost: mean rate by the attitude less the gyro's, means of y' and of y'' (n - 3, 3)."""
    assert window.gyro is not None
    assert window.attitude is not None
    h, y = window.dt, window.gyro
    first = (y[2:-1] - y[1:-2]) / h
    second = (y[3:] - y[2:-1] - y[1:-2] + y[:-3]) / (2.0 * h**2)
    # The mean of y over a step is that of its ends less h^2 / 12 of the mean of y''.
    mean = 0.5 * (y[2:-1] + y[1:-2]) - h**2 / 12.0 * second
    return turn(window.attitude[1:-2], window.attitude[2:-1]) / h - mean, first, second


def in_time(window: Window, delay: float) -> Window:
    """The window with gyro and accelerometer as they were before the filter, Eq. 1; itself where `delay` is 0 [s]."""
    if delay == 0.0:
        return window
    undone: dict[str, Any] = {
        name: _undone(values, window.dt, delay)
        for name in ("gyro", "accel")
        if (values := getattr(window, name)) is not None
    }
    return replace(window, **undone)


def _undone(values: FloatArray, dt: float, delay: float) -> FloatArray:
    """Right side of Eq. 1, shape (n, 3), by the spectrum; rows that were not measured stay so."""
    rows, missing = np.arange(len(values)), np.isnan(values)
    whole = np.column_stack(
        [
            np.interp(rows, rows[~m], c[~m]) if m.any() and not m.all() else c
            for c, m in zip(values.T, missing.T, strict=True)
        ]
    )
    more = min(MARGIN, len(whole) - 1)
    longer = np.pad(whole, ((more, more), (0, 0)), mode="reflect", reflect_type="odd")
    s = 2j * np.pi * np.fft.rfftfreq(len(longer), dt)[:, None]
    spectrum = np.fft.rfft(longer, axis=0) * (1.0 + delay * s + 0.5 * (delay * s) ** 2)
    out = np.fft.irfft(spectrum, len(longer), axis=0)[more : more + len(whole)]
    return np.where(missing, np.nan, out)
