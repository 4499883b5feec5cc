"""Whether logged velocity is the change of logged position: an estimator that scales one of them is wrong in one."""

from __future__ import annotations

import numpy as np

from quadid.inspection.conventions import fit_axes, running_integral, usable_steps
from quadid.inspection.findings import Check, CheckResult
from quadid.resample import sample_period
from quadid.types import FloatArray
from quadid.window import Channel, Recording

FEWEST_SAMPLES = 20
"""Samples of each that a comparison needs."""
FEWEST_STRETCHES = 4.0
"""Independent stretches that it needs."""
STRETCH = 1.0
"""Changes are compared over this time [s]: slow enough for delays and low-passes of either channel not to count."""
CLEAR = 0.98
"""Correlation above which two changes are the same motion, seen by two channels."""
UPWARDS = 0.8
"""Correlation below the negative of which one of two vertical changes has the wrong sign."""
LEAST_MOTION = 0.1
"""Change of position [m], as standard deviation, below which its noise may decide."""
SCALE = 0.03
"""Deviation from scale 1 that matters to whoever predicts positions …"""
SIGMAS = 4.0
"""… when it is beyond chance by this many standard errors."""
_PAIRS = (("horizontally", (0, 1)), ("vertically", (2,)))


def position_checks(recording: Recording) -> list[Check]:
    """Integral of the velocity against the change of position, where both are logged: scale and correlation.

    Horizontal axes together, the vertical one by itself.
    """
    position, velocity = (recording.channels.get(n) for n in ("position", "velocity"))
    if position is None or velocity is None or min(len(position.t), len(velocity.t)) < FEWEST_SAMPLES:
        return []
    return [_compared(position, velocity)]


def _compared(position: Channel, velocity: Channel) -> Check:
    moved, flown, independent = _changes(position, velocity)
    if independent < FEWEST_STRETCHES:
        return Check("position_velocity", CheckResult.UNKNOWN, "too few stretches without a gap to compare")
    horizontal = fit_axes(moved[:, :2], flown[:, :2])
    if np.max(np.std(moved[:, :2], axis=0)) > LEAST_MOTION and horizontal.r2 > CLEAR**2 and not horizontal.straight:
        return Check(
            "position_velocity", CheckResult.WARNING,
            f"world axes of velocity differ from those of position: {horizontal} (R^2 {horizontal.r2:.2f})",
            "use NED for both; ROS' ENU swaps x and y", {"r2": horizontal.r2},
        )  # fmt: skip
    numbers: dict[str, float] = {}
    scales: list[str] = []
    off: list[str] = []
    for where, axes in _PAIRS:
        p, v = (x[:, axes] - x[:, axes].mean(axis=0) for x in (moved, flown))
        correlation = float(np.sum(p * v) / np.sqrt(max(np.sum(p * p) * np.sum(v * v), 1e-300)))
        if where == "vertically" and np.max(np.std(p, axis=0)) > LEAST_MOTION and correlation < -UPWARDS:
            return Check(
                "position_velocity", CheckResult.ERROR,
                f"position rises where velocity falls (correlation {correlation:.2f}): one of them points up",
                "negate z or vz: the world is NED, its z down", {"correlation": correlation},
            )  # fmt: skip
        if np.max(np.std(p, axis=0)) < LEAST_MOTION or correlation < CLEAR:
            continue
        # Both have errors: the ratio of their sizes, not a regression of one on the other.
        scale = float(np.sqrt(np.sum(v * v) / np.sum(p * p)))
        error = scale * np.sqrt(max(1.0 - correlation**2, 0.0) / (independent * len(axes)))
        numbers |= {f"scale {where}": scale, f"correlation {where}": correlation}
        scales.append(f"{scale:.3f} ± {error:.3f} {where} (correlation {correlation:.4f})")
        if abs(scale - 1.0) > max(SCALE, SIGMAS * error):
            off.append(f"{abs(scale - 1.0):.1%} {'larger' if scale > 1.0 else 'smaller'} {where}")
    if not scales:
        message = "velocity does not follow the change of position clearly, or the vehicle hardly moves"
        return Check("position_velocity", CheckResult.UNKNOWN, message)
    measured = f"velocity against change of position: {', '.join(scales)}"
    if not off:
        return Check("position_velocity", CheckResult.OK, measured, numbers=numbers)
    return Check(
        "position_velocity", CheckResult.WARNING,
        f"the logged velocity is {' and '.join(off)} than the logged change of position ({measured}): the scale of one "
        "of them is wrong; a simulation fitted to such a log misses positions by as much, unless it has "
        "`velocity_scale`",
        "check the scale of the positioning system and of the estimator's velocity (flow sensor, marker distances)",
        numbers,
    )  # fmt: skip


def _changes(position: Channel, velocity: Channel) -> tuple[FloatArray, FloatArray, float]:
    """Changes of position and integrals of velocity over overlapping stretches, both (m, 3), and independent ones."""
    period = sample_period(position.t)
    steps, every = max(round(STRETCH / period), 1), max(round(0.1 * STRETCH / period), 1)
    broken = np.concatenate([[0], np.cumsum(~usable_steps(position.t, velocity.t))])
    start = np.arange(0, len(position.t) - steps, every)
    start = start[broken[start + steps] == broken[start]]
    path = running_integral(velocity, position.t)
    moved, flown = (x[start + steps] - x[start] for x in (position.values, path))
    known = np.isfinite(moved).all(axis=1) & np.isfinite(flown).all(axis=1)
    return moved[known], flown[known], float(np.count_nonzero(known)) * every / steps
