"""Rotor positions and spins as autopilots number them: ArduPilot's frames, PX4's geometry parameters.

ArduPilot stores angles only, no arm; PX4 stores positions.  Angles run clockwise from the nose, seen from above;
spin +1 is counter-clockwise seen from above, as in the vehicle file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import NamedTuple


class Place(NamedTuple):
    """A rotor: x forward, y right, z down [m], and spin +1 or -1."""

    x: float
    y: float
    z: float
    spin: int


class Frame(NamedTuple):
    """An airframe as the log tells it; `scaled` says that its size is a guess, for the autopilot stores none."""

    name: str
    rotors: tuple[Place, ...]
    scaled: bool


CCW, CW = 1, -1
_CLASSES = {1: "QUAD", 2: "HEXA", 3: "OCTA", 4: "OCTAQUAD", 5: "Y6", 7: "TRI"}
_TYPES = {0: "PLUS", 1: "X", 2: "V", 3: "H", 12: "BF_X", 13: "DJI_X", 14: "CW_X", 18: "BF_X_REV"}

ARDUPILOT: Mapping[str, tuple[tuple[float, int], ...]] = MappingProxyType({
    "QUAD/PLUS": ((90, CCW), (-90, CCW), (0, CW), (180, CW)),
    "QUAD/X": ((45, CCW), (-135, CCW), (-45, CW), (135, CW)),
    "QUAD/H": ((45, CW), (-135, CW), (-45, CCW), (135, CCW)),
    "QUAD/BF_X": ((135, CW), (45, CCW), (-135, CCW), (-45, CW)),
    "QUAD/BF_X_REV": ((135, CCW), (45, CW), (-135, CW), (-45, CCW)),
    "QUAD/DJI_X": ((45, CCW), (-45, CW), (-135, CCW), (135, CW)),
    "QUAD/CW_X": ((45, CCW), (135, CW), (-135, CCW), (-45, CW)),
    "HEXA/PLUS": ((0, CW), (180, CCW), (-120, CW), (60, CCW), (-60, CCW), (120, CW)),
    "HEXA/X": ((90, CW), (-90, CCW), (-30, CW), (150, CCW), (30, CCW), (-150, CW)),
    "OCTA/PLUS": ((0, CW), (180, CW), (45, CCW), (135, CCW), (-45, CCW), (-135, CCW), (-90, CW), (90, CW)),
    "OCTA/X": (
        (22.5, CW), (-157.5, CW), (67.5, CCW), (157.5, CCW), (-22.5, CCW), (-112.5, CCW), (-67.5, CW), (112.5, CW)
    ),
    "OCTAQUAD/X": ((45, CCW), (-45, CW), (-135, CCW), (135, CW), (-45, CCW), (45, CW), (135, CCW), (-135, CW)),
})  # fmt: skip
"""Angle [deg] and spin of motors 1, 2, 3 … (AP_MotorsMatrix.cpp of ArduPilot 4.x)."""


def frame_of(parameters: Mapping[str, float], arm: float) -> Frame | None:
    """Returns the airframe that an autopilot's parameters describe; None where they describe none that is known.

    Args:
        parameters: as logged (`Recording.autopilot`).
        arm: distance of the rotors from the centre [m], used where the autopilot stores none.
    """
    if "yaw_motors_reversed" in parameters:  # Betaflight's quadrotor; the default has propellers turning inwards
        name = "QUAD/BF_X_REV" if parameters["yaw_motors_reversed"] else "QUAD/BF_X"
        return _numbered(name, "Betaflight", arm)
    kind = _CLASSES.get(_whole(parameters, "FRAME_CLASS"), "")
    name = f"{kind}/{_TYPES.get(_whole(parameters, 'FRAME_TYPE'), '')}"
    return _px4(parameters) or (_numbered(name, "ArduPilot", arm) if name in ARDUPILOT else None)


def _numbered(name: str, autopilot: str, arm: float) -> Frame:
    rotors = [
        Place(arm * math.cos(math.radians(angle)), arm * math.sin(math.radians(angle)), 0.0, spin)
        for angle, spin in ARDUPILOT[name]
    ]
    return Frame(f"{autopilot} {name}", tuple(rotors), scaled=True)


def _px4(parameters: Mapping[str, float]) -> Frame | None:
    count = _whole(parameters, "CA_ROTOR_COUNT")
    if not 3 <= count <= 12:
        return None
    rotors = []
    for n in range(count):
        entry = [parameters.get(f"CA_ROTOR{n}_{key}", math.nan) for key in ("PX", "PY", "PZ", "KM")]
        if not all(math.isfinite(v) and abs(v) < 10.0 for v in entry) or entry[3] == 0.0:
            return None
        rotors.append(Place(entry[0], entry[1], entry[2], CCW if entry[3] > 0.0 else CW))
    return Frame(f"PX4 geometry of {count} rotors", tuple(rotors), scaled=False)


def _whole(parameters: Mapping[str, float], name: str) -> int:
    value = parameters.get(name, -1.0)
    return int(value) if abs(value) < 1e6 else -1
