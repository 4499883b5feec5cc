"""Our decoder of telemetry and pymavlink's say the same of every message that is read, whole or damaged."""

from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import pytest
from pymavlink.generator.mavcrc import x25crc
from quadid_replay.tlog import _DIALECT, _WANTED, Frames, decode, intact, read_frames


def frame_of(rng: Random, kind: Any, old: bool) -> bytes:
    """A frame with random numbers, shorter or longer than they should be now and then; one in ten is damaged."""
    size = kind.unpacker.size
    payload = rng.randbytes(rng.choice((size, size, rng.randrange(size + 1), size + rng.randrange(5))))
    if old:
        head = bytes([0xFE, len(payload), 1, 2, 3, kind.id])
    else:
        head = bytes([0xFD, len(payload), rng.choice((0, 1)), 0, 1, 2, 3]) + kind.id.to_bytes(3, "little")
    crc = x25crc(head[1:] + payload + bytes([kind.crc_extra])).crc ^ (rng.random() < 0.1)
    signature = bytes(13) if not old and head[2] else b""
    return head + payload + int(crc).to_bytes(2, "little") + signature


def written(path: Path, frames: list[bytes]) -> Frames:
    path.write_bytes(b"".join((1_700_000_000_000_000 + k).to_bytes(8, "big") + f for k, f in enumerate(frames)))
    return read_frames(path)


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("number", sorted(_WANTED))
def test_every_field_is_that_of_the_library(tmp_path: Path, number: int) -> None:
    rng, library, kind = Random(number), _DIALECT.MAVLink(None), _DIALECT.mavlink_map[number]
    raw = [frame_of(rng, kind, old=k % 2 == 1 and number < 256) for k in range(100)]
    frames = written(tmp_path / "log", raw)
    assert [frames.frame(k) for k in range(100)] == raw
    theirs = []
    for frame in raw:
        try:
            theirs.append(library.decode(bytearray(frame)))
        except _DIALECT.MAVError:
            theirs.append(None)
    which = np.arange(100)
    good = intact(frames, which, np.full(100, kind.crc_extra))
    assert good.tolist() == [m is not None for m in theirs]
    assert 50 < np.count_nonzero(good) < 100
    ours = decode(frames, kind, which[good])
    for field in kind.fieldnames:
        found, kept = getattr(ours, field), [getattr(m, field) for m in theirs if m is not None]
        rows = zip(*found, strict=True) if isinstance(kept[0], list) else found
        for one, other in zip(rows, kept, strict=True):
            assert repr(np.array(one).tolist()) == repr(other), field
    with pytest.raises(AttributeError, match="no_such_field"):
        _ = ours.no_such_field
