"""A manoeuvre in words for somebody with a transmitter."""

from __future__ import annotations

import math
from itertools import groupby

from quadid.types import Json
from quadid_report.manoeuvres.plan import Plan

PEAK = math.sqrt(2.0)
"""Of a swing over its rms."""


def sticks(plan: Plan) -> str:
    """What to do with the sticks, block after block."""
    blocks = [list(block) for _, block in groupby(plan.segments, key=lambda s: s["start"])]
    lines = [*plan.header(plan.promise, "what to do with the sticks"), ""]
    lines += [
        "Fly in Stabilize or AltHold (PX4: Stabilized or Altitude), log IMU and motors at the highest rate. Hover in "
        "the middle of the envelope; between two movements level out and go back there. The promise is that of a "
        "flight to the letter: by hand move at least as quickly, and let `quadid inspect` say what was reached.",
        "",
    ]
    for number, (text, times) in enumerate(_counted([_block(block) for block in blocks]), 1):
        lines.append(f"{number}. {f'{times} times, ' if times > 1 else ''}{text}")
    lines += [
        "",
        "Stop at once below the lowest height, beyond the tilt, or when the battery is down to its limit.",
    ]
    return "\n".join(lines) + "\n"


def _counted(texts: list[str]) -> list[tuple[str, int]]:
    return [(text, len(list(same))) for text, same in groupby(texts)]


def _block(block: list[Json]) -> str:
    first = block[0]
    moves = ", ".join(_move(s) for s in block)
    return (
        f"{first['duration']:g} s of swinging to and fro, from {first['frequency']:g} to {first['frequency_end']:g} "
        f"times a second, all named sticks at once and each at its own pace: {moves}."
    )


def _move(segment: Json) -> str:
    size = PEAK * float(segment["amplitude"])
    if segment["axis"] == "throttle":
        return f"throttle {100.0 * size:.0f} % about hover"
    return f"{segment['axis']} {math.degrees(size):.0f} degrees to each side"
