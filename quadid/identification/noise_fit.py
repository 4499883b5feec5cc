"""Noise of a flight from what fits leave: its level and spectrum, from a flexible fit.

The flexible fit frees everything the catalogue can free at once, so that it leaves noise whatever the model of interest
lacks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.identification.gauss_newton import Polished, polish
from quadid.identification.initial_states import InitialStates
from quadid.identification.noise import SHAPE_POINTS, NoiseModel, estimate_noise
from quadid.identification.problem import Free, Shooting
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, IndexArray

# --- Spectrum of what a fit leaves: cosine modes of the whitened residual beside those of pure noise
#
# Rotor vibration folds to a hump somewhere between 0 Hz and the Nyquist frequency, so inertial noise is not white.  The
# spectrum is taken from the residual of the flexible fit above `LOWEST`; below it the level found just above is carried
# on, because what stands there is more likely dynamics than noise, and must stay visible.


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


# --- The noise floor: sensor noise from a deliberately flexible fit, whatever the model of interest lacks


SPECTRUM_SECONDS = 0.5
LINE_SECONDS = 1.0
"""Segments of this length separate a line of vibration, as in calm flight, from a hump; where the model follows."""
LINE_SEGMENTS = 100
"""Fewest of them: from fewer, so fine a spectrum would be known too poorly to weigh by."""
FLEXIBLE_DRAG = 0.1
"""Rotor drag [1/s] the flexible fit starts from: velocities and moments of drag show only where there is any."""
FAR_ITERATIONS = 10
"""Linearisations of the flexible fit where the nominal one is far off."""
GROWS = 3.0
"""Growth of a channel's residual variance, from short segments to longer ones, that no sensor noise shows …"""
STAYS = 1.2
"""… and up to which the longer ones are followed as well."""
SHORT_SEGMENTS = 400
"""Most short segments the flexible model is fitted to at first."""
FROM_START = 8
"""Linearisations spent on the longer segments when they begin anew."""
LONG_SEGMENTS = 300
"""Most longer segments it is fitted to afterwards: its parameters need no more."""
MOST_SEGMENTS = 4000
"""Most longer segments that the noise is measured on; they give it to a thousandth."""
_SETTLING = ("imu_lag.period", "rotor_drag.k_x")


def residual_noise(shooting: Shooting, polished: Polished, parameters: int | None = None) -> NoiseModel:
    """Noise from the residuals of a polish, all structure counted as noise (a starting point).

    Args:
        shooting: the problem.
        polished: its optimum.
        parameters: how many were fitted to these data; by default those of the polish.
    """
    lin = polished.lin
    used = lin.total_rows
    fitted = lin.gram.shape[1] if parameters is None else parameters
    freedom = max(used - fitted, 1.0) / max(used, 1.0)
    return estimate_noise(lin.residuals, lin.weights, shooting.dt, freedom)


def reweighted_fit(
    shooting: Shooting, theta: FloatArray, free: Free, iterations: int, robust: bool = False
) -> tuple[Shooting, Polished]:
    """Fits, measures the noise in what the fit leaves, and fits again: the problem with that noise, and the last fit.

    Args:
        shooting: the problem.
        theta: start, full vector.
        free: parameters to move.
        iterations: most linearisations of the second fit.
        robust: down-weight outliers in the second fit.
    """
    first = polish(shooting, theta, free, iterations=8)
    shooting = shooting.with_noise(residual_noise(shooting, first))
    return shooting, polish(shooting, first.theta, free, states=first.states, iterations=iterations, robust=robust)


def flexible_names(layout: Layout, shooting: Shooting) -> list[str]:
    """Everything the catalogue can free at once on these data: the model that leaves only noise."""
    kinds = ("always", "with_velocity") if shooting.has_velocity else ("always",)
    effects = [e for e in EFFECTS.values() if e.flexible in kinds]
    out = [*NOMINAL_NAMES, *(n for e in effects for n in e.flexible_entries)]
    losses = [n for n in layout.entries if n.startswith("weak_rotor.loss_")]
    return out + losses[1:]


class Flexible(NamedTuple):
    """The flexible fit: the noise that it leaves, and its optimum, a full vector."""

    noise: NoiseModel
    theta: FloatArray


def flexible_fit(
    windows: Sequence[Window],
    short: Shooting,
    starts: Sequence[FloatArray],
    free: Free,
    noise: NoiseModel | None = None,
    iterations: int = 4,
) -> Flexible:
    """Fits everything the catalogue can free at once.

    The flexible model is fitted on short segments, where it is nearly linear (of a long flight on some of them, spread
    evenly), and again on longer ones that resolve the spectrum of the vibration.

    Args:
        windows: data.
        short: short segments.
        starts: full vectors; the best outcome counts.
        free: nominal free parameters (kept free).
        noise: weights of the first fit; by default that of `short`.
        iterations: linearisations to spend on the short segments.
    """
    names = list(dict.fromkeys([*free.names, *flexible_names(short.layout, short)]))
    # The best of all starts on short segments, with some drag, without which velocities show in nothing.
    drag = short.free([n for n in ("rotor_drag.k_x", "rotor_drag.k_y") if n not in free.names]).index
    few = thinned(windows, short, short.seconds, noise or short.noise, SHORT_SEGMENTS)
    wide = few.free(names)
    tried = []
    for theta in starts:
        start = theta.copy()
        start[drag] = np.where(start[drag] == 0.0, FLEXIBLE_DRAG, start[drag])
        tried.append(polish(few, start, wide, iterations=iterations))
    first = min(tried, key=lambda p: p.cost)
    brief = residual_noise(few, first)
    longer = thinned(windows, short, SPECTRUM_SECONDS, brief, MOST_SEGMENTS)
    # In calm flight short segments may make flexible parameters diverge; then longer ones begin where they did.
    for theta, iterations in [(first.theta, 3), *((start, FROM_START) for start in starts)]:
        found = polish(longer.at_most(LONG_SEGMENTS), theta, wide, iterations=iterations)
        second = _settled(longer, found.theta, names)
        noise = residual_noise(longer, second, len(names))
        if np.any(noise.variance > GROWS * brief.variance):
            continue  # noise does not grow with the length of a segment; what does is the model losing its way
        # The spectrum shows best in the longest segments that the model follows as well.
        shown, states = longer.with_noise(noise), second.states
        longest = thinned(windows, longer, LINE_SECONDS, noise, MOST_SEGMENTS)
        if longest.count >= LINE_SEGMENTS:
            fitted = _settled(longest, second.theta, names)
            level = residual_noise(longest, fitted, len(names))
            if not np.any(level.variance > STAYS * noise.variance):
                shown, states = longest.with_noise(level), fitted.states
        return Flexible(shaped_noise(shown, second.theta, wide, states), second.theta)
    return Flexible(brief, first.theta)


def _settled(shooting: Shooting, theta: FloatArray, names: Sequence[str]) -> Polished:
    """Initial states of all segments at `theta`: all of them show the level of the noise.

    Two parameters move beside the initial states, so that segments are started and filters warmed up as for all.
    """
    return polish(shooting, theta, shooting.free([n for n in _SETTLING if n in names]), iterations=3)


def thinned(windows: Sequence[Window], like: Shooting, seconds: float, noise: NoiseModel, most: int) -> Shooting:
    """Segments of `seconds`, at most about `most` of them spread evenly; vehicle as in `like`."""
    return Shooting.cut(windows, like.vehicle, seconds, noise, like.layout).at_most(most)
