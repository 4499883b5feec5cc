"""The stabiliser of a vehicle, as given or found in a log.

The control law is that of `quadid.attitude_controller`: angle P, rate PI, mixer.  Its inputs (references, measured
attitude and rate) and its output (rotor commands) are all logged, so the gains follow from a regression; how much of
the commands it leaves unexplained shows whether the vehicle flies this law at all.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from quadid.attitude_controller import GAIN_NAMES
from quadid.data.grid import bridged
from quadid.data.window import Window
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

EXPLAINED = 0.9
"""Least share of the variance of every command that the law must explain to be believed."""
TRIAL_ROWS = 6000
"""Rows of the first window on which a law is tried before it is fitted to all."""
SHORTEST = 500
"""Rows needed for an answer."""
FAST = 4
"""Runs a row of a stabiliser that is faster than the log."""
_AXES = ("roll", "pitch", "yaw")
_NO_LIMIT = 50.0
"""Largest limit of a rate reference that is looked for [rad/s]."""
_RESTING = 3
"""Rows at an extreme value that make it a limit and no chance."""


@dataclass(frozen=True)
class Autopilot:
    """A stabiliser that can be simulated.

    Attributes:
        gains: by name, see `quadid.attitude_controller.GAIN_UNITS`.
        rate: how often it runs [Hz]; None for once a row.
        source: ``given`` or ``identified``.
        explained: share of the variance of the throttle, roll, pitch and yaw commands explained; NaN when given.
    """

    gains: Mapping[str, float]
    rate: float | None
    source: str
    explained: tuple[float, ...]


class _Axis(NamedTuple):
    """Angle gain [1/s], rate gain, integral gain, limit of the rate reference [rad/s], explained share."""

    p: float
    rate_p: float
    rate_i: float
    limit: float
    explained: float


def find_autopilot(windows: Sequence[Window], vehicle: Vehicle) -> Autopilot | None:
    """Returns the stabiliser of the vehicle file, else the one found in the data, else None.

    Args:
        windows: of one vehicle on one grid; needed are references, attitude, gyro and rotor commands.
        vehicle: geometry; its guess of b and d scales the gains and cancels in what they command.
    """
    if vehicle.stabiliser is not None:
        return Autopilot(vehicle.stabiliser.gains, vehicle.stabiliser.rate, "given", ())
    rows = [r for r in (_rows(w) for w in windows) if r is not None]
    if sum(len(r.time_step) for r in rows) < SHORTEST:
        return None
    b, d = (vehicle.parameters[n].initial for n in NOMINAL_NAMES[:2])
    throttle, ceiling = _throttle(rows)
    arms = vehicle.torque_arms.T * [[b], [b], [d]]
    # The first minutes show whether it runs faster than the log, and the gains to begin with.
    some = [_Rows(*(values[:TRIAL_ROWS] for values in rows[0]))] if len(rows[0].rate) >= SHORTEST else rows
    found = []
    for late in (False, True):
        axes = [_fit_axis(some, axis, arms[axis], late) for axis in range(3)]
        found.append((min(a.explained for a in axes), late, axes))
    _, late, axes = max(found, key=lambda f: f[0])
    if sum(len(r.rate) for r in rows) > sum(len(r.rate) for r in some):
        axes = [_fit_axis(rows, axis, arms[axis], late, axes[axis]) for axis in range(3)]
    explained = (throttle, *(a.explained for a in axes))
    if not min(explained) >= EXPLAINED:
        return None
    squares = np.concatenate([r.command for r in rows])
    yaw_torque = _limit(np.abs(squares @ arms[2]))
    slowest = 1.0 / _limit(1.0 / np.sqrt(squares.ravel()))
    gains = _gains(axes, yaw_torque, b, d, slowest, ceiling)
    return Autopilot(gains, FAST / windows[0].dt if late else None, "identified", explained)


class _Rows(NamedTuple):
    """One window: rotation error (n, 3), rate (n, 3), throttle (n,), squared commands (n, rotors), time step (n,)."""

    error: FloatArray
    rate: FloatArray
    throttle: FloatArray
    command: FloatArray
    time_step: FloatArray


def _rows(window: Window) -> _Rows | None:
    from scipy.spatial.transform import Rotation  # slow to load

    reference, attitude, gyro = window.attitude_reference, window.attitude, window.gyro
    if reference is None or attitude is None or gyro is None or window.sampling != "held":
        return None
    reference, attitude, gyro = (bridged(rows) for rows in (reference, attitude, gyro))
    if not np.isfinite(np.column_stack([reference, attitude, gyro])).all():
        return None
    is_ = Rotation.from_quat(attitude, scalar_first=True).as_matrix()
    wanted = Rotation.from_euler("ZYX", reference[:, 2::-1]).as_matrix()
    relative = np.einsum("nki,nkj->nij", is_, wanted)  # R' Rd
    skew = 0.5 * (relative - relative.transpose(0, 2, 1))
    error = np.column_stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]])
    return _Rows(error, gyro, reference[:, 3], window.rotor_speed**2, np.full(len(gyro), window.dt))


def _throttle(rows: Sequence[_Rows]) -> tuple[float, float]:
    """Explained share of the mean squared command by throttle, and the speed at full throttle [rad/s]."""
    throttle = np.concatenate([r.throttle for r in rows])
    lift = np.concatenate([r.command.mean(axis=1) for r in rows])
    power = float(throttle @ throttle)
    if power == 0.0:
        return 0.0, 0.0
    slope = float(throttle @ lift) / power
    return _explained(lift, slope * throttle), float(np.sqrt(max(slope, 0.0)))


def _explained(values: FloatArray, predicted: FloatArray) -> float:
    spread = float(np.sum((values - values.mean()) ** 2))
    return 1.0 - float(np.sum((values - predicted) ** 2)) / spread if spread > 0.0 else 0.0


def _fit_axis(rows: Sequence[_Rows], axis: int, arm: FloatArray, late: bool, known: _Axis | None = None) -> _Axis:
    """Fits one axis, from what is known if anything.

    With `late`, a row's command, the mean of faster ones, follows what is measured half a row later.
    """
    error, rate, torque = [], [], []
    for r in rows:
        e, w = r.error[:, axis], r.rate[:, axis]
        if late:
            e, w = (0.5 * (v + np.append(v[1:], v[-1])) for v in (e, w))
        error.append(e)
        rate.append(w)
        torque.append(r.command @ arm)
    step = float(rows[0].time_step[0])
    measured = np.concatenate(torque)
    scale, most = max(float(np.std(measured)), 1e-12), float(np.max(np.abs(measured)))

    def predicted(x: FloatArray) -> FloatArray:
        p, rate_p, rate_i, limit = np.exp(x[:4])
        parts = []
        for i, (e, w) in enumerate(zip(error, rate, strict=True)):
            miss = np.clip(p * e, -limit, limit) - w
            parts.append(rate_p * miss + rate_i * step * np.cumsum(miss) + scale * x[4 + i])
        return np.asarray(np.clip(np.concatenate(parts), -most, most))

    def residual(x: FloatArray) -> FloatArray:
        return (predicted(x) - measured) / scale

    start = np.concatenate([np.log([4.0, 1.0, 1.0, 3.0]), np.zeros(len(rows))])
    # The guesses of both rate gains follow from the size of the commands.
    start[1:3] += np.log(scale / max(float(np.std(predicted(start))), 1e-12))
    if known is not None and min(known[:4]) > 0.0:
        start[:4] = np.log(known[:4])
    evaluations = 60 if known is None else 20  # it begins near its end
    bounds = np.full((2, len(start)), 20.0) * np.array([[-1.0], [1.0]])
    bounds[1, 3] = np.log(_NO_LIMIT)
    start[:4] = np.clip(start[:4], bounds[0, :4] + 1e-6, bounds[1, :4] - 1e-6)
    from scipy.optimize import least_squares  # slow to import, and many logs hold no references

    found = least_squares(residual, start, bounds=bounds, loss="soft_l1", max_nfev=evaluations)
    p, rate_p, rate_i, limit = np.exp(found.x[:4])
    largest = p * max(float(np.max(np.abs(e))) for e in error)
    if largest <= limit:
        limit = 2.0 * largest  # never met, so it is only known to be no smaller than the largest reference
    return _Axis(float(p), float(rate_p), float(rate_i), float(limit), _explained(measured, predicted(found.x)))


def _limit(values: FloatArray) -> float:
    """Limit that positive values were held to, or one they never met: twice the largest."""
    largest = float(values.max())
    resting = np.count_nonzero(values > largest * (1.0 - 1e-9))
    return largest if resting >= _RESTING else 2.0 * largest


def _gains(
    axes: Sequence[_Axis], yaw_torque: float, b: float, d: float, slowest: float, fastest: float
) -> dict[str, float]:
    gains = {"yaw_rate_limit": axes[2].limit, "roll_pitch_rate_limit": max(axes[0].limit, axes[1].limit)}
    for name, axis in zip(_AXES, axes, strict=True):
        gains |= {f"{name}_p": axis.p, f"{name}_rate_p": axis.rate_p, f"{name}_rate_i": axis.rate_i}
    gains |= {"yaw_torque_limit": yaw_torque, "thrust_coefficient": b, "drag_coefficient": d}
    gains |= {"min_speed": slowest, "max_speed": fastest}
    return {name: gains[name] for name in GAIN_NAMES}
