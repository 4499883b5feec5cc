"""The fit to fast motion alone, for vehicles that turn by moments which no model of theirs has.

Inertias and drag torque are read from the rates, the thrust coefficient from the specific force along the rotors' axis;
everything else that is measured only gives the start of segments, because it repeats, smoothed and late, what random
moments did to the rates.  How late rotors and gyro are is fitted along: in fast motion that passes for inertia.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.identification.gauss_newton import Convergence, Polished, polish
from quadid.identification.noise_estimation import SPECTRUM_SECONDS
from quadid.identification.noise_model import NoiseModel
from quadid.identification.parameterization import Free
from quadid.identification.priors import Prior, default_prior
from quadid.identification.process_noise import AXES, LEAST_WHITE, likeliest
from quadid.identification.segment_cost import Linearised
from quadid.identification.shooting import Shooting
from quadid.identification.torque_coherence import undecided
from quadid.parameters import INERTIAS
from quadid.types import FloatArray

THRUST_AXIS = 8
"""Residual channel of the specific force along z."""
LATE_START = 0.005
"""Where lags and delays begin in the fit [s]."""
MOST_SEGMENTS = 1000
"""Most segments of this fit and of a first one; the parameters need no more."""
ROUNDS = 15
"""Most estimates of the random moments, each followed by a fit."""
USUAL = 1.0
"""Prior standard deviation of what is late, in typical sizes."""
SETTLED = 0.01
"""Step of the parameters (log scale) below which another round changes nothing."""


@dataclass(frozen=True)
class FastMotion:
    """A fit to fast motion.

    Attributes:
        shooting: the problem, with its random moments; found: the optimum; free: nominal parameters and what is late.
        prior: on these.
        short: the same in segments as short as those of the first fit, whose motion is quicker still.
        prompt: scaled step of the parameters to where they are with nothing late, shape (P,).
        undecided: share of scaled parameters that stays open where torque and motion have low coherence, shape (P,).
        simulated: parameter vectors simulated for all of it.
    """

    shooting: Shooting
    found: Polished
    free: Free
    prior: Prior
    short: Polished
    prompt: FloatArray
    undecided: FloatArray
    simulated: int


def fast_motion(
    windows: Sequence[Window], short: Shooting, theta: FloatArray, names: Sequence[str]
) -> FastMotion | None:
    """Fits `names` and what is late to fast motion, and estimates the random moments with them.

    Args:
        windows: data.
        short: short segments, whose noise weighs the specific force.
        theta: where to start, full vector.
        names: parameters to fit.

    Returns:
        None where the simulation diverges, or no segment fits.
    """
    used = [*AXES, THRUST_AXIS]
    rest = [c for c in range(short.channels) if c not in used]
    shooting = Shooting.cut(windows, short.vehicle, SPECTRUM_SECONDS, short.noise, short.layout).leaving_out(rest)
    shooting = shooting.at_most(MOST_SEGMENTS)
    if not shooting.count:
        return None
    late = [n for n in _late(windows[0]) if n.split(".")[0] not in short.vehicle.effects and n not in names]
    free = shooting.free([*names, *late])
    prior = default_prior(shooting, free)
    prior = Prior(prior.mean, np.where(np.isin(free.names, late), USUAL, prior.sigma))
    theta = theta.copy()
    theta[shooting.free(late).index] = LATE_START
    lin, spent = shooting.linearise(theta, free), 1
    for _ in range(ROUNDS):
        shooting = shooting.with_noise(with_moments(shooting, lin))
        found = polish(shooting, theta, free, prior, states=lin.states, iterations=8)
        moved = free.step(theta, found.theta)
        theta, lin, spent = found.theta, found.lin, spent + found.iterations
        if found.outcome is Convergence.CONVERGED and np.max(np.abs(moved)) < SETTLED:
            break
    if not np.isfinite(found.cost):
        return None
    brief = short.with_noise(shooting.noise).leaving_out(rest)
    quicker = polish(brief, theta, free, prior, iterations=8)
    own = shooting.free(names)
    neutral = theta.copy()
    neutral[shooting.free(late).index] = 0.0
    prompt = polish(shooting, neutral, own, states=found.states, iterations=8)
    step = np.where(np.isin(free.names, names), free.step(theta, prompt.theta), 0.0)
    open_by = dict(zip(INERTIAS[:2], undecided(windows, short.vehicle, shooting.noise.white[:2]), strict=True))
    unsure = np.array([open_by.get(n, 0.0) for n in free.names])
    simulated = (spent + quicker.iterations) * (len(free.entries) + 10) + prompt.iterations * (len(own.entries) + 10)
    return FastMotion(shooting, found, free, prior, quicker, step, unsure, simulated)


def _late(window: Window) -> list[str]:
    """What may be late between the rotor columns and the rates."""
    columns = "readings" if window.sampling == "instant" else "commands"
    effects = [e for e in EFFECTS.values() if e.family == "late" and e.turns and {columns}.issuperset(e.needs)]
    return [name for e in effects for name in e.entries]


def with_moments(shooting: Shooting, lin: Linearised) -> NoiseModel:
    """The noise of a problem with the likeliest white noise and random moments of the rates."""
    noise = shooting.noise
    white, moments = np.maximum(noise.white, LEAST_WHITE), np.array(noise.moments or (0.0, 0.0, 0.0))
    for c in AXES:
        complete = np.all(lin.weights[:, :, c] > 0.0, axis=1)
        if complete.any():
            white[c], moments[c] = likeliest(lin.residuals[complete, :, c], shooting.dt)
    x, y, z = moments.tolist()
    return replace(noise, white=white, moments=(x, y, z), shape=None)
