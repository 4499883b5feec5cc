"""Recordings to windows: channels onto uniform grids, by interpolation, holding, or one zero-phase low-pass."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Any, NamedTuple

import numpy as np

from quadid.data.intersample import follow_feedback
from quadid.data.rotor_signal import rotor_signal
from quadid.data.window import (
    COINCIDENT,
    Recording,
    Sampling,
    Window,
    fresh_rows,
    in_body_axes,
    measured_period,
    median,
    sample_period,
)
from quadid.errors import LogError, NotIdentifiableError
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import Vehicle

# --- One channel: stretches without gaps, interpolation, and the low-pass for all
#
# All of it takes plain arrays: times [s], shape (n,), and values, shape (n, columns), in any unit.


HALF_WIDTH = 4.0
"""Half-width of the low-pass kernel in steps of the new grid."""
CUTOFF = 0.4
"""Frequency where the low-pass halves the amplitude, as a fraction of the new grid's rate (0.5 is its Nyquist)."""
_CHUNK = 4096


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


# --- Channels on their way to the grid: what each one's samples are worth there, and how it is read at grid times


GAP = 3.5
"""A step longer than this many median ones is a gap."""
HOLE = 1.5
"""A step longer than this many median ones, and no gap, is a hole: it is bridged and counted."""
_FAST = 0.77
"""A channel whose period is below this many grid steps must be low-passed before it is read on the grid."""
REQUIRED = ("rotor_speed", "gyro", "accel")
OPTIONAL = ("attitude", "velocity", "position", "battery", "attitude_reference")


@dataclass(frozen=True)
class ChannelTrack:
    """One channel on its way to the grid; times strictly increase, `period` [s] is that of its samples."""

    t: FloatArray
    values: FloatArray
    period: float
    stretches: tuple[slice, ...]
    held: bool = False

    @cached_property
    def begins(self) -> FloatArray:
        """Time [s] of the first sample of each stretch."""
        return self.t[[cut.start for cut in self.stretches]]

    @cached_property
    def ends(self) -> FloatArray:
        """Time [s] of the last sample of each stretch."""
        return self.t[[cut.stop - 1 for cut in self.stretches]]

    def stretches_within(self, first: float, last: float) -> tuple[slice, ...]:
        """Returns the stretches that have a sample in [first, last] [s] or span it."""
        begin, end = np.searchsorted(self.ends, first, "left"), np.searchsorted(self.begins, last, "right")
        return self.stretches[int(begin) : int(end)]


class GridPlan(NamedTuple):
    """Grid step [s], whether fast channels are low-passed for it, tracks by channel, meaning of the rotor rows."""

    step: float
    filtered: bool
    tracks: dict[str, ChannelTrack]
    sampling: Sampling


def make_plan(
    recording: Recording, t: FloatArray, speeds: FloatArray, sampling: Sampling, rate: float | None
) -> GridPlan:
    """Prepares all channels; `t`, `speeds` [rad/s], `sampling`: rotor signal; `rate` [Hz]: None for the log's own."""
    raw = {"rotor_speed": (t, speeds)}
    for name in (*REQUIRED[1:], *OPTIONAL):
        channel = recording.channels.get(name)
        if channel is not None and len(channel.t) >= 2:
            raw[name] = (channel.t, channel.values)
    raw = {name: _distinct(*pair) for name, pair in raw.items()}
    # The step of the grid, and whether any channel is so fast for it that all must be low-passed alike.
    periods = {name: sample_period(times) for name, (times, _) in raw.items()}
    own = periods.get("gyro", periods["rotor_speed"])
    step = round(own, 9) if rate is None else 1.0 / rate
    filtered = min(periods[n] for n in REQUIRED if n in raw) < _FAST * step
    # Repeated readings are none where a low-pass would smear them; stretches end at gaps and breaks.
    tracks = {}
    for name, (times, values) in raw.items():
        period, longest = periods[name], longest_step(times, step)
        if filtered and name in ("attitude", "velocity", "position", "gyro"):
            rows = fresh_rows(values)
            if len(rows) < len(times):
                times, values = times[rows], values[rows]
                period = sample_period(times)
                longest = longest_step(times, step) if len(times) > 1 else period  # stuck: there is no period
        cuts = tuple(split_stretches(times, longest, recording.breaks))
        tracks[name] = ChannelTrack(times, values, period, cuts, name == "rotor_speed" and sampling == "held")
    return GridPlan(step, filtered, tracks, "instant" if filtered else sampling)


def longest_step(t: FloatArray, grid_step: float) -> float:
    """Longest step [s] between samples at `t` that is no gap on a grid of `grid_step` [s], half of which never is."""
    return max(GAP * median(np.diff(t)), 0.5 * grid_step)


def holes(t: FloatArray, grid_step: float) -> int:
    """Counts the lost samples that are bridged: steps longer than `HOLE` median ones that are no gap."""
    steps = np.diff(t)
    return int(np.count_nonzero((steps > HOLE * median(steps)) & (steps <= longest_step(t, grid_step))))


def bridged(values: FloatArray) -> FloatArray:
    """Rows on a grid (n, columns), lost ones by straight lines; as they are where a third and more was not measured."""
    good, rows = np.isfinite(values).all(axis=1), np.arange(len(values), dtype=np.float64)
    if bool(good.all()) or float(good.mean()) * HOLE < 1.0:
        return values
    return linear(rows[good], values[good], rows)


def _distinct(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    rising = t[1:] > t[:-1]
    if bool(rising.all()):
        return t, values
    keep = np.concatenate([[True], rising])
    return t[keep], values[keep]


def _is_filtered(track: ChannelTrack, plan: GridPlan) -> bool:
    """A channel slower than the grid is not low-passed, but a staircase always is: it is known between its samples."""
    return plan.filtered and (track.held or track.period <= 1.1 * plan.step)


def reach(track: ChannelTrack, cut: slice, plan: GridPlan) -> tuple[float, float]:
    """Returns the first and last time [s] at which one stretch of a track can be read on the grid."""
    t = track.t[cut]
    if _is_filtered(track, plan):
        return lowpass_span(t, plan.step, track.held)
    return float(t[0]), float(t[-1])


def on_grid(name: str, track: ChannelTrack, at: FloatArray, plan: GridPlan) -> FloatArray:
    """Reads one channel at the grid times; NaN where nothing was measured."""
    out = np.full((len(at), track.values.shape[1]), np.nan)
    tolerance = COINCIDENT * plan.step
    for cut in track.stretches_within(at[0] - tolerance, at[-1] + tolerance):
        a, b = reach(track, cut, plan)
        rows = np.flatnonzero((at >= a - tolerance) & (at <= b + tolerance))
        if len(rows):
            out[rows] = _stretch_on_grid(name, track, cut, np.clip(at[rows], a, b), plan)
    return out


def _stretch_on_grid(name: str, track: ChannelTrack, cut: slice, at: FloatArray, plan: GridPlan) -> FloatArray:
    t, values, step = track.t[cut], track.values[cut], plan.step
    filtered = _is_filtered(track, plan)
    if not filtered:
        rows = matching_rows(t, at, step)
        if rows is not None:
            return np.asarray(values[rows])
    if name == "attitude_reference":
        values = np.column_stack([np.unwrap(values[:, :3], axis=0), values[:, 3]])
    if filtered:
        out = lowpass(t, values, at, step, track.held)
    elif track.held:
        out = hold_mean(t, values, at, step)
    else:
        fast = track.period <= 1.33 * step
        out = interpolate(t, values, at, smooth=fast)
        # Inputs act between their samples; what is measured is known there only, lost samples least.
        if name != "rotor_speed" and not (fast and name == "attitude_reference"):
            after = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
            distance = np.minimum(np.abs(t[after] - at), np.abs(at - t[np.maximum(after - 1, 0)]))
            out = np.where((distance <= 0.5 * (HOLE * step if fast else step))[:, None], out, np.nan)
    if name == "attitude":
        out = out / np.linalg.norm(out, axis=1, keepdims=True)
    elif name == "attitude_reference":
        out[:, :3] = np.remainder(out[:, :3] + np.pi, 2.0 * np.pi) - np.pi
    return out


# --- Merges the channels of a recording onto uniform grids: recording -> windows
#
# No lag is invented.  When the log is faster than the grid, one symmetric low-pass goes over all fast channels alike,
# rotor speeds included; channels slower than the grid stay untouched and are NaN between their samples.  Gaps and
# breaks (reboots, clock steps) end a window; nothing is joined across them.


Span = tuple[float, float]

WHOLE: Span = (-math.inf, math.inf)
"""All of a log."""
SHORTEST = 1.0
"""Windows shorter than this [s] are dropped where a rate was asked for."""


@dataclass(frozen=True)
class GridReport:
    """Account of a recording on its way to windows.

    Attributes:
        rate: grid rate [Hz].
        seconds_used: time inside windows [s].
        seconds_log: first to last sample of the log [s].
        gaps: number of places where the log was cut (gaps and breaks).
        dropped: number of stretches too short to keep.
        seconds_dropped: time in them [s].
        rotor_source: where the rotor speeds came from.
        rotor_rate: their own rate in the log [Hz].
        filtered: whether the channels were low-passed for the grid.
        bridged: number of holes in rotor signal, gyro and accelerometer too short for a gap; nothing is measured there.
    """

    rate: float
    windows: int
    seconds_used: float
    seconds_log: float
    gaps: int
    dropped: int
    seconds_dropped: float
    rotor_source: str
    rotor_rate: float
    filtered: bool
    bridged: int = 0
    notes: tuple[str, ...] = ()


class Gridded(NamedTuple):
    """Windows and the account of how they were made."""

    windows: list[Window]
    report: GridReport


def to_windows(
    recording: Recording,
    vehicle: Vehicle,
    rate: float | None = 50.0,
    start: float | None = None,
    stop: float | None = None,
) -> list[Window]:
    """Merges what lies between `start` and `stop` [s] onto uniform grids; see `grid_recording` for the rest."""
    part = -math.inf if start is None else start, math.inf if stop is None else stop
    return grid_recording(recording, vehicle, rate, [part]).windows


def grid_recording(
    recording: Recording, vehicle: Vehicle, rate: float | None = 50.0, parts: Sequence[Span] = (WHOLE,)
) -> Gridded:
    """Merges the channels of a recording onto uniform grids, one per stretch without gaps.

    A log whose rows already lie on the grid passes bit for bit.  Down-sampled commands come out as ``instant``, for the
    filtered staircase has a value at an instant; commands at the grid's own rate stay ``held``, with the slope within
    each sample that the flight controller's feedback makes (`quadid.data.rotor_signal`).

    Args:
        recording: a log in core units and frames.
        vehicle: defines what the rotor columns mean and how many there must be.
        rate: grid rate [Hz]; None for the log's own (that of its gyro, else of its rotor signal).
        parts: first and last time [s] of each part to use, rising, in the recording's time.

    Raises:
        LogError: no rotor signal, rotor columns that do not fit the vehicle, or no usable stretch.
        NotIdentifiableError: a rotor signal too slow to mean anything.
    """
    if rate is not None and not (math.isfinite(rate) and 1.0 <= rate <= 2000.0):
        raise LogError(f"grid rate {rate} Hz", "1 to 2000 Hz", "leave it out for 50 Hz")
    recording = in_body_axes(recording, vehicle)
    rotor = rotor_signal(recording, vehicle)
    plan = make_plan(recording, rotor.t, rotor.values, rotor.sampling, rate)
    # Windows where every required channel is there, without gaps and breaks, inside the parts that are asked for.
    required, spans = [plan.tracks[name] for name in REQUIRED if name in plan.tracks], [(-math.inf, math.inf)]
    for track in required:
        spans = _common(spans, list(zip(track.begins.tolist(), track.ends.tolist(), strict=True)))
    shortest = SHORTEST if rate is not None else 0.0
    log_span = recording.span
    windows: list[Window] = []
    dropped: list[float] = []
    for span in spans:
        # The low-pass, if there is one, needs samples on both sides in every required channel.
        ends = [reach(track, cut, plan) for track in required for cut in track.stretches_within(*span)]
        a, b = max([span[0], *(low for low, _ in ends)]), min([span[1], *(high for _, high in ends)])
        for low, high in _common([span], parts):
            at = _grid_times(plan, max(a, low), min(b, high))
            if len(at) >= 2 and (len(at) - 1) * plan.step >= shortest - 0.5 * plan.step:
                read = {name: on_grid(name, track, at, plan) for name, track in plan.tracks.items()}
                kept: dict[str, Any] = {name: values for name, values in read.items() if not np.isnan(values).all()}
                kept |= {"sampling": plan.sampling, "name": recording.name, "log_span": log_span}
                windows.append(Window(float(at[0]), plan.step, **kept))
            elif low < high:
                dropped.append(high - low)
    if not windows:
        longest = max((b - a for a, b in spans), default=0.0)
        raise _nothing_left(recording, longest, max(shortest, 2.0 * plan.step), parts)
    windows, followed = follow_feedback(windows, vehicle)
    period, notes = measured_period(rotor.t, rotor.values), list(rotor.notes)
    if period > 1.5 * plan.step:
        notes.append(
            f"rotor signal at {1 / period:.3g} Hz is slower than the grid at {1 / plan.step:.3g} Hz: "
            "fast motion cannot be attributed to the rotors"
        )
    report = GridReport(
        rate=1.0 / plan.step,
        windows=len(windows),
        seconds_used=sum((len(w) - 1) * w.dt for w in windows),
        seconds_log=log_span[1] - log_span[0],
        gaps=len(spans) - 1,
        dropped=len(dropped),
        seconds_dropped=sum(dropped),
        rotor_source=rotor.source,
        rotor_rate=1.0 / period,
        filtered=plan.filtered,
        bridged=sum(holes(track.t, plan.step) for track in required),
        notes=(*notes, *([followed] if followed else [])),
    )
    return Gridded(windows, report)


def _common(one: Sequence[Span], other: Sequence[Span]) -> list[Span]:
    """Intersects two rising lists of spans."""
    out, i, j = [], 0, 0
    while i < len(one) and j < len(other):
        a, b = max(one[i][0], other[j][0]), min(one[i][1], other[j][1])
        if a <= b:
            out.append((a, b))
        if one[i][1] < other[j][1]:
            i += 1
        else:
            j += 1
    return out


def _grid_times(plan: GridPlan, a: float, b: float) -> FloatArray:
    """Returns the grid in [a, b]; its first point is a sample of the gyro, else of the rotor signal."""
    tolerance = COINCIDENT * plan.step
    t = plan.tracks["gyro" if "gyro" in plan.tracks else "rotor_speed"].t
    first = int(np.searchsorted(t, a - tolerance))
    if first >= len(t) or t[first] > b + tolerance:
        return np.empty(0)
    return np.asarray(t[first] + plan.step * np.arange(math.floor((b - t[first] + tolerance) / plan.step) + 1))


def _nothing_left(
    recording: Recording, longest: float, needed: float, parts: Sequence[Span]
) -> LogError | NotIdentifiableError:
    if tuple(parts) != (WHOLE,):
        # In the time in which people ask for a part.
        zero = recording.first_imu_time
        first, last = (t - zero for t in recording.span)
        asked = " nor ".join(f"{a - zero:g} and {b - zero:g} s" for a, b in parts)
        return LogError(
            f"{recording.name}: nothing to use between {asked}",
            f"{first:z.1f} to {last:z.1f} s after its first IMU sample",
            "see `quadid inspect` for the flying spans",
        )
    return NotIdentifiableError(
        f"{recording.name}: the longest stretch with rotor signal and IMU and without gaps is {longest:.3g} s",
        f"at least {needed:.3g} s",
        "log at a steady rate, or ask for a lower --rate",
    )
