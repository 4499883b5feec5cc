"""What else the recorded flights hold, and why it is not used: vibration, control effort, sag, thrust and turning in
motion."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
from scipy.signal import butter, sosfiltfilt
from scipy.special import stdtrit

from quadid.checks.motion import flying_spans
from quadid.condition.changes import SIGNIFICANT
from quadid.condition.trim import trim_directions
from quadid.data.grid import linear
from quadid.data.rotor_signal import rotor_signal
from quadid.data.window import Recording
from quadid.types import BoolArray, FloatArray
from quadid_evaluation.studies.health.limits import untraced
from quadid_evaluation.studies.health.recorded import CRAZYFLIE, LARGE, Flown, Judged, kind_right

_BAND = (1.5, 15.0)
"""Motion that motors follow and position control does not make alone [Hz]."""
_LAG = 0.06
"""From command to accelerometer [s], motor and filters: it explains the healthy flights best."""
_GYRO_LAG = 0.04
"""The same to the gyro."""


class Feature(NamedTuple):
    """A feature, the channel that it needs, and the logarithm of its size in a log."""

    name: str
    channel: str
    value: Callable[[Recording], float]


def _steady(t: FloatArray, recording: Recording) -> BoolArray:
    (begin, end), *_ = flying_spans(recording, CRAZYFLIE)
    return np.asarray((t > begin + 1.5) & (t < end - 1.5))


def _bend(values: FloatArray) -> float:
    """Logarithm of the root mean square of second differences, as a level of white noise; mean over the columns."""
    return float(np.log(np.sqrt((np.diff(values, 2, axis=0) ** 2).mean(axis=0) / 6.0)).mean())


def vibration(recording: Recording, name: str, axes: slice) -> float:
    """Of a channel's axes above a quarter of its rate."""
    channel = recording.channels[name]
    return _bend(channel.values[_steady(channel.t, recording), axes])


def effort(recording: Recording) -> float:
    """Of the roll and pitch commands, as a share of the load."""
    rotors = rotor_signal(recording, CRAZYFLIE)
    load = rotors.values[_steady(rotors.t, recording)] ** 2
    return _bend(load @ trim_directions(CRAZYFLIE)[:2].T / load.sum(axis=1)[:, None])


def sag(recording: Recording) -> float:
    """Of the battery under load, per command: the current that the motors draw."""
    battery, rotors = recording.channels["battery"], rotor_signal(recording, CRAZYFLIE)
    (begin, _), *_ = flying_spans(recording, CRAZYFLIE)
    rest = np.median(battery.values[battery.t < begin - 0.3, 0])
    flying = battery.values[_steady(battery.t, recording), 0].mean()
    return float(np.log((rest - flying) / (rotors.values[_steady(rotors.t, recording)] ** 2).mean()))


def thrust_in_motion(recording: Recording) -> float:
    """What M3's command does to the vertical force, against what all do, within `_BAND`."""
    channel = recording.channels.get("accel_z") or recording.channels["accel_world"]
    rotors, t, force = rotor_signal(recording, CRAZYFLIE), channel.t, -channel.values[:, -1]
    count = min(len(rotors.t), len(t))
    band = butter(3, _BAND, "band", fs=1.0 / float(np.median(np.diff(t))), output="sos")
    load = linear(rotors.t, rotors.values**2, t[:count] - _LAG)
    inside = _steady(t[:count], recording)
    x, y = sosfiltfilt(band, load, axis=0)[inside], sosfiltfilt(band, force[:count])[inside]
    each = np.linalg.lstsq(x, y, rcond=None)[0]
    return float(np.log(max(each[2] / each.mean(), 0.05)))


def turning(recording: Recording) -> float:
    """Angular acceleration per roll and pitch command within `_BAND`: a weight on an arm has inertia."""
    gyro, rotors = recording.channels["gyro"], rotor_signal(recording, CRAZYFLIE)
    step = float(np.median(np.diff(gyro.t)))
    band = butter(3, _BAND, "band", fs=1.0 / step, output="sos")
    torque = linear(rotors.t, rotors.values**2 @ trim_directions(CRAZYFLIE)[:2].T, gyro.t - _GYRO_LAG)
    inside = _steady(gyro.t, recording)
    x = sosfiltfilt(band, np.cumsum(torque - torque.mean(axis=0), axis=0) * step, axis=0)[inside]
    y = sosfiltfilt(band, gyro.values[:, :2], axis=0)[inside]
    return float(np.log((x * y).sum() / (x * x).sum()))


GYRO = Feature("roll and pitch rate above 25 Hz", "gyro", lambda one: vibration(one, "gyro", slice(0, 2)))
FEATURES = (
    GYRO,
    Feature("vertical acceleration above 25 Hz", "accel_z", lambda one: vibration(one, "accel_z", slice(None))),
    Feature("acceleration above 25 Hz", "accel_world", lambda one: vibration(one, "accel_world", slice(None))),
    Feature("roll and pitch command above 25 Hz", "position", effort),
    Feature("battery's sag per command", "battery", sag),
    Feature("M3's thrust per command in motion", "position", thrust_in_motion),
    Feature("roll and pitch acceleration per command", "gyro", turning),
)
GROUPS: tuple[tuple[str, Callable[[Flown], bool]], ...] = (
    ("cuts below 3 mm, tape", lambda f: f.condition == "tape" or (f.condition == "cut" and f.total < LARGE)),
    ("larger, blades alike", lambda f: f.condition == "cut" and f.total >= LARGE and not f.uneven),
    ("larger, blades unlike", lambda f: f.condition == "cut" and f.total >= LARGE and f.uneven),
    ("glued weights", lambda f: "glued" in f.weight),
)


def outside(feature: Feature, flights: Sequence[Flown]) -> dict[str, bool]:
    """By file, whether one in a hundred healthy flights is as far out.

    Flights count from the healthy ones of their airframe and kind of log; the spread is that of all these.
    """
    values = {f.file: feature.value(f.recording) for f in flights if feature.channel in f.recording.channels}
    by: dict[tuple[str, str], list[float]] = {}
    for f in flights:
        if f.file in values and f.condition == "healthy":
            by.setdefault((f.airframe, f.kind), []).append(values[f.file])
    freedom = sum(len(healthy) - 1 for healthy in by.values())
    spread = float(np.sqrt(sum(np.var(healthy) * len(healthy) for healthy in by.values()) / freedom))
    limit = spread * float(stdtrit(freedom, 1.0 - 0.5 * SIGNIFICANT))
    out = {}
    for f in flights:
        if f.file in values and f.condition != "healthy":
            healthy = by[f.airframe, f.kind]
            far = abs(values[f.file] - np.mean(healthy))
            out[f.file] = bool(far > limit * np.sqrt(1.0 + 1.0 / len(healthy)))
    return out


def text(judged: Sequence[Judged]) -> str:
    """The features as Markdown: how many flights are outside of what healthy ones show."""
    compared = ("healthy", lambda f: f.condition == "healthy"), *GROUPS
    flights = [j.flown for j in judged if any(chosen(j.flown) for _, chosen in compared)]
    none = {j.flown.file for j in untraced(judged)}
    hints, silent = set[str](), list[str]()
    lines = [
        "| logarithm of | " + " | ".join(name for name, _ in GROUPS) + " |",
        "|---" * (1 + len(GROUPS)) + "|",
    ]
    for feature in FEATURES:
        far = outside(feature, flights)
        hints |= {file for file in none if far.get(file)}
        cells = []
        for _, chosen in GROUPS:
            mine = [far[f.file] for f in flights if chosen(f) and f.file in far]
            cells.append(f"{sum(mine)}/{len(mine)}")
        if all(cell.startswith("0/") for cell in cells):
            silent.append(feature.name)
        else:
            lines.append(f"| {feature.name} | " + " | ".join(cells) + " |")
    shaking = outside(GYRO, flights)
    mended = [j.flown.file for j in judged if j.flown.condition == "cut" and shaking.get(j.flown.file)]
    wrong = [j.flown.file for j in judged if j.flown.file in mended and not kind_right(j)]
    return "\n".join(lines) + _WHY.format(", ".join(silent), len(wrong), len(none), len(hints))


_WHY = """

Flights outside of what one healthy flight in a hundred shows, of those whose log has the channel; none by {}.
Propellers with unlike blades shake, others no more than healthy ones; as evidence of a propeller this would mend {} of
the wrong answers. Of the {} large cuts that fly like healthy flights, {} are outside in any row."""
