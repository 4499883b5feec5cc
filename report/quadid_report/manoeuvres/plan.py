"""What a manoeuvre is, where it may be flown, and what it promises."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from quadid.types import Json


@dataclass(frozen=True)
class Plan:
    """A manoeuvre to be written down.

    Attributes:
        vehicle: its name.
        seconds: length.
        segments: multisines: axis, start [s], duration [s], amplitude (rms) [rad, or share of hover thrust], frequency
            and frequency_end [Hz].
        sweeps: one axis at a time instead: axis, amplitude [rad, rad/s for yaw, share of hover thrust], frequency,
            frequency_end [Hz], duration [s].
        envelope: lowest_m, highest_m above take-off, radius_m, tilt_deg asked for at most, abort_tilt_deg,
            battery_percent.
        promise: relative 95 % half-widths by parameter, flown as `segments`.
        promise_sweeps: likewise, flown as `sweeps`.
    """

    vehicle: str
    seconds: float
    segments: Sequence[Json]
    sweeps: Sequence[Json]
    envelope: Json
    promise: Mapping[str, float]
    promise_sweeps: Mapping[str, float]

    def header(self, promise: Mapping[str, float], what: str) -> list[str]:
        """The lines at the top of every form: what it is, the envelope, the promise and what that rests on."""
        e = self.envelope
        return [
            f"{self.vehicle}: {what}. Proposed by `quadid excite`; read it before you fly it.",
            "Neither a simulated autopilot (SITL) nor a vehicle has flown it yet: try it in SITL first.",
            f"Envelope: {e['lowest_m']:g} to {e['highest_m']:g} m above take-off, {e['radius_m']:g} m around the "
            f"start, tilt {e['abort_tilt_deg']:.0f} deg, {e['battery_percent']:g} % of the battery left.",
            f"Promised 95 % intervals: {', '.join(f'{n} {half_width(v)}' for n, v in promise.items())}.",
            "They are predicted by a simulated flight with the current values; `quadid identify` states what "
            "a real log obtained.",
        ]


def half_width(half: float) -> str:
    """A relative half-width for people."""
    return "unknown" if half > 2.0 else f"± {100.0 * half:.3g} %"
