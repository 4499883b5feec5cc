"""The airframe from above as inline SVG: every rotor with its load against the baseline, damage and shift marked."""

from __future__ import annotations

from collections.abc import Sequence

from markupsafe import Markup

from quadid.types import Json
from quadid.vehicle import Vehicle

_SIZE, _MARGIN = 420.0, 92.0
_LARGEST = 30.0
"""Pixels; a disc grows and shrinks with its rotor's load around `_DISC`."""
_DISC = 44.0
_SHIFT = 6.0
"""A shift of the CG is drawn this many times its size."""


def airframe_picture(
    vehicle: Vehicle, load: Sequence[float], baseline: Sequence[float], changes: Sequence[Json]
) -> str:
    """SVG of the airframe, nose up.

    Args:
        vehicle: geometry.
        load: each rotor's share of the commanded load in the flights in question.
        baseline: the same of healthy flights.
        changes: entries of ``quadid.health/1``.
    """
    scale = (0.5 * _SIZE - _MARGIN) / max(abs(c) for r in vehicle.rotors for c in r.position[:2])
    centre = 0.5 * _SIZE
    places = [(centre + scale * r.position[1], centre - scale * r.position[0]) for r in vehicle.rotors]
    weak = {int(change_value(c, "rotor")) - 1: c for c in changes if c["effect"] == "weak_rotor"}
    parts = [
        Markup(
            '<svg class="airframe" viewBox="0 0 {0:.0f} {0:.0f}" role="img" aria-label="Airframe from above, nose up">'
        ).format(_SIZE),
        *(_line(centre, centre, x, y) for x, y in places),
        Markup('<path class="nose" d="M{0:.0f} {1:.0f} l-9 18 h18 z"/>').format(centre, centre - 30.0),
        *(
            _rotor(j, x, y, load[j] / baseline[j] - 1.0, weak.get(j), centre)
            for j, (x, y) in enumerate(places)
        ),
        *_shift(changes, centre, scale),
        Markup("</svg>"),
    ]  # fmt: skip
    return str(Markup("").join(parts))


def change_value(change: Json, name: str) -> float:
    """A number of a change."""
    return float(next(p["value"] for p in change["parameters"] if p["name"] == name))


def _line(x1: float, y1: float, x2: float, y2: float) -> str:
    return Markup('<line class="arm" x1="{:.0f}" y1="{:.0f}" x2="{:.0f}" y2="{:.0f}"/>').format(x1, y1, x2, y2)


def _rotor(j: int, x: float, y: float, more: float, weak: Json | None, centre: float) -> str:
    """One rotor: its healthy disc, its disc now, its number, its load, and its loss where it is damaged."""
    kind = "" if weak is None else " damaged" if weak["confident"] else " suspect"
    radius = _DISC + max(-_LARGEST, min(_LARGEST, 100.0 * more))
    out = [
        Markup('<circle class="disc{}" cx="{:.0f}" cy="{:.0f}" r="{:.1f}"/>').format(kind, x, y, radius),
        Markup('<circle class="healthy" cx="{:.0f}" cy="{:.0f}" r="{:.0f}"/>').format(x, y, _DISC),
        _text(x, y - 4.0, f"M{j + 1}", "name"),
        _text(x, y + 14.0, f"{100.0 * more:+.1f} %".replace("-", "−"), "load"),
    ]
    if weak is not None:
        below = y + _DISC + _LARGEST + 12.0 if y > centre else y - _DISC - _LARGEST - 2.0
        low, high = next(p["ci95"] for p in weak["parameters"] if p["name"] == "loss")
        words = f"loss {100.0 * change_value(weak, 'loss'):.0f} % ({100.0 * low:.0f} … {100.0 * high:.0f})"
        out.append(_text(x, below, words.replace("-", "−"), "loss" + kind))
    return Markup("").join(out)


def _text(x: float, y: float, words: str, kind: str) -> str:
    return Markup('<text class="{}" x="{:.0f}" y="{:.0f}">{}</text>').format(kind, x, y, words)


def _shift(changes: Sequence[Json], centre: float, scale: float) -> Sequence[str]:
    """An arrow from the centre towards where the CG went, enlarged."""
    found = [c for c in changes if c["effect"] == "cg_offset"]
    if not found:
        return ()
    ahead, right = (change_value(found[0], axis) for axis in "xy")
    x, y = centre + _SHIFT * scale * right, centre - _SHIFT * scale * ahead
    words = f"CG {1e3 * (ahead**2 + right**2) ** 0.5:.1f} mm"
    return (
        Markup('<line class="shift" x1="{0:.0f}" y1="{0:.0f}" x2="{1:.0f}" y2="{2:.0f}"/>').format(centre, x, y),
        Markup('<circle class="cg" cx="{:.0f}" cy="{:.0f}" r="7"/>').format(x, y),
        _text(x, y + 24.0, words, "loss"),
    )
