"""Requests and answers of fits as bytes, between machines and on the disk.

MessagePack, read by the types that the records declare.  What comes over a network names no function and no class: it
is one of the kinds below.  Numbers of arrays travel in one block beside the record, so that a record is small, and few
bytes never make gigabytes.

python -m quadid_node.wire_format FILE  # does a job that failed and was kept again, and prints what becomes of it
"""

import contextlib
import errno
import math
import sys
import time
import zlib
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from quadid.errors import QuadidError
from quadid.files import read_regular
from quadid.online.change_job import ChangeReply, ChangeRequest, DiagnosisReply, DiagnosisRequest
from quadid.online.fit_job import FitReply, FitRequest
from quadid.online.records import Job, JobReply
from quadid.vehicle import Vehicle

LARGEST = 1 << 24
"""Parcels beyond this are refused [bytes]; a minute of flight at 50 Hz has less than one mebibyte."""
LARGEST_RECORD = 1 << 18
"""A record without its numbers has at most so many [bytes]: an empty map is one byte that takes 64 of memory."""
MOST_AXES = 3


def _tag(kind: type) -> str:
    """Name of a kind with a checksum of its fields and their types: another version's is refused."""
    schema = msgspec.json.encode(msgspec.json.schema(kind, schema_hook=lambda _: {"type": "object"}))
    return f"{kind.__name__} {zlib.crc32(schema):08x}"


KINDS: Mapping[str, type] = {
    _tag(kind): kind for kind in (FitRequest, FitReply, ChangeRequest, ChangeReply, DiagnosisRequest, DiagnosisReply)
}


class ParcelError(QuadidError):
    """Bytes that are no parcel of ours."""


def pack(item: object) -> bytes:
    """A request or an answer as bytes; raises ParcelError for anything else."""
    numbers: list[bytes] = []

    def plain(value: Any) -> Any:
        if isinstance(value, Vehicle):
            return value.model_dump_json(exclude_unset=True)  # a default that is given is more than a default
        if isinstance(value, np.generic):
            return value.item()
        numbers.append(np.ascontiguousarray(value, dtype="<f8").tobytes())
        return value.shape, value.flags.writeable

    tag = next((tag for tag, kind in KINDS.items() if kind is type(item)), None)
    if tag is None:
        raise ParcelError(f"a parcel with a {type(item).__name__}", ", ".join(KINDS))
    record = msgspec.msgpack.encode(item, enc_hook=plain)
    parcel: bytes = msgspec.msgpack.encode((tag, record, b"".join(numbers)))
    return parcel


def unpack(data: bytes) -> Any:
    """The request or answer in bytes.

    Raises:
        ParcelError: too large, damaged, of another kind or version, or with a field of another type.
    """
    if len(data) > LARGEST:
        raise ParcelError(f"a parcel of {len(data)} bytes", f"at most {LARGEST}")
    numbers = np.empty(0)

    def record_of(kind: Any, value: Any) -> Any:
        nonlocal numbers
        if kind is Vehicle:
            return Vehicle.model_validate_json(value)
        shape, writable = msgspec.convert(value, tuple[tuple[int, ...], bool])
        count = math.prod(shape)
        if len(shape) > MOST_AXES or min(shape, default=0) < 0 or count > numbers.size:
            raise ParcelError(f"an array of shape {shape} in {numbers.size} numbers", f"up to {MOST_AXES} axes")
        found, numbers = numbers[:count].reshape(shape), numbers[count:]  # each number is used once
        return found.copy() if writable else found

    try:
        tag, record, block = msgspec.msgpack.decode(data, type=tuple[str, bytes, bytes])
        if tag not in KINDS or len(record) > LARGEST_RECORD:
            raise ParcelError(f"a parcel of kind {tag[:60]!r} with {len(record)} bytes", ", ".join(KINDS))
        numbers = np.frombuffer(block, "<f8")
        item: Any = msgspec.msgpack.decode(record, type=KINDS[tag], dec_hook=record_of)
        if numbers.size:
            raise ParcelError(f"{numbers.size} numbers that belong to no array", "a whole parcel")
    except ParcelError:
        raise
    except Exception as error:
        raise ParcelError(f"damaged parcel ({type(error).__name__})", "a whole one, of the same version") from error
    return item


# --- Inputs of jobs that failed by an error of this program, kept beside the history so that the error can be repeated


MOST = 8
"""Newest inputs kept: a minute of flight takes less than a mebibyte."""
SUFFIX = ".job"


def folder_of(history: Path) -> Path:
    """The folder beside a history."""
    return history.with_name(f"{history.name}.failures")


def keep(history: Path, job: Job) -> str:
    """Keeps the input of a job, and the newest `MOST` of all; returns where, or why not, for people."""
    folder = folder_of(history)
    path = folder / f"{time.time_ns():020d}-{type(job).__name__}{SUFFIX}"
    try:
        folder.mkdir(exist_ok=True)
        if folder.is_symlink():  # whose oldest files would be removed
            raise OSError(errno.ELOOP, "a link stands there", str(folder))
        others = sorted(folder.glob(f"*{SUFFIX}"))
        path.write_bytes(pack(job))
        for old in others[: 1 - MOST]:
            with contextlib.suppress(OSError):
                old.unlink()
    except (OSError, ParcelError) as error:
        return f"its input could not be kept ({error})"
    return f"its input is in {path}"


def repeat(path: Path) -> JobReply:
    """Does the job of a kept input again; raises ParcelError for a file that holds none, OSError."""
    reply: JobReply = unpack(read_regular(path, LARGEST)).run()
    return reply


if __name__ == "__main__":
    sys.stdout.write(f"{repeat(Path(sys.argv[1]))}\n")
