"""Resampler of a live stream: messages of different rates, in any order, become rows of one uniform grid.

The rules of resampling are those of logs (`quadid.resampling_plan`): no lag is invented, gaps are not bridged.  Rows
leave in blocks once the gyro, which leads the clock, is `SETTLE` seconds past them, so that every channel had that long
to arrive.  With each sample goes how far the stream had come before it; a block of rows is made of the samples that
came before the stream reached the block's end, whoever asks for rows and however late, and however the messages were
handed in.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Generator, Iterator, Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quadid.errors import LogError, QuadidError
from quadid.mounting import in_body_axes
from quadid.online.channel_buffer import ChannelBuffer
from quadid.online.clock import AHEAD, StreamClock
from quadid.online.command_reconstruction import CommandReconstruction
from quadid.online.rows import Rows, columns_on_grid
from quadid.resample import HALF_WIDTH, lowpass
from quadid.resampling_plan import make_plan
from quadid.rotor_signal import RotorSignal, rotor_channel, rotor_signal
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import Vehicle
from quadid.window import CHANNELS, Block, Recording

LEADER = "gyro"
SETTLE = 0.5
"""Rows leave this long [s] after their time, so that slower and delayed channels are there."""
BLOCK = 20
"""Rows that leave at once: many of them are read from the channels for little more than one."""
HISTORY = 2.0
"""Past samples kept [s]: rates and gaps are judged from them.  Over a longer pause of the gyro no rows are made: work
is in proportion to what came, not to the time that its stamps claim."""
MOST_SAMPLES = 400_000
"""A channel holds no more samples than this; a flood beyond is dropped and counted."""
MOST_EARLY = 1000
"""Messages kept until the first of the gyro."""
LARGEST_VALUE = 1e9
"""No sensor reads more, in any channel's unit; beyond, powers of it leave the range of numbers."""
APART = 20
"""So many samples in a row too far from the gyro's time are no accident: a clock is wrong, or the gyro is gone."""
_COUNT = " values instead of "


class _Stretch(NamedTuple):
    """A stretch of the stream on one grid.

    Attributes:
        first: first point of the grid [s], a gyro sample: a log that is on the grid passes bit for bit.
        end: how far the stream had come before it [s].
        new_clock: a new time base began with it.
    """

    first: float
    end: float
    new_clock: bool


class Column(NamedTuple):
    """Values of one channel, shape (n, columns), and which rows are measurements, shape (n,)."""

    values: FloatArray
    usable: BoolArray


class Resampler:
    """Messages in, rows out.

    Attributes:
        faults: dropped samples by ``channel: reason``.
        time: the time base.
        counts: accepted samples by channel.
        last: newest session time by channel [s].
        notices: channel and sentence: what is wrong with its clock; whoever tells people takes them out.
    """

    def __init__(self, vehicle: Vehicle, rate: float = 50.0) -> None:
        """Prepares for the channels of `vehicle` on a grid of `rate` [Hz]."""
        self.faults: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self.last: dict[str, float] = {}
        self.notices: list[tuple[str, str]] = []
        self.time = StreamClock()
        self._vehicle = vehicle
        self._step = 1.0 / rate
        rotors = len(vehicle.rotors)
        self._columns = {name: (count or rotors) for name, (count, _) in CHANNELS.items()}
        self._buffers = {name: ChannelBuffer(count) for name, count in self._columns.items()}
        self._reconstruction = CommandReconstruction(vehicle)
        self._early: deque[tuple[FloatArray, dict[str, Column]]] = deque(maxlen=MOST_EARLY)
        self._apart: dict[str, tuple[int, int]] = {}
        self._leads = 0
        self._told: set[str] = set()
        self._stretches: deque[_Stretch] = deque()
        self._stretch: _Stretch | None = None
        self._making: Iterator[Rows | None] | None = None
        self._row = 0
        # The low-pass makes its table when first used: now, not in flight.
        lowpass(np.arange(20.0), np.zeros((20, 1)), np.full(1, 10.0), 1.0, held=False)

    # --- messages in

    def push(self, block: Block) -> None:
        """Takes messages; what cannot be used is dropped and counted in `faults`.

        Handing them in one by one, or in other blocks, comes to the same.
        """
        columns = {name: found for name, values in block.columns if (found := self._measured(name, values)) is not None}
        lead = columns[LEADER].usable if LEADER in columns else np.zeros(len(block.t), dtype=bool)
        for a, b in pairwise([0, *(np.flatnonzero(np.diff(lead)) + 1).tolist(), len(lead)]):
            if a < b:  # messages whose gyro is of no use follow like all others
                (self._lead if lead[a] else self._follow)(block.t[a:b], _part(columns, slice(a, b)))

    def _measured(self, name: str, values: FloatArray) -> Column | None:
        """Values of a channel, and which rows are measurements; None for what is no such channel."""
        columns = self._columns.get(name)
        if columns is None:
            self.faults["unknown channel"] += len(values)
            return None
        if values.shape[1] != columns:
            self.faults[f"{name}: {values.shape[1]}{_COUNT}{columns}"] += len(values)
            return None
        usable: BoolArray = np.abs(values).max(axis=1, initial=0.0) <= LARGEST_VALUE
        if not usable.all():
            finite = np.isfinite(values).all(axis=1)
            self._fault(f"{name}: not finite", np.asarray(~finite))
            self._fault(f"{name}: beyond {LARGEST_VALUE:g}", finite & ~usable)
            values = np.where(usable[:, None], values, 0.0)
        if name == "attitude":
            w, x, y, z = values.T
            norm = np.sqrt(w * w + x * x + y * y + z * z)
            unit: BoolArray = np.asarray((norm > 0.5) & (norm < 2.0))
            self._fault("attitude: not a unit quaternion", np.asarray(usable & ~unit))
            usable = usable & unit
            odd = usable & (np.abs(norm - 1.0) > 1e-3)
            values = np.where(odd[:, None], values / np.where(odd, norm, 1.0)[:, None], values)
        return Column(values, usable)

    def _lead(self, stamps: FloatArray, columns: Mapping[str, Column]) -> None:
        """Takes messages with gyro, which move the clock one after the other."""
        room = MOST_SAMPLES - self._buffers[LEADER].waiting
        if len(stamps) > room:
            self.faults[f"{LEADER}: flood"] += len(stamps) - room
        elif self.time.newest == -math.inf and len(stamps) > 1:
            self._lead(stamps[:1], _part(columns, slice(1)))
            self._lead(stamps[1:], _part(columns, slice(1, None)))
            return
        stamps, columns = stamps[:room], _part(columns, slice(room))
        self._leads += len(stamps)
        before = self.time.newest
        t = self.time.lead(stamps)
        reached = np.fmax.accumulate(np.concatenate([[before], t]))[:-1]
        for k in np.flatnonzero(t > reached + HISTORY).tolist():
            new_clock = self.time.began_in(float(reached[k]), float(t[k]))
            self._stretches.append(_Stretch(float(t[k]), float(reached[k]), new_clock))
            self._told -= self._told if new_clock else {LEADER}
        if before == -math.inf < self.time.newest:
            early, self._early = self._early, deque(maxlen=MOST_EARLY)
            for followers in early:
                self._take(followers[1], self.time.follow(followers[0]), np.full(1, -math.inf))
                self.counts.subtract(list(followers[1]))
        self._take(columns, t, reached)

    def _follow(self, stamps: FloatArray, columns: Mapping[str, Column]) -> None:
        """Takes messages of other channels: none moves the clock."""
        if self.time.newest > -math.inf:
            t = self.time.follow(stamps)
            self._take(columns, t, np.full(len(t), self.time.newest))
            for name, column in columns.items():
                self._compare(name, (self.time.in_base(stamps) - self.time.newest)[column.usable])
            return
        for k in range(len(stamps)):
            self._early.append((stamps[k : k + 1], _part(columns, slice(k, k + 1))))
        self.counts.update({name: len(stamps) for name in columns})
        if len(self._early) == MOST_EARLY:
            self._notice(LEADER, f"no gyro yet, while {', '.join(sorted(columns))} arrive; fix: connect the IMU")

    def _take(self, columns: Mapping[str, Column], t: FloatArray, reached: FloatArray) -> None:
        """Keeps what is usable of messages at times `t` [s], NaN: refused, before which the stream had come so far."""
        for name, (values, usable) in columns.items():
            self._fault(f"{name}: unconfirmed time" if name == LEADER else f"{name}: ahead", usable & np.isnan(t))
            buffer, keep = self._buffers[name], np.flatnonzero(usable & ~np.isnan(t))
            room = MOST_SAMPLES - buffer.waiting
            if len(keep) > room:
                self.faults[f"{name}: flood"] += len(keep) - room
                keep = keep[:room]
            if len(keep):
                times = t[keep]
                buffer.add(reached[keep], times, values[keep])
                self.counts[name] += len(keep)
                self.last[name] = max(self.last.get(name, -math.inf), float(times.max()))

    def _compare(self, name: str, offsets: FloatArray) -> None:
        """Notes how far ahead of the gyro samples of another channel are [s]; tells what is no accident."""
        behind = SETTLE + BLOCK * self._step
        for offset in offsets.tolist() if name in self._apart or np.any(np.abs(offsets) > min(AHEAD, behind)) else ():
            if -behind <= offset <= AHEAD:
                self._apart.pop(name, None)
                continue
            count, since = self._apart.get(name, (0, self._leads))
            self._apart[name] = count + 1, since
            if count + 1 == APART and self._leads == since:
                self._notice(LEADER, f"no gyro for {offset:.1f} s while {name} goes on; fix: connect the IMU")
            elif count + 1 == APART:
                side = "ahead of" if offset > 0.0 else "behind"
                why = f"{name} is {abs(offset):.1f} s {side} the gyro: it is left out; fix: stamp both with one clock"
                self._notice(name, why)

    def _notice(self, channel: str, text: str) -> None:
        if channel not in self._told:
            self._told.add(channel)
            self.notices.append((channel, text))

    def _fault(self, reason: str, which: BoolArray) -> None:
        count = int(np.count_nonzero(which))
        if count:
            self.faults[reason] += count

    # --- rows out

    @property
    def busy(self) -> bool:
        """Whether there is a piece of `work`."""
        return self._making is not None or self._is_due()

    def work(self) -> Rows | None:
        """Does one piece of the work on the next block of rows, a millisecond or two; the last one gives the block.

        What arrives between two pieces changes nothing in the block.
        """
        making, self._making = self._making, None  # a block that cannot be made is left out
        if making is None:
            if not self._is_due():
                return None
            making = self._make()
        rows = next(making)
        if rows is None:
            self._making = making
        return rows

    def _is_due(self) -> bool:
        """Whether the stream has come past the next block of rows; goes on to the next stretch where one has ended."""
        while True:
            end = self._stretches[0].end if self._stretches else self.time.newest
            if self._stretch is not None and end >= self._times()[-1] + SETTLE:
                return True
            if not self._stretches:
                return False
            self._stretch, self._row = self._stretches.popleft(), 0
            self._reconstruction.restart()
            for buffer in self._buffers.values():
                buffer.forget(self._stretch.first - HISTORY)

    def _times(self) -> FloatArray:
        """Of the rows of the next block [s]."""
        assert self._stretch is not None
        rows = np.arange(self._row, self._row + BLOCK, dtype=np.float64)
        return np.asarray(self._stretch.first + self._step * rows)

    def _make(self) -> Iterator[Rows | None]:
        """Makes a block of rows piece by piece: None after each piece but the last."""
        assert self._stretch is not None
        at, stretch, fresh = self._times(), self._stretch, self._row == 0
        self._row += BLOCK
        for name, buffer in self._buffers.items():
            late, doubles = buffer.settle(
                float(at[0]) - (HISTORY if fresh else SETTLE), float(at[-1]) + SETTLE,
                stretch.end if fresh else -math.inf,
            )  # fmt: skip
            if late:
                self.faults[f"{name}: late"] += late
            if doubles:
                self.faults[f"{name}: duplicate"] += doubles
        yield None
        rows = yield from self._grid(at)
        for buffer in self._buffers.values():
            buffer.forget(float(at[0]) - HISTORY)
        yield replace(rows, fresh=fresh, new_clock=fresh and stretch.new_clock)

    def _grid(self, at: FloatArray) -> Generator[None, None, Rows]:
        channels = {}
        for name, buffer in self._buffers.items():
            channel = buffer.between(name, float(at[0]) - HISTORY, float(at[-1]) + SETTLE)
            if channel is not None:
                channels[name] = channel
        recording = in_body_axes(Recording("live", "stream", channels), self._vehicle)
        try:
            rotor = self._rotor_signal(recording, at)
        except QuadidError as error:
            empty = np.full((len(at), len(self._vehicle.rotors)), np.nan)
            return Rows(at, {"rotor_speed": empty}, "held", "", problem=str(error))
        plan = make_plan(recording, rotor.t, rotor.values, rotor.sampling, 1.0 / self._step)
        columns = yield from columns_on_grid(plan, at)
        spacing = plan.tracks["rotor_speed"].period / self._step
        return Rows(at, columns, plan.sampling, rotor.source, spacing=spacing)

    def _rotor_signal(self, recording: Recording, at: FloatArray) -> RotorSignal:
        """What the rotors were told: as published, else references through the stabiliser; raises QuadidError."""
        told, steered = (
            any(self._buffers[name].taken for name in names)
            for names in (("rotor_speed", "motor_command"), ("attitude_reference",))
        )
        if told or not self._reconstruction.known or not steered:
            misfits = [f for f in self.faults if f.startswith(("rotor_speed", "motor_command")) and _COUNT in f]
            if misfits and not told:
                wanted = f"{len(self._vehicle.rotors)}, the rotors of '{self._vehicle.name}'"
                raise LogError(f"live: {misfits[0]}", wanted, "choose the vehicle file that belongs to these data")
            if told and rotor_channel(recording, self._vehicle)[0] is None:
                raise LogError("live: rotor speeds or motor commands pause", fix="they are used once they come")
            return rotor_signal(recording, self._vehicle)
        until = float(at[-1]) + (HALF_WIDTH + 2.0) * self._step
        self._reconstruction.advance(self._buffers, until, float(at[0]) - HISTORY)
        return self._reconstruction.signal(until)


def _part(columns: Mapping[str, Column], which: slice) -> dict[str, Column]:
    """Some messages of columns."""
    return {name: Column(values[which], usable[which]) for name, (values, usable) in columns.items()}
