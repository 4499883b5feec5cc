"""Result of an inspection: facts of channels, checks, what is missing and how to get it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from enum import StrEnum
from typing import Any

from quadid.jsonable import jsonable

FATAL = (
    "gravity", "gyro_attitude", "velocity_attitude", "position_velocity", "rotor_speed", "hover", "motor_order",
    "rotor_timing",
)  # fmt: skip
"""Checks whose error means that nothing may be fitted to the log."""


class CheckResult(StrEnum):
    """Outcome of one check."""

    OK = "ok"
    WARNING = "warning"
    ERROR = "error"
    UNKNOWN = "unknown"


@dataclass(frozen=True)
class ChannelFacts:
    """One channel of a log.

    Attributes:
        name: key of `quadid.window.CHANNELS`.
        unit: of its values.
        source: topic, message or column names it came from.
        rate: measured samples a second inside stretches without gaps, interpolated rows not counted [Hz].
        count: samples kept.
        first, last: times of the first and last one [s].
        jitter: standard deviation of the step over its median (gaps left out).
        gaps: steps longer than the gap limit.
        longest_gap: [s], 0 when there is none.
        bridged: lost samples too few for a gap.
        repeated: fraction of rows equal to the row before.
        stuck: longest time in flight without any change [s]; 0 where it is unknown when it flies.
        saturated: samples at a limit that the channel hits several times.
        dropped: samples the reader dropped, by reason.
    """

    name: str
    unit: str
    source: str
    rate: float
    count: int
    first: float
    last: float
    jitter: float
    gaps: int
    longest_gap: float
    bridged: int
    repeated: float
    stuck: float
    saturated: int
    dropped: Mapping[str, int] = field(default_factory=dict)


@dataclass(frozen=True)
class Check:
    """One question put to the data.

    Attributes:
        name: of the check: gravity, gyro_attitude, velocity_attitude, position_velocity, rotor_speed, hover,
            motor_order, rotor_timing, geometry, mass, clock, timing.
        verdict: the answer.
        message: one sentence with numbers and units.
        fix: what to do, empty when nothing.
        numbers: the numbers behind it.
    """

    name: str
    verdict: CheckResult
    message: str
    fix: str = ""
    numbers: Mapping[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class Missing:
    """A signal that is absent or too slow, why it matters, and how to log it."""

    channel: str
    why: str
    how: str


@dataclass(frozen=True)
class Outlook:
    """Whether the channels allow a parameter to be identified at all; excitation is another question."""

    parameter: str
    possible: bool
    reason: str


@dataclass(frozen=True)
class Inspection:
    """Everything an inspection found.

    Attributes:
        name, format, sha256: of the log.
        seconds: first to last sample [s].
        channels: facts by channel, in the order of `quadid.window.CHANNELS`.
        breaks: times across which nothing is joined [s].
        flying: spans in which the vehicle flies [s].
        checks: unit, frame, motor and clock checks.
        missing: signals to add to the log.
        parameters: what the channels allow.
        excitation: rows computed elsewhere, as given.
        warnings: of the reader.
        zero: time of the log's first IMU sample [s]: ``LOG@from:to``, and tables for people, count from there.
    """

    name: str
    format: str
    sha256: str
    seconds: float
    channels: tuple[ChannelFacts, ...]
    breaks: tuple[float, ...]
    flying: tuple[tuple[float, float], ...]
    checks: tuple[Check, ...]
    missing: tuple[Missing, ...]
    parameters: tuple[Outlook, ...]
    excitation: tuple[Mapping[str, Any], ...] = ()
    warnings: tuple[str, ...] = ()
    zero: float = 0.0

    @property
    def usable(self) -> bool:
        """Whether something flies, at least one parameter can be identified, and no check finds the data wrong."""
        wrong = any(check.verdict is CheckResult.ERROR for check in self.checks)
        return bool(self.flying) and any(outlook.possible for outlook in self.parameters) and not wrong

    def to_dict(self) -> dict[str, Any]:
        """Returns the inspection as JSON-ready data, schema ``quadid.inspect/1``; NaN and infinity become null."""
        data = {"schema": "quadid.inspect/1", "usable": self.usable, **asdict(self)}
        return dict(jsonable(data))
