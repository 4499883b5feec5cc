"""Motor outputs of autopilots: numbering, positions, spins, and rows of rotor speeds."""

import math
import re
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from quadid.types import BoolArray, FloatArray

# --- Rotor positions and spins as autopilots number them: ArduPilot's frames, PX4's geometry parameters
#
# ArduPilot stores angles only, no arm; PX4 stores positions.  Angles run clockwise from the nose, seen from above;
# spin +1 is counter-clockwise seen from above, as in the vehicle file.


class Place(NamedTuple):
    """A rotor: x forward, y right, z down [m], and spin +1 or -1."""

    x: float
    y: float
    z: float
    spin: int


class Frame(NamedTuple):
    """An airframe as logged; `scaled`: its size is a guess, for the autopilot stores none."""

    name: str
    rotors: tuple[Place, ...]
    scaled: bool


CCW, CW = 1, -1
_CLASSES = {1: "QUAD", 2: "HEXA", 3: "OCTA", 4: "OCTAQUAD", 5: "Y6", 7: "TRI"}
_TYPES = {0: "PLUS", 1: "X", 2: "V", 3: "H", 12: "BF_X", 13: "DJI_X", 14: "CW_X", 18: "BF_X_REV"}
_OCTA_SPINS = (CW, CW, CCW, CCW, CCW, CCW, CW, CW)

ARDUPILOT: Mapping[str, tuple[tuple[float, int], ...]] = MappingProxyType(
    {
        "QUAD/PLUS": ((90, CCW), (-90, CCW), (0, CW), (180, CW)),
        "QUAD/X": ((45, CCW), (-135, CCW), (-45, CW), (135, CW)),
        "QUAD/H": ((45, CW), (-135, CW), (-45, CCW), (135, CCW)),
        "QUAD/BF_X": ((135, CW), (45, CCW), (-135, CCW), (-45, CW)),
        "QUAD/BF_X_REV": ((135, CCW), (45, CW), (-135, CW), (-45, CCW)),
        "QUAD/DJI_X": ((45, CCW), (-45, CW), (-135, CCW), (135, CW)),
        "QUAD/CW_X": ((45, CCW), (135, CW), (-135, CCW), (-45, CW)),
        "HEXA/PLUS": ((0, CW), (180, CCW), (-120, CW), (60, CCW), (-60, CCW), (120, CW)),
        "HEXA/X": ((90, CW), (-90, CCW), (-30, CW), (150, CCW), (30, CCW), (-150, CW)),
        "OCTA/PLUS": tuple(zip((0, 180, 45, 135, -45, -135, -90, 90), _OCTA_SPINS, strict=True)),
        "OCTA/X": tuple(zip((22.5, -157.5, 67.5, 157.5, -22.5, -112.5, -67.5, 112.5), _OCTA_SPINS, strict=True)),
        "OCTAQUAD/X": ((45, CCW), (-45, CW), (-135, CCW), (135, CW), (-45, CCW), (45, CW), (135, CCW), (-135, CW)),
    }
)
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
    name = f"{kind}/{_TYPES.get(_whole(parameters, 'FRAME_TYPE', -1), '')}"
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


# --- Which logged outputs are motors, and rows of rotor speeds from telemetry that comes one motor at a time


RPM = 2.0 * np.pi / 60.0
"""One revolution per minute [rad/s]."""
_LOWEST_PULSE, _HIGHEST_PULSE = 700.0, 2300.0
_FRAMES = {"TRI": 3, "QUAD": 4, "HEXA": 6, "Y6": 6, "OCTA": 8, "OCTAQUAD": 8, "OCTA_QUAD": 8, "DODECAHEXA": 12}
MOST_ROTORS = 12
"""ArduPilot and PX4 mix no more."""
_LARGEST_WHOLE = 1e9
ESCS = 32
"""Outputs of ArduPilot, and ESCs that it may report."""
MOTOR_FUNCTION = re.compile(r"SERVO([1-9]|[12]\d|3[0-2])_FUNCTION|(?:PWM_(?:MAIN|AUX)|UAVCAN_EC)_FUNC([1-9]|1[0-6])")
"""Parameters of ArduPilot and PX4 that say what an output drives."""
_ARDUPILOT_MOTORS = {**{33 + k: k for k in range(8)}, **{82 + k: 8 + k for k in range(4)}}
_PX4_MOTORS = {101 + k: k for k in range(MOST_ROTORS)}
PX4_BANKS = ("PWM_AUX", "PWM_MAIN", "UAVCAN_EC")
"""PX4's banks of outputs, as its parameters name them."""
_OLD_ESCS = (4, 4)
"""The last ArduPilot that counts ESCs from 0, whatever outputs they are on."""
_TRICOPTER, _TAIL = (0, 1, 3), 6
"""ArduPilot's tricopter has motors 1, 2 and 4; its motor 7 is the servo of the tail."""
MULTIROTORS = {2: 4, 13: 6, 14: 8, 15: 3, 29: 12, 35: 10}
"""MAV_TYPE of multirotors: how many rotors they have."""
_OTHER_FRAMES = {6: "helicopter", 8: "single copter", 9: "coax copter", 11: "helicopter", 13: "helicopter"}
"""FRAME_CLASS of ArduCopter that is no multirotor."""
_OTHER_AIRFRAMES = {1: "plane", 2: "VTOL", 3: "tiltrotor", 4: "tailsitter", 5: "rover", 6: "rover", 10: "helicopter",
                    11: "helicopter", 12: "helicopter", 13: "rover", 14: "spacecraft"}  # fmt: skip
"""CA_AIRFRAME of PX4 that is no multirotor."""
_SHOTS = {"OneShot125": (125.0, 250.0), "OneShot42": (42.0, 84.0), "Multishot": (5.0, 25.0)}
"""Short pulses [us] that stand for those of 1000 and 2000, by protocol."""
DSHOT, UAVCAN = 1999.0, 8191.0
"""Full command of these protocols, as PX4 logs it."""
_NAMED = 4


class Outputs(NamedTuple):
    """Outputs that are motors.

    Attributes:
        columns: of the rotors one by one, 0 is the first output; empty where that is not known.
        problem: why no output can be used; empty where they can, or where nothing is said of them.
        told: by the autopilot's parameters, not by default.
    """

    columns: list[int]
    problem: str = ""
    told: bool = False


def motor_outputs(
    parameters: Mapping[str, float], rotors: int, width: int, message: str, ardupilot: bool = False
) -> Outputs:
    """Finds the motors among the outputs of one message, as the autopilot's parameters say.

    ArduPilot's SERVOn_FUNCTION 33..40 and 82..85 are motors 1..8 and 9..12.  Motor k is on output k where that is not
    told; where what is told contradicts it, as after a parameter was lost or for outputs of PX4 in another order, no
    output is used.

    Args:
        rotors: how many the vehicle has; 0 for unknown.
        width: how many outputs the message holds.
        ardupilot: whether it is an ArduPilot, be none of these parameters known.
    """
    ardupilot |= any(name.startswith("SERVO") and MOTOR_FUNCTION.fullmatch(name) for name in parameters)
    said = [
        (name, *_driven(name, value))
        for name, value in parameters.items()
        if MOTOR_FUNCTION.fullmatch(name) and (name.startswith("SERVO") or not ardupilot)
    ]
    said.sort(key=lambda entry: entry[1])  # of several outputs that drive one motor the first counts
    motors = {motor: output for _, output, motor in reversed(said) if motor is not None} if ardupilot else {}
    tricopter = ardupilot and (rotors == 3 or (not rotors and set(motors) == {*_TRICOPTER, _TAIL}))
    if tricopter:
        said = [(name, output, None if motor == _TAIL else motor) for name, output, motor in said]
        motors.pop(_TAIL, None)
    order = list(_TRICOPTER) if tricopter else list(range(rotors or len(motors)))
    told = bool(motors) and set(motors) == set(order)
    against = [
        f"{name} {_whole(parameters, name)}"
        for name, output, motor in said
        if not told and motor != (output if output in order else None) and (ardupilot or motor in order)
    ]
    if against:
        problem = f"{', '.join(against[:_NAMED])}: no order of {rotors or 'the'} motors, {message} is not used"
        return Outputs([], f"{problem}; let all of the autopilot's parameters be heard, or record rotor speeds")
    columns = [motors[m] if told else m for m in order]
    far = [f"motor {m + 1} on output {k + 1}" for m, k in zip(order, columns, strict=True) if k >= width]
    if far:
        problem = f"{', '.join(far)} (SERVOn_FUNCTION, else the frame), but {message} holds outputs 1 to {width}"
        fix = f"put the motors on the first {width} outputs, or record rotor speeds"
        return Outputs([], f"{problem}: it is not used; {fix}")
    return Outputs(columns, told=told)


def esc_columns(
    parameters: Mapping[str, float],
    rotors: int,
    reporting: Sequence[bool] | BoolArray,
    message: str,
    ardupilot: bool = False,
    version: tuple[int, int] | None = None,
) -> Outputs:
    """Finds the motors among the ESCs that report speeds: they go with the outputs, as `motor_outputs` has them.

    ESC k is the one on output k, or, up to ArduPilot 4.4, the k-th in the order of their outputs.  The one is used of
    which more ESCs report; if both do alike, the version decides.

    Args:
        rotors: how many the vehicle has; 0 for unknown.
        reporting: whether each ESC, from the first, ever reports a speed.
        ardupilot: whether it is an ArduPilot, be none of these parameters known.
        version: of ArduPilot, major and minor; None for unknown.
    """
    reports = [bool(reporting[k]) if k < len(reporting) else False for k in range(ESCS)]
    banks = [px4_motor_outputs(parameters, bank) for bank in PX4_BANKS]
    px4 = next((columns for columns in banks if columns and (not rotors or len(columns) == rotors)), None)
    found = motor_outputs(parameters, rotors, ESCS, message, ardupilot) if px4 is None else Outputs(px4, told=True)
    outputs = found.columns or list(range(min(sum(reports), MOST_ROTORS)))
    if found.problem or not any(reports):
        return found if found.problem else Outputs(outputs, told=found.told)
    by_rank = [sorted(outputs).index(k) for k in outputs]
    old = version is not None and version <= _OLD_ESCS
    ways = [by_rank, outputs] if old else [outputs, by_rank]
    columns = max(ways, key=lambda way: sum(reports[k] for k in way))
    if any(reports[k] for k in columns):
        return Outputs(columns, told=found.told)
    speeds, motors = (", ".join(str(k + 1) for k in which) for which in (np.flatnonzero(reports), outputs))
    return Outputs([], f"{message}: ESC {speeds} report speeds, but the motors are on {motors}: they are not used")


def frame_rotors(frame: str) -> int:
    """Returns how many rotors a frame of ArduPilot has; 0 for one that is not known.

    Args:
        frame: text after ``Frame:`` in a log's messages, such as ``QUAD/X``.
    """
    return _FRAMES.get(frame.split("/")[0].strip().upper(), 0)


def changed_functions(names: Sequence[str], values: Sequence[float]) -> str:
    """Names the parameters of outputs whose motor changes; empty where none does.

    Args:
        names: of all parameters in the order in which they came.
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
        f"{name} ({', then '.join(map(str, seen[:_NAMED]))}{' …' if len(seen) > _NAMED else ''})"
        for name, seen in given.items()
        if len(seen) > 1 and any(_driven(name, function)[1] is not None for function in seen)
    ]
    more = f" and {len(changed) - _NAMED} more" if len(changed) > _NAMED else ""
    return f"{', '.join(changed[:_NAMED])}{more}"


def changed_within(names: Sequence[str], values: Sequence[float]) -> str:
    """Says of a log, for people, which `changed_functions` it has."""
    changed = changed_functions(names, values)
    return changed and (
        f"the motor order changes within the log: {changed}; outputs follow the last values, so earlier data "
        "belong to other motors"
    )


def px4_motor_outputs(parameters: Mapping[str, float], bank: str) -> list[int]:
    """Returns the columns of motors 1, 2, 3 … in one bank of outputs, of `PX4_BANKS`.

    Args:
        parameters: PX4 parameters of the log.
        bank: the beginning of their names.
    """
    return motor_columns([_whole(parameters, f"{bank}_FUNC{output}") for output in range(1, 17)])


def motor_columns(functions: Sequence[int]) -> list[int]:
    """Returns the columns of motors 1, 2, 3 … by PX4's functions of each (parameters, `EscReport.actuator_function`).

    Functions 101..112 are motors 1..12; of several columns of one motor the first counts.  Empty where motors lack.
    """
    motors = {_PX4_MOTORS[f]: k for k, f in reversed([*enumerate(functions)]) if f in _PX4_MOTORS}
    return [motors[k] for k in range(len(motors))] if set(motors) == set(range(len(motors))) else []


def px4_rotor_count(parameters: Mapping[str, float]) -> int:
    """Returns the number of rotors by CA_ROTOR_COUNT, else by MAV_TYPE; 0 when neither has it."""
    count = _whole(parameters, "CA_ROTOR_COUNT")
    return count if 0 < count <= MOST_ROTORS else MULTIROTORS.get(_whole(parameters, "MAV_TYPE"), 0)


def _driven(name: str, value: float) -> tuple[int, int | None]:
    """Output (0 is the first) that a parameter is about, and the motor (0 is the first) that it puts on it."""
    match = MOTOR_FUNCTION.fullmatch(name)
    assert match is not None
    motors = _ARDUPILOT_MOTORS if match[1] else _PX4_MOTORS
    return int(match[1] or match[2]) - 1, motors.get(_whole({name: value}, name))


def _whole(parameters: Mapping[str, float], name: str, otherwise: int = 0) -> int:
    """A parameter as a whole number; `otherwise` where it is absent or damaged beyond any number."""
    value = parameters.get(name, math.nan)
    return int(value) if abs(value) < _LARGEST_WHOLE else otherwise


def no_multirotor(parameters: Mapping[str, float], mav_type: int = 0, firmware: str = "") -> str:
    """Says why a vehicle's outputs are not all rotors: it is a plane, a VTOL, a helicopter …; empty for a multirotor.

    Args:
        mav_type: MAV_TYPE of its heartbeats; 0 for unknown.
        firmware: of ArduPilot, such as Copter or Plane; empty for unknown.
    """
    kind = mav_type or _whole(parameters, "MAV_TYPE")
    airframe = _OTHER_AIRFRAMES.get(_whole(parameters, "CA_AIRFRAME"))
    frame = _OTHER_FRAMES.get(_whole(parameters, "FRAME_CLASS"))
    which = (
        f"MAV_TYPE {kind}"
        if kind and kind not in MULTIROTORS
        else f"Ardu{firmware}"
        if firmware not in ("", "Copter")
        else f"CA_AIRFRAME {airframe}"
        if airframe
        else f"FRAME_CLASS {frame}"
        if frame
        else "Q_ENABLE 1"
        if parameters.get("Q_ENABLE") == 1.0
        else ""
    )
    return which and f"the vehicle calls itself {which}, no multirotor: its outputs are not used"


def in_pulses(outputs: FloatArray) -> tuple[FloatArray, str]:
    """Outputs (n, k) as pulse widths [us], of which shorter protocols have a part; and what was done, for people."""
    turning = outputs[outputs > 0.0]
    ends = np.quantile(turning, [0.05, 0.95]) if len(turning) else np.zeros(2)
    for name, (least, full) in _SHOTS.items():
        slope = 1000.0 / (full - least)
        if np.all(np.abs(1000.0 + slope * (ends - least) - 1500.0) < 800.0) and ends[1] > least:
            pulses = np.where(outputs > 0.0, 1000.0 + slope * (outputs - least), outputs)
            return pulses, f"{name}, {least:g} to {full:g} us"
    return outputs, ""


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
