"""Comparison of models on blocks of data that the fit did not see.

Segments are grouped into ten blocks of time.  For each block the parameters are those fitted to all other blocks (one
Gauss-Newton step from the common optimum, exact for the linearised problem), so a model is charged for every parameter
that only fits noise; the paired differences between two models, one a block, carry their own standard error whatever
the correlation inside a block.

A block that moves the vehicle as no other does is an extrapolation of parameters that the others hardly determine.  Its
error is no evidence on the model, so each block is scored by its predictive density, in which that uncertainty has its
share (Geisser and Eddy, J. Am. Stat. Assoc. 74 (1979) 153).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from scipy.special import stdtrit

from quadid.identification.score import INFINITE
from quadid.identification.segment_cost import Linearised
from quadid.types import FloatArray, IndexArray

BLOCKS = 10
"""With so many the error of a gain is known to a quarter, and each is many times the memory of the noise."""


def block_labels(lin: Linearised) -> IndexArray:
    """Block number of each segment, shape (segments,): stretches of a tenth of all data, none over two flights."""
    length = max(lin.spacing * len(lin.time) / BLOCKS, 2.0 * lin.spacing)
    _, first, window = np.unique(lin.window, return_index=True, return_inverse=True)
    number = np.floor((lin.time - lin.time[first][window] + 1e-9) / length)
    return np.unique(np.stack([window, number]), axis=1, return_inverse=True)[1].reshape(-1)


class HeldOut(NamedTuple):
    """Deviances with the parameters of all blocks but one, for each in turn, shapes (blocks,).

    Attributes:
        block: of the block itself, in the density that the other blocks predict.
        rest: of the other blocks, at their own optimum.
    """

    block: FloatArray
    rest: FloatArray


@INFINITE
def held_out(lin: Linearised, prior_precision: FloatArray) -> HeldOut:
    """Deviance of each block in the density that the other blocks predict, and of those.

    Twice the negative logarithm of N(r; r(z), I + B V B'), with z and V mean and covariance of the parameters from the
    other blocks and B the derivative of the block's residuals r; less that of the noise alone, N(0; 0, I).
    """
    labels = block_labels(lin)
    gram, grad, cost = (sum_by_block(a, labels) for a in (lin.gram, lin.grad, lin.cost + lin.occam))
    z = steps_without(gram, grad, prior_precision)
    moved = np.einsum("bpq,bq->bp", gram, z)
    slope, rest = grad + moved, _rest(gram, prior_precision)
    shared = np.einsum("bp,bp->b", slope, np.linalg.solve(rest + gram, slope[..., None])[..., 0])
    spread = np.linalg.slogdet(rest + gram)[1] - np.linalg.slogdet(rest)[1]
    return HeldOut(
        cost + np.sum((grad + slope) * z, axis=1) - shared + spread,
        cost.sum() - cost + np.sum((grad.sum(axis=0) - grad) * z, axis=1),
    )


def steps_without(gram: FloatArray, grad: FloatArray, prior_precision: FloatArray) -> FloatArray:
    """Scaled step to the optimum of all blocks but one, for each in turn, shape (blocks, P).

    Args:
        gram: of each block, shape (blocks, P, P).
        grad: half the slope of the deviance of each block, shape (blocks, P).
        prior_precision: of each parameter, shape (P,).
    """
    g_rest = grad.sum(axis=0) - grad
    return np.asarray(-np.linalg.solve(_rest(gram, prior_precision), g_rest[..., None])[..., 0])


def _rest(gram: FloatArray, prior_precision: FloatArray) -> FloatArray:
    """Information of all blocks but one and of the prior, for each in turn, shape (blocks, P, P)."""
    return np.asarray(gram.sum(axis=0) - gram + np.diag(np.maximum(prior_precision, 1e-12)))


def sum_by_block(values: FloatArray, labels: IndexArray) -> FloatArray:
    """Sums of `values` (segments, ...) over the segments of each block, shape (blocks, ...)."""
    order = np.argsort(labels, kind="stable")
    first = np.flatnonzero(np.diff(labels[order], prepend=-1))
    out = np.zeros((int(labels.max()) + 1, *values.shape[1:]))
    out[labels[order][first]] = np.add.reduceat(values[order], first, axis=0)
    return out


@dataclass(frozen=True)
class Gain:
    """What one model gains over another on data not fitted.

    Attributes:
        total: summed reduction of the deviance; error: its standard error.
        blocks: reduction of each block.
    """

    total: float
    error: float
    blocks: FloatArray

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval of the total."""
        half = float(stdtrit(max(len(self.blocks) - 1, 1), 0.975)) * self.error
        return self.total - half, self.total + half


@INFINITE
def paired_gain(before: FloatArray, after: FloatArray) -> Gain:
    """Gain of `after` over `before`, both block deviances of the same blocks."""
    difference = before - after
    n = len(difference)
    error = float(np.sqrt(n) * np.std(difference, ddof=1)) if n > 1 else float("inf")
    return Gain(float(difference.sum()), error, difference)
