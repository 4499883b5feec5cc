"""The structure of the binary formats, as far as a fuzzer must know it: records, lengths, checksums, definitions.

A format splits a log into records, tells where a record's length stands, repairs checksums, and changes what the log
says of itself, so that mutations get past the first door: a frame with a wrong checksum only ever tests the checksum.
"""

from collections.abc import Callable, Sequence
from functools import lru_cache
from random import Random
from typing import NamedTuple

from tests.fuzz import mcap_format as mcap
from tests.fuzz import record_formats as plain
from tests.fuzz import rosbag2_format as rosbag2
from tests.fuzz.bytes_mutated import mutate_bytes

FLOODED = (1 << 14, 1 << 17, 1 << 20)
"""Sizes that an input grows to [bytes] where records or filler are repeated: what takes quadratic time shows there."""
FILLER = (b"\xfe", b"\x00", b"\xff", b"\xa3\x95\x80", b"\x2f\x73\x13\x20\x25\x0c\xbb\x12", b"I")
"""Bytes that some format takes for the beginning of something."""


class Format(NamedTuple):
    """Functions that a fuzzer needs of a format.

    Attributes:
        split: the records of a log; joined they are the log.
        length: place and width of the length field in a record, or None.
        repair: makes one record's lengths and checksums right again, most of the time.
        define: changes what a record says of other records; one that says nothing comes back as it is.
        finish: makes the whole file's checksums right.
    """

    split: Callable[[bytes], list[bytes]]
    length: tuple[int, int] | None
    repair: Callable[[Random, bytes], bytes]
    define: Callable[[Random, bytes], bytes]
    finish: Callable[[bytes], bytes]


def _as_it_is(rng: Random, record: bytes) -> bytes:
    return record


def _unchanged(data: bytes) -> bytes:
    return data


FORMATS: dict[str, Format] = {
    "mcap": Format(mcap.split, (1, 8), mcap.repair, mcap.define, mcap.finish),
    "tlog": Format(plain.split_tlog, (9, 1), plain.repair_tlog, plain.define_tlog, _unchanged),
    "dataflash": Format(plain.split_dataflash, (4, 1), _as_it_is, plain.define_dataflash, _unchanged),
    "ulog": Format(plain.split_ulog, (0, 2), plain.repair_ulog, plain.define_ulog, _unchanged),
    "rosbag2": Format(rosbag2.split, None, rosbag2.repair, rosbag2.define, rosbag2.finish),
    "usdlog": Format(plain.split_usd, None, _as_it_is, plain.define_usd, plain.finish_usd),
    "blackbox": Format(plain.split_blackbox, None, _as_it_is, plain.define_blackbox, _unchanged),
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
    if rng.random() < 0.01:
        _flood(rng, records)
    data = b"".join(records)
    if rng.random() < 0.9:
        data = form.finish(data)
    if rng.random() < 0.15:
        data = mutate_bytes(rng, data, rng.choice((1, 2, 8)))
    return data[: rng.randrange(1, len(data) + 1)] if rng.random() < 0.05 and data else data


def _flood(rng: Random, records: list[bytes]) -> None:
    """Repeats a run of records, or filler, up to one of the sizes `FLOODED`."""
    at = rng.randrange(len(records))
    piece = b"".join(records[at : at + rng.choice((1, 2, 3))]) if rng.random() < 0.5 else rng.choice(FILLER)
    size = rng.choice((*FLOODED, FLOODED[0]))
    records[at:at] = [piece] * (size // max(len(piece), 1))


def _change(rng: Random, form: Format, records: list[bytes], at: int, seeds: Sequence[bytes]) -> None:
    choice = rng.random()
    if choice < 0.35:
        record = mutate_bytes(rng, records[at], rng.choice((1, 1, 2, 3)))
        records[at] = form.repair(rng, record) if rng.random() < 0.8 else record
    elif choice < 0.55:
        telling = [k for k, r in enumerate(records) if _tells(form, r)]
        if telling:
            k = rng.choice(telling)
            records[k] = form.define(rng, records[k])
    elif choice < 0.62:
        records[at] = form.repair(rng, records[at])
    elif choice < 0.72:
        _resize(rng, form, records, at)
    elif choice < 0.79:
        del records[at]
    elif choice < 0.86:
        records.insert(at, records[at])
    elif choice < 0.92:
        other = rng.randrange(len(records))
        records[at], records[other] = records[other], records[at]
    else:
        records.insert(at, rng.choice(form.split(rng.choice(seeds))))


@lru_cache(maxsize=4096)
def _tells(form: Format, record: bytes) -> bool:
    """Checks whether a record says something of other records; seeds share most of theirs."""
    return form.define(Random(1), record) != record


def _resize(rng: Random, form: Format, records: list[bytes], at: int) -> None:
    """A length that lies, or a record cut to that length, down to nothing, whose length is true."""
    record = records[at]
    if form.length is None or rng.random() < 0.4:
        kept = record[: rng.choice((len(record) // 2, len(record) - 1, sum(form.length or (1, 0))))]
        if form.length is not None:
            place, width = form.length
            body = max(len(kept) - place - width, 0)
            kept = kept[:place] + (body & (1 << 8 * width) - 1).to_bytes(width, "little") + kept[place + width :]
        records[at] = kept
        return
    place, width = form.length
    value = rng.choice((0, 1, len(record) - 1, len(record) + 1, 255, 65535, 2**31, 2**63 - 1, 2**64 - 1))
    lying = (value & (1 << 8 * width) - 1).to_bytes(width, "little")
    records[at] = record[:place] + lying + record[place + width :]
