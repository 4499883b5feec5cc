"""Rest after the named causes: random forces, and signals that the innovations follow; and the verdict on it."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.evidence import RELEVANT
from quadid.diagnosis.hypotheses import held_out, paired_gain
from quadid.diagnosis.pipeline import LEAST_OF_EXPLAINED, LEAST_STRUCTURE, SHARE_TO_NAME
from quadid.diagnosis.residual_tests import SITES, WAVES, Follows, Site, inputs, strongest
from quadid.diagnosis.result import Explanation
from quadid.estimate import kalman as k
from quadid.estimate.fit import ACTS, ALL_NOISE, MOST, scoring
from quadid.estimate.kalman import Gains
from quadid.estimate.problem import Sensitivities
from quadid.identification.elimination import freed
from quadid.rotation import rotated
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY
from quadid_evaluation.studies.innovations.models import Flights, Model, innovations, quadratic, with_additions

LEAST_REMOVED = 0.3
"""Share of the squared random force and moment that causes must take to explain a flight in part …"""
REMOVED_ALONE = 0.5
"""… a single cause this one: nothing else is there to have left the rest, so its form may be wrong."""
# --- What remains, held against generic causes: do the innovations follow anything that the vehicle did?
#
# Random forces see structure only where it stands above the noise.  Something that follows a command, a motion or the
# time is seen far below that.  Each probe is a signal (an input, its square, its change, a motion, a slow function of
# time) acting at a site: as a moment, a force, an error of the gyro or of the attitude.  What it does to the
# innovations, less what free parameters take up, is fitted on all blocks but one and judged on that one, so a probe
# that follows only noise loses.
#
# No signal may share noise with an innovation: motions are those filtered one sample before, and inputs are those of
# the step before, because a controller's command answers to the noise of the sample that it was worked out from.


_RIDGE = 1e-6
"""Prior precision of a probe, relative to its information: keeps signals finite that double one another."""
SMALL = 1e-3
"""Step of a probe's derivative, as a share of a unit signal."""


def _channel(site: Site) -> int:
    """Output that shows a site most, of `CHANNEL_NAMES`."""
    return site.channels[0][0]


def follows(flights: Flights, model: Model) -> tuple[Follows, ...]:
    """Holds what `model` leaves against all signals at every site."""
    problem = model.problem
    named = [signals(w, g) for w, g in zip(flights.windows, model.gains, strict=True)]
    names = tuple(named[0])
    # Scaled over all flights alike, so that one coefficient means the same in each.
    stacked = [np.stack(list(s.values())) for s in named]
    scale = np.sqrt(np.mean(np.concatenate([s**2 for s in stacked], axis=1), axis=1, keepdims=True))
    stacked = [s / np.where(scale > 0.0, scale, 1.0) for s in stacked]
    own = [problem.sensitivities(j, model.z, model.psi, g) for j, g in enumerate(model.gains)]
    out = []
    for site in SITES:
        if not all(track.seen[:, _channel(site) // 3].any() for track in problem.tracks):
            continue
        found = []
        for j, mine in enumerate(own):
            J = np.zeros((len(model.z) + len(names), *mine.plain.shape))
            J[mine.entries] = mine.J
            J[len(model.z) :] = _responses(site, stacked[j], model, j, mine.plain)
            found.append(Sensitivities(list(range(len(J))), mine.plain, J))
        out.append(_followed(site, names, found, model))
    return tuple(out)


def _responses(site: Site, signal: FloatArray, model: Model, j: int, plain: FloatArray) -> FloatArray:
    """Derivatives of whitened innovations (n, M) by signals (S, n) at a site, shape (S, n, M)."""
    track, p = model.problem.tracks[j], model.problem.physics(model.z, j)
    g = with_additions(model.gains[j])
    h, axis, out = np.diff(track.t), _channel(site) % 3, np.empty((len(signal), *plain.shape))
    for i, s in enumerate(SMALL * signal):
        added = g.beyond.added.copy()
        if site.name.startswith("moment"):
            added[:-1, axis] += h * s[:-1]
            added[:-1, 3 + axis] += 0.5 * h**2 * s[:-1]
        elif site.name.startswith("force"):
            added[:-1, 6:9] += rotated(g.mean[:-1, :4], h[:, None] * s[:-1, None] * np.eye(3)[axis])
            added[:, 9 + k.ACCEL + axis] += s
        else:
            added[:, 9 + _channel(site)] += s
        out[i] = innovations(track._replace(beyond=g.beyond._replace(added=added)), p, model.psi, g)
    return (out - plain) / SMALL


def _followed(site: Site, names: tuple[str, ...], found: Sequence[Sensitivities], model: Model) -> Follows:
    problem, own = model.problem, len(model.z)
    near = quadratic(model.problem, model.gains, found, len(found[0].J))
    total, slope = near.information, near.gradient
    sizes = np.diag(total)[own:]
    precision = np.concatenate([model.precision, _RIDGE * sizes + 1e-9])
    gain = paired_gain(model.left_out.block, held_out(near, precision).block)
    each = freed(
        (sizes + precision[own:])[:, None, None],
        total[own:, None, :own],
        total[:own, :own] + np.diag(precision[:own]),
        slope[own:, None],
        slope[:own] + (model.z - problem.prior[0]) * precision[:own],
    )
    return Follows(site, gain, dict(zip(names, each.tolist(), strict=True)))


def signals(window: Window, g: Gains) -> dict[str, FloatArray]:
    """Signals at every row of a flight, each of shape (n,), not yet scaled.

    Args:
        window: the flight.
        g: gains of a pass over it, whose means are the motion.
    """
    out = {f"{name} input": _before(s) for name, s in inputs(window).items()}
    out |= {name: _before(s) for name, s in _motions(window, g).items()}
    first, last = window.log_span
    share = (window.t - first) / max(last - first, window.dt)
    out["constant"] = np.ones_like(share)
    for n in range(1, WAVES + 1):
        out[f"time, {n} half waves"] = np.cos(n * np.pi * share)
    return out


def _motions(window: Window, g: Gains) -> dict[str, FloatArray]:
    """Filtered rates and tilt, measured specific force, and products of them."""
    p, q, r = g.mean[:, 4:7].T
    out = {"p": p, "q": q, "r": r, "p|p|": p * np.abs(p), "q|q|": q * np.abs(q), "r|r|": r * np.abs(r)}
    out |= {"p q": p * q, "q r": q * r, "r p": r * p, "|p|": np.abs(p), "|q|": np.abs(q)}
    if window.accel is not None:
        f_x, f_y, f_z = np.nan_to_num(window.accel).T
        lift = f_z - np.mean(f_z)
        out |= {
            "a_x": f_x,
            "a_y": f_y,
            "a_z": lift,
            "a_z squared": lift**2,
            "a_x a_z": f_x * lift,
            "a_y a_z": f_y * lift,
        }
    w, x, y, z = g.mean[:, :4].T
    out |= {"pitched": 2.0 * (x * z - w * y), "rolled": 2.0 * (y * z + w * x)}
    return out | {"heading north": w * w + x * x - y * y - z * z, "heading east": 2.0 * (x * y + w * z)}


def _before(signal: FloatArray) -> FloatArray:
    """The signal one row before; in the first row, there."""
    return np.concatenate([signal[:1], signal[:-1]])


# --- What remains after the named causes: do random forces act, and does the rest contradict the causes?


FORCES = slice(k.SIGMA, k.SIGMA + 4)
"""Places of the random forces and moments among the noise numbers."""


@dataclass(frozen=True)
class Remainder:
    """Rest by random forces and by what it follows.

    Attributes:
        random: deviance that random forces and moments take away.
        sites: what the innovations follow at each site.
    """

    random: float
    sites: tuple[Follows, ...]

    @property
    def followed_deviance(self) -> float:
        """Deviance that signals take away."""
        return sum(f.gain.total for f in self.followed)

    @property
    def followed(self) -> tuple[Follows, ...]:
        """Generic causes that predict unseen innovations beyond chance, strongest first."""
        return tuple(f for f in strongest(self.sites) if f.significant)


def remainder(flights: Flights, model: Model) -> Remainder:
    """Judges what `model` leaves: what random forces take away of it, and what it follows."""
    random = 0.0
    least = model.problem.noise_bounds[FORCES, 0]
    if np.any(model.psi[FORCES] > ACTS * least):
        still = model.psi.copy()
        still[FORCES] = least
        others = ALL_NOISE.copy()
        others[FORCES] = False
        value = scoring(model.problem, model.z, still, MOST, others, physics=False)[2]
        random = max(value - model.deviance, 0.0)
    return Remainder(random, follows(flights, model))


# --- Verdict from what the causes explain and what is left


def judge(nominal: Model, model: Model, left: Remainder) -> Explanation:
    """Verdict from what the causes explain and what is left.

    Args:
        nominal: model without causes.
        model: the selected one.
        left: what it leaves.
    """
    explained = max(float(nominal.left_out.block.sum() - model.left_out.block.sum()), 0.0)
    least = max(LEAST_STRUCTURE * model.rows, LEAST_OF_EXPLAINED * explained)
    followed, acts = left.followed_deviance, left.random > RELEVANT * model.rows
    if followed <= least and not acts:
        return Explanation.EXPLAINED if model.causes else Explanation.NOTHING_FOUND
    # What random forces take up of a missing cause shows in their size, what the innovations follow in the likelihood.
    named = followed <= least or explained >= SHARE_TO_NAME * (explained + followed)
    share = LEAST_REMOVED if len(model.effects) > 1 else REMOVED_ALONE
    enough = not acts or missing_square(model) <= (1.0 - share) * missing_square(nominal)
    return Explanation.PARTLY_EXPLAINED if model.causes and named and enough else Explanation.UNKNOWN


def missing_square(model: Model) -> float:
    """Square of the random force and moment of a model, each axis in units of weight and of the rotors' moment."""
    problem, (level, vertical, turn, yaw) = model.problem, model.psi[FORCES]
    force = (2.0 * level**2 + vertical**2) / GRAVITY**2
    return float(force + np.sum((np.array([turn, turn, yaw]) / problem.control) ** 2))
