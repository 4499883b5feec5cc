"""A flight with one channel multiplied by a factor, and what the online session publishes of it."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import butter, sosfiltfilt

from quadid.data.window import Block, Recording
from quadid.online import Job, Publish, Session
from quadid.online.records import OnlineSet
from quadid.types import FloatArray

Spoil = Callable[[Recording], Recording]
MUST = ("b", "J_xx", "J_yy")
STEP = 0.1
"""Data are handed over in pieces of this length [s]."""


@dataclass(frozen=True)
class Poison:
    """One channel wrong by a factor.

    Attributes:
        channel: name of the channel; column: which of it, None for all (of the attitude: roll and pitch).
        factor: what it is multiplied by in the end.
        begin: when it begins [s]; ramp: how long it grows [s], 0 for a step.
    """

    channel: str
    column: int | None
    factor: float
    begin: float
    ramp: float

    def factors(self, t: FloatArray) -> FloatArray:
        """Factor at times `t` [s], shape (n,)."""
        share = np.clip((t - self.begin) / self.ramp, 0.0, 1.0) if self.ramp else (t >= self.begin).astype(float)
        return np.asarray(1.0 + (self.factor - 1.0) * share)

    def spoil(self, recording: Recording) -> Recording:
        """The recording with the poison in it."""
        channel = recording.channels[self.channel]
        factor = self.factors(channel.t)
        if self.channel == "attitude":
            values = turned(channel.values, factor)
        else:
            scale = np.ones_like(channel.values)
            scale[:, slice(None) if self.column is None else self.column] = (
                factor[:, None] if self.column is None else factor
            )
            values = channel.values * scale
        return replace(
            recording, channels={**recording.channels, self.channel: replace(channel, values=np.asarray(values))}
        )


def scaled(channel: str, factor: float, column: int | None = None) -> Spoil:
    """A channel, or one column of it, wrong by a factor from the beginning."""
    return Poison(channel, column, factor, -np.inf, 0.0).spoil


def changed(channel: str, change: Callable[[FloatArray], FloatArray]) -> Spoil:
    """A channel whose values, shape (n, k), something was done to."""

    def spoil(recording: Recording) -> Recording:
        old = recording.channels[channel]
        new = replace(old, values=np.asarray(change(old.values)))
        return replace(recording, channels={**recording.channels, channel: new})

    return spoil


def supported(newtons: float, b: float) -> Spoil:
    """Something holds the vehicle up by a force [N], down where negative; it flies the same motion."""

    def less(speed: FloatArray) -> FloatArray:
        return np.asarray(np.sqrt(np.maximum(speed**2 - newtons / speed.shape[1] / b, 1.0)))

    return changed("rotor_speed", less)


def leaking(source: int, into: int, share: float) -> Spoil:
    """A share of one axis of the gyro is in another."""

    def mixed(gyro: FloatArray) -> FloatArray:
        out = gyro.copy()
        out[:, into] += share * gyro[:, source]
        return out

    return changed("gyro", mixed)


def about_the_mean(factor: float) -> Spoil:
    """An accelerometer's scale that a bias hides at 1 g."""
    return changed("accel", lambda force: force.mean(axis=0) + factor * (force - force.mean(axis=0)))


def smoothed(cutoff: float, rate: float = 50.0) -> Spoil:
    """A gyro smoothed forwards and backwards below a frequency [Hz]."""
    return changed("gyro", lambda g: sosfiltfilt(butter(2, cutoff, fs=rate, output="sos"), g, axis=0))


def late(channel: str, seconds: float) -> Spoil:
    """A channel whose stamps are late [s]."""

    def spoil(recording: Recording) -> Recording:
        old = recording.channels[channel]
        return replace(recording, channels={**recording.channels, channel: replace(old, t=old.t + seconds)})

    return spoil


def turned(q: FloatArray, factor: FloatArray) -> FloatArray:
    """Attitudes whose roll and pitch are multiplied, heading as it was; shapes (n, 4) and (n,)."""
    w, x, y, z = q.T
    roll = np.arctan2(2.0 * (w * x + y * z), 1.0 - 2.0 * (x * x + y * y)) * factor
    pitch = np.arcsin(np.clip(2.0 * (w * y - z * x), -1.0, 1.0)) * factor
    yaw = np.arctan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
    (cr, sr), (cp, sp), (cy, sy) = ((np.cos(0.5 * a), np.sin(0.5 * a)) for a in (roll, pitch, yaw))
    return np.column_stack([
        cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy,
    ])  # fmt: skip


def fly_online(session: Session, recording: Recording, start: float, stop: float) -> list[OnlineSet]:
    """Sets that a session puts on the parameter topic while it hears a stretch of a recording, every job done at once.

    Args:
        session: it hears, and is changed.
        recording: times in seconds.
        start: first time heard [s].
        stop: last one [s].
    """
    sets: list[OnlineSet] = []
    edges = np.arange(start, stop + 0.5 * STEP, STEP)
    places = {n: np.searchsorted(c.t, edges - 1e-6) for n, c in recording.channels.items()}
    for k in range(len(edges) - 1):
        for name, place in places.items():
            a, b = int(place[k]), int(place[k + 1])
            channel = recording.channels[name]
            if b > a:
                session.push(Block(channel.t[a:b], ((name, channel.values[a:b]),)))
        _answer(session, sets)
    return sets


def _answer(session: Session, sets: list[OnlineSet]) -> None:
    while True:
        for action in session.poll():
            if isinstance(action, Publish) and action.topic == "parameters":
                sets.append(action.item)
            elif isinstance(action, Job) and action.background:
                session.deliver(action.run())
        if session.running is None:
            return
        session.deliver(session.running.run())
