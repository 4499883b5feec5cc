"""Diagnosis in rough air: causes selected by innovations, what remains beside them, and the verdict on it.

Where the quick search leaves more than noise, random forces may be what it could not name.  They belong to the model
here: from the quick search's answer on every model has its own, and a cause is worth what it takes away beside them.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.hypotheses import RELEVANT, free_names, held_out, paired_gain
from quadid.diagnosis.random_forces import Flights, Model, innovations, quadratic, with_additions
from quadid.diagnosis.residual_tests import RIDGE, SITES, Follows, Site, inputs, motions, slow, strongest
from quadid.diagnosis.search import Round, Search
from quadid.diagnosis.second_search import select
from quadid.estimate import kalman as k
from quadid.estimate.fit import ACTS, ALL_NOISE, FORCES, MOST, scoring
from quadid.estimate.kalman import Gains
from quadid.estimate.problem import PER_FLIGHT, Sensitivities
from quadid.identification.elimination import freed
from quadid.rotation import rotated
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY


@dataclass(frozen=True)
class RoughAir:
    """Answer where random forces act.

    Attributes:
        nominal: model without causes; model: the selected one.
        rounds: steps of the selection.
        sites: what the innovations follow at each site.
    """

    nominal: Model
    model: Model
    rounds: tuple[Round[Model], ...]
    sites: tuple[Follows, ...]

    @property
    def followed(self) -> float:
        """Deviance that signals take away which innovations follow beyond chance."""
        return sum(f.gain.total for f in strongest(self.sites) if f.significant)

    @property
    def explained(self) -> float:
        """Deviance that causes take away on unseen blocks."""
        return max(float(self.nominal.held_out.sum() - self.model.held_out.sum()), 0.0)

    @property
    def removed(self) -> float:
        """Share of the squared random force and moment that causes take away."""
        return 1.0 - missing_square(self.model) / missing_square(self.nominal)


@np.errstate(over="ignore", invalid="ignore")
def in_rough_air(windows: Sequence[Window], search: Search) -> RoughAir | None:
    """Causes of what moves a vehicle beside random forces, from the quick search on; None where no such forces act.

    Args:
        windows: the flights, each once.
        search: the quick search on them.
    """
    quick, vehicle = search.model, search.shooting.vehicle
    flights, nominal = Flights.of(windows, vehicle, search.listed).nominal(search.nominal.theta)
    times = {c.effect: float(quick.theta[c.timed]) for c in quick.causes if c.timed is not None}
    problem = flights.problem(free_names(quick.causes), times)
    start = dict(zip(problem.keys, problem.at(quick.theta), strict=True))
    start |= {key: z for key, z in zip(nominal.keys, nominal.z, strict=True) if key[0].startswith(PER_FLIGHT)}
    known = flights.fit(quick.causes, start, nominal.psi, times, quick.tried)
    model, rounds = select(flights, known or nominal)
    if taken_by_random_forces(model) <= RELEVANT * model.rows:
        return None
    return RoughAir(nominal, model, rounds, follows(flights, model))


def taken_by_random_forces(model: Model) -> float:
    """Deviance that random forces and moments take away."""
    least = model.problem.noise_bounds[FORCES, 0]
    if not np.any(model.psi[FORCES] > ACTS * least):
        return 0.0
    still, others = model.psi.copy(), ALL_NOISE.copy()
    still[FORCES], others[FORCES] = least, False
    return scoring(model.problem, model.z, still, MOST, others, physics=False)[2] - model.deviance


def missing_square(model: Model) -> float:
    """Square of the random force and moment of a model, each axis in units of weight and of the rotors' moment."""
    problem, (level, vertical, turn, yaw) = model.problem, model.psi[FORCES]
    force = (2.0 * level**2 + vertical**2) / GRAVITY**2
    return float(force + np.sum((np.array([turn, turn, yaw]) / problem.control) ** 2))


# --- What remains, held against generic causes: do the innovations follow anything that the vehicle did?
#
# The probes of `residual_tests`, by what they do to innovations.  No signal may share noise with one: motions are those
# filtered one sample before, and inputs are those of the step before.


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
            found.append(mine._replace(entries=list(range(len(J))), J=J))
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
    near = quadratic(problem, model.gains, found, len(found[0].J))
    total, slope = near.information, near.gradient
    sizes = np.diag(total)[own:]
    precision = np.concatenate([model.precision, RIDGE * sizes + 1e-9])
    gain = paired_gain(model.held_out, held_out(near, precision).block)
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
    force = None if window.accel is None else np.nan_to_num(window.accel)
    out = {f"{name} input": s for name, s in inputs(window).items()} | motions(g.mean[:, 4:7], force, g.mean[:, :4])
    return {name: np.concatenate([s[:1], s[:-1]]) for name, s in out.items()} | slow(window)
