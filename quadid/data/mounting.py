"""Where the IMU sits in the body: readings turned into body axes before anything else sees them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from quadid.data.window import Recording
from quadid.types import FloatArray
from quadid.vehicle import Vehicle


def mounting_matrix(rotation: tuple[float, float, float]) -> FloatArray:
    """Returns the matrix (3, 3) from IMU to body axes, for roll, pitch, yaw [rad] of the IMU in the body (z-y-x)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rotation), np.sin(rotation)
    return np.array([
        [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
        [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
        [-sp, sr * cp, cr * cp],
    ])  # fmt: skip


def in_body_axes(recording: Recording, vehicle: Vehicle) -> Recording:
    """Returns the recording with gyro and accelerometer in body axes; itself where the IMU is mounted straight."""
    rotation = vehicle.mounting.rotation
    if not any(rotation):
        return recording
    turn = mounting_matrix(rotation)
    turned = {
        name: replace(channel, values=channel.values @ turn.T)
        for name, channel in recording.channels.items()
        if name in ("gyro", "accel")
    }
    return replace(recording, channels={**recording.channels, **turned})
