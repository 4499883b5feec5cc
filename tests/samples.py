"""Single measurements by name, for tests that drop, move and change them; the product takes blocks."""

from collections.abc import Iterable
from typing import NamedTuple

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


def flat(blocks: Iterable[Block]) -> list[Sample]:
    """Samples of blocks, message by message, within a message in the order of its channels."""
    return [
        Sample(t, name, tuple(values[k].tolist()))
        for block in blocks
        for k, t in enumerate(block.t.tolist())
        for name, values in block.columns
    ]
