"""Small files that cost much: records that share one large thing, and what inflates, nests, or never ends.

Each goes through the command, with 3 s of processor time and 400 MiB for the child that reads it, and no file written.
It is read or refused; a refusal is one line that says what was found, what is allowed and what to do.
"""

import os
import resource
import sqlite3
import struct
import sys
import zlib
from collections.abc import Callable
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from quadid_node.history import make_tables
from quadid_replay import opening
from quadid_replay.schemas import schema_text

from quadid.cli.main import app_main
from tests.faults.evidence import Happened
from tests.fuzz.seeds import mcap_of
from tests.replay.shared_pages import share_first_row
from tests.replay.test_mcap import header
from tests.replay.test_ulog import Ulog

SECONDS, MEMORY = 3, 400
STARTING = 6.0
"""Processor time [s] of the process that stands ready: its start on a busy machine, and the readers' libraries."""
MOTORS = "quadid_msgs/msg/MotorCommand"


def text(value: bytes) -> bytes:
    return struct.pack("<I", len(value)) + value


def record(kind: int, body: bytes) -> bytes:
    return struct.pack("<BQ", kind, len(body)) + body


def chunk(content: bytes, name: bytes = b"", declared: int | None = None, packed: bytes | None = None) -> bytes:
    packed = content if packed is None else packed
    size = len(content) if declared is None else declared
    return record(6, struct.pack("<QQQI", 0, 1, size, 0) + text(name) + struct.pack("<Q", len(packed)) + packed)


def zstd(content: bytes) -> bytes:
    return chunk(content, b"zstd", packed=zstandard.compress(content))


IMU = record(3, struct.pack("<H", 1) + text(b"sensor_msgs/msg/Imu") + text(b"ros2msg") + text(b"float64 x\n"))
CHANNEL = record(4, struct.pack("<HH", 1, 1) + text(b"/imu") + text(b"cdr") + struct.pack("<I", 0))
EMPTY_MESSAGES = record(5, struct.pack("<HIQQ", 1, 0, 0, 0)) * 40_000


def mcap(data: bytes, summary: bytes) -> bytes:
    body = b"\x89MCAP0\r\n" + record(1, text(b"ros2") + text(b"x")) + data + record(15, struct.pack("<I", 0))
    foot = struct.pack("<BQQQ", 2, 20, len(body), 0)
    crc = zlib.crc32(foot, zlib.crc32(summary))
    return body + summary + foot + struct.pack("<I", crc) + b"\x89MCAP0\r\n"


def entry(offset: int, length: int) -> bytes:
    body = struct.pack("<QQQQ", 0, 1, offset, length) + struct.pack("<IQ", 0, 0) + text(b"") + struct.pack("<QQ", 0, 0)
    return record(8, body)


def one_chunk_listed_often(step: int) -> Callable[[], bytes]:
    """An index whose entries all point to one chunk, or each a little further into it."""

    def made() -> bytes:
        body = chunk(bytes(1_000_000), declared=0)
        begin = 8 + len(record(1, text(b"ros2") + text(b"x")))
        entries = b"".join(entry(begin + step * k, len(body)) for k in range(20_000))
        return mcap(body, IMU + CHANNEL + entries)

    return made


def one_chunk_with_a_long_name() -> bytes:
    body = record(6, struct.pack("<QQQII", 0, 1, 0, 0, 0x7FFFFFFF) + bytes(2_000_000))
    begin = 8 + len(record(1, text(b"ros2") + text(b"x")))
    return mcap(body, IMU + CHANNEL + entry(begin, len(body)) * 20_000)


def chunks_of_messages() -> bytes:
    """Messages without content: 40,000 in a chunk of two kilobytes, sixty million in all."""
    return mcap(IMU + CHANNEL + zstd(EMPTY_MESSAGES) * 1500, b"")


def chunks_of_zeros() -> bytes:
    packed = lz4.frame.compress(bytes(64 << 20))
    return mcap(IMU + CHANNEL + chunk(b"", b"lz4", 64 << 20, packed) * 4, b"")


def channels_without_end() -> bytes:
    return mcap(
        b"".join(
            record(4, struct.pack("<HH", k % 65536, 1) + text(b"a" * 9) + text(b"cdr") + bytes(4))
            for k in range(100_000)
        ),
        b"",
    )


def definition(line: str) -> Callable[[], bytes]:
    def made() -> bytes:
        first, rest = schema_text(MOTORS).split("=" * 80, 1)
        message = ("motor_command", MOTORS, schema_text(MOTORS), lambda ns: {"header": header(ns), "values": [0.5] * 4})
        return mcap_of([message], True, shown=f"{first}{line}\n{'=' * 80}{rest}")

    return made


def shared_overflow(cells: int, size: int) -> Callable[[], bytes]:
    """A rosbag2 database whose messages all have one chain of overflow pages for their payload."""

    def made() -> bytes:
        path = Path("made.db3").absolute()
        path.unlink(missing_ok=True)
        db = sqlite3.connect(path)
        db.executescript(
            "PRAGMA page_size=512; CREATE TABLE topics(id INTEGER PRIMARY KEY, name, type, serialization_format);"
            "CREATE TABLE messages(id INTEGER PRIMARY KEY, topic_id, timestamp, data BLOB);"
            "INSERT INTO topics VALUES(1, '/imu', 'sensor_msgs/msg/Imu', 'cdr');"
        )
        db.execute("INSERT INTO messages VALUES(1, 1, 1000000000000, ?)", (bytes(size),))
        db.commit()
        db.close()
        share_first_row(path, "messages", cells)
        return path.read_bytes()

    return made


def nested(levels: int, each: int) -> Callable[[], bytes]:
    """A ULog message whose type holds others, each so many of the next."""

    def made() -> bytes:
        log = Ulog()
        log.format("t0", f"uint8_t[{each}] x;")
        for k in range(1, levels):
            log.format(f"t{k}", f"t{k - 1}[{each}] x;")
        log.format("vehicle_attitude", f"uint64_t timestamp;t{levels - 1}[{each}] x;")
        log.subscribe("vehicle_attitude")
        return bytes(log.data)

    return made


def in_itself(other: str) -> Callable[[], bytes]:
    """A ULog message that holds another, which holds it."""

    def made() -> bytes:
        log = Ulog()
        log.format("vehicle_attitude", f"uint64_t timestamp;{other} x;")
        log.format("other", "vehicle_attitude x;")
        log.subscribe("vehicle_attitude")
        return bytes(log.data)

    return made


def topics_without_end() -> bytes:
    log = Ulog()
    log.format("vehicle_attitude", "uint64_t timestamp;float[4900] q;")
    for k in range(3000):
        log.record("A", struct.pack("<BH", k % 256, k) + b"vehicle_attitude")
    return bytes(log.data)


def a_long_number() -> bytes:
    log = Ulog()
    log.format("vehicle_attitude", f"uint64_t timestamp;float[{'9' * 5000}] q;")
    log.subscribe("vehicle_attitude")
    return bytes(log.data)


def blackbox_headers() -> bytes:
    return b"H Product:Blackbox flight data recorder by Nicholas Sherlock\n" * 60_000


KINDS: dict[str, Callable[[], bytes]] = {
    "mcap: one chunk listed 20,000 times": one_chunk_listed_often(0),
    "mcap: 20,000 chunks that overlap": one_chunk_listed_often(9),
    "mcap: a chunk with a name of 2 MB": one_chunk_with_a_long_name,
    "mcap: sixty million messages of nothing": chunks_of_messages,
    "mcap: chunks of zeros": chunks_of_zeros,
    "mcap: channels without end": channels_without_end,
    "mcap: a constant that stalls the parser": definition("uint8 POWER_SUPPLY_HEALTH_UNSPEC_FAILURE_AND_SO_ON__X=1"),
    "mcap: an array of two thousand million nothings": definition(
        f"Nothing[2000000000] x\n{'=' * 80}\nMSG: quadid_msgs/Nothing\n# no field"
    ),
    "rosbag2: 2400 messages that share 200 kB": shared_overflow(2400, 200_000),
    "rosbag2: 20,000 messages that share 2 MB": shared_overflow(20_000, 2_000_000),
    "ulog: types in types": nested(5, 60_000),
    "ulog: types in many types": nested(40, 2),
    "ulog: a type in itself": in_itself("vehicle_attitude"),
    "ulog: two types in each other": in_itself("other"),
    "ulog: 3000 topics of 4900 numbers": topics_without_end,
    "ulog: a length of 5000 digits": a_long_number,
    "blackbox: 60,000 headers": blackbox_headers,
}


@pytest.mark.parametrize("kind", KINDS)
def test_a_small_file_costs_no_more_than_its_limits(
    kind: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], happened: Happened
) -> None:
    monkeypatch.chdir(tmp_path)
    path = tmp_path / "log"
    path.write_bytes(KINDS[kind]())
    size = path.stat().st_size
    assert size < 5 << 20
    monkeypatch.setenv("QUADID_READ_SECONDS", str(SECONDS))
    monkeypatch.setenv("QUADID_READ_MEMORY_MB", str(MEMORY))
    kept = {*os.listdir(tmp_path)}
    opening.stop()
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    monkeypatch.setattr(sys, "argv", ["quadid", "inspect", str(path), "--vehicle", "pelican"])
    code = app_main()
    opening.stop()  # what its children took counts from now on
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    (said,) = capfd.readouterr().err.strip().splitlines()
    assert code == 2, said
    assert "; allowed: " in said or "; fix: " in said, said
    seconds = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    assert seconds < SECONDS + STARTING
    assert {*os.listdir(tmp_path)} == kept
    happened(35, f"{kind} ({size >> 10} kB): {seconds:.1f} s of processor time with the start; '{said[:100]}'")


ROWS = {
    "sets": "vehicle, sequence, state, reason, approved_by, wall, data) VALUES ('v', 1, 'accepted', '', '', 1, ?",
    "candidates": "id, vehicle, state, gate, reason, wall, data) VALUES (1, 'v', 'accepted', '', '', 1, ?",
    "events": "id, vehicle, level, kind, wall, text) VALUES (1, 'v', 'INFO', '', 1, ?",
}


@pytest.mark.parametrize("table", ROWS)
def test_a_history_whose_rows_share_pages_is_refused(
    table: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str], happened: Happened
) -> None:
    """4 MB of history were 40 GB of rows, all of them kept."""
    path = tmp_path / "h.sqlite"
    make_tables(path)
    db = sqlite3.connect(path)
    db.execute("PRAGMA journal_mode = DELETE")
    db.execute(f"INSERT INTO {table} ({ROWS[table]})", (" " * 2_000_000,))
    db.commit()
    db.close()
    share_first_row(path, table, 20_000)
    for command in (
        ["history", "--vehicle", "v", "--history", path, "--candidates", "9", "--events", "9"],
        ["export", "--vehicle", "pelican", "--history", path, "--format", "mujoco", "--out", tmp_path],
    ):
        monkeypatch.setattr(sys, "argv", ["quadid", *map(str, command)])
        assert app_main() == 2
        assert "its pages do not add up" in capfd.readouterr().err
    happened(12, f"history of {path.stat().st_size >> 20} MB whose {table} are 40 GB in shared pages: refused")
