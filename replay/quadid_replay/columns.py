"""Growing columns: what a reader keeps of a log while it streams through it; and the recording made of them."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from quadid.errors import LogError
from quadid.resample import sample_period
from quadid.rotation import continuous_sign
from quadid.types import BoolArray, FloatArray
from quadid.window import Channel, Recording
from quadid_replay.clocks import LogClock
from quadid_replay.frames import unit_quaternions

_AROUND = 5
"""A rotor speed is compared with so many, itself among them."""
_ABSURD = 1e9
"""No channel holds a number of this size in SI units; damage does."""
_REASONS = {
    "duplicate": "with a repeated stamp",
    "backwards": "running backwards in time",
    "not_finite": "not finite",
    "absurd": "beyond any physical value",
    "bad_stamp": "with a wild stamp",
    "impossible_rotor_speed": "with a rotor speed far from those before and after it",
    "not_attitude": "that are no attitude (quaternion far from unit length)",
}


class RawChannel(NamedTuple):
    """A channel as a reader found it: core units and frames, recording time, nothing dropped yet.

    Attributes:
        name: key of `quadid.window.CHANNELS`.
        t: times [s] in file order, shape (n,).
        values: shape (n, columns).
        source: topic, message or column names, for people.
        refused: samples whose stamp the clock refused.
        spikes: readings that the reader dropped as such.
    """

    name: str
    t: FloatArray
    values: FloatArray
    source: str
    refused: int = 0
    spikes: int = 0


class Columns:
    """Times and values of one signal, appended sample by sample as packed doubles.

    Args:
        width: number of values a sample.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self.refused = 0
        self._t = array("d")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._t)

    def add(self, t: float | None, values: Sequence[float]) -> None:
        """Appends one sample; a time of None (refused by the clock) is counted and dropped."""
        if t is None:
            self.refused += 1
            return
        if len(values) != self.width:
            raise ValueError(f"{len(values)} values for {self.width} columns")
        self._t.append(t)
        self._values.extend(values)

    def add_many(self, t: FloatArray, values: FloatArray) -> None:
        """Appends samples: times (n,), NaN where refused, and values (n, width)."""
        if values.shape != (len(t), self.width):
            raise ValueError(f"values of shape {values.shape} for {len(t)} times and {self.width} columns")
        known = ~np.isnan(t)
        self.refused += len(t) - int(np.count_nonzero(known))
        self._t.frombytes(t[known].tobytes())
        self._values.frombytes(values[known].tobytes())

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Returns times (n,) and values (n, width), as added."""
        t = np.frombuffer(self._t, dtype=np.float64) if self._t else np.empty(0)
        values = np.frombuffer(self._values, dtype=np.float64) if self._values else np.empty(0)
        return t, values.reshape(-1, self.width)


def spikes(speeds: FloatArray) -> BoolArray:
    """Tells readings, shape (n,), that no rotor turns at between those before and after: counts of 65535, zeros.

    More than half off the median of five neighbours, which agree with each other, and far beyond what the signal does
    elsewhere: a real jump has more than two rows.
    """
    if len(speeds) < _AROUND:
        return np.zeros(len(speeds), dtype=np.bool_)
    usual = _running_median(speeds)
    spread = _running_median(np.abs(speeds - usual))
    size = np.maximum(usual, np.median(speeds))
    off = np.abs(speeds - usual)
    return np.asarray((usual > 0.0) & (off > 0.5 * size) & (spread < 0.1 * size) & (off > 20.0 * np.mean(off)))


def _running_median(values: FloatArray) -> FloatArray:
    """Medians of `_AROUND` values around each; in NumPy, for SciPy takes a reading process as long to import again."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, _AROUND // 2, mode="edge"), _AROUND)
    return np.asarray(np.median(around, axis=1))


def clean_channel(raw: RawChannel) -> Channel | None:
    """Makes a channel of raw samples: drops and counts what cannot be used.

    Dropped: values or times that are not finite or absurd, single impossible rotor speeds, repeated stamps, samples
    running backwards, quaternions that are none.
    Returns None when nothing remains.
    """
    t, values = raw.t, raw.values
    faults = {"bad_stamp": raw.refused}
    finite = np.isfinite(t) & np.isfinite(values).all(axis=1)
    faults["not_finite"] = int(np.count_nonzero(~finite))
    absurd = finite & (np.abs(values) > _ABSURD).any(axis=1)
    faults["absurd"] = int(np.count_nonzero(absurd))
    finite &= ~absurd
    if raw.name == "rotor_speed":
        known = np.flatnonzero(finite)
        far = np.array([spikes(column) for column in values[known].T]).any(axis=0)
        faults["impossible_rotor_speed"] = raw.spikes + int(np.count_nonzero(far))
        finite[known[far]] = False
    if raw.name == "attitude":
        values, good = unit_quaternions(values)
        faults["not_attitude"] = int(np.count_nonzero(finite & ~good))
        finite &= good
    t, values = t[finite], values[finite]
    if len(t) == 0:
        return None
    newest = np.maximum.accumulate(t)
    forward = np.concatenate([[True], t[1:] > newest[:-1]])
    faults["duplicate"] = int(np.count_nonzero(t[1:] == newest[:-1]))
    faults["backwards"] = int(np.count_nonzero(~forward)) - faults["duplicate"]
    t, values = t[forward], values[forward]
    if raw.name == "attitude":
        values = continuous_sign(values)
    return Channel(raw.name, t, values, raw.source, {k: n for k, n in faults.items() if n})


def assemble(
    name: str,
    kind: str,
    raw: Sequence[RawChannel],
    clock: LogClock,
    notes: Sequence[str],
    autopilot: Mapping[str, float] | None = None,
) -> Recording:
    """Cleans the channels and makes the recording; of several sources of one channel the first usable one is kept.

    Raises:
        LogError: no channel holds a usable sample.
    """
    channels: dict[str, Channel] = {}
    for entry in raw:
        if entry.name in channels or len(entry.t) == 0:
            continue
        channel = clean_channel(entry)
        if channel is not None:
            channels[entry.name] = channel
    if not channels:
        why = f" ({notes[0]})" if notes else ""
        raise LogError(
            f"{name}: no usable flight data in it{why}", "gyro, attitude, accelerometer or rotor signals",
            "see docs/logs.md for the messages that are read",
        )  # fmt: skip
    warnings = (*notes, *clock.warnings(), *fault_warnings(channels))
    return Recording(name, kind, channels, tuple(clock.breaks), warnings, autopilot=dict(autopilot or {}))


def fastest_first(raw: Sequence[RawChannel], advantage: float = 1.3) -> list[RawChannel]:
    """Orders sources of one channel: as given, but one that is `advantage` times faster than the best goes first."""
    best: list[RawChannel] = []
    for entry in raw:
        if len(entry.t) < 2:
            continue
        period = sample_period(np.sort(entry.t))
        if best and not period * advantage < sample_period(np.sort(best[0].t)):
            best.append(entry)
        else:
            best.insert(0, entry)
    return best


def fault_warnings(channels: Mapping[str, Channel]) -> list[str]:
    """Says in sentences which samples were dropped from which channel."""
    out = []
    for channel in channels.values():
        parts = [f"{count} {_REASONS[reason]}" for reason, count in channel.faults.items()]
        if parts:
            out.append(f"{channel.name}: dropped samples: {', '.join(parts)}")
    return out
