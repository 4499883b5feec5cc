"""Single measurements by name, for tests that drop, move and change them; the product takes blocks."""

from collections.abc import Iterable, Iterator
from itertools import islice
from typing import NamedTuple

import numpy as np

from quadid.data.window import Block


class Sample(NamedTuple):
    """One row of one channel: time [s], channel, values in the channel's unit."""

    t: float
    channel: str
    values: tuple[float, ...]

    @property
    def block(self) -> Block:
        """The sample as a block."""
        return Block.one(*self)


def gathered(blocks: Iterable[Block], most: int = 40) -> Iterator[Block]:
    """A stream as a logger would hand it over: of every `most` blocks those of one kind together, in their order."""
    left = iter(blocks)
    while portion := list(islice(left, most)):
        kinds: dict[tuple[tuple[str, int], ...], list[Block]] = {}
        for block in portion:
            kinds.setdefault(tuple((name, values.shape[1]) for name, values in block.columns), []).append(block)
        for kind, part in kinds.items():
            columns = tuple((name, np.concatenate([b.columns[i][1] for b in part])) for i, (name, _) in enumerate(kind))
            yield Block(np.concatenate([b.t for b in part]), columns)


def flat(blocks: Iterable[Block]) -> list[Sample]:
    """Samples of blocks, message by message, within a message in the order of its channels."""
    return [
        Sample(t, name, tuple(values[k].tolist()))
        for block in blocks
        for k, t in enumerate(block.t.tolist())
        for name, values in block.columns
    ]
