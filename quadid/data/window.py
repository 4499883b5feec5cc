"""Measured data as the core sees it: blocks of messages, channels, recordings, and windows on a uniform grid.

Inside the core all data are SI, world NED, body FRD, quaternions body to world, scalar first.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, TypeGuard, get_args

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import LogError, WindowError
from quadid.types import BoolArray, FloatArray, IndexArray

if TYPE_CHECKING:
    from quadid.vehicle import Vehicle

Sampling = Literal["held", "instant", "smooth"]

CHANNELS: dict[str, tuple[int | None, str]] = {
    "gyro": (3, "rad/s"),
    "accel": (3, "m/s^2"),
    "attitude": (4, "quaternion wxyz, body to world"),
    "rotor_speed": (None, "rad/s"),
    "motor_command": (None, "normalized 0..1 or us"),
    "mixer_input": (None, "as the vehicle file's mixer takes it"),
    "attitude_reference": (4, "rad, rad, rad, throttle 0..1"),
    "velocity": (3, "m/s, NED"),
    "position": (3, "m, NED"),
    "battery": (1, "V"),
    "accel_z": (1, "m/s^2"),
    "accel_world": (3, "m/s^2, NED"),
}
"""Known channels: number of columns (None: as many as the vehicle asks for) and unit.

``accel`` is specific force (-g on z at rest); ``accel_z`` its z alone, ``accel_world`` the same in world axes, from
logs that hold no more.
"""
CHANNEL_NAMES = ("p", "q", "r", "phi", "theta", "psi", "a_x", "a_y", "a_z", "v_n", "v_e", "v_d", "x", "y", "z")
"""Residual channels: rates, attitude error as a body rotation vector, specific force, velocity, position."""
CHANNEL_UNITS = ("rad/s",) * 3 + ("rad",) * 3 + ("m/s^2",) * 3 + ("m/s",) * 3 + ("m",) * 3
COINCIDENT = 5e-3
"""Samples this close to a uniform grid, in steps, lie on it."""
_MEASURED = ("gyro", "attitude", "accel", "velocity", "position", "battery", "attitude_reference")
"""Channels of a window that may be missing."""


@dataclass(frozen=True)
class Block:
    """Messages of one kind in order of arrival, n >= 1: what every source of data gives and a session takes.

    Attributes:
        t: times [s], shape (n,).
        columns: channel and values in its unit, shape (n, columns), of each channel that the messages hold.
    """

    t: FloatArray
    columns: tuple[tuple[str, FloatArray], ...]

    @classmethod
    def one(cls, t: float, channel: str, values: Sequence[float]) -> Block:
        """One message of one channel at `t` [s]."""
        return cls(np.array([t]), ((channel, np.array([values])),))

    @property
    def channel(self) -> str:
        """Name of the first channel, which was that of a `Sample` in release 0.1.0."""
        return self.columns[0][0]

    @property
    def values(self) -> tuple[float, ...]:
        """Values of the first message in that channel."""
        return tuple(self.columns[0][1][0].tolist())

    def part(self, start: int, stop: int | None = None) -> Block:
        """Messages `start` to before `stop`."""
        return Block(self.t[start:stop], tuple((name, values[start:stop]) for name, values in self.columns))


Sample = Block.one
"""One message, by its name of release 0.1.0."""


def _never_changes(values: ArrayLike) -> TypeGuard[FloatArray]:
    """True if these are rows of doubles that nobody can write to, so that they need no copy."""
    if not (isinstance(values, np.ndarray) and values.dtype == np.float64 and values.flags.c_contiguous):
        return False
    owner: object = values
    while isinstance(owner, np.ndarray):
        if owner.flags.writeable:
            return False
        owner = owner.base
    return owner is None


def _frozen(values: ArrayLike, name: str, columns: int | None) -> FloatArray:
    array = values if _never_changes(values) else np.array(values, dtype=np.float64, order="C")
    if array.ndim == 1 and columns == 1:
        array = array[:, None]
    if array.ndim != 2 or (columns is not None and array.shape[1] != columns):
        raise WindowError(f"{name} of shape {array.shape}", f"(n, {columns if columns else 'rotors'})")
    array.setflags(write=False)
    return array


@dataclass(frozen=True)
class Channel:
    """One channel of a recording at its own rate.

    Attributes:
        name: key of `CHANNELS`.
        t: times [s], shape (n,), non-decreasing.
        values: shape (n, columns).
        source: where it came from, for people (topic, message name, column names).
        faults: number of samples the reader dropped, by reason, such as duplicate, not_finite.
    """

    name: str
    t: FloatArray
    values: FloatArray
    source: str = ""
    faults: Mapping[str, int] = field(default_factory=dict)

    def __post_init__(self) -> None:
        """Checks name, shapes and order of time; raises WindowError."""
        if self.name not in CHANNELS:
            raise WindowError(f"unknown channel '{self.name}'", ", ".join(CHANNELS))
        t = np.array(self.t, dtype=np.float64)
        values = _frozen(self.values, self.name, CHANNELS[self.name][0])
        if t.shape != (len(values),):
            raise WindowError(f"{self.name}: {len(values)} rows but times of shape {t.shape}", "one time a row")
        if len(t) > 1 and np.any(np.diff(t) < 0.0):
            raise WindowError(f"{self.name}: time runs backwards", "non-decreasing time", "split at the step")
        t.setflags(write=False)
        object.__setattr__(self, "t", t)
        object.__setattr__(self, "values", values)


@dataclass(frozen=True)
class Recording:
    """Contents of a log, in core units and frames, each channel at its own rate.

    Attributes:
        format: how it was recognised: csv, mcap, tlog, dataflash, ulog, usdlog.
        channels: by name; absent channels are absent keys.
        breaks: times [s] across which nothing may be joined (reboots, clock steps).
        warnings: what was wrong with the log and what was done about it.
        grid: for a log that already is a uniform grid (CSV), its step [s]; else None.
        autopilot: the autopilot's own parameters as the log holds them, by their names there (`INS_GYRO_FILTER`).
        epoch: UNIX time of its time 0 [s]; None where its clock has no date.
        modes: when the autopilot entered a flight mode [s], and its name; empty where the log lacks them.
        other: the evidence that it is no multirotor, whose outputs are left out; empty where there is none.
    """

    name: str
    format: str
    channels: Mapping[str, Channel]
    breaks: tuple[float, ...] = ()
    warnings: tuple[str, ...] = ()
    sha256: str = ""
    grid: float | None = None
    autopilot: Mapping[str, float] = field(default_factory=dict)
    epoch: float | None = None
    modes: tuple[tuple[float, str], ...] = ()
    other: str = ""

    @property
    def span(self) -> tuple[float, float]:
        """First and last time of any channel [s]; both 0 where there is no sample."""
        ends = [(float(c.t[0]), float(c.t[-1])) for c in self.channels.values() if len(c.t)] or [(0.0, 0.0)]
        return min(a for a, _ in ends), max(b for _, b in ends)

    @property
    def first_imu_time(self) -> float:
        """Time [s] of the first gyro or accelerometer sample, else of the first of any channel: LOG@0 begins there."""
        imu = (self.channels[name].t for name in ("gyro", "accel") if name in self.channels)
        return min((float(t[0]) for t in imu if len(t)), default=self.span[0])


def mounting_matrix(rotation: tuple[float, float, float]) -> FloatArray:
    """Matrix (3, 3) from IMU to body axes, for roll, pitch, yaw [rad] of the IMU in the body (z-y-x)."""
    (cr, cp, cy), (sr, sp, sy) = np.cos(rotation), np.sin(rotation)
    return np.array(
        [
            [cp * cy, sr * sp * cy - cr * sy, cr * sp * cy + sr * sy],
            [cp * sy, sr * sp * sy + cr * cy, cr * sp * sy - sr * cy],
            [-sp, sr * cp, cr * cp],
        ]
    )


def in_body_axes(recording: Recording, vehicle: Vehicle) -> Recording:
    """The recording with gyro and accelerometer in body axes; itself where the IMU is mounted straight."""
    rotation = vehicle.mounting.rotation
    if not any(rotation):
        return recording
    turn = mounting_matrix(rotation)
    turned = {
        name: replace(channel, values=channel.values @ turn.T)
        for name, channel in recording.channels.items()
        if name in ("gyro", "accel")
    }
    return replace(recording, channels={**recording.channels, **turned})


@dataclass(frozen=True)
class Window:
    """A stretch of flight without gaps on a uniform grid.

    NaN in a measured channel means "no measurement at this grid point"; rotor speeds must be finite.

    Attributes:
        t0: time of the first row [s].
        dt: grid step [s].
        rotor_speed: shape (n, rotors) [rad/s]; see `sampling`.
        gyro: shape (n, 3) [rad/s], body FRD, instants; or None.
        attitude: shape (n, 4), unit quaternions body to world; or None.
        accel: shape (n, 3) [m/s^2], specific force in body FRD, mean over one sample centred on t; or None.
        velocity: shape (n, 3) [m/s], world NED; or None.
        position: shape (n, 3) [m], world NED; or None.
        battery: shape (n, 1) [V]; or None.
        attitude_reference: shape (n, 4): roll, pitch, yaw [rad], throttle 0..1; or None.
        sampling: ``held``: row k of `rotor_speed` acts from t_k to t_k+1; ``instant``: a reading; ``smooth``: a reading
            behind a low-pass for this grid, without frequencies above half its rate.
        rotor_slope: shape (n, rotors) [rad/s^2]: a held row is the mean of a speed that runs on at this slope within
            its sample (`quadid.data.rotor_signal`); None: it stays the same.
        log_span: first and last time [s] of the whole log, for effects that run over a flight.
    """

    t0: float
    dt: float
    rotor_speed: FloatArray
    gyro: FloatArray | None = None
    attitude: FloatArray | None = None
    accel: FloatArray | None = None
    velocity: FloatArray | None = None
    position: FloatArray | None = None
    battery: FloatArray | None = None
    attitude_reference: FloatArray | None = None
    sampling: Sampling = "held"
    rotor_slope: FloatArray | None = None
    name: str = ""
    log_span: tuple[float, float] = field(default=(np.nan, np.nan))

    def __post_init__(self) -> None:
        """Checks shapes, finiteness and quaternion norms; normalises the sign of time span; raises WindowError."""
        if not (np.isfinite(self.dt) and self.dt > 0.0):
            raise WindowError(f"grid step {self.dt} s", "a positive step")
        if self.sampling not in get_args(Sampling):
            raise WindowError(f"sampling '{self.sampling}'", ", ".join(get_args(Sampling)))
        rotor = _frozen(self.rotor_speed, "rotor_speed", None)
        if not np.all(np.isfinite(rotor)):
            bad = int(np.count_nonzero(~np.isfinite(rotor).all(axis=1)))
            raise WindowError(
                f"{bad} rows of rotor_speed are not finite", "finite rotor speeds", "split the window there"
            )
        object.__setattr__(self, "rotor_speed", rotor)
        if self.rotor_slope is not None:
            if self.sampling != "held":
                raise WindowError(f"rotor_slope with sampling '{self.sampling}'", "held", "leave rotor_slope out")
            slope = _frozen(self.rotor_slope, "rotor_slope", rotor.shape[1])
            if slope.shape != rotor.shape or not np.all(np.isfinite(slope)):
                raise WindowError("rotor_slope", f"finite values, as many as rotor_speed {rotor.shape}")
            object.__setattr__(self, "rotor_slope", slope)
        for name in _MEASURED:
            values = getattr(self, name)
            if values is None:
                continue
            array = _frozen(values, name, CHANNELS[name][0])
            if len(array) != len(rotor):
                raise WindowError(f"{name} has {len(array)} rows, rotor_speed {len(rotor)}", "equal numbers of rows")
            if np.any(np.isinf(array)):
                raise WindowError(f"{name} holds infinite values", "finite values, or NaN where nothing was measured")
            object.__setattr__(self, name, array)
        if self.attitude is not None:
            norm = np.linalg.norm(self.attitude, axis=1)
            if np.any(np.abs(norm[np.isfinite(norm)] - 1.0) > 1e-3):
                raise WindowError("attitude quaternions are not of unit length", "unit quaternions, scalar first")
        if not np.isfinite(self.log_span[0]):
            object.__setattr__(self, "log_span", (self.t0, self.t0 + self.dt * (len(rotor) - 1)))

    def __len__(self) -> int:
        return len(self.rotor_speed)

    @property
    def t(self) -> FloatArray:
        """Times of the rows [s], shape (n,)."""
        return np.asarray(self.t0 + self.dt * np.arange(len(self)), dtype=np.float64)

    def slice(self, start: int, stop: int) -> Window:
        """Returns rows `start` to `stop` (exclusive) as a window of the same log."""
        values = {name: getattr(self, name) for name in ("rotor_speed", "rotor_slope", *_MEASURED)}
        cut: dict[str, Any] = {name: rows[start:stop] for name, rows in values.items() if rows is not None}
        return replace(self, t0=self.t0 + self.dt * start, **cut)


def as_recording(windows: Sequence[Window]) -> Recording:
    """One recording of windows of one log, without the rows where nothing was measured.

    Raises:
        LogError: no window, or windows that overlap in time.
    """
    if not windows:
        raise LogError("no window", "at least one")
    if any(a.t[-1] >= b.t0 for a, b in pairwise(windows)):
        raise LogError("windows overlap in time", "windows of one log in rising order of time")
    channels = {}
    for name in CHANNELS:
        parts = [(w.t, getattr(w, name)) for w in windows if getattr(w, name, None) is not None]
        if parts:
            t, values = np.concatenate([p[0] for p in parts]), np.concatenate([p[1] for p in parts])
            measured = np.isfinite(values).all(axis=1)
            if measured.any():
                channels[name] = Channel(name, t[measured], values[measured], "window")
    return Recording(windows[0].name, "window", channels, grid=windows[0].dt)


def beginning(windows: Iterable[Window], longest: float, least: float = 1.0) -> tuple[list[Window], float]:
    """The first `longest` seconds of windows, and how long they are [s]; rests shorter than `least` are left out."""
    taken: list[Window] = []
    seconds = 0.0
    for window in windows:
        rows = int((longest - seconds) / window.dt)
        if rows < least / window.dt:
            break
        taken.append(window if len(window) <= rows else window.slice(0, rows))
        seconds += len(taken[-1]) * window.dt
    return taken, seconds


# --- Samples of one channel: how often, and which of them, were measured


INTERPOLATED = 0.5
"""Share of moving rows on straight lines above which they were interpolated; logs as they were measured have none, a
log whose lost rows were filled in a tenth, one brought from 10 to 100 Hz nine tenths."""


def sample_period(t: FloatArray) -> float:
    """Returns the sample period [s]: the mean of the steps up to 1.5 times the median one; NaN below two samples."""
    return period_of(t[1:] - t[:-1])


def period_of(steps: FloatArray) -> float:
    """As `sample_period`, of the steps between samples [s]."""
    if len(steps) == 0:
        return float("nan")
    low, high = float(steps.min()), float(steps.max())
    if low > 0.0 and high <= 1.5 * low:  # then the median leaves none out
        return float(np.add.reduce(steps) / len(steps))
    steps = steps[steps > 0.0]
    if len(steps) == 0:
        return float("nan")
    return float(np.mean(steps[steps <= 1.5 * median(steps)]))


def median(values: FloatArray) -> float:
    """Median of finite numbers, shape (n,), n > 0: numpy's to the bit, without the checks that cost more than it."""
    middle = len(values) // 2
    if len(values) % 2:
        return float(np.partition(values, middle)[middle])
    low, high = np.partition(values, [middle - 1, middle])[middle - 1 : middle + 1]
    return float((low + high) / 2.0)


def copied(values: FloatArray) -> BoolArray:
    """True for rows of (n, columns), from the second on, that equal the row before exactly, shape (n - 1,)."""
    return np.asarray(np.all(values[1:] == values[:-1], axis=1))


def true_runs(true: BoolArray) -> tuple[IndexArray, IndexArray]:
    """Places where each run of True in an array (n,) begins, and where it has ended, shapes (runs,)."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], true, [False]]).astype(np.int8)))
    return edges[::2], edges[1::2]


def fresh_rows(values: FloatArray) -> IndexArray:
    """Returns the rows that bring a new reading, where a log repeats each reading several times; else all rows.

    A slow estimate written at a fast rate is a staircase, half a step late when read as instants.  A reading counts as
    repeated only when that is the rule (median run of equal rows at least 2; of over fifty, nearly all alike); runs far
    longer than usual are kept, for they are a signal that rests.
    """
    if len(values) < 20:
        return np.arange(len(values))
    start = np.concatenate([[0], np.flatnonzero(~copied(values)) + 1])
    run = np.diff(np.append(start, len(values)))
    usual = median(run.astype(np.float64))
    rare = len(start) < 0.02 * len(values) and (len(start) < 20 or np.quantile(run, 0.9) > 1.5 * usual)
    if usual < 2.0 or rare:
        return np.arange(len(values))
    keep = np.repeat(run > 5.0 * usual, run)
    keep[start] = True
    return np.flatnonzero(keep)


def measured_rows(t: FloatArray, values: FloatArray) -> BoolArray:
    """Rows that were measured, shape (n,); the others were put on straight lines between them before they were logged.

    Measured numbers do not lie on a line with both neighbours in every column while they move; where more than
    `INTERPOLATED` of all steps that move lead on along one, only its ends were measured.

    Args:
        t: times [s], shape (n,).
        values: columns at these times, shape (n, k).
    """
    out, step = np.ones(len(t), dtype=bool), np.diff(t)
    if len(t) < 3 or step.min() <= 0.0:
        return out
    moved = np.diff(values, axis=0)
    slope = moved / step[:, None]
    # Printed digits may put a row off its line.
    room = 1e-3 * np.std(moved, axis=0) + 1e-6 * np.max(np.abs(values), axis=0)
    bend: FloatArray = np.abs(np.diff(slope, axis=0)) * step[1:, None]
    on_line = np.all(bend <= room, axis=1)
    moves = np.any(moved[1:] != 0.0, axis=1)
    if np.any(moves) and np.mean(on_line[moves]) > INTERPOLATED:
        out[1:-1] = ~on_line
    return out


def measured_period(t: FloatArray, values: FloatArray) -> float:
    """Period [s] at which `values` were measured, see `fresh_rows`, `measured_rows` and `sample_period`."""
    fresh = fresh_rows(values)
    rows = fresh[measured_rows(t[fresh], values[fresh])]
    repeated = len(fresh) < len(values)  # then a signal that rests, on the ground, tells of no rate
    moving = ~copied(values[rows]) if repeated else slice(None)
    return period_of(np.diff(t[rows])[moving])


# --- Faults of the data themselves, seen without any model: a sensor at the end of its range, rows that are copies
#
# Both bend every estimate, and a cause named from them would be a stand-in.  Copies are no measurements and are left
# out; what a saturated sensor would have shown is not known, so nothing found beside it is called confident.
#
# A saturated axis piles up at exactly its largest or smallest value, far more often than at the value beside it, and
# comes back to it again and again.  Coarse steps of a converter pile up nowhere in particular, and a motor at rest
# stays at its lowest command without coming back.


LEAST_COPIES = 0.03
"""Share of inertial rows that equal the row before exactly."""


class AtLimit(NamedTuple):
    """One end of one axis at its limit.

    Attributes:
        level: the value that is not left, in the unit of the values.
        share: of the column's finite samples.
    """

    axis: int
    level: float
    samples: int
    share: float


def at_limit(values: FloatArray) -> list[AtLimit]:
    """Returns the ends of axes that are saturated.

    Args:
        values: shape (n, axes), any unit; rows that are not finite do not count.
    """
    found = []
    for axis, column in enumerate(values.T):
        finite = column[np.isfinite(column)]
        levels, counts = np.unique(finite, return_counts=True)
        if len(levels) < 3:
            continue
        for end, beside in ((0, 1), (-1, -2)):
            count, share = int(counts[end]), float(counts[end] / len(finite))
            there = finite == levels[end]
            arrivals = np.count_nonzero(there[1:] & ~there[:-1])
            if share > 0.005 and count >= 6 and count > 4.0 * counts[beside] and arrivals >= 3:
                found.append(AtLimit(axis, float(levels[end]), count, share))
    return found


@dataclass(frozen=True)
class DataFault:
    """One fault of the data.

    Attributes:
        kind: ``saturated`` or ``repeated``.
        channel: name of the channel, with its axis where there is one.
        text: one sentence with what to do.
    """

    kind: str
    channel: str
    share: float
    text: str


def data_faults(windows: Sequence[Window]) -> tuple[DataFault, ...]:
    """Looks for saturated and repeated inertial samples in `windows`; a flight without such faults gives none."""
    out: list[DataFault] = []
    for name, unit in (("gyro", "rad/s"), ("accel", "m/s²")):
        parts = [values for w in windows if (values := getattr(w, name)) is not None]
        for axis, level, _, share in at_limit(np.concatenate(parts)) if parts else ():
            text = (
                f"{name} {'xyz'[axis]} stays at exactly {level:.4g} {unit} in {share:.1%} of the samples: the sensor "
                "saturates; log it with a wider range, or fly more gently"
            )
            out.append(DataFault("saturated", f"{name} {'xyz'[axis]}", share, text))
        share = sum(np.count_nonzero(copied(p)) for p in parts) / max(sum(max(len(p) - 1, 0) for p in parts), 1)
        if share >= LEAST_COPIES:
            text = (
                f"{share:.0%} of the {name} rows are exact copies of the row before and were left out: the sensor is "
                "slower than the log, or the link repeats what it has; "
                "log the sensor's own samples with their own times"
            )
            out.append(DataFault("repeated", name, float(share), text))
    return tuple(out)


def without_copies(windows: Sequence[Window]) -> list[Window]:
    """Windows in which inertial rows that equal the row before exactly count as not measured."""
    out = []
    for window in windows:
        changed = {}
        for name in ("gyro", "accel"):
            values = getattr(window, name)
            if values is None:
                continue
            copies = np.flatnonzero(copied(values)) + 1
            if len(copies) >= LEAST_COPIES * len(values):
                kept = values.copy()
                kept[copies] = np.nan
                changed[name] = kept
        out.append(replace(window, **changed) if changed else window)
    return out
