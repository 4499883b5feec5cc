"""The page of a proposed manoeuvre: what it would gain, and how it looks when flown."""

from __future__ import annotations

import math
from collections.abc import Mapping
from itertools import groupby
from typing import Any

import numpy as np

from quadid.report.figures import trace
from quadid.report.page import render
from quadid.window import Window

JsonDict = Mapping[str, Any]


def excite_html(result: JsonDict, window: Window) -> str:
    """The page.

    Args:
        result: of the form ``quadid.excite/1``.
        window: the manoeuvre as flown in simulation.
    """
    gained = [
        [p["name"], *(_percent(p[k]) for k in ("now", "gentle_flight", "manoeuvre", "one_axis_at_a_time"))]
        for p in result["parameters"]
    ]
    each = [
        (m["name"], ", ".join(f"{a} {_amplitude(a, v)}" for a, v in m["amplitudes"].items()))
        for m in result["movements"]
    ]
    moves = [[name, str(len(list(same))), size] for (name, size), same in groupby(each)]
    peak = result["peak"]
    return render({
        "title": f"What to fly next: {result['vehicle']}",
        "subtitle": f"{result['seconds']:g} s, at most {peak['tilt_deg']:.0f}° of tilt and {peak['rate_deg_s']:.0f}°/s",
        "sections": [
            {
                "id": "gain",
                "title": "What it would gain",
                "intro": "Relative half-width of the 95 % interval, from the Fisher information of simulated flights.",
                "figures": [_bars(result)],
                "tables": [{
                    "head": ["parameter", "now", "gentle flight", "manoeuvre", "one axis at a time"], "rows": gained,
                }],
            },
            {
                "id": "manoeuvre",
                "title": "The manoeuvre",
                "intro": "Stick movements one after the other, and the attitude that the simulation flies.",
                "figures": [_attitude(window)],
                "tables": [{"head": ["movement", "times", "amplitude, rms"], "rows": moves}],
            },
            {
                "id": "envelope",
                "title": "Where it may be flown",
                "intro": "Scripts begin only inside the envelope, and end when they leave it.",
                "figures": [],
                "tables": [{"head": ["", "needed in simulation", "envelope"], "rows": _limits(result)}],
            },
        ],
    })  # fmt: skip


def _limits(result: JsonDict) -> list[list[str]]:
    room, e, peak = result["room"], result["envelope"], result["peak"]
    return [
        [
            "height above take-off",
            f"{room['up_m'] + room['down_m']:.1f} m",
            f"{e['lowest_m']:g} to {e['highest_m']:g} m",
        ],
        ["distance from the start", f"{room['sideways_m']:.0f} m", f"{e['radius_m']:g} m"],
        ["tilt", f"{peak['tilt_deg']:.0f}°", f"{e['abort_tilt_deg']:.0f}°"],
        ["battery", "–", f"{e['battery_percent']:g} % left"],
    ]


def _percent(half: float) -> str:
    return "unknown" if half > 2.0 else f"± {100.0 * half:.3g} %"


def _amplitude(axis: str, value: float) -> str:
    return f"{100.0 * value:.0f} %" if axis == "throttle" else f"{math.degrees(value):.1f}°"


def _bars(result: JsonDict) -> dict[str, Any]:
    names = [p["name"] for p in result["parameters"]]
    data = [
        {"role": role, "name": label, "type": "bar", "x": names,
         "y": [100.0 * min(p[key], 2.0) for p in result["parameters"]]}
        for role, label, key in (
            ("measured", "now", "now"), ("before", "after a gentle flight", "gentle_flight"),
            ("after", "after the manoeuvre", "manoeuvre"),
        )
    ]  # fmt: skip
    layout = {"yaxis": {"type": "log", "title": {"text": "half-width (%)"}}, "xaxis": {"type": "category"}}
    return {"id": "gain-bars", "title": "Half-widths", "height": 320,
            "views": [{"label": "", "data": data, "layout": layout}]}  # fmt: skip


def _attitude(window: Window) -> dict[str, Any]:
    from quadid.rotation import euler

    assert window.attitude is not None
    angles = np.degrees(np.unwrap(euler(window.attitude), axis=0))
    t = window.t - window.t0
    data = [
        trace(role, label, t, angles[:, i])
        for i, (role, label) in enumerate((("measured", "roll"), ("before", "pitch"), ("after", "yaw")))
    ]
    layout = {"xaxis": {"title": {"text": "time (s)"}}, "yaxis": {"title": {"text": "angle (°)"}}}
    return {"id": "attitude", "title": "Attitude", "height": 320,
            "views": [{"label": "", "data": data, "layout": layout}]}  # fmt: skip
