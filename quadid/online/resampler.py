"""Resampler of a live stream: samples of different rates, in any order, become rows of one uniform grid.

The rules of resampling are those of logs (`quadid.resampling_plan`): no lag is invented, gaps are not bridged.  Rows
leave in blocks once every channel had `SETTLE` seconds to arrive, so the order in which messages of different topics
come in changes nothing.  Which samples a block is made of is settled when samples arrive, not when somebody asks for
rows: a fit that keeps the reader busy changes nothing either, not even for samples that come later than that.
"""

from __future__ import annotations

import math
from collections import Counter, deque
from collections.abc import Generator, Iterator, Mapping
from dataclasses import dataclass

import numpy as np

from quadid.errors import LogError, QuadidError
from quadid.mounting import in_body_axes
from quadid.online.channel_buffer import ChannelBuffer
from quadid.online.clock import StreamClock
from quadid.online.command_reconstruction import CommandReconstruction
from quadid.online.rows import Rows, columns_on_grid
from quadid.resample import HALF_WIDTH, lowpass
from quadid.resampling_plan import make_plan
from quadid.rotor_signal import RotorSignal, rotor_channel, rotor_signal
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import Vehicle
from quadid.window import CHANNELS, Block, Recording, Sample

SETTLE = 0.5
"""Rows leave this long [s] after their time, so that slower and delayed channels are there."""
BLOCK = 20
"""Rows that leave at once: many of them are read from the channels for little more than one."""
HISTORY = 2.0
"""Past samples kept [s]: rates and gaps are judged from them."""
_LARGE = 1e150
_COUNT = " values instead of "
MOST_SAMPLES = 400_000
"""A channel holds no more samples than this; a flood beyond is dropped and counted."""


@dataclass(frozen=True)
class _Due:
    """What became possible at one moment: a block of rows, or a new beginning of the stream.

    Attributes:
        first: first point of the grid [s].
        row: number of the block's first row; -1: a new beginning.
        arrived: samples that had come by then, by buffer.
    """

    first: float
    row: int
    arrived: tuple[int, ...]


class Resampler:
    """Samples in, rows out.

    Attributes:
        faults: dropped samples by ``channel: reason``.
        time: the time base.
        counts: accepted samples by channel.
        last: newest session time by channel [s].
    """

    def __init__(self, vehicle: Vehicle, rate: float = 50.0) -> None:
        """Prepares for the channels of `vehicle` on a grid of `rate` [Hz]."""
        self.faults: Counter[str] = Counter()
        self.counts: Counter[str] = Counter()
        self.last: dict[str, float] = {}
        self.time = StreamClock()
        self._vehicle = vehicle
        self._step = 1.0 / rate
        rotors = len(vehicle.rotors)
        self._columns = {name: (count or rotors) for name, (count, _) in CHANNELS.items()}
        self._buffers = {name: ChannelBuffer(count) for name, count in self._columns.items()}
        self._reconstruction = CommandReconstruction(vehicle)
        self._due: deque[_Due] = deque()
        self._making: Iterator[Rows | None] | None = None
        self._first = math.inf
        self._next = math.nan
        self._row = 0
        self._steps_seen = 0
        self._fresh = True
        # The low-pass makes its table when first used: now, not in flight.
        lowpass(np.arange(20.0), np.zeros((20, 1)), np.full(1, 10.0), 1.0, held=False)

    def push(self, sample: Sample) -> None:
        """Takes one sample; what cannot be used is dropped and counted in `faults`."""
        name, values = sample.channel, sample.values
        columns = self._columns.get(name)
        if columns is None:
            self.faults["unknown channel"] += 1
            return
        if len(values) != columns:
            self.faults[f"{name}: {len(values)}{_COUNT}{columns}"] += 1
            return
        if not math.isfinite(sum(values)):
            self.faults[f"{name}: not finite"] += 1
            return
        if name == "attitude" and (values := _unit(values)) == ():
            self.faults["attitude: not a unit quaternion"] += 1
            return
        t = self.time.time(sample.t, name)
        if t is None:
            self.faults[f"{name}: unconfirmed time"] += 1
            return
        buffer = self._buffers[name]
        if buffer.waiting >= MOST_SAMPLES:
            self.faults[f"{name}: flood"] += 1
            return
        self._advance(name, t)
        buffer.add(t, values)
        self._note_due()
        self.counts[name] += 1
        if t > self.last.get(name, -math.inf):
            self.last[name] = t

    def push_block(self, block: Block) -> None:
        """Takes messages as if their samples were pushed one by one."""
        start, t = 0, self._plain(block)
        while start < len(block.t):
            # Up to the message with which a block of rows is settled, samples only add up.
            stop = start if t is None else start + _first(t[start:] >= self._next)
            if t is not None and stop > start:
                self._extend(block, t, start, stop)
            for sample in block.samples(stop, len(block.t) if t is None else stop + 1):
                self.push(sample)
            start = len(block.t) if t is None else stop + 1

    def _plain(self, block: Block) -> FloatArray | None:
        """Session times of messages with which nothing is wrong [s]; None where each must be looked at."""
        if math.isnan(self._next) or len(self.time.steps) > self._steps_seen:
            return None
        for name, values in block.columns:
            buffer = self._buffers.get(name)
            if buffer is None or values.shape[1] != self._columns[name]:
                return None
            if not np.abs(values).max(initial=0.0) < _LARGE or buffer.waiting + len(values) > MOST_SAMPLES:
                return None
            if name == "attitude" and not (np.abs(np.sqrt(np.sum(values * values, axis=1)) - 1.0) < 0.9e-3).all():
                return None
        return self.time.plain(block.t, [name for name, _ in block.columns])

    def _extend(self, block: Block, t: FloatArray, start: int, stop: int) -> None:
        """Takes messages that are plain and settle nothing."""
        times = t[start:stop]
        newest = float(times.max())
        self.time.note(newest, [name for name, _ in block.columns])
        for name, values in block.columns:
            self._buffers[name].extend(times, values[start:stop])
            self.counts[name] += len(times)
            self.last[name] = max(self.last.get(name, -math.inf), newest)

    @property
    def busy(self) -> bool:
        """Whether there is a piece of `work`."""
        return self._making is not None or bool(self._due)

    def work(self) -> Rows | None:
        """Does one piece of the work on the next block of rows, a millisecond or two; the last one gives the block.

        What arrives between two pieces changes nothing in the block.
        """
        if self._making is None:
            due = self._due.popleft()
            if due.row < 0:
                self._restart(due.arrived)
                return None
            self._making = self._make(due)
        making, self._making = self._making, None  # a block that cannot be made is left out
        rows = next(making)
        if rows is None:
            self._making = making
        return rows

    def _restart(self, arrived: tuple[int, ...]) -> None:
        self._fresh = True
        self._reconstruction.restart()
        for buffer, count in zip(self._buffers.values(), arrived, strict=True):
            buffer.restart(count)

    def _make(self, due: _Due) -> Iterator[Rows | None]:
        """Makes a block of rows piece by piece: None after each piece but the last."""
        at: FloatArray = due.first + self._step * np.arange(due.row, due.row + BLOCK, dtype=np.float64)
        self._settle(float(at[0]), due.arrived)
        yield None
        rows = yield from self._grid(at, dict(zip(self._buffers, due.arrived, strict=True)))
        self._fresh = False
        for buffer in self._buffers.values():
            buffer.forget(float(at[0]) - HISTORY)
        yield rows

    def _advance(self, name: str, t: float) -> None:
        """Begins anew after a step of the clock; finds the first gyro sample, on which the first grid point is put.

        A log that is on the grid then passes bit for bit.
        """
        if len(self.time.steps) > self._steps_seen:
            self._steps_seen = len(self.time.steps)
            self._first, self._next = math.inf, math.nan
            self._due.append(_Due(self.time.steps[-1], -1, self._arrived()))
        if math.isnan(self._next) and name == "gyro" and t < self._first:
            self._first = t

    def _note_due(self) -> None:
        """Notes the blocks of rows that can be made of what has arrived."""
        if math.isnan(self._next):
            if self.time.newest < self._first + SETTLE:
                return
            self._row = 0
            self._next = self._last_row_settled()
        while self.time.newest >= self._next:
            self._due.append(_Due(self._first, self._row, self._arrived()))
            self._row += BLOCK
            self._next = self._last_row_settled()

    def _last_row_settled(self) -> float:
        """When the next block may leave [s]."""
        return self._first + self._step * (self._row + BLOCK - 1) + SETTLE

    def _arrived(self) -> tuple[int, ...]:
        return tuple(buffer.arrived for buffer in self._buffers.values())

    def _settle(self, start: float, arrived: tuple[int, ...]) -> None:
        oldest = start - HISTORY if self._fresh else start - SETTLE
        for (name, buffer), count in zip(self._buffers.items(), arrived, strict=True):
            late, doubles = buffer.settle(oldest, count)
            if late:
                self.faults[f"{name}: late"] += late
            if doubles:
                self.faults[f"{name}: duplicate"] += doubles

    def _grid(self, at: FloatArray, arrived: Mapping[str, int]) -> Generator[None, None, Rows]:
        channels = {}
        for name, buffer in self._buffers.items():
            channel = buffer.between(name, float(at[0]) - HISTORY, float(at[-1]) + SETTLE)
            if channel is not None:
                channels[name] = channel
        recording = in_body_axes(Recording("live", "stream", channels), self._vehicle)
        try:
            rotor = self._rotor_signal(recording, at, arrived)
        except QuadidError as error:
            empty = np.full((len(at), len(self._vehicle.rotors)), np.nan)
            return Rows(at, {"rotor_speed": empty}, "held", "", self._fresh, str(error))
        plan = make_plan(recording, rotor.t, rotor.values, rotor.sampling, 1.0 / self._step)
        columns = yield from columns_on_grid(plan, at)
        spacing = plan.tracks["rotor_speed"].period / self._step
        return Rows(at, columns, plan.sampling, rotor.source, self._fresh, "", spacing)

    def _rotor_signal(self, recording: Recording, at: FloatArray, arrived: Mapping[str, int]) -> RotorSignal:
        """What the rotors were told: as published, else references through the stabiliser; raises QuadidError."""
        told = arrived["rotor_speed"] or arrived["motor_command"]
        if told or not self._reconstruction.known or not arrived["attitude_reference"]:
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


def _first(true: BoolArray) -> int:
    """Where the first True stands, shape (n,), n > 0; n for none."""
    at = int(true.argmax())
    return at if true[at] else len(true)


def _unit(q: tuple[float, ...]) -> tuple[float, ...]:
    """The quaternion at unit length; empty for what is no attitude."""
    norm = math.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if not 0.5 < norm < 2.0:
        return ()
    return q if abs(norm - 1.0) <= 1e-3 else tuple(c / norm for c in q)
