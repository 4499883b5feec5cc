"""Columns and clocks that a reader keeps of an untrusted log while it streams through it."""

from __future__ import annotations

import math
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import NamedTuple

import numpy as np

from quadid.data.window import Channel, Recording, sample_period
from quadid.errors import LogError
from quadid.rotation import continuous_sign
from quadid.types import BoolArray, FloatArray
from quadid_replay.frames import unit_quaternions

# --- Time from untrusted logs: reboots and clock steps found, wild stamps refused
#
# A log has one `LogClock`; stamps are fed in file order and come back as recording time [s], which never starts over.


STEP_BACK = 1.0
"""A stamp this far [s] before the newest one means a reboot or a clock step."""
STEP_AHEAD = 30.0
"""A stamp this far [s] after the newest one is suspect until others confirm it."""
CONFIRMATIONS = 3
"""Number of further stamps that must agree before a new time base is believed; a single wild stamp moves nothing."""
PAUSE = 1.0
"""Recording time [s] put between the last sample before a reboot and the first one after it."""


class LogClock:
    """Maps raw stamps [s] to recording time [s].

    Attributes:
        breaks: recording times across which nothing may be joined.
        reboots: number of time bases that ended by a step back.
        jumps: number of steps ahead.
        wild: number of stamps refused because nothing confirmed them.
    """

    def __init__(self) -> None:
        self.breaks: list[float] = []
        self.reboots = 0
        self.jumps = 0
        self.wild = 0
        self._offset = 0.0
        self._newest: float | None = None
        self._suspects: list[float] = []

    def times(self, raw: FloatArray) -> FloatArray:
        """Maps stamps [s] in file order, shape (n,); NaN for one that is refused or still waits for confirmation."""
        out = np.full(len(raw), np.nan)
        begin = 0
        if self._newest is None and len(raw) > 1 + CONFIRMATIONS:
            # The first stamp is far from the second, which others follow: it is wild, and no time base.
            steps = np.diff(raw[: 2 + CONFIRMATIONS])
            begin = int(not -STEP_BACK < steps[0] < STEP_AHEAD and bool(np.all(np.abs(steps[1:]) < STEP_BACK)))
            self.wild += begin
        if not self._suspects and begin < len(raw):
            # All stamps up to the first that does not follow the newest one before it.
            first = raw[begin] if self._newest is None else self._newest
            newest = np.maximum.accumulate(np.concatenate([[first], raw[begin:]]))
            follows = (newest[:-1] - STEP_BACK < raw[begin:]) & (raw[begin:] < newest[:-1] + STEP_AHEAD)
            plain = len(follows) if follows.all() else int(np.argmin(follows))
            if plain:
                out[begin : begin + plain] = raw[begin : begin + plain] + self._offset
                begin, self._newest = begin + plain, float(newest[plain])
        for k in range(begin, len(raw)):  # the others one by one: each may begin or confirm a new time base
            out[k] = self._time(float(raw[k]))
        return out

    def _time(self, raw: float) -> float:
        if not math.isfinite(raw):
            self.wild += 1
            return math.nan
        if self._newest is None:
            self._newest = raw
            return raw
        if self._newest - STEP_BACK < raw < self._newest + STEP_AHEAD:
            self.wild += len(self._suspects)
            self._suspects.clear()
            self._newest = max(self._newest, raw)
            return raw + self._offset
        return self._suspect(raw)

    def _suspect(self, raw: float) -> float:
        """Collects stamps of a possible new time base and moves to it when enough agree."""
        if self._suspects and abs(raw - self._suspects[-1]) > STEP_BACK:
            self.wild += len(self._suspects)
            self._suspects.clear()
        self._suspects.append(raw)
        if len(self._suspects) <= CONFIRMATIONS:
            return math.nan
        assert self._newest is not None
        base = min(self._suspects)
        if base < self._newest:
            self.reboots += 1
            end = self._newest + self._offset
            self._offset = end + PAUSE - base
            self.breaks.append(end + 0.5 * PAUSE)
        else:
            self.jumps += 1
            self.breaks.append(base + self._offset)
        self._newest = max(self._suspects)
        self._suspects.clear()
        return raw + self._offset

    def warnings(self) -> list[str]:
        """Says in sentences what was wrong with the log's time."""
        out = []
        if self.reboots:
            out.append(f"time starts over {self.reboots} times (reboot or clock step): nothing is joined across that")
        if self.jumps:
            out.append(f"time jumps ahead by over {STEP_AHEAD:g} s {self.jumps} times: nothing is joined across that")
        if self.wild:
            out.append(f"{self.wild} stamps that no neighbour confirms were dropped")
        return out


# --- Growing columns: what a reader keeps of a log while it streams through it; and the recording made of them


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
        name: key of `quadid.data.window.CHANNELS`.
        t: times [s] in file order, NaN where the clock refused the stamp, shape (n,).
        values: shape (n, columns).
        source: topic, message or column names, for people.
        spikes: readings that the reader dropped as such.
    """

    name: str
    t: FloatArray
    values: FloatArray
    source: str
    spikes: int = 0


class Source(NamedTuple):
    """One way to make a channel of a log.

    Attributes:
        channel: as of `RawChannel`.
        records: name of the records that tell it; empty where columns have names of their own.
        columns: of these, in order.
        convert: rows (n, columns) to core units and frames; not finite where they tell nothing.
        note: for people, behind the name of the records.
    """

    channel: str
    records: str
    columns: tuple[str, ...]
    convert: Callable[[FloatArray], FloatArray] = np.asarray
    note: str = ""


def channels_of(
    sources: Iterable[Source], rows: Callable[[Source], tuple[FloatArray, FloatArray] | None], advantage: float = 1.3
) -> list[RawChannel]:
    """Makes the channels of a log: of several sources of one the first, or another that is `advantage` times faster.

    Args:
        sources: in order of preference.
        rows: times (n,), NaN where refused, and columns (n, k) of a source; None where the log has no such.
        advantage: as of `fastest_first`.
    """
    found: dict[str, list[RawChannel]] = {}
    for source in sources:
        if (told := rows(source)) is not None:
            name = f"{source.records}{source.note and f' {source.note}'}" or " ".join(source.columns)
            with np.errstate(invalid="ignore"):  # what is no number is dropped further on
                entry = RawChannel(source.channel, told[0], source.convert(told[1]), name)
            found.setdefault(source.channel, []).append(entry)
    return [entry for entries in found.values() for entry in fastest_first(entries, advantage)]


class Columns:
    """Times and values of one signal, appended as packed doubles.

    Args:
        width: number of values a sample.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self._t = array("d")
        self._values = array("d")

    def add(self, t: FloatArray, values: FloatArray) -> None:
        """Appends samples: times (n,), NaN where refused, and values (n, width)."""
        if values.shape != (len(t), self.width):
            raise ValueError(f"values of shape {values.shape} for {len(t)} times and {self.width} columns")
        self._t.frombytes(t.tobytes())
        self._values.frombytes(values.tobytes())

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

    Dropped: refused stamps, values that are not finite or absurd, single impossible rotor speeds, repeated stamps,
    samples running backwards, quaternions that are none.
    Returns None when nothing remains.
    """
    stamped = np.isfinite(raw.t)
    t, values = (raw.t, raw.values) if stamped.all() else (raw.t[stamped], raw.values[stamped])
    faults = {"bad_stamp": len(stamped) - len(t)}
    finite = np.asarray(np.isfinite(values).all(axis=1))
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
        if np.count_nonzero(np.isfinite(entry.t)) < 2:
            continue  # a single sample is no channel
        if best and not _period(entry) * advantage < _period(best[0]):
            best.append(entry)
        else:
            best.insert(0, entry)
    return best


def _period(entry: RawChannel) -> float:
    return sample_period(np.sort(entry.t[np.isfinite(entry.t)]))


def fault_warnings(channels: Mapping[str, Channel]) -> list[str]:
    """Says in sentences which samples were dropped from which channel."""
    out = []
    for channel in channels.values():
        parts = [f"{count} {_REASONS[reason]}" for reason, count in channel.faults.items()]
        if parts:
            out.append(f"{channel.name}: dropped samples: {', '.join(parts)}")
    return out


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
