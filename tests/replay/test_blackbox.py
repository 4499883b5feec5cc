"""Betaflight blackbox: every encoding there and back, units and frames, damage, several logs in a file."""

import json
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.blackbox import FrameDefinition, Reader

from quadid.errors import LogError
from quadid.types import FloatArray
from tests.replay import blackbox_writer as writer
from tests.replay.golden import summary


def rows(count: int = 400) -> list[list[int]]:
    """Numbers that move as a flight's: small and large steps, rests, a jump now and then."""
    rng = np.random.default_rng(7)
    out = []
    state = np.zeros(len(writer.NAMES), dtype=np.int64)
    for k in range(count):
        state += rng.integers(-3, 4, len(state)) * rng.integers(0, 2, len(state))
        if k % 37 == 5:
            state += rng.integers(-9000, 9000, len(state))
        row = [int(v) for v in state]
        for i, name in enumerate(writer.NAMES):
            if name == "loopIteration":
                row[i] = k
            elif name == "time":
                row[i] = 2_000_000 + 500 * k + k % 3
            elif name.startswith(("motor", "eRPM")):
                row[i] = 300 + abs(row[i]) % 1500
            elif name == "vbatLatest":
                row[i] = 1590 - k // 50
            elif name in ("rssi", "rcCommand[3]"):
                row[i] = 1100 + abs(row[i]) % 500
        out.append(row)
    return out


def column(table: Sequence[Sequence[int]], name: str) -> FloatArray:
    return np.array([row[writer.NAMES.index(name)] for row in table], dtype=np.float64)


def log(tmp_path: Path, data: bytes) -> Path:
    path = tmp_path / "LOG00001.BFL"
    path.write_bytes(data)
    return path


@pytest.mark.parametrize(
    ("encoding", "encode", "size"),
    [
        (0, lambda v: writer.signed(v[0]), 1),
        (3, lambda v: writer.neg_14bit(v[0]), 1),
        (6, writer.tag8_8svb, 8),
        (6, writer.tag8_8svb, 3),
        (7, writer.tag2_3s32, 3),
        (8, writer.tag8_4s16, 4),
        (10, writer.tag2_3svariable, 3),
    ],
)
def test_every_encoding_gives_back_its_numbers(encoding: int, encode: Callable[[list[int]], bytes], size: int) -> None:
    rng = Random(1)
    definition = FrameDefinition(("x",) * size, (0,) * size, (encoding,) * size)
    for largest in (1, 2, 7, 8, 15, 31, 63, 127, 2000, 8191):
        for _ in range(200):
            values = [rng.randint(-largest, largest) for _ in range(size)]
            data = encode(values)
            reader = Reader(data, 0)
            assert definition.raw(reader) == values
            assert reader.at == len(data)


def test_units_and_frames(tmp_path: Path) -> None:
    table = rows()
    recording = open_log(log(tmp_path, writer.header() + b"".join(writer.frames(table)) + writer.END))
    assert recording.format == "blackbox"
    assert recording.warnings == ()
    c = recording.channels
    np.testing.assert_allclose(c["gyro"].t, column(table, "time") * 1e-6)
    for i, sign in enumerate((1.0, -1.0, -1.0)):  # FLU to FRD
        np.testing.assert_allclose(c["gyro"].values[:, i], sign * np.radians(column(table, f"gyroADC[{i}]")))
        np.testing.assert_allclose(c["accel"].values[:, i], sign * column(table, f"accSmooth[{i}]") / 2048 * 9.80665)
    for i in range(4):
        np.testing.assert_allclose(
            c["motor_command"].values[:, i], (column(table, f"motor[{i}]") - writer.LOW) / (writer.HIGH - writer.LOW)
        )
        np.testing.assert_allclose(
            c["rotor_speed"].values[:, i], column(table, f"eRPM[{i}]") * 100 / 7 * 2 * np.pi / 60
        )
    np.testing.assert_allclose(c["battery"].values[:, 0], column(table, "vbatLatest") * 0.01)
    assert recording.autopilot["motor_poles"] == 14.0


def test_the_golden_log_reads_as_it_did() -> None:
    """Bytes and numbers are kept apart from the writer, so that writer and reader cannot err together unseen."""
    log_file = Path(__file__).with_name("golden.bbl")
    expected = json.loads(log_file.with_name("golden_bbl.json").read_text(encoding="utf-8"))
    assert json.loads(json.dumps(summary(open_log(log_file)))) == expected


def test_damage_costs_the_frames_up_to_the_next_complete_one(tmp_path: Path) -> None:
    table = rows()
    parts = writer.frames(table)
    parts[100] = b"\x00\xff" + parts[100][3:]
    recording = open_log(log(tmp_path, writer.header() + b"".join(parts)))
    t, gyro = recording.channels["gyro"].t, np.degrees(recording.channels["gyro"].values[:, 0])
    known = {round(a * 1e-6, 6): b for a, b in zip(column(table, "time"), column(table, "gyroADC[0]"), strict=True)}
    assert 380 < len(t) < 400
    np.testing.assert_allclose(gyro, [known[round(float(a), 6)] for a in t], atol=1e-9)
    assert any("damaged and were skipped" in w for w in recording.warnings)
    assert any("no end-of-log mark" in w for w in recording.warnings)


def test_numbers_wrap_in_32_bits_as_in_the_firmware(tmp_path: Path) -> None:
    """A throttle below `minthrottle`, and a clock that starts over after 71.6 minutes, are no damage."""
    table = rows()
    throttle, time = writer.NAMES.index("rcCommand[3]"), writer.NAMES.index("time")
    for k, row in enumerate(table):
        row[throttle] = 1000 + k % 3 if k // 50 % 2 else 1300
        row[time] = (2**32 - 100_000 + 500 * k) % 2**32
    recording = open_log(log(tmp_path, writer.header() + b"".join(writer.frames(table)) + writer.END))
    assert recording.warnings == ()
    np.testing.assert_allclose(recording.channels["gyro"].t, (2**32 - 100_000 + 500.0 * np.arange(400)) * 1e-6)
    np.testing.assert_allclose(recording.channels["gyro"].values[:, 0], np.radians(column(table, "gyroADC[0]")))


def test_high_resolution_is_tenths_of_a_degree(tmp_path: Path) -> None:
    table = rows()
    header = writer.header() + b"H blackbox_high_resolution:1\n"
    recording = open_log(log(tmp_path, header + b"".join(writer.frames(table)) + writer.END))
    np.testing.assert_allclose(recording.channels["gyro"].values[:, 0], np.radians(column(table, "gyroADC[0]") / 10))


def test_a_pause_of_logging_is_no_damage(tmp_path: Path) -> None:
    """Logging that a switch stops and starts tells so by an event (14) with iteration and time."""
    table = rows()
    for row in table[200:]:
        row[0] += 80_000
        row[1] += 40_000_000
    resumed = b"E\x0e" + writer.unsigned(table[200][0]) + writer.unsigned(table[200][1])
    parts = writer.frames(table)
    recording = open_log(log(tmp_path, writer.header() + b"".join([*parts[:200], resumed, *parts[200:]]) + writer.END))
    assert len(recording.channels["gyro"].t) == 397  # three confirm the jump of the clock
    assert not any("damaged" in w for w in recording.warnings)


@pytest.mark.parametrize("seed", range(20))
def test_after_damage_no_row_is_invented(tmp_path: Path, seed: int) -> None:
    """Any `I` in the data may be taken for a frame: only true rows come back, and those after the damage do."""
    table = rows(1200)
    data = bytearray(b"".join(writer.frames(table)))
    rng = Random(seed)
    for _ in range(20):
        at = rng.randrange(len(data) // 10, len(data) * 9 // 10)
        data[at : at + 30] = rng.randbytes(rng.choice((0, 30, 60))).replace(b"\x00", b"I")
    recording = open_log(log(tmp_path, writer.header() + bytes(data) + writer.END))
    t, gyro = recording.channels["gyro"].t, np.degrees(recording.channels["gyro"].values[:, 2])
    known = {round(a * 1e-6, 6): -b for a, b in zip(column(table, "time"), column(table, "gyroADC[2]"), strict=True)}
    wrong = [a for a, b in zip(t, gyro, strict=True) if abs(known.get(round(float(a), 6), np.inf) - b) > 1e-6]
    assert len(wrong) <= 2 * 8  # the rest of two groups of frames: the format has no checksum
    assert len(t) > 700
    assert t[-1] == pytest.approx(table[-1][1] * 1e-6)
    assert recording.breaks == ()


def test_of_several_logs_the_longest_is_read(tmp_path: Path) -> None:
    short, long = (writer.header() + b"".join(writer.frames(rows(n))) + writer.END for n in (50, 300))
    recording = open_log(log(tmp_path, short + long + short))
    assert len(recording.channels["gyro"].t) == 300
    assert any("3 logs in this file" in w for w in recording.warnings)


def test_a_header_of_another_dialect_is_refused(tmp_path: Path) -> None:
    whole = writer.header()
    for data in (whole[:200], whole.replace(b"Field P encoding", b"Field X encoding"), whole.replace(b",7,", b",77,")):
        with pytest.raises(LogError, match="blackbox header is damaged or of another dialect"):
            open_log(log(tmp_path, data))
    with pytest.raises(LogError, match="no usable flight data"):
        open_log(log(tmp_path, whole + bytes(5000)))
