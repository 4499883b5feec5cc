"""Structure of MCAP for the fuzzer: records, chunks with their sizes and checksums, definitions, bombs."""

import struct
import zlib
from functools import lru_cache
from random import Random

import lz4.frame  # type: ignore[import-untyped]
import zstandard

from tests.fuzz.bytes_mutated import mutate_bytes
from tests.fuzz.text_mutated import mutate_text

MAGIC = b"\x89MCAP0\r\n"
SCHEMA, CHANNEL, MESSAGE, CHUNK, FOOTER = 3, 4, 5, 6, 2
_ZSTD = zstandard.ZstdCompressor(level=1)
_SCHEMA_TEXT = struct.Struct("<I")
BOMB_SIZES = (1 << 20, 32 << 20, 256 << 20)


def split(data: bytes) -> list[bytes]:
    """The records of a log, the marks at both ends among them."""
    records, offset = [data[:8]], 8
    while offset + 9 <= len(data) and data[offset:] != MAGIC:
        end = offset + 9 + int.from_bytes(data[offset + 1 : offset + 9], "little")
        records.append(data[offset:end])
        offset = end
    return [*records, data[offset:]]


def record(kind: int, body: bytes) -> bytes:
    """A record with its length."""
    return bytes([kind]) + struct.pack("<Q", len(body)) + body


def repair(rng: Random, data: bytes) -> bytes:
    """A chunk gets its size and checksum, and now and then a compression; half of them also a mutated content."""
    if len(data) < 49 or data[0] != CHUNK:
        return data
    body = _content(data)
    if not body:
        return data
    if rng.random() < 0.5:
        body = _mutate_content(rng, body)
    compression = rng.choice((b"", b"", b"zstd", b"lz4"))
    packed = bytes({b"": bytes, b"zstd": _ZSTD.compress, b"lz4": lz4.frame.compress}[compression](body))
    return _chunk(data[9:25], body, compression, packed, len(body))


def define(rng: Random, data: bytes) -> bytes:
    """A definition that says something else, that there are many of, or a chunk made to inflate."""
    if not data or data[0] not in (SCHEMA, CHUNK):
        return data
    if data[0] == SCHEMA:
        changed = _redefined(rng, data)
        return changed if rng.random() < 0.8 else _many(rng, changed)
    if rng.random() < 0.05:
        return _bomb(data[9:25], rng.choice(BOMB_SIZES), rng.random() < 0.5)
    records = split(MAGIC + _content(data))[1:-1]
    schemas = [k for k, r in enumerate(records) if r[:1] == bytes([SCHEMA])]
    if schemas:
        at = rng.choice(schemas)
        records[at] = _redefined(rng, records[at])
    body = b"".join(records)
    return _chunk(data[9:25], body, b"", body, len(body))


def finish(data: bytes) -> bytes:
    """Writes the summary's checksum into the footer, where there is one and it points into the file."""
    foot = len(data) - 37
    if foot < 8 or data[foot] != FOOTER or not data.endswith(MAGIC):
        return data
    start = struct.unpack_from("<Q", data, foot + 9)[0]
    if not 8 <= start <= foot:
        return data
    return data[: foot + 25] + struct.pack("<I", zlib.crc32(data[start : foot + 25])) + data[foot + 29 :]


def _content(data: bytes) -> bytes:
    """The records inside a chunk that is not compressed."""
    if len(data) < 49:
        return b""
    named = struct.unpack_from("<I", data, 37)[0]
    return data[49 + named :] if named < 8 and data[41 : 41 + named] == b"" else b""


def _chunk(times: bytes, body: bytes, compression: bytes, packed: bytes, declared: int) -> bytes:
    head = times + struct.pack("<QII", declared, zlib.crc32(body), len(compression)) + compression
    return record(CHUNK, head + struct.pack("<Q", len(packed)) + packed)


def _mutate_content(rng: Random, body: bytes) -> bytes:
    records = split(MAGIC + body)[1:-1]
    if not records:
        return body
    at = rng.randrange(len(records))
    changed = mutate_bytes(rng, records[at][9:], rng.randrange(1, 3))
    length = len(changed) if rng.random() < 0.8 else rng.randrange(2 * len(changed) + 2)
    records[at] = records[at][:1] + struct.pack("<Q", length) + changed
    return b"".join(records)


def _parts(data: bytes) -> tuple[bytes, bytes, bytes, bytes] | None:
    """Number, name, encoding and text of a schema; None for one whose lengths are wrong."""
    number, at, parts = data[9:11], 11, []
    for _ in range(3):
        if at + 4 > len(data):
            return None
        size = _SCHEMA_TEXT.unpack_from(data, at)[0]
        parts.append(data[at + 4 : at + 4 + size])
        at += 4 + size
    return (number, parts[0], parts[1], parts[2]) if at == len(data) else None


def _schema(number: bytes, *parts: bytes) -> bytes:
    return record(SCHEMA, number + b"".join(_SCHEMA_TEXT.pack(len(p)) + p for p in parts))


def _redefined(rng: Random, data: bytes) -> bytes:
    parts = _parts(data)
    if parts is None:
        return data
    number, name, encoding, text = parts
    choice = rng.random()
    if choice < 0.8:
        text = mutate_text(rng, text.decode("utf-8", "replace")).encode()
    elif choice < 0.9:
        name = mutate_text(rng, name.decode("utf-8", "replace")).encode()
    else:
        encoding = rng.choice((b"", b"ros2idl", b"ros1msg", b"protobuf", b"ros2msg\0"))
    return _schema(number, name, encoding, text)


def _many(rng: Random, data: bytes) -> bytes:
    """The same schema under many numbers."""
    parts = _parts(data)
    count = rng.choice((10, 300, 6000))
    return (
        data
        if parts is None
        else data + b"".join(_schema(struct.pack("<H", n), *parts[1:3], b"") for n in range(count))
    )


@lru_cache(maxsize=8)
def _zeros(size: int, zstd: bool) -> bytes:
    return bytes(_ZSTD.compress(bytes(size)) if zstd else lz4.frame.compress(bytes(size)))


@lru_cache(maxsize=8)
def _crc_of_zeros(size: int) -> int:
    return zlib.crc32(bytes(size))


def _bomb(times: bytes, size: int, zstd: bool) -> bytes:
    name, packed = b"zstd" if zstd else b"lz4", _zeros(size, zstd)
    head = times + struct.pack("<QII", size, _crc_of_zeros(size), len(name)) + name
    return record(CHUNK, head + struct.pack("<Q", len(packed)) + packed)
