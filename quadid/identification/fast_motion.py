"""The fit to fast motion alone, for vehicles disturbed by moments that the model lacks.

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
from quadid.identification.noise import AXES, LEAST_WHITE, NoiseModel, likeliest
from quadid.identification.noise_fit import SPECTRUM_SECONDS
from quadid.identification.problem import Free, Linearised, Prior, Shooting, default_prior
from quadid.parameters import INERTIAS
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- How much of quick turning the rotors make: what that leaves undecided of roll and pitch inertia
#
# Inertia is torque over angular acceleration.  Where the two are not coherent, one of them holds what the other
# lacks: an error of rotor speeds makes the inertia too large, one of the motion too small, by up to the coherence (the
# estimators H1 and H2 of a frequency response; J. S. Bendat and A. G. Piersol, Random Data, 4th ed. (2010), ch. 6).
# Beside moments that no model has the two cannot be distinguished, so an inertia is not known better than that.


COHERENCE_SECONDS = 1.0
"""Stretch of a spectrum."""
COHERENCE_BAND = (2.5, 12.5)
"""Frequencies [Hz] that count: slower ones are ruled by unmodelled moments, faster ones by noise and vibration."""
LEAST_COHERENCE = 0.01
"""Smallest share distinguished from zero; also where no stretch is long enough for a spectrum."""


def undecided(windows: Sequence[Window], vehicle: Vehicle, white: FloatArray) -> FloatArray:
    """Indecision of J_xx and J_yy, in log scale, shape (2,).

    It is minus the logarithm of the share of quick roll and pitch acceleration, less what the gyro's noise makes of it,
    that the rotors' torque accounts for.

    Args:
        windows: data on one grid, with a gyro.
        vehicle: places of the rotors.
        white: standard deviation of the white noise of roll and pitch rate [rad/s], shape (2,).
    """
    dt = windows[0].dt
    length = max(round(COHERENCE_SECONDS / dt), 4)
    taper = np.hanning(length)[:, None]
    torque_power, motion_power, cross = (np.zeros((length // 2 + 1, 2), dtype) for dtype in (float, float, complex))
    blocks = 0
    for window in windows:
        if window.gyro is None or len(window) < length:
            continue
        torque = window.rotor_speed**2 @ vehicle.torque_arms[:, :2]
        acceleration = np.gradient(_without_gaps(window.gyro[:, :2]), dt, axis=0)
        for begin in range(0, len(window) - length + 1, length // 2):
            part = slice(begin, begin + length)
            t, a = (np.fft.rfft(taper * (v[part] - v[part].mean(axis=0)), axis=0) for v in (torque, acceleration))
            torque_power += np.abs(t) ** 2
            motion_power += np.abs(a) ** 2
            cross += np.conj(t) * a
            blocks += 1
    frequency = np.fft.rfftfreq(length, dt)
    band = (frequency >= COHERENCE_BAND[0]) & (frequency <= COHERENCE_BAND[1])
    differences = np.sin(2.0 * np.pi * frequency[band] * dt)[:, None] / dt
    noise = blocks * np.sum(taper**2) * np.sum((differences * white) ** 2, axis=0)
    none = np.finfo(float).tiny
    made = np.sum(np.abs(cross[band]) ** 2 / np.maximum(torque_power[band], none), axis=0)
    motion = np.sum(motion_power[band], axis=0) - noise
    return np.asarray(-np.log(np.clip(made / np.maximum(motion, none), LEAST_COHERENCE, 1.0)))


def _without_gaps(values: FloatArray) -> FloatArray:
    """Straight lines across missing rows."""
    rows, there = np.arange(len(values)), np.isfinite(values).all(axis=1)
    return np.column_stack([np.interp(rows, rows[there], v[there]) if there.any() else 0.0 * rows for v in values.T])


# --- The fit


THRUST_AXIS = 8
"""Residual channel of the specific force along z."""
LATE_START = 0.005
"""Start of lags and delays in the fit [s]."""
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
    # Random moments from what a fit leaves, and the fit with these, in turns until nothing moves.
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
    # Other estimates: shorter segments, nothing late, and what torque leaves undecided.
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
    """Delays between the rotor columns and the rates."""
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
