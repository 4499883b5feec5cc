"""Open-loop prediction error: how far the simulation, started from the measured state, has drifted after h samples.

Every sample starts one run, driven by the logged rotor speeds held over each sample; runs never cross a gap or a file.
Errors are Euclidean for vectors and the angle of the relative rotation (q and -q alike), as in the IDSIA nano-drone
benchmark.  Rates are compared as the gyro would read them: bias, scale and misalignment of the model are taken off the
measured rate at the start and put on the predicted one.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.errors import NotIdentifiableError, ParameterError
from quadid.model import layout as ix
from quadid.model.kernel import N_STATE
from quadid.model.rollout import Rollout, Segments
from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]
Mask = NDArray[np.bool_]

QUANTITIES: dict[str, str] = {"position": "m", "velocity": "m/s", "rotation": "rad", "rate": "rad/s"}
"""What is scored, with units."""
HORIZONS = (1, 10, 50)
SUM_TO = 50
"""The summed score adds the mean errors of the first fifty samples."""
LONGEST = 2000
_CHUNK = 256
"""Starts rolled at once; keeps the residuals of a chunk in cache."""


@dataclass(frozen=True)
class HorizonScore:
    """Pooled errors of all starts.

    Attributes:
        samples: number of starts.
        mean: mean error by sample after the start, shape (longest, 4), columns as `QUANTITIES`; row h - 1 is h samples
            on; NaN for what the log lacks.
        horizons: those asked for.
        sum_to: number of rows in `sum`.
    """

    samples: int
    mean: FloatArray
    horizons: tuple[int, ...]
    sum_to: int = SUM_TO

    def at(self, horizon: int) -> dict[str, float]:
        """Mean error after `horizon` samples by quantity; NaN for what the log lacks."""
        return dict(zip(QUANTITIES, self.mean[horizon - 1].tolist(), strict=True))

    @property
    def sum(self) -> dict[str, float]:
        """Sum of the mean errors after 1, 2, … `sum_to` samples, by quantity."""
        return dict(zip(QUANTITIES, self.mean[: self.sum_to].sum(axis=0).tolist(), strict=True))


@dataclass(frozen=True)
class _Tally:
    """Summed errors and their counts, both (longest, 4), and the number of starts."""

    total: FloatArray
    count: FloatArray
    samples: int

    def __add__(self, other: _Tally) -> _Tally:
        return _Tally(self.total + other.total, self.count + other.count, self.samples + other.samples)


def horizon_scores(
    files: Sequence[Sequence[Window]], vehicle: Vehicle, theta: FloatArray, horizons: Sequence[int] = HORIZONS
) -> tuple[HorizonScore, list[HorizonScore]]:
    """Scores `theta` on several files.

    Args:
        files: windows of each file, on the file's grid.
        vehicle: geometry and mass.
        theta: full parameter vector, shape (size,); see `Layout.initial` for that of a vehicle file.
        horizons: samples after the start, 1 to `LONGEST`.

    Returns:
        The score pooled over all starts, and that of each file (with no samples where no run fits).

    Raises:
        ParameterError: impossible horizons.
        NotIdentifiableError: no run fits into any file, or there is no gyro.
    """
    wanted = tuple(dict.fromkeys(int(h) for h in horizons))
    if not wanted or min(wanted) < 1 or max(wanted) > LONGEST:
        raise ParameterError(f"horizons {list(horizons)}", f"whole numbers of samples from 1 to {LONGEST}")
    longest = max(*wanted, SUM_TO)
    tallies = [_file_tally(windows, vehicle, theta, longest) for windows in files]
    pooled = _empty(longest)
    for tally in tallies:
        pooled = pooled + tally
    if pooled.samples == 0:
        raise NotIdentifiableError(
            f"no run of {longest} samples fits: measured rate, and no gap for {longest} samples after it",
            f"stretches longer than {longest} samples with gyro", "log without gaps, or ask for a lower --rate",
        )  # fmt: skip
    return _score(pooled, wanted), [_score(tally, wanted) for tally in tallies]


def _empty(longest: int) -> _Tally:
    return _Tally(np.zeros((longest, 4)), np.zeros((longest, 4)), 0)


def _score(tally: _Tally, horizons: tuple[int, ...]) -> HorizonScore:
    mean = np.divide(tally.total, tally.count, out=np.full_like(tally.total, np.nan), where=tally.count > 0)
    mean.setflags(write=False)
    return HorizonScore(tally.samples, mean, horizons)


def _file_tally(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, longest: int) -> _Tally:
    tally = _empty(longest)
    for window in windows:
        if len(window) > longest:
            tally = tally + _window_tally(window, vehicle, theta, longest)
    return tally


def rate_errors(windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, samples: int) -> FloatArray:
    """Error of the predicted body rates `samples` after every start, axis by axis.

    Args:
        windows: of one or more files, on one grid.
        vehicle: geometry and mass.
        theta: full parameter vector, shape (size,).
        samples: horizon, 1 to `LONGEST`.

    Returns:
        Predicted - measured p, q, r [rad/s], body FRD, shape (starts, 3), windows one after the other; rows without a
        measurement at the target are left out.
    """
    parts = []
    for window in windows:
        if len(window) > samples:
            for _, residual, valid in _runs(window, vehicle, theta, samples):
                parts.append(residual[valid[:, samples - 1], samples - 1, :3])
    return np.concatenate(parts) if parts else np.zeros((0, 3))


def _runs(
    window: Window, vehicle: Vehicle, theta: FloatArray, longest: int
) -> Iterator[tuple[NDArray[np.intp], FloatArray, Mask]]:
    """Rolls from every measured rate: rows of starts, residual (starts, longest, channels), measured rate at target."""
    known = _finite(window)
    states = initial_states(window, theta, known)
    starts = np.flatnonzero(known["gyro"][: len(window) - longest])
    rollout = Rollout(_padded(window), vehicle)
    for first in range(0, len(starts), _CHUNK):
        rows = starts[first : first + _CHUNK]
        segments = Segments(longest, 1, (rows + 1).astype(np.int64))
        residual = rollout.roll(segments, theta[None], np.ascontiguousarray(states[rows]))[0][0, ..., 0]
        yield rows, residual, rollout.valid[:, 0][rows[:, None] + 1 + np.arange(longest)]


def _window_tally(window: Window, vehicle: Vehicle, theta: FloatArray, longest: int) -> _Tally:
    known = _finite(window)
    valid = Rollout(_padded(window), vehicle).valid
    tally = _empty(longest)
    for rows, residual, _ in _runs(window, vehicle, theta, longest):
        tally = tally + _tally(residual, valid, rows, longest, known)
    return tally


def _padded(window: Window) -> Window:
    """The window as held, with one more row, which the simulation rolls into but nothing is compared with."""

    def extended(values: FloatArray | None, fill: float | None = np.nan) -> FloatArray | None:
        if values is None:
            return None
        last = values[-1:] if fill is None else np.full_like(values[-1:], fill)
        return np.concatenate([values, last])

    rotor = extended(window.rotor_speed, None)
    assert rotor is not None
    return replace(
        window,
        rotor_speed=rotor,
        gyro=extended(window.gyro),
        attitude=extended(window.attitude),
        accel=None,
        velocity=extended(window.velocity),
        position=extended(window.position),
        battery=None,
        attitude_reference=None,
        sampling="held",
    )


def _finite(window: Window) -> dict[str, Mask]:
    """Rows at which each channel was measured."""
    out = {}
    for name in ("gyro", "attitude", "velocity", "position"):
        values = getattr(window, name)
        out[name] = np.zeros(len(window), dtype=bool) if values is None else np.isfinite(values).all(axis=1)
    return out


def initial_states(window: Window, theta: FloatArray, known: dict[str, Mask]) -> FloatArray:
    """Measured state of every row, shape (rows, 13): attitude, rate, velocity, position; level, at rest if unknown."""
    x = np.zeros((len(window), N_STATE))
    x[:, 0] = 1.0
    for name, place in (("attitude", 0), ("velocity", 7), ("position", 10)):
        values = getattr(window, name)
        if values is not None:
            x[known[name], place : place + values.shape[1]] = values[known[name]]
    if window.gyro is not None:
        x[known["gyro"], 4:7] = true_rate(window.gyro[known["gyro"]], theta)
    return x


def true_rate(measured: FloatArray, theta: FloatArray) -> FloatArray:
    """Undoes the model's gyro: measured = (1 + s) exp([m]x) rate + bias, element by element in s; shapes (n, 3)."""
    m = theta[[ix.MAX_, ix.MAY, ix.MAZ]]
    cross = np.array([[0.0, -m[2], m[1]], [m[2], 0.0, -m[0]], [-m[1], m[0], 0.0]])
    mounting = np.eye(3) + cross + 0.5 * cross @ cross  # to second order, as the kernel has it
    sensor = (measured - theta[[ix.GBX, ix.GBY, ix.GBZ]]) / (1.0 + theta[[ix.GSX, ix.GSY, ix.GSZ]])
    return np.asarray(np.linalg.solve(mounting, sensor.T).T)


def _tally(
    residual: FloatArray, valid: Mask, rows: NDArray[np.intp], longest: int, known: dict[str, Mask]
) -> _Tally:  # fmt: skip
    """Adds up the errors of runs from `rows`; residual (starts, longest, channels), predicted - measured.

    A quantity counts where it was measured at the target and the start was known well enough: a velocity needs attitude
    and velocity at the start, a position its own start too.
    """
    errors = np.zeros((len(rows), longest, 4))
    channels = residual.shape[2]
    if channels == 15:
        errors[..., 0] = np.linalg.norm(residual[..., 12:15], axis=2)
    if channels >= 12:
        errors[..., 1] = np.linalg.norm(residual[..., 9:12], axis=2)
    errors[..., 2] = 2.0 * np.arcsin(np.minimum(0.5 * np.linalg.norm(residual[..., 3:6], axis=2), 1.0))
    errors[..., 3] = np.linalg.norm(residual[..., :3], axis=2)
    at = rows[:, None] + 1 + np.arange(longest)
    attitude = known["attitude"][rows]
    velocity = attitude & known["velocity"][rows]
    position = velocity & known["position"][rows]
    columns = ((12, position), (9, velocity), (3, attitude), (0, known["gyro"][rows]))
    counts = np.zeros(errors.shape, dtype=bool)
    for i, (channel, started) in enumerate(columns):
        if channel < channels:
            counts[..., i] = valid[:, channel][at] & started[:, None]
    # A run that overflowed has an infinite error, not none.
    errors = np.where(counts, np.nan_to_num(errors, nan=np.inf, posinf=np.inf), 0.0)
    return _Tally(errors.sum(axis=0), counts.sum(axis=0).astype(np.float64), len(rows))
