"""rosbag2 databases and folders, written by another library, are the same recording as the MCAP file."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer as McapWriter
from quadid_replay import open_log, write_mcap
from quadid_replay.mcap_file import McapFile
from quadid_replay.schemas import schema_text
from rosbags.rosbag2 import StoragePlugin, Writer
from rosbags.typesys import Stores, get_typestore

from quadid.data.window import Recording
from quadid.errors import LogError
from tests.faults.evidence import Happened
from tests.replay.synthetic import full_recording


@pytest.fixture(scope="module")
def mcap(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("bag") / "flight.mcap"
    write_mcap(path, full_recording(4.0, 50.0))
    return path


def folder_of(mcap: Path, target: Path, storage: StoragePlugin) -> Path:
    """The standard messages of an MCAP, as the library rosbags writes them into a folder."""
    file, store = McapFile(mcap), get_typestore(Stores.ROS2_JAZZY)
    topics = {n: t for n, t in file.topics.items() if t.type in store.types}
    with Writer(target, version=9, storage_plugin=storage) as writer:
        links = {n: writer.add_connection(t.name, t.type, typestore=store) for n, t in topics.items()}
        for number, stamp, data in file.messages(topics.keys()):
            writer.write(links[number], stamp, data)
    return target


def same(found: Recording, expected: Recording) -> None:
    assert {"gyro", "accel", "attitude", "rotor_speed"} <= set(found.channels)
    for name, channel in found.channels.items():
        np.testing.assert_array_equal(channel.t, expected.channels[name].t)
        np.testing.assert_array_equal(channel.values, expected.channels[name].values)


@pytest.mark.parametrize("storage", list(StoragePlugin))
def test_a_folder_is_read_as_the_file(tmp_path: Path, mcap: Path, storage: StoragePlugin) -> None:
    folder = folder_of(mcap, tmp_path / "flight_1", storage)
    recording = open_log(folder)
    same(recording, open_log(mcap))
    assert recording.name == "flight_1"
    assert len(recording.sha256) == 64


def test_a_database_is_read_by_itself_with_or_without_definitions(tmp_path: Path, mcap: Path) -> None:
    (database,) = folder_of(mcap, tmp_path / "a", StoragePlugin.SQLITE3).glob("*.db3")
    same(open_log(database), open_log(mcap))
    with sqlite3.connect(database) as connection:
        connection.execute("DROP TABLE IF EXISTS message_definitions")
    connection.close()
    same(open_log(database), open_log(mcap))


def test_a_recording_in_several_files_is_one(tmp_path: Path, mcap: Path) -> None:
    """The second half is in a file of its own, whose name sorts before that of the first as text does."""
    folder = folder_of(mcap, tmp_path / "split", StoragePlugin.SQLITE3)
    (first,) = folder.glob("*.db3")
    second = folder / "split_10.db3"
    shutil.copy(first, second)
    first = first.rename(folder / "split_9.db3")
    with sqlite3.connect(first) as one:
        (middle,) = one.execute("SELECT avg(timestamp) FROM messages").fetchone()
        one.execute("DELETE FROM messages WHERE timestamp >= ?", (middle,))
    with sqlite3.connect(second) as two:
        two.execute("DELETE FROM messages WHERE timestamp < ?", (middle,))
        two.execute("UPDATE messages SET topic_id = topic_id + 100")
        two.execute("UPDATE topics SET id = id + 100")
    one.close()
    two.close()
    same(open_log(folder), open_log(mcap))


def test_what_is_no_recording_is_named(tmp_path: Path) -> None:
    with sqlite3.connect(tmp_path / "other.db") as connection:
        connection.execute("CREATE TABLE a (b)")
    connection.close()
    with pytest.raises(LogError, match="an SQLite database, but no rosbag2"):
        open_log(tmp_path / "other.db")
    data = (tmp_path / "other.db").read_bytes()
    (tmp_path / "damaged.db").write_bytes(data[:100] + b"\xff" * (len(data) - 100))
    with pytest.raises(LogError, match="damaged SQLite database"):
        open_log(tmp_path / "damaged.db")
    (tmp_path / "packed").mkdir()
    for name in ("metadata.yaml", "a_0.db3", "a_0.db3.zstd"):
        (tmp_path / "packed" / name).write_text("x")
    with pytest.raises(LogError, match=r"a_0\.db3\.zstd is compressed"):
        open_log(tmp_path / "packed")
    (tmp_path / "odd").mkdir()
    for name in ("metadata.yaml", "²1.db3", "a1.db3"):  # a digit, and no number
        (tmp_path / "odd" / name).write_text("x")
    with pytest.raises(LogError):
        open_log(tmp_path / "odd")
    with pytest.raises(LogError, match="is a directory"):
        open_log(tmp_path)


def test_types_that_a_database_does_not_describe_are_named(tmp_path: Path, mcap: Path) -> None:
    """Bags of a research group held one topic of its own type; the answer was "type without a readable definition"."""
    (database,) = folder_of(mcap, tmp_path / "a", StoragePlugin.SQLITE3).glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("DROP TABLE IF EXISTS message_definitions")
        connection.execute("UPDATE topics SET type = 'foresee_msgs/msg/DynamicsData'")
    connection.close()
    with pytest.raises(LogError, match=r"imu \[foresee_msgs/DynamicsData, no definition held\]"):
        open_log(database)


def test_a_definition_in_idl_is_replaced_or_named(tmp_path: Path, mcap: Path) -> None:
    source = McapFile(mcap)
    (imu,) = (n for n, t in source.topics.items() if t.type == "sensor_msgs/msg/Imu")
    path = tmp_path / "idl.mcap"
    with path.open("wb") as stream:
        writer = McapWriter(stream)
        writer.start(profile="ros2")
        known = writer.register_schema("sensor_msgs/msg/Imu", "ros2idl", b"module sensor_msgs {};")
        strange = writer.register_schema("my_msgs/msg/Rpm", "ros2idl", b"module my_msgs {};")
        channel = writer.register_channel("imu", "cdr", known)
        writer.register_channel("rpm", "cdr", strange)
        for _, stamp, data in source.messages({imu}):
            writer.add_message(channel, stamp, data, stamp)
        writer.finish()  # type: ignore[no-untyped-call]
    recording = open_log(path)
    np.testing.assert_array_equal(recording.channels["gyro"].values, open_log(mcap).channels["gyro"].values)
    assert any("rpm" in note and "IDL" in note for note in recording.warnings)
    assert schema_text("sensor_msgs/Imu")


TOPICS = (
    "CREATE TABLE topics(id INTEGER PRIMARY KEY, name TEXT, type TEXT, serialization_format TEXT);"
    "INSERT INTO topics VALUES (1, 'imu', 'sensor_msgs/msg/Imu', 'cdr');"
)
ROWS = "INSERT INTO messages (id, topic_id, timestamp) VALUES (1, 1, 1), (2, 1, 2), (3, 1, 3);"


@pytest.mark.parametrize(
    "messages",
    [
        "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id INTEGER, timestamp INTEGER, "
        f"data BLOB GENERATED ALWAYS AS (zeroblob(900000000)) VIRTUAL); {ROWS}",
        "CREATE VIRTUAL TABLE messages USING fts5(topic_id, timestamp, data)",
        "CREATE VIEW messages AS WITH RECURSIVE c(x) AS (SELECT 1 UNION ALL SELECT x + 1 FROM c) "
        "SELECT x AS id, 1 AS topic_id, x AS timestamp, zeroblob(100) AS data FROM c",
    ],
    ids=["computed", "virtual", "view"],
)
def test_a_database_whose_messages_are_computed_is_refused(tmp_path: Path, messages: str, happened: Happened) -> None:
    """Twelve kilobytes took 7 GB and two minutes: three messages of 900 MB that no file holds; a reader has limits."""
    path = tmp_path / "log.db3"
    connection = sqlite3.connect(path)
    connection.executescript(f"{TOPICS}{messages}")
    connection.close()
    with pytest.raises(LogError, match="memory|no usable flight data|no rosbag2") as told:
        open_log(path)
    happened(25, f"rosbag2 of {path.stat().st_size >> 10} kB with '{messages[:40]}...': {str(told.value)[:80]}")


def test_a_type_of_a_database_that_is_described_in_idl_is_named(tmp_path: Path, mcap: Path) -> None:
    (database,) = folder_of(mcap, tmp_path / "bag", StoragePlugin.SQLITE3).glob("*.db3")
    with sqlite3.connect(database) as connection:
        connection.execute("UPDATE topics SET type = 'my_msgs/msg/Rpm' WHERE name LIKE '%battery'")
        told = ("my_msgs/msg/Rpm", "ros2idl", "module my_msgs {};", "")
        connection.execute("INSERT INTO message_definitions VALUES (NULL, ?, ?, ?, ?)", told)
    connection.close()
    assert any("battery" in note and "IDL" in note for note in open_log(database).warnings)
