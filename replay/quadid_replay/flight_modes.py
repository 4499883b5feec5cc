"""Names of flight modes: ArduCopter's numbers (MODE records) and PX4's (nav_state of vehicle_status)."""

from __future__ import annotations

import numpy as np

from quadid.types import FloatArray

ARDUCOPTER = {
    0: "Stabilize", 1: "Acro", 2: "AltHold", 3: "Auto", 4: "Guided", 5: "Loiter", 6: "RTL", 7: "Circle", 9: "Land",
    11: "Drift", 13: "Sport", 14: "Flip", 15: "AutoTune", 16: "PosHold", 17: "Brake", 18: "Throw", 19: "Avoid ADSB",
    20: "Guided NoGPS", 21: "SmartRTL", 22: "FlowHold", 23: "Follow", 24: "ZigZag", 25: "SystemID", 26: "Autorotate",
    27: "Auto RTL", 28: "Turtle",
}  # fmt: skip
PX4 = {
    0: "Manual", 1: "Altitude", 2: "Position", 3: "Mission", 4: "Hold", 5: "Return", 10: "Acro", 12: "Descend",
    13: "Termination", 14: "Offboard", 15: "Stabilized", 17: "Takeoff", 18: "Land", 19: "Follow", 20: "Precision land",
    21: "Orbit", 22: "VTOL takeoff",
}  # fmt: skip


def mode_changes(t: FloatArray, numbers: FloatArray, names: dict[int, str]) -> tuple[tuple[float, str], ...]:
    """When the mode changed [s], and what to.

    Args:
        t: times of the records [s], NaN where refused, shape (n,).
        numbers: of the modes, shape (n,).
        names: by number; one without a name keeps its number.
    """
    known = np.isfinite(t) & np.isfinite(numbers)
    t, numbers = t[known], numbers[known]
    first = np.flatnonzero(np.diff(numbers, prepend=np.nan) != 0.0)
    return tuple((float(t[i]), names.get(int(numbers[i]), f"mode {int(numbers[i])}")) for i in first)
