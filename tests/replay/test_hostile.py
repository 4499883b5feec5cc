"""Files made to harm, or damaged badly: read in time that grows with their size, or refused; never silently wrong.

A log is read in a child that may take 10 s and 4 s a MiB of processor time; what takes longer than linear time is
refused there, which fails these tests.
"""

import struct
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType, Writer
from quadid_replay import open_log
from quadid_replay.mcap_file import McapFile, in_log_time

from quadid.errors import LogError
from tests.faults.evidence import Happened
from tests.fuzz.seeds import seeds
from tests.replay.test_dataflash import Dataflash
from tests.replay.test_tlog import Tlog, attitude, heartbeat, servo


def opened(tmp_path: Path, data: bytes) -> str:
    """Warnings of a log, or the reason why it is refused."""
    path = tmp_path / "log"
    path.write_bytes(data)
    try:
        return "; ".join(open_log(path).warnings)
    except LogError as error:
        return str(error)


def tlog() -> bytes:
    log = Tlog()
    log.add(0.0, heartbeat())
    for k in range(100):
        log.add(0.02 * k, attitude(5.0 + 0.02 * k))
        log.add(0.02 * k, servo(5.0 + 0.02 * k))
    return bytes(log.data)


@pytest.mark.parametrize("filler", [b"\xfd\xfe", struct.pack(">Q", 1_700_000_000_000_000) + b"\xfe\xff"])
def test_a_telemetry_log_of_filler_takes_linear_time(tmp_path: Path, filler: bytes, happened: Happened) -> None:
    said = opened(tmp_path, tlog() + filler * ((12 << 20) // len(filler)))
    assert "bytes are damaged and were skipped" in said
    happened(5, f"telemetry log of filler {filler[:2].hex()}: read in linear time")


def test_a_telemetry_log_damaged_after_every_other_frame_takes_linear_time(tmp_path: Path, happened: Happened) -> None:
    empty = bytes([0xFE, 0, 0, 1, 1, 0, 0, 0])
    frames = [struct.pack(">Q", 1_700_000_000_000_000 + k) + empty for k in range(2)]
    said = opened(tmp_path, tlog() + (b"".join(frames) + b"xx") * 400_000)
    assert "bytes are damaged and were skipped" in said
    assert "longer than" not in said
    happened(5, "telemetry log with 400,000 damaged places: read in linear time")


def test_a_ulog_without_sync_takes_linear_time(tmp_path: Path, happened: Happened) -> None:
    bad = struct.pack("<HB", 1, 0xFF)  # records of no known kind, one after the other
    said = opened(tmp_path, seeds("ulog")[0] + bad * (4 << 20))
    assert "longer than" not in said
    assert "damaged" in said
    happened(5, "ULog without sync marks: read in linear time")


@pytest.mark.parametrize("where", ["inside a chunk", "in the file"])
def test_an_mcap_record_without_content_is_damage(tmp_path: Path, where: str) -> None:
    empty = bytes([5]) + struct.pack("<Q", 0)
    body = struct.pack("<QQQIIQ", 0, 0, len(empty), 0, 0, len(empty)) + empty
    record = empty if where == "in the file" else bytes([6]) + struct.pack("<Q", len(body)) + body
    said = opened(tmp_path, b"\x89MCAP0\r\n" + record + record)
    assert "damaged chunks" in said


@pytest.mark.parametrize("summary", [True, False])
def test_an_mcap_is_read_in_log_time_whatever_its_order(tmp_path: Path, summary: bool, happened: Happened) -> None:
    path = tmp_path / "shuffled.mcap"
    order = np.random.default_rng(3).permutation(5000)
    with path.open("wb") as file:
        writer = Writer(file, compression=CompressionType.NONE, chunk_size=1 << 12, use_chunking=True)
        writer.start()
        schema = writer.register_schema("a/B", "ros2msg", b"int8 x")
        channel = writer.register_channel("x", "cdr", schema)
        for k in order:
            writer.add_message(channel, int(k), bytes(8), int(k))
        writer.finish()  # type: ignore[no-untyped-call]
    if not summary:
        path.write_bytes(path.read_bytes()[:-40])
    times = [t for _, t, _ in McapFile(path).messages({channel})]
    np.testing.assert_array_equal(times, np.arange(5000))
    happened(31, f"5000 messages shuffled, summary {summary}: all read, in the order of their log times")


def test_ordering_keeps_little_waiting() -> None:
    taken = 0

    def part(start: int) -> list[tuple[int, int, bytes]]:
        nonlocal taken
        taken += 10
        return [(1, start + k, b"") for k in range(10)]

    for n, (_, t, _) in enumerate(in_log_time((10 * k, iter(part(10 * k))) for k in range(10_000))):
        assert t == n
        assert taken - n <= 1020


def test_two_vehicles_under_one_system_id_are_refused(tmp_path: Path, happened: Happened) -> None:
    one, two = Tlog(), Tlog()
    for k in range(200):
        for log, boot in ((one, 100.0), (two, 300.0)):
            log.add(0.02 * k, attitude(boot + 0.02 * k))
            log.add(0.02 * k, servo(boot + 0.02 * k))
    frames = [bytes(log.data) for log in (one, two)]
    length = len(frames[0]) // 200
    mixed = b"".join(f[k * length : (k + 1) * length] for k in range(200) for f in frames)
    assert "two vehicles under one system id" in opened(tmp_path, mixed)
    happened(31, "two autopilots with one id, frame by frame: refused as two vehicles")


@pytest.mark.parametrize("turn", [1, 10, 100])
def test_two_vehicles_under_one_id_that_were_started_at_once_are_said(
    tmp_path: Path, turn: int, happened: Happened
) -> None:
    """Their boot times are the same: only the numbers of their frames tell them apart."""
    senders = Tlog(), Tlog()
    senders[1].mav.seq = 90
    mixed = bytearray()
    for k in range(1600):
        log = senders[k // turn % 2]
        log.data.clear()
        log.add(0.02 * k, attitude(100.0 + 0.02 * k))
        mixed += log.data
    assert "frame numbers of system 1 component 1 come in two rows" in opened(tmp_path, bytes(mixed))
    happened(31, f"two autopilots with one id and one clock, {turn} frames each in turn: said, by their frame numbers")


def test_one_sender_whose_frames_are_lost_late_or_doubled_is_one(tmp_path: Path) -> None:
    rng, log, frames = np.random.default_rng(1), Tlog(), []
    for k in range(3000):
        log.data.clear()
        log.add(0.02 * k, attitude(100.0 + 0.02 * k))
        frames.append(bytes(log.data))
    late = [f for pair in zip(frames[1::2], frames[::2], strict=True) for f in pair]
    lossy = [f for f in frames if rng.random() < 0.05]
    for kept in (frames, lossy, late, [f for f in frames for _ in range(2)], frames[:900] + frames[1000:]):
        assert "two rows" not in opened(tmp_path, b"".join(kept))


def test_a_description_that_changes_within_a_log_ends_its_column(tmp_path: Path, happened: Happened) -> None:
    log = Dataflash()
    columns = ("TimeUS", "I", "GyrX", "GyrY", "GyrZ", "AccX", "AccY", "AccZ")
    log.describe(140, "IMU", "QBffffff", ",".join(columns))
    for k in range(50):
        log.add("IMU", k * 20_000, 0, 0.1, 0.2, 0.3, 0.0, 0.0, -9.8)
    log.describe(140, "IMU", "QBffffff", ",".join((*columns[:2], *columns[5:], *columns[2:5])))
    for k in range(50, 100):
        log.add("IMU", k * 20_000, 0, 0.0, 0.0, -9.8, 0.1, 0.2, 0.3)
    path = tmp_path / "log.bin"
    path.write_bytes(bytes(log.data))
    recording = open_log(path)
    np.testing.assert_allclose(recording.channels["gyro"].values, np.tile([0.1, 0.2, 0.3], (50, 1)), rtol=1e-6)
    assert any("IMU redefined" in w for w in recording.warnings)
    happened(31, "IMU described anew with gyro and accelerometer swapped: read up to there, and said")


def test_numbers_that_only_python_reads_are_dropped(tmp_path: Path, happened: Happened) -> None:
    rows = "".join(f"{0.02 * k:.2f},0.1,0.2,0.3\n" for k in range(50))
    path = tmp_path / "a.csv"
    path.write_text(
        "t,p,q,r\n" + rows + "1.00,1_0,0.2,0.3\n1.02,\uff11,0.2,0.3\n" + "1.04,0.1,0.2,0.3\n", encoding="utf-8"
    )
    recording = open_log(path)
    np.testing.assert_allclose(recording.channels["gyro"].values[:, 0], 0.1)
    assert any("2 lines with missing or unreadable cells" in w for w in recording.warnings)
    happened(31, "1_0 and a full-width digit in a CSV: these lines dropped and counted")


def test_a_wild_first_stamp_moves_nothing(tmp_path: Path, happened: Happened) -> None:
    rows = "".join(f"{0.02 * k:.2f},0.1,0.2,0.3\n" for k in range(50))
    for wild in ("1e9", "-5000", "99999"):
        path = tmp_path / "a.csv"
        path.write_text(f"t,p,q,r\n{wild},0.1,0.2,0.3\n" + rows)
        recording = open_log(path)
        np.testing.assert_allclose(recording.channels["gyro"].t, 0.02 * np.arange(50), atol=1e-9)
        assert recording.breaks == ()
        assert any("1 stamps that no neighbour confirms" in w for w in recording.warnings)
    happened(31, "first stamp of 1e9, -5000 and 99999 s: dropped and said, the others keep their times")
