"""Manoeuvres in the forms in which they are flown: autopilot scripts, parameters, words for the sticks."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import groupby

from quadid.errors import ParameterError, nearest
from quadid.report.templating import render
from quadid.types import Json

# --- What a manoeuvre is, where it may be flown, and what it promises


@dataclass(frozen=True)
class ManoeuvrePlan:
    """A manoeuvre to be written down.

    Attributes:
        segments: multisines: axis, start [s], duration [s], amplitude (rms) [rad, or share of hover thrust], frequency
            and frequency_end [Hz].
        sweeps: one axis at a time instead: axis, amplitude [rad, rad/s for yaw, share of hover thrust], frequency,
            frequency_end [Hz], duration [s].
        envelope: lowest_m, highest_m above take-off, radius_m, tilt_deg asked for at most, abort_tilt_deg,
            battery_percent.
        promise: relative 95 % half-widths by parameter, flown as `segments`.
        promise_sweeps: likewise, flown as `sweeps`.
        disturbed: whether they know what moves the vehicle beyond its model, as a fit found it.
    """

    vehicle: str
    seconds: float
    segments: Sequence[Json]
    sweeps: Sequence[Json]
    envelope: Json
    promise: Mapping[str, float]
    promise_sweeps: Mapping[str, float]
    disturbed: bool = False

    @property
    def rests_on(self) -> str:
        """Origin of the promise, and what it leaves out."""
        if self.disturbed:
            return "a fit of a simulated flight with the random forces that a fit of this vehicle found"
        return (
            "a simulated flight with the current values and sensor noise alone, many times too narrow where more moves "
            "the vehicle, as a log of it would show"
        )

    def header(self, promise: Mapping[str, float], what: str) -> list[str]:
        """The lines at the top of every form: what it is, the envelope, the promise and what that rests on."""
        e = self.envelope
        return [
            f"{self.vehicle}: {what}. Proposed by `quadid excite`; read it before you fly it.",
            "Neither a simulated autopilot (SITL) nor a vehicle has flown it yet: try it in SITL first.",
            f"Envelope: {e['lowest_m']:g} to {e['highest_m']:g} m above take-off, {e['radius_m']:g} m around the "
            f"start, tilt {e['abort_tilt_deg']:.0f} deg, {e['battery_percent']:g} % of the battery left.",
            f"Promised 95 % intervals: {', '.join(f'{n} {half_width(v)}' for n, v in promise.items())}.",
            f"They are predicted by {self.rests_on}; `quadid identify` states what a real log obtained.",
        ]


def half_width(half: float) -> str:
    """A relative half-width for people."""
    return "unknown" if half > 2.0 else f"± {100.0 * half:.3g} %"


# --- The forms by name, each a template in ``templates/manoeuvres``
#
# Scripts watch the envelope themselves, begin only when the pilot has switched to them in flight, and end in a mode
# that holds the place.


FORMS = {
    "ardupilot-lua": "Lua script for ArduCopter, all axes at once",
    "ardupilot-sid": "parameters of ArduCopter's SystemID mode, one axis at a time",
    "px4": "ROS 2 script for PX4's Offboard mode, all axes at once",
    "sticks": "instructions for a pilot",
}
PEAK = math.sqrt(2.0)
"""Of a swing over its rms."""
SID_AXES = {"roll": 1, "pitch": 2, "yaw": 3, "throttle": 13}
"""Axes that ArduCopter's SystemID mode adds a sweep to: roll and pitch angle [deg], yaw rate [deg/s], throttle (share
of full).  It stops itself on landing and beyond the largest lean angle; fence and battery failsafe are the
autopilot's own.  https://ardupilot.org/copter/docs/systemid-mode.html"""
_WHAT = "a manoeuvre that shows mass-normalised thrust, drag torque and inertia"


def check_form(form: str) -> None:
    """Raises ParameterError for a form that is not written."""
    if form not in FORMS:
        raise ParameterError(f"--format {form}", ", ".join(FORMS), nearest(form, FORMS))


def written_as(plan: ManoeuvrePlan, form: str, hover_throttle: float) -> dict[str, str]:
    """Texts of a form by the end of their file names.

    Args:
        form: of `FORMS`.
        hover_throttle: share of full throttle at hover.

    Raises:
        ParameterError: an unknown form, or too short a manoeuvre for it.
    """
    check_form(form)
    facts = {**asdict(plan), **plan.envelope, "header": plan.header(plan.promise, _WHAT)}
    if form == "ardupilot-lua":
        return {".manoeuvre.lua": render("manoeuvres/ardupilot.lua", facts)}
    if form == "px4":
        return {".manoeuvre_px4.py": render("manoeuvres/px4.py", facts)}
    if form == "sticks":
        facts["header"] = plan.header(plan.promise, "what to do with the sticks")
        # Movements of the sticks at one time, alike ones counted
        peaks = [(s, PEAK * s["amplitude"]) for s in plan.segments]
        moved = [{**s, "peak": peak, "peak_deg": math.degrees(peak)} for s, peak in peaks]
        alike = groupby([{**s, "start": 0.0} for s in b] for _, b in groupby(moved, key=lambda s: s["start"]))
        facts["blocks"] = [(block, len(list(same))) for block, same in alike]
        return {".sticks.txt": render("manoeuvres/sticks.txt", facts)}
    if not plan.sweeps:
        raise ParameterError(
            f"too short for sweeps of one axis after the other: {plan.seconds:g} s", "36 s or more", "use --seconds 60"
        )
    texts = {}
    for i, sweep in enumerate(plan.sweeps, 1):
        axis, size = str(sweep["axis"]), float(sweep["amplitude"])
        magnitude = size * hover_throttle if axis == "throttle" else math.degrees(size)
        what = f"sweeps of SystemID mode, {i} of {len(plan.sweeps)} ({axis})"
        facts |= {"header": plan.header(plan.promise_sweeps, what), "sweep": sweep}
        facts |= {"axis": SID_AXES[axis], "magnitude": magnitude}
        texts[f".sid_{i}_{axis}.param"] = render("manoeuvres/system_id.param", facts)
    return texts
