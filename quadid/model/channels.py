"""Residual channels: their order, and what a window measured of each."""

from __future__ import annotations

import numpy as np

from quadid.types import BoolArray, FloatArray
from quadid.window import Window

CHANNEL_NAMES = ("p", "q", "r", "phi", "theta", "psi", "a_x", "a_y", "a_z", "v_n", "v_e", "v_d", "x", "y", "z")
"""Residual channels: rates, attitude error as a body rotation vector, specific force, velocity, position."""
CHANNEL_UNITS = ("rad/s",) * 3 + ("rad",) * 3 + ("m/s^2",) * 3 + ("m/s",) * 3 + ("m",) * 3


def channels_of(window: Window) -> int:
    """Number of residual channels that a window has."""
    if window.position is not None:
        return 15
    return 9 if window.velocity is None else 12


def measurements(window: Window, channels: int) -> tuple[FloatArray, BoolArray]:
    """What a window measured, as the kernel reads it.

    Args:
        window: the data, n rows.
        channels: residual channels to look at, the first 9, 12 or 15.

    Returns:
        Rates, quaternion, specific force, and of those looked at velocity and position, shape (n, channels + 1), at
        rest where missing; and where each channel was measured, shape (n, channels).
    """
    n = len(window)
    measured = np.zeros((n, channels + 1))
    measured[:, 3] = 1.0
    valid = np.zeros((n, channels), dtype=bool)
    places = ((window.gyro, 0, 0), (window.attitude, 3, 3), (window.accel, 7, 6), (window.velocity, 10, 9),
              (window.position, 13, 12))  # fmt: skip
    for values, column, channel in places:
        if values is None or channel >= channels:
            continue
        good = np.isfinite(values).all(axis=1)
        measured[good, column : column + values.shape[1]] = values[good]
        valid[good, channel : channel + 3] = True
    return measured, valid
