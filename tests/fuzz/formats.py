"""The structure of the four binary formats, as far as a fuzzer must know it: records, length fields, checksums.

A format splits a log into records, tells where a record's length stands, and repairs checksums, so that mutations get
past the first door: a frame with a wrong checksum only ever tests the checksum.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Callable, Sequence
from random import Random
from typing import NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from pymavlink.dialects.v20 import ardupilotmega
from quadid_replay.esc_messages import extend_dialect

from tests.fuzz.bytes_mutated import mutate_bytes

_MESSAGES = extend_dialect(ardupilotmega).mavlink_map
_MCAP_MAGIC = b"\x89MCAP0\r\n"
_CHUNK, _FOOTER = 6, 2
_ZSTD = zstandard.ZstdCompressor(level=1)


class Format(NamedTuple):
    """What a fuzzer needs of a format.

    Attributes:
        split: the records of a log; joined they are the log.
        length: place and width of the length field in a record, or None.
        repair: makes one record's checksums right again, most of the time.
        finish: makes those right that cover the whole file.
    """

    split: Callable[[bytes], list[bytes]]
    length: tuple[int, int] | None
    repair: Callable[[Random, bytes], bytes]
    finish: Callable[[bytes], bytes]


def _as_it_is(rng: Random, record: bytes) -> bytes:
    return record


def _unchanged(data: bytes) -> bytes:
    return data


# --- MCAP


def _split_mcap(data: bytes) -> list[bytes]:
    records, offset = [data[:8]], 8
    while offset + 9 <= len(data) and data[offset:] != _MCAP_MAGIC:
        end = offset + 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
        records.append(data[offset:end])
        offset = end
    return [*records, data[offset:]]


def _repair_mcap(rng: Random, record: bytes) -> bytes:
    """A chunk gets its size and checksum, and now and then a compression; half of them also a mutated content."""
    if len(record) < 49 or record[0] != _CHUNK:
        return record
    named = struct.unpack_from("<I", record, 37)[0]
    body = record[49 + named :] if named < 8 and record[41 : 41 + named] == b"" else b""
    if not body:
        return record
    if rng.random() < 0.5:
        body = _mutate_content(rng, body)
    compression = rng.choice((b"", b"", b"zstd", b"lz4"))
    packed = bytes({b"": bytes, b"zstd": _ZSTD.compress, b"lz4": lz4.frame.compress}[compression](body))
    size, crc = len(body), zlib.crc32(body)
    inner = record[9:25] + struct.pack("<QII", size, crc, len(compression)) + compression
    inner += struct.pack("<Q", len(packed)) + packed
    return bytes([_CHUNK]) + struct.pack("<Q", len(inner)) + inner


def _mutate_content(rng: Random, body: bytes) -> bytes:
    records = _split_mcap(_MCAP_MAGIC + body)[1:-1]
    if not records:
        return body
    at = rng.randrange(len(records))
    record = mutate_bytes(rng, records[at][9:], rng.randrange(1, 3))
    length = len(record) if rng.random() < 0.8 else rng.randrange(2 * len(record) + 2)
    records[at] = records[at][:1] + struct.pack("<Q", length) + record
    return b"".join(records)


def _finish_mcap(data: bytes) -> bytes:
    """Writes the summary's checksum into the footer, where there is one and it points into the file."""
    foot = len(data) - 37
    if foot < 8 or data[foot] != _FOOTER or not data.endswith(_MCAP_MAGIC):
        return data
    start = struct.unpack_from("<Q", data, foot + 9)[0]
    if not 8 <= start <= foot:
        return data
    return data[: foot + 25] + struct.pack("<I", zlib.crc32(data[start : foot + 25])) + data[foot + 29 :]


# --- MAVLink telemetry


def _split_tlog(data: bytes) -> list[bytes]:
    records, offset = [], 0
    while offset + 12 < len(data):
        end = offset + (16 if data[offset + 8] == 0xFE else 20) + data[offset + 9]
        records.append(data[offset:end])
        offset = end
    return records


def _repair_tlog(rng: Random, record: bytes) -> bytes:
    """The checksum of a frame, with the message's own seed (MAVLink's X.25)."""
    if len(record) < 18 or record[8] not in (0xFE, 0xFD):
        return record
    number = record[13] if record[8] == 0xFE else int.from_bytes(record[15:18], "little")
    message = _MESSAGES.get(number)
    if message is None:
        return record
    crc = 0xFFFF
    for byte in record[9:-2] + bytes([message.crc_extra]):
        mixed = (byte ^ crc) & 0xFF
        mixed = (mixed ^ mixed << 4) & 0xFF
        crc = crc >> 8 ^ mixed << 8 ^ mixed << 3 ^ mixed >> 4
    return record[:-2] + struct.pack("<H", crc)


# --- DataFlash, ULog


def _split_dataflash(data: bytes) -> list[bytes]:
    lengths, records, offset = {0x80: 89}, [], 0
    while offset + 3 <= len(data):
        end = offset + lengths[data[offset + 2]]
        record = data[offset:end]
        if record[2] == 0x80:
            lengths[record[3]] = record[4]
        records.append(record)
        offset = end
    return records


def _split_ulog(data: bytes) -> list[bytes]:
    records, offset = [data[:16]], 16
    while offset + 3 <= len(data):
        end = offset + 3 + int.from_bytes(data[offset : offset + 2], "little")
        records.append(data[offset:end])
        offset = end
    return records


def _repair_ulog(rng: Random, record: bytes) -> bytes:
    """The length of a record, which mutations of its body have made wrong."""
    return struct.pack("<H", len(record) - 3) + record[2:] if 3 <= len(record) < 65538 else record


FORMATS: dict[str, Format] = {
    "mcap": Format(_split_mcap, (1, 8), _repair_mcap, _finish_mcap),
    "tlog": Format(_split_tlog, (9, 1), _repair_tlog, _unchanged),
    "dataflash": Format(_split_dataflash, (4, 1), _as_it_is, _unchanged),
    "ulog": Format(_split_ulog, (0, 2), _repair_ulog, _unchanged),
}


def mutated(rng: Random, kind: str, seeds: Sequence[bytes]) -> bytes:
    """Returns one mutated input of a format: records changed, lost, doubled, swapped, spliced; bytes changed; cut."""
    form = FORMATS[kind]
    records = form.split(rng.choice(seeds))
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(records)) or rng.randrange(len(records))  # the first one tells the format: seldom
        _change(rng, form, records, at, seeds)
        if not records:
            return b""
    data = b"".join(records)
    if rng.random() < 0.9:
        data = form.finish(data)
    if rng.random() < 0.15:
        data = mutate_bytes(rng, data, rng.choice((1, 2, 8)))
    return data[: rng.randrange(1, len(data) + 1)] if rng.random() < 0.05 and data else data


def _change(rng: Random, form: Format, records: list[bytes], at: int, seeds: Sequence[bytes]) -> None:
    choice = rng.random()
    if choice < 0.55:
        record = mutate_bytes(rng, records[at], rng.choice((1, 1, 2, 3)))
        records[at] = form.repair(rng, record) if rng.random() < 0.8 else record
    elif choice < 0.65:
        records[at] = form.repair(rng, records[at])
    elif choice < 0.73 and form.length is not None:
        place, width = form.length
        changed = bytearray(records[at])
        value = rng.choice((0, 1, len(changed) - 1, len(changed) + 1, 255, 65535, 2**31, 2**63 - 1, 2**64 - 1))
        changed[place : place + width] = (value & (1 << 8 * width) - 1).to_bytes(width, "little")
        records[at] = bytes(changed)
    elif choice < 0.8:
        del records[at]
    elif choice < 0.86:
        records.insert(at, records[at])
    elif choice < 0.92:
        other = rng.randrange(len(records))
        records[at], records[other] = records[other], records[at]
    else:
        records.insert(at, rng.choice(form.split(rng.choice(seeds))))
