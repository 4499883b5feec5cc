"""Frames, clocks and channels of untrusted logs: what every reader does with the columns that it found."""

import math
from bisect import bisect_left
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from quadid.data.window import Channel, Recording, copied, sample_period, true_runs
from quadid.errors import LogError
from quadid.rotation import continuous_sign, euler
from quadid.types import BoolArray, FloatArray, IntArray

# --- Frames and units at the door of the core: ROS (ENU, FLU) and degrees become NED, FRD and SI
#
# All functions take arrays with one sample a row and return new arrays.  Rows that are not finite (damage) come out as
# not finite and are dropped further on.


GRAVITY = 9.80665
"""Standard gravity [m/s^2], the unit of accelerometers that count in g."""
_HALF = np.sqrt(0.5)
_BODY, _WORLD = np.array([1.0, -1.0, -1.0]), np.array([1.0, 1.0, -1.0])


def _columns(*columns: FloatArray) -> FloatArray:
    """As `np.column_stack`, which takes longer than the sums of a few rows."""
    out = np.empty((len(columns[0]), len(columns)))
    for k, column in enumerate(columns):
        out[:, k] = column
    return out


def cross(a: FloatArray, b: FloatArray) -> FloatArray:
    """Cross products of rows, shape (n, 3): `np.cross` to the bit, which takes ten times as long for a few rows."""
    (a1, a2, a3), (b1, b2, b3) = a.T, b.T
    return _columns(a2 * b3 - a3 * b2, a3 * b1 - a1 * b3, a1 * b2 - a2 * b1)


def flip_body(vectors: FloatArray) -> FloatArray:
    """Turns body vectors between FLU and FRD (its own inverse), shape (n, 3)."""
    return np.asarray(vectors * _BODY)


def flip_world(vectors: FloatArray) -> FloatArray:
    """Turns world vectors between ENU and NED (its own inverse), shape (n, 3)."""
    return np.asarray(vectors[:, [1, 0, 2]] * _WORLD)


def flip_attitude(q: FloatArray) -> FloatArray:
    """Turns attitudes between FLU->ENU and FRD->NED, quaternions wxyz, shape (n, 4).

    q' = -q_world q q_body with q_world = (0, 1, 1, 0)/sqrt(2) and q_body = (0, 1, 0, 0), in closed form; its own
    inverse, sign included.
    """
    w, x, y, z = q.T
    return np.asarray(_HALF * _columns(w + z, x + y, x - y, w - z))


def from_euler(angles: FloatArray) -> FloatArray:
    """Turns roll, pitch, yaw [rad] (z-y-x), shape (n, 3), into quaternions wxyz body to world, shape (n, 4)."""
    half = 0.5 * angles
    with np.errstate(invalid="ignore"):
        (cr, cp, cy), (sr, sp, sy) = np.cos(half).T, np.sin(half).T
    return _columns(
        cr * cp * cy + sr * sp * sy,
        sr * cp * cy - cr * sp * sy,
        cr * sp * cy + sr * cp * sy,
        cr * cp * sy - sr * sp * cy,
    )


def to_euler(q: FloatArray) -> FloatArray:
    """Turns quaternions wxyz, shape (n, 4), into roll, pitch, yaw [rad], shape (n, 3)."""
    with np.errstate(over="ignore", invalid="ignore"):
        return euler(q)


def unit_quaternions(q: FloatArray) -> tuple[FloatArray, BoolArray]:
    """Returns the quaternions with those off unit length by more than 1e-3 normalised, and which rows are attitudes.

    Rows of length below 0.5 or above 2 (zeros, garbage) are no attitudes.
    """
    with np.errstate(over="ignore"):
        norm = np.linalg.norm(q, axis=1)
    good = (norm > 0.5) & (norm < 2.0)
    off = good & (np.abs(norm - 1.0) > 1e-3)
    if off.any():
        q = q.copy()
        q[off] /= norm[off, None]
    return q, good


# --- Time from untrusted logs: reboots and clock steps found, wild stamps refused
#
# A log has one `LogClock`; stamps are fed in file order and come back as recording time [s], which never starts over.


EARLIEST_US, LATEST_US = 946_684_800_000_000, 4_102_444_800_000_000
"""Years 2000 to 2100 [us since 1970], between which a receive time can be true."""
STEP_BACK = 1.0
"""A stamp this far [s] before the newest one means a reboot or a clock step."""
SOON = 1.0
"""A stamp this far [s] after the newest one ends a gap once others confirm it; else nothing follows from it."""
STEP_AHEAD = 30.0
"""A stamp this far [s] after the newest one is refused until others confirm it."""
CONFIRMATIONS = 3
"""Number of further stamps that must agree before a new time is believed; a single wild stamp moves nothing."""
APART = 0.01
"""Messages closer than this [s] are of one instant, which may be wild as a whole, and confirm nothing of each other."""
_TOGETHER = 4096
"""Stamps that are looked at together."""
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

    def __init__(self, apart: float = APART) -> None:
        """Starts; stamps so close [s] may be those of one instant."""
        self._apart = apart
        self.breaks: list[float] = []
        self.reboots = 0
        self.jumps = 0
        self.wild = 0
        self._offset = 0.0
        self._newest: float | None = None
        self._suspects: list[float] = []
        self._waiting = 0
        self._ahead: list[float] = []

    def times(self, raw: FloatArray) -> FloatArray:
        """Maps stamps [s] in file order, shape (n,); NaN for one that is refused or still waits for confirmation."""
        out = np.full(len(raw), np.nan)
        begin = 0
        if self._newest is None and len(raw) > 1 + CONFIRMATIONS:
            # The first instant is far from the second, which others follow: it is wild, and no time base.
            second = int(np.argmax(np.abs(raw - raw[0]) > self._apart))
            ahead, *steps = np.diff(raw[max(second - 1, 0) : second + 1 + CONFIRMATIONS])
            if not -STEP_BACK < ahead < STEP_AHEAD and bool(np.all(np.abs(steps) < STEP_BACK)):
                begin = second
            self.wild += begin
        for k in range(begin, len(raw), _TOGETHER):
            out[k : k + _TOGETHER] = self._mapped(raw[k : k + _TOGETHER])
        return out

    def times_of(self, stamps: Mapping[str, FloatArray], places: Mapping[str, IntArray]) -> dict[str, FloatArray]:
        """Maps the stamps [s] of several kinds of records, in the order in which all of them stand in the file."""
        if not stamps:
            return {}
        order = np.argsort(np.concatenate([places[name] for name in stamps]), kind="stable")
        mapped = np.empty(len(order))
        mapped[order] = self.times(np.concatenate(list(stamps.values()))[order])
        ends = np.cumsum([len(each) for each in stamps.values()])
        return dict(zip(stamps, np.split(mapped, ends[:-1]), strict=True))

    def _mapped(self, raw: FloatArray) -> FloatArray:
        first = raw[0] if self._newest is None else self._newest
        newest = np.maximum.accumulate(np.concatenate([[first], raw]))
        follows = (newest[:-1] - STEP_BACK < raw) & (raw < newest[:-1] + SOON)
        if follows.all() and not self._suspects and not self._ahead:
            self._newest = float(newest[-1])
            return np.asarray(raw + self._offset)
        # One by one: each may begin or confirm a new time.
        return np.array([self._time(stamp) for stamp in raw.tolist()])

    def _time(self, raw: float) -> float:
        if not math.isfinite(raw):
            self.wild += 1
            return math.nan
        if self._newest is None:
            self._newest = raw
            return raw
        reached = self._ahead[-1] if self._ahead else self._newest
        if not self._newest - STEP_BACK < raw < reached + STEP_AHEAD:
            return self._suspect(raw)
        self._refuse()
        if raw < max(self._newest + SOON, reached - STEP_BACK):  # what was ahead is not confirmed
            self._ahead.clear()
        if raw < self._newest + SOON:
            self._newest = max(self._newest, raw)
            return raw + self._offset
        if not self._ahead or raw > self._ahead[-1] + self._apart:
            self._ahead.append(raw)
        if len(self._ahead) > CONFIRMATIONS:
            self._newest = self._ahead[-1]
            self._ahead.clear()
        return raw + self._offset

    def _suspect(self, raw: float) -> float:
        """Collects stamps of a possible new time base and moves to it when enough agree."""
        if self._suspects and abs(raw - self._suspects[-1]) > STEP_BACK:
            self._refuse()
        if not self._suspects or raw > self._suspects[-1] + self._apart:
            self._suspects.append(raw)
        if len(self._suspects) <= CONFIRMATIONS:
            self._waiting += 1
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
        self._waiting = 0
        self._suspects.clear()
        self._ahead.clear()
        return raw + self._offset

    def _refuse(self) -> None:
        """The stamps that waited were wild."""
        self.wild += self._waiting
        self._waiting = 0
        self._suspects.clear()

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


# --- The recording made of what a reader found


_AROUND = 5
"""A rotor speed is compared with so many, itself among them."""
_ABSURD = 1e9
"""No channel holds a number of this size in SI units; damage does."""
_MEASURED = ("gyro", "accel", "rotor_speed", "velocity", "position", "battery")
"""Channels of bodies that move steadily; a command may be anything."""
_STATES = ("attitude", "velocity", "position")
_HELD, _TURNS = 5.0, 0.05
"""A state that stays the same for longer than this [s] while rates vary by this [rad/s, standard deviation] is none."""
_SLOW = 0.05
"""Between rows so far apart [s] a body turns and stops again."""
_REASONS = {
    "duplicate": "with a repeated stamp",
    "backwards": "out of order in time",
    "not_finite": "not finite",
    "absurd": "beyond any physical value",
    "bad_stamp": "with a wild stamp",
    "impossible": "far from those before and after",
    "not_attitude": "that are no attitude (quaternion far from unit length)",
    "held": "that stay the same for seconds while the gyro turns: they are not measurements",
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


def spikes(values: FloatArray, rotor: bool = False, command: bool = False) -> BoolArray:
    """Finds readings, shape (n,), that cannot be true between those before and after: a real jump has more than two.

    Off the median of five neighbours by twenty times all that these medians span.  A rotor does not read 65535 or
    nothing either: more than half off neighbours that agree, and far beyond what the signal does elsewhere; nor for a
    while, for none stops or leaps within one reading.  Of one that often reads nothing the checks say so.  Of a command
    only what leaps to several times all others is none.
    """
    if len(values) < _AROUND:
        return np.zeros(len(values), dtype=np.bool_)
    usual = _running_median(values)
    off = np.abs(values - usual)
    spread = _running_median(off)
    far = (np.ptp(usual) > 0.0) & (off > 20.0 * np.ptp(usual)) & (spread < 0.1 * off) & (not command)
    half = 0.5 * float(np.median(values[values > 0.0])) if (values > 0.0).any() else np.inf
    wild: tuple[tuple[BoolArray, float], ...] = ((values > 20.0 * np.quantile(values, 0.95), 0.05),) * command
    if rotor:
        size = np.maximum(usual, np.median(values))
        far |= (usual > 0.0) & (off > 0.5 * size) & (spread < 0.1 * size) & (off > 20.0 * np.mean(off))
        wild = ((values == 0.0, 0.05), (values > 8.0 * half, 0.3))
    for wrong, most in wild:
        for a, b in zip(*true_runs(wrong), strict=True) if np.mean(wrong) < most else ():
            beside = values[[a - 1, b]] if a > 0 and b < len(values) else np.zeros(2)
            least = min(values[a], values[b - 1])
            far[a:b] |= beside.min() > half and (least == 0.0 or least > 2.0 * beside.max())
    return np.asarray(far)


def _running_median(values: FloatArray) -> FloatArray:
    """Medians of `_AROUND` values around each; in NumPy, for SciPy takes a reading process as long to import again."""
    around = np.lib.stride_tricks.sliding_window_view(np.pad(values, _AROUND // 2, mode="edge"), _AROUND)
    return np.asarray(np.median(around, axis=1))


def rising(t: FloatArray) -> BoolArray:
    """The most samples whose times (n,) rise; of equal times the first."""
    if np.all(np.diff(t) > 0.0):
        return np.ones(len(t), dtype=np.bool_)
    # The longest rising series of times, from its end: of each length the one that begins latest, and what follows it.
    begins: list[float] = []
    places: list[int] = []
    after = [-1] * len(t)
    for k in reversed(range(len(t))):
        length = bisect_left(begins, -t[k])
        begins[length : length + 1], places[length : length + 1] = [-float(t[k])], [k]
        after[k] = places[length - 1] if length else -1
    kept, k = np.zeros(len(t), dtype=np.bool_), places[-1]
    while k >= 0:
        kept[k], k = True, after[k]
    return kept


def _confirmed(t: FloatArray) -> tuple[int, int]:
    """Begin and end of rising times (n,) without few that stand alone before and after: no neighbour confirms them."""
    steps = np.diff(t)
    far = max(STEP_BACK, 50.0 * float(np.median(steps))) if len(steps) else math.inf
    edges = [0, *(np.flatnonzero(steps > far) + 1).tolist(), len(t)]
    while len(edges) > 2 and edges[1] - edges[0] <= CONFIRMATIONS:
        edges.pop(0)
    while len(edges) > 2 and edges[-1] - edges[-2] <= CONFIRMATIONS:
        edges.pop()
    return edges[0], edges[-1]


def clean_channel(raw: RawChannel) -> Channel:
    """Makes a channel of raw samples: drops and counts what cannot be used.

    Dropped: refused stamps, values that are not finite or absurd, single impossible readings, repeated stamps, samples
    out of order, quaternions that are none.
    """
    t, values = raw.t, raw.values
    faults: dict[str, int] = {}

    def keep(good: BoolArray, reason: str) -> None:
        nonlocal t, values
        faults[reason] = faults.get(reason, 0) + int(np.count_nonzero(~good))
        t, values = (t, values) if good.all() else (t[good], values[good])

    keep(np.isfinite(t), "bad_stamp")
    keep(np.asarray(np.isfinite(values).all(axis=1)), "not_finite")
    keep(np.asarray((np.abs(values) <= _ABSURD).all(axis=1)), "absurd")
    slow = len(t) > 1 and raw.name in ("gyro", "accel") and float(np.median(np.diff(t))) > _SLOW
    if raw.name in (*_MEASURED, "motor_command") and not slow:
        kind = raw.name == "rotor_speed", raw.name == "motor_command"
        faults["impossible"] = raw.spikes
        far = np.array([spikes(column, *kind) for column in values.T])
        keep(np.asarray(~far.any(axis=0)), "impossible")
    if raw.name == "attitude":
        values, good = unit_quaternions(values)
        keep(good, "not_attitude")
    if len(t):
        kept = rising(t)
        before = np.maximum.accumulate(np.where(kept, np.arange(len(t)), 0))
        faults["duplicate"] = int(np.count_nonzero(t[~kept] == t[before[~kept]]))
        keep(kept, "backwards")
        faults["backwards"] -= faults["duplicate"]
        begin, end = _confirmed(t)
        faults["bad_stamp"] += len(t) - (end - begin)
        t, values = t[begin:end], values[begin:end]
        values = continuous_sign(values) if raw.name == "attitude" else values
    return Channel(raw.name, t, values, raw.source, {reason: n for reason, n in faults.items() if n})


def assemble(
    name: str,
    kind: str,
    raw: Sequence[RawChannel],
    clock: LogClock,
    notes: Sequence[str],
    autopilot: Mapping[str, float] | None = None,
    other: str = "",
) -> Recording:
    """Cleans the channels and makes the recording; of several sources of one channel the first usable one is kept.

    Of what is no multirotor, as `other` says (of `motors.no_multirotor`), no output is.

    Raises:
        LogError: no channel holds a usable sample.
    """
    channels: dict[str, Channel] = {}
    for entry in raw:
        found = entry.name in channels and len(channels[entry.name].t) > 0
        if not (found or len(entry.t) == 0 or (other and entry.name in ("rotor_speed", "motor_command"))):
            channels[entry.name] = clean_channel(entry)
    if not any(len(channel.t) for channel in channels.values()):
        why = f" ({notes[0]})" if notes else ""
        raise LogError(
            f"{name}: no usable flight data in it{why}",
            "gyro, attitude, accelerometer or rotor signals",
            "see docs/logs.md for the messages that are read",
        )
    channels = {n: _without_held(c, channels.get("gyro")) for n, c in channels.items()}
    warnings = [*notes, *filter(None, [other]), *clock.warnings()]
    for channel in channels.values():
        if parts := [f"{count} {_REASONS[reason]}" for reason, count in channel.faults.items()]:
            parts += ["none is left"] * (not len(channel.t))
            warnings.append(f"{channel.name}: dropped samples: {', '.join(parts)}")
    channels = {n: c for n, c in channels.items() if len(c.t)}
    return Recording(
        name, kind, channels, tuple(clock.breaks), tuple(warnings), autopilot=dict(autopilot or {}), other=other
    )


def damage(size: int, skipped: int, cut: bool, *others: str, unit: str = "record") -> list[str]:
    """Sentences about what of a file of `size` bytes could not be read; `others`, where there are any, among them."""
    notes = [f"{skipped} of {size} bytes are damaged and were skipped"] if skipped else []
    notes += filter(None, others)
    return notes + [f"the file ends inside a {unit}: it was cut; everything before is used"] * cut


def _without_held(channel: Channel, gyro: Channel | None) -> Channel:
    """A state without rows of stretches in which it stays the same although the gyro turns: a logger filled them.

    Nor is a velocity measured one axis of which never changes.
    """
    if channel.name not in _STATES or gyro is None:
        return channel
    first, end = true_runs(copied(channel.values))
    long = [(a, b) for a, b in zip(first, end, strict=True) if channel.t[b] - channel.t[a] > _HELD]
    if channel.name == "velocity" and len(channel.t) > 1 and np.min(np.ptp(channel.values, axis=0)) == 0.0:
        long = [(0, len(channel.t) - 1)]
    kept = np.ones(len(channel.t), dtype=np.bool_)
    for a, b in long:
        turns = gyro.values[(gyro.t >= channel.t[a]) & (gyro.t <= channel.t[b])]
        kept[a : b + 1] = not len(turns) or bool(np.max(np.std(turns, axis=0)) < _TURNS)
    held = {"held": int(np.count_nonzero(~kept))} if not kept.all() else {}
    return replace(channel, t=channel.t[kept], values=channel.values[kept], faults={**channel.faults, **held})


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
