"""PX4's control allocation: from torque and thrust setpoints, logged at 50 Hz, to the motors, logged at 10 Hz.

The pseudo-inverse of the rotors' geometry in the log's own parameters, scaled as PX4 scales it (ControlAllocation and
ActuatorEffectivenessRotors of its sources).  Where a motor would leave 0 to 1 PX4 gives up torque for it in steps that
are not repeated here; such rows have no value.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from quadid.types import FloatArray
from quadid_replay.motors import px4_rotor_count

MULTIROTOR = 0
"""CA_AIRFRAME whose rotors alone make forces and moments."""
_DEFAULTS = {"AX": 0.0, "AY": 0.0, "AZ": -1.0, "PX": 0.0, "PY": 0.0, "PZ": 0.0, "CT": 6.5, "KM": 0.05}
_NOTHING = 1e-3
"""Share of a torque below which a motor has no part in it."""


def allocation(parameters: Mapping[str, float]) -> FloatArray | None:
    """Matrix from torque and thrust setpoints (x, y, z each, FRD) to motors, shape (rotors, 6).

    Args:
        parameters: of the autopilot, by name (CA_AIRFRAME, CA_ROTORn_*).

    Returns:
        None where these are not told, or not of a multirotor.
    """
    count = px4_rotor_count(parameters)
    if not count or parameters.get("CA_AIRFRAME") != MULTIROTOR:
        return None
    rotors = [
        {k: float(parameters.get(f"CA_ROTOR{i}_{k}", default)) for k, default in _DEFAULTS.items()}
        for i in range(count)
    ]
    place, axis = (np.array([[r[f"{kind}{a}"] for a in "XYZ"] for r in rotors]) for kind in "PA")
    length = np.linalg.norm(axis, axis=1, keepdims=True)
    strength, drag = (np.array([[r[k]] for r in rotors]) for k in ("CT", "KM"))
    if not np.all(length > 0.0):
        return None
    axis = axis / length
    effect = strength * np.hstack([np.cross(place, axis) - drag * axis, axis])
    mix = np.linalg.pinv(effect.T)
    mix[:, :2] /= max(_spread(mix[:, 0]), _spread(mix[:, 1])) or 1.0
    mix[:, 2] /= np.max(np.abs(mix[:, 2])) or 1.0
    lifting = np.abs(mix[:, 5]) > np.finfo(np.float32).eps
    mix[:, 3:] /= np.mean(np.abs(mix[lifting, 5])) if lifting.any() else 1.0
    return np.asarray(mix)


def _spread(column: FloatArray) -> float:
    """Size of what motors do for a torque, as PX4 scales it to one."""
    taking_part = np.count_nonzero(np.abs(column) > _NOTHING)
    return float(np.sqrt(np.sum(column**2) / (0.5 * taking_part))) if taking_part else 0.0


def allocated(mix: FloatArray, setpoints: FloatArray) -> FloatArray:
    """Motors, relative thrust 0 to 1, shape (n, rotors); rows in which PX4 would have limited one are not finite.

    Args:
        mix: of `allocation`.
        setpoints: torque and thrust, shape (n, 6).
    """
    motors = setpoints @ mix.T
    limited = np.any((motors < 0.0) | (motors > 1.0), axis=1)
    motors[limited] = np.nan
    return motors
