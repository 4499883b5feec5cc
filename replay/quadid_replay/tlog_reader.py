"""MAVLink telemetry logs: one vehicle's messages to channels on its boot clock."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from quadid.errors import LogError
from quadid.window import Recording
from quadid_replay.boot_clock import BootClock, Placed
from quadid_replay.clocks import LogClock
from quadid_replay.columns import Columns, RawChannel, assemble, fastest_first
from quadid_replay.esc_messages import extend_dialect
from quadid_replay.mavlink_decode import Decoder
from quadid_replay.mavlink_frames import FrameCount, iterate_frames
from quadid_replay.motors import active_outputs, ardupilot_motor_outputs, px4_rotor_count
from quadid_replay.tlog_messages import PREFERENCE, READERS, STATE_MESSAGES, Reading, boot_stamp, unix_seconds

_DIALECT = extend_dialect(ardupilotmega)
_WANTED = {n for n, m in _DIALECT.mavlink_map.items() if m.msgname in READERS or m.msgname in STATE_MESSAGES}
_INVALID, _ARDUPILOT = 8, 3
_ROTORCRAFT = {2: 4, 13: 6, 14: 8, 15: 3, 29: 12, 35: 10}
_BACKWARDS, _MOST_BACKWARDS = 0.5, 10
"""Boot time that falls by more than the first [s] more often than the second: no vehicle boots that often."""
_WIDTH = {"esc": 12, "servo": 16, "actuator": 32, "attitude": 4, "attitude_reference": 4, "battery": 1}


class _VehicleLog:
    """What one MAVLink component told: signals by (channel, message), parameters, type, clock."""

    def __init__(self) -> None:
        self.clock = LogClock()
        self.signals: dict[tuple[str, str], Columns] = {}
        self.parameters: dict[str, float] = {}
        self.kind = 0
        self.autopilot = _INVALID
        self.rotors = 0
        self._boot_clock: BootClock[list[Reading]] = BootClock()
        self._unix_offset: float | None = None
        self._last_stamp = 0.0
        self.backwards = 0
        self._esc_rows: dict[str, tuple[float | None, int, list[float]]] = {}

    def take(self, m: Any, received: float) -> None:
        """Takes one decoded message received at UNIX time `received` [s]."""
        name = m.get_type()
        if name == "HEARTBEAT":
            self.kind, self.autopilot = m.type, m.autopilot
        elif name == "PARAM_VALUE":
            self.parameters[str(m.param_id)] = float(m.param_value)
        elif name == "ESC_INFO":
            self.rotors = max(self.rotors, int(m.count))
        elif name == "SYSTEM_TIME":
            if m.time_unix_usec > 1e14:
                self._unix_offset = m.time_unix_usec * 1e-6 - m.time_boot_ms * 1e-3
        elif name != "RAW_IMU" or self.autopilot == _ARDUPILOT:  # elsewhere RAW_IMU counts in sensor units
            readings = READERS[name](m)
            if readings:
                boot = self._stamp(m)
                known = self._boot_clock
                self._note_all(
                    known.unstamped(readings, received) if boot is None else known.stamped(readings, boot, received)
                )

    def _stamp(self, m: Any) -> float | None:
        """Returns the message's own stamp on the boot clock [s]; None where it has none."""
        boot = boot_stamp(m, self._boot_clock.newest)
        if boot is not None and m.get_type() != "SERVO_OUTPUT_RAW":
            self.backwards += boot < self._last_stamp - _BACKWARDS
            self._last_stamp = boot
        unix = unix_seconds(m)
        return unix - self._unix_offset if unix is not None and self._unix_offset is not None else boot

    def _note_all(self, placed: list[Placed[list[Reading]]]) -> None:
        for readings, boot in placed:
            t = None if boot is None else self.clock.time(boot)
            for reading in readings:
                self._note(t, reading)

    def _note(self, t: float | None, reading: Reading) -> None:
        width = _WIDTH.get(reading.signal, 3)
        columns = self.signals.setdefault((reading.signal, reading.source), Columns(width))
        if reading.signal == "esc":
            self._note_escs(t, reading, columns)
        else:
            columns.add(t, [*reading.values, *([0.0] * (width - len(reading.values)))])

    def _note_escs(self, t: float | None, reading: Reading, columns: Columns) -> None:
        """Joins the messages of one round (four ESCs each, rising index) to one row at the time of the first."""
        if reading.place >= columns.width:
            return  # ESCs that no vehicle has
        key = reading.source
        started, last, row = self._esc_rows.get(key, (None, columns.width, []))
        if reading.place <= last:
            if row:
                columns.add(started, row)
            started, row = t, [float("nan")] * columns.width
        end = min(reading.place + len(reading.values), columns.width)
        row[reading.place : end] = reading.values[: end - reading.place]
        self._esc_rows[key] = (started, reading.place, row)

    def finish(self) -> None:
        """Adds what still waits: messages without a stamp and the last round of ESC messages."""
        self._note_all(self._boot_clock.finish())
        for (signal, source), columns in self.signals.items():
            started, _, row = self._esc_rows.get(source, (None, 0, []))
            if signal == "esc" and row:
                columns.add(started, row)


def read_tlog(path: Path) -> Recording:
    """Reads a telemetry log, whole or damaged; of several vehicles the one that tells most.

    Raises:
        LogError: no vehicle in it tells anything usable.
    """
    count = FrameCount()
    vehicles: dict[tuple[int, int], _VehicleLog] = {}
    bad = 0
    decoder = Decoder(_DIALECT, _WANTED)
    for frame in iterate_frames(path, count):
        if frame.message not in _WANTED:
            continue
        message = decoder.decode(frame.message, frame.data)
        if message is None:
            bad += 1
            continue
        sender = frame.system, frame.component
        if sender not in vehicles:
            vehicles[sender] = _VehicleLog()
        vehicles[sender].take(message, frame.received)
    if not any(v.signals for v in vehicles.values()):
        raise LogError(
            f"{path.name}: {count.frames} MAVLink frames but no measurements of a vehicle",
            "IMU, attitude, servo or ESC messages", "ask the autopilot for them (SR*_RAW_SENS, SR*_EXTRA1, MAV_*_MODE)",
        )  # fmt: skip
    for vehicle in vehicles.values():
        vehicle.finish()
    who = max(vehicles, key=lambda key: sum(len(c) for c in vehicles[key].signals.values()))
    notes = _notes(count, bad, path.stat().st_size)
    if vehicles[who].backwards > _MOST_BACKWARDS:
        raise LogError(
            f"{path.name}: boot time under system {who[0]} component {who[1]} falls back {vehicles[who].backwards} "
            "times: two vehicles under one system id", "one vehicle an id",
            "give each vehicle its own SYSID_THISMAV (MAV_SYS_ID) and record again, or record each link by itself",
        )  # fmt: skip
    others = [key for key, v in vehicles.items() if key != who and v.signals]
    if others:
        notes.append(f"vehicle {who[0]} used; also in the log: {', '.join(f'{s}/{c}' for s, c in others)}")
    raw = _channels(vehicles[who], notes)
    return assemble(path.name, "tlog", raw, vehicles[who].clock, notes, vehicles[who].parameters)


def _notes(count: FrameCount, bad: int, size: int) -> list[str]:
    notes = []
    if count.skipped:
        notes.append(f"{count.skipped} of {size} bytes are damaged and were skipped")
    if bad:
        notes.append(f"{bad} frames with a wrong checksum were refused")
    if count.cut:
        notes.append("the file ends inside a frame: it was cut; everything before is used")
    return notes


def _channels(vehicle: _VehicleLog, notes: list[str]) -> list[RawChannel]:
    raw: list[RawChannel] = []
    for channel, messages in PREFERENCE.items():
        found = []
        for message in messages:
            for (signal, source), columns in vehicle.signals.items():
                if signal == channel and source.split(" ")[0] == message:
                    found.append(RawChannel(channel, *columns.arrays(), source, columns.refused))
        raw += fastest_first(found, 2.0)
    return raw + _motors(vehicle, notes)


def _motors(vehicle: _VehicleLog, notes: list[str]) -> list[RawChannel]:
    """ESC rpm of as many rotors as the vehicle has; outputs that are motors."""
    if vehicle.kind and vehicle.kind not in _ROTORCRAFT:
        notes.append(f"the vehicle calls itself MAV_TYPE {vehicle.kind}, no multirotor: its outputs are not used")
        return []
    rotors = vehicle.rotors or px4_rotor_count(vehicle.parameters) or _ROTORCRAFT.get(vehicle.kind, 0)
    raw: list[RawChannel] = []
    for (signal, source), columns in vehicle.signals.items():
        t, values = columns.arrays()
        if signal == "esc":
            known = ~np.isnan(values).all(axis=0) & (np.nan_to_num(values) != 0.0).any(axis=0)
            width = rotors or int(np.count_nonzero(known))
            raw.append(RawChannel("rotor_speed", t, values[:, :width], f"{source} (rpm)", columns.refused))
        elif signal == "servo":
            motors = ardupilot_motor_outputs(vehicle.parameters) or list(range(rotors)) or active_outputs(values)
            label = f"{source} {' '.join(str(i + 1) for i in motors)}"
            if motors:
                raw.append(RawChannel("motor_command", t, values[:, motors], label, columns.refused))
        elif signal == "actuator" and rotors:
            raw.append(RawChannel("motor_command", t, values[:, :rotors], f"{source} (normalized)", columns.refused))
    order: Iterable[RawChannel] = sorted(raw, key=lambda r: "ACTUATOR" not in r.source)
    return list(order)
