"""Timing of channels and values that do not move: rates, gaps, jitter, stuck and saturated signals, clock faults."""

from __future__ import annotations

import numpy as np

from quadid.inspection.airborne import Spans, within
from quadid.inspection.findings import ChannelFacts, Check, CheckResult
from quadid.resample import copied, measured_period, true_runs
from quadid.resampling_plan import holes, longest_step
from quadid.saturation import at_limit
from quadid.types import BoolArray, FloatArray
from quadid.window import CHANNELS, Channel, Recording

_GRID = 0.02
"""Step of the grid [s] for which gaps are reported, that of the fit."""
_STUCK = 0.5
"""An IMU channel that does not change for this long [s] in flight is stuck."""
FILLED = 1.5
"""Rows for each measured one above which it is reported."""
_UNSTEADY = 0.25
"""Jitter above which the log's timing is worth a warning."""


def channel_facts(recording: Recording, flying: Spans = ()) -> tuple[ChannelFacts, ...]:
    """Returns the facts of all channels of a recording.

    Args:
        recording: the log.
        flying: when it flies [s]; at rest a sensor may well repeat itself.
    """
    return tuple(_facts(recording.channels[name], flying) for name in CHANNELS if name in recording.channels)


def _facts(channel: Channel, flying: Spans) -> ChannelFacts:
    steps = np.diff(channel.t)
    median = float(np.median(steps)) if len(steps) else np.nan
    long = steps > (longest_step(channel.t, _GRID) if len(steps) else np.inf)
    usual = steps[~long]
    same = copied(channel.values)
    return ChannelFacts(
        name=channel.name,
        unit=CHANNELS[channel.name][1],
        source=channel.source,
        rate=1.0 / measured_period(channel.t, channel.values) if len(channel.t) > 1 else np.nan,
        count=len(channel.t),
        first=float(channel.t[0]),
        last=float(channel.t[-1]),
        jitter=float(np.std(usual) / median) if len(usual) else np.nan,
        gaps=int(np.count_nonzero(long)),
        bridged=holes(channel.t, _GRID) if len(steps) else 0,
        longest_gap=float(steps[long].max()) if long.any() else 0.0,
        repeated=float(np.mean(same)) if len(same) else 0.0,
        stuck=_longest_rest(channel.t, same & within(channel.t[:-1], flying) & within(channel.t[1:], flying)),
        saturated=sum(end.samples for end in at_limit(channel.values))
        if channel.name in ("gyro", "accel", "motor_command")
        else 0,
        dropped=dict(channel.faults),
    )


def _longest_rest(t: FloatArray, same: BoolArray) -> float:
    """Returns the longest time [s] during which no column changed."""
    first, end = true_runs(same)
    return float(np.max(t[end] - t[first], initial=0.0))


def timing_checks(recording: Recording, facts: tuple[ChannelFacts, ...]) -> list[Check]:
    """Checks clocks, gaps, jitter and stuck sensors.

    Args:
        recording: the log.
        facts: of its channels.
    """
    checks = [_clock_check(recording, facts)]
    for f in facts:
        rows = (f.count - 1) / max(f.last - f.first, 1e-9)
        if not f.gaps and rows > FILLED * f.rate:
            message = f"{f.name}: {rows:.3g} rows a second were interpolated between samples at {f.rate:.3g} Hz"
            checks.append(
                Check("timing", CheckResult.WARNING, message, "log it at this rate, or without the interpolated rows")
            )
    gaps = {f.name: f for f in facts if f.gaps}
    if gaps:
        worst = max(gaps.values(), key=lambda f: f.longest_gap)
        text = ", ".join(f"{f.name} {f.gaps}" for f in gaps.values())
        checks.append(
            Check(
                "timing", CheckResult.WARNING,
                f"gaps: {text}; the longest lasts {worst.longest_gap:.3g} s ({worst.name})",
                "windows are cut there; log to a faster card or at a lower rate",
                {"gaps": float(sum(f.gaps for f in facts)), "longest_s": worst.longest_gap},
            )
        )  # fmt: skip
    unsteady = [
        f for f in facts if f.name in ("gyro", "accel", "rotor_speed", "motor_command") and f.jitter > _UNSTEADY
    ]
    for f in unsteady:
        message = f"{f.name}: steps vary by {f.jitter:.0%} of their median: stamps are unsteady or samples are lost"
        checks.append(Check("timing", CheckResult.WARNING, message, "stamp at the sensor", {"jitter": f.jitter}))
    for f in facts:
        if f.name in ("gyro", "accel") and f.stuck > _STUCK:
            message = f"{f.name}: does not change for {f.stuck:.2g} s of flight ({f.source})"
            checks.append(
                Check("stuck", CheckResult.WARNING, message, "check this sensor or topic", {"stuck_s": f.stuck})
            )
        if f.name in ("gyro", "accel") and f.saturated:
            message = f"{f.name}: {f.saturated} samples at the limit of its range"
            checks.append(Check("saturated", CheckResult.WARNING, message, "choose a larger range or fly more gently"))
    return checks


def _clock_check(recording: Recording, facts: tuple[ChannelFacts, ...]) -> Check:
    dropped: dict[str, int] = {}
    for f in facts:
        for reason, count in f.dropped.items():
            dropped[reason] = dropped.get(reason, 0) + count
    numbers = {"breaks": float(len(recording.breaks)), **{k: float(v) for k, v in dropped.items()}}
    if not recording.breaks and not dropped:
        return Check("clock", CheckResult.OK, "time rises steadily, no sample was dropped", numbers=numbers)
    parts = [f"{len(recording.breaks)} breaks (reboots or clock steps)"] if recording.breaks else []
    parts += [f"{count} samples dropped: {reason.replace('_', ' ')}" for reason, count in dropped.items()]
    return Check(
        "clock",
        CheckResult.WARNING,
        "; ".join(parts),
        "nothing is joined across breaks" if recording.breaks else "",
        numbers,
    )
