"""How much of quick turning the rotors make: what that leaves undecided of roll and pitch inertia.

Inertia is torque over angular acceleration.  Where the two are not coherent, one of them holds what the other
lacks: an error of rotor speeds makes the inertia too large, one of the motion too small, by up to the coherence (the
estimators H1 and H2 of a frequency response; J. S. Bendat and A. G. Piersol, Random Data, 4th ed. (2010), ch. 6).
Beside moments that no model has the two cannot be distinguished, so an inertia is not known better than that.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

SECONDS = 1.0
"""Stretch of a spectrum."""
BAND = (2.5, 12.5)
"""Frequencies [Hz] that count: slower ones are ruled by unmodelled moments, faster ones by noise and vibration."""
LEAST = 0.01
"""Smallest share distinguished from zero; also where no stretch is long enough for a spectrum."""


def undecided(windows: Sequence[Window], vehicle: Vehicle, white: FloatArray) -> FloatArray:
    """What J_xx and J_yy are undecided by, in log scale, shape (2,).

    It is minus the logarithm of the share of quick roll and pitch acceleration, less what the gyro's noise makes of it,
    that the rotors' torque accounts for.

    Args:
        windows: data on one grid, with a gyro.
        vehicle: places of the rotors.
        white: standard deviation of the white noise of roll and pitch rate [rad/s], shape (2,).
    """
    dt = windows[0].dt
    length = max(round(SECONDS / dt), 4)
    taper = np.hanning(length)[:, None]
    torque_power, motion_power, cross = (np.zeros((length // 2 + 1, 2), dtype) for dtype in (float, float, complex))
    blocks = 0
    for window in windows:
        if window.gyro is None or len(window) < length:
            continue
        torque = window.rotor_speed**2 @ vehicle.torque_arms[:, :2]
        acceleration = np.gradient(_without_gaps(window.gyro[:, :2]), dt, axis=0)
        for begin in range(0, len(window) - length + 1, length // 2):
            part = slice(begin, begin + length)
            t, a = (np.fft.rfft(taper * (v[part] - v[part].mean(axis=0)), axis=0) for v in (torque, acceleration))
            torque_power += np.abs(t) ** 2
            motion_power += np.abs(a) ** 2
            cross += np.conj(t) * a
            blocks += 1
    frequency = np.fft.rfftfreq(length, dt)
    band = (frequency >= BAND[0]) & (frequency <= BAND[1])
    differences = np.sin(2.0 * np.pi * frequency[band] * dt)[:, None] / dt
    noise = blocks * np.sum(taper**2) * np.sum((differences * white) ** 2, axis=0)
    none = np.finfo(float).tiny
    made = np.sum(np.abs(cross[band]) ** 2 / np.maximum(torque_power[band], none), axis=0)
    motion = np.sum(motion_power[band], axis=0) - noise
    return np.asarray(-np.log(np.clip(made / np.maximum(motion, none), LEAST, 1.0)))


def _without_gaps(values: FloatArray) -> FloatArray:
    """Straight lines across missing rows."""
    rows, there = np.arange(len(values)), np.isfinite(values).all(axis=1)
    return np.column_stack([np.interp(rows, rows[there], v[there]) if there.any() else 0.0 * rows for v in values.T])
