"""ROS 2 logs: picks the topics, decodes them, and brings their stamps onto one clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from mcap_ros2._dynamic import generate_dynamic

from quadid.errors import LogError
from quadid.resample import fresh_rows
from quadid.sanitise import plain
from quadid.window import Recording
from quadid_replay.bag_topics import Topic
from quadid_replay.columns import Columns, RawChannel, assemble, fastest_first
from quadid_replay.mcap_decode import Source, decode_messages, source_of
from quadid_replay.mcap_messages import SIGNALS, TYPES, type_name
from quadid_replay.motors import active_outputs
from quadid_replay.presets import AUTO, preset_rank
from quadid_replay.rosbag2_files import Bag, open_bag


def read_mcap(path: Path, preset: str = AUTO) -> Recording:
    """Reads a ROS 2 log, whole or damaged: an MCAP file, a rosbag2 database or a rosbag2 folder.

    Args:
        path: the file or folder.
        preset: key of `quadid_replay.presets.PRESETS`, or ``auto``.

    Raises:
        LogError: no topic of a known type, or unknown preset.
    """
    bag = open_bag(path)
    notes: list[str] = []
    sources = _sources(bag, preset, notes)
    if not sources:
        raise _no_topic(path, bag, preset, notes)
    columns, stamps, failed = decode_messages(bag.messages(sources.keys()), sources)
    notes = [*bag.damage(), *notes]
    if failed:
        notes.append(f"{failed} messages could not be decoded and were dropped")
    if stamps.base_ns:
        notes.append(f"times count from UNIX time {stamps.base_ns // 10**9} s")
    recording = assemble(path.name, "mcap", _channels(columns, sources, preset), stamps.clock, notes)
    return replace(recording, epoch=float(stamps.base_ns // 10**9) if stamps.base_ns else None)


def _sources(bag: Bag, preset: str, notes: list[str]) -> dict[int, Source]:
    """Picks the topics whose type is known and whose name the preset lists for one of its channels."""
    sources = {}
    for number, topic in bag.topics.items():
        if not topic.type and topic.unread:
            notes.append(f"{topic.name}: {topic.unread}: not read; record it with a ros2msg definition")
        kind = TYPES.get(type_name(topic.type))
        if kind is None or topic.encoding != "cdr":
            continue
        listed = [preset_rank(preset, channel, topic.name) for channel in {c for c, _ in SIGNALS.values()}]
        if all(rank is None for rank in listed):
            continue
        try:
            decode = _decoder(topic.type, topic.definition)
        except Exception as error:  # noqa: BLE001 - the parser of untrusted definitions raises anything; it is reported
            notes.append(f"{topic.name}: its message definition is damaged ({type(error).__name__}): not used")
            continue
        sources[number] = source_of(topic, kind, decode)
    return sources


@lru_cache(maxsize=64)
def _decoder(kind: str, definition: str) -> Callable[[bytes], Any]:
    """The library's decoder of a type; making one costs more than decoding a hundred messages."""
    decode: Callable[[bytes], Any] = generate_dynamic(kind, definition)[kind]
    return decode


def _channels(columns: dict[tuple[int, str], Columns], sources: dict[int, Source], preset: str) -> list[RawChannel]:
    """Makes channels of the columns; of several topics for one channel the best comes first."""
    ranked: dict[str, list[tuple[int, RawChannel]]] = {}
    for (number, signal), kept in columns.items():
        channel, convert = SIGNALS[signal]
        topic = sources[number].topic
        rank = preset_rank(preset, channel, topic.name)
        t, values = kept.arrays()
        values = _motor_columns(signal, values)
        if rank is None or len(t) == 0 or values.shape[1] == 0 or _unused(signal, topic, values):
            continue
        source = f"{topic.name} ({type_name(topic.type)})"
        rank += 5 if signal == "pose_attitude" else 0
        with np.errstate(over="ignore", invalid="ignore"):  # damaged numbers are dropped further on
            converted = convert(values)
        ranked.setdefault(channel, []).append((rank, RawChannel(channel, t, converted, source, kept.refused)))
    out = []
    for entries in ranked.values():
        ordered = [entry for _, entry in sorted(entries, key=lambda pair: pair[0])]
        if ordered[0].name in ("gyro", "accel"):
            ordered.sort(key=_repeats)
        out += ordered if preset != AUTO else fastest_first(ordered, 1.5)
    return out


def _motor_columns(signal: str, values: np.ndarray[Any, np.dtype[np.float64]]) -> np.ndarray[Any, np.dtype[np.float64]]:
    """Keeps the columns that are motors, of messages with room for more."""
    if signal == "outputs":
        return values[:, active_outputs(values)]
    if signal == "actuator_motors":
        return values[:, np.isfinite(values).any(axis=0)]
    return values


def _unused(signal: str, topic: Topic, values: np.ndarray[Any, np.dtype[np.float64]]) -> bool:
    """Fields that a driver left alone: a constant identity attitude, efforts that are no commands, body twists."""
    if signal in ("attitude", "pose_attitude"):
        return bool(np.all(values == values[0]) and np.isin(values[0], (0.0, 1.0)).all())
    if signal == "motor_command" and type_name(topic.type) == "sensor_msgs/JointState":
        return bool(np.nanmin(values) < -0.05 or not np.any(values))
    return signal == "velocity" and "body" in topic.name


def _repeats(entry: RawChannel) -> bool:
    """Tells a topic that repeats readings, as MAVROS' imu/data repeats the acceleration."""
    return len(fresh_rows(entry.values)) < 0.9 * len(entry.values)


def _no_topic(path: Path, bag: Bag, preset: str, notes: list[str]) -> LogError:
    unread = "type without a readable definition"
    found = ", ".join(f"{t.name} [{type_name(t.type) or t.unread or unread}]" for t in list(bag.topics.values())[:5])
    damage = plain("; ".join([*bag.damage(), *notes[:4]]), 600)
    reason = f" ({damage})" if damage else ""
    if damage and not bag.topics:
        fix = "copy it again; `mcap recover` may save a part of an MCAP file"
        return LogError(f"{path.name}: nothing in it can be read{reason}", "a whole log", fix)
    return LogError(
        f"{path.name}: no topic to read with preset '{preset}' among: {found or 'none'}{reason}",
        "topics of types " + ", ".join(list(TYPES)[:6]) + " …",
        "choose another preset, or record the topics of docs/logs.md",
    )
