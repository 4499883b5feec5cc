"""Any split of the messages into batches gives the same rows, bit for bit: in whole, changing and damaged logs."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2.writer import Writer as RosWriter
from quadid_replay import ros_messages as mcap_decode
from quadid_replay import write_mcap
from quadid_replay.formats import read_here
from quadid_replay.mcap_file import Topic
from quadid_replay.ros_messages import MessageReader, MessageType, TopicSource, decode_messages
from quadid_replay.schemas import schema_text

from quadid.data.window import Recording
from quadid.errors import LogError
from tests.replay.synthetic import full_recording
from tests.replay.test_mcap import EPOCH, header, imu

Message = dict[str, Any]
STEP = 10_000_000
"""Nanoseconds from one message to the next."""


def both_ways(path: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[Recording | str, int]:
    """Reads a log in batches of any size, checks that they agree, and returns it and how often messages were decoded
    by the library when batches are as large as they are.
    """
    decodings = 0
    learn = MessageReader._learn

    def watched(reader: MessageReader, *told: Any) -> None:
        nonlocal decodings
        decodings += 1
        learn(reader, *told)

    def recording() -> Recording | str:
        try:
            return read_here(path, "auto")
        except LogError as error:
            return str(error)

    with monkeypatch.context() as patch:
        patch.setattr(MessageReader, "_learn", watched)
        whole = recording()
    for size in (1, 7, 100):
        with monkeypatch.context() as patch:
            patch.setattr(mcap_decode, "BATCH", size)
            split = recording()
        assert type(whole) is type(split)
        if isinstance(whole, str) or isinstance(split, str):
            assert whole == split
            continue
        assert (whole.warnings, whole.breaks, list(whole.channels)) == (
            split.warnings,
            split.breaks,
            list(split.channels),
        )
        for name, channel in whole.channels.items():
            other = split.channels[name]
            assert channel.t.tobytes() == other.t.tobytes(), name
            assert channel.values.tobytes() == other.values.tobytes(), name
            assert (channel.source, channel.faults) == (other.source, other.faults)
    return whole, decodings


def write(path: Path, messages: list[tuple[str, Message, int]]) -> None:
    """Writes messages of sensor_msgs types: type, content, log time [ns]."""
    with path.open("wb") as stream, RosWriter(stream, chunk_size=4096) as writer:
        schemas: dict[str, Any] = {}
        for kind, message, ns in messages:
            if kind not in schemas:
                schemas[kind] = writer.register_msgdef(f"sensor_msgs/msg/{kind}", schema_text(f"sensor_msgs/{kind}"))
            writer.write_message(kind.lower(), schemas[kind], message, ns)


def flown(count: int = 800) -> list[tuple[str, Message, int]]:
    """Messages of an IMU with moving numbers and of four rotors."""
    rng = np.random.default_rng(0)
    out: list[tuple[str, Message, int]] = []
    for k in range(count):
        ns = EPOCH + k * STEP + int(rng.integers(0, STEP // 2))
        names = [f"rotor_{i}" for i in range(1, 5)]
        speeds = {"header": header(ns), "name": names, "velocity": [400.0 + float(v) for v in rng.standard_normal(4)]}
        out += [("Imu", imu(ns, float(rng.standard_normal()), 9.8 + float(rng.standard_normal()), 0.1), ns)]
        out += [("JointState", speeds, ns)]
    return out


def test_whole_log_is_read_in_batches(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    write_mcap(tmp_path / "log", full_recording(20.0))
    recording, decodings = both_ways(tmp_path / "log", monkeypatch)
    assert isinstance(recording, Recording)
    assert "gyro" in recording.channels
    assert decodings < 0.1 * len(recording.channels["gyro"].t)


def _absent_force(messages: list[tuple[str, Message, int]]) -> None:
    """From its middle on the IMU says that it has no accelerometer (REP-145)."""
    for kind, message, _ in messages[len(messages) // 2 :]:
        if kind == "Imu":
            message["linear_acceleration_covariance"] = [-1.0] + [0.0] * 8


def _other_names(messages: list[tuple[str, Message, int]]) -> None:
    for kind, message, _ in messages[len(messages) // 2 :: 3]:
        if kind == "JointState":
            message["name"] = ["front", "right", "back", "left"]


def _fewer_rotors(messages: list[tuple[str, Message, int]]) -> None:
    for kind, message, _ in messages[600:900]:
        if kind == "JointState":
            message["velocity"] = message["velocity"][:3]


def _no_stamps(messages: list[tuple[str, Message, int]]) -> None:
    for _, message, _ in messages[700:760]:
        message["header"] = header(0)


def _clock_steps_back(messages: list[tuple[str, Message, int]]) -> None:
    for _, message, ns in messages[900:]:
        message["header"] = header(ns - 40 * 10**9)


def _wild_stamp(messages: list[tuple[str, Message, int]]) -> None:
    messages[1000][1]["header"] = header(EPOCH + 10**13)


def _no_numbers(messages: list[tuple[str, Message, int]]) -> None:
    for _, message, _ in messages[500:1100:7]:
        if "angular_velocity" in message:
            message["angular_velocity"]["x"] = float("nan")


@pytest.mark.parametrize(
    "change",
    [_absent_force, _other_names, _fewer_rotors, _no_stamps, _clock_steps_back, _wild_stamp, _no_numbers],
    ids=lambda change: change.__name__.strip("_"),
)
def test_logs_that_change_on_the_way(
    change: Callable[[list[tuple[str, Message, int]]], None], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    messages = flown()
    change(messages)
    write(tmp_path / "log", messages)
    recording, decodings = both_ways(tmp_path / "log", monkeypatch)
    assert isinstance(recording, Recording)
    assert decodings < 0.5 * len(messages)


def test_types_without_a_layout_are_read_one_by_one() -> None:
    def unread(data: bytes) -> Any:
        raise ValueError(data)

    kind = MessageType((lambda m: [0.0],), lambda runs, extra: [("battery", runs[0], True)], stamp=lambda m: 1)
    source = TopicSource(Topic("t", "k", "", "cdr"), kind, MessageReader(kind, unread))
    assert decode_messages([(1, 0, b"x")], {1: source}).failed == 1
