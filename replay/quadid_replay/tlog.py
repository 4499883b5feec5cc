"""MAVLink telemetry logs: frames, one vehicle's messages, channels on its boot clock."""

import mmap
from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple, TypeAlias

import numpy as np
from fastcrc.crc16 import mcrf4xx
from numpy.typing import NDArray
from pymavlink.dialects.v20 import ardupilotmega

from quadid.data.window import Recording
from quadid.errors import LogError
from quadid.types import BoolArray, FloatArray, IntArray
from quadid_replay.columns import EARLIEST_US, LATEST_US, LogClock, RawChannel, assemble, damage, fastest_first
from quadid_replay.mavlink_messages import (
    PREFERENCE,
    READERS,
    STATE_MESSAGES,
    BootClock,
    Placed,
    boot_seconds,
    boot_stamp,
    extend_dialect,
    two_rows,
    unix_seconds,
)
from quadid_replay.motors import (
    ESCS,
    MOST_ROTORS,
    MULTIROTORS,
    active_outputs,
    changed_within,
    esc_columns,
    in_pulses,
    motor_outputs,
    no_multirotor,
    px4_rotor_count,
)

# --- Frames of a telemetry log: receive times and MAVLink 1 or 2 frames, found all at once, through damage
#
# A tlog has neither index nor end mark.  After a damaged place the next frame is the next one that looks like one and
# is followed by another.  Messages, fields and checksums are pymavlink's; its reader takes ten times as long.


Bytes: TypeAlias = NDArray[np.uint8]

_STAMP = 8
_SIGNED = 1
_SIGNATURE = 13
_HEAD = _STAMP + 3
"""Bytes that tell a frame's length: receive time, mark, payload length, flags."""
_BLOCK = 1 << 18


class Frames(NamedTuple):
    """The frames of a tlog in file order; checksums are the caller's business.

    Attributes:
        data: the file.
        start: offset of each frame's mark, shape (n,).
        end: offset behind its payload, where its checksum stands.
        head: bytes from the mark to the payload: 6 or 10.
        stop: offset behind the whole frame.
        received: receive times [s, UNIX].
        number: of each frame, counted by its sender from 0 to 255 again and again.
        message, system, component: message id and who sent it.
        skipped: bytes that belong to no frame.
        cut: whether the file ends inside a frame.
    """

    data: Bytes
    start: IntArray
    end: IntArray
    head: IntArray
    stop: IntArray
    received: FloatArray
    number: IntArray
    message: IntArray
    system: Bytes
    component: Bytes
    skipped: int
    cut: bool

    def frame(self, k: int) -> bytes:
        """Frame `k` as it was on the link."""
        return self.data[self.start[k] : self.stop[k]].tobytes()


def read_frames(path: Path) -> Frames:
    """Finds the frames of a tlog."""
    with path.open("rb") as file:
        data = np.frombuffer(mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ), dtype=np.uint8)

    # Places at which the high bytes of a receive time between the years 2000 and 2100 stand, and a mark behind it.
    found = [np.empty(0, dtype=np.int64)]
    for begin in range(0, len(data) - _STAMP, _BLOCK):
        block = data[begin : begin + _BLOCK + _STAMP]
        first, high, mark = block[:-_STAMP], block[1 : 1 - _STAMP], block[_STAMP:]
        looks = (mark >= 0xFD) & (mark != 0xFF) & (first == 0) & (high >= 0x03) & (high <= 0x0E)
        found.append(np.flatnonzero(looks) + begin)
    marks = np.concatenate(found)
    received = np.zeros(len(marks), dtype=np.int64)  # [us, UNIX], its highest byte zero
    for k in range(1, _STAMP):
        received = received << 8 | data[marks + k]
    possible = (received > EARLIEST_US) & (received < LATEST_US) & (marks + _HEAD <= len(data))
    places, received = marks[possible], received[possible]

    # Where each of them would end.
    version_1 = data[places + _STAMP] == 0xFE
    head = np.where(version_1, 6, 10)
    end = places + _STAMP + head + data[places + _STAMP + 1]
    signed = ~version_1 & (data[places + _STAMP + 2] & _SIGNED != 0)
    stop = end + 2 + _SIGNATURE * signed

    kept, skipped, cut = _walk(places, stop, len(data))
    start, head, end = places[kept] + _STAMP, head[kept], end[kept]
    short = np.where(head == 6, 0, 2)  # MAVLink 2 has two flags more before these
    kind = start + 5 + short
    message = data[kind].astype(np.int64)
    long = head == 10
    message[long] |= data[kind[long] + 1].astype(np.int64) << 8 | data[kind[long] + 2].astype(np.int64) << 16
    return Frames(
        data,
        start,
        end,
        head,
        stop[kept],
        received[kept].astype(np.float64) * 1e-6,
        data[start + 2 + short].astype(np.int64),
        message,
        data[start + 3 + short],
        data[start + 4 + short],
        skipped,
        cut,
    )


def _walk(places: IntArray, stops: IntArray, size: int) -> tuple[list[int], int, bool]:
    """Follows the frames from one to the next; after damage goes on at the next one that another follows.

    Args:
        places: offsets where a frame may begin, rising; stops: where each ends.
        size: of the file.

    Returns:
        Which of the places are frames, the bytes skipped, and whether the file ends inside a frame.
    """
    following = np.searchsorted(places, stops)
    linked = np.append(places, -1)[following] == stops
    certain = np.flatnonzero((stops <= size) & (linked | (stops >= size)))
    certain_places = places[certain]
    ends, next_one = stops.tolist(), np.where(linked, following, -1).tolist()
    kept: list[int] = []
    skipped, offset, at = 0, 0, 0 if len(places) and places[0] == 0 else -1
    while True:
        while at >= 0:
            kept.append(at)
            offset, at = ends[at], next_one[at]
        if offset > size:
            return kept[:-1], skipped, True
        if offset + _STAMP >= size:
            return kept, skipped, offset < size
        found = int(np.searchsorted(certain_places, offset, side="right"))
        at = int(certain[found]) if found < len(certain) else -1
        resumed = int(places[at]) if at >= 0 else size
        skipped, offset = skipped + resumed - offset, resumed


# --- MAVLink messages of one kind to columns, all at once, from the dialect's own descriptions
#
# Fields, their order, padding and text are pymavlink's, message by message; a test compares both.


_AT_ONCE = 4096
"""Frames that are looked at together: what they need stays in the processor's cache."""


class Messages:
    """Messages of one kind; its fields are attributes: shape (n,), of an array a list of those, of text strings."""

    def __init__(self, kind: Any, payloads: Bytes) -> None:
        """Takes a message class of the dialect and payloads padded with zeros, shape (n, size)."""
        fields = zip(kind.ordered_fieldnames, kind.native_format.decode()[1:], kind.array_lengths, strict=True)
        wire = [
            (name, f"S{n}", ()) if code == "c" else (name, f"<{code}", (n,) if n else ()) for name, code, n in fields
        ]
        self._rows = payloads.view(np.dtype(wire))[:, 0]

    def __getattr__(self, name: str) -> Any:
        """The field of this name, whole numbers of up to 32 bits as int64, others as float64 or uint64."""
        if name not in (self._rows.dtype.names or ()):
            raise AttributeError(name)
        values = self._rows[name]
        if values.dtype.kind == "S":
            return [text.split(b"\0", 1)[0].decode("ascii", "replace") for text in values.tolist()]
        if values.dtype != np.uint64:
            with np.errstate(invalid="ignore"):  # a signalling NaN
                values = values.astype(np.float64 if values.dtype.kind == "f" else np.int64)
        return values if values.ndim == 1 else list(values.T)


def decode(frames: Frames, kind: Any, which: IntArray) -> Messages:
    """Decodes the frames `which`, all of one kind of message, a class of the dialect."""
    size = kind.unpacker.size
    payloads = np.empty((len(which), size), dtype=np.uint8)
    columns = np.arange(size)
    for a in range(0, len(which), _AT_ONCE):
        some = which[a : a + _AT_ONCE]
        begin = frames.start[some] + frames.head[some]
        block = frames.data.take(begin[:, None] + columns, mode="clip")
        payloads[a : a + _AT_ONCE] = np.where(columns < (frames.end[some] - begin)[:, None], block, 0)
    return Messages(kind, payloads)


def intact(frames: Frames, which: IntArray, seeds: IntArray) -> BoolArray:
    """Tells which of these frames have the right checksum; `seeds` are their messages' (`crc_extra`), shape (n,)."""
    data, seed = frames.data.tobytes(), [bytes([k]) for k in range(256)]
    each = zip(frames.start[which].tolist(), frames.end[which].tolist(), seeds.tolist(), strict=True)
    crc = np.array([mcrf4xx(data[begin + 1 : end] + seed[k], 0xFFFF) for begin, end, k in each], dtype=np.uint16)
    at = frames.end[which]
    return np.asarray(crc == (frames.data[at].astype(np.uint16) | frames.data[at + 1].astype(np.uint16) << 8))


# --- Contents of one vehicle's telemetry: its signals on one clock
#
# Signals are those of the messages' `Reading`s, by name and message; times are the messages' own stamps, else those of
# the stamped messages around them (`BootClock`), on the clock of the log.


_INVALID, _ARDUPILOT = 8, 3
_EPOCH_US = 1e14
"""SYSTEM_TIME holds a date where it counts more than this [us]."""
_BACKWARDS = 0.5
"""Boot time that falls by more than this [s] is counted."""
Told: TypeAlias = Mapping[str, tuple[IntArray, Messages]]
"""Messages by name, and which frames of the log they are, rising, shape (n,)."""


class VehicleLog(NamedTuple):
    """Messages of one MAVLink component.

    Attributes:
        told: its messages.
        clock: of the log.
        signals: by channel and message, times [s] of n samples, NaN where refused, and values (n, columns).
        heard: whether a measurement has its time before the log ends.
        backwards: how often the boot time fell.
    """

    told: Told
    clock: LogClock
    signals: Mapping[tuple[str, str], tuple[FloatArray, FloatArray]]
    heard: bool
    backwards: int


def vehicle_log(told: Told, received: FloatArray) -> VehicleLog:
    """Gathers the signals of a vehicle, in the order in which they first appear.

    Args:
        told: its messages.
        received: receive times of all frames of the log [s, UNIX].
    """
    # What its messages tell, by signal: frames, first columns and values; and of each frame its own stamps.
    parts: dict[tuple[str, str], list[tuple[IntArray, IntArray, FloatArray]]] = {}
    stamped: list[tuple[IntArray, FloatArray, FloatArray, BoolArray]] = []
    for name in (name for name in READERS if name in told):
        which, m = told[name]
        sensible: BoolArray | bool = True
        if name == "RAW_IMU":  # elsewhere than in ArduPilot it counts in sensor units
            at, beats = told.get("HEARTBEAT", (which[:0], None))
            autopilot = np.empty(0) if beats is None else beats.autopilot
            sensible = _latest(at, autopilot, which, _INVALID) == _ARDUPILOT
        some = np.zeros(len(which), dtype=np.bool_)
        for reading in READERS[name](m):
            tells = np.broadcast_to(reading.known & sensible, len(which))
            places = np.broadcast_to(reading.place, len(which))
            values = np.column_stack([np.broadcast_to(v, len(which)).astype(np.float64) for v in reading.values])
            some |= tells
            if tells.any():
                key = reading.signal, reading.source
                parts.setdefault(key, []).append((which[tells], places[tells], values[tells]))
        boot, unix = (np.broadcast_to(seconds(m), len(which))[some] for seconds in (boot_seconds, unix_seconds))
        servo = np.full(len(boot), name == "SERVO_OUTPUT_RAW")
        stamped.append((which[some], boot, unix - _unix_offset(told, which[some]), servo))

    # Every message in file order goes to its stamp on the boot clock, or between the stamped ones around it.
    clock, boot_clock = LogClock(), BootClock[int]()
    placed: list[Placed[int]] = []
    before, backwards = 0.0, 0
    columns = [np.concatenate(column) for column in zip(*stamped, strict=True)] if stamped else [np.empty(0)] * 4
    order = np.argsort(columns[0])
    for k, raw, dated, servo in zip(*(column[order].tolist() for column in columns), strict=True):
        own, came = boot_stamp(raw, servo, boot_clock.newest), float(received[k])
        if own is not None and not servo:
            backwards += own < before - _BACKWARDS
            before = own
        time = own if dated != dated else dated
        placed += boot_clock.unstamped(k, came) if time is None else boot_clock.stamped(k, time, came)
    waited = boot_clock.finish()
    at_boot = np.full(len(received), np.nan)
    for k, time in (*placed, *waited):
        at_boot[k] = np.nan if time is None else time
    timed = np.flatnonzero(np.isfinite(at_boot))
    t = np.full(len(received), np.nan)
    t[timed] = clock.times(at_boot[timed])

    signals = {}
    for key in sorted(parts, key=lambda key: min(which[0] for which, _, _ in parts[key])):
        which, places, values = (np.concatenate(column) for column in zip(*parts[key], strict=True))
        in_file = np.argsort(which, kind="stable")
        told_of = t[which[in_file]], values[in_file]
        joined = key[0] in ("esc", "servo")
        signals[key] = _rounds(told_of[0], places[in_file], told_of[1], ESCS) if joined else told_of
    return VehicleLog(told, clock, signals, len(waited) < len(order), backwards)


def _unix_offset(told: Told, which: IntArray) -> FloatArray:
    """UNIX time of boot [s] by the last SYSTEM_TIME before each frame; NaN before the first."""
    if "SYSTEM_TIME" not in told:
        return np.full(len(which), np.nan)
    at, m = told["SYSTEM_TIME"]
    dated = m.time_unix_usec > _EPOCH_US
    offset = m.time_unix_usec * 1e-6 - m.time_boot_ms * 1e-3
    return _latest(at[dated], offset[dated], which, np.nan)


def _latest(at: IntArray, values: FloatArray, which: IntArray, otherwise: float) -> FloatArray:
    """The value of the last of the frames `at` before each of `which`."""
    return np.asarray(np.concatenate([[otherwise], values])[np.searchsorted(at, which)], dtype=np.float64)


def _rounds(t: FloatArray, places: IntArray, values: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Joins the messages of one round (four ESCs or sixteen outputs each, rising) to a row at the time of the first."""
    real = places < width  # what no vehicle has is left out
    t, places, values = t[real], places[real], values[real]
    begins = np.ones(len(t), dtype=np.bool_)
    begins[1:] = places[1:] <= places[:-1]
    rows = np.full((int(np.count_nonzero(begins)), width + values.shape[1]), np.nan)
    rows[(np.cumsum(begins) - 1)[:, None], places[:, None] + np.arange(values.shape[1])] = values
    return t[begins], rows[:, :width]


# --- MAVLink telemetry logs: one vehicle's messages to channels on its boot clock


_DIALECT = extend_dialect(ardupilotmega)
_WANTED = {n: m for n, m in _DIALECT.mavlink_map.items() if m.msgname in READERS or m.msgname in STATE_MESSAGES}
_MOST_BACKWARDS = 10
"""Boot time that falls more often: no vehicle boots that often."""
_MOST_SENDERS = 32
"""Of more, those with the fewest frames are not looked into: damage makes senders, and none of them is the vehicle."""
_NAMED = 8
"""Other vehicles that are named; more are counted."""


def read_tlog(path: Path) -> Recording:
    """Reads a telemetry log, whole or damaged; of several vehicles the one with most data.

    Raises:
        LogError: no vehicle in it sends anything usable.
    """
    frames = read_frames(path)
    which = np.flatnonzero(np.isin(frames.message, list(_WANTED)))
    seeds = np.zeros(max(_WANTED) + 1, dtype=np.int64)
    seeds[list(_WANTED)] = [m.crc_extra for m in _WANTED.values()]
    whole = intact(frames, which, seeds[frames.message[which]])
    vehicles = _vehicles(frames, which[whole])
    if not any(v.heard for v in vehicles.values()):
        raise LogError(
            f"{path.name}: {len(frames.start)} MAVLink frames but no measurements of a vehicle",
            "IMU, attitude, servo or ESC messages",
            "ask the autopilot for them (SR*_RAW_SENS, SR*_EXTRA1, MAV_*_MODE)",
        )
    who = max(vehicles, key=lambda key: sum(len(t) for t, _ in vehicles[key].signals.values()))
    bad = len(which) - int(np.count_nonzero(whole))
    refused = f"{bad} frames with a wrong checksum were refused" if bad else ""
    notes = damage(len(frames.data), frames.skipped, frames.cut, refused, unit="frame")
    if vehicles[who].backwards > _MOST_BACKWARDS:
        raise LogError(
            f"{path.name}: boot time under system {who[0]} component {who[1]} falls back {vehicles[who].backwards} "
            "times: two vehicles under one system id",
            "one vehicle an id",
            "give each vehicle its own SYSID_THISMAV (MAV_SYS_ID) and record again, or record each link by itself",
        )
    if two_rows(frames.number[(frames.system == who[0]) & (frames.component == who[1])]):
        notes.append(
            f"frame numbers of system {who[0]} component {who[1]} come in two rows: two links of one vehicle, or two "
            "vehicles under one id, and then nothing of it can be trusted"
        )
    others = [key for key, v in vehicles.items() if key != who and v.signals]
    if others:
        more = f" and {len(others) - _NAMED} more" if len(others) > _NAMED else ""
        named = ", ".join(f"{s}/{c}" for s, c in others[:_NAMED])
        notes.append(f"vehicle {who[0]} used; also in the log: {named}{more}")
    used = vehicles[who]
    _, beats = used.told.get("HEARTBEAT", (None, None))
    kind = 0 if beats is None else int(beats.type[-1])
    _, said = used.told.get("PARAM_VALUE", (None, None))
    names, values = ([], []) if said is None else (said.param_id, said.param_value.tolist())
    parameters = dict(zip(names, values, strict=True))
    raw: list[RawChannel] = []
    for name, messages in PREFERENCE.items():
        found = [RawChannel(name, *told, source) for (signal, source), told in used.signals.items() if signal == name]
        found.sort(key=lambda entry: messages.index(entry.source.split(" ")[0]))
        raw += fastest_first(found, 2.0)
    other = no_multirotor(parameters, kind)
    if not other:
        notes += filter(None, [changed_within(names, values)])
        raw += _motors(used, parameters, kind, notes)
    return assemble(path.name, "tlog", raw, used.clock, notes, parameters, other)


def _vehicles(frames: Frames, which: IntArray) -> dict[tuple[int, int], VehicleLog]:
    """Messages of each system and component in the frames `which`, in the order in which they are first heard; of many
    senders those with the most frames.
    """
    sender = frames.system[which].astype(np.int64) << 8 | frames.component[which]
    found, first, count = np.unique(sender, return_index=True, return_counts=True)
    most = np.argsort(-count, kind="stable")[:_MOST_SENDERS]
    out = {}
    for one in found[most][np.argsort(first[most])]:
        its = which[sender == one]
        message = frames.message[its]
        told = {}
        for number in np.unique(message):
            kind, of_it = _WANTED[int(number)], its[message == number]
            told[kind.msgname] = of_it, decode(frames, kind, of_it)
        out[int(one) >> 8, int(one) & 0xFF] = vehicle_log(told, frames.received)
    return out


def _motors(vehicle: VehicleLog, parameters: Mapping[str, float], kind: int, notes: list[str]) -> list[RawChannel]:
    """Rotor speeds and outputs, each of the motors in their order."""
    _, beats = vehicle.told.get("HEARTBEAT", (None, None))
    _, escs = vehicle.told.get("ESC_INFO", (None, None))
    ardupilot = beats is not None and int(beats.autopilot[-1]) == _ARDUPILOT
    rotors = 0 if escs is None else int(escs.count.max())
    rotors = rotors if 0 < rotors <= MOST_ROTORS else px4_rotor_count(parameters) or MULTIROTORS.get(kind, 0)
    raw: list[RawChannel] = []
    for (signal, source), (t, values) in vehicle.signals.items():
        if signal == "esc":
            turning = (np.nan_to_num(values) != 0.0).any(axis=0)
            found = esc_columns(parameters, rotors, turning, source, ardupilot)
            notes += filter(None, [found.problem])
            raw.append(RawChannel("rotor_speed", t, values[:, found.columns], f"{source} (rpm)"))
        elif signal in ("servo", "actuator"):
            told = np.flatnonzero(np.isfinite(values).any(axis=0))
            values = values[:, : told.max(initial=-1) + 1]
            found = motor_outputs(parameters, rotors, values.shape[1], source, ardupilot)
            notes += filter(None, [found.problem])
            motors, which = found.columns, "(normalized)"
            if signal == "servo":
                values, how = in_pulses(values)
                motors = motors or ([] if found.problem else active_outputs(values))
                which = " ".join([*(str(i + 1) for i in motors), how]).strip()
            if motors:
                raw.append(RawChannel("motor_command", t, values[:, motors], f"{source} {which}"))
    return sorted(raw, key=lambda r: "ACTUATOR" not in r.source)
