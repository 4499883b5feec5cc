"""The whitened residual of every segment with the directions in which initial state and parameters move it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from quadid.types import BoolArray, FloatArray, IntArray
from quadid.window import Window


@dataclass(frozen=True)
class Columns:
    """One window, cut into segments.

    Attributes:
        window: its data.
        rows: row of the window of each sample, shape (segments, length).
        basis: orthonormal whitened directions of the initial state, shape (segments, length * channels, k); channel c
            of sample i at row i * channels + c.
        residual: whitened, shape (segments, length, channels).
        complete: channels of a segment that were measured throughout, shape (segments, channels).
        parameters: whitened directions of the free parameters, shape (segments, length * channels, P).
        base: residual predicted - measured in channel units, shape (segments, length, channels).
        weights: 1 where measured, 0 elsewhere, same shape.
        sigma: standard deviation of each channel, shape (channels,).
        coloured: channels to whiten, shape (channels,).
        whitener: shape (channels, length, length).
    """

    window: Window
    rows: IntArray
    basis: FloatArray
    residual: FloatArray
    complete: BoolArray
    parameters: FloatArray
    base: FloatArray
    weights: FloatArray
    sigma: FloatArray
    coloured: BoolArray
    whitener: FloatArray

    @property
    def projected(self) -> FloatArray:
        """What `parameters` do that the initial state cannot undo, shape (segments, length, channels, P)."""
        flat = self.parameters - self.basis @ (self.basis.transpose(0, 2, 1) @ self.parameters)
        return flat.reshape(*self.weights.shape, -1)

    def whiten(self, rows: FloatArray, channel: int) -> FloatArray:
        """Weights and whitens changes of one channel, shape (segments, length, columns)."""
        weight = self.weights[:, :, channel, None]
        if not self.coloured[channel]:
            return np.asarray(rows * weight / self.sigma[channel])
        full = self.complete[:, channel, None, None]
        scaled = rows * weight
        return np.asarray(np.where(full, np.matmul(self.whitener[channel], scaled), scaled / self.sigma[channel]))
