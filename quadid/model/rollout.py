"""Simulation of windows: segments, initial states, many parameter vectors at once."""

import itertools
import math
import os
from collections import OrderedDict
from collections.abc import Callable, Hashable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from queue import SimpleQueue
from threading import Lock
from typing import NamedTuple
from weakref import WeakValueDictionary

import numpy as np

from quadid.blas import one_thread
from quadid.data.window import Window
from quadid.errors import WindowError
from quadid.model import layout as ix
from quadid.model.kernel import (
    FACTOR_ENTRIES,
    HUB_ENTRIES,
    RARE_ENTRIES,
    ROTOR_ENTRIES,
    SOLID_ENTRIES,
    Flight,
    Needs,
    needs_of,
)
from quadid.model.layout import relative_voltage, residual_terms
from quadid.model.rollout_kernel import roll_segments
from quadid.model.rotor_kernel import Drive, rotor_table
from quadid.model.simd import ALL_MOMENTS, LANES, MAX_TANGENTS, N_STATE, aligned
from quadid.types import BoolArray, FloatArray, IndexArray, IntArray, check_shapes
from quadid.vehicle import Vehicle

# --- Residual channels: what a window measured of each


def channels_of(window: Window) -> int:
    """Number of residual channels that a window has."""
    if window.position is not None:
        return 15
    return 9 if window.velocity is None else 12


def measurements(window: Window, channels: int) -> tuple[FloatArray, BoolArray]:
    """Measurements of a window, as the kernel reads it.

    Args:
        window: the data, n rows.
        channels: residual channels to look at, the first 9, 12 or 15.

    Returns:
        Rates, quaternion, specific force, and of those looked at velocity and position, shape (n, channels + 1), at
        rest where missing; and where each channel was measured, shape (n, channels).
    """
    n = len(window)
    measured = np.zeros((n, channels + 1))
    measured[:, 3] = 1.0
    valid = np.zeros((n, channels), dtype=bool)
    places = (
        (window.gyro, 0, 0),
        (window.attitude, 3, 3),
        (window.accel, 7, 6),
        (window.velocity, 10, 9),
        (window.position, 13, 12),
    )
    for values, column, channel in places:
        if values is None or channel >= channels:
            continue
        good = np.isfinite(values).all(axis=1)
        measured[good, column : column + values.shape[1]] = values[good]
        valid[good, channel : channel + 3] = True
    return measured, valid


# --- How a window is cut into segments


@dataclass(frozen=True)
class Segments:
    """Cut of a window for multiple shooting.

    Attributes:
        length: scored rows a segment.
        lead: rows before the first scored one, available to roll in filters and delays.
        starts: first scored row of each segment.
    """

    length: int
    lead: int
    starts: IntArray

    @classmethod
    def cut(cls, rows: int, length: int, lead: int = 1) -> "Segments":
        """Cuts `rows` rows into back-to-back segments of `length`, leaving `lead` rows before the first.

        Raises:
            WindowError: when not one segment fits.
        """
        starts = np.arange(lead, rows - length, length, dtype=np.int64)
        if len(starts) == 0:
            raise WindowError(f"window of {rows} rows", f"at least {length + lead + 1} rows", "use a longer stretch")
        return cls(length, lead, starts)

    @property
    def rows(self) -> IntArray:
        """Scored rows of each segment, shape (segments, length)."""
        return self.starts[:, None] + np.arange(self.length)

    def at(self, places: IndexArray) -> "Segments":
        """Returns the segments at `places`."""
        return Segments(self.length, self.lead, self.starts[places])


# --- Arrays kept for the next calls, the most recently used ones, up to a number of bytes together


class ArrayCache:
    """Arrays by key; the least recently used go first.

    Args:
        most: bytes of all together; a single larger array is not kept.
    """

    def __init__(self, most: int) -> None:
        self._most, self._bytes = most, 0
        self._kept: OrderedDict[Hashable, FloatArray] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable) -> FloatArray | None:
        """The array kept under this key, if it still is."""
        with self._lock:
            found = self._kept.get(key)
            if found is not None:
                self._kept.move_to_end(key)
            return found

    def keep(self, key: Hashable, array: FloatArray) -> None:
        """Keeps an array under a key, and drops those used longest ago."""
        with self._lock:
            self._bytes += array.nbytes - (self._kept.pop(key).nbytes if key in self._kept else 0)
            self._kept[key] = array
            while self._bytes > self._most:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes


# --- Which parameter vectors share a block of lanes: those that need the same of the model, so that no block needs all


def packing(thetas: FloatArray, rotors: int) -> IndexArray:
    """Lane of each of these parameter vectors (m, size), the first one in lane 0, shape (m,).

    The others are sorted by what they need of the model; those with rotors of their own fill the last lanes, and so
    the fewest blocks.  Lanes left over, between them and the rest, repeat the first.
    """
    if len(thetas) <= LANES:
        return np.arange(len(thetas))
    others = thetas[1:]
    entries = (
        (ix.IMU_PERIOD,),
        (ix.ATT_DELAY,),
        (ix.AHRS_K,),
        HUB_ENTRIES + RARE_ENTRIES,
        SOLID_ENTRIES + FACTOR_ENTRIES,
        RARE_ENTRIES,
    )
    needs = [np.any(others[:, list(group)] != 0.0, axis=1) for group in entries]
    driving = [*ROTOR_ENTRIES, *range(ix.LOSS, ix.LOSS + 2 * rotors)]
    own = np.any(others[:, driving] != thetas[0, driving], axis=1)
    lane, last = np.zeros(len(thetas), dtype=np.intp), len(thetas) - np.count_nonzero(own)
    lane[1 + np.lexsort([*needs, others[:, ix.DELAY] != 0.0, own])] = np.arange(1, len(thetas))
    lane[lane >= last] += -len(thetas) % LANES
    return lane


def packed(vectors: FloatArray, lane: IndexArray) -> FloatArray:
    """Vectors (m, n) in whole blocks of lanes, spare ones repeating the first."""
    out = np.repeat(vectors[:1], -(-len(vectors) // LANES) * LANES, axis=0)
    out[lane] = vectors
    return out


# --- Typed wrapper of the kernel: segments of a window, initial states, many parameter vectors at once


_PART_ROWS = 800
"""Rows of one block simulated before their residuals are used, fewer of more blocks: they stay in cache."""
_TABLES = ArrayCache(32 << 20)
"""Rotor moments kept for the next calls, of all windows together: four tables of a log of 500 s take 26 MB."""
NUMBERS = itertools.count()
"""Of simulations: what is kept of one is found by it."""
_FORGOTTEN = 40.0
"""Time constants after which nothing is left in double precision: exp(-40) = 4e-18."""


@lru_cache(maxsize=1)
def _threads() -> ThreadPoolExecutor:
    return ThreadPoolExecutor(max_workers=os.cpu_count(), thread_name_prefix="rollout")


_NO_TABLE = np.empty((0, 2 * ALL_MOMENTS))
_NO_BASIS, _NO_ENDS, _NOTHING = np.empty((0, 0, 0)), np.empty((0, 0, 0)), np.empty(0)


def hub_geometry(vehicle: Vehicle) -> tuple[FloatArray, float, tuple[float, float, float, float, float], float]:
    """Geometry that the kernel needs.

    Returns:
        Hubs (rotors, 4), see `quadid.model.rotor_kernel.Drive`; mean z of the hubs [m]; means of x, y, x^2, y^2, x y of
        the hubs; half the smallest distance between two of them [m].
    """
    positions = vehicle.rotor_positions
    rotors, hub, (x, y) = len(positions), float(positions[:, 2].mean()), positions[:, :2].T
    plan = (float(x.mean()), float(y.mean()), float(x @ x) / rotors, float(y @ y) / rotors, float(x @ y) / rotors)
    gaps = [float(np.linalg.norm(a - b)) for i, a in enumerate(positions) for b in positions[:i]]
    return np.column_stack([positions[:, :2], vehicle.spins, positions[:, 2] - hub]), hub, plan, 0.5 * min(gaps)


class _Lanes(NamedTuple):
    """One block: parameter vectors (LANES, size), tangent offsets (12, LANES), needs, shared rotor moments.

    And the number of rows after which rotors have forgotten how they began, to the last digit of their speed.
    """

    theta: FloatArray
    dx: FloatArray
    need: Needs
    table: FloatArray
    memory: int


class Rollout:
    """The simulation of one window: residuals of many parameter vectors against its measurements.

    Attributes:
        window: the data; vehicle: its rotors and mass.
        channels: 9, 12 with velocity, 15 with position.
        valid: shape (n, channels), True where there is a measurement.
    """

    def __init__(self, window: Window, vehicle: Vehicle) -> None:
        """Prepares measured arrays; raises WindowError when rotor columns do not match the vehicle."""
        rotors = len(vehicle.rotors)
        if window.rotor_speed.shape[1] != rotors:
            raise WindowError(
                f"{window.name or 'window'}: {window.rotor_speed.shape[1]} rotor columns",
                f"{rotors}, as vehicle '{vehicle.name}' has",
                "choose the vehicle that flew, or map the columns",
            )
        self.window, self.vehicle = window, vehicle
        self.mass = vehicle.mass
        self.geometry, hub, plan, self.reach = hub_geometry(vehicle)
        self.channels = channels_of(window)
        self.measured, self.valid = measurements(window, self.channels)
        self._terms = residual_terms(vehicle)
        self._size = LANES, ix.LOSS + 2 * rotors + len(self._terms)
        speed = window.rotor_speed.view()
        slope = speed[:0] if window.rotor_slope is None else window.rotor_slope.view()
        speed.flags.writeable = slope.flags.writeable = False  # those of a window that was pickled can be written to
        self.drive = Drive(
            speed, slope, relative_voltage(window, vehicle), window.sampling == "held", self.geometry, window.dt
        )
        self.flight = Flight(self.mass, self.reach, hub, plan, window.t0, window.dt, *window.log_span)
        self._number = next(NUMBERS)

    def __len__(self) -> int:
        return len(self.window)

    def roll(
        self,
        segments: Segments,
        theta: FloatArray,
        x0: FloatArray,
        dx: FloatArray | None = None,
        n_pre: int = 1,
        out: tuple[FloatArray, FloatArray] | None = None,
    ) -> tuple[FloatArray, FloatArray]:
        """Simulates every segment for every parameter vector.

        Args:
            segments: the cut.
            theta: parameter vectors, shape (m, size).
            x0: initial states `n_pre` rows before each segment: quaternion, rates [rad/s], velocity [m/s],
                position [m] (NED); shape (segments, 13).
            dx: tangent offset of the initial state of each vector, shape (m, 12); none by default.
            n_pre: rows rolled before the first scored one.
            out: what an earlier call of the same shapes returned, to be overwritten; spares fresh memory.

        Returns:
            Residuals predicted - measured, shape (blocks, segments, length, channels, LANES), vector i at
            [i // LANES, ..., i % LANES] (surplus lanes repeat the last vector; unmeasured samples hold 0), and the
            states one step after each segment, shape (blocks, segments, 13, LANES).
        """
        m, count = len(theta), len(segments.starts)
        blocks = -(-m // LANES)
        shapes = (blocks, count, segments.length, self.channels, LANES), (blocks, count, N_STATE, LANES)
        residuals, ends = (aligned(shapes[0]), aligned(shapes[1])) if out is None else out
        check_shapes("roll", ("out", residuals, shapes[0]), ("ends", ends, shapes[1]))
        mask = self.valid.astype(np.float64)

        def one(block: int, lanes: _Lanes) -> None:
            rows = residuals[block].reshape(count, segments.length, self.channels * LANES)
            self._run(segments, n_pre, x0, lanes, mask, None, rows, ends[block], _NOTHING)

        self._each_block(segments, n_pre, theta, dx, self.channels, one)
        return residuals, ends

    def roll_parts(
        self,
        segments: Segments,
        theta: FloatArray,
        x0: FloatArray,
        dx: FloatArray,
        n_pre: int,
        use: Callable[[slice, FloatArray], None],
    ) -> None:
        """Simulates as `roll` does, a few segments at a time, so that residuals are used while they are in cache.

        Args:
            use: called with which segments, and their residuals (blocks, segments, length, channels, LANES), which
                are overwritten afterwards; called from several threads.
        """
        count, width = len(segments.starts), segments.length * self.channels * LANES
        lanes = self._prepared(segments, n_pre, theta, dx, self.channels)
        step = max(_PART_ROWS // (segments.length * len(lanes)), 1)
        mask = self.valid.astype(np.float64)
        room: SimpleQueue[FloatArray] = SimpleQueue()

        def part(first: int) -> None:
            which = slice(first, min(first + step, count))
            some = Segments(segments.length, segments.lead, segments.starts[which])
            shape = (len(lanes), len(some.starts), segments.length, self.channels, LANES)
            space = aligned((len(lanes) * step * width,)) if room.empty() else room.get()
            out = space[: math.prod(shape)].reshape(shape)
            ends = aligned((len(some.starts), N_STATE, LANES))
            for block, one in enumerate(lanes):
                rows = out[block].reshape(len(some.starts), segments.length, -1)
                self._run(some, n_pre, x0[which], one, mask, None, rows, ends, _NOTHING)
            use(which, out)
            room.put(space)

        starts = range(0, count, step)
        if len(starts) == 1:
            part(0)
            return
        with one_thread():
            list(_threads().map(part, starts))

    def costs(
        self,
        segments: Segments,
        theta: FloatArray,
        x0: FloatArray,
        weights: FloatArray,
        basis: FloatArray,
        n_pre: int = 1,
    ) -> FloatArray:
        """Weighted sum of squares of many parameter vectors, initial states eliminated by variable projection.

        For residuals r of a segment, weights W and orthonormal columns Q that span the directions which the initial
        state opens in W r, the cost is ``|W r|^2 - |Q' W r|^2``, summed over segments.  Golub & Pereyra 1973,
        doi:10.1137/0710036.  Residuals stay in the processor's cache.

        Args:
            segments: the cut.
            theta: parameter vectors, shape (m, size).
            x0: initial states `n_pre` rows before each segment, shape (segments, 13), as for `roll`.
            weights: of every row of the window, shape (n, channels): 1 / sigma, 0 where nothing was measured; the
                first 9, 12 or all channels.
            basis: shape (segments, length * channels, directions); channel c of sample i at row i * channels + c.
            n_pre: rows rolled before the first scored one.

        Returns:
            Costs, shape (m,).
        """
        channels = weights.shape[1]
        cost = np.zeros((-(-len(theta) // LANES), LANES))
        weights, basis = np.ascontiguousarray(weights), np.ascontiguousarray(basis)

        def one(block: int, lanes: _Lanes) -> None:
            room = aligned((1, 1, channels * LANES))
            self._run(segments, n_pre, x0, lanes, weights, basis, room, _NO_ENDS, cost[block])

        self._each_block(segments, n_pre, theta, None, channels, one)
        return cost.reshape(-1)[: len(theta)]

    def _each_block(
        self,
        segments: Segments,
        n_pre: int,
        theta: FloatArray,
        dx: FloatArray | None,
        channels: int,
        run: Callable[[int, _Lanes], None],
    ) -> None:
        """Cuts parameter vectors into blocks of lanes and runs the blocks, several at a time."""
        lanes = self._prepared(segments, n_pre, theta, dx, channels)
        if len(lanes) == 1:
            run(0, lanes[0])
        else:
            list(_threads().map(run, range(len(lanes)), lanes))

    def _prepared(
        self, segments: Segments, n_pre: int, theta: FloatArray, dx: FloatArray | None, channels: int
    ) -> list[_Lanes]:
        """Cuts parameter vectors into blocks of lanes; raises ValueError for what cannot be simulated."""
        if not 1 <= n_pre <= segments.lead:
            raise ValueError(f"n_pre = {n_pre}; allowed: 1 to the segments' lead, {segments.lead}")
        if np.any(np.diff(segments.starts) < 0):
            raise ValueError("segments that begin before the one in front of them; allowed: rising starts")
        if not np.isfinite(theta).all():
            vector, entry = np.argwhere(~np.isfinite(theta))[0]
            raise ValueError(f"theta[{vector}, {entry}] = {theta[vector, entry]}; allowed: finite numbers (see Layout)")
        m = len(theta)
        blocks = -(-m // LANES)
        th = np.empty((blocks * LANES, theta.shape[1]))
        th[:m], th[m:] = theta, theta[-1]
        offsets = np.zeros((blocks * LANES, MAX_TANGENTS))
        if dx is not None:
            offsets[:m] = dx
        return [self._lanes(th[i : i + LANES], offsets[i : i + LANES], channels) for i in range(0, len(th), LANES)]

    def _lanes(self, theta: FloatArray, dx: FloatArray, channels: int) -> _Lanes:
        check_shapes("needs_of", ("theta", theta, self._size))
        need = needs_of(theta, len(self.geometry), channels)
        table = self._table(theta, need) if need.shared else _NO_TABLE
        lag = float((theta[:, ix.TAU] + np.maximum(theta[:, ix.SLOWER], 0.0)).max())
        late = float(theta[:, ix.DELAY].max())
        memory = math.ceil((_FORGOTTEN * lag + late) / self.window.dt) + 4
        return _Lanes(theta, np.ascontiguousarray(dx.T), need, table, memory)

    def _table(self, theta: FloatArray, need: Needs) -> FloatArray:
        """Rotor moments of every step for lanes with the same rotors; kept for the next calls."""
        own = np.concatenate(
            [theta[0, list(ROTOR_ENTRIES)], theta[0, ix.LOSS : ix.LOSS + 2 * len(self.geometry)]]
        ).tobytes()
        key = self._number, own, theta[0, ix.B] if theta[0, ix.OFFSET] else 0.0, need.hub
        table = _TABLES.get(key)
        if table is None:
            table = np.empty((len(self.window), 2 * ALL_MOMENTS))
            rotor_table(self.drive, need, theta, table)
            _TABLES.keep(key, table)
        return table

    def _run(
        self,
        segments: Segments,
        n_pre: int,
        x0: FloatArray,
        lanes: _Lanes,
        scale: FloatArray,
        basis: FloatArray | None,
        out: FloatArray,
        ends: FloatArray,
        cost: FloatArray,
    ) -> None:
        rows, length, count, channels = len(self), segments.length, len(segments.starts), scale.shape[1]
        first, last = segments.starts[0] - n_pre, segments.starts[-1] + length
        if first < 0 or last >= rows:
            raise ValueError(f"segments over rows {first} to {last}; allowed: 0 to {rows - 1}")
        if channels not in (9, 12, 15) or channels > self.channels:
            raise ValueError(f"{channels} residual channels; allowed: 9, 12 or 15, at most {self.channels}")
        sums = basis is not None
        given = [
            ("scale", scale, (rows, channels)),
            ("x0", x0, (count, N_STATE)),
            ("theta", lanes.theta, self._size),
            ("dx", lanes.dx, (MAX_TANGENTS, LANES)),
            ("out", out, (1, 1, channels * LANES) if sums else (count, length, channels * LANES)),
        ]
        if basis is None:
            given.append(("ends", ends, (count, N_STATE, LANES)))
        else:
            given += [("basis", basis, (count, length * channels, basis.shape[-1])), ("cost", cost, (LANES,))]
        if lanes.need.shared:
            given.append(("table", lanes.table, (rows, 2 * ALL_MOMENTS)))
        check_shapes("roll_segments", *given)
        x0 = x0 if x0.flags.writeable else x0.copy()  # of read-only states numba would compile the kernel once more
        roll_segments(
            self.drive, self._terms, self.flight, lanes.table, self.measured, scale, lanes.memory, segments.starts,
            n_pre, x0, lanes.theta, lanes.dx, lanes.need, channels, length, sums,
            _NO_BASIS if basis is None else basis, out, ends, cost,
        )  # fmt: skip

    def initial_states(self, segments: Segments, n_pre: int = 1) -> FloatArray:
        """First guess of the states `n_pre` rows before each segment from the measurements, shape (segments, 13).

        Unmeasured parts start level, at rest, at the origin; an isolated missing sample takes its nearest neighbour.
        """
        rows = segments.starts - n_pre
        x0 = np.zeros((len(rows), N_STATE))
        x0[:, 0] = 1.0
        w = self.window
        for values, place in ((w.attitude, 0), (w.gyro, 4), (w.velocity, 7), (w.position, 10)):
            if values is not None and np.isfinite(values).all(axis=1).any():
                good = np.flatnonzero(np.isfinite(values).all(axis=1))
                nearest = good[np.argmin(np.abs(rows[:, None] - good[None, :]), axis=1)] if len(good) < len(w) else rows
                x0[:, place : place + values.shape[1]] = values[nearest]
        return x0


# --- One simulation of a window for all problems that look at it


_SHARED: WeakValueDictionary[tuple[int, int], Rollout] = WeakValueDictionary()


def shared_rollout(window: Window, vehicle: Vehicle) -> Rollout:
    """The `Rollout` of this very window and vehicle that somebody still uses, or a new one.

    Problems with segments of several lengths look at the same data; of a long log each copy would be a large part of
    all memory.
    """
    key = (id(window), id(vehicle))  # of objects that the one found keeps alive
    found = _SHARED.get(key)
    if found is None:
        found = _SHARED[key] = Rollout(window, vehicle)
    return found
