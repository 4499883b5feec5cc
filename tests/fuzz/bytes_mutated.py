"""Mutations of bytes that know nothing of a format: flips, cuts, splices, interesting integers."""

from collections.abc import Callable, Sequence
from random import Random

INTERESTING = (0, 1, 2, 0x7F, 0x80, 0xFF, 0x7FFF, 0x8000, 0xFFFF, 0x7FFFFFFF, 0x80000000, 0xFFFFFFFF, 2**63 - 1, 2**63)
"""Integers at which arithmetic, signs and sizes tip over."""
LARGEST = 1 << 16
"""Mutated inputs stay below this size [bytes]: a fuzzer that grows its inputs only grows slow."""


def flip_bit(rng: Random, data: bytearray) -> None:
    """Turns one bit."""
    data[rng.randrange(len(data))] ^= 1 << rng.randrange(8)


def set_byte(rng: Random, data: bytearray) -> None:
    """Sets one byte to anything."""
    data[rng.randrange(len(data))] = rng.randrange(256)


def set_integer(rng: Random, data: bytearray) -> None:
    """Writes an interesting integer of 2, 4 or 8 bytes in either order somewhere."""
    width = rng.choice((2, 4, 8))
    at = rng.randrange(len(data))
    value = rng.choice(INTERESTING) & (1 << 8 * width) - 1
    part = value.to_bytes(width, rng.choice(("little", "big")))[: len(data) - at]
    data[at : at + len(part)] = part


def set_number(rng: Random, data: bytearray) -> None:
    """Writes NaN, an infinity or a huge number as float or double somewhere."""
    patterns = (b"\x00\x00\xc0\x7f", b"\x00\x00\x80\x7f", b"\x00\x00\x80\xff", b"\xff\xff\x7f\x7f")
    doubles = (b"\x00" * 6 + b"\xf8\x7f", b"\x00" * 6 + b"\xf0\x7f", b"\xff" * 6 + b"\xef\x7f", b"\x01" + b"\x00" * 7)
    part = rng.choice(patterns + doubles)
    at = rng.randrange(len(data))
    part = part[: len(data) - at]
    data[at : at + len(part)] = part


def delete(rng: Random, data: bytearray) -> None:
    """Takes a stretch out."""
    at = rng.randrange(len(data))
    del data[at : at + rng.choice((1, 2, 4, 8, rng.randrange(1, len(data) + 1)))]


def insert(rng: Random, data: bytearray) -> None:
    """Puts noise, zeros or 0xFF in."""
    at, length = rng.randrange(len(data) + 1), rng.choice((1, 2, 4, 8, 64))
    data[at:at] = rng.choice((rng.randbytes(length), bytes(length), b"\xff" * length))


def repeat(rng: Random, data: bytearray) -> None:
    """Puts a copy of a stretch behind itself."""
    at = rng.randrange(len(data))
    length = rng.randrange(1, min(len(data) - at, 256) + 1)
    data[at:at] = data[at : at + length]


def move(rng: Random, data: bytearray) -> None:
    """Overwrites a stretch by another of the same input."""
    length = rng.randrange(1, min(len(data), 64) + 1)
    a, b = rng.randrange(len(data) - length + 1), rng.randrange(len(data) - length + 1)
    data[a : a + length] = data[b : b + length]


MUTATIONS: Sequence[Callable[[Random, bytearray], None]] = (
    flip_bit,
    flip_bit,
    set_byte,
    set_byte,
    set_integer,
    set_integer,
    set_number,
    delete,
    insert,
    repeat,
    move,
)


def mutate_bytes(rng: Random, data: bytes, times: int = 1) -> bytes:
    """Returns `data` after some mutations."""
    out = bytearray(data)
    for _ in range(times):
        if out:
            rng.choice(MUTATIONS)(rng, out)
    return bytes(out[:LARGEST])


def cut(rng: Random, data: bytes) -> bytes:
    """Returns a beginning of `data`."""
    return data[: rng.randrange(1, len(data) + 1)]
