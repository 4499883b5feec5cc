"""Of several topics that tell one channel, uses the best that arrives, from the first sample on."""

from __future__ import annotations

from collections.abc import Iterator

from quadid.window import Sample

DECIDE = 1.0
"""Time of the data [s] in which a better source may still show up before a worse one is used."""
SILENT = 3.0
"""A chosen source that is silent for this long [s] gives way to the next."""
MOST_HELD = 5000


class Chooser:
    """Picks one source for each channel.

    Samples of a source that is not the best possible are held back until it is certain that no better one comes, so
    that a channel never mixes two sources.
    """

    def __init__(self, best: dict[str, int]) -> None:
        """Knows the best (lowest) rank that each channel could have."""
        self._best = best
        self._chosen: dict[str, int] = {}
        self._last: dict[str, float] = {}
        self._held: dict[str, dict[int, list[Sample]]] = {}

    def take(self, sample: Sample, rank: int) -> Iterator[Sample]:
        """Yields what may be used now.

        Args:
            sample: a sample.
            rank: of its source for this channel; 0 is the best.
        """
        channel = sample.channel
        chosen = self._chosen.get(channel)
        if chosen is not None and rank > chosen and sample.t > self._last[channel] + SILENT:
            chosen = None  # the chosen one fell silent
        if chosen is None and rank == self._best.get(channel, 0):
            chosen = rank
            self._held.pop(channel, None)
        elif chosen is not None and rank < chosen:
            chosen = rank  # a better one has come
        if chosen is not None:
            self._chosen[channel] = chosen
            if rank == chosen:
                self._last[channel] = sample.t
                yield sample
            return
        yield from self._hold(sample, rank)

    def has(self, channel: str) -> bool:
        """Whether some source tells the channel."""
        return channel in self._chosen or channel in self._held

    def settled(self, channel: str, rank: int, newest: float) -> bool | None:
        """Whether all samples of a source up to time `newest` [s] may be used; None: to be decided one by one."""
        chosen = self._chosen.get(channel)
        if chosen is None or rank < chosen or (rank > chosen and newest > self._last[channel] + SILENT):
            return None
        return rank == chosen

    def used(self, channel: str, t: float) -> None:
        """Notes that samples up to one at `t` [s] were used, as `settled` allowed."""
        self._last[channel] = t

    def _hold(self, sample: Sample, rank: int) -> Iterator[Sample]:
        by_rank = self._held.setdefault(sample.channel, {})
        held = by_rank.setdefault(rank, [])
        held.append(sample)
        first = min(samples[0].t for samples in by_rank.values())
        if sample.t - first < DECIDE and len(held) < MOST_HELD:
            return
        best = min(by_rank)
        self._chosen[sample.channel] = best
        samples = self._held.pop(sample.channel)[best]
        self._last[sample.channel] = samples[-1].t
        yield from samples
