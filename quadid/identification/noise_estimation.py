"""The noise floor: sensor noise from a deliberately flexible fit, whatever the model of interest lacks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.identification.gauss_newton import Polished, polish
from quadid.identification.initial_states import InitialStates
from quadid.identification.noise_model import ATTITUDE, SLOW_TIME, NoiseModel, estimate_noise
from quadid.identification.noise_spectrum import shaped_noise
from quadid.identification.parameterization import Free
from quadid.identification.shooting import Shooting
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray

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


def residual_noise(
    shooting: Shooting, polished: Polished, parameters: int | None = None, slow_time: float = SLOW_TIME
) -> NoiseModel:
    """Noise from the residuals of a polish, all structure counted as noise (a starting point).

    Args:
        shooting: the problem.
        polished: its optimum.
        parameters: how many were fitted to these data; by default those of the polish.
        slow_time: correlation time of the attitude's slow part [s].
    """
    lin = polished.lin
    used = lin.total_rows
    fitted = lin.gram.shape[1] if parameters is None else parameters
    freedom = max(used - fitted, 1.0) / max(used, 1.0)
    return estimate_noise(lin.residuals, lin.weights, shooting.dt, freedom, slow_time)


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
    """Everything the catalogue can free at once on these data: the model that leaves only noise.

    With attitude left out the scale of the gyro and an inertia are one number; then it is not among them.
    """
    kinds = ("always", "with_velocity") if shooting.has_velocity else ("always",)
    effects = [e for e in EFFECTS.values() if e.flexible in kinds]
    if set(ATTITUDE) <= set(shooting.left_out):
        effects.remove(EFFECTS["gyro_scale"])
    out = [*NOMINAL_NAMES, *(n for e in effects for n in e.flexible_entries)]
    losses = [n for n in layout.entries if n.startswith("weak_rotor.loss_")]
    return out + losses[1:]


@dataclass(frozen=True)
class Flexible:
    """The flexible fit: the noise that it leaves, and its optimum, a full vector."""

    noise: NoiseModel
    theta: FloatArray


def flexible_fit(
    windows: Sequence[Window], short: Shooting, starts: Sequence[FloatArray], free: Free,
    noise: NoiseModel | None = None, iterations: int = 4,
) -> Flexible:  # fmt: skip
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
    # In calm flight short segments may lead flexible parameters far astray; then longer ones begin where they did.
    for theta, iterations in [(first.theta, 3), *((start, FROM_START) for start in starts)]:
        found = polish(longer.at_most(LONG_SEGMENTS), theta, wide, iterations=iterations)
        second = _settled(longer, found.theta, names)
        noise = residual_noise(longer, second, len(names))
        # Noise does not grow with the length of a segment; what does is the model losing its way.
        if not np.any(noise.variance > GROWS * brief.variance):
            longest, states = _longest(windows, longer.with_noise(noise), second, names)
            return Flexible(shaped_noise(longest, second.theta, wide, states), second.theta)
    return Flexible(brief, first.theta)


def _settled(shooting: Shooting, theta: FloatArray, names: Sequence[str]) -> Polished:
    """Initial states of all segments at `theta`: all of them show the level of the noise.

    Two parameters move beside the initial states, so that segments are started and filters warmed up as for all.
    """
    return polish(shooting, theta, shooting.free([n for n in _SETTLING if n in names]), iterations=3)


def _longest(
    windows: Sequence[Window], longer: Shooting, second: Polished, names: Sequence[str]
) -> tuple[Shooting, InitialStates]:
    """The longest segments that the model of `second` follows as well as `longer`, and states there."""
    out = thinned(windows, longer, LINE_SECONDS, longer.noise, MOST_SEGMENTS)
    if out.count < LINE_SEGMENTS:
        return longer, second.states
    fitted = _settled(out, second.theta, names)
    noise = residual_noise(out, fitted, len(names))
    if np.any(noise.variance > STAYS * longer.noise.variance):
        return longer, second.states
    return out.with_noise(noise), fitted.states


def thinned(windows: Sequence[Window], like: Shooting, seconds: float, noise: NoiseModel, most: int) -> Shooting:
    """Segments of `seconds`, at most about `most` of them spread evenly; vehicle as in `like`."""
    return Shooting.cut(windows, like.vehicle, seconds, noise, like.layout).at_most(most)
