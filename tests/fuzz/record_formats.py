"""Structure of telemetry, DataFlash, ULog, µSD and blackbox logs for the fuzzer: records, checksums, definitions."""

import re
import struct
import zlib
from random import Random

from pymavlink.dialects.v20 import ardupilotmega
from quadid_replay.mavlink_messages import extend_dialect

from tests.fuzz.text_mutated import mutate_text

_MESSAGES = extend_dialect(ardupilotmega).mavlink_map


# --- MAVLink telemetry


def split_tlog(data: bytes) -> list[bytes]:
    """Frames, each with its receive time."""
    records, offset = [], 0
    while offset + 12 < len(data):
        end = offset + (16 if data[offset + 8] == 0xFE else 20) + data[offset + 9]
        records.append(data[offset:end])
        offset = end
    return records


def repair_tlog(rng: Random, record: bytes) -> bytes:
    """The length of a frame's payload and its checksum, with the message's own seed (MAVLink's X.25)."""
    if len(record) < 18 or record[8] not in (0xFE, 0xFD):
        return record
    number = record[13] if record[8] == 0xFE else int.from_bytes(record[15:18], "little")
    message = _MESSAGES.get(number)
    if message is None:
        return record
    payload = len(record) - (16 if record[8] == 0xFE else 20)
    if 0 <= payload < 256 and rng.random() < 0.8:
        record = record[:9] + bytes([payload]) + record[10:]
    crc = 0xFFFF
    for byte in record[9:-2] + bytes([message.crc_extra]):
        mixed = (byte ^ crc) & 0xFF
        mixed = (mixed ^ mixed << 4) & 0xFF
        crc = crc >> 8 ^ mixed << 8 ^ mixed << 3 ^ mixed >> 4
    return record[:-2] + struct.pack("<H", crc)


def define_tlog(rng: Random, record: bytes) -> bytes:
    """The same payload under another message's number, system or component, at another receive time."""
    if len(record) < 20:
        return record
    changed = bytearray(record)
    choice = rng.random()
    if choice < 0.4:
        at, width = (13, 1) if record[8] == 0xFE else (15, 3)
        changed[at : at + width] = rng.choice(list(_MESSAGES)).to_bytes(3, "little")[:width]
    elif choice < 0.7:
        changed[11 if record[8] == 0xFE else 13] = rng.choice((0, 1, 2, 255))
    else:
        moved = int.from_bytes(record[:8], "big") + rng.choice((-1, 1)) * 10 ** rng.randrange(14)
        changed[:8] = (moved % 2**64).to_bytes(8, "big")
    return repair_tlog(rng, bytes(changed))


# --- DataFlash


def split_dataflash(data: bytes) -> list[bytes]:
    """Records by the lengths that the log declares."""
    lengths, records, offset = {0x80: 89}, [], 0
    while offset + 3 <= len(data):
        end = offset + lengths[data[offset + 2]]
        record = data[offset:end]
        if record[2] == 0x80:
            lengths[record[3]] = record[4]
        records.append(record)
        offset = end
    return records


def define_dataflash(rng: Random, record: bytes) -> bytes:
    """A format that says something else: number, length, letters, column names."""
    if len(record) != 89 or record[2] != 0x80:
        return record
    changed = bytearray(record)
    place, width = rng.choice(((3, 1), (4, 1), (5, 4), (9, 16), (25, 64)))
    if width == 1:
        changed[place] = rng.choice((0, 3, 0x80, 255, changed[place] + 1 & 255))
    elif width == 16:
        changed[place + rng.randrange(16)] = rng.choice(b"bBhHiIfdnNZcCeELMqQa\0")
    else:
        text = mutate_text(rng, record[place : place + width].rstrip(b"\0").decode("latin-1").replace(",", ";"))
        changed[place : place + width] = text.replace(";", ",").encode("latin-1", "replace")[:width].ljust(width, b"\0")
    return bytes(changed)


# --- ULog


def split_ulog(data: bytes) -> list[bytes]:
    """The file's head, then records."""
    records, offset = [data[:16]], 16
    while offset + 3 <= len(data):
        end = offset + 3 + int.from_bytes(data[offset : offset + 2], "little")
        records.append(data[offset:end])
        offset = end
    return records


def repair_ulog(rng: Random, record: bytes) -> bytes:
    """The length of a record, which mutations of its body have made wrong."""
    return struct.pack("<H", len(record) - 3) + record[2:] if 3 <= len(record) < 65538 else record


def define_ulog(rng: Random, record: bytes) -> bytes:
    """A format that says something else."""
    if record[2:3] not in (b"F", b"A", b"P", b"I", b"M"):
        return record
    text = mutate_text(rng, record[3:].decode("latin-1"))
    return repair_ulog(rng, record[:3] + text.encode("latin-1", "replace")[:60000])


# --- Crazyflie µSD


def split_usd(data: bytes) -> list[bytes]:
    """Head, declarations of event types, records, checksum."""
    at, sizes, records = 5, {}, [data[:5]]
    for _ in range(int.from_bytes(data[3:5], "little")):
        begin, number = at, data[at : at + 2]
        at = data.index(b"\0", at + 2) + 1
        width, at, size = int.from_bytes(data[at : at + 2], "little"), at + 2, 10
        for _ in range(width):
            at = data.index(b"\0", at) + 1
            size += struct.calcsize("<" + chr(data[at - 3]))
        sizes[number] = size
        records.append(data[begin:at])
    while at + 4 < len(data):
        end = at + sizes[data[at : at + 2]]
        records.append(data[at:end])
        at = end
    return [*records, data[at:]]


def define_usd(rng: Random, record: bytes) -> bytes:
    """Another name, type or number of variables of an event type."""
    if b"(" not in record or not record.endswith(b"\0"):
        return record
    text = mutate_text(rng, record[2:-1].decode("latin-1").replace("\0", ";"))
    return record[:2] + text.replace(";", "\0").encode("latin-1", "replace") + b"\0"


def finish_usd(data: bytes) -> bytes:
    """The checksum at the end."""
    return data[:-4] + struct.pack("<I", zlib.crc32(data[:-4]))


# --- Betaflight blackbox

_PIECE = re.compile(rb"H [^\n]*\n|[IPSEGH][^IPSEGH]*|[^IPSEGH]+", re.DOTALL)


def split_blackbox(data: bytes) -> list[bytes]:
    """Header lines, then pieces that begin with the letter of a frame."""
    return _PIECE.findall(data)


def define_blackbox(rng: Random, record: bytes) -> bytes:
    """A header line that says something else."""
    if not record.startswith(b"H "):
        return record
    return b"H " + mutate_text(rng, record[2:].decode("latin-1")).encode("latin-1", "replace")
