"""A manoeuvre as a Lua script of ArduPilot, and as a ROS 2 node that flies PX4 in Offboard mode.

Both watch the envelope themselves, begin only when the pilot has switched to them in flight, and end in a mode that
holds the place.
"""

from __future__ import annotations

from importlib import resources

from quadid_report.manoeuvres.plan import Plan

_WHAT = "a manoeuvre that shows mass-normalised thrust, drag torque and inertia"


def ardupilot_lua(plan: Plan) -> str:
    """The Lua script for ArduCopter 4.2 or later: Guided mode, attitude and climb rate."""
    rows = [f"  {{{_row(plan, i)}}}," for i in range(len(plan.segments))]
    return _filled(plan, "manoeuvre.lua", "--", rows)


def px4_ros2(plan: Plan) -> str:
    """The Python script for ROS 2 and px4_msgs: Offboard mode, attitude and thrust."""
    rows = [f"    ({_row(plan, i)})," for i in range(len(plan.segments))]
    return _filled(plan, "manoeuvre_px4.py.txt", "#", rows)


def _row(plan: Plan, i: int) -> str:
    s = plan.segments[i]
    numbers = (s["start"], s["duration"], s["amplitude"], s["frequency"], s["frequency_end"])
    return f'"{s["axis"]}", ' + ", ".join(f"{v:.6g}" for v in numbers)


def _filled(plan: Plan, asset: str, comment: str, rows: list[str]) -> str:
    text = (resources.files("quadid_report") / "assets" / asset).read_text(encoding="utf-8")
    e = plan.envelope
    values = {
        "HEADER": "\n".join(f"{comment} {line}" for line in plan.header(plan.promise, _WHAT)),
        "SEGMENTS": "\n".join(rows),
        "SECONDS": f"{plan.seconds:.6g}",
        "LOWEST": f"{e['lowest_m']:g}", "HIGHEST": f"{e['highest_m']:g}", "RADIUS": f"{e['radius_m']:g}",
        "TILT": f"{e['tilt_deg']:.4g}", "ABORT_TILT": f"{e['abort_tilt_deg']:.4g}",
        "BATTERY": f"{e['battery_percent']:g}",
    }  # fmt: skip
    for name, value in values.items():
        text = text.replace(f"@{name}@", value)
    return text
