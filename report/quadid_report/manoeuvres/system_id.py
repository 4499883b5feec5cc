"""A manoeuvre as parameters of ArduCopter's SystemID mode: one file an axis, as the mode sweeps one axis at a time.

The mode adds the sweep to the pilot's input: roll and pitch angle [deg] (SID_AXIS 1, 2), yaw rate [deg/s] (3) and
throttle (13, share of full).  It stops itself on landing and beyond the largest lean angle; fence and battery failsafe
are the autopilot's own.  https://ardupilot.org/copter/docs/systemid-mode.html
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from quadid_report.manoeuvres.plan import Plan

AXES = {"roll": 1, "pitch": 2, "yaw": 3, "throttle": 13}
MODE = 25
FADE = 1.0
"""Time over which a sweep grows at its beginning, and fades at its end [s]."""
_WHAT = "sweeps of SystemID mode"


def system_id(plan: Plan, hover_throttle: float) -> dict[str, str]:
    """Parameter files (``NAME,VALUE``) by the end of their names.

    Args:
        plan: the manoeuvre.
        hover_throttle: share of full throttle at hover.
    """
    return {
        f".sid_{i + 1}_{sweep['axis']}.param": _file(plan, i, sweep, hover_throttle)
        for i, sweep in enumerate(plan.sweeps)
    }


def _file(plan: Plan, i: int, sweep: Mapping[str, Any], hover_throttle: float) -> str:
    axis, size, e = str(sweep["axis"]), float(sweep["amplitude"]), plan.envelope
    magnitude = size * hover_throttle if axis == "throttle" else math.degrees(size)
    values = {
        "SID_AXIS": AXES[axis], "SID_MAGNITUDE": magnitude, "SID_F_START_HZ": sweep["frequency"],
        "SID_F_STOP_HZ": sweep["frequency_end"], "SID_T_FADE_IN": FADE, "SID_T_REC": sweep["duration"],
        "SID_T_FADE_OUT": FADE, "FENCE_ENABLE": 1, "FENCE_TYPE": 11, "FENCE_ACTION": 1,
        "FENCE_ALT_MIN": e["lowest_m"], "FENCE_ALT_MAX": e["highest_m"], "FENCE_RADIUS": max(e["radius_m"], 30.0),
        "ANGLE_MAX": 100.0 * e["abort_tilt_deg"], "BATT_FS_LOW_ACT": 2,
    }  # fmt: skip
    head = [
        *plan.header(plan.promise_sweeps, f"{_WHAT}, {i + 1} of {len(plan.sweeps)} ({axis})"),
        "The intervals hold for all files flown one after the other; moving all axes at once reveals more.",
        f"Use: load, set a flight mode to {MODE} (SystemID), hover, switch to it, keep the place with the sticks; it "
        f"sweeps for {sweep['duration']:g} s.",
        f"BATT_LOW_MAH: set it to {e['battery_percent']:g} % of BATT_CAPACITY. ArduCopter 4.7: ATC_ANGLE_MAX "
        f"{e['abort_tilt_deg']:.0f} instead of ANGLE_MAX.",
        "Restore the values you had before the next ordinary flight.",
    ]
    return "\n".join([*(f"# {line}" for line in head), *(f"{n},{v:.6g}" for n, v in values.items())]) + "\n"
