"""What else the recorded flights hold, and why it is not used: vibration, control effort, thrust in motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt

from quadid.health.trims import trim_directions
from quadid.inspection.airborne import flying_spans
from quadid.resample import linear
from quadid.rotor_signal import rotor_signal
from quadid.types import BoolArray, FloatArray
from quadid.window import Recording
from studies.health.recorded import CRAZYFLIE, LARGE, Flown

_BAND = (1.5, 15.0)
"""Motion that motors follow and position control does not make alone [Hz]."""
_LAG = 0.06
"""From command to accelerometer [s], motor and filters: it explains the healthy flights best."""


class Feature(NamedTuple):
    """A feature, its value for a log, and whether that is a logarithm."""

    name: str
    value: Callable[[Recording], float]


def _steady(t: FloatArray, recording: Recording) -> BoolArray:
    (begin, end), *_ = flying_spans(recording, CRAZYFLIE)
    return np.asarray((t > begin + 1.5) & (t < end - 1.5))


def _bend(values: FloatArray) -> float:
    """Logarithm of the root mean square of second differences, as a level of white noise."""
    return float(np.log(np.sqrt(np.mean(np.diff(values, 2) ** 2) / 6.0)))


def _vertical(recording: Recording) -> tuple[FloatArray, FloatArray]:
    channel = recording.channels.get("accel_z") or recording.channels["accel_world"]
    return channel.t, -channel.values[:, -1]


def vibration(recording: Recording) -> float:
    """Of the accelerometer's z axis above a quarter of its rate."""
    t, force = _vertical(recording)
    return _bend(force[_steady(t, recording)])


def _balance(recording: Recording, axis: int) -> float:
    rotors = rotor_signal(recording, CRAZYFLIE)
    load = rotors.values[_steady(rotors.t, recording)] ** 2
    return _bend(load @ trim_directions(CRAZYFLIE)[axis] / load.sum(axis=1))


def roll_effort(recording: Recording) -> float:
    """Of the roll command, as a share of the load."""
    return _balance(recording, 0)


def pitch_effort(recording: Recording) -> float:
    """Of the pitch command."""
    return _balance(recording, 1)


def thrust_in_motion(recording: Recording) -> float:
    """Logarithm of what M3's command does to the vertical force, against what all do, within `_BAND`."""
    rotors, (t, force) = rotor_signal(recording, CRAZYFLIE), _vertical(recording)
    count = min(len(rotors.t), len(t))
    band = butter(3, _BAND, "band", fs=1.0 / float(np.median(np.diff(t))), output="sos")
    load = linear(rotors.t, rotors.values**2, t[:count] - _LAG)
    inside = _steady(t[:count], recording)
    x, y = sosfiltfilt(band, load, axis=0)[inside], sosfiltfilt(band, force[:count])[inside]
    each = np.linalg.lstsq(x, y, rcond=None)[0]
    return float(np.log(max(each[2] / each.mean(), 0.05)))


FEATURES = (
    Feature("accelerometer's vibration, z", vibration), Feature("roll command above 25 Hz", roll_effort),
    Feature("pitch command above 25 Hz", pitch_effort), Feature("M3's thrust per command in motion", thrust_in_motion),
)  # fmt: skip


def positioning(flights: Sequence[Flown]) -> float:
    """Correlation, over flights, of the roll command's noise with that of the roll that position control asks for."""
    pairs = []
    for recording in (f.recording for f in flights):
        wanted = recording.channels.get("attitude_reference")
        if wanted is not None:
            pairs.append((roll_effort(recording), _bend(wanted.values[_steady(wanted.t, recording), 0])))
    return float(np.corrcoef(np.array(pairs).T)[0, 1])


_WHY = """
None is used. Vibration tells how well propellers are balanced: two equal cuts keep the balance, and healthy sets differ
by half. The roll command's noise goes with the roll that position control asks for (correlation {:.2f}). What M3's
command does in motion differs by a factor of {:.1f} between flights (1 sigma), whatever was cut."""


def text(flights: Sequence[Flown]) -> str:
    """The features as Markdown: spread of healthy flights, and cuts of M3 in units of it."""
    lines = [
        "| feature (logarithm) | spread of E8 | of E9 | cuts of E8 from 3 mm on, in spreads | of E9 |",
        "|---|---|---|---|---|",
    ]
    for feature in FEATURES:
        spreads, moved = [], []
        for airframe in ("E8", "E9"):
            mine = [f for f in flights if f.airframe == airframe]
            healthy = np.array([feature.value(f.recording) for f in mine if f.condition == "healthy"])
            cut = [feature.value(f.recording) for f in mine if f.rotors == {3} and f.total >= LARGE]
            spreads.append(float(healthy.std(ddof=1)))
            far = (np.array(cut) - healthy.mean()) / spreads[-1]
            moved.append(f"{np.median(far):+.1f}")
        lines.append(f"| {feature.name} | {spreads[0]:.2f} | {spreads[1]:.2f} | {moved[0]} | {moved[1]} |")
    scatter = float(np.exp(np.std([thrust_in_motion(f.recording) for f in flights if f.condition == "cut"])))
    return "\n".join(lines) + "\n" + _WHY.format(positioning(flights), scatter)
