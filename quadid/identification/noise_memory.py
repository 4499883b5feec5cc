"""How long the slow part of attitude noise is remembered, from residuals of segments that are longer than that.

In a segment of a second a slow error is hardly more than a line, which the initial state takes out; in one of four it
bends, and the likelihood of its memory has a peak.  Each memory is given the variances that are likeliest.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache

import numpy as np

from quadid.data.window import Window
from quadid.identification.gauss_newton import polish
from quadid.identification.noise_estimation import LINE_SECONDS, STAYS, residual_noise, thinned
from quadid.identification.noise_model import ATTITUDE, TREND, NoiseModel, correlation
from quadid.identification.process_noise import modes_beside_trend
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray

MEMORY_SECONDS = 4.0
"""Segments of this length show the memory …"""
MEMORY_SEGMENTS = 40
"""… and about so many of them give it precisely enough."""
ITERATIONS = 3
"""Linearisations from the optimum on segments of another length."""

MEMORIES = np.geomspace(0.15, 10.0, 13)
"""Correlation times that are compared [s]."""
FEWEST_SEGMENTS = 10
"""Complete segments of a channel below which its likelihood is not evaluated."""
ROUNDS = 6
"""Of the search for two variances."""
FINEST_ROWS = 100
"""Rows of a segment beyond which neighbours are averaged: they do not show a memory."""


def with_memory(windows: Sequence[Window], problem: Shooting, theta: FloatArray, names: Sequence[str]) -> NoiseModel:
    """Noise of a problem with the memory of the attitude noise.

    A model that loses its way leaves more the longer it runs, and noise does not: where segments of `MEMORY_SECONDS`
    leave more than short ones, the noise stays as it is.

    Args:
        windows: data.
        problem: layout, vehicle and noise.
        theta: optimum of the model, full vector.
        names: its free parameters.
    """
    noise, free = problem.noise, problem.free(names)
    near = thinned(windows, problem, LINE_SECONDS, noise, round(MEMORY_SEGMENTS * MEMORY_SECONDS / LINE_SECONDS))
    far = thinned(windows, problem, MEMORY_SECONDS, noise, MEMORY_SEGMENTS)
    if not far.count:
        return noise
    brief, long = (polish(s, theta, free, iterations=ITERATIONS) for s in (near, far))
    memory = attitude_memory(long.lin.residuals, long.lin.weights, far.dt) if np.isfinite(long.cost) else None
    if memory is None:
        return noise
    found, drifted = (residual_noise(*both, slow_time=memory) for both in ((near, brief), (far, long)))
    if np.any((drifted.variance / found.variance).reshape(-1, 3).mean(axis=1) > STAYS):
        return noise
    white, slow = noise.white.copy(), noise.slow.copy()
    white[list(ATTITUDE)], slow[list(ATTITUDE)] = found.white[list(ATTITUDE)], found.slow[list(ATTITUDE)]
    return replace(noise, white=white, slow=slow, slow_time=memory)


def attitude_memory(residuals: FloatArray, weights: FloatArray, dt: float) -> float | None:
    """Correlation time [s] of the attitude noise that makes `residuals` most likely, one for all three axes.

    Args:
        residuals: of all channels, shape (segments, length, channels).
        weights: 0 for samples to leave out, same shape.
        dt: grid step [s].

    Returns:
        None where too few segments are complete, or nothing is left in them.
    """
    share = max(residuals.shape[1] // FINEST_ROWS, 1)
    rows = residuals.shape[1] // share
    log_likelihood = np.zeros(len(MEMORIES))
    for c in ATTITUDE:
        complete = np.all(weights[:, :, c] > 0.0, axis=1)
        if np.count_nonzero(complete) < FEWEST_SEGMENTS:
            continue
        blocks = residuals[complete, : rows * share, c].reshape(-1, rows, share).mean(axis=2)
        if np.any(blocks):
            log_likelihood += [_log_likelihood(blocks, share * dt / memory) for memory in MEMORIES]
    best = int(np.argmax(log_likelihood))
    if np.ptp(log_likelihood) == 0.0:
        return None
    if best in (0, len(MEMORIES) - 1):
        return float(MEMORIES[best])
    left, middle, right = log_likelihood[best - 1 : best + 2]
    peak = 0.5 * (left - right) / (left - 2.0 * middle + right)
    return float(MEMORIES[best] * (MEMORIES[1] / MEMORIES[0]) ** peak)


def _log_likelihood(residuals: FloatArray, step: float) -> float:
    """Of one channel (segments, length) less its trend, at the variances that are likeliest with this memory."""
    modes, slow = _modes(residuals.shape[1], round(step, 9))
    power = np.mean((residuals @ modes) ** 2, axis=0)
    level = np.full(len(power), max(float(np.mean(power)), np.finfo(float).tiny))
    both = np.column_stack([np.ones(len(slow)), slow])
    for _ in range(ROUNDS):
        # Fisher scoring of two variances: powers have standard deviations as large as their levels.
        scaled = both / level[:, None]
        variances = np.linalg.lstsq(scaled, power / level, rcond=None)[0]
        if np.min(variances) <= 0.0:
            variances = np.array([float(np.mean(power)), 0.0])
        level = np.maximum(both @ variances, np.finfo(float).tiny)
    return float(-0.5 * len(residuals) * np.sum(np.log(level) + power / level))


@lru_cache(maxsize=64)
def _modes(length: int, step: float) -> tuple[FloatArray, FloatArray]:
    """Independent modes of slow noise beside its trend, as columns (length, modes), and their variances."""
    return modes_beside_trend(correlation(length, step), TREND[1])
