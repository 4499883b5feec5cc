"""Merges the channels of a recording onto uniform grids: recording -> windows.

No lag is invented.  When the log is faster than the grid, one symmetric low-pass goes over all fast channels alike,
rotor speeds included; channels slower than the grid stay untouched and are NaN between their samples.  Gaps and breaks
(reboots, clock steps) end a window; nothing is joined across them.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from quadid.errors import LogError, NotIdentifiableError
from quadid.intersample import follow_feedback
from quadid.mounting import in_body_axes
from quadid.resample import COINCIDENT, measured_period
from quadid.resampling_plan import REQUIRED, Plan, holes, make_plan, on_grid, reach
from quadid.rotor_signal import RotorSignal, rotor_signal
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid.window import Recording, Window

Span = tuple[float, float]

WHOLE: Span = (-math.inf, math.inf)
"""All of a log."""
SHORTEST = 1.0
"""Windows shorter than this [s] are dropped where a rate was asked for."""


@dataclass(frozen=True)
class GridReport:
    """What became of a recording on its way to windows.

    Attributes:
        rate: grid rate [Hz].
        windows: number of windows kept.
        seconds_used: time inside windows [s].
        seconds_log: first to last sample of the log [s].
        gaps: number of places where the log was cut (gaps and breaks).
        dropped: number of stretches too short to keep.
        seconds_dropped: time in them [s].
        rotor_source: where the rotor speeds came from.
        rotor_rate: their own rate in the log [Hz].
        filtered: whether the channels were low-passed for the grid.
        bridged: number of holes in rotor signal, gyro and accelerometer too short for a gap, read between neighbours.
        notes: sentences for people.
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
    recording: Recording, vehicle: Vehicle, rate: float | None = 50.0, start: float | None = None,
    stop: float | None = None,
) -> list[Window]:  # fmt: skip
    """Merges what lies between `start` and `stop` [s] onto uniform grids; see `grid_recording` for the rest."""
    part = -math.inf if start is None else start, math.inf if stop is None else stop
    return grid_recording(recording, vehicle, rate, [part]).windows


def grid_recording(
    recording: Recording, vehicle: Vehicle, rate: float | None = 50.0, parts: Sequence[Span] = (WHOLE,)
) -> Gridded:
    """Merges the channels of a recording onto uniform grids, one per stretch without gaps.

    A log whose rows already lie on the grid passes bit for bit.  Down-sampled commands come out as ``instant``, for the
    filtered staircase has a value at an instant; commands at the grid's own rate stay ``held``, with the slope within
    each sample that the flight controller's feedback makes (`quadid.intersample`).

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
    spans = _spans(plan)
    shortest = SHORTEST if rate is not None else 0.0
    log_span = recording.span
    windows: list[Window] = []
    dropped: list[float] = []
    for span in spans:
        a, b = _inside(plan, span)
        for low, high in _common([span], parts):
            at = _grid_times(plan, max(a, low), min(b, high))
            if len(at) >= 2 and (len(at) - 1) * plan.step >= shortest - 0.5 * plan.step:
                windows.append(_window(plan, at, recording.name, log_span))
            elif low < high:
                dropped.append(high - low)
    if not windows:
        longest = max((b - a for a, b in spans), default=0.0)
        raise _nothing_left(recording, longest, max(shortest, 2.0 * plan.step), parts)
    windows, followed = follow_feedback(windows, vehicle)
    report = _report(plan, rotor, windows, len(spans) - 1, dropped, log_span)
    return Gridded(windows, replace(report, notes=(*report.notes, followed)) if followed else report)


def _report(
    plan: Plan, rotor: RotorSignal, windows: list[Window], gaps: int, dropped: list[float], log_span: Span
) -> GridReport:
    period = measured_period(rotor.t, rotor.values)
    slow = [
        f"rotor signal at {1 / period:.3g} Hz is slower than the grid at {1 / plan.step:.3g} Hz: "
        "fast motion cannot be attributed to the rotors"
    ] if period > 1.5 * plan.step else []  # fmt: skip
    return GridReport(
        rate=1.0 / plan.step,
        windows=len(windows),
        seconds_used=sum((len(w) - 1) * w.dt for w in windows),
        seconds_log=log_span[1] - log_span[0],
        gaps=gaps,
        dropped=len(dropped),
        seconds_dropped=sum(dropped),
        rotor_source=rotor.source,
        rotor_rate=1.0 / period,
        filtered=plan.filtered,
        bridged=sum(holes(plan.tracks[name].t, plan.step) for name in REQUIRED if name in plan.tracks),
        notes=(*rotor.notes, *slow),
    )


def _spans(plan: Plan) -> list[Span]:
    """Returns the times [s] during which every required channel is there, cut at gaps and breaks."""
    spans: list[Span] = [(-math.inf, math.inf)]
    for name in REQUIRED:
        if name in plan.tracks:
            track = plan.tracks[name]
            spans = _common(spans, list(zip(track.begins.tolist(), track.ends.tolist(), strict=True)))
    return spans


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


def _inside(plan: Plan, span: Span) -> Span:
    """Shrinks a span to where the low-pass, if there is one, has samples on both sides in every required channel."""
    a, b = span
    for name in REQUIRED:
        for cut in plan.tracks[name].stretches_within(*span) if name in plan.tracks else ():
            c, d = reach(plan.tracks[name], cut, plan)
            a, b = max(a, c), min(b, d)
    return a, b


def _grid_times(plan: Plan, a: float, b: float) -> FloatArray:
    """Returns the grid in [a, b]; its first point is a sample of the gyro, else of the rotor signal."""
    tolerance = COINCIDENT * plan.step
    t = plan.tracks["gyro" if "gyro" in plan.tracks else "rotor_speed"].t
    first = int(np.searchsorted(t, a - tolerance))
    if first >= len(t) or t[first] > b + tolerance:
        return np.empty(0)
    return np.asarray(t[first] + plan.step * np.arange(math.floor((b - t[first] + tolerance) / plan.step) + 1))


def _window(plan: Plan, at: FloatArray, name: str, log_span: Span) -> Window:
    columns = {}
    for channel, track in plan.tracks.items():
        values = on_grid(channel, track, at, plan)
        if not np.isnan(values).all():
            columns[channel] = values
    return Window(float(at[0]), plan.step, **columns, sampling=plan.sampling, name=name, log_span=log_span)


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
            f"{first:z.1f} to {last:z.1f} s after its first IMU sample", "see `quadid inspect` for the flying spans",
        )  # fmt: skip
    return NotIdentifiableError(
        f"{recording.name}: the longest stretch with rotor signal and IMU and without gaps is {longest:.3g} s",
        f"at least {needed:.3g} s", "log at a steady rate, or ask for a lower --rate",
    )  # fmt: skip
