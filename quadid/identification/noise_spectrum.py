"""Spectrum of what a fit leaves: cosine modes of the whitened residual beside those of pure noise.

Rotor vibration folds to a hump somewhere between 0 Hz and the Nyquist frequency, so inertial noise is not white.  The
spectrum is taken from the residual of the flexible fit above `LOWEST`; below it the level found just above is carried
on, because what stands there is more likely dynamics than noise, and must stay visible.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache

import numpy as np

from quadid.identification.initial_states import InitialStates
from quadid.identification.noise_model import SHAPE_POINTS, NoiseModel
from quadid.identification.parameterization import Free
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray, IndexArray

LOWEST = 3.0
"""Frequency [Hz] below which residual power is not counted as noise."""
BAND = 1.5
"""Width [Hz] above `LOWEST` whose level is carried on below it."""
DRAWS = 4
SMOOTH = 3
LEAST_SEGMENTS = 20
LEAST_LEFT = 0.3
"""Share of its power that the elimination must leave a mode of noise for it to count."""


def mode_power(
    shooting: Shooting, theta: FloatArray, free: Free, rng: np.random.Generator, states: InitialStates
) -> tuple[FloatArray, FloatArray, IndexArray]:
    """Mean power of each mode (channels, length) of the residual, and of noise through the same elimination.

    Args:
        shooting: problem.
        theta: full parameter vector.
        free: free parameters of the model (decide what is eliminated).
        rng: for the drawn noise.
        states: initial states at their optimum.

    Returns:
        Power found, power of unit white noise, and the number of segments, per channel; NaN where none is complete.
    """
    found, null = np.zeros((2, shooting.channels, shooting.length))
    counts = np.zeros(shooting.channels, dtype=np.intp)
    for c in shooting.columns(theta, free, states, parameters=False):
        found += np.einsum("scm,sc->cm", _powers(c.residual, c.basis), c.complete)
        for _ in range(DRAWS):
            powers = _powers(rng.standard_normal(c.residual.shape), c.basis)
            null += np.einsum("scm,sc->cm", powers, c.complete) / DRAWS
        counts += c.complete.sum(axis=0)
    with np.errstate(invalid="ignore", divide="ignore"):
        return found / counts[:, None], null / counts[:, None], counts


def _powers(residual: FloatArray, basis: FloatArray) -> FloatArray:
    """Squared cosine modes of the residual less its part in `basis`: (segments, channels, length)."""
    count, length, channels = residual.shape
    flat = residual.reshape(count, -1)
    inside = np.matmul(basis.transpose(0, 2, 1), flat[..., None])
    flat = flat - np.matmul(basis, inside)[..., 0]
    modes = np.matmul(_cosines(length), flat.reshape(count, length, channels))
    return np.asarray((modes**2).transpose(0, 2, 1))


@lru_cache(maxsize=8)
def _cosines(length: int) -> FloatArray:
    """Orthonormal cosine modes as rows (DCT-II), shape (length, length)."""
    modes = np.cos(np.pi / length * np.outer(np.arange(length), np.arange(length) + 0.5))
    modes *= np.sqrt(2.0 / length)
    modes[0] *= np.sqrt(0.5)
    return np.asarray(modes)


def shaped_noise(shooting: Shooting, theta: FloatArray, free: Free, states: InitialStates) -> NoiseModel:
    """Noise model of `shooting` with the spectrum of its inertial channels, from the residual at `theta` and `states`.

    `shooting.noise` must be white in those channels.  Attitude keeps its slow part; channels with few segments stay
    white.
    """
    noise = shooting.noise
    found, null, counts = mode_power(shooting, theta, free, np.random.default_rng(0), states)
    channels, length = found.shape
    frequency = 0.5 * np.arange(length) / (length * shooting.dt)
    grid = np.linspace(0.0, 0.5 / shooting.dt, SHAPE_POINTS)
    shape, white = np.ones((channels, SHAPE_POINTS)), noise.white.copy()
    for c in range(channels):
        if 3 <= c < 6 or counts[c] < LEAST_SEGMENTS or not np.isfinite(found[c]).all():
            continue
        level, modes = band_power(found[c], null[c], SMOOTH)
        known = np.flatnonzero(modes > 0.0)
        level = np.interp(np.arange(length), known, level[known])
        band = (frequency >= LOWEST) & (frequency < LOWEST + BAND)
        level = np.where(frequency < LOWEST, np.mean(level[band]), level)
        level = np.maximum(level, 1e-3 * np.max(level))
        mean = float(np.mean(level))
        white[c] *= np.sqrt(mean)
        shape[c] = np.interp(grid, frequency, level / mean)
    return replace(noise, white=white, shape=shape)


def band_power(found: FloatArray, null: FloatArray, width: int) -> tuple[FloatArray, FloatArray]:
    """Power over `width` modes around each relative to that of noise, and how many of them count.

    Modes that the initial state takes away do not count.

    Args:
        found: power of each mode, shape (length,).
        null: what noise leaves there, likewise.
        width: odd number of modes.
    """
    kernel, usable = np.ones(width), null > LEAST_LEFT
    power, noise, modes = (np.convolve(usable * a, kernel, mode="same") for a in (found, null, np.ones_like(null)))
    return np.asarray(power / np.maximum(noise, 1e-9)), np.asarray(modes)
