"""Live streams: samples in any order and rate become rows of one uniform grid, and windows are cut from them."""

import math
from collections import Counter, deque
from collections.abc import Mapping
from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quadid.attitude_controller import pack_gains, stabilise_rows
from quadid.data.grid import GAP, HALF_WIDTH, linear, lowpass, make_plan
from quadid.data.rotor_signal import RotorSignal, rotor_channel, rotor_signal
from quadid.data.window import CHANNELS, Block, Channel, Recording, Sampling, in_body_axes
from quadid.errors import LogError, QuadidError
from quadid.online.grid_buffer import Rows, columns_on_grid
from quadid.rotation import continuous_sign
from quadid.types import BoolArray, FloatArray
from quadid.vehicle import GRAVITY, Vehicle, mixer_matrix

# --- Time of a live stream: one rising session time, led by the stamps of the gyro, which every row of the grid needs
#
# Other channels follow: their stamps are read in the gyro's time base and moved by nothing but the gyro.  One that is
# further ahead of the gyro than any delay explains is refused; one that is late is left out when its rows are settled.
# So no channel but the gyro decides what becomes of another's samples, and the gyro only with several stamps that
# agree.


STEP_BACK = 1.0
"""A gyro stamp this far [s] before the newest one means a reboot or a clock step; less is late."""
STEP_AHEAD = 0.5
"""One this far [s] after the newest one is suspect: rows wait as long, so that a smaller step takes no sample away."""
AHEAD = 1.0
"""Other channels may be this far [s] ahead of the gyro: it comes later over a slower way, or some of it is lost."""
PAUSE_AHEAD = 30.0
"""A confirmed step ahead by no more than this [s] is a pause of the stream; any other begins a new time base."""
CONFIRMATIONS = 3
"""Further stamps that must agree before a step is believed: a single wild stamp moves nothing."""
PAUSE = 4.0
"""Session time [s] between the newest sample of one time base and the first of the next: more than rows look back on
(`HISTORY`) and followers run ahead."""
DAY = 86400.0
LARGEST = 1e11
"""Stamps beyond this [s] are no times."""


class StreamClock:
    """Maps stamps [s] to session time [s], which counts from midnight of the gyro's first stamp and never runs back.

    Attributes:
        newest: newest session time of the gyro; minus infinity before its first sample.
        steps: number of time bases that began after the first (reboot, clock step).
        wild: gyro stamps refused because nothing confirmed them.
    """

    def __init__(self) -> None:
        self.newest = -math.inf
        self.steps = self.wild = 0
        # The newest time bases, of which session times can be turned back into stamps.
        self._bases: deque[tuple[float, float]] = deque([(-math.inf, 0.0)], maxlen=64)
        self._suspects: list[float] = []

    def stamp(self, t: float) -> float:
        """The stamp that belongs to session time `t`, in the time base that held then."""
        shift = next((shift for start, shift in reversed(self._bases) if t >= start), self._bases[0][1])
        return t - shift

    def in_base(self, stamps: FloatArray) -> FloatArray:
        """Session times that stamps stand for in the present time base, shape (n,)."""
        return stamps + self._bases[-1][1]

    def began_in(self, after: float, until: float) -> bool:
        """True if a time base began after one session time [s] and until another; the first one after all times."""
        return after == -math.inf or any(after < start <= until for start, _ in self._bases)

    def follow(self, stamps: FloatArray) -> FloatArray:
        """Session times of stamps of other channels, shape (n,); NaN for those too far ahead of the gyro."""
        t = self.in_base(stamps)
        return np.where(t <= self.newest + AHEAD, t, np.nan)

    def lead(self, stamps: FloatArray) -> FloatArray:
        """Session times of stamps of the gyro, shape (n,), in the order of arrival; NaN for those that are refused."""
        out = np.full(len(stamps), np.nan)
        at = 0
        while at < len(stamps):
            # Stamps that go on from those before are taken together; the first that does not is looked at by itself.
            t = stamps[at : at + 256] + self._bases[-1][1]
            reached = np.maximum.accumulate(np.concatenate([[self.newest], t]))[:-1]
            strange = ~((t > reached - STEP_BACK) & (t < reached + STEP_AHEAD))
            count = int(strange.argmax()) if strange.any() else len(t)
            if count:
                out[at : at + count] = t[:count]
                self.newest = max(self.newest, float(t[:count].max()))
                self.wild += len(self._suspects)
                self._suspects.clear()
            at += count
            if count < len(t):
                out[at] = self._suspect(float(stamps[at]))
                at += 1
        return out

    def _suspect(self, stamp: float) -> float:
        """Session time of a stamp that does not follow the one before: of the first ever, or once enough agree."""
        if not abs(stamp) <= LARGEST:
            self.wild += 1
            return math.nan
        if self.newest == -math.inf:
            self._bases[0] = (-math.inf, -math.floor(stamp / DAY) * DAY)
            self.newest = stamp + self._bases[0][1]
            return self.newest
        if self._suspects and abs(stamp - self._suspects[-1]) > STEP_AHEAD:
            self.wild += len(self._suspects)
            self._suspects.clear()
        self._suspects.append(stamp)
        if len(self._suspects) <= CONFIRMATIONS:
            return math.nan
        # Enough agree: a pause of this time base, or a new one, which begins after a pause of session time.
        first, shift = min(self._suspects), self._bases[-1][1]
        self._suspects.clear()
        if not self.newest < first + shift <= self.newest + PAUSE_AHEAD:
            start = self.newest + PAUSE
            shift = start - first
            self._bases.append((start, shift))
            self.steps += 1
        self.newest = max(stamp + shift, self.newest)
        return stamp + shift


# --- Samples of one channel of a live stream: those that wait in the order of arrival, and those sorted by time


class ChannelBuffer:
    """Samples of one channel.

    Attributes:
        t, values: those sorted in, shapes (n,) and (n, columns).
        waiting: how many are not sorted in yet.
        taken: how many ever were, late ones and doubles included.
    """

    def __init__(self, columns: int) -> None:
        self.t = np.empty(0)
        self.values = np.empty((0, columns))
        self.waiting = self.taken = 0
        self._chunks: deque[tuple[FloatArray, FloatArray, FloatArray]] = deque()

    def add(self, reached: FloatArray, t: FloatArray, values: FloatArray) -> None:
        """Takes samples in the order of arrival.

        Args:
            reached: time that the stream had reached before each [s], never falling, shape (n,).
            t: times of the samples [s], shape (n,).
            values: shape (n, columns).
        """
        if len(t):
            self._chunks.append((reached, t, values))
            self.waiting += len(t)

    def settle(self, oldest: float, before: float, since: float = -np.inf) -> tuple[int, int]:
        """Sorts in what came before the stream reached `before` [s]; returns how many were too late, and doubles.

        Args:
            oldest: earlier samples [s] are too late.
            since: what came before the stream had passed this [s] belongs to an earlier stretch, and is not late.
        """
        chunks = self._take(before)
        if not chunks:
            return 0, 0
        reached, t, values = (np.concatenate(parts) for parts in zip(*chunks, strict=True))
        # What came too late is left out; of equal times the sample that came first stays.
        in_time = t >= oldest
        late = int(np.count_nonzero(~in_time & (reached > since)))
        t, values = np.concatenate([self.t, t[in_time]]), np.concatenate([self.values, values[in_time]])
        doubles = 0
        if np.any(t[1:] <= t[:-1]):
            order = np.argsort(t, kind="stable")
            t, values = t[order], values[order]
            keep = np.concatenate([[True], np.diff(t) > 0.0])
            doubles = len(t) - int(np.count_nonzero(keep))
            t, values = t[keep], values[keep]
        self.t, self.values = t, values
        return late, doubles

    def _take(self, before: float) -> list[tuple[FloatArray, FloatArray, FloatArray]]:
        out = []
        while self._chunks and self._chunks[0][0][0] < before:
            reached, t, values = self._chunks.popleft()
            count = int(np.searchsorted(reached, before))
            if count < len(t):
                self._chunks.appendleft((reached[count:], t[count:], values[count:]))
            out.append((reached[:count], t[:count], values[:count]))
            self.waiting -= count
            self.taken += count
        return out

    def forget(self, before: float) -> None:
        """Drops sorted samples before a time [s]."""
        first = int(np.searchsorted(self.t, before))
        if first:
            self.t, self.values = self.t[first:], self.values[first:]

    def between(self, name: str, a: float, b: float) -> Channel | None:
        """The samples in [a, b) as a channel; None when there are fewer than two."""
        low, high = int(np.searchsorted(self.t, a)), int(np.searchsorted(self.t, b))
        if high - low < 2:
            return None
        values = self.values[low:high]
        return Channel(name, self.t[low:high], continuous_sign(values) if name == "attitude" else values, name)


# --- Rotor commands reconstructed from references through the stabiliser, as the vehicle computes them on board
#
# A vehicle that publishes its references, its attitude and its rates, and whose stabiliser is known (`stabiliser:` in
# the vehicle file), needs to publish no rotor commands: the control law of `quadid.attitude_controller` computes them
# from the others. Commands are computed at the gyro's samples, and act from each until the next; a stabiliser that runs
# faster than the gyro comes is run in between on interpolated measurements, and its mean is taken.
#
# The integrals at the start of the stream are not published, and a constant torque that is not there spoils inertias.
# But a vehicle that flies on does not spin up: over some seconds the torques of its rotors amount to the change of its
# angular momentum.  What they exceed it by in the first `CALM` seconds of flight is taken off the integrals; only then
# are commands given out.  A lasting torque, as of a CG off centre, cannot be told from the integrals that hold it.


NEEDED = ("attitude_reference", "attitude", "gyro")
SOURCE = "references through the stabiliser"
OLDEST = 1.0
"""References and attitude older than this [s] are not steered by, nor those that miss so many of their periods that it
is a gap: the integrals after it are unknown."""
CALM = 10.0
"""Flight from which the integrals are found [s]."""


class CommandReconstruction:
    """The stabiliser of one vehicle, run beside the stream."""

    def __init__(self, vehicle: Vehicle) -> None:
        """Prepares for `vehicle`; without a known stabiliser it steers nothing."""
        known = vehicle.stabiliser
        self._gains = pack_gains(known.gains) if known is not None else None
        self._mixer = mixer_matrix(vehicle, known.gains) if known is not None else np.empty((0, 4))
        b, d = (known.gains[n] for n in ("thrust_coefficient", "drag_coefficient")) if known is not None else (0.0, 0.0)
        self._arms = vehicle.torque_arms * [b, b, d]
        self._hover = vehicle.mass * GRAVITY / b if known is not None else math.inf
        self._inertia = np.array([vehicle.parameters[n].initial for n in ("J_xx", "J_yy", "J_zz")])
        self._rate = (known.rate if known is not None else None) or 0.0
        self.restart()
        if self._gains is not None:  # compiled before the first flight, not in it
            still, level = np.zeros((1, 4)), np.array([[1.0, 0.0, 0.0, 0.0]])
            stabilise_rows(
                self._gains,
                self._mixer,
                still,
                level,
                np.zeros((1, 3)),
                np.full(1, 0.02),
                np.zeros((1, 3)),
                np.empty((1, len(self._mixer))),
            )

    @property
    def known(self) -> bool:
        """True if the stabiliser is known."""
        return self._gains is not None

    def restart(self) -> None:
        """Begins anew after an interruption of the stream, with unknown integrals."""
        self._integral = np.zeros(3)
        self._newest = -math.inf
        self._rate_then: FloatArray | None = None
        self._settled = False
        self._begin_flight()
        self._t = np.empty(0)
        self._commands = np.empty((0, len(self._mixer)))

    def advance(self, buffers: Mapping[str, ChannelBuffer], until: float, forget: float) -> None:
        """Computes commands up to a time.

        Args:
            until: time [s] up to which all samples are there.
            forget: commands before this time [s] are dropped.
        """
        if self._gains is None:
            return
        reference, attitude, gyro = (buffers[name] for name in NEEDED)
        if min(len(reference.t), len(attitude.t)) < 1 or len(gyro.t) < 2:
            return
        start = max(float(reference.t[0]), float(attitude.t[0]))
        first = max(int(np.searchsorted(gyro.t, self._newest, "right")), int(np.searchsorted(gyro.t, start)))
        # Each command acts until the next sample, which must be known.
        last = min(int(np.searchsorted(gyro.t, until, "right")), len(gyro.t) - 1)
        if last <= first:
            return
        t, period = gyro.t[first : last + 1], float(np.median(np.diff(gyro.t)))
        before = self._newest if math.isfinite(self._newest) else t[0]
        torn = np.flatnonzero(np.diff(t, prepend=before) > GAP * period)
        if len(torn):
            self.restart()
            t = t[torn[-1] :]
            if len(t) < 2:
                return
        commands = self._run(buffers, t, min(max(round(self._rate * period), 1), 20))
        # With less than a quarter of the weight for a block of rows it has landed: the integrals begin anew.
        if commands is None or (self._settled and np.mean(commands**2) * len(self._mixer) < 0.25 * self._hover):
            self.restart()
            return
        self._newest = float(t[-2])
        if self._settled:
            keep = self._t >= forget
            self._t = np.concatenate([self._t[keep], t[:-1]])
            self._commands = np.concatenate([self._commands[keep], commands])
        else:
            self._settle(np.diff(t), commands, gyro.values[last + 1 - len(t) : last + 1])

    def _run(self, buffers: Mapping[str, ChannelBuffer], t: FloatArray, runs: int) -> FloatArray | None:
        """Commands from each of the times `t` to the next, shape (len(t) - 1, rotors); None: measured too long ago."""
        assert self._gains is not None
        reference, attitude, gyro = (buffers[name] for name in NEEDED)
        at = (t[:-1, None] + np.diff(t)[:, None] * (np.arange(runs) / runs)).ravel()
        held, nearest = (np.searchsorted(buffer.t, at + 1e-9, "right") - 1 for buffer in (reference, attitude))
        for buffer, before in ((reference, held), (attitude, nearest)):
            if (at - buffer.t[before] > _oldest(buffer)).any():
                return None
        commands = np.empty((len(at), len(self._mixer)))
        stabilise_rows(
            self._gains,
            self._mixer,
            np.ascontiguousarray(reference.values[held]),
            _turned(attitude, at),
            linear(gyro.t, gyro.values, at),
            np.repeat(np.diff(t) / runs, runs),
            self._integral[None],
            commands,
        )
        return np.asarray(commands.reshape(len(t) - 1, runs, -1).mean(axis=1))

    def _settle(self, dt: FloatArray, commands: FloatArray, rate: FloatArray) -> None:
        """Adds up torques and angular momentum until they reveal the integrals."""
        square = commands**2
        # With less than half the weight nothing is learned, and the integrals rest at zero.
        if np.sum(square, axis=1).min() < 0.5 * self._hover:
            self._begin_flight()
            return
        if self._rate_then is None:
            self._rate_then = rate[0]
        spin = rate[:-1]
        turning = np.cross(spin, self._inertia * spin)
        self._angular += dt @ (square @ self._arms - turning)
        self._flown += float(dt.sum())
        if self._flown >= CALM:
            self._integral -= (self._angular - self._inertia * (rate[-1] - self._rate_then)) / self._flown
            self._settled = True

    def _begin_flight(self) -> None:
        self._integral[:] = 0.0
        self._angular, self._flown = np.zeros(3), 0.0
        self._rate_then = None

    def signal(self, until: float) -> RotorSignal:
        """The commands up to a time [s]; raises LogError when there are none."""
        count = int(np.searchsorted(self._t, until, "right"))
        if count < 2:
            have = f"{self._flown:.0f} of {CALM:g} s of flight from which its integrals are found"
            fix = "publish rotor speeds or motor commands; or keep flying, with references, attitude and rates"
            raise LogError(f"no rotor speeds, and none yet from references through the stabiliser ({have})", fix=fix)
        return RotorSignal(self._t[:count], self._commands[:count], "held", SOURCE)


def _oldest(buffer: ChannelBuffer) -> float:
    """Age of the newest sample of a channel beyond which it is not steered by [s]."""
    return min(OLDEST, GAP * float(np.median(np.diff(buffer.t)))) if len(buffer.t) > 1 else OLDEST


def _turned(buffer: ChannelBuffer, at: FloatArray) -> FloatArray:
    """Attitudes at times, quaternions, by straight lines between neighbours of the same sign."""
    out = linear(buffer.t, continuous_sign(buffer.values), at)
    return np.asarray(out / np.linalg.norm(out, axis=1, keepdims=True))


# --- Resampler of a live stream: messages of different rates, in any order, become rows of one uniform grid
#
# The rules of resampling are those of logs (`quadid.data.grid`): no lag is invented, gaps are not bridged.  Rows
# leave in blocks once the gyro, which leads the clock, is `SETTLE` seconds past them, so that every channel had that
# long to arrive.  With each sample goes how far the stream had come before it; a block of rows is made of the samples
# that came before the stream reached the block's end, whoever asks for rows and however late, and however the messages
# were handed in.


LEADER = "gyro"
SETTLE = 0.5
"""Rows leave this long [s] after their time, so that slower and delayed channels are there."""
BLOCK = 5
"""Rows that leave at once: many of them are read for little more than one, but the first wait for the last."""
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


class Measured(NamedTuple):
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
        notices: channel and sentence: what is wrong with its clock; the session reports them and empties the list.
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
        self._early: deque[tuple[FloatArray, dict[str, Measured]]] = deque(maxlen=MOST_EARLY)
        self._apart: dict[str, tuple[int, int]] = {}
        self._leads = self._idle = 0
        self._led = math.nan
        self._told: set[str] = set()
        self._stretches: deque[_Stretch] = deque()
        self._stretch: _Stretch | None = None
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

    def _measured(self, name: str, values: FloatArray) -> Measured | None:
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
        return Measured(values, usable)

    def _lead(self, stamps: FloatArray, columns: Mapping[str, Measured]) -> None:
        """Takes messages with gyro, which move the clock one after the other."""
        # A flood is cut off; the first message of all, which begins the clock, is taken by itself.
        room = MOST_SAMPLES - self._buffers[LEADER].waiting
        if len(stamps) > room:
            self.faults[f"{LEADER}: flood"] += len(stamps) - room
        stamps, columns = stamps[:room], _part(columns, slice(room))
        times = np.abs(stamps) <= LARGEST
        begun = int(times.argmax()) + 1 if self.time.newest == -math.inf and times.any() else len(stamps)
        if begun < len(stamps):
            self._lead(stamps[:begun], _part(columns, slice(begun)))
            self._lead(stamps[begun:], _part(columns, slice(begun, None)))
            return
        self._leads += len(stamps)
        # Session times, and how far the stream had come before each; where it jumps, another stretch begins.
        before = self.time.newest
        t = self.time.lead(stamps)
        self._watch_leader(stamps, np.isnan(t) | (np.diff(stamps, prepend=self._led) == 0.0))
        reached = np.fmax.accumulate(np.concatenate([[before], t]))[:-1]
        for k in np.flatnonzero(t > reached + HISTORY).tolist():
            new_clock = self.time.began_in(float(reached[k]), float(t[k]))
            self._stretches.append(_Stretch(float(t[k]), float(reached[k]), new_clock))
            if new_clock:
                self._told.clear()
                self._apart.clear()
            else:
                self._told.discard(LEADER)
        # The clock has begun: what came before it can be placed now.
        if before == -math.inf < self.time.newest:
            early, self._early = self._early, deque(maxlen=MOST_EARLY)
            for followers in early:
                self._take(followers[1], self.time.follow(followers[0]), np.full(1, -math.inf))
                self.counts.subtract(list(followers[1]))
        self._take(columns, t, reached)

    def _watch_leader(self, stamps: FloatArray, idle: BoolArray) -> None:
        """Notes that the gyro's clock stands: most messages, those `idle`, bring the stamp before or none to believe.

        A message in three that goes on is enough: the same ones may come over several ways.
        """
        if self._idle or idle.any():
            for stamp, stands in zip(stamps.tolist(), idle.tolist(), strict=True):
                self._idle = min(self._idle + 1, APART) if stands else max(self._idle - 2, 0)
                if self._idle == APART:
                    why = f"time stands still: stamps of the gyro do not go on from {stamp:.12g} s, or are no times"
                    self._notice(LEADER, f"{why}; fix: stamp each message when it is measured, in seconds")
            if not self._idle:
                self._told.discard(LEADER)
        self._led = float(stamps[-1]) if len(stamps) else self._led

    def _follow(self, stamps: FloatArray, columns: Mapping[str, Measured]) -> None:
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

    def _take(self, columns: Mapping[str, Measured], t: FloatArray, reached: FloatArray) -> None:
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
        """Notes how far ahead of the gyro samples of another channel are [s]; notes what is no accident."""
        behind = SETTLE + BLOCK * self._step
        for offset in offsets.tolist() if name in self._apart or np.any(np.abs(offsets) > min(AHEAD, behind)) else ():
            if -behind <= offset <= AHEAD:
                self._apart.pop(name, None)
                continue
            count, since = self._apart.get(name, (0, self._leads))
            if offset < 0.0 and count and self._leads == since:
                continue  # what was held back comes at once: that is one delay, not many
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

    def next_rows(self) -> Rows | None:
        """The next block of rows; None until enough has arrived.  One that cannot be made raises, and is left out."""
        if not self._is_due():
            return None
        assert self._stretch is not None
        at, stretch, fresh = self._times(), self._stretch, self._row == 0
        self._row += BLOCK
        for name, buffer in self._buffers.items():
            late, doubles = buffer.settle(
                float(at[0]) - (HISTORY if fresh else SETTLE),
                float(at[-1]) + SETTLE,
                stretch.end if fresh else -math.inf,
            )
            if late:
                self.faults[f"{name}: late"] += late
            if doubles:
                self.faults[f"{name}: duplicate"] += doubles
        rows = self._grid(at)
        for buffer in self._buffers.values():
            buffer.forget(float(at[0]) - HISTORY)
        return replace(rows, fresh=fresh, new_clock=fresh and stretch.new_clock)

    def _is_due(self) -> bool:
        """True if the stream has come past the next block of rows; goes on to the next stretch where one has ended."""
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

    def _grid(self, at: FloatArray) -> Rows:
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
        columns = columns_on_grid(plan, at)
        spacing = plan.tracks["rotor_speed"].period / self._step
        # Of logs `quadid.data.grid` says "instant": J of recorded Crazyflie flights of 5 s is less sure with "smooth".
        sampling: Sampling = "smooth" if plan.filtered else plan.sampling
        return Rows(at, columns, sampling, rotor.source, spacing=spacing)

    def _rotor_signal(self, recording: Recording, at: FloatArray) -> RotorSignal:
        """Rotor commands or speeds: as published, else references through the stabiliser; raises QuadidError."""
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


def _part(columns: Mapping[str, Measured], which: slice) -> dict[str, Measured]:
    """Some messages of columns."""
    return {name: Measured(values[which], usable[which]) for name, (values, usable) in columns.items()}
