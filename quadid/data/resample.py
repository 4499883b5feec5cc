"""One channel by itself: what was measured, faults, stretches without gaps, interpolation, and one low-pass for all.

Everything but `data_faults` takes plain arrays: times [s], shape (n,), and values, shape (n, columns), in any unit.
Policy (which channel, which rate) is in `quadid.data.grid`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from quadid.data.window import Window
from quadid.types import BoolArray, FloatArray, IndexArray

HALF_WIDTH = 4.0
"""Half-width of the low-pass kernel in steps of the new grid."""
CUTOFF = 0.4
"""Frequency where the low-pass halves the amplitude, as a fraction of the new grid's rate (0.5 is its Nyquist)."""
COINCIDENT = 5e-3
"""Samples this close to the grid, in steps, lie on it: they are passed on bit for bit."""
INTERPOLATED = 0.5
"""Share of moving rows on straight lines above which they were interpolated; logs as they were measured have none, a
log whose lost rows were filled in a tenth, one brought from 10 to 100 Hz nine tenths."""
_CHUNK = 4096


def sample_period(t: FloatArray) -> float:
    """Returns the sample period [s]: the mean of the steps up to 1.5 times the median one; NaN below two samples."""
    return period_of(t[1:] - t[:-1])


def measured_rows(t: FloatArray, values: FloatArray) -> BoolArray:
    """Rows that were measured, shape (n,); the others were put on straight lines between them before they were logged.

    Measured numbers do not lie on a line with both neighbours in every column while they move; where more than
    `INTERPOLATED` of all steps that move lead on along one, only its ends were measured.

    Args:
        t: times [s], shape (n,).
        values: columns at these times, shape (n, k).
    """
    out, step = np.ones(len(t), dtype=bool), np.diff(t)
    if len(t) < 3 or step.min() <= 0.0:
        return out
    moved = np.diff(values, axis=0)
    slope = moved / step[:, None]
    # Printed digits may put a row off its line.
    room = 1e-3 * np.std(moved, axis=0) + 1e-6 * np.max(np.abs(values), axis=0)
    bend: FloatArray = np.abs(np.diff(slope, axis=0)) * step[1:, None]
    on_line = np.all(bend <= room, axis=1)
    moves = np.any(moved[1:] != 0.0, axis=1)
    if np.any(moves) and np.mean(on_line[moves]) > INTERPOLATED:
        out[1:-1] = ~on_line
    return out


def measured_period(t: FloatArray, values: FloatArray) -> float:
    """Period [s] at which `values` were measured, see `fresh_rows`, `measured_rows` and `sample_period`."""
    fresh = fresh_rows(values)
    return sample_period(t[fresh][measured_rows(t[fresh], values[fresh])])


def period_of(steps: FloatArray) -> float:
    """As `sample_period`, of the steps between samples [s]."""
    if len(steps) == 0:
        return float("nan")
    low, high = float(steps.min()), float(steps.max())
    if low > 0.0 and high <= 1.5 * low:  # then the median leaves none out
        return float(np.add.reduce(steps) / len(steps))
    steps = steps[steps > 0.0]
    if len(steps) == 0:
        return float("nan")
    return float(np.mean(steps[steps <= 1.5 * median(steps)]))


def median(values: FloatArray) -> float:
    """Median of finite numbers, shape (n,), n > 0: numpy's to the bit, without the checks that cost more than it."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    low, high = np.partition(values, [middle - 1, middle])[middle - 1 : middle + 1]
    return float((low + high) / 2.0)


def split_stretches(t: FloatArray, longest_step: float, breaks: Sequence[float] = ()) -> list[slice]:
    """Cuts samples into stretches: never across a step longer than `longest_step` [s], nor across a break.

    A break at time b separates samples before b from samples at or after b.
    """
    if len(t) == 0:
        return []
    cuts = np.flatnonzero(t[1:] - t[:-1] > longest_step) + 1
    if not len(cuts) and not breaks:
        return [slice(0, len(t))]
    edges = np.searchsorted(t, np.asarray(breaks, dtype=np.float64), side="left")
    inner = np.unique(np.concatenate([cuts, edges[(edges > 0) & (edges < len(t))]]))
    bounds = [0, *(int(i) for i in inner), len(t)]
    return [slice(a, b) for a, b in zip(bounds[:-1], bounds[1:], strict=True)]


def matching_rows(t: FloatArray, at: FloatArray, step: float) -> IndexArray | None:
    """Returns the index of the sample at each time of `at`, or None unless each has one within `COINCIDENT` steps."""
    if len(t) == 0:
        return None
    index = np.clip(np.searchsorted(t, at - 0.5 * step), 0, len(t) - 1)
    near = np.abs(t[index] - at) <= COINCIDENT * step
    return index if bool(np.all(near)) else None


def linear(t: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """Values (n, columns) of times t (n,) at other times (m,), by straight lines; beyond the ends the last value."""
    return np.column_stack([np.interp(at, t, column) for column in values.T])


def interpolate(t: FloatArray, values: FloatArray, at: FloatArray, smooth: bool) -> FloatArray:
    """Interpolates one stretch at times inside it.

    Args:
        t: increasing times [s], shape (n,).
        values: shape (n, columns).
        at: times [s], shape (m,); NaN rows are returned outside [t[0], t[-1]].
        smooth: cubic through four neighbours (slopes by central differences), which keeps the amplitude of motion near
            the Nyquist frequency; else straight lines.
    """
    out = np.full((len(at), values.shape[1]), np.nan)
    inside = (at >= t[0]) & (at <= t[-1])
    if smooth and len(t) >= 4:
        out[inside] = _hermite(t, values, at[inside])
    else:
        out[inside] = linear(t, values, at[inside])
    return out


def _hermite(t: FloatArray, values: FloatArray, at: FloatArray) -> FloatArray:
    """Cubic Hermite interpolation with slopes by central differences at times within [t[0], t[-1]]."""
    slopes = np.gradient(values, t, axis=0)
    k = np.minimum(np.searchsorted(t, at, side="right") - 1, len(t) - 2)
    step = (t[k + 1] - t[k])[:, None]
    u = (at - t[k])[:, None] / step
    rise, begin, end = values[k + 1] - values[k], step * slopes[k], step * slopes[k + 1]
    bend = end + begin - 2.0 * rise
    return np.asarray(values[k] + u * (begin + u * ((rise - begin - bend) + u * bend)))


def moving_mean(values: FloatArray, width: int, mirrored: bool = False) -> FloatArray:
    """Mean of `width` neighbouring rows (the middle one at index width // 2), shape as `values`: (n,) or (n, columns).

    Beyond the ends the last value goes on, or the signal is mirrored.
    """
    before = width // 2
    pad = [(before, width - 1 - before), *([(0, 0)] * (values.ndim - 1))]
    padded = np.pad(values, pad, mode="symmetric" if mirrored else "edge")
    weights = np.full(width, 1.0 / width)
    columns = padded.reshape(len(padded), -1).T
    return np.column_stack([np.convolve(c, weights, mode="valid") for c in columns]).reshape(values.shape)


def hold_mean(t: FloatArray, values: FloatArray, at: FloatArray, step: float) -> FloatArray:
    """Averages a held signal over each [at, at + step): exactly what acted on average in that step.

    The sample at t_j acts until t_j+1; the last one goes on acting.
    """
    area = np.concatenate([np.zeros((1, values.shape[1])), np.cumsum(values[:-1] * np.diff(t)[:, None], axis=0)])

    def integral(x: FloatArray) -> FloatArray:
        row = np.clip(np.searchsorted(t, x, side="right") - 1, 0, len(t) - 1)
        return np.asarray(area[row] + values[row] * (x - t[row])[:, None])

    return (integral(at + step) - integral(at)) / step


@lru_cache(maxsize=1)
def _kernel_table() -> tuple[FloatArray, FloatArray, FloatArray]:
    """Tabulates lag [grid steps], kernel, and its running integral (0 to 1)."""
    lag = np.linspace(-HALF_WIDTH, HALF_WIDTH, 16001)
    # Kaiser's beta of 5 has its stop band about 53 dB down.  Less its value at the ends: a sample there weighs nothing.
    window = np.i0(5.0 * np.sqrt(np.clip(1.0 - (lag / HALF_WIDTH) ** 2, 0.0, 1.0))) - 1.0
    kernel = np.sinc(2.0 * CUTOFF * lag) * window
    area = np.concatenate([[0.0], np.cumsum(0.5 * (kernel[1:] + kernel[:-1]) * np.diff(lag))])
    return lag, kernel / area[-1], area / area[-1]


def lowpass(t: FloatArray, values: FloatArray, at: FloatArray, step: float, held: bool) -> FloatArray:
    """Low-passes one stretch with a symmetric kernel (no lag) and reads it at times `at`.

    Kernel: Kaiser-windowed sinc, half amplitude at `CUTOFF`/step, half-width `HALF_WIDTH` steps.  Instants are weighted
    by their share of time (trapezoidal rule, so jitter and a lost packet do no harm).  A held signal is integrated
    exactly as the staircase it is: its sample k acts from t_k to t_k+1 and so counts at the middle of that step.

    Args:
        t: increasing times [s] of one stretch, shape (n,).
        values: shape (n, columns).
        at: times [s]; each must be at least `HALF_WIDTH` steps inside the stretch (see `lowpass_span`).
        step: step of the new grid [s].
        held: staircase or instants.
    """
    if len(at) == 0:
        return np.empty((0, values.shape[1]))
    lag, kernel, area = _kernel_table()
    first = np.maximum(np.searchsorted(t, at - HALF_WIDTH * step) - 1, 0)
    taps = int(np.max(np.searchsorted(t, at + HALF_WIDTH * step, side="right") - first)) + 1
    # Only what the kernel reaches, and a sample on either side, is looked at.
    low, high = max(int(first.min()) - 1, 0), min(int(first.max()) + taps + 1, len(t))
    end = t[-1] + (sample_period(t) if held and len(t) > 1 else step) if high == len(t) else t[high]
    first, t, values = first - low, t[low:high], values[low:high]
    edges = np.append(t, end)
    share = np.gradient(t) if len(t) > 1 else np.array([step])
    out = np.empty((len(at), values.shape[1]))
    for begin in range(0, len(at), _CHUNK):
        rows = slice(begin, begin + _CHUNK)
        index = np.minimum(first[rows, None] + np.arange(taps), len(t) - 1)
        unique = first[rows, None] + np.arange(taps) < len(t)
        if held:
            upper = np.interp((at[rows, None] - edges[index]) / step, lag, area)
            lower = np.interp((at[rows, None] - edges[index + 1]) / step, lag, area)
            weight = (upper - lower) * unique
        else:
            distance = (at[rows, None] - t[index]) / step
            weight = np.interp(distance, lag, kernel, left=0.0, right=0.0) * share[index] * unique
        weight /= weight.sum(axis=1, keepdims=True)
        out[rows] = np.einsum("ij,ijk->ik", weight, values[index])
    return out


def lowpass_span(t: FloatArray, step: float, held: bool) -> tuple[float, float]:
    """Returns the first and last time [s] at which `lowpass` sees samples on both sides for its whole half-width."""
    tail = sample_period(t) if held and len(t) > 1 else 0.0
    return float(t[0]) + HALF_WIDTH * step, float(t[-1]) + tail - HALF_WIDTH * step


def true_runs(true: BoolArray) -> tuple[IndexArray, IndexArray]:
    """Where each run of True in an array (n,) begins, and where it has ended, shapes (runs,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]


def copied(values: FloatArray) -> BoolArray:
    """Which rows of (n, columns), from the second on, equal the row before exactly, shape (n - 1,)."""
    return np.asarray(np.all(values[1:] == values[:-1], axis=1))


def fresh_rows(values: FloatArray) -> IndexArray:
    """Returns the rows that bring a new reading, where a log repeats each reading several times; else all rows.

    A slow estimate written at a fast rate is a staircase, half a step late when read as instants.  A reading counts as
    repeated only when that is the rule (median run of equal rows at least 2; of over fifty, nearly all alike); runs far
    longer than usual are kept, for they are a signal that rests.
    """
    if len(values) < 20:
        return np.arange(len(values))
    start = np.concatenate([[0], np.flatnonzero(~copied(values)) + 1])
    run = np.diff(np.append(start, len(values)))
    usual = median(run.astype(np.float64))
    rare = len(start) < 0.02 * len(values) and (len(start) < 20 or np.quantile(run, 0.9) > 1.5 * usual)
    if usual < 2.0 or rare:
        return np.arange(len(values))
    keep = np.repeat(run > 5.0 * usual, run)
    keep[start] = True
    return np.flatnonzero(keep)


# --- Faults of the data themselves, seen without any model: a sensor at the end of its range, rows that are copies
#
# Both bend every estimate, and a cause named from them would be a stand-in.  Copies are no measurements and are left
# out; what a saturated sensor would have shown is not known, so nothing found beside it is called confident.
#
# A saturated axis piles up at exactly its largest or smallest value, far more often than at the value beside it, and
# comes back to it again and again.  Coarse steps of a converter pile up nowhere in particular, and a motor at rest
# stays at its lowest command without coming back.


LEAST_COPIES = 0.03
"""Share of inertial rows that equal the row before exactly."""


class AtLimit(NamedTuple):
    """One end of one axis at its limit.

    Attributes:
        axis: column.
        level: the value that is not left, in the unit of the values.
        samples: how many are there.
        share: of the column's finite samples.
    """

    axis: int
    level: float
    samples: int
    share: float


def at_limit(values: FloatArray) -> list[AtLimit]:
    """Returns the ends of axes that are saturated.

    Args:
        values: shape (n, axes), any unit; rows that are not finite do not count.
    """
    found = []
    for axis, column in enumerate(values.T):
        finite = column[np.isfinite(column)]
        levels, counts = np.unique(finite, return_counts=True)
        if len(levels) < 3:
            continue
        for end, beside in ((0, 1), (-1, -2)):
            count, share = int(counts[end]), float(counts[end] / len(finite))
            there = finite == levels[end]
            arrivals = np.count_nonzero(there[1:] & ~there[:-1])
            if share > 0.005 and count >= 6 and count > 4.0 * counts[beside] and arrivals >= 3:
                found.append(AtLimit(axis, float(levels[end]), count, share))
    return found


@dataclass(frozen=True)
class DataFault:
    """One fault of the data.

    Attributes:
        kind: ``saturated`` or ``repeated``.
        channel: name of the channel, with its axis where there is one.
        share: of the samples.
        text: one sentence with what to do.
    """

    kind: str
    channel: str
    share: float
    text: str


def data_faults(windows: Sequence[Window]) -> tuple[DataFault, ...]:
    """Looks for saturated and repeated inertial samples in `windows`; a flight without such faults gives none."""
    out: list[DataFault] = []
    for name, unit in (("gyro", "rad/s"), ("accel", "m/s²")):
        parts = [values for w in windows if (values := getattr(w, name)) is not None]
        for axis, level, _, share in at_limit(np.concatenate(parts)) if parts else ():
            text = (
                f"{name} {'xyz'[axis]} stays at exactly {level:.4g} {unit} in {share:.1%} of the samples: the sensor "
                "saturates; log it with a wider range, or fly more gently"
            )
            out.append(DataFault("saturated", f"{name} {'xyz'[axis]}", share, text))
        share = sum(np.count_nonzero(copied(p)) for p in parts) / max(sum(max(len(p) - 1, 0) for p in parts), 1)
        if share >= LEAST_COPIES:
            text = (
                f"{share:.0%} of the {name} rows are exact copies of the row before and were left out: the sensor is "
                "slower than the log, or the link repeats what it has; "
                "log the sensor's own samples with their own times"
            )
            out.append(DataFault("repeated", name, float(share), text))
    return tuple(out)


def without_copies(windows: Sequence[Window]) -> list[Window]:
    """Windows in which inertial rows that equal the row before exactly count as not measured."""
    out = []
    for window in windows:
        changed = {}
        for name in ("gyro", "accel"):
            values = getattr(window, name)
            if values is None:
                continue
            copies = np.flatnonzero(copied(values)) + 1
            if len(copies) >= LEAST_COPIES * len(values):
                kept = values.copy()
                kept[copies] = np.nan
                changed[name] = kept
        out.append(replace(window, **changed) if changed else window)
    return out
