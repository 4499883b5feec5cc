"""Which logged outputs are motors, and rows of rotor speeds from telemetry that comes one motor at a time."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence

import numpy as np

from quadid.types import FloatArray

RPM = 2.0 * np.pi / 60.0
"""One revolution per minute [rad/s]."""
_LOWEST_PULSE, _HIGHEST_PULSE = 700.0, 2300.0
_FRAMES = {"TRI": 3, "QUAD": 4, "HEXA": 6, "Y6": 6, "OCTA": 8, "OCTAQUAD": 8, "OCTA_QUAD": 8, "DODECAHEXA": 12}
MOST_ROTORS = 12
"""ArduPilot and PX4 mix no more."""
_LARGEST_WHOLE = 1e9
MOTOR_FUNCTION = re.compile(r"SERVO(?:[1-9]|[12]\d|3[0-2])_FUNCTION")
"""Parameters of ArduPilot that say what an output drives."""
_PX4_TYPES = {2: 4, 13: 6, 14: 8, 15: 3}  # MAV_TYPE: quadrotor, hexarotor, octorotor, tricopter


def ardupilot_motor_outputs(parameters: Mapping[str, float], frame: str = "") -> list[int]:
    """Returns the output columns (0 is the first) of motors 1, 2, 3 …; empty when the log does not say.

    SERVOn_FUNCTION 33..40 and 82..85 are motors 1..8 and 9..12; older logs only tell the frame in a message.

    Args:
        parameters: ArduPilot parameters of the log.
        frame: text after ``Frame:`` in the log's messages, such as ``QUAD/X``.
    """
    motors: dict[int, int] = {}
    for output in range(1, 33):
        motor = _motor_of(_whole(parameters, f"SERVO{output}_FUNCTION"))
        if motor is not None:
            motors[motor] = output - 1
    if motors and sorted(motors) == list(range(len(motors))):
        return [motors[i] for i in range(len(motors))]
    return list(range(_FRAMES.get(frame.split("/")[0].strip().upper(), 0)))


def unheld(motors: Sequence[int], width: int, message: str) -> str:
    """Says which motors stand on outputs that a message does not hold; empty where it holds all.

    Args:
        motors: their outputs, 0 is the first.
        width: how many outputs the message holds.
        message: its name.
    """
    far = [f"motor {k + 1} on output {output + 1}" for k, output in enumerate(motors) if output >= width]
    if not far:
        return ""
    return (
        f"{', '.join(far)} (SERVOn_FUNCTION, else the frame), but {message} holds outputs 1 to {width}: "
        f"it is not used; put the motors on the first {width} outputs, or record rotor speeds"
    )


def changed_functions(names: Sequence[str], values: Sequence[float]) -> str:
    """Says which SERVOn_FUNCTION of a motor changes within a log; empty where none does.

    Args:
        names: of all parameters in the order in which the log gives them.
        values: theirs.
    """
    given: dict[str, list[int]] = {}
    for name, value in zip(names, values, strict=True):
        if MOTOR_FUNCTION.fullmatch(name):
            function = _whole({name: value}, name)
            seen = given.setdefault(name, [])
            if function not in seen[-1:]:
                seen.append(function)
    changed = [
        f"{name} ({', then '.join(map(str, seen[:4]))}{' …' if len(seen) > 4 else ''})"
        for name, seen in given.items()
        if len(seen) > 1 and any(_motor_of(function) is not None for function in seen)
    ]
    if not changed:
        return ""
    more = f" and {len(changed) - 4} more" if len(changed) > 4 else ""
    return (
        f"the motor order changes within the log: {', '.join(changed[:4])}{more}; outputs are taken as the last values "
        "say, so those from before the change are of other motors"
    )


def px4_motor_outputs(parameters: Mapping[str, float], bank: str) -> list[int]:
    """Returns the columns of motors 1, 2, 3 … in one bank of outputs.

    PWM_<bank>_FUNCn 101..112 are motors 1..12.

    Args:
        parameters: PX4 parameters of the log.
        bank: ``MAIN`` or ``AUX``.
    """
    motors = {}
    for output in range(1, 17):
        function = _whole(parameters, f"PWM_{bank}_FUNC{output}")
        if 101 <= function <= 112:
            motors[function - 101] = output - 1
    return [motors[i] for i in range(len(motors))] if sorted(motors) == list(range(len(motors))) else []


def px4_rotor_count(parameters: Mapping[str, float]) -> int:
    """Returns the number of rotors that CA_ROTOR_COUNT, else MAV_TYPE, tells; 0 when neither does."""
    count = _whole(parameters, "CA_ROTOR_COUNT")
    return count if 0 < count <= MOST_ROTORS else _PX4_TYPES.get(_whole(parameters, "MAV_TYPE"), 0)


def _motor_of(function: int) -> int | None:
    """The motor, 0 for the first, that a SERVOn_FUNCTION stands for."""
    if 33 <= function <= 40:
        return function - 33
    return function - 82 + 8 if 82 <= function <= 85 else None


def _whole(parameters: Mapping[str, float], name: str) -> int:
    """A parameter as a whole number; 0, which tells nothing, where it is absent or damaged beyond any number."""
    value = parameters.get(name, 0.0)
    return int(value) if abs(value) < _LARGEST_WHOLE else 0


def active_outputs(pulses: FloatArray) -> list[int]:
    """Returns the leading outputs that look like motors: pulses [us] in range that vary; shape (n, outputs)."""
    columns = 0
    for column in pulses.T if len(pulses) else ():
        plausible = (column > _LOWEST_PULSE) & (column < _HIGHEST_PULSE)
        if plausible.mean() < 0.9 or np.ptp(column[plausible]) < 20.0:
            break
        columns += 1
    return list(range(max((n for n in (3, 4, 6, 8, 12) if n <= columns), default=0)))


def merge_instances(series: Sequence[tuple[FloatArray, FloatArray]]) -> tuple[FloatArray, FloatArray]:
    """Makes rows of signals that arrive one instance at a time.

    Rows stand at the times of the instance with fewest samples; the others are interpolated linearly, never beyond
    their ends.

    Args:
        series: for each instance times [s] (increasing) and values.

    Returns:
        Times (n,) and values (n, instances).
    """
    if not series or any(len(t) < 2 for t, _ in series):
        return np.empty(0), np.empty((0, len(series)))
    reference = min((t for t, _ in series), key=len)
    first, last = max(t[0] for t, _ in series), min(t[-1] for t, _ in series)
    at = reference[(reference >= first) & (reference <= last)]
    return at, np.column_stack([np.interp(at, t, values) for t, values in series])
