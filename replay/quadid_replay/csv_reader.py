"""CSV of the contract: a header row, `t` [s], then any of the known columns, SI, world NED, body FRD."""

import re
from array import array
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import islice
from pathlib import Path

import numpy as np

from quadid.data.window import COINCIDENT, Channel, Recording, sample_period
from quadid.errors import LogError, nearest
from quadid.sanitise import plain
from quadid.types import FloatArray
from quadid_replay.columns import LogClock, RawChannel, assemble, from_euler
from quadid_replay.formats import HEAD_BYTES, header_line

GROUPS: dict[str, tuple[str, ...]] = {
    "gyro": ("p", "q", "r"),
    "accel": ("ax", "ay", "az"),
    "attitude": ("qw", "qx", "qy", "qz"),
    "velocity": ("vx", "vy", "vz"),
    "position": ("x", "y", "z"),
    "battery": ("battery",),
    "attitude_reference": ("phi_ref", "theta_ref", "psi_ref", "throttle"),
}
EULER = ("phi", "theta", "psi")
_ROTOR = {"rotor_speed": re.compile(r"w([1-9]\d?)"), "motor_command": re.compile(r"u([1-9]\d?)")}
_MOTOR_LIKE = re.compile(r"(?:pwm|motor|mot|esc|rpm|cmd|servo|out|m)_?([1-9]\d?)", re.IGNORECASE)
_SLOWEST_ROW, _FEW_ROWS = 0.9, 20
"""Rows further apart [s] are in another unit of time; fewer rows are not judged."""
_LINES = 4096


def read_csv(path: Path, columns: Mapping[str, str] | None = None) -> Recording:
    """Reads a CSV log.

    Args:
        columns: names in this file for those of the contract, such as ``{"p": "gyro_x"}``.

    Raises:
        LogError: no header, a column group that is incomplete, a name that is not there, or no usable row.
    """
    names, delimiter = _header(path, columns or {})
    layout, ignored = _layout(names, path.name)
    table, notes = _table(path, len(names), delimiter)
    if len(table) == 0:
        raise _no_rows(path, names, delimiter)
    motors = [m for name in ignored if (m := _MOTOR_LIKE.fullmatch(name))]
    if motors:
        given = ",".join(f"{m[0]}=u{m[1]}" for m in motors[:8])
        notes.append(f"columns that look like motors are not used: --columns {plain(given)} (w1 … for speeds [rad/s])")
    elif ignored:
        notes.append(f"columns not used: {plain(', '.join(ignored))} ({nearest(ignored[0], _known())})")
    _check_seconds(table[:, names.index("t")], path.name)
    clock = LogClock()
    t = clock.times(table[:, names.index("t")])
    raw = []
    for name, group in layout.items():
        values = table[:, [names.index(c) for c in group]]
        blank = np.isnan(values).all(axis=1)  # an empty cell means: nothing measured in this row
        if group == EULER:
            _check_radians(values, path.name)
            values = from_euler(values)
        raw.append(RawChannel(name, t[~blank], values[~blank], " ".join(group)))
    recording = assemble(path.name, "csv", raw, clock, notes)
    return replace(recording, grid=_uniform_step(recording.channels))


def _no_rows(path: Path, names: Sequence[str], delimiter: str) -> LogError:
    _, line = next(_lines(path), (0, ""))
    width, cells = len(names), line.rstrip("\r\n").split(delimiter)
    commas = line.count(",")
    if (delimiter != "," and commas) or (delimiter == "," and width < commas + 1 <= 2 * width):
        found = f"{path.name}: decimal commas ({plain(line, 40)})"
        return LogError(found, "decimal points: 0.02", "export with decimal points, or in an English locale")
    words = [(name, cell) for name, cell in zip(names, cells, strict=False) if not _numbers(cell, delimiter)]
    if len(cells) == width and words:
        name, cell = words[0]
        return LogError(
            f"{path.name}: column {plain(name, 40)} holds '{plain(cell.strip(), 40)}', no number",
            "numbers in every row",
            "write times as seconds: 0.02, 0.04 …" if name == "t" else "leave that column out, or export numbers",
        )
    return LogError(f"{path.name}: no usable row below the header", "numbers in every row", "check the export")


def _check_radians(angles: FloatArray, origin: str) -> None:
    """Pitch in radians never leaves +-pi/2, and nothing rolls more than a few turns; raises LogError for degrees."""
    roll, pitch = np.nanmax(np.abs(angles[:, :2]), axis=0, initial=0.0)
    if pitch <= 0.5 * np.pi + 0.01 and roll <= 4.0 * np.pi:
        return
    raise LogError(
        f"{origin}: columns phi and theta reach {roll:.3g} and {pitch:.3g}: degrees?",
        "radians",
        "multiply phi, theta and psi by 0.0174533",
    )


def _check_seconds(t: FloatArray, origin: str) -> None:
    """Logs have many rows a second; raises LogError for times that do not rise, or in milli- or microseconds."""
    step = sample_period(t)
    known = t[np.isfinite(t)]
    steps = np.diff(known)
    if len(known) >= _FEW_ROWS and (np.median(steps) <= 0.0 or np.mean(steps < 0.0) > 0.1):
        falls = np.mean(steps < 0.0) > 0.1 or known[-1] < known[0]
        raise LogError(
            f"{origin}: column t {'falls' if falls else 'stays the same'} from row to row",
            "the time [s] of each row, rising",
            "sort the rows by time" if falls else "check the export of t",
        )
    if len(t) < _FEW_ROWS or not step >= _SLOWEST_ROW:
        return
    units = (("milliseconds", 1e-3), ("microseconds", 1e-6), ("nanoseconds", 1e-9))
    unit, factor = units[int(step >= 500.0) + int(step >= 500e3)]
    fix = f"multiply t by {factor:g}"
    if np.all(steps == 1.0):
        unit, fix = "row numbers, or milliseconds", "divide t by the rows a second"
    raise LogError(
        f"{origin}: column t rises by {step:.8g} a row: {unit}?", f"seconds, rows at most {_SLOWEST_ROW} s apart", fix
    )


def _header(path: Path, columns: Mapping[str, str]) -> tuple[list[str], str]:
    with path.open("rb") as file:
        head = file.read(HEAD_BYTES)
    line = header_line(head)
    if line is None:
        raise LogError(f"{path.name}: no header row", "t, then column names such as p,q,r,ax,ay,az,w1")
    if len(head) == HEAD_BYTES and head.endswith(line.encode()):
        raise LogError(f"{path.name}: its header row is longer than {HEAD_BYTES >> 10} KiB", "fewer columns")
    delimiter = max(",;\t", key=line.count)
    names = [cell.strip().strip('"') for cell in line.split(delimiter)]
    names = _renamed(names, columns, path.name)
    doubles = sorted(name for name, count in Counter(names).items() if count > 1)
    if doubles:
        raise LogError(f"{path.name}: column {plain(', '.join(doubles))} appears twice", "each column once")
    if "t" not in names:
        raise LogError(f"{path.name}: no column t among {', '.join(names)[:120]}", "a column t with the time [s]")
    return names, delimiter


def _renamed(names: list[str], columns: Mapping[str, str], origin: str) -> list[str]:
    """Gives columns the contract's names; a column that loses its own to another is not used under it."""
    theirs = {}
    for own, given in columns.items():
        if given not in names:
            raise LogError(
                f"{origin}: no column {plain(given, 40)}, which `columns` names for {plain(own, 40)}",
                plain(", ".join(names), 200),
                nearest(given, names),
            )
        theirs[given] = own
    return [theirs.get(name, f"({name})" if name in columns else name) for name in names]


def check_columns(columns: Mapping[str, str]) -> None:
    """Raises LogError for a name that is none of the contract's, whatever the format of the log."""
    for own in columns:
        if own not in ("t", *_known()) and not any(pattern.fullmatch(own) for pattern in _ROTOR.values()):
            raise LogError(f"`columns`: unknown name '{plain(own, 40)}'", ", ".join(_known()), nearest(own, _known()))


def _known() -> list[str]:
    return [*(c for group in GROUPS.values() for c in group), *EULER, "w1", "u1"]


def _layout(names: list[str], origin: str) -> tuple[dict[str, tuple[str, ...]], list[str]]:
    """Assigns columns to channels; returns the unused columns as well."""
    layout: dict[str, tuple[str, ...]] = {}
    for channel, group in (*GROUPS.items(), ("attitude", EULER)):
        missing = [c for c in group if c not in names]
        if not missing:
            layout.setdefault(channel, group)
        elif len(missing) < len(group) and channel not in layout:
            raise LogError(f"{origin}: {channel} lacks column {', '.join(missing)}", "all of " + " ".join(group))
    for channel, pattern in _ROTOR.items():
        numbers = sorted(int(m[1]) for m in map(pattern.fullmatch, names) if m)
        if numbers and numbers != list(range(1, len(numbers) + 1)):
            raise LogError(f"{origin}: rotor columns numbered {numbers}", "1, 2, 3 … without a hole")
        if numbers:
            layout[channel] = tuple(f"{'w' if channel == 'rotor_speed' else 'u'}{i}" for i in numbers)
    if not layout:
        raise LogError(f"{origin}: none of the columns {', '.join(names)[:120]} is known", ", ".join(_known()))
    used = {"t", *EULER, *(c for columns in layout.values() for c in columns)}
    return layout, [n for n in names if n not in used]


def _table(path: Path, width: int, delimiter: str) -> tuple[FloatArray, list[str]]:
    """Reads the numbers in blocks; a line that does not fit is dropped and counted."""
    rows, told = array("d"), _lines(path)
    bad: list[int] = []
    cut = False
    while block := list(islice(told, _LINES)):
        numbers, lines = zip(*block, strict=True)
        if not lines[-1].endswith("\n"):
            # A last line without line end whose last number is shorter than in those before may lack digits.
            *before, last = (len(line.rstrip().rpartition(",")[2]) for line in lines[-20:])
            cut = last < min(before, default=0)
            lines = lines[: len(lines) - cut]
        try:
            table = np.loadtxt(lines, delimiter=delimiter, ndmin=2, comments=None)
            fits = table.shape[1] == width
        except ValueError:
            fits = False
        if not fits:
            each = [(number, _numbers(line, delimiter)) for number, line in zip(numbers, lines, strict=False)]
            bad += [number for number, values in each if len(values) != width]
            table = np.array([values for _, values in each if len(values) == width], dtype=np.float64)
        rows.frombytes(np.ascontiguousarray(table).tobytes())
    notes = []
    if bad:
        notes.append(
            f"{len(bad)} line{'s' * (len(bad) > 1)} with missing or unreadable cells dropped (first: line {bad[0]})"
        )
    if cut:
        notes.append("the last line is cut short: dropped")
    return np.frombuffer(rows, dtype=np.float64).reshape(-1, width), notes


def _lines(path: Path) -> Iterator[tuple[int, str]]:
    """Yields number and text of the lines below the header."""
    with path.open(encoding="utf-8-sig", errors="replace") as file:
        told = ((n, line) for n, line in enumerate(file, 1) if line.strip() and not line.lstrip().startswith("#"))
        next(told, None)
        yield from told


def _numbers(line: str, delimiter: str) -> list[float]:
    """The numbers of a line; none where a cell is unreadable."""
    try:
        return [_number(cell) for cell in line.rstrip("\r\n").split(delimiter)]
    except ValueError:
        return []


def _number(cell: str) -> float:
    """A number as CSV files have it; NaN for an empty cell.  Raises ValueError, also for what only Python reads."""
    text = cell.strip().strip('"')
    if not text:
        return float("nan")
    if "_" in text or not text.isascii():
        raise ValueError(text)
    return float(text)


def _uniform_step(channels: Mapping[str, Channel]) -> float | None:
    """Returns the step [s] when every channel lies on one uniform grid (gaps aside), else None."""
    longest = max(channels.values(), key=lambda c: len(c.t))
    if len(longest.t) < 3:
        return None
    step = sample_period(longest.t)
    steps = np.diff(longest.t)
    steps = steps[steps < 1.5 * step]
    same_rows = all(len(c.t) == len(longest.t) for c in channels.values())
    return float(step) if same_rows and np.abs(steps - step).max() < COINCIDENT * step else None
