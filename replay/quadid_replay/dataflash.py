"""ArduPilot DataFlash logs."""

from __future__ import annotations

import mmap
import re
import struct
from array import array
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pymavlink.DFReader import FORMAT_TO_STRUCT

from quadid.data.window import Recording
from quadid.types import FloatArray, IntArray
from quadid_replay.columns import (
    LogClock,
    RawChannel,
    Source,
    assemble,
    channels_of,
    damage,
    from_euler,
    mode_changes,
    rising,
    spikes,
)
from quadid_replay.motors import (
    ESCS,
    RPM,
    Outputs,
    active_outputs,
    changed_within,
    esc_columns,
    frame_rotors,
    in_pulses,
    merge_instances,
    motor_outputs,
    no_multirotor,
)

# --- Finds the records of an ArduPilot DataFlash log and reads their columns
#
# The types of columns are pymavlink's; finding and reading are ours, because pymavlink makes one Python object a
# record, stops at the first unknown record and raises on a damaged description.  Here a damaged place is skipped and
# counted.


_HEAD = b"\xa3\x95"
_FMT_TYPE, _FMT_LENGTH = 0x80, 89
_PADDING = 528
"""Block-based logs end with up to this many bytes of padding, which is not damage."""
_ROWS = 65536
_TYPES = {
    code: f"S{kind[:-1]}" if kind.endswith("s") else f"<{kind}" for code, (kind, _, _) in FORMAT_TO_STRUCT.items()
}


class Description(NamedTuple):
    """A kind of record: codes and names of its columns, and its bytes, where column k is the field of that number."""

    codes: str
    columns: tuple[str, ...]
    layout: np.dtype[np.void]


@dataclass
class DataflashIndex:
    """Places of the records of a log.

    Attributes:
        data: the file's bytes, mapped.
        formats: description by message name.
        offsets: byte offsets of the records, by message name.
        skipped: bytes that belong to no record (padding at the end not counted).
        damaged: names of messages whose description is damaged.
        redefined: names of messages that are described anew within the log; what follows the change is not used.
        cut: whether the file ends inside a record.
    """

    data: mmap.mmap
    formats: dict[str, Description] = field(default_factory=dict)
    offsets: dict[str, array[int]] = field(default_factory=dict)
    skipped: int = 0
    damaged: list[str] = field(default_factory=list)
    redefined: list[str] = field(default_factory=list)
    cut: bool = False

    def has(self, name: str, *columns: str) -> bool:
        """Tells whether there are records called `name` with all these columns."""
        return len(self.offsets.get(name, ())) > 0 and set(columns) <= set(self.formats[name].columns)

    def rows(self, name: str) -> IntArray:
        """Returns the byte offsets of the records, shape (n,): their order in the file."""
        return np.array(self.offsets.get(name, ()), dtype=np.int64)

    def column(self, name: str, column: str) -> FloatArray:
        """Returns one numeric column, scaled as its format defines, shape (n,); NaN where it holds text."""
        raw, scale = self._raw(name, column)
        if raw.dtype.kind == "S":
            return np.full(len(raw), np.nan)
        with np.errstate(invalid="ignore"):  # damaged records hold signalling NaN
            values = np.asarray(raw, dtype=np.float64)
        return values if scale is None else values * scale

    def text(self, name: str, column: str) -> list[str]:
        """Returns one text column; empty where it holds numbers."""
        raw, _ = self._raw(name, column)
        texts = raw if raw.dtype.kind == "S" else np.full(len(raw), b"")
        return [text.split(b"\0")[0].decode("ascii", "replace") for text in texts.tolist()]

    def _raw(self, name: str, column: str) -> tuple[NDArray[Any], float | None]:
        """A column as it stands in the file, shape (n,), and its scale."""
        codes, columns, layout = self.formats[name]
        k = columns.index(column)
        kind, place = layout[str(k)], layout.fields[str(k)][1]  # type: ignore[index]
        buffer, starts = np.frombuffer(self.data, dtype=np.uint8), self.rows(name) + place
        out = np.empty((len(starts), kind.itemsize), dtype=np.uint8)
        for begin in range(0, len(starts), _ROWS):
            part = starts[begin : begin + _ROWS]
            out[begin : begin + _ROWS] = buffer[part[:, None] + np.arange(kind.itemsize)]
        return out.view(kind)[:, 0], FORMAT_TO_STRUCT[codes[k]][1]


def index_dataflash(path: Path) -> DataflashIndex:
    """Walks through a log once and notes where its records are; damaged stretches are skipped and counted."""
    with path.open("rb") as file:
        data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
    index = DataflashIndex(data)
    names: dict[int, str] = {}
    lengths = [0] * 256
    lengths[_FMT_TYPE] = _FMT_LENGTH
    offset, size = 0, len(data)
    in_step = True  # the record before this one was whole
    while offset + 3 <= size:
        length = lengths[data[offset + 2]] if data[offset : offset + 2] == _HEAD else 0
        end = offset + length
        if (
            length == 0
            or (end > size and not in_step)
            or not (in_step or end + 2 > size or data[end : end + 2] == _HEAD)
        ):
            in_step = False
            following = data.find(_HEAD, offset + 1)
            following = size if following < 0 else following
            index.skipped += following - offset if size - following > 0 or following - offset > _PADDING else 0
            offset = following
            continue
        if end > size:
            index.cut = True
            break
        kind = data[offset + 2]
        in_step = True
        if kind == _FMT_TYPE:
            _note_format(index, data[offset + 3 : end], names, lengths)
        elif names[kind]:
            index.offsets[names[kind]].append(offset)
        offset = end
    return index


def _note_format(index: DataflashIndex, body: bytes, names: dict[int, str], lengths: list[int]) -> None:
    """Notes a description; once rows have two meanings, they make no column: what follows is left out."""
    kind, length, *texts = struct.unpack("<BB4s16s64s", body)
    if kind == _FMT_TYPE:
        return
    try:
        name, codes, titles = (text.split(b"\0")[0].decode("ascii") for text in texts)
        layout = np.dtype([("head", "S3"), *((str(k), _TYPES[code]) for k, code in enumerate(codes))])
        described = Description(codes, tuple(titles.split(",") if titles else ()), layout)
        if layout.itemsize != length or len(codes) != len(described.columns) or not name.isalnum():
            raise ValueError("sizes that do not fit")
    except (KeyError, ValueError):
        index.damaged.append(f"type {kind}")
        return
    closed = names.get(kind) == ""
    before = None if closed else names.get(kind, name)
    known = index.formats.get(before or "")
    if known == described and before == name and kind in names:
        return
    if closed or known is not None:
        index.redefined += [] if known is None or before is None else [before]
        names[kind], lengths[kind] = "", length
        return
    names[kind], lengths[kind] = name, length
    index.formats[name] = described
    index.offsets.setdefault(name, array("Q"))


# --- ArduPilot DataFlash logs: which record holds which channel, and its units
#
# Body FRD and world NED are ArduPilot's own; ATT is in degrees, RCOU in microseconds.  Time is TimeUS or TimeMS,
# since boot.


_FIRMWARE = re.compile(r"(?:Ardu|APM:)(\w+) V(\d+)\.(\d+)")
_OUTPUTS = ("RCOU", "RCO2", "RCO3")
"""Outputs 1 to 14, and those behind."""
_OUTPUT = re.compile(r"Ch?(\d{1,2})")
_EKF = ("XKF1", "NKF1", "EKF1")


def _volts(volts: FloatArray) -> FloatArray:
    """Battery voltage [V]; old CURR counts centivolts, and a monitor that is not there reports zero."""
    if not len(volts) or np.max(volts) <= 0.0:
        return np.full_like(volts, np.nan)
    return volts * 0.01 if np.median(volts) > 100.0 else volts


SOURCES = (
    *(Source("gyro", name, ("GyrX", "GyrY", "GyrZ"), note="instance 0") for name in ("IMU", "GYR")),
    # The rate controller's input: at the loop's rate where the IMU is logged slowly.
    Source("gyro", "RATE", ("R", "P", "Y"), np.radians, "(degrees/s, filtered on board)"),
    *(Source("accel", name, ("AccX", "AccY", "AccZ"), note="instance 0") for name in ("IMU", "ACC")),
    *(
        Source("attitude", name, ("Roll", "Pitch", "Yaw"), lambda rows: from_euler(np.radians(rows)), "(degrees)")
        for name in ("ATT", "ANG")
    ),
    *(Source("attitude", name, ("Q1", "Q2", "Q3", "Q4")) for name in ("XKQ", "XKQ1", "NKQ1")),
    *(
        Source("attitude_reference", name, ("DesRoll", "DesPitch", "DesYaw", column), note=f"Des*, CTUN {column}")
        for name in ("ANG", "ATT")
        for column in ("ThO", "ThrOut")
    ),
    *(Source("velocity", name, ("VN", "VE", "VD"), note="VN VE VD") for name in _EKF),
    *(Source("position", name, ("PN", "PE", "PD"), note="PN PE PD") for name in _EKF),
    *(Source("battery", name, ("Volt",), _volts, "Volt") for name in ("BAT", "CURR")),
)
"""In order of preference."""

ARDUCOPTER = {
    0: "Stabilize", 1: "Acro", 2: "AltHold", 3: "Auto", 4: "Guided", 5: "Loiter", 6: "RTL", 7: "Circle", 9: "Land",
    11: "Drift", 13: "Sport", 14: "Flip", 15: "AutoTune", 16: "PosHold", 17: "Brake", 18: "Throw", 19: "Avoid ADSB",
    20: "Guided NoGPS", 21: "SmartRTL", 22: "FlowHold", 23: "Follow", 24: "ZigZag", 25: "SystemID", 26: "Autorotate",
    27: "Auto RTL", 28: "Turtle",
}  # fmt: skip
"""Names of ArduCopter's flight modes."""
_STAMPED = (*dict.fromkeys(source.records for source in SOURCES), *_OUTPUTS, "ESC", "CTUN", "MODE")
"""Records whose stamps are used."""


def read_dataflash(path: Path) -> Recording:
    """Reads a DataFlash log, whole or damaged.

    Raises:
        LogError: nothing usable in it.
    """
    index = index_dataflash(path)
    clock = LogClock()
    stamps = {
        name: index.column(name, column) * unit
        for name in _STAMPED
        for column, unit in (("TimeUS", 1e-6), ("TimeMS", 1e-3))
        if index.has(name, column)
    }
    times = clock.times_of(stamps, {name: index.rows(name) for name in stamps})
    names, values = list[str](), list[float]()  # in file order; a parameter that is changed comes again
    if index.has("PARM", "Name", "Value"):
        names, values = index.text("PARM", "Name"), index.column("PARM", "Value").tolist()
    parameters = dict(zip(names, values, strict=True))
    messages = index.text("MSG", "Message") if index.has("MSG", "Message") else []
    firmware = next(filter(None, map(_FIRMWARE.search, messages)), None)
    frame = next((text.split(":", 1)[1].strip() for text in messages if text.startswith("Frame:")), "")
    damaged, redefined = (", ".join(sorted(set(names))[:8]) for names in (index.damaged, index.redefined))
    notes = damage(
        len(index.data),
        index.skipped,
        index.cut,
        damaged and f"damaged message descriptions: {damaged}",
        redefined and f"{redefined} redefined within the log: data after the change are not used",
    )
    sources = SOURCES
    if parameters.get("AHRS_EKF_TYPE") == 2.0:
        sources = tuple(sorted(SOURCES, key=lambda source: source.records != "NKF1"))

    def rows(source: Source) -> tuple[FloatArray, FloatArray] | None:
        if source.channel == "attitude_reference":
            return _reference(index, times, source)
        return _rows(index, times, source.records, source.columns)

    raw = channels_of(sources, rows)
    other = no_multirotor(parameters, firmware=firmware[1] if firmware else "")
    if not other:
        version = (int(firmware[2]), int(firmware[3])) if firmware else None
        raw += _outputs(index, times, parameters, frame_rotors(frame), notes)
        raw += _esc(index, times, parameters, frame_rotors(frame), version, notes)
    notes += filter(None, [changed_within(names, values)])
    # ArduPilot numbers its logs from 1 on every vehicle: such a name identifies a log only with its folder's.
    name = f"{path.absolute().parent.name}/{path.name}" if path.stem.isdigit() else path.name
    recording = assemble(name, "dataflash", raw, clock, notes, parameters, other)
    mode = next((c for c in ("ModeNum", "Mode") if index.has("MODE", c)), None)
    if mode is None or "MODE" not in times:
        return recording
    return replace(recording, modes=mode_changes(times["MODE"], index.column("MODE", mode), ARDUCOPTER))


def _rows(
    index: DataflashIndex, times: dict[str, FloatArray], name: str, columns: tuple[str, ...]
) -> tuple[FloatArray, FloatArray] | None:
    """Times and columns of instance 0 (of batteries the first); None when columns are missing."""
    if name not in times or not index.has(name, *columns):
        return None
    t, rows = times[name], np.ones(len(times[name]), dtype=np.bool_)
    for instance in ("I", "Instance", "Inst", "C"):
        if index.has(name, instance):
            number = index.column(name, instance)
            rows &= number == (np.min(number, initial=255) if name == "BAT" else 0)
    values = np.stack([index.column(name, column)[rows] for column in columns], axis=1)
    t = t[rows]
    stamped = np.flatnonzero(np.isfinite(t))
    if index.has(name, "SampleUS") and len(stamped):  # the raw sensor's own clock is finer than the time of writing
        sample = index.column(name, "SampleUS")[rows] * 1e-6
        later = (sample - sample[stamped[0]]) - (t - t[stamped[0]])
        t = t + later if np.abs(later[stamped]).max() < 0.1 else t
    return t, values


def _reference(
    index: DataflashIndex, times: dict[str, FloatArray], source: Source
) -> tuple[FloatArray, FloatArray] | None:
    """Times and desired angles with the last throttle output of CTUN."""
    desired = _rows(index, times, source.records, source.columns[:3])
    throttle = _rows(index, times, "CTUN", source.columns[3:])
    if desired is None or throttle is None:
        return None
    t, angles = desired[0], np.radians(desired[1])
    angles[:, 2] = np.remainder(angles[:, 2] + np.pi, 2.0 * np.pi) - np.pi
    written, level = (part[np.isfinite(throttle[0])] for part in throttle)
    kept = rising(written)
    written, level = written[kept], level[kept]
    latest = np.searchsorted(written, t, side="right") - 1
    known = latest >= 0
    unit = 1.0 if source.columns[3] == "ThO" else 1e-3
    return t[known], np.hstack([angles[known], level[latest[known]] * unit])


def _outputs(
    index: DataflashIndex, times: dict[str, FloatArray], parameters: dict[str, float], rotors: int, notes: list[str]
) -> list[RawChannel]:
    """Outputs that are motors; of one moment those of all records."""
    place: dict[int, tuple[str, str]] = {}  # record and column of each output
    for name in _OUTPUTS:
        columns = index.formats[name].columns if name in index.formats else ()
        place |= {int(m[1]) - 1: (name, m[0]) for c in columns if (m := _OUTPUT.fullmatch(c)) and 0 < int(m[1]) <= ESCS}
    told = {
        name: _rows(index, times, name, tuple(c for n, c in place.values() if n == name)) for name, _ in place.values()
    }
    first = next(iter(told.values()), None)
    if first is None:
        return []
    pulses = np.full((len(first[0]), 1 + max(place)), np.nan)
    for name, rows in told.items():
        if rows is not None:
            _, here, there = np.intersect1d(first[0], rows[0], return_indices=True)  # of one moment
            outputs = [output for output, (n, _) in place.items() if n == name]
            pulses[here[:, None], outputs] = rows[1][there]
    found = motor_outputs(parameters, rotors, pulses.shape[1], "RCOU", ardupilot=True)
    notes += filter(None, [found.problem])
    motors = [] if found.problem else found.columns or active_outputs(in_pulses(pulses)[0])
    lost = [k + 1 for k in motors if k not in place]
    if lost:
        notes.append(f"motors on outputs {lost}, of which the log holds no column: no output is used")
    if not motors or lost:
        return []
    values, how = in_pulses(pulses[:, motors])
    label = " ".join([*dict.fromkeys(place[k][0] for k in motors), *(place[k][1] for k in motors)])
    return [RawChannel("motor_command", first[0], values, f"{label}{how and f' ({how})'}")]


def _esc(
    index: DataflashIndex,
    times: dict[str, FloatArray],
    parameters: dict[str, float],
    rotors: int,
    version: tuple[int, int] | None,
    notes: list[str],
) -> list[RawChannel]:
    """ESC telemetry comes one motor at a time."""
    number = next((c for c in ("Instance", "I") if index.has("ESC", c)), None)
    if number is None or "ESC" not in times or not index.has("ESC", "RPM"):
        return []
    instance, rpm, t = index.column("ESC", number), index.column("ESC", "RPM"), times["ESC"]
    turning = [bool(np.any(rpm[instance == k] != 0.0)) for k in range(ESCS)]
    found = esc_columns(parameters, rotors, turning, "ESC", ardupilot=True, version=version)
    silent = [k for k in found.columns if not np.any(instance == k)]
    if silent and any(turning):
        found = Outputs([], f"ESC: no records of instance {', '.join(map(str, silent))}, a motor: they are not used")
    if found.problem:
        notes.append(found.problem)
        return []
    series, dropped = [], 0
    for motor in found.columns:
        rows = np.flatnonzero((instance == motor) & np.isfinite(t) & np.isfinite(rpm))
        rows = rows[rising(t[rows])]
        far = spikes(rpm[rows], rotor=True)  # before others are interpolated to
        dropped += int(np.count_nonzero(far))
        series.append((t[rows[~far]], rpm[rows[~far]] * RPM))
    at, values = merge_instances(series)
    label = f"ESC RPM of {len(found.columns)} motors"
    return [RawChannel("rotor_speed", at, np.abs(values), label, spikes=dropped)]
