"""Files cut at any byte, bytes flipped, garbage inside and behind: what is before the damage is read."""

from pathlib import Path

import numpy as np
import pytest
import quadid_replay.writers
from quadid_replay import open_log, write_csv, write_mcap, write_tlog

from quadid.data.window import Recording
from quadid.errors import QuadidError
from tests.faults.evidence import Happened
from tests.replay.synthetic import full_recording

CUTS, FLIPS = 40, 60
FORMATS = ("csv", "mcap", "tlog", "dataflash", "ulog", "usdlog", "blackbox")
ROWS = {"mcap": 1, "tlog": 3, "dataflash": 3, "ulog": 4}
"""Rows of the list of faults that these formats belong to."""


@pytest.fixture(scope="module", params=FORMATS)
def log(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory, data_dir: Path) -> bytes:
    """A whole log of a format, a few hundred kB at most."""
    kind = request.param
    path = tmp_path_factory.mktemp("logs") / "log"
    if kind == "dataflash":
        return (data_dir / "ardupilot" / "log171.bin").read_bytes()[:250_000]
    if kind == "usdlog":
        return (data_dir / "crazypad" / "motor_126.usd").read_bytes()
    if kind == "blackbox":
        return Path(__file__).with_name("golden.bbl").read_bytes()
    if kind == "ulog":
        return (data_dir / "px4" / "ascend_cubeorange_test.ulg").read_bytes()[:400_000]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(quadid_replay.writers, "CHUNK_BYTES", 8192)
        {"csv": write_csv, "mcap": write_mcap, "tlog": write_tlog}[kind](path, full_recording(2.0, 50.0))
    return path.read_bytes()


def attempt(path: Path, data: bytes) -> Recording | None:
    """The recording, or None where the file is refused with one line that says what is allowed."""
    path.write_bytes(data)
    try:
        return open_log(path)
    except QuadidError as error:
        if "\n" in str(error) or not error.found:
            raise AssertionError("an error must be one line that says what was found") from error
        return None


def sane(recording: Recording) -> None:
    assert recording.channels
    for channel in recording.channels.values():
        assert np.isfinite(channel.values).all()
        assert np.all(np.diff(channel.t) > 0.0)


def test_cut_anywhere_gives_a_prefix(
    log: bytes, tmp_path: Path, request: pytest.FixtureRequest, happened: Happened
) -> None:
    whole = attempt(tmp_path / "log", log)
    assert whole is not None
    rng = np.random.default_rng(len(log))
    cuts = sorted({1, 2, 7, 8, 9, 15, 16, 17, len(log) - 1, *(int(c) for c in rng.integers(1, len(log), CUTS))})
    told = counted = 0
    for cut in cuts:
        part = attempt(tmp_path / "log", log[:cut])
        if part is None:
            continue
        sane(part)
        counted += 1
        told += bool(part.warnings) or cut == len(log)
        for name, channel in part.channels.items():
            full = whole.channels.get(name)
            if full is None or full.source != channel.source or full.values.shape[1] != channel.values.shape[1]:
                continue  # another source or number of motors was the best of what was left
            assert len(channel.t) <= len(full.t)
            np.testing.assert_array_equal(channel.t, full.t[: len(channel.t)])
            same = np.abs(channel.values - full.values[: len(channel.t)])
            assert not same.any(), name
    assert counted > 0.5 * len(cuts)
    assert told > 0.85 * counted  # only a cut between two records cannot be seen
    kind = request.node.callspec.params["log"]
    if kind in ROWS:
        text = f"{kind} cut at {len(cuts)} places: {counted} read, each an exact beginning, the loss stated in {told}"
        happened(ROWS[kind], f"{text}; the others, cut inside their head, refused")


def test_flipped_bytes_are_survived(
    log: bytes, tmp_path: Path, request: pytest.FixtureRequest, happened: Happened
) -> None:
    rng = np.random.default_rng(7)
    read = 0
    for place in rng.integers(0, len(log), FLIPS):
        data = bytearray(log)
        data[place] ^= int(rng.integers(1, 256))
        recording = attempt(tmp_path / "log", bytes(data))
        if recording is not None:
            sane(recording)
            read += 1
    assert read > 0.8 * FLIPS
    kind = request.node.callspec.params["log"]
    if kind in ROWS:
        happened(ROWS[kind], f"{kind} with one byte changed, {FLIPS} times: {read} read to finite, rising channels")


def test_garbage_in_the_middle_and_at_the_end(log: bytes, tmp_path: Path) -> None:
    rng = np.random.default_rng(9)
    for at, length in ((len(log) // 3, 64), (len(log) // 2, 3000), (len(log), 5000)):
        recording = attempt(tmp_path / "log", log[:at] + rng.bytes(length) + log[at + length :])
        if recording is not None:
            sane(recording)


def test_a_log_that_is_only_its_first_bytes(log: bytes, tmp_path: Path) -> None:
    for length in range(1, 40):
        assert attempt(tmp_path / "log", log[:length]) is None


def test_noise_behind_a_true_beginning(log: bytes, tmp_path: Path) -> None:
    rng = np.random.default_rng(11)
    for size in (100, 5000, 50_000):
        recording = attempt(tmp_path / "log", log[:64] + rng.bytes(size))
        if recording is not None:
            sane(recording)
