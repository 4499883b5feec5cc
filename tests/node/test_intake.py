"""Messages read a batch at a time: the samples, and the recording, are those of one message after the other."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from quadid_node.inputs import MEMORY, SLICE, Chooser, Decoder, Input, Intake, best_ranks, source
from quadid_replay import write_mcap
from quadid_replay.mcap_file import McapFile
from quadid_replay.schemas import schema_text

from quadid.data.window import Block, Sample
from quadid.flight import fly
from quadid.vehicle import Vehicle

Message = tuple[str, bytes]
SECONDS = 3.0
INPUTS = source("canonical").inputs


@pytest.fixture(scope="module")
def messages(tmp_path_factory: pytest.TempPathFactory) -> list[Message]:
    flown = fly(Vehicle.shipped("pelican"), seconds=SECONDS, seed=1, log_rate=200.0, extras=["velocity", "battery"])
    path = tmp_path_factory.mktemp("intake") / "k.mcap"
    write_mcap(path, flown.recording, 1_700_000_000 * 10**9)
    file = McapFile(path)
    return [(file.topics[number].name, data) for number, _, data in file.messages(file.topics.keys())]


def decoder(entry: Input, chooser: Chooser, mounted: bool = True) -> Decoder:
    kind = entry.type.replace("/", "/msg/")
    decode = generate_dynamic(kind, schema_text(kind))[kind]
    return Decoder(entry, chooser, 4, decode, mounted)


def flat(items: Iterator[Sample | Block]) -> list[Sample]:
    return [s for item in items for s in (item.samples() if isinstance(item, Block) else [item])]


def by_intake(messages: list[Message], batch: int) -> tuple[list[Sample], list[Message], int]:
    """Samples, what was recorded, and how many blocks there were, when taken in every `batch` messages."""
    chooser, now = Chooser(best_ranks(INPUTS)), [0.0]
    intake = Intake(lambda: now[0])
    arrived: dict[str, deque[bytes]] = {e.topic: deque() for e in INPUTS}
    for e in INPUTS:
        waiting = arrived[e.topic]
        intake.open(e, e.topic, decoder(e, chooser), lambda q=waiting: q.popleft() if q else None)  # type: ignore[misc]
    out: list[Sample] = []
    recorded: list[Message] = []
    blocks = 0
    for k in range(0, len(messages), batch):
        for topic, data in messages[k : k + batch]:
            arrived[topic].append(data)
        now[0] = min(k + batch, len(messages)) * SECONDS / len(messages)
        read = intake.read(intake.take(), lambda topic, kind, data: recorded.append((topic, data)))
        items = [item for topic in read for item in topic]
        blocks += sum(isinstance(item, Block) for item in items)
        out += flat(iter(items))
    return out, recorded, blocks


def one_by_one(messages: list[Message]) -> list[Sample]:
    chooser = Chooser(best_ranks(INPUTS))
    known = {e.topic: decoder(e, chooser) for e in INPUTS}
    return [s for topic, data in messages for s in flat(known[topic].take([data]))]


@pytest.mark.parametrize("batch", [1, 7, 60])
def test_a_batch_gives_the_samples_of_its_messages_in_the_order_recorded(messages: list[Message], batch: int) -> None:
    samples, recorded, blocks = by_intake(messages, batch)
    assert sorted(recorded) == sorted(messages)
    assert samples == one_by_one(recorded)
    assert blocks > 0
    assert {s.channel for s in samples} >= {"gyro", "accel", "attitude", "rotor_speed", "velocity"}


def test_the_gyro_comes_last(messages: list[Message]) -> None:
    _, recorded, _ = by_intake(messages, 60)
    topics = [topic for topic, _ in recorded[:60]]
    assert topics.index("imu") == len(topics) - topics.count("imu")


def test_no_topic_runs_far_ahead_when_much_has_piled_up(messages: list[Message]) -> None:
    _, recorded, _ = by_intake(messages, len(messages))
    at = {topic: [k for k, (name, _) in enumerate(messages) if name == topic] for topic, _ in messages}
    arrived = [at[topic].pop(0) for topic, _ in recorded]
    per_second = len(messages) / SECONDS
    behind = max(newest - k for newest, k in zip(np.maximum.accumulate(arrived), arrived, strict=True)) / per_second
    assert 0.0 < behind < 1.2 * SLICE < 0.1 * SECONDS


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        ("base_link", False), ("quad1/base_link_frd", False), ("", False), ("fcu", False),
        ("imu_link", True), ("base_link/imu", True), ("rebase_link", True),
    ],
)  # fmt: skip
def test_an_imu_in_a_frame_of_its_own_is_told_unless_its_mounting_is_given(
    messages: list[Message], frame: str, told: bool
) -> None:
    entry = next(e for e in INPUTS if e.topic == "imu")
    (type_name, text) = ("sensor_msgs/msg/Imu", schema_text("sensor_msgs/msg/Imu"))
    decode = generate_dynamic(type_name, text)[type_name]
    encode = serialize_dynamic(type_name, text)[type_name]
    original = [data for topic, data in messages if topic == "imu"][:20]
    framed = []
    for data in original:
        message = decode(data)
        message.header.frame_id = frame
        framed.append(encode(message))
    attitude = next(e for e in INPUTS if e.topic == "attitude")
    for mounted in (False, True):
        chooser = Chooser(best_ranks(INPUTS))
        assert flat(decoder(attitude, chooser).take([data for topic, data in messages if topic == "attitude"]))
        reader = decoder(entry, chooser, mounted)
        assert len(flat(reader.take(original))) == 40
        assert reader.trouble == ""
        assert len(flat(reader.take(framed))) == 40
        assert reader.trouble == (
            f"is measured in {frame}, not base_link: say mounting: {{rotation, position}} in the vehicle file"
            if told and not mounted else ""
        )  # fmt: skip


def test_a_damaged_message_spoils_only_itself(messages: list[Message]) -> None:
    imu = [data for topic, data in messages if topic == "imu"][:40]
    imu[20] = imu[20][:30]
    entry = next(e for e in INPUTS if e.topic == "imu")
    whole = decoder(entry, Chooser(best_ranks(INPUTS)))
    single = decoder(entry, Chooser(best_ranks(INPUTS)))
    assert flat(whole.take(imu)) == [s for data in imu for s in flat(single.take([data]))]
    assert whole.failed == single.failed == 1


def test_messages_without_a_stamp_are_named_as_such(messages: list[Message]) -> None:
    imu = [data[:4] + bytes(8) + data[12:] for topic, data in messages if topic == "imu"][:5]
    entry = next(e for e in INPUTS if e.topic == "imu")
    reader = decoder(entry, Chooser(best_ranks(INPUTS)))
    assert flat(reader.take(imu)) == []
    assert "5 messages have no time" in reader.trouble
    reader.pace.look(0.9 * MEMORY, 0.0, 0)
    assert "5 messages have no time" in reader.trouble
    reader.pace.look(1.1 * MEMORY, MEMORY, 1)
    assert reader.trouble == "", "all that came since had one"


def test_messages_that_cannot_be_read_are_named_as_long_as_they_come(messages: list[Message]) -> None:
    entry = next(e for e in INPUTS if e.topic == "imu")
    reader = decoder(entry, Chooser(best_ranks(INPUTS)))
    for now in (0.0, 0.9 * MEMORY, 1.8 * MEMORY):
        reader.pace.look(now, now - 0.1, 1)
        assert flat(reader.take([b"no message"])) == []
        assert reader.trouble == f"{reader.failed} messages could not be read"
    reader.pace.look(3.0 * MEMORY, 2.9 * MEMORY, 1)
    assert (reader.failed, reader.trouble) == (3, "")
