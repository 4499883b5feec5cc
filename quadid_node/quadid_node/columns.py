"""Many messages of one topic at once: which columns of their numbers are which signal.

As the `signals` of `quadid_replay.mcap_messages`, for types that come fast; any other goes message by message.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
Columns = list[tuple[str, FloatArray]]
Runs = list[FloatArray]
"""Runs of numbers of n messages, each of shape (n, length)."""

_WXYZ = [3, 0, 1, 2]


def imu(runs: Runs, extra: Any) -> Columns | None:
    """REP-145: a covariance that begins with -1 says that the quantity is absent."""
    (v,) = runs
    out: Columns = []
    parts = (("body_rate", 16, slice(13, 16)), ("body_force", 28, slice(25, 28)), ("attitude", 4, _WXYZ))
    for name, flag, cut in parts:
        told = _alike(v[:, flag] != -1.0)
        if told is None:
            return None
        if told:
            out.append((name, v[:, cut]))
    return out


def quaternion(runs: Runs, extra: Any) -> Columns | None:
    """Attitude."""
    return [("attitude", runs[0][:, _WXYZ])]


def joints(runs: Runs, extra: Any) -> Columns | None:
    """Speeds and efforts, where there are any."""
    return [(n, v) for n, v in zip(("rotor_speed", "motor_command"), runs, strict=True) if v.shape[1]]


def odometry(runs: Runs, extra: Any) -> Columns | None:
    """Pose and twist; NaN stands for what is not told."""
    (v,) = runs
    q = v[:, [6, 3, 4, 5]]
    position, velocity = _alike(v[:, 0] == v[:, 0]), _alike(v[:, 43] == v[:, 43])
    if position is None or velocity is None:
        return None
    out: Columns = [("pose_attitude", q)]
    if position:
        out.append(("position", v[:, :3]))
    if velocity:
        out.append(("velocity", v[:, 43:46]) if extra else ("body_velocity", np.hstack([q, v[:, 43:46]])))
    return out


def attitude_command(runs: Runs, extra: Any) -> Columns | None:
    """Attitude and throttle references."""
    return [("euler_reference", runs[0])]


def motor_command(runs: Runs, extra: Any) -> Columns | None:
    """Commands of the motors."""
    return [("motor_command", runs[0])]


COLUMNS: dict[str, Callable[[Runs, Any], Columns | None]] = {
    "sensor_msgs/Imu": imu,
    "geometry_msgs/QuaternionStamped": quaternion,
    "sensor_msgs/JointState": joints,
    "nav_msgs/Odometry": odometry,
    "quadid_msgs/AttitudeCommand": attitude_command,
    "quadid_msgs/MotorCommand": motor_command,
}
"""By message type; None from a function: the messages do not all tell the same signals."""


def _alike(flags: NDArray[np.bool_]) -> bool | None:
    """What all rows say; None when they differ."""
    first = bool(flags[0])
    return first if bool((flags == first).all()) else None
