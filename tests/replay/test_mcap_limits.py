"""MCAP made to exhaust memory, and MCAP with damaged chunks or without its end."""

import struct
import tracemalloc
from io import BytesIO
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import pytest
import quadid_replay.writers
import zstandard
from mcap.reader import make_reader
from mcap.writer import CompressionType, Writer
from quadid_replay import open_log, write_mcap
from quadid_replay.mcap_file import McapFile, read_metadata
from quadid_replay.schemas import schema_text

from quadid.errors import LogError
from tests.faults.evidence import Happened
from tests.replay.synthetic import full_recording


def chunked(path: Path, body: bytes, declared: int, compression: str = "zstd") -> None:
    """An MCAP with one hand-made chunk."""
    buffer = BytesIO()
    writer = Writer(buffer, compression=CompressionType.NONE, use_chunking=False)
    writer.start(profile="ros2")
    schema = writer.register_schema("sensor_msgs/msg/Imu", "ros2msg", schema_text("sensor_msgs/Imu").encode())
    writer.register_channel("imu", "cdr", schema)
    start = len(buffer.getvalue())
    chunk = struct.pack("<QQQII", 0, 1, declared, 0, len(compression)) + compression.encode()
    chunk += struct.pack("<Q", len(body)) + body
    path.write_bytes(buffer.getvalue()[:start] + struct.pack("<BQ", 6, len(chunk)) + chunk)


def test_what_a_recording_began_with_is_sought_without_unpacking_anything(tmp_path: Path, happened: Happened) -> None:
    """It is read in the program itself, before any child: metadata stand in front of the first chunk."""
    path, size = tmp_path / "bomb.mcap", 64 << 20
    packed = zstandard.compress(bytes(size))
    chunk = struct.pack("<QQQII4sQ", 0, 1, size, 0, 4, b"zstd", len(packed)) + packed
    header = struct.pack("<BQI4sI", 1, 12, 4, b"ros2", 0)
    path.write_bytes(b"\x89MCAP0\r\n" + header + struct.pack("<BQ", 6, len(chunk)) + chunk)
    tracemalloc.start()
    assert read_metadata(path) == {}
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < size / 8
    happened(5, f"metadata sought in a file that unpacks to {size >> 20} MiB: {peak >> 20} MiB")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_chunks_that_lie_about_their_size_inflate_no_further(
    tmp_path: Path, compression: str, happened: Happened
) -> None:
    body = zstandard.compress(bytes(50_000_000)) if compression == "zstd" else lz4.frame.compress(bytes(50_000_000))
    chunked(tmp_path / "liar", body, 1000, compression)
    with pytest.raises(LogError, match="nothing in it can be read"):
        open_log(tmp_path / "liar")
    happened(5, f"{compression} chunk of 50 MB that declares 1000 bytes: inflated to 1000 bytes, then refused")


@pytest.fixture
def small_chunks(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setattr(quadid_replay.writers, "CHUNK_BYTES", 16384)
    path = tmp_path / "small.mcap"
    write_mcap(path, full_recording())
    return path


def test_one_damaged_chunk_costs_only_itself(small_chunks: Path, happened: Happened) -> None:
    with small_chunks.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    chunk = summary.chunk_indexes[3]
    data = bytearray(small_chunks.read_bytes())
    data[chunk.chunk_start_offset + chunk.chunk_length - 40] ^= 1
    small_chunks.write_bytes(bytes(data))
    recording = open_log(small_chunks)
    assert any("1 damaged chunks or definitions refused" in w for w in recording.warnings)
    share = len(recording.channels["gyro"].t) / 400
    assert 1 - 2 / len(summary.chunk_indexes) < share < 1
    happened(
        1,
        f"one of {len(summary.chunk_indexes)} chunks with a wrong CRC: refused and told, {share:.0%} of the gyro used",
    )


def test_without_summary_everything_before_the_cut_is_read(small_chunks: Path) -> None:
    data = small_chunks.read_bytes()
    small_chunks.write_bytes(data[: len(data) // 2])
    recording = open_log(small_chunks)
    assert not McapFile(small_chunks).has_summary
    assert any("not readable" in w for w in recording.warnings)
    assert len(recording.channels["gyro"].t) == pytest.approx(200, abs=40)


def test_messages_outside_chunks_are_read(tmp_path: Path) -> None:
    with small_log(tmp_path / "chunked").open("rb") as stream, (tmp_path / "plain").open("wb") as out:
        reader = make_reader(stream)
        writer = Writer(out, compression=CompressionType.NONE, use_chunking=False)
        writer.start(profile="ros2")
        numbers: dict[str, int] = {}
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            if channel.topic not in numbers:
                kind = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.topic] = writer.register_channel(channel.topic, "cdr", kind)
            writer.add_message(numbers[channel.topic], message.log_time, message.data, message.publish_time)
        writer.finish()  # type: ignore[no-untyped-call]
    chunked_log, plain = open_log(tmp_path / "chunked"), open_log(tmp_path / "plain")
    assert plain.warnings == ()
    for name, kept in chunked_log.channels.items():
        np.testing.assert_array_equal(plain.channels[name].values, kept.values)


def small_log(path: Path) -> Path:
    write_mcap(path, full_recording(1.0, 50.0))
    return path
