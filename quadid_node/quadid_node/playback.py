"""A log as the stream that it once was, with the stamps a live service would have seen.

Logs in general are played in time order; a recording of the node itself in the order in which the messages came.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from mcap_ros2._dynamic import generate_dynamic
from quadid_replay.mcap_file import McapFile
from quadid_replay.ros_messages import type_name

from quadid.data.window import Block, Recording, Sample
from quadid.errors import LogError
from quadid_node.inputs import Chooser, Decoder, best_ranks, seconds, source

_BASE = re.compile(r"times count from UNIX time (\d+) s")


def base_seconds(recording: Recording) -> int:
    """UNIX time that the recording's times count from [s]; 0 when they are no UNIX times."""
    for note in recording.warnings:
        found = _BASE.search(note)
        if found is not None:
            return int(found[1])
    return 0


def stream(recording: Recording) -> Iterator[Sample]:
    """Yields all samples in time order, at equal times by channel; absolute where the log's times are.

    Times are brought back to whole nanoseconds, as they came in headers, so that a replayed log gives the numbers of
    the live run bit for bit.
    """
    base = base_seconds(recording) * 10**9
    names = list(recording.channels)
    if not names:
        return
    times = [recording.channels[n].t for n in names]
    which = np.concatenate([np.full(len(t), i) for i, t in enumerate(times)])
    rows = np.concatenate([np.arange(len(t)) for t in times])
    order = np.argsort(np.concatenate(times), kind="stable")
    for i, row in zip(which[order].tolist(), rows[order].tolist(), strict=True):
        channel = recording.channels[names[i]]
        ns = round(float(channel.t[row]) * 1e9) + base
        yield Sample(seconds(ns), names[i], tuple(channel.values[row].tolist()))


def arrivals(path: Path, preset: str, rotors: int) -> Iterator[Sample]:
    """Yields the samples of a node's recording as the node's session got them: the same numbers in the same order.

    Args:
        path: the recording.
        preset: whose topic names and types it holds.
        rotors: of the vehicle.

    Raises:
        LogError: a message definition that cannot be used.
    """
    file, inputs = McapFile(path), source(preset).inputs
    chooser = Chooser(best_ranks(inputs))
    decoders = {}
    for number, topic in file.topics.items():
        entry = next((e for e in inputs if e.topic == topic.name and e.type == type_name(topic.type)), None)
        if entry is None:
            continue
        try:
            decode = generate_dynamic(topic.type, topic.definition)[topic.type]
        except Exception as error:
            raise LogError(
                f"{path.name}: the definition of {topic.type} is damaged ({type(error).__name__})"
            ) from error
        decoders[number] = Decoder(entry, chooser, rotors, decode)
    for number, _, data in file.messages(decoders.keys()):
        for item in decoders[number].take([data]):
            yield from item.samples() if isinstance(item, Block) else [item]
