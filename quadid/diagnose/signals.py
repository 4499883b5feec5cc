"""Signals that a residual may follow: inputs, motions, time.

None may share noise with the residual: motions are the predicted ones, and inputs are those of the step before a
sample, because a controller's command answers to the noise of the sample that it was worked out from; so are specific
forces, which follow the command at once.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from quadid.identify.segment_jacobian import Columns

FloatArray = NDArray[np.float64]

LAGS = (0.04, 0.1)
"""How far back [s] inputs are also looked at."""
WAVES = 4
"""Half waves over the log, for what comes and goes slowly."""


def signals(part: Columns) -> dict[str, FloatArray]:
    """Signals at the samples of every segment, each of shape (segments, length), not yet scaled.

    Args:
        part: one window's segments with their prediction.
    """
    out = {f"{name} input": s[part.rows - 1] for name, s in _inputs(part).items()}
    out |= _motions(part)
    first, last = part.window.log_span
    share = (part.window.t[part.rows] - first) / max(last - first, part.window.dt)
    out["constant"] = np.ones_like(share)
    for n in range(1, WAVES + 1):
        out[f"time, {n} half waves"] = np.cos(n * np.pi * share)
    return out


def _inputs(part: Columns) -> dict[str, FloatArray]:
    """What the rotors were told, by row of the window: thrust and differences of squared speeds, their shapes."""
    square = part.window.rotor_speed**2
    mean = square.mean(axis=1)
    # Principal differences between rotors stand for the moments, whatever the geometry.
    apart = square - mean[:, None]
    apart = apart - apart.mean(axis=0)
    axes = np.linalg.svd(apart, full_matrices=False)[2][: min(3, square.shape[1] - 1)]
    level = float(mean.mean())
    thrust = mean / level - 1.0
    basic = {"thrust": thrust}
    for i, axis in enumerate(axes):
        basic[f"moment {i + 1}"] = apart @ axis / level
    out = dict(basic)
    for name, s in basic.items():
        for lag in LAGS:
            steps = max(round(lag / part.window.dt), 1)
            out[f"{name} {lag:g} s before,"] = np.concatenate([np.full(steps, s[0]), s[:-steps]])
        change = np.diff(s, prepend=s[0])
        out[f"changing {name}"] = change
        out[f"|changing {name}|"] = np.abs(change)
        out[f"squared {name}"] = s**2
        out[f"cubed {name}"] = s**3
    return out


def _motions(part: Columns) -> dict[str, FloatArray]:
    """Predicted rates, tilt and specific force, and products of them."""
    window = part.window
    p, q, r = (_predicted(part, window.gyro, i, i) for i in range(3))
    f_x, f_y, f_z = (_before(_predicted(part, window.accel, i, 6 + i)) for i in range(3))
    out = {"p": p, "q": q, "r": r, "p|p|": p * np.abs(p), "q|q|": q * np.abs(q), "r|r|": r * np.abs(r)}
    out |= {"p q": p * q, "q r": q * r, "r p": r * p, "|p|": np.abs(p), "|q|": np.abs(q)}
    lift = f_z - np.mean(f_z)
    out |= {"a_x": f_x, "a_y": f_y, "a_z": lift, "a_z squared": lift**2, "a_x a_z": f_x * lift, "a_y a_z": f_y * lift}
    if window.attitude is not None:
        w, x, y, z = _predicted_attitude(part, window.attitude)
        out |= {"pitched": 2.0 * (x * z - w * y), "rolled": 2.0 * (y * z + w * x)}
        out |= {"heading north": w * w + x * x - y * y - z * z, "heading east": 2.0 * (x * y + w * z)}
    return out


def _before(signal: FloatArray) -> FloatArray:
    """The signal one step before; at the first sample of a segment, there."""
    return np.concatenate([signal[:, :1], signal[:, :-1]], axis=1)


def _predicted(part: Columns, measured: FloatArray | None, axis: int, channel: int) -> FloatArray:
    """Predicted value of a channel; where nothing was measured, 0, as its residual."""
    value = part.base[:, :, channel]
    return value if measured is None else value + np.nan_to_num(measured[part.rows][..., axis])


def _predicted_attitude(part: Columns, measured: FloatArray) -> FloatArray:
    """Predicted quaternion, shape (4, segments, length): the measured one turned by its residual, a body rotation."""
    w, x, y, z = np.moveaxis(np.nan_to_num(measured[part.rows]), -1, 0)
    a, b, c = 0.5 * np.moveaxis(part.base[:, :, 3:6], -1, 0)
    return np.stack(
        [w - x * a - y * b - z * c, x + w * a + y * c - z * b, y + w * b + z * a - x * c, z + w * c + x * b - y * a]
    )
