"""Messages read a batch at a time, and the node's own recording of them."""

import json
import os
import struct
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap_ros2._dynamic import generate_dynamic, serialize_dynamic
from quadid_node.history import Restored
from quadid_node.inputs import MEMORY, SLICE, Decoder, Input, Intake, SourceSelector, best_ranks, source
from quadid_node.recording import RECORD, Beginning, Recorder, arrivals, read_beginning, stream
from quadid_replay import TopicWriter, open_log, write_mcap
from quadid_replay.mcap_file import McapFile, read_metadata
from quadid_replay.schemas import schema_text

from quadid.condition.trim import FlightTrim, flight_to_dict
from quadid.data.window import Block
from quadid.errors import LogError
from quadid.flight import fly
from quadid.online import SessionSettings
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import flight
from tests.online.test_gate import TRUE, online_set
from tests.samples import Sample, flat

# --- Messages read a batch at a time: the samples, and the recording, are those of one message after the other


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


def decoder(entry: Input, chooser: SourceSelector, mounted: bool = True) -> Decoder:
    kind = entry.type.replace("/", "/msg/")
    decode = generate_dynamic(kind, schema_text(kind))[kind]
    return Decoder(entry, chooser, 4, decode, mounted)


def by_intake(messages: list[Message], batch: int) -> tuple[list[Sample], list[Message]]:
    """Samples, and what was recorded, when taken in every `batch` messages."""
    chooser, now = SourceSelector(best_ranks(INPUTS)), [0.0]
    intake = Intake(lambda: now[0])
    arrived: dict[str, deque[bytes]] = {e.topic: deque() for e in INPUTS}
    for e in INPUTS:
        waiting = arrived[e.topic]
        intake.open(e, e.topic, decoder(e, chooser), lambda q=waiting: q.popleft() if q else None)  # type: ignore[misc]
    out: list[Sample] = []
    recorded: list[Message] = []
    for k in range(0, len(messages), batch):
        for topic, data in messages[k : k + batch]:
            arrived[topic].append(data)
        now[0] = min(k + batch, len(messages)) * SECONDS / len(messages)
        read = intake.read(intake.take(), lambda topic, kind, data: recorded.append((topic, data)))
        out += flat(read)
    return out, recorded


def one_by_one(messages: list[Message]) -> list[Sample]:
    chooser = SourceSelector(best_ranks(INPUTS))
    known = {e.topic: decoder(e, chooser) for e in INPUTS}
    return [s for topic, data in messages for s in flat(known[topic].take([data]))]


@pytest.mark.parametrize("batch", [1, 7, 60])
def test_a_batch_gives_the_samples_of_its_messages_in_the_order_recorded(messages: list[Message], batch: int) -> None:
    samples, recorded = by_intake(messages, batch)
    assert sorted(recorded) == sorted(messages)
    assert samples == one_by_one(recorded)
    assert {s.channel for s in samples} >= {"gyro", "accel", "attitude", "rotor_speed", "velocity"}


def test_the_gyro_comes_last(messages: list[Message]) -> None:
    _, recorded = by_intake(messages, 60)
    topics = [topic for topic, _ in recorded[:60]]
    assert topics.index("imu") == len(topics) - topics.count("imu")


def test_no_topic_runs_far_ahead_when_much_has_piled_up(messages: list[Message]) -> None:
    _, recorded = by_intake(messages, len(messages))
    at = {topic: [k for k, (name, _) in enumerate(messages) if name == topic] for topic, _ in messages}
    arrived = [at[topic].pop(0) for topic, _ in recorded]
    per_second = len(messages) / SECONDS
    behind = max(newest - k for newest, k in zip(np.maximum.accumulate(arrived), arrived, strict=True)) / per_second
    assert 0.0 < behind < 1.2 * SLICE < 0.1 * SECONDS


@pytest.mark.parametrize(
    ("frame", "told"),
    [
        ("base_link", False),
        ("quad1/base_link_frd", False),
        ("", False),
        ("fcu", False),
        ("imu_link", True),
        ("base_link/imu", True),
        ("rebase_link", True),
    ],
)
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
        chooser = SourceSelector(best_ranks(INPUTS))
        assert flat(decoder(attitude, chooser).take([data for topic, data in messages if topic == "attitude"]))
        reader = decoder(entry, chooser, mounted)
        assert len(flat(reader.take(original))) == 40
        assert reader.trouble == ""
        assert len(flat(reader.take(framed))) == 40
        assert reader.trouble == (
            f"is measured in {frame}, not base_link: say mounting: {{rotation, position}} in the vehicle file"
            if told and not mounted
            else ""
        )


def test_a_damaged_message_spoils_only_itself(messages: list[Message]) -> None:
    imu = [data for topic, data in messages if topic == "imu"][:40]
    imu[20] = imu[20][:30]
    entry = next(e for e in INPUTS if e.topic == "imu")
    whole = decoder(entry, SourceSelector(best_ranks(INPUTS)))
    single = decoder(entry, SourceSelector(best_ranks(INPUTS)))
    assert flat(whole.take(imu)) == [s for data in imu for s in flat(single.take([data]))]
    assert whole.failed == single.failed == 1


def test_messages_whose_arrays_are_numpys_are_read_as_others(messages: list[Message]) -> None:
    """As ROS' own decoder makes them: a live IMU was not read for a while."""
    imu = [data for topic, data in messages if topic == "imu"][:5]
    entry, name = next(e for e in INPUTS if e.topic == "imu"), "sensor_msgs/msg/Imu"
    decode = generate_dynamic(name, schema_text(name))[name]

    def with_arrays(data: bytes) -> Any:
        message = decode(data)
        for field in ("orientation", "angular_velocity", "linear_acceleration"):
            setattr(message, f"{field}_covariance", np.array(getattr(message, f"{field}_covariance")))
        return message

    reader = Decoder(entry, SourceSelector(best_ranks(INPUTS)), 4, with_arrays)
    assert flat(reader.take(imu)) == flat(decoder(entry, SourceSelector(best_ranks(INPUTS))).take(imu)) != []


def imu_decoder() -> Decoder:
    """Decoder of the IMU beside a topic that tells the attitude."""
    chooser = SourceSelector(best_ranks(INPUTS))
    assert list(chooser.take(Block.one(0.0, "attitude", (1.0, 0.0, 0.0, 0.0)), 0))
    return decoder(next(e for e in INPUTS if e.topic == "imu"), chooser)


def sent(messages: list[Message], burst: int) -> tuple[Intake, Decoder]:
    """The IMU alone, looked for ten times a second of its own clock; sent `burst` messages together."""
    now, entry, waiting = [0.0], next(e for e in INPUTS if e.topic == "imu"), deque[bytes]()
    intake, reader = Intake(lambda: now[0]), imu_decoder()
    intake.open(entry, "imu", reader, lambda: waiting.popleft() if waiting else None)
    held, step = list[bytes](), 0
    for k, data in enumerate(data for topic, data in messages if topic == "imu"):
        held.append(data)
        if len(held) == burst:
            waiting.extend(held)
            held.clear()
        while (k + 1) / 200.0 >= 0.1 * (step + 1):
            now[0], step = 0.1 * (step + 1), step + 1
            flat(intake.read(intake.take()))
    return intake, reader


@pytest.mark.parametrize(("burst", "told"), [(1, ""), (100, "comes in bursts: 100 messages at once after")])
def test_messages_that_are_sent_in_bursts_are_named(messages: list[Message], burst: int, told: str) -> None:
    intake, _ = sent(messages, burst)
    assert intake.troubles().get("imu", "").startswith(told)
    assert bool(intake.troubles()) == bool(told)


@pytest.mark.parametrize(("burst", "told"), [(1, ""), (10, "stamped in bursts")])
def test_stamps_of_the_moment_of_sending_are_named_where_messages_are_sent_together(
    messages: list[Message], burst: int, told: str
) -> None:
    stamped = list[Message]()
    for k, data in enumerate(data for topic, data in messages if topic == "imu"):
        ns = round((k // burst * burst / 200.0 + 1e-5 * (k % burst)) * 1e9)
        stamped.append(("imu", data[:4] + struct.pack("<II", 1_700_000_000 + ns // 10**9, ns % 10**9) + data[12:]))
    assert sent(stamped, 1)[1].trouble.startswith(told)
    assert bool(sent(stamped, 1)[1].trouble) == bool(told)


def test_a_signal_that_messages_say_not_to_have_is_named_where_nothing_else_tells_it(messages: list[Message]) -> None:
    name = "sensor_msgs/msg/Imu"
    decode = generate_dynamic(name, schema_text(name))[name]
    encode = serialize_dynamic(name, schema_text(name))[name]
    without = list[bytes]()
    for data in (data for topic, data in messages if topic == "imu"):
        message = decode(data)
        message.angular_velocity_covariance[0] = -1.0
        without.append(encode(message))
    reader = imu_decoder()
    assert {s.channel for s in flat(reader.take(without))} == {"accel"}
    assert "angular_velocity_covariance[0] is -1" in reader.trouble


def test_messages_without_a_stamp_are_named_as_such(messages: list[Message]) -> None:
    imu = [data[:4] + bytes(8) + data[12:] for topic, data in messages if topic == "imu"][:5]
    entry = next(e for e in INPUTS if e.topic == "imu")
    reader = decoder(entry, SourceSelector(best_ranks(INPUTS)))
    assert flat(reader.take(imu)) == []
    assert "5 messages have no time" in reader.trouble
    reader.pace.look(0.9 * MEMORY, 0.0, 0)
    assert "5 messages have no time" in reader.trouble
    reader.pace.look(1.1 * MEMORY, MEMORY, 1)
    assert reader.trouble == "", "all that came since had one"


def test_messages_that_cannot_be_read_are_named_as_long_as_they_come(messages: list[Message]) -> None:
    entry = next(e for e in INPUTS if e.topic == "imu")
    reader = decoder(entry, SourceSelector(best_ranks(INPUTS)))
    for now in (0.0, 0.9 * MEMORY, 1.8 * MEMORY):
        reader.pace.look(now, now - 0.1, 1)
        assert flat(reader.take([b"no message"])) == []
        assert reader.trouble == f"{reader.failed} messages could not be read"
    reader.pace.look(3.0 * MEMORY, 2.9 * MEMORY, 1)
    assert (reader.failed, reader.trouble) == (3, "")


@pytest.mark.parametrize(("kind", "used"), [(2, True), (0, True), (1, False), (22, False)])
def test_outputs_of_a_plane_are_no_rotors_on_live_topics_either(kind: int, used: bool) -> None:
    inputs = source("px4").inputs
    chooser = SourceSelector(best_ranks(inputs))
    layouts = {
        "px4_msgs/VehicleStatus": ("uint64 timestamp\nuint8 system_type\n", {"timestamp": 10**6, "system_type": kind}),
        "px4_msgs/ActuatorMotors": (
            "uint64 timestamp\nfloat32[12] control\n",
            {"timestamp": 10**6, "control": [0.5] * 12},
        ),
    }
    taken: list[Sample] = []
    for name, (layout, message) in layouts.items():
        entry = next(e for e in inputs if e.type == name)
        full = name.replace("/", "/msg/")
        reader = Decoder(entry, chooser, 4, generate_dynamic(full, layout)[full])
        taken += flat(reader.take([serialize_dynamic(full, layout)[full](message)] * 3))
        if "Status" in name:
            assert ("no multirotor" in reader.trouble) is not used
    # Commands are held back while a better source may come; what was refused is not.
    assert (bool(taken) or chooser.has("motor_command")) is used


# --- A node's own recording: what it begins with comes back exactly, and messages come back in the order of arrival


PELICAN = Vehicle.shipped("pelican")
EPOCH_NS = 1_700_000_000 * 10**9


def beginning() -> Beginning:
    last = replace(online_set(TRUE), sequence=4)
    trim = np.array([0.1, -0.2, 0.3, 1.0 / 3.0])
    healthy = FlightTrim("one", trim, np.array([trim, trim]), np.full(4, 0.25), 0.1 * trim, 60.0, "accelerometer")
    restored = Restored(last, 5, last, healthy=(healthy,), mass=1.5)
    return Beginning(PELICAN, SessionSettings(window=5.0, seed=7), "canonical", restored)


def messages_of(path: Path) -> list[tuple[str, str, bytes]]:
    file = McapFile(path)
    topics = file.topics
    return [(topics[n].name, topics[n].type, data) for n, _, data in file.messages(topics.keys())]


def test_what_a_session_began_with_comes_back_exactly(tmp_path: Path) -> None:
    path, written = tmp_path / "r.mcap", beginning()
    Recorder(path, written, INPUTS).close()
    found = read_beginning(path)
    assert found is not None
    assert (found.vehicle, found.settings, found.source) == (written.vehicle, written.settings, written.source)
    assert (found.restored.next_sequence, found.restored.mass) == (5, 1.5)
    assert found.restored.item is not None
    assert written.restored.item is not None
    assert [p.value for p in found.restored.item.parameters] == [p.value for p in written.restored.item.parameters]
    assert np.array_equal(found.restored.item.parameters.covariance, written.restored.item.parameters.covariance), (
        "to the last bit"
    )
    (healthy,) = found.restored.healthy
    assert flight_to_dict(healthy) == flight_to_dict(written.restored.healthy[0]), "health is judged as it was"


def test_a_recording_replaces_a_link_and_leaves_what_it_led_to(tmp_path: Path, happened: Happened) -> None:
    path, other = tmp_path / "r.mcap", tmp_path / "of_the_user"
    other.write_text("kept")
    path.symlink_to(other)
    Recorder(path, beginning(), INPUTS).close()
    assert read_beginning(path) is not None
    assert other.read_text() == "kept"
    happened(35, "a link under the name of the node's recording: replaced, the file it led to is as it was")


def test_messages_come_back_in_the_order_of_arrival(tmp_path: Path) -> None:
    log, path = tmp_path / "log.mcap", tmp_path / "r.mcap"
    write_mcap(log, flight(4.0).recording, EPOCH_NS)
    rng = np.random.default_rng(1)
    given = messages_of(log)
    shuffled = [given[i] for i in np.argsort(np.arange(len(given)) + rng.uniform(0.0, 60.0, len(given)))]
    recorder = Recorder(path, beginning(), INPUTS)
    for topic, kind, data in shuffled:
        recorder.take(topic, kind, data)
    recorder.close()
    assert messages_of(path) == shuffled
    got = flat(arrivals(path, "canonical", 4))
    sorted_ones = flat(stream(open_log(str(log))))
    assert sorted(got, key=lambda s: (s.channel, s.t)) == sorted(sorted_ones, key=lambda s: (s.channel, s.t))
    assert got != sorted(got, key=lambda s: s.t)


def test_other_files_have_no_beginning_and_damage_is_told(tmp_path: Path) -> None:
    path = tmp_path / "plain.mcap"
    write_mcap(path, flight(4.0).recording)
    assert read_beginning(path) is None
    assert read_metadata(path) == {}
    (tmp_path / "no.mcap").write_bytes(b"no MCAP")
    assert read_beginning(tmp_path / "no.mcap") is None
    with TopicWriter(path, {RECORD: {"vehicle": "x"}}):
        pass
    with pytest.raises(LogError, match="cannot be read"):
        read_beginning(path)
    for restored in ("[" * 100_000, '{"item": null, "next_sequence": 1e999, "baseline": null}', '"x"', "[]"):
        told = {"vehicle": PELICAN.to_yaml(), "settings": "{}", "source": "canonical", "restored": restored}
        with TopicWriter(path, {RECORD: told}):
            pass
        with pytest.raises(LogError, match="cannot be read"):
            read_beginning(path)
    os.mkfifo(tmp_path / "pipe.mcap")
    assert read_beginning(tmp_path / "pipe.mcap") is None


def _without_b(item: dict[str, Any]) -> None:
    item["parameters"] = [p for p in item["parameters"] if p["name"] != "b"]


@pytest.mark.parametrize(
    "spoil",
    [
        lambda left: left.update(next_sequence=10**30),
        lambda left: left["item"].update(sequence=10**30),
        lambda left: left["item"]["parameters"][0].update(value=-1.0),
        lambda left: left["baseline"]["parameters"][2].update(value=0.0),
        lambda left: _without_b(left["item"]),
        lambda left: left.update(mass=-1.0),
    ],
)
def test_a_beginning_that_no_run_left_is_refused(
    tmp_path: Path, spoil: Callable[[dict[str, Any]], None], happened: Happened
) -> None:
    """A stranger's recording began a session with whatever it said: a set without b, number 10^30."""
    path, written = tmp_path / "r.mcap", beginning()
    Recorder(path, written, INPUTS).close()
    record = dict(read_metadata(path)[RECORD])
    left = json.loads(record["restored"])
    spoil(left)
    with TopicWriter(path, {RECORD: {**record, "restored": json.dumps(left)}}):
        pass
    with pytest.raises(LogError, match="cannot be read") as caught:
        read_beginning(path)
    happened(44, f"a recording that begins with what no run left: '{str(caught.value)[:110]}'")
