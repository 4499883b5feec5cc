"""The forms by name."""

from __future__ import annotations

from quadid.errors import ParameterError, nearest
from quadid_report.manoeuvres.plan import Plan
from quadid_report.manoeuvres.scripts import ardupilot_lua, px4_ros2
from quadid_report.manoeuvres.sticks import sticks
from quadid_report.manoeuvres.system_id import system_id

FORMS = {
    "ardupilot-lua": "Lua script for ArduCopter, all axes at once",
    "ardupilot-sid": "parameters of ArduCopter's SystemID mode, one axis at a time",
    "px4": "ROS 2 script for PX4's Offboard mode, all axes at once",
    "sticks": "instructions for a pilot",
}


def check_form(form: str) -> None:
    """Raises ParameterError for a form that is not written."""
    if form not in FORMS:
        raise ParameterError(f"--format {form}", ", ".join(FORMS), nearest(form, FORMS))


def written_as(plan: Plan, form: str, hover_throttle: float) -> dict[str, str]:
    """Texts of a form by the end of their file names.

    Args:
        plan: the manoeuvre.
        form: of `FORMS`.
        hover_throttle: share of full throttle at hover.

    Raises:
        ParameterError: an unknown form, or too short a manoeuvre for it.
    """
    check_form(form)
    if form == "ardupilot-lua":
        return {".manoeuvre.lua": ardupilot_lua(plan)}
    if form == "ardupilot-sid":
        if not plan.sweeps:
            raise ParameterError(
                f"too short for sweeps of one axis after the other: {plan.seconds:g} s",
                "36 s or more",
                "use --seconds 60",
            )
        return system_id(plan, hover_throttle)
    if form == "px4":
        return {".manoeuvre_px4.py": px4_ros2(plan)}
    return {".sticks.txt": sticks(plan)}
