"""From names of logs and vehicles to checked windows on a grid."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from quadid.errors import LogError, VehicleError
from quadid_workflow.files import read_regular
from quadid_workflow.log_parts import LogPart, flown_parts, left_on_ground, names_of, parse_part

if TYPE_CHECKING:
    from quadid.grid import GridReport
    from quadid.inspection.airborne import Spans
    from quadid.vehicle import Vehicle
    from quadid.window import Recording, Window

_FILL_IN = "FILL IN"
"""Marks the guesses of `quadid init`."""
GRID = 50.0
"""Rate of the grid unless asked otherwise [Hz], as in the paper."""
LONGEST = 3600.0
"""Excitation is computed from this much flight at most [s]."""


@dataclass(frozen=True)
class Log:
    """A log that was read, checked and brought onto the grid.

    Attributes:
        path: absolute path.
        recording: as read, each channel at its own rate.
        vehicle: whose log it is; says what the rotor columns mean.
        windows: on one grid, without gaps.
        grid: how the windows were made.
        cut: the part that is used.
        doubts: what looks wrong about units, frames, motors or clock, each with what to do.
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

    @property
    def name(self) -> str:
        """Name of the file."""
        return self.recording.name

    @property
    def warnings(self) -> list[str]:
        """What was wrong with the log and its gridding, each with the log's name."""
        return [f"{self.path.name}: {text}" for text in (*self.recording.warnings, *self.doubts, *self.grid.notes)]

    def at(self, rate: float | None) -> Log:
        """The same log on a grid of another rate [Hz]; None for the log's own."""
        windows, grid = gridded(self.recording, self.vehicle, rate, self.cut, self.flown)
        return replace(self, windows=windows, grid=grid)

    def of(self, vehicle: str | Path | Vehicle) -> Log:
        """The same log read with another description of its vehicle: checked anew, on a grid of the same rate."""
        described = as_vehicle(vehicle)
        if described == self.vehicle:
            return self
        return _read(self.path, self.recording, described, self.grid.rate, self.cut)

    def __repr__(self) -> str:
        used, whole = self.grid.seconds_used, self.grid.seconds_log
        head = f"{self.name}: {self.recording.format}, {used:.1f} of {whole:.1f} s used at {self.grid.rate:.4g} Hz"
        return "\n".join((f"{head}, vehicle {self.vehicle.name}", *(f"warning: {text}" for text in self.warnings)))


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
        data = read_regular(path)
    except FileNotFoundError as error:
        raise VehicleError(f"no vehicle file {name}", "a shipped name or a YAML file", "check the path") from error
    except OSError as error:
        raise VehicleError(f"{name} cannot be read ({error.strerror})", fix="check its permissions") from error
    try:
        text = data.decode("utf-8")
        blanks = [line.split(":")[0].strip(" -#") for line in text.splitlines() if _FILL_IN in line]
        if blanks:
            raise VehicleError(
                f"{name}: {' and '.join(blanks)} {'is a guess' if len(blanks) == 1 else 'are guesses'} of "
                f"`quadid init`, marked {_FILL_IN}", "measured values",
                f"write your vehicle's and delete the words {_FILL_IN}",
            )  # fmt: skip
        return Vehicle.from_yaml(text, path.name)
    except UnicodeDecodeError as error:
        raise VehicleError(f"{name}: not text", "a YAML file", "if this is the log, pass it as LOG") from error


def as_vehicle(vehicle: str | Path | Vehicle) -> Vehicle:
    """The vehicle itself, or as `load_vehicle` has it."""
    return load_vehicle(str(vehicle)) if isinstance(vehicle, str | Path) else vehicle


def load(
    log: str | Path, vehicle: str | Path | Vehicle, *, rate: float | None = GRID, start: float | None = None,
    stop: float | None = None, preset: str = "auto", unchecked: bool = False, columns: Mapping[str, str] | None = None,
) -> Log:  # fmt: skip
    """Opens a log of any kind, checks it, and brings it onto the grid.

    Args:
        log: path, or path with a span as in ``flight.bin@76:216`` [s].
        vehicle: a shipped name, a YAML file or a `Vehicle`; says what the rotor columns mean.
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
    from quadid_replay.reading import start as start_reading

    start_reading()
    described = as_vehicle(vehicle)
    cut = replace(parse_part(str(log), start, stop), checked=not unchecked)
    recording = open_recording(cut.path, preset, {**described.columns, **(columns or {})})
    require_gyro(recording)
    return _read(cut.path.resolve(), recording, described, rate, cut)


def require_gyro(recording: Recording) -> None:
    """Raises LogError where a log has no gyro: nothing can be fitted to it."""
    if "gyro" not in recording.channels:
        unused = next((f"; {note}" for note in recording.warnings if note.startswith("columns not used")), "")
        raise LogError(
            f"{recording.name}: no gyro in the data{unused}", "p q r [rad/s]",
            "log the IMU at 50 Hz or faster, or name the columns of a CSV: --columns gyro_x=p,gyro_y=q,gyro_z=r",
        )  # fmt: skip


def open_recording(path: Path, preset: str = "auto", columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a log of any kind."""
    from quadid_replay import open_log

    return open_log(path, preset, columns)


def write_recording(path: str | Path, recording: Recording) -> Path:
    """Writes a log as MCAP, tlog or CSV by suffix; returns its absolute path."""
    import quadid_replay

    kind = Path(path).suffix.lower()[1:]
    getattr(quadid_replay, f"write_{kind}")(path, recording)
    return Path(path).absolute()


def _read(path: Path, recording: Recording, vehicle: Vehicle, rate: float | None, cut: LogPart) -> Log:
    """A log checked and on the grid."""
    checked = check_conventions(recording, vehicle, cut) if cut.checked else Checked()
    return on_grid(path, recording, vehicle, rate, cut, checked)


def on_grid(
    path: Path, recording: Recording, vehicle: Vehicle, rate: float | None, cut: LogPart, checked: Checked
) -> Log:
    """A checked log on the grid; of one that also stands on the ground, what is in the air."""
    doubts, flown = checked
    windows, report = gridded(recording, vehicle, rate, cut, flown)
    left_out = [left_on_ground(names_of(cut, flown))] if flown else []
    return Log(path, recording, vehicle, windows, report, cut, (*doubts, *left_out), flown)


def gridded(
    recording: Recording, vehicle: Vehicle, rate: float | None, cut: LogPart, flown: Spans
) -> tuple[list[Window], GridReport]:
    """What is flown of a log, or the part that was asked for, on a grid of so many rows a second [Hz]."""
    from quadid.grid import grid_recording

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
    """A log that means what is believed: what looks wrong but need not be, and its parts to use (`Log.flown`)."""

    doubts: tuple[str, ...] = ()
    flown: Spans = ()


def check_conventions(recording: Recording, vehicle: Vehicle, cut: LogPart) -> Checked:
    """Checks that a log means what its reader and the vehicle file believe, before anything is fitted to it.

    Args:
        recording: the whole log.
        vehicle: whose log it is.
        cut: the part that is asked for; an error about a whole log proposes what is in the air.

    Raises:
        LogError: units, frames or a motor order that cannot be right; names the fix.
    """
    from quadid.inspection import FATAL, CheckResult, inspect

    found, doubts = inspect(recording, vehicle), []
    flown = flown_parts(recording, found.flying, cut)
    # Rotors at a speed that cannot carry this vehicle: what else is wrong about them is that of another one.
    stranger = next((c.message for c in found.checks if c.name == "hover" and c.verdict is CheckResult.WARNING), "")
    for check in found.checks:
        # A check without numbers could not be made; what comes next says why, and better.
        if check.verdict is CheckResult.ERROR and check.name in FATAL and check.numbers:
            fix = f"{check.fix}, or insist with --unchecked" if check.fix else "insist with --unchecked"
            of_rotors = stranger if check.name in ("motor_order", "rotor_timing") else ""
            fix = f"use the vehicle file of this log; else {fix}" if of_rotors else fix
            parts = " ".join(names_of(cut, flown))
            fix = f"{fix}; or leave out the ground: use {parts}" if parts else fix
            raise LogError(f"{recording.name}: {'; '.join(filter(None, (of_rotors, check.message)))}", fix=fix)
        if check.verdict in (CheckResult.ERROR, CheckResult.WARNING):
            doubts.append(f"{check.message}{'; ' * bool(check.fix)}{check.fix}")
    return Checked(tuple(doubts), flown)
