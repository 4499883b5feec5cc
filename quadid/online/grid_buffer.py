"""Rows of the grid: a live stream read on it, the last seconds kept, and windows cut from them."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from quadid.data.grid import GAP, OPTIONAL, REQUIRED, ChannelTrack, GridPlan, on_grid, split_stretches
from quadid.data.window import Sampling, Window, true_runs
from quadid.types import BoolArray, FloatArray

# --- Rows of the grid, and channels of a live stream read on them


@dataclass(frozen=True)
class Rows:
    """Consecutive rows of the grid.

    Attributes:
        t: times [s], shape (n,).
        columns: values by channel, NaN where nothing was measured; only channels that say something.
        sampling: meaning of the rotor rows; source: where the rotor speeds come from.
        fresh: True when the grid was anchored anew before the first row: nothing may be joined across.
        problem: why there are no rotor speeds, or empty.
        spacing: time between two readings of the rotors [rows].
        new_clock: True where it was anchored anew because a new time base began: another run of the vehicle, maybe.
    """

    t: FloatArray
    columns: dict[str, FloatArray]
    sampling: Sampling
    source: str
    fresh: bool = False
    problem: str = ""
    spacing: float = 1.0
    new_clock: bool = False


def columns_on_grid(plan: GridPlan, at: FloatArray) -> dict[str, FloatArray]:
    """Values of the channels of a plan by name, NaN where nothing was measured.

    Optional channels that say nothing in these rows are left out.

    Args:
        plan: tracks around the rows.
        at: times of the rows [s], shape (n,).
    """
    columns = {}
    for name in (*REQUIRED, *OPTIONAL):
        if name not in plan.tracks:
            continue
        values = on_grid(name, _mended(plan.tracks[name], plan.step), at, plan)
        if name in REQUIRED or not np.isnan(values).all():
            columns[name] = values
    return columns


def _mended(track: ChannelTrack, step: float) -> ChannelTrack:
    """The track with stretches joined where only a few packets of a fast stream were lost.

    They are no gap while samples come within two grid steps: the low-pass reaches over twice as far.
    """
    longest = 2.05 * step
    if len(track.stretches) < 2 or GAP * track.period >= longest:
        return track
    return replace(track, stretches=tuple(split_stretches(track.t, longest)))


# --- The last seconds of grid rows, and windows cut from them


SHORTEST = 2.0
"""A stretch without gaps shorter than this [s] is left out of a window."""
COMPLETE = 0.8
"""A window needs this share of its time in usable stretches."""


@dataclass(frozen=True)
class WindowCut:
    """Result of cutting one window.

    Attributes:
        windows: stretches without gaps, in order.
        seconds: time in them [s].
        gaps: number of places where the rows were cut.
        reason: what is wrong with them, empty when they are complete.
        blocked: whether that will not pass by itself.
        spacing: longest time between two readings of the rotors in it [rows].
    """

    windows: tuple[Window, ...]
    seconds: float
    gaps: int
    reason: str = ""
    blocked: bool = False
    spacing: float = 1.0


class GridBuffer:
    """Rows of the last `seconds`, one array a channel."""

    def __init__(self, rate: float, seconds: float) -> None:
        """Keeps `seconds` of rows of a grid of `rate` [Hz]."""
        self._step = 1.0 / rate
        self._most = round(seconds * rate)
        self._blocks: list[Rows] = []
        self._kept = 0

    @property
    def start(self) -> float:
        """Time of the oldest row [s]; infinite before there is one."""
        return float(self._blocks[0].t[0]) if self._blocks else math.inf

    def add(self, rows: Rows) -> None:
        """Appends a block of rows and forgets the oldest."""
        self._blocks.append(rows)
        self._kept += len(rows.t)
        while self._kept - len(self._blocks[0].t) >= self._most:
            self._kept -= len(self._blocks.pop(0).t)

    def _reaching(self, start: float, stop: float) -> list[Rows]:
        """Blocks with a row between the two, or on either side of them."""
        return [b for b in self._blocks if b.t[-1] >= start and b.t[0] < stop]

    def span(self, start: float, stop: float) -> Rows | None:
        """Rows with start <= t < stop, whatever they hold; None when there are none."""
        blocks = self._reaching(start, stop)
        if not blocks:
            return None
        t, columns = _joined(blocks)
        inside = (t >= start) & (t < stop)
        if not inside.any():
            return None
        some, last = {name: values[inside] for name, values in columns.items()}, blocks[-1]
        return Rows(t[inside], some, last.sampling, last.source, blocks[0].fresh, last.problem)

    def onset(self, near: float) -> float:
        """Moment of a step in specific force per squared rotor speed within 1 s of `near` [s], to a row."""
        rows = self.span(near - 1.5, near + 1.5)
        if rows is None or "accel" not in rows.columns:
            return near
        with np.errstate(divide="ignore", invalid="ignore"):
            ratio = -rows.columns["accel"][:, 2] / np.sum(rows.columns["rotor_speed"] ** 2, axis=1)
        good = np.isfinite(ratio)
        t, y = rows.t[good], ratio[good]
        if len(t) < 20:
            return near
        n = np.arange(1, len(t))
        total, squares = np.cumsum(y), np.cumsum(y * y)
        left = squares[:-1] - total[:-1] ** 2 / n
        right = squares[-1] - squares[:-1] - (total[-1] - total[:-1]) ** 2 / (len(t) - n)
        inside = np.abs(t[1:] - near) <= 1.0
        return float(t[1:][inside][np.argmin((left + right)[inside])]) if inside.any() else near

    def cut(self, start: float, stop: float) -> WindowCut:
        """Windows of the rows with start <= t < stop."""
        blocks = self._reaching(start, stop)
        problem = blocks[-1].problem if blocks else ""  # what lacked before and came passes by itself
        pieces: list[list[Rows]] = []
        for block in blocks:
            before = pieces[-1][-1] if pieces else None
            if before is None or block.fresh or (before.sampling, before.source) != (block.sampling, block.source):
                pieces.append([])
            pieces[-1].append(block)
        windows = [window for piece in pieces for window in self._windows(piece, start, stop)]
        seconds = sum(len(w) for w in windows) * self._step
        gaps = max(len(windows) - 1, 0)
        reason, blocked = self._incomplete(seconds, stop - start, problem, blocks)
        spacing = max((b.spacing for b in blocks), default=1.0)
        return WindowCut(tuple(windows), seconds, gaps, reason, blocked, spacing)

    def _incomplete(self, seconds: float, wanted: float, problem: str, blocks: list[Rows]) -> tuple[str, bool]:
        if seconds >= COMPLETE * wanted - 0.5 * self._step:
            return "", False
        if problem:
            return problem, True
        if blocks and all("gyro" not in b.columns or np.isnan(b.columns["gyro"]).all() for b in blocks):
            return "no gyro in the data; allowed: angular rates [rad/s] at 20 Hz or more; fix: connect the IMU", True
        return f"{seconds:.1f} s of usable data in the last {wanted:.3g} s", False

    def _windows(self, piece: list[Rows], start: float, stop: float) -> list[Window]:
        t, columns = _joined(piece)
        if "gyro" not in columns:
            return []
        good: BoolArray = np.isfinite(columns["rotor_speed"]).all(axis=1) & (t >= start) & (t < stop)
        good &= _bridged(np.asarray(np.isfinite(columns["gyro"]).all(axis=1)))
        out = []
        for a, b in zip(*true_runs(good), strict=True):
            if (b - a) * self._step < SHORTEST - 0.5 * self._step:
                continue
            cut: dict[str, Any] = {
                n: v[a:b] for n, v in columns.items() if n == "rotor_speed" or np.isfinite(v[a:b]).any()
            }
            out.append(Window(float(t[a]), self._step, **cut, sampling=piece[0].sampling, name="live"))
        return out


def _joined(blocks: list[Rows]) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Times of blocks one after the other, and values by channel, NaN where a block has no such channel."""
    columns = {}
    for name, width in {name: values.shape[1] for b in blocks for name, values in b.columns.items()}.items():
        parts = [b.columns[name] if name in b.columns else np.full((len(b.t), width), math.nan) for b in blocks]
        columns[name] = np.concatenate(parts)
    return np.concatenate([b.t for b in blocks]), columns


def _bridged(good: BoolArray) -> BoolArray:
    """Short holes count as good: the model simply has no measurement there."""
    out = good.copy()
    for a, b in zip(*true_runs(~good), strict=True):
        if b - a <= 3 and a > 0 and b < len(good):
            out[a:b] = True
    return out
