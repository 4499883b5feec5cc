"""When the vehicle flies, from its motors or its vibration."""

from __future__ import annotations

import numpy as np

from quadid.model.thrust import ThrustModel
from quadid.resample import moving_mean, sample_period, true_runs
from quadid.rotor_signal import rotor_channel
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle
from quadid.window import Channel, Recording

Spans = tuple[tuple[float, float], ...]

_LEAST = 0.5
"""Flying means at least this fraction of hover thrust …"""
_FALLING = 0.8
"""Who feels less than this share of his weight falls."""
_OFF = 16.0
"""A thrust coefficient that is wrong by more tells nothing of the weight."""
_CARRIES = 0.9
"""… from when the rotors first carry this fraction of what they usually do; below, the ground still has its share."""
_IDLE = 0.15
"""Commands that never exceed this fraction of full are idling motors."""
_NOTHING = 0.1
"""A rotor below this share of the median speed of all is ignored."""
_GROUND = 3.0
"""Rotors that carry nothing for longer than this [s] stand on the ground; a log with more of it is worth trimming."""
_MARGIN = 2.0
"""Left out after take-off and before landing [s]: feet, ground and the air above it push, too."""
_FLIGHT = 5.0
"""Shortest flight worth proposing [s]."""
_SHORTEST, _BRIDGE = 1.0, 0.5
"""Spans shorter than the first [s] are none; interruptions up to the second [s] do not end one."""


def flying_spans(recording: Recording, vehicle: Vehicle | None) -> Spans:
    """Returns the spans [s] in which the vehicle flies; empty without evidence.

    Thrust and weight are those of the vehicle file where rotor speeds and a vehicle are known; else thrust grows with
    the square of the command, and hover is what is felt as one g.  A vehicle that feels less than its weight falls, and
    so flies, whatever its rotors do; one that feels it along an unusual direction for half a second lies somewhere.
    """
    channels = recording.channels
    rotors, _ = rotor_channel(recording, vehicle)
    if rotors is not None:
        accel = channels.get("accel")
        load = None if accel is None or len(accel.t) < 10 else _load(accel)
        felt = None if load is None or accel is None else np.interp(rotors.t, accel.t, load)
        thrust, hover = _thrust(rotors, vehicle, felt)
        if hover <= 0.0:
            return ()
        t, on = rotors.t, thrust > _LEAST * hover
        if accel is not None and len(accel.t) > 10:
            on &= np.interp(t, accel.t, _felt(accel)) > 0.5
        if felt is not None and on.any():
            inside = (t >= t[on][0]) & (t <= t[on][-1])
            on |= inside & (felt < _FALLING)
        carried = t[on & (thrust > _CARRIES * np.median(thrust[on]))] if on.any() else t[on]
        return tuple(later for span in _spans(t, on) if (later := _from_carried(span, carried)))
    if "accel" in channels and len(channels["accel"].t) > 10:
        return _spans(channels["accel"].t, _vibrates(channels["accel"]))
    return ()


def proposed_cuts(spans: Spans, first: float, last: float) -> Spans:
    """Flights without take-off and landing [s after `first`, to a tenth]; none where the log holds little else.

    Args:
        spans: when it flies [s].
        first: sample that is used when nothing is cut [s].
        last: sample, likewise [s].
    """
    flights: list[tuple[float, float]] = []
    for a, b in spans:
        if flights and a - flights[-1][1] < _GROUND:
            flights[-1] = (flights[-1][0], b)
        else:
            flights.append((a, b))
    if last - first - sum(b - a for a, b in flights) < _GROUND:
        return ()
    cuts = [
        (0.0 if a - first < _MARGIN else a + _MARGIN - first, (b if last - b < _MARGIN else b - _MARGIN) - first)
        for a, b in flights
    ]
    return tuple((round(a, 1), round(b, 1)) for a, b in cuts if b - a >= _FLIGHT)


def within(t: FloatArray, spans: Spans) -> BoolArray:
    """Which of the times [s], shape (n,), lie in one of the spans."""
    return np.asarray(np.any([np.zeros(len(t), dtype=bool), *((t >= a) & (t <= b) for a, b in spans)], axis=0))


def _thrust(channel: Channel, vehicle: Vehicle | None, felt: FloatArray | None) -> tuple[FloatArray, float]:
    """Returns relative thrust and the value that hovers; `felt` is the specific force [g], shape (n,)."""
    values = channel.values
    if channel.name == "motor_command" and np.median(np.abs(values)) > 100.0:
        low, high = vehicle.command.range if vehicle is not None else (1000.0, 2000.0)
        values = np.clip((values - low) / (high - low), 0.0, None)
    values = _beside_others(values)
    thrust = np.asarray(np.sum(values**2, axis=1))
    if channel.name == "motor_command" and np.quantile(thrust, 0.95) < _IDLE**2 * values.shape[1]:
        return thrust, 0.0
    if channel.name == "rotor_speed" and vehicle is not None and values.shape[1] == len(vehicle.rotors):
        modelled, hover = ThrustModel.stated(vehicle).total(values), vehicle.mass * GRAVITY
        highest = float(np.max(modelled))  # of losses that no rotor has it may be negative
        typical = float(np.median(modelled[modelled >= 0.25 * highest])) if highest > 0.0 else 0.0
        if 1.0 / _OFF < typical / hover < _OFF:
            return modelled, hover
    strong = thrust > 0.5 * np.quantile(thrust, 0.95)
    if felt is not None and (strong := strong & (felt > 0.5)).any():
        return thrust, float(np.median(thrust[strong] / felt[strong]))
    powered = thrust[thrust > 0.25 * np.quantile(thrust, 0.95)]
    return thrust, float(np.median(powered)) if len(powered) else 0.0


def _beside_others(speeds: FloatArray) -> FloatArray:
    """Speeds with the others' median for a rotor that is ignored: it is dead, or its signal is; no ground carries."""
    usual = np.median(speeds, axis=1, keepdims=True)
    return np.asarray(np.where(speeds < _NOTHING * usual, usual, speeds))


def _load(accel: Channel) -> FloatArray | None:
    """Specific force [g] averaged over 0.2 s, shape (n,), whichever unit it is in; None where it is in none."""
    length = np.linalg.norm(accel.values, axis=1)
    middle = float(np.median(length))
    unit = next((u for u in (GRAVITY, 1.0, 1e3) if 0.5 < middle / u < 4.0), None)
    width = max(1, round(0.2 / sample_period(accel.t)))
    return None if unit is None else np.asarray(moving_mean(length / unit, width))


def _felt(accel: Channel) -> FloatArray:
    """Returns 1 where the specific force, averaged over 0.5 s, points along its usual direction, else 0; any unit."""
    usual = np.median(accel.values, axis=0)
    share = accel.values @ usual / float(usual @ usual or 1.0)
    width = max(1, round(0.5 / sample_period(accel.t)))
    return np.asarray(moving_mean(share, width) > 0.3, dtype=np.float64)


def _vibrates(accel: Channel) -> BoolArray:
    """Tells where the accelerometer's length varies by more than at rest (0.3 m/s^2 over 25 samples)."""
    length = np.linalg.norm(accel.values, axis=1)
    mean, square = moving_mean(length, 25), moving_mean(length**2, 25)
    return np.asarray(np.sqrt(np.maximum(square - mean**2, 0.0)) > 0.3)


def _from_carried(span: tuple[float, float], carried: FloatArray) -> tuple[float, float] | None:
    """A span from the first of the rising times [s] in it at which rotors carry; None where that is too short."""
    first = float(carried[at]) if (at := int(np.searchsorted(carried, span[0]))) < len(carried) else np.inf
    return (first, span[1]) if span[1] - first >= _SHORTEST else None


def _spans(t: FloatArray, on: BoolArray) -> Spans:
    spans: list[tuple[float, float]] = []
    for first, end in zip(*true_runs(on), strict=True):
        a, b = float(t[first]), float(t[end - 1])
        if spans and a - spans[-1][1] <= _BRIDGE:
            spans[-1] = (spans[-1][0], b)
        else:
            spans.append((a, b))
    return tuple(span for span in spans if span[1] - span[0] >= _SHORTEST)
