"""The page of a proposed manoeuvre: what it would gain, and how it looks when flown."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import groupby
from typing import Any

import numpy as np

from quadid.types import Json
from quadid.window import Window
from quadid_report.manoeuvres.plan import half_width
from quadid_report.page import render
from quadid_report.parts import axis, figure, rows_of, section, trace
from quadid_report.text_table import Column, TextTable


def excite_html(result: Json, window: Window) -> str:
    """The page.

    Args:
        result: of the form ``quadid.excite/1``.
        window: the manoeuvre as flown in simulation.
    """
    peak = result["peak"]
    return render({
        "title": f"What to fly next: {result['vehicle']}",
        "subtitle": f"{result['seconds']:g} s, at most {peak['tilt_deg']:.0f}° of tilt and {peak['rate_deg_s']:.0f}°/s",
        "sections": [
            section(
                "gain", "What it would gain",
                "Relative half-width of the 95 % interval, from the Fisher information of simulated flights.",
                [_bars(result)],
                [gain_table(result).part()],
            ),
            section(
                "manoeuvre", "The manoeuvre",
                "Stick movements one after the other, and the attitude that the simulation flies.",
                [_attitude(window)], [rows_of(("movement", "times", "amplitude, rms"), grouped(result["movements"]))],
            ),
            section(
                "envelope", "Where it may be flown",
                "Scripts start only inside the envelope and stop outside it.",
                tables=[rows_of(("", "needed in simulation", "envelope"), _limits(result))],
            ),
        ],
    })  # fmt: skip


def gain_table(result: Json) -> TextTable:
    """Half-widths now, and after each kind of flight."""
    keys = ("now", "gentle_flight", "manoeuvre", "one_axis_at_a_time")
    rows = tuple((p["name"], *(half_width(p[key]) for key in keys)) for p in result["parameters"])
    heads = (Column("parameter"), *(Column(key.replace("_", " "), right=True) for key in keys))
    return TextTable(f"Relative 95 % half-width (±) before and after {result['seconds']:g} s", heads, rows)


def grouped(movements: Sequence[Json]) -> list[tuple[str, str, str]]:
    """Movements that follow each other alike as one: name, how many times, amplitudes."""
    each = [(m["name"], ", ".join(f"{a} {_amplitude(a, v)}" for a, v in m["amplitudes"].items())) for m in movements]
    return [(name, str(len(list(same))), size) for (name, size), same in groupby(each)]


def _limits(result: Json) -> list[list[str]]:
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


def _amplitude(axis: str, value: float) -> str:
    return f"{100.0 * value:.0f} %" if axis == "throttle" else f"{math.degrees(value):.1f}°"


def _bars(result: Json) -> dict[str, Any]:
    names = [p["name"] for p in result["parameters"]]
    data = [
        {"role": role, "name": label, "type": "bar", "x": names,
         "y": [100.0 * min(p[key], 2.0) for p in result["parameters"]]}
        for role, label, key in (
            ("measured", "now", "now"), ("before", "after a gentle flight", "gentle_flight"),
            ("after", "after the manoeuvre", "manoeuvre"),
        )
    ]  # fmt: skip
    layout = {"yaxis": axis("half-width (%)", type="log"), "xaxis": {"type": "category"}}
    return figure("gain-bars", "Half-widths", data, layout, 320)


def _attitude(window: Window) -> dict[str, Any]:
    from quadid.rotation import euler

    assert window.attitude is not None
    angles = np.degrees(np.unwrap(euler(window.attitude), axis=0))
    t = window.t - window.t0
    data = [
        trace(role, label, t, angles[:, i])
        for i, (role, label) in enumerate((("measured", "roll"), ("before", "pitch"), ("after", "yaw")))
    ]
    return figure("attitude", "Attitude", data, {"xaxis": axis("time (s)"), "yaxis": axis("angle (°)")}, 320)
