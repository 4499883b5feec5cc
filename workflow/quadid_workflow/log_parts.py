"""Parts of a log: those asked for as LOG@from:to, and those in the air."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from quadid.errors import LogError

if TYPE_CHECKING:
    from quadid.inspection.airborne import Spans
    from quadid.window import Recording

_CUT = re.compile(r"(?P<path>.+)@(?P<start>[0-9.]*):(?P<stop>[0-9.]*)")


@dataclass(frozen=True)
class LogPart:
    """Part of a log that was asked for: seconds after its first IMU sample; None for open ends; units to be checked."""

    path: Path
    start: float | None = None
    stop: float | None = None
    checked: bool = True

    def span(self, recording: Recording) -> tuple[float, float]:
        """First and last time of the part [s], in the time of the recording; infinite for open ends."""
        zero = recording.first_imu_time
        low = -math.inf if self.start is None else zero + self.start
        return low, math.inf if self.stop is None else zero + self.stop

    def of(self, recording: Recording) -> Recording:
        """The part of a recording; raises LogError where that is empty."""
        if self.start is None and self.stop is None:
            return recording
        low, high = self.span(recording)
        inside = {name: (c.t >= low) & (c.t <= high) for name, c in recording.channels.items()}
        channels = {
            name: replace(c, t=c.t[inside[name]], values=c.values[inside[name]])
            for name, c in recording.channels.items()
            if inside[name].any()
        }
        if not channels:
            raise self._empty(recording)
        return replace(recording, channels=channels, breaks=tuple(b for b in recording.breaks if low <= b <= high))

    def _empty(self, recording: Recording) -> LogError:
        """Nothing is there: which span was asked for, and which there is."""
        zero = recording.first_imu_time
        first, last = recording.span
        asked = f"between {self.start} and {self.stop} s" if self.stop is not None else f"after {self.start} s"
        if self.start is None:
            asked = f"before {self.stop} s"
        there = f", {first - zero:.1f} to {last - zero:.1f} s" if last > first else ""
        return LogError(f"{recording.name}: nothing {asked}", f"a span inside the log{there}")


def parse_part(text: str, start: float | None = None, stop: float | None = None) -> LogPart:
    """Splits ``LOG@76:216`` into its parts, unless a file of that name exists; own limits go before the common ones."""
    found = _CUT.fullmatch(text)
    if found is None or Path(text).exists():
        cut = LogPart(Path(text), start, stop)
    else:
        try:
            own = [float(found[key]) if found[key] else None for key in ("start", "stop")]
        except ValueError as error:
            raise LogError(
                f"cannot read the span of '{text}'", "LOG@START:STOP in seconds, for example LOG@76:216"
            ) from error
        cut = LogPart(Path(found["path"]), start if own[0] is None else own[0], stop if own[1] is None else own[1])
    for limit in (cut.start, cut.stop):
        if limit is not None and not math.isfinite(limit):
            raise LogError(f"{text}: a span from {cut.start} to {cut.stop} s", "seconds")
    if cut.start is not None and cut.stop is not None and not cut.start < cut.stop:
        raise LogError(f"{text}: a span from {cut.start:g} to {cut.stop:g} s", "start before stop", "swap them")
    return cut


def flown_parts(recording: Recording, flying: Spans, cut: LogPart) -> Spans:
    """What to use of a log that also stands on the ground [s, after its first IMU sample]; none where it hardly does.

    A part that was asked for is used as it is.

    Args:
        recording: the whole log.
        flying: when it flies [s, in the time of the recording].
        cut: the part that is asked for.
    """
    from quadid.inspection import proposed_cuts

    imu = [c.t for n, c in recording.channels.items() if n in ("gyro", "accel") and len(c.t)]
    if cut.start is not None or cut.stop is not None or not imu:
        return ()
    return proposed_cuts(flying, recording.first_imu_time, max(float(t[-1]) for t in imu))


def names_of(cut: LogPart, parts: Spans) -> list[str]:
    """Parts of a log as one asks for them: ``flight.bin@73.2:227.3``."""
    return [f"{cut.path.name}@{a:g}:{b:g}" for a, b in parts]


def left_on_ground(names: Sequence[str]) -> str:
    """What is used of a log that also stands on the ground, by the names of its parts, and how to use all of it."""
    whole = names[0].rpartition("@")[0]
    return f"time on the ground is left out: fits use {' '.join(names)}; to use all of it: {whole}@0:"
