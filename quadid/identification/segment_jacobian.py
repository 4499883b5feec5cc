"""The whitened residual of every segment with the directions in which initial state and parameters move it."""

from __future__ import annotations

from dataclasses import dataclass

from quadid.data.window import Window
from quadid.identification.noise_model import NoiseModel
from quadid.types import BoolArray, FloatArray, IntArray


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
        noise: what whitens.
    """

    window: Window
    rows: IntArray
    basis: FloatArray
    residual: FloatArray
    complete: BoolArray
    parameters: FloatArray
    base: FloatArray
    weights: FloatArray
    noise: NoiseModel

    @property
    def projected(self) -> FloatArray:
        """What `parameters` do that the initial state cannot undo, shape (segments, length, channels, P)."""
        flat = self.parameters - self.basis @ (self.basis.transpose(0, 2, 1) @ self.parameters)
        return flat.reshape(*self.weights.shape, -1)

    def whiten(self, rows: FloatArray, channel: int) -> FloatArray:
        """Weights and whitens changes of one channel, shape (segments, length, columns)."""
        return self.noise.channel_whitened(channel, rows, self.weights[:, :, channel], self.window.dt)
