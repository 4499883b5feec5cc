"""Logs and vehicles of a piece of work: names to checked windows on a grid, parts, and repetitions."""

from __future__ import annotations

import math
import os
import re
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
import quadid_replay
from numpy.typing import NDArray
from quadid_replay import open_log

from quadid.app.over_time import OverTime
from quadid.data.grid import linear
from quadid.data.window import Recording, Window
from quadid.errors import LogError, QuadidError, VehicleError
from quadid.files import unwaited
from quadid.files import written_whole as whole
from quadid.sanitise import LONGEST_NAME
from quadid.types import FloatArray, IntArray
from quadid.vehicle import MOST_FLIGHTS, FittedFlight, Vehicle

if TYPE_CHECKING:
    import pandas as pd
    import xarray as xr

    from quadid.checks import Check
    from quadid.checks.motion import Spans
    from quadid.data.grid import GridReport


# --- Files written whole or not at all; files of users read without waiting for one that is none


class OutputError(QuadidError):
    """A place that cannot be written to."""


@contextmanager
def written_whole(target: Path) -> Iterator[Path]:
    """`quadid.files.written_whole`; raises OutputError where that cannot be done."""
    try:
        with whole(target) as part:
            yield part
    except OSError as error:
        raise OutputError(
            f"{target} cannot be written ({error.strerror})", fix="check permissions and free space"
        ) from error


def write_text(path: str | Path, text: str) -> Path:
    """Writes a file whole or not at all; into a pipe or device where one stands there. Returns its absolute path."""
    target = Path(path).absolute()
    with written_whole(target) as place, open(place, "w", encoding="utf-8", errors="replace", opener=unwaited) as file:
        file.write(text)
    return target


def make_folder(folder: Path, fix: str = "choose another folder") -> None:
    """Makes a folder where there is none; raises OutputError where it cannot be made."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(f"{folder} cannot be made ({error.strerror})", "a folder", fix) from error


_pipes: list[int] = []
"""Pipes to be written later: the reader of one ends when its last writer does."""


def check_place(file: Path, option: str, inside: bool = False) -> None:
    """Raises OutputError when a file to be written later cannot be.

    Args:
        option: what the user named it by; `inside`: or the folder that it will be in.
    """
    if file.is_dir():
        name = "report.html" if option == "--report" else "result.json"
        fix = "remove it, or choose another folder" if inside else f"name a file in it: {file / name}"
        raise OutputError(f"{option} {file} is a directory", "a file name", fix)
    folder = file.absolute().parent
    if not folder.is_dir():
        raise OutputError(f"{option}: no folder {folder}", "an existing folder", f"mkdir -p {folder}")
    if file.exists() and not file.is_file():
        try:
            _pipes.append(os.open(file, os.O_WRONLY | os.O_NONBLOCK))
        except OSError as error:
            raise OutputError(
                f"{option}: {file} is a pipe without a reader, or a socket ({error.strerror})",
                "a file",
                "choose another place, or start what reads the pipe",
            ) from error
    elif not os.access(file if file.exists() else folder, os.W_OK):
        raise OutputError(f"{option}: {file} is not writable", "a file you may write", "choose another place")


def check_folder(folder: Path, option: str, *names: str) -> Path:
    """Makes a folder where there is none; returns its absolute path.

    Args:
        names: patterns of files to be written later.

    Raises:
        OutputError: it cannot be made or written to, or holds a folder or a pipe under such a name.
    """
    make_folder(folder, f"choose another {option}")
    if not os.access(folder, os.W_OK | os.X_OK):
        raise OutputError(f"{folder} is not writable", "a folder you may write to", f"choose another {option}")
    for file in (found for name in names for found in folder.glob(name) if not found.is_file()):
        check_place(file, option, inside=True)
    return folder.resolve()


def write_texts(place: str | Path, texts: Mapping[str, str]) -> list[Path]:
    """Writes texts by file name into a folder, or the only one under the name that `place` is; returns absolute paths.

    A place is a file name where it has a suffix and is no folder.  All are looked at before the first is written.

    Raises:
        OutputError: several texts for one file, or a place that cannot be written to.
    """
    where = Path(place)
    if where.is_dir() or not where.suffix:
        make_folder(where)
        for name in texts:
            check_place(where / name, "file", inside=True)
        return [write_text(where / name, text) for name, text in texts.items()]
    if len(texts) != 1:
        raise OutputError(f"{where} is one file, this holds {len(texts)} files", "a folder", f"{where.parent}")
    return [write_text(where, text) for text in texts.values()]


def file_name(name: str) -> str:
    """A vehicle's name as part of a file name: letters, digits and ``-_+.`` only, at most 100 bytes."""
    kept = "".join(c if c.isalnum() or c in "-_+." else "_" for c in name).lstrip(".")
    return kept.encode()[:100].decode(errors="ignore") or "vehicle"


def free_name(folder: str | Path, name: str, ending: str, taken: Sequence[Path]) -> Path:
    """An absolute path that no other log of this run has; two logs of one name are distinguished by number."""
    whole = Path(folder).absolute()
    path, number = whole / f"{file_name(name)}.{ending}", 2
    while path in taken:
        path, number = whole / f"{file_name(name)}.{number}.{ending}", number + 1
    return path


# --- Parts of a log: those asked for as LOG@from:to, and those in the air


SPAN = "LOG@START:STOP in seconds, for example LOG@76:216"
_CUT = re.compile(r"(?P<path>.+)@(?P<start>[0-9.]*):(?P<stop>[0-9.]*)")


@dataclass(frozen=True)
class LogPart:
    """Part of a log that was asked for: seconds after its first IMU sample; None for open ends; units to be checked."""

    path: Path
    start: float | None = None
    stop: float | None = None
    checked: bool = True

    def span(self, recording: Recording) -> tuple[float, float]:
        """First and last time of the part [s], in the time of the recording; infinite for open ends."""
        zero = recording.first_imu_time
        low = -math.inf if self.start is None else zero + self.start
        return low, math.inf if self.stop is None else zero + self.stop

    def of(self, recording: Recording) -> Recording:
        """The part of a recording; raises LogError where that is empty."""
        if not self.asked:
            return recording
        low, high = self.span(recording)
        channels = {}
        for name, c in recording.channels.items():
            if (inside := (c.t >= low) & (c.t <= high)).any():
                channels[name] = replace(c, t=c.t[inside], values=c.values[inside])
        if not channels:
            # Nothing is there: which span was asked for, and which there is
            ends = {"after": self.start, "before": self.stop}
            asked = " and ".join(f"{side} {limit} s" for side, limit in ends.items() if limit is not None)
            if None not in ends.values():
                asked = f"between {self.start} and {self.stop} s"
            first, last = (t - recording.first_imu_time for t in recording.span)
            there = f", {first:.1f} to {last:.1f} s" if last > first else ""
            raise LogError(f"{recording.name}: nothing {asked}", f"a span inside the log{there}")
        return replace(recording, channels=channels, breaks=tuple(b for b in recording.breaks if low <= b <= high))

    @property
    def asked(self) -> bool:
        """A part was asked for, which is used as it is."""
        return self.start is not None or self.stop is not None

    def in_the_air(self, recording: Recording, flying: Spans) -> Spans:
        """Stretches in the air of a log that also stands on the ground [s, after its first IMU sample], else none.

        Args:
            flying: when it flies [s, in the time of the recording].
        """
        from quadid.checks import proposed_cuts

        imu = [c.t for n, c in recording.channels.items() if n in ("gyro", "accel") and len(c.t)]
        if not imu:
            return ()
        low, high = self.span(recording)
        first, last = max(low, recording.first_imu_time), min(high, max(float(t[-1]) for t in imu))
        inside = tuple((max(a, first), min(b, last)) for a, b in flying if b > first and a < last)
        begin = round(first - recording.first_imu_time, 1)
        return tuple((round(begin + a, 1), round(begin + b, 1)) for a, b in proposed_cuts(inside, first, last))

    def flown(self, recording: Recording, flying: Spans) -> Spans:
        """Stretches to use, as `in_the_air`, where no part was asked for."""
        return () if self.asked else self.in_the_air(recording, flying)

    def names(self, parts: Spans) -> list[str]:
        """Parts of the log as one asks for them: ``flight.bin@73.2:227.3``."""
        return [f"{self.path.name}@{a:g}:{b:g}" for a, b in parts]

    def standing(self, recording: Recording, flying: Spans) -> list[str]:
        """A sentence where a part that was asked for also stands on the ground, with the part that does not; else none.

        Who asks for all of a log, ``flight.bin@0:``, knows.
        """
        names = self.names(self.in_the_air(recording, flying)) if self.start or self.stop is not None else []
        told = f"this part also stands on the ground, which carries the vehicle: use {' '.join(names)}"
        return [told] if names else []


def parse_part(text: str, start: float | None = None, stop: float | None = None) -> LogPart:
    """Splits ``LOG@76:216`` into its parts, unless a file of that name exists; own limits go before the common ones."""
    found, (before, sign, _) = _CUT.fullmatch(text), text.rpartition("@")
    path = Path(text)
    if not path.exists():
        try:
            if found is not None:
                path, first, last = Path(found["path"]), found["start"], found["stop"]
                start, stop = float(first) if first else start, float(last) if last else stop
            elif sign and Path(before).exists():
                raise ValueError(text)
        except ValueError as error:
            raise LogError(f"cannot read the span of '{text}'", SPAN) from error
    if not all(limit is None or math.isfinite(limit) for limit in (start, stop)):
        raise LogError(f"{text}: a span from {start} to {stop} s", "seconds")
    if start is not None and stop is not None and not start < stop:
        raise LogError(f"{text}: a span from {start:g} to {stop:g} s", "start before stop", "swap them")
    return LogPart(path, start, stop)


def left_on_ground(names: Sequence[str]) -> str:
    """Used parts of a log that also stands on the ground, by the names of its parts, and how to use all of it."""
    whole = names[0].rpartition("@")[0]
    return f"time on the ground is left out: fits use {' '.join(names)}; to use all of it: {whole}@0:"


# --- From names of logs and vehicles to checked windows on a grid


GRID = 50.0
"""Rate of the grid unless asked otherwise [Hz], as in the paper."""
LONGEST = 3600.0
"""Excitation is computed from this much flight at most [s]."""


@dataclass(frozen=True)
class Log:
    """A log that was read, checked and brought onto the grid.

    Attributes:
        recording: as read, each channel at its own rate.
        vehicle: whose log it is; decides what the rotor columns mean.
        windows: on one grid, without gaps.
        grid: how the windows were made.
        cut: the part that is used.
        doubts: what looks wrong about units, frames, motors or clock, each with what to do.
        off: natural logarithm of estimate over truth by parameter if the worst of the doubts is right.
        flown: what is used of a log that also stands on the ground [s, after its first IMU sample]; empty: all of
            the part that was asked for.
    """

    path: Path
    recording: Recording
    vehicle: Vehicle
    windows: list[Window]
    grid: GridReport
    cut: LogPart
    doubts: tuple[str, ...] = ()
    flown: Spans = ()
    off: Mapping[str, float] = field(default_factory=dict)

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.recording.name

    @property
    def warnings(self) -> list[str]:
        """Problems of the log and its gridding, each with the log's name."""
        return [f"{self.path.name}: {text}" for text in (*self.recording.warnings, *self.doubts, *self.grid.notes)]

    def at(self, rate: float | None) -> Log:
        """The same log on a grid of another rate [Hz]; None for the log's own."""
        windows, grid = gridded(self.recording, self.vehicle, rate, self.cut, self.flown)
        return replace(self, windows=windows, grid=grid)

    def of(self, vehicle: str | Path | Vehicle) -> Log:
        """The same log read with another description of its vehicle: checked anew, on a grid of the same rate."""
        described = Vehicle.named(vehicle)
        if described == self.vehicle:
            return self
        return _read(self.path, self.recording, described, self.grid.rate, self.cut)

    def over_time(self) -> OverTime:
        """The channels that are used, on the grid, with the columns of a CSV (SI, FRD, NED)."""
        from quadid_replay.writers import column_names, recording_of, union_rows

        recording = recording_of(self.windows)
        layout = column_names(recording)
        t, rows = union_rows([recording.channels[name] for name in layout])
        values = {name: row for name, row in zip(layout, rows, strict=True) if row is not None}
        return OverTime(t, values, {n: _places(n, v.shape[1]) for n, v in values.items()}, layout)

    def to_frame(self) -> pd.DataFrame:
        """`over_time` as a pandas data frame: a row a time [s], columns as in a CSV."""
        return self.over_time().to_frame()

    def to_xarray(self) -> xr.Dataset:
        """`over_time` as an xarray data set, with gyro (t, axis), attitude (t, quaternion), rotor_speed (t, rotor)."""
        return self.over_time().to_xarray()

    def __repr__(self) -> str:
        used, whole = self.grid.seconds_used, self.grid.seconds_log
        head = f"{self.name}: {self.recording.format}, {used:.1f} of {whole:.1f} s used at {self.grid.rate:.4g} Hz"
        return "\n".join((f"{head}, vehicle {self.vehicle.name}", *(f"warning: {text}" for text in self.warnings)))


def _places(channel: str, width: int) -> tuple[str, Sequence[str | int]]:
    """Dimension of a channel's columns, and the label of each."""
    if channel in ("rotor_speed", "motor_command"):
        return "rotor", range(1, width + 1)
    return {3: ("axis", "xyz"), 4: ("quaternion", "wxyz")}.get(width, (channel + "_column", range(1, width + 1)))


def load(
    log: str | Path,
    vehicle: str | Path | Vehicle,
    *,
    rate: float | None = GRID,
    start: float | None = None,
    stop: float | None = None,
    preset: str = "auto",
    unchecked: bool = False,
    columns: Mapping[str, str] | None = None,
) -> Log:
    """Opens a log of any kind, checks it, and brings it onto the grid.

    Args:
        log: path, or path with a span as in ``flight.bin@76:216`` [s].
        vehicle: a shipped name, a YAML file or a `Vehicle`; decides what the rotor columns mean.
        rate: of the grid [Hz]; None for the log's own.
        start: first time to use [s], after the log's first IMU sample.
        stop: last time to use [s], likewise.
        preset: topic names of ROS logs.
        unchecked: use the log even when its units, frames or motors look wrong.
        columns: names in a CSV by names of the contract, as ``{"p": "gyro_x"}``; beside those of the vehicle file.

    Raises:
        LogError: not readable, in wrong units or frames, motors in another order, or nothing left of it.
        VehicleError: no such vehicle.
        NotIdentifiableError: no rotor signal that means anything.
    """
    from quadid_replay.opening import start as start_reading

    start_reading()
    described = Vehicle.named(vehicle)
    cut = replace(parse_part(str(log), start, stop), checked=not unchecked)
    recording = read_log(cut.path, preset, described, columns)
    require_gyro(recording)
    return _read(cut.path.resolve(), recording, described, rate, cut)


def read_log(
    path: Path, preset: str = "auto", vehicle: Vehicle | None = None, columns: Mapping[str, str] | None = None
) -> Recording:
    """Opens a log with the columns that a vehicle file names, and others; says where these are of no use.

    Args:
        path: of the log.
        preset: topic names of ROS logs.
        vehicle: whose file may name columns.
        columns: as of `load`.
    """
    recording = open_log(path, preset, {**({} if vehicle is None else vehicle.columns), **(columns or {})})
    if not columns or recording.format == "csv":
        return recording
    given = ", ".join(columns.values())
    note = f"columns are named for CSV ({given}), and this is {recording.format}: its channels are found by themselves"
    return replace(recording, warnings=(*recording.warnings, note))


def require_gyro(recording: Recording) -> None:
    """Raises LogError where a log has no gyro: nothing can be fitted to it."""
    if "gyro" not in recording.channels:
        unused = next((f"; {note}" for note in recording.warnings if note.startswith("columns not used")), "")
        raise LogError(
            f"{recording.name}: no gyro in the data{unused}",
            "p q r [rad/s]",
            "log the IMU at 50 Hz or faster, or name the columns of a CSV: --columns gyro_x=p,gyro_y=q,gyro_z=r",
        )


def write_recording(path: str | Path, recording: Recording) -> Path:
    """Writes a log as MCAP, tlog or CSV by suffix; returns its absolute path."""
    target = Path(path).absolute()
    with written_whole(target) as part:
        getattr(quadid_replay, f"write_{target.suffix.lower()[1:]}")(part, recording)
    return target


def _read(path: Path, recording: Recording, vehicle: Vehicle, rate: float | None, cut: LogPart) -> Log:
    """A log checked and on the grid."""
    checked = check_conventions(recording, vehicle, cut) if cut.checked else Checked()
    return on_grid(path, recording, vehicle, rate, cut, checked)


def on_grid(
    path: Path, recording: Recording, vehicle: Vehicle, rate: float | None, cut: LogPart, checked: Checked
) -> Log:
    """A checked log on the grid; of one that also stands on the ground, what is in the air."""
    doubts, flown, off = checked
    windows, report = gridded(recording, vehicle, rate, cut, flown)
    left_out = [left_on_ground(cut.names(flown))] if flown else []
    return Log(path, recording, vehicle, windows, report, cut, (*doubts, *left_out), flown, off)


def gridded(
    recording: Recording, vehicle: Vehicle, rate: float | None, cut: LogPart, flown: Spans
) -> tuple[list[Window], GridReport]:
    """Flown parts of a log, or the part that was asked for, on a grid of so many rows a second [Hz]."""
    from quadid.data.grid import grid_recording

    zero = recording.first_imu_time
    return grid_recording(recording, vehicle, rate, [(zero + a, zero + b) for a, b in flown] or [cut.span(recording)])


def parse_columns(texts: Sequence[str]) -> dict[str, str]:
    """Reads ``gyro_x=p`` (name in the file = name of the contract); returns ``{"p": "gyro_x"}``.

    Raises:
        LogError: a text of another form.
    """
    out = {}
    for text in ",".join(texts).split(","):
        given, sign, known = (part.strip() for part in text.partition("="))
        if text and not (given and sign and known):
            raise LogError(f"--columns {text}", "NAME_IN_FILE=NAME", "for example --columns gyro_x=p")
        if text:
            out[known] = given
    return out


class Checked(NamedTuple):
    """A log that means what is believed: what looks wrong but need not be, its parts to use, what may be off."""

    doubts: tuple[str, ...] = ()
    flown: Spans = ()
    off: Mapping[str, float] = MappingProxyType({})


def check_conventions(recording: Recording, vehicle: Vehicle, cut: LogPart) -> Checked:
    """Checks that a log means what its reader and the vehicle file believe, before anything is fitted to it.

    Args:
        cut: the part that is asked for; an error about a whole log proposes what is in the air.

    Raises:
        LogError: units, frames or a motor order that cannot be right; names the fix.
    """
    from quadid.checks import CheckResult, inspect
    from quadid.checks.findings import farthest

    found = inspect(recording, vehicle)
    flown = cut.flown(recording, found.flying)
    # Rotors at a speed that cannot carry this vehicle: what else is wrong about them is that of another one.
    stranger = next((c.message for c in found.checks if c.name == "hover" and c.verdict is CheckResult.WARNING), "")
    for check in found.checks:
        # A check without numbers could not be made; what comes next gives the better reason.
        if check.verdict is CheckResult.ERROR and check.numbers:
            fix = f"{check.fix}, or insist with --unchecked" if check.fix else "insist with --unchecked"
            of_rotors = stranger if check.name in ("motor_order", "rotor_timing") else ""
            fix = f"use the vehicle file of this log; else {fix}" if of_rotors else fix
            parts = " ".join(cut.names(flown))
            fix = f"{fix}; or leave out the ground: use {parts}" if parts else fix
            raise LogError(f"{recording.name}: {'; '.join(filter(None, (of_rotors, check.message)))}", fix=fix)
    doubts = (*doubts_of(found.checks), *cut.standing(recording, found.flying))
    return Checked(doubts, flown, farthest([check.off for check in found.checks]))


def doubts_of(checks: Sequence[Check]) -> list[str]:
    """Sentences of checks that warn or fail, each with its remedy."""
    return [f"{c.message}{'; ' * bool(c.fix)}{c.fix}" for c in checks if c.verdict.value in ("error", "warning")]


# --- Whether a flight was fitted before: the same log, a copy of it, a part of it, a second recorder
#
# Such a flight is no validation, and what a vehicle file learnt from it is no knowledge beside it.


Marks = NDArray[np.uint64]

RUN = 8
"""Gyro rows that must agree in a row: 24 numbers with sensor noise do not agree by chance."""
ROUNDED = 4
"""Decimals of the rates [rad/s] that are compared, so that a copy in another format agrees too."""
ALIKE = 0.8
"""Correlation of rates at the same date above which two recorders flew on one vehicle."""
SHORTEST = 2.0
"""Shortest common stretch that is called an overlap [s]."""
KEPT = 16
"""Runs of a fitted flight by which it is known again: those with the smallest hashes, wherever a part is cut."""
COMMON = 2
"""Of them so many in another log make it the same flight."""


def check_unseen(train: Sequence[Log], held: Sequence[Log], vehicle: Vehicle | None = None) -> None:
    """Raises LogError where a validation log holds flight that is fitted too, or that the file was fitted to."""
    for log in held:
        for other in train:
            seconds = max(common_rows(other, log), same_flight(other, log))
            if seconds > 0.0:
                raise LogError(
                    f"{log.name} cannot validate: {seconds:.1f} s of it are in {other.name}, which is fitted",
                    "a flight, or a part of one, that is not fitted",
                    "use another flight for --validate, or parts that do not overlap: LOG@0:60 --validate LOG@60:120",
                )
    for log in held:
        for flight in () if vehicle is None else fitted_before(vehicle, log):
            raise LogError(
                f"{log.name} cannot validate: {flight.log}, to which this vehicle file was fitted, is the same flight",
                "a flight that the file was not fitted to",
                "use another flight for --validate, or the vehicle file from before that fit",
            )


def without_own_priors(vehicle: Vehicle, train: Sequence[Log]) -> tuple[Vehicle, list[str]]:
    """The vehicle without standard deviations that come from the flights to be fitted, and a remark on it.

    A flight would count twice otherwise: as data, and as what was known before.
    """
    known = {log.name: flight for log in train for flight in fitted_before(vehicle, log)}
    if not known or all(p.sigma is None for p in vehicle.parameters.values()):
        return vehicle, []
    guesses = {n: p.model_copy(update={"sigma": None}) for n, p in vehicle.parameters.items()}
    told = ", ".join(name if name == flight.log else f"{name} ({flight.log})" for name, flight in known.items())
    return vehicle.model_copy(update={"parameters": guesses}), [
        f"the vehicle file was fitted to {told} already: its values start the fit, but its sigmas are not "
        "used, so that no flight counts twice"
    ]


def fitted_before(vehicle: Vehicle, log: Log) -> list[FittedFlight]:
    """Flights that the values of a vehicle file were fitted to and that this log holds, by content or by date."""
    fitted = () if vehicle.proof is None else vehicle.proof.fitted
    if not fitted:
        return []
    t, rates = gyro(log)
    here, epoch = _runs(rates), log.recording.epoch
    out = []
    for flight in fitted:
        marks = np.array([int(mark, 16) for mark in flight.marks.split()], dtype=np.uint64)
        alike = int(np.isin(marks, here).sum()) >= COMMON
        if not alike and flight.begin is not None and epoch is not None and len(t):
            begin, end = max(flight.begin, t[0] + epoch), min(flight.begin + flight.seconds, t[-1] + epoch)
            alike = end - begin >= SHORTEST
        out += [flight] if alike else []
    return out


def remembered(train: Sequence[Log], vehicle: Vehicle) -> tuple[FittedFlight, ...]:
    """The fitted flights, and those that the vehicle file rested on before, for a new file."""
    out = {}
    for log in train:
        t, rates = gyro(log)
        epoch = log.recording.epoch
        out[log.name] = FittedFlight(
            log=log.name[:LONGEST_NAME],
            seconds=round(float(np.ptp(t)), 2) if len(t) else 0.0,
            begin=None if epoch is None or not len(t) else round(epoch + float(t[0]), 2),
            marks=" ".join(f"{mark:016x}" for mark in np.unique(_runs(rates))[:KEPT].tolist()),
        )
    before = () if vehicle.proof is None else vehicle.proof.fitted
    return (*out.values(), *(flight for flight in before if flight.log not in out))[:MOST_FLIGHTS]


def common_rows(train: Log, held: Log) -> float:
    """Seconds of `held` whose gyro rows stand in `train` too, number by number."""
    (_, a), (t, b) = gyro(train), gyro(held)
    shared = np.isin(_runs(b), _runs(a))
    return (int(shared.sum()) + RUN - 1) * float(np.median(np.diff(t))) if shared.sum() > 1 else 0.0


def same_flight(train: Log, held: Log) -> float:
    """Seconds that both logs have in common by date, where their rates agree; else 0."""
    (s, a), (t, b) = gyro(train), gyro(held)
    begun = train.recording.epoch, held.recording.epoch
    if len(s) < 2 or len(t) < 2 or begun[0] is None or begun[1] is None:
        return 0.0
    t = t + (begun[1] - begun[0])
    inside = (t >= s[0]) & (t <= s[-1])
    common = float(np.ptp(t[inside])) if inside.any() else 0.0
    if common < SHORTEST:
        return 0.0
    again = linear(s, a, t[inside])
    here = b[inside] - b[inside].mean(axis=0)
    again = again - again.mean(axis=0)
    size = math.sqrt(float(np.sum(here**2)) * float(np.sum(again**2)))
    return common if size > 0.0 and float(np.sum(here * again)) / size > ALIKE else 0.0


def gyro(log: Log) -> tuple[FloatArray, FloatArray]:
    """Times [s] and rates [rad/s] (n, 3) inside the part of a log that is used."""
    channel = log.recording.channels.get("gyro")
    if channel is None:
        return np.zeros(0), np.zeros((0, 3))
    low, high = log.cut.span(log.recording)
    used = (channel.t >= low) & (channel.t <= high) & np.isfinite(channel.values).all(axis=1)
    return channel.t[used], channel.values[used]


def _runs(rates: FloatArray) -> Marks:
    """Hashes of the `RUN` rows that begin at each row, but for those in which a sensor does not move."""
    if len(rates) < RUN:
        return np.zeros(0, dtype=np.uint64)
    rounded: IntArray = np.rint(rates * 10.0**ROUNDED).astype(np.int64)
    changes = np.cumsum(np.vstack([np.zeros((1, 3), dtype=np.int64), np.diff(rounded, axis=0) != 0]), axis=0)
    moving = np.all(changes[RUN - 1 :] > changes[: len(changes) - RUN + 1], axis=1)
    axes: Marks = rounded.view(np.uint64)
    rows = _mixed(axes[:, 0] + _mixed(axes[:, 1] + _mixed(axes[:, 2] + np.uint64(1))))
    out = np.zeros(len(rows) - RUN + 1, dtype=np.uint64)
    for k in range(RUN):
        out = _mixed(out + rows[k : k + len(out)])
    return out[moving]


def _mixed(x: Marks) -> Marks:
    """A hash of 64 bits (the finaliser of splitmix64, Steele, Lea and Flood, OOPSLA 2014)."""
    x = (x ^ (x >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    x = (x ^ (x >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return x ^ (x >> np.uint64(31))


# --- Which logs and which vehicle a piece of work is about


Flight = str | Path | Log
"""A log: its path, with a span if wanted, or as `quadid.load` returns it."""
Given = Flight | Sequence[Flight]
"""A log or several."""


def listed(logs: Given) -> list[Flight]:
    """Logs as a list."""
    return [logs] if isinstance(logs, str | Path | Log) else list(logs)


def vehicle_of(logs: Sequence[Flight], vehicle: str | Path | Vehicle | None) -> Vehicle:
    """The vehicle that is asked for, else that of the first loaded log.

    Raises:
        VehicleError: no such vehicle, or only paths of logs, which do not say whose they are.
    """
    if vehicle is not None:
        return Vehicle.named(vehicle)
    for log in logs:
        if isinstance(log, Log):
            return log.vehicle
    raise VehicleError(
        f"no vehicle for {logs[0]}",
        "a shipped name, a YAML file or a Vehicle",
        'give vehicle="...", or a log from quadid.load(path, vehicle="...")',
    )


def read(logs: Given, vehicle: Vehicle) -> list[Log]:
    """Logs as a list, read with this description of the vehicle: checked, and on the grid.

    Raises:
        LogError: a log that cannot be read or does not fit the vehicle.
    """
    return [log.of(vehicle) if isinstance(log, Log) else load(log, vehicle) for log in listed(logs)]


@dataclass(frozen=True)
class Settled:
    """Subject of a piece of work.

    Attributes:
        vehicle: as described, without priors that come from the flights to fit.
    """

    vehicle: Vehicle
    train: list[Log]
    held: list[Log]
    notes: list[str]

    @property
    def warnings(self) -> list[str]:
        """The notes, and what is wrong with the logs."""
        found = [*self.notes, *(text for log in (*self.train, *self.held) for text in log.warnings)]
        return list(dict.fromkeys(found))  # parts of one log repeat them


def settled(logs: Given, validate: Given, vehicle: str | Path | Vehicle | None) -> Settled:
    """The vehicle, and the logs to fit and to score, all read with its description.

    Raises:
        LogError: no log, or a log to score that is fitted too, or that the vehicle file was fitted to.
        VehicleError: no such vehicle, or only paths of logs and none that says whose they are.
    """
    given = listed(logs)
    if not given:
        raise LogError("no log", "at least one, a path or from quadid.load", "give a log")
    described = vehicle_of(given, vehicle)
    train, held = read(given, described), read(validate, described)
    check_unseen(train, held, described)
    described, notes = without_own_priors(described, train)
    return Settled(described, train, held, notes)
