"""From names on the command line to a vehicle and to windows on a grid."""

from __future__ import annotations

import math
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from quadid.errors import LogError, VehicleError

if TYPE_CHECKING:
    from quadid.grid import GridReport
    from quadid.vehicle import Vehicle
    from quadid.window import Recording, Window

_CUT = re.compile(r"(?P<path>.+)@(?P<start>[0-9.]*):(?P<stop>[0-9.]*)")
_LARGEST_VEHICLE_FILE = 1 << 20
LONGEST = 3600.0
"""Excitation is computed from this much flight at most [s]."""
_FATAL = ("gravity", "gyro_attitude", "velocity_attitude", "hover", "motor_order")
"""Checks of units, frames and motors; what fails them would give numbers that look fine and mean nothing."""


@dataclass(frozen=True)
class Cut:
    """Part of a log that was asked for: seconds after its first IMU sample; None for open ends."""

    path: Path
    start: float | None = None
    stop: float | None = None


@dataclass(frozen=True)
class Log:
    """A log on the grid.

    Attributes:
        path: absolute path.
        recording: as read, each channel at its own rate.
        windows: on one grid, without gaps.
        grid: how the windows were made.
        doubts: what looks wrong about units, frames, motors or clock, each with what to do.
    """

    path: Path
    recording: Recording
    windows: list[Window]
    grid: GridReport
    doubts: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """What was wrong with the log and its gridding, each with the log's name."""
        return [f"{self.path.name}: {text}" for text in (*self.recording.warnings, *self.doubts, *self.grid.notes)]


def load_vehicle(name: str) -> Vehicle:
    """Loads a vehicle file, or the shipped vehicle of that name.

    Raises:
        VehicleError: no such file or name, or a file that describes no vehicle.
    """
    from quadid.vehicle import Vehicle

    path = Path(name)
    looks_like_file = path.suffix.lower() in (".yaml", ".yml") or "/" in name
    if not looks_like_file and not path.is_file():
        return Vehicle.shipped(name)
    if path.is_dir():
        raise VehicleError(f"{name} is a directory", "a shipped name or a YAML file", "name the file in it")
    try:
        with path.open("rb") as file:
            data = file.read(_LARGEST_VEHICLE_FILE)
    except FileNotFoundError as error:
        raise VehicleError(f"no vehicle file {name}", "a shipped name or a YAML file", "check the path") from error
    except OSError as error:
        raise VehicleError(f"{name} cannot be read ({error.strerror})", fix="check its permissions") from error
    try:
        return Vehicle.from_yaml(data.decode("utf-8"), path.name)
    except UnicodeDecodeError as error:
        raise VehicleError(f"{name}: not text", "a YAML file", "is this the log? give it as LOG") from error


def parse_cut(text: str, start: float | None = None, stop: float | None = None) -> Cut:
    """Splits ``LOG@76:216`` into its parts, unless a file of that name exists; own limits go before the common ones."""
    found = _CUT.fullmatch(text)
    if found is None or Path(text).exists():
        cut = Cut(Path(text), start, stop)
    else:
        try:
            own = [float(found[key]) if found[key] else None for key in ("start", "stop")]
        except ValueError as error:
            raise LogError(
                f"cannot read the span of '{text}'", "LOG@START:STOP in seconds, for example LOG@76:216"
            ) from error
        cut = Cut(Path(found["path"]), start if own[0] is None else own[0], stop if own[1] is None else own[1])
    for limit in (cut.start, cut.stop):
        if limit is not None and not math.isfinite(limit):
            raise LogError(f"{text}: a span from {cut.start} to {cut.stop} s", "seconds")
    if cut.start is not None and cut.stop is not None and not cut.start < cut.stop:
        raise LogError(f"{text}: a span from {cut.start:g} to {cut.stop:g} s", "start before stop", "swap them")
    return cut


def load_log(
    text: str, vehicle: Vehicle, rate: float | None, start: float | None = None, stop: float | None = None,
    preset: str = "auto", unchecked: bool = False,
) -> Log:  # fmt: skip
    """Opens a log and brings it onto the grid.

    Args:
        text: path, or path with a span as in `parse_cut`.
        vehicle: says what the rotor columns mean.
        rate: of the grid [Hz]; None for the log's own.
        start: first time to use [s], after the log's first IMU sample.
        stop: last time to use [s], likewise.
        preset: topic names of ROS logs.
        unchecked: use the log even when its units or frames look wrong.

    Raises:
        LogError: not readable, in wrong units or frames, or nothing left of it.
        NotIdentifiableError: no rotor signal that means anything.
    """
    from quadid_replay import open_log

    from quadid.grid import grid_recording

    cut = parse_cut(text, start, stop)
    recording = open_log(cut.path, preset)
    doubts = () if unchecked else check_conventions(recording, vehicle)
    zero = first_imu_time(recording)
    limits = [None if limit is None else zero + limit for limit in (cut.start, cut.stop)]
    windows, report = grid_recording(recording, vehicle, rate, limits[0], limits[1])
    return Log(cut.path.resolve(), recording, windows, report, doubts)


def load_logs(
    texts: Sequence[str], vehicle: Vehicle, rate: float | None, start: float | None = None, stop: float | None = None,
    preset: str = "auto", unchecked: bool = False,
) -> list[Log]:  # fmt: skip
    """Opens several logs, see `load_log`."""
    return [load_log(text, vehicle, rate, start, stop, preset, unchecked) for text in texts]


def beginning(windows: Iterable[Window], longest: float) -> tuple[list[Window], float]:
    """The first `longest` seconds of windows, and how long they are [s]; rests of less than a second are left out."""
    taken: list[Window] = []
    seconds = 0.0
    for window in windows:
        rows = int((longest - seconds) / window.dt)
        if rows < 1.0 / window.dt:
            break
        taken.append(window if len(window) <= rows else window.slice(0, rows))
        seconds += len(taken[-1]) * window.dt
    return taken, seconds


def check_conventions(recording: Recording, vehicle: Vehicle) -> tuple[str, ...]:
    """Checks that a log means what its reader and the vehicle file believe, before anything is fitted to it.

    Returns:
        What looks wrong but need not be.

    Raises:
        LogError: units, frames or a motor order that cannot be right; names the fix.
    """
    from quadid.inspection import Verdict, inspect

    doubts = []
    for check in inspect(recording, vehicle).checks:
        # A check without numbers could not be made; what comes next says why, and better.
        if check.verdict is Verdict.ERROR and check.name in _FATAL and check.numbers:
            fix = f"{check.fix}, or insist with --unchecked" if check.fix else "insist with --unchecked"
            raise LogError(f"{recording.name}: {check.message}", fix=fix)
        if check.verdict in (Verdict.ERROR, Verdict.WARNING):
            doubts.append(f"{check.message}{'; ' * bool(check.fix)}{check.fix}")
    return tuple(doubts)


def first_imu_time(recording: Recording) -> float:
    """Time [s] of the first gyro or accelerometer sample, else of the first sample of any channel."""
    imu = [float(c.t[0]) for n, c in recording.channels.items() if n in ("gyro", "accel") and len(c.t)]
    rest = [float(c.t[0]) for c in recording.channels.values() if len(c.t)]
    return min(imu or rest, default=0.0)
