"""What goes into the reduction of a segment to its quadratic form, and what comes out: see `gram_kernel`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from quadid.model.simd import TILE_ROWS
from quadid.types import BoolArray, FloatArray

VELOCITY = 6
"""Place of the velocity among the directions of an initial state."""
NEGLIGIBLE = 1e-5
"""Entries of a whitener below this share of its largest are left out."""


class Whitening:
    """What weights and whitens the channels of a segment.

    Attributes:
        precision: 1 / sigma of each channel, for rows that are not whitened, shape (C,).
        coloured: True for channels to whiten, in segments that have all their samples, shape (C,).
        matrix: lower-triangular, rows padded with zeros to whole tiles, shape (C, padded length, length).
        reach: first column of each tile of rows that counts, shape (C, tiles).
    """

    def __init__(self, sigma: FloatArray, coloured: BoolArray, whitener: FloatArray) -> None:
        """Prepares standard deviations (C,) and a whitener (C, length, length)."""
        channels, length, _ = whitener.shape
        tiles = -(-length // TILE_ROWS)
        self.precision, self.coloured = 1.0 / sigma, coloured
        self.matrix = np.zeros((channels, tiles * TILE_ROWS, length))
        self.reach = np.zeros((channels, tiles), dtype=np.int64)
        for c, w in enumerate(whitener):
            matters = np.abs(w) > NEGLIGIBLE * np.max(np.abs(w))
            reach = np.argmax(matters, axis=1)
            self.matrix[c, :length] = np.where(np.arange(length) >= reach[:, None], np.tril(w), 0.0)
            self.reach[c] = [reach[i : i + TILE_ROWS].min() for i in range(0, length, TILE_ROWS)]


class StatePrior(NamedTuple):
    """What holds the initial states back.

    Attributes:
        ridge: precision of the step of each eliminated direction, shape (own,).
        velocity: precision of the initial velocity itself around a known one; 0 for none.
        away: how far the velocity is from there now, shape (segments, 3).
    """

    ridge: FloatArray
    velocity: float
    away: FloatArray

    def part(self, which: slice) -> StatePrior:
        """The prior of some segments."""
        return self._replace(away=self.away[which])


class Reduced(NamedTuple):
    """Quadratic form of every segment's cost in the parameters, see `quadid.identification.segment_cost.Linearised`.

    Attributes:
        gram: (segments, P, P); grad: (segments, P); cost: (segments,).
        occam: log-determinant of the eliminated velocity, (segments,); 0 without its prior.
        fitted: directions of the initial state that the data determine, (segments,).
        offset: step of the eliminated directions, (segments, own); slope: its change with parameters (…, P).
        base: residual, channel units, (segments, length, C).
        largest: largest product of two columns, (segments,); infinite when it is none.
    """

    gram: FloatArray
    grad: FloatArray
    cost: FloatArray
    occam: FloatArray
    fitted: FloatArray
    offset: FloatArray
    slope: FloatArray
    base: FloatArray
    largest: FloatArray

    @staticmethod
    def shapes(count: int, own: int, parameters: int, length: int, channels: int) -> tuple[tuple[int, ...], ...]:
        """Shapes of the fields, in order."""
        one, p = (count,), parameters
        ends = ((count, own), (count, own, p), (count, length, channels), one)
        return ((count, p, p), (count, p), one, one, one, *ends)

    @classmethod
    def room(cls, count: int, own: int, parameters: int, length: int, channels: int) -> Reduced:
        """Arrays to be written."""
        return cls(*(np.empty(shape) for shape in cls.shapes(count, own, parameters, length, channels)))

    def part(self, which: slice) -> Reduced:
        """Views of some segments."""
        return Reduced(*(a[which] for a in self))

    def run_away(self, prior: StatePrior) -> None:
        """Makes the cost infinite, which every search steps back from, and all else what no data leave."""
        for array in (self.gram, self.grad, self.fitted, self.offset, self.slope):
            array[...] = 0.0
        own, velocity = prior.ridge.copy(), slice(VELOCITY, VELOCITY + 3)
        if prior.velocity > 0.0:
            own[velocity] += prior.velocity
            self.offset[:, velocity] = prior.velocity * prior.away / own[velocity]
            self.occam[:] = np.sum(np.log(own[VELOCITY:])) - 3.0 * np.log(prior.velocity)
        self.cost[:] = np.inf
