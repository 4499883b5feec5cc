"""MAVLink telemetry logs: one vehicle's messages to channels on its boot clock."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import numpy as np
from pymavlink.dialects.v20 import ardupilotmega

from quadid.errors import LogError
from quadid.types import IntArray
from quadid.window import Recording
from quadid_replay.columns import RawChannel, assemble, fastest_first
from quadid_replay.esc_messages import extend_dialect
from quadid_replay.frame_numbers import two_rows
from quadid_replay.mavlink_decode import decode, intact
from quadid_replay.mavlink_frames import Frames, read_frames
from quadid_replay.motors import (
    MULTIROTORS,
    active_outputs,
    esc_columns,
    in_pulses,
    motor_outputs,
    no_multirotor,
    px4_rotor_count,
)
from quadid_replay.tlog_messages import PREFERENCE, READERS, STATE_MESSAGES
from quadid_replay.tlog_vehicle import Told, VehicleLog, vehicle_log

_DIALECT = extend_dialect(ardupilotmega)
_WANTED = {n: m for n, m in _DIALECT.mavlink_map.items() if m.msgname in READERS or m.msgname in STATE_MESSAGES}
_MOST_BACKWARDS = 10
"""Boot time that falls more often: no vehicle boots that often."""
_MOST_SENDERS = 32
"""Of more, those with the fewest frames are not looked into: damage makes senders, and none of them is the vehicle."""
_NAMED = 8
"""Other vehicles that are named; more are counted."""


def read_tlog(path: Path) -> Recording:
    """Reads a telemetry log, whole or damaged; of several vehicles the one that tells most.

    Raises:
        LogError: no vehicle in it tells anything usable.
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
            "IMU, attitude, servo or ESC messages", "ask the autopilot for them (SR*_RAW_SENS, SR*_EXTRA1, MAV_*_MODE)",
        )  # fmt: skip
    who = max(vehicles, key=lambda key: sum(len(s.t) for s in vehicles[key].signals.values()))
    notes = _notes(frames, len(which) - int(np.count_nonzero(whole)))
    if vehicles[who].backwards > _MOST_BACKWARDS:
        raise LogError(
            f"{path.name}: boot time under system {who[0]} component {who[1]} falls back {vehicles[who].backwards} "
            "times: two vehicles under one system id", "one vehicle an id",
            "give each vehicle its own SYSID_THISMAV (MAV_SYS_ID) and record again, or record each link by itself",
        )  # fmt: skip
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
    raw = _channels(vehicles[who], notes)
    return assemble(path.name, "tlog", raw, vehicles[who].clock, notes, vehicles[who].parameters)


def _vehicles(frames: Frames, which: IntArray) -> dict[tuple[int, int], VehicleLog]:
    """What each system and component tells in the frames `which`, in the order in which they are first heard; of many
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
            told[kind.msgname] = Told(of_it, decode(frames, kind, of_it))
        out[int(one) >> 8, int(one) & 0xFF] = vehicle_log(told, frames.received)
    return out


def _notes(frames: Frames, bad: int) -> list[str]:
    notes = []
    if frames.skipped:
        notes.append(f"{frames.skipped} of {len(frames.data)} bytes are damaged and were skipped")
    if bad:
        notes.append(f"{bad} frames with a wrong checksum were refused")
    if frames.cut:
        notes.append("the file ends inside a frame: it was cut; everything before is used")
    return notes


def _channels(vehicle: VehicleLog, notes: list[str]) -> list[RawChannel]:
    raw: list[RawChannel] = []
    for channel, messages in PREFERENCE.items():
        found = []
        for message in messages:
            for (signal, source), (t, values, refused) in vehicle.signals.items():
                if signal == channel and source.split(" ")[0] == message:
                    found.append(RawChannel(channel, t, values, source, refused))
        raw += fastest_first(found, 2.0)
    return raw + _motors(vehicle, notes)


def _motors(vehicle: VehicleLog, notes: list[str]) -> list[RawChannel]:
    """Rotor speeds and outputs, each of the motors in their order."""
    if other := no_multirotor(vehicle.parameters, vehicle.kind):
        notes.append(other)
        return []
    rotors = vehicle.rotors or px4_rotor_count(vehicle.parameters) or MULTIROTORS.get(vehicle.kind, 0)
    notes += [vehicle.changed] if vehicle.changed else []
    raw: list[RawChannel] = []
    for (signal, source), (t, values, refused) in vehicle.signals.items():
        if signal == "esc":
            turning = (np.nan_to_num(values) != 0.0).any(axis=0)
            found = esc_columns(vehicle.parameters, rotors, turning, source, vehicle.ardupilot)
            notes += [found.problem] if found.problem else []
            raw.append(RawChannel("rotor_speed", t, values[:, found.columns], f"{source} (rpm)", refused))
        elif signal in ("servo", "actuator"):
            told = np.flatnonzero(np.isfinite(values).any(axis=0))
            values = values[:, : told.max(initial=-1) + 1]
            found = motor_outputs(vehicle.parameters, rotors, values.shape[1], source, vehicle.ardupilot)
            notes += [found.problem] if found.problem else []
            values, how = in_pulses(values) if signal == "servo" else (values, "")
            guessed = active_outputs(values) if signal == "servo" and not found.problem else []
            motors = found.columns or guessed
            which = " ".join(str(i + 1) for i in motors) + how if signal == "servo" else "(normalized)"
            if motors:
                raw.append(RawChannel("motor_command", t, values[:, motors], f"{source} {which}", refused))
    order: Iterable[RawChannel] = sorted(raw, key=lambda r: "ACTUATOR" not in r.source)
    return list(order)
