"""Our decoder of telemetry and pymavlink's say the same of every message that is read, whole or damaged."""

from __future__ import annotations

from random import Random
from typing import Any

import pytest
from pymavlink.generator.mavcrc import x25crc
from quadid_replay.mavlink_decode import Decoder
from quadid_replay.tlog_reader import _DIALECT, _WANTED

DECODER = Decoder(_DIALECT, _WANTED)


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


@pytest.mark.parametrize("number", sorted(_WANTED))
def test_every_field_is_that_of_the_library(number: int) -> None:
    rng, library, kind = Random(number), _DIALECT.MAVLink(None), _DIALECT.mavlink_map[number]
    refused = 0
    for k in range(100):
        frame = frame_of(rng, kind, old=k % 2 == 1 and number < 256)
        ours = DECODER.decode(number, memoryview(frame))
        try:
            theirs = library.decode(bytearray(frame))
        except _DIALECT.MAVError:
            assert ours is None
            refused += 1
            continue
        assert ours is not None
        assert ours.get_type() == theirs.get_type()
        for field in kind.fieldnames:
            assert repr(getattr(ours, field)) == repr(getattr(theirs, field)), field
    assert 0 < refused < 50
