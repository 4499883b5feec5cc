"""Metadata records at the beginning of an MCAP file, as `TopicWriter` puts them there."""

from __future__ import annotations

import struct
from io import BytesIO
from pathlib import Path

from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Metadata

MAGIC = b"\x89MCAP0\r\n"
LARGEST = 1 << 22
"""Metadata beyond this are not ours [bytes]."""
_RECORD = struct.Struct("<BQ")


def read_metadata(path: Path) -> dict[str, dict[str, str]]:
    """Metadata records before the first message, by name; empty for a file without any, damaged or no MCAP at all."""
    found: dict[str, dict[str, str]] = {}
    try:
        with path.open("rb") as file:
            if file.read(len(MAGIC)) != MAGIC:
                return {}
            while len(head := file.read(_RECORD.size)) == _RECORD.size:
                kind, length = _RECORD.unpack(head)
                if kind not in (Opcode.HEADER, Opcode.METADATA) or length > LARGEST:
                    break
                body = file.read(length)
                if kind == Opcode.METADATA:
                    record = Metadata.read(ReadDataStream(BytesIO(body)))
                    found[record.name] = record.metadata
    except (OSError, McapError, struct.error, ValueError):
        return found
    return found
