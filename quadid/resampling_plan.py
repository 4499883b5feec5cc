"""Channels on their way to the grid: what each one's samples are worth there, and how it is read at grid times."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np

from quadid.resample import (
    COINCIDENT,
    fresh_rows,
    hold_mean,
    interpolate,
    lowpass,
    lowpass_span,
    matching_rows,
    median,
    sample_period,
    split_stretches,
)
from quadid.types import FloatArray
from quadid.window import Recording, Sampling

GAP = 3.5
"""A step longer than this many median ones is a gap."""
BRIDGED = 0.5
"""A step no longer than this fraction of the grid's is never a gap: hardly anything shows of it on the grid."""
HOLE = 1.5
"""A step longer than this many median ones, and no gap, is a hole: it is bridged and counted."""
_FAST = 0.77
"""A channel whose period is below this many grid steps must be low-passed before it is read on the grid."""
REQUIRED = ("rotor_speed", "gyro", "accel")
OPTIONAL = ("attitude", "velocity", "position", "battery", "attitude_reference")


@dataclass(frozen=True)
class Track:
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


class Plan(NamedTuple):
    """Grid step [s], whether fast channels are low-passed for it, tracks by channel, meaning of the rotor rows."""

    step: float
    filtered: bool
    tracks: dict[str, Track]
    sampling: Sampling


def make_plan(recording: Recording, t: FloatArray, speeds: FloatArray, sampling: Sampling, rate: float | None) -> Plan:
    """Prepares all channels; `t`, `speeds` [rad/s], `sampling`: rotor signal; `rate` [Hz]: None for the log's own."""
    raw = {"rotor_speed": (t, speeds)}
    for name in (*REQUIRED[1:], *OPTIONAL):
        channel = recording.channels.get(name)
        if channel is not None and len(channel.t) >= 2:
            raw[name] = (channel.t, channel.values)
    raw = {name: _distinct(*pair) for name, pair in raw.items()}
    periods = {name: sample_period(times) for name, (times, _) in raw.items()}
    own = periods.get("gyro", periods["rotor_speed"])
    step = round(own, 9) if rate is None else 1.0 / rate
    filtered = min(periods[n] for n in REQUIRED if n in raw) < _FAST * step
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
        tracks[name] = Track(times, values, period, cuts, name == "rotor_speed" and sampling == "held")
    return Plan(step, filtered, tracks, "instant" if filtered else sampling)


def longest_step(t: FloatArray, grid_step: float) -> float:
    """Returns the longest step [s] between samples at `t` that is no gap on a grid of `grid_step` [s]."""
    return max(GAP * median(np.diff(t)), BRIDGED * grid_step)


def holes(t: FloatArray, grid_step: float) -> int:
    """Counts the lost samples that are bridged: steps longer than `HOLE` median ones that are no gap."""
    steps = np.diff(t)
    return int(np.count_nonzero((steps > HOLE * median(steps)) & (steps <= longest_step(t, grid_step))))


def _distinct(t: FloatArray, values: FloatArray) -> tuple[FloatArray, FloatArray]:
    rising = t[1:] > t[:-1]
    if bool(rising.all()):
        return t, values
    keep = np.concatenate([[True], rising])
    return t[keep], values[keep]


def _is_filtered(track: Track, plan: Plan) -> bool:
    """A channel slower than the grid is not low-passed, but a staircase always is: it is known between its samples."""
    return plan.filtered and (track.held or track.period <= 1.1 * plan.step)


def reach(track: Track, cut: slice, plan: Plan) -> tuple[float, float]:
    """Returns the first and last time [s] at which one stretch of a track can be read on the grid."""
    t = track.t[cut]
    if _is_filtered(track, plan):
        return lowpass_span(t, plan.step, track.held)
    return float(t[0]), float(t[-1])


def on_grid(name: str, track: Track, at: FloatArray, plan: Plan) -> FloatArray:
    """Reads one channel at the grid times; NaN where nothing was measured."""
    out = np.full((len(at), track.values.shape[1]), np.nan)
    tolerance = COINCIDENT * plan.step
    for cut in track.stretches_within(at[0] - tolerance, at[-1] + tolerance):
        a, b = reach(track, cut, plan)
        rows = np.flatnonzero((at >= a - tolerance) & (at <= b + tolerance))
        if len(rows):
            out[rows] = _stretch_on_grid(name, track, cut, np.clip(at[rows], a, b), plan)
    return out


def _stretch_on_grid(name: str, track: Track, cut: slice, at: FloatArray, plan: Plan) -> FloatArray:
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
    elif name == "rotor_speed" or track.period <= 1.33 * step:
        out = interpolate(t, values, at, smooth=track.period <= 1.33 * step)
    else:
        out = _at_nearest(t, interpolate(t, values, at, smooth=False), at, step)
    if name == "attitude":
        out = out / np.linalg.norm(out, axis=1, keepdims=True)
    elif name == "attitude_reference":
        out[:, :3] = np.remainder(out[:, :3] + np.pi, 2.0 * np.pi) - np.pi
    return out


def _at_nearest(t: FloatArray, values: FloatArray, at: FloatArray, step: float) -> FloatArray:
    """Keeps only the grid rows nearest to a real sample."""
    after = np.clip(np.searchsorted(t, at), 0, len(t) - 1)
    before = np.maximum(after - 1, 0)
    distance = np.minimum(np.abs(t[after] - at), np.abs(at - t[before]))
    out: FloatArray = np.where((distance <= 0.5 * step)[:, None], values, np.nan)
    return out
