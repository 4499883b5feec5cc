"""The fit by innovations: the likelihood of a Kalman filter with random forces and moments, and how far it holds.

Where turbulence, the wake of rotors or a missing cause moves the vehicle, simulated runs take what the controller does
against it for inertia (an error of closed loop: U. Forssell and L. Ljung, Automatica 35 (1999) 1215).  Innovations of a
Kalman filter with random forces do not, and where nothing random acts they hold all that a whole flight shows.  What
acts on every vehicle beside the six is fitted along: what makes rotors or gyro late passes for inertia, drag and
damping for drag torque.

Random forces hold what comes and goes.  What a missing cause makes in step with the rotors or the motion they do not:
parts of the flight, and models with each cause of the catalogue added, estimate the same parameters, and intervals are
as wide as their differences.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.chi_square import exceeded
from quadid.data.window import Window
from quadid.effects import EFFECTS, butterworth_delay
from quadid.estimate import kalman as k
from quadid.estimate.fit import ACTS, NEAR_SECONDS, Estimate, best_step, estimate, newton_step
from quadid.estimate.kalman import Gains
from quadid.estimate.late_imu import delay_of, in_time
from quadid.estimate.problem import LATE, Problem, Sensitivities
from quadid.estimate.track import from_window
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Free
from quadid.identification.uncertainty import (
    BLOCKS,
    CHANCE,
    NEAR_BEST,
    SHARE,
    SPREAD_LIMIT,
    WIDE,
    Reliability,
    Uncertainty,
    coarse,
    promised,
    random_effects,
)
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import Vehicle

ALONG = (
    "rotor_drag.k_x",
    "rotor_drag.k_y",
    "rotor_drag.central",
    "rotor_drag_moment.h_x",
    "rotor_drag_moment.h_y",
    "rate_damping.l_p",
    "rate_damping.m_q",
    "rate_damping.n_r",
    "cg_offset.x",
    "cg_offset.y",
)
"""Fitted along, with what is late, unless the model has numbers of that effect."""
INFLOW, UNCOUPLED = "axial_inflow.k_z", "no_gyroscopic_coupling.share"
SHOWN = {INFLOW: 0.0, UNCOUPLED: 0.5}
"""Fitted along where a flight shows that, and what they then are at least: climbs take thrust away, and a simulator
leaves all of the coupling out or nothing.  Below, something else passes for them."""
MOST_SECONDS = 600.0
"""Of longer flights the liveliest so many seconds are fitted: then a minute's interval is a third."""
FORGOTTEN = 4.0
"""Lags after which rotors hardly turn any more as they began."""
MET = 3.0
"""Standard deviations of a cause's number that are met: beyond, something else passes for it."""
SELDOM = 1e-4
"""Probability with which a cause that is not there takes away so much."""
LARGE = 0.5
"""Random moments in units of their prior, a tenth of the control moment, from which they are reported."""
LOST = 3.0
"""The same of the vertical force that the flight shows, a twentieth of the weight: beyond, no number is to be used."""


@dataclass(frozen=True)
class Filtered:
    """Parameters by the likelihood of innovations.

    Attributes:
        theta: full vector, nothing of what was fitted along in it.
        uncertainty: covariance of what is free.
        prompt: step of what is free to where nothing is late, scaled parameters, shape (P,).
        trust: what other estimates differ by.
        tilting: random moments act about roll or pitch.
        noise: of the sensors, white and, of the attitude, slow.
        beside: what was fitted along and undone, as effects of a vehicle file.
    """

    theta: FloatArray
    uncertainty: Uncertainty
    prompt: FloatArray
    trust: Reliability
    tilting: bool
    noise: NoiseModel
    beside: dict[str, dict[str, float]]

    def held(self, uncertainty: Uncertainty) -> Uncertainty:
        """An uncertainty of these parameters with what other estimates differ by."""
        return self.trust.widened(uncertainty.differing([self.prompt]))

    def doubts(self, free: Free) -> tuple[str, ...]:
        """Sentences on parameters whose estimates differ too much."""
        late = [n for n, step in zip(free.names, self.prompt, strict=True) if abs(step) > SPREAD_LIMIT]
        otherwise = f"{', '.join(late)}: more than {SPREAD_LIMIT:.0%} different without lag and delay"
        return (*((otherwise,) if late else ()), *self.trust.reasons(free))


def filtered(
    windows: Sequence[Window],
    vehicle: Vehicle,
    theta: FloatArray,
    free: Free,
    per_flight: Sequence[str] = (),
    noise: FloatArray | None = None,
) -> Filtered | None:
    """Fits `free` parameters by the likelihood of innovations, random forces and all noise with them.

    Args:
        windows: data on one grid.
        vehicle: geometry, mass, priors and bounds.
        theta: where to start, full vector; holds the numbers of what is not free.
        free: the parameters.
        per_flight: entries that are free beside them, with a value for each flight.
        noise: noise numbers of a model nearby, see `quadid.estimate.fit.estimate`.

    Returns:
        None where the filter has no finite answer.
    """
    try:
        with np.errstate(over="ignore", invalid="ignore"):
            return _filtered(windows, vehicle, theta, free, per_flight, noise)
    except np.linalg.LinAlgError:  # the filter ran away
        return None


def _filtered(
    windows: Sequence[Window],
    vehicle: Vehicle,
    theta: FloatArray,
    free: Free,
    per_flight: Sequence[str],
    noise: FloatArray | None,
) -> Filtered | None:
    # 1. The estimate, with what acts on every vehicle fitted along; gyro and accelerometer in time.
    layout, beside = Layout(vehicle), dict[str, dict[str, float]]()
    known = {e.name.split(".")[0] for e in layout.entries.values() if theta[e.index] != e.neutral}
    stated = known | {n.split(".")[0] for n in free.names}
    if "imu_lag" not in stated:
        delay = delay_of(windows)
        windows = [in_time(window, delay) for window in windows]
        if delay:
            beside["imu_lag"] = {"cutoff": butterworth_delay(delay)}
    along = [*fitted_along(stated)]
    late = [n for n in along if n in LATE]
    nominal = [n for n in free.names if n in NOMINAL_NAMES]
    others = [*(n for n in free.names if n not in NOMINAL_NAMES), *per_flight]

    def problem_of(windows: Sequence[Window], names: Sequence[str] = ()) -> Problem:
        tracks = [from_window(w, vehicle, air=True) for w in windows]
        return Problem.of(tracks, vehicle, (*others, *along, *names), windows, theta, nominal).liveliest(MOST_SECONDS)

    # How rotors behind a lag began is not known.
    unsettled = FORGOTTEN * float(theta[layout.entry("motor_lag.tau").index])
    whole = problem_of(windows).settled(unsettled)
    found = estimate(whole, start_of(whole, theta, along), noise)
    lag = found.value("motor_lag.tau")[0] if "motor_lag.tau" in whole.names else 0.0
    if FORGOTTEN * lag > unsettled + windows[0].dt:
        unsettled = FORGOTTEN * lag
        again = problem_of(windows).settled(unsettled)
        found = estimate(again, found.z * found.problem.size / again.size, found.psi)
    # What these flights show beside: in a climb b would stand in for inflow, J_zz for rotations that do not couple.
    velocity = all(w.velocity is not None for w in windows)
    asked = [name for name in SHOWN if name.split(".")[0] not in stated and (velocity or name != INFLOW)]
    while asked and found.finite and (shown := _shown(found, problem_of(windows, asked).settled(unsettled))):
        along += shown
        again = problem_of(windows).settled(unsettled)
        beyond = estimate(again, _without(found, again), found.psi)
        wrong = [name for name in shown if not (beyond.finite and beyond.value(name)[0] >= SHOWN[name])]
        if not wrong:
            found = beyond
            break
        along, asked = [n for n in along if n not in shown], [n for n in asked if n not in wrong]
    if not found.finite:
        return None
    problem, names = found.problem, [name for name, *_ in found.problem.entries]
    out, places = theta.copy(), np.array([names.index(n) for n in free.names])
    out[free.index] = [found.value(n, 0)[0] for n in free.names]
    # 2. Its covariance: both scale the six by logarithms, but effects by sizes of their own.
    unit = np.where(free.is_log, 1.0, problem.size[places] / free.scale)
    covariance = found.covariance[np.ix_(places, places)] * np.outer(unit, unit)
    own = Uncertainty(covariance, np.ones(len(unit)), unit * problem.prior[1][places])
    # 3. What is late may be the rotors or a filter of the gyro, of which a J each follows: where nothing is, a third.
    where = np.array([names.index(n) for n in late], dtype=np.intp)
    prompt = np.zeros(len(places))
    if late:
        pull = np.linalg.solve(found.covariance[np.ix_(where, where)], found.z[where])
        prompt = -unit * (found.covariance[np.ix_(places, where)] @ pull)
    # 4. Parts of the flights, every second row, and models with one cause more.
    more = [n for n in _catalogue(layout, windows) if n not in problem.names and n.split(".")[0] not in known]
    wide, half = problem_of(windows, more), replace(problem_of([coarse(w) for w in windows]), names=problem.names)
    wide, half = wide.settled(unsettled), half.settled(unsettled)
    trust = _compared(found, wide, half, places, unit)
    share = found.psi[k.SIGMA : k.TIME] / problem.noise_scale
    for name in along:
        value, (effect, number) = found.value(name)[0], name.split(".")
        if not layout.entry(name).sign * value < 0.0:  # less than nothing is noise about nothing
            beside.setdefault(effect, {})[number] = value
    return Filtered(out, own, prompt, trust, bool(share[2] > LARGE), sensor_noise(found), beside)


def _without(found: Estimate, more: Problem) -> FloatArray:
    """Scaled parameters of an estimate in a problem that has more, without that."""
    z = dict(zip(found.problem.keys, found.z.tolist(), strict=True))
    return np.array([z.get(key, 0.0) for key in more.keys])


def _shown(found: Estimate, more: Problem) -> list[str]:
    """Entries of a problem with more of them than an estimate that are proven beside it, each by a score test."""
    problem = found.problem
    z, anywhere = _without(found, more), np.full(len(more.entries), np.inf)
    more = replace(more, base=problem.base, control=problem.control, tail=problem.tail).along(z, found.psi)
    h, g = more.normal_equations(z, found.psi, more.passes(z, found.psi)[1])
    own = [i for i, (name, *_) in enumerate(more.entries) if name in problem.names]
    others = {name: [i] for i, (name, *_) in enumerate(more.entries) if i not in own}
    promises = _promises(h, g, (-anywhere, anywhere), own, others)
    return [name for name, gain, _ in promises if gain > exceeded(SELDOM, 1)]


def _promises(
    h: FloatArray, g: FloatArray, box: tuple[FloatArray, FloatArray], own: list[int], causes: Mapping[str, list[int]]
) -> list[tuple[str, float, FloatArray]]:
    """Result of `promised` by information h and gradient g, steps within a box; causes that run away are left out."""
    finite = np.isfinite(np.diag(h)) & np.isfinite(g)
    return promised(
        lambda free: best_step(h, g, box, free),
        own,
        {name: entries for name, entries in causes.items() if finite[entries].all()},
    )


def carried(gains: Sequence[Gains]) -> float:
    """Root mean square of the vertical random force, specific [m/s^2]: what carries the vehicle beside its rotors."""
    force = np.concatenate([g.mean[:, k.FO + 3] for g in gains])  # of the mean, all but the attitude lies one further
    return float(np.sqrt(np.mean(force**2)))


def sensor_noise(found: Estimate) -> NoiseModel:
    """Noise of the measured channels, the attitude estimator's error as the slow part of the attitude's."""
    measured = 12 if any(track.seen[:, 3].any() for track in found.problem.tracks) else 9
    slow, tilt_and_heading = np.zeros(measured), [k.SIGMA + 4, k.SIGMA + 4, k.SIGMA + 5]
    error, least = found.psi[tilt_and_heading], found.problem.noise_bounds[tilt_and_heading, 0]
    slow[k.ATTITUDE : k.ACCEL] = np.where(error > ACTS * least, error, 0.0)
    return NoiseModel(found.psi[:measured].copy(), slow, float(found.psi[k.TIME + 4]))


def fitted_along(stated: Collection[str]) -> tuple[str, ...]:
    """Names of what acts on every vehicle beside the nominal six, but for the effects `stated` by name."""
    # Delays and lags of rotors pass for one another: where the model has one, nothing else is late.
    effects = [EFFECTS[n] for n in stated if n in EFFECTS]
    late = () if any(e.family == "late" and e.acts == "command" for e in effects) else LATE
    return tuple(n for n in (*ALONG, *late) if n.split(".")[0] not in stated)


def start_of(problem: Problem, theta: FloatArray, along: Collection[str]) -> FloatArray:
    """Scaled parameters of a full vector, where a search begins: drag fitted `along` acts at the centre of gravity.

    Without the hubs' part only the accelerometer determines the sign of drag.
    """
    begin = theta.copy()
    if "rotor_drag.central" in along:
        begin[problem.layout.entry("rotor_drag.central").index] = 1.0
    return problem.at(begin)


def _catalogue(layout: Layout, windows: Sequence[Window]) -> list[str]:
    """Entries of every cause that these data may hold; each rotor's loss is one."""
    measured = {name for name in ("velocity", "position") if all(getattr(w, name) is not None for w in windows)}
    # Without an attitude the scale of the gyro and an inertia are one number; a delay is a lag's twin.
    twins = {"command_delay", "weak_rotor"} | ({"gyro_scale"} if any(w.attitude is None for w in windows) else set())
    effects = [e for e in EFFECTS.values() if measured.issuperset(e.needs) and not e.timed and e.name not in twins]
    losses = [name for name in layout.entries if name.startswith("weak_rotor.loss_")]
    return [*(name for e in effects for name in e.entries), *losses]


def _compared(found: Estimate, wide: Problem, half: Problem, places: IndexArray, unit: FloatArray) -> Reliability:
    """Compares the estimate with those from parts of the flights, and from models with one cause more.

    Args:
        found: the estimate.
        wide: the same flights with the whole catalogue free.
        half: every second row of them.
        places: of the parameters that are compared, shape (P,).
        unit: their scale over that of the estimate, shape (P,).
    """
    problem = found.problem
    wide, half = (
        replace(other, base=problem.base, control=problem.control, tail=problem.tail) for other in (wide, half)
    )
    # 1. Parts of the flights: the step of each block of time from the optimum of all, and its variance.
    gains = problem.passes(found.z, found.psi)[1]
    whole, lost = _sensitivities(problem, found, gains), bool(carried(gains) > LOST * problem.noise_scale[1])
    gains.clear()  # of a long flight, they are as much as all else together
    grams, slopes = _blocks(problem, whole)
    grams, slopes = grams + np.diag(1.0 / (BLOCKS * problem.prior[1] ** 2)), slopes - slopes.mean(axis=0)
    box = problem.limits - found.z
    steps = np.array([newton_step(gram, slope, 0.0, *box) for gram, slope in zip(grams, slopes, strict=True)])
    variances = np.diagonal(np.linalg.inv(grams), axis1=1, axis2=2)
    between = random_effects(steps[:, places] * unit, variances[:, places] * unit**2)
    # 2. The whole catalogue, linearised at the estimate on the liveliest minute.
    part = problem.liveliest(NEAR_SECONDS)
    near = whole if part is problem else _sensitivities(part, found, part.passes(found.z, found.psi)[1])
    others = [
        (f"when {name} is in the model", step[places] * unit)
        for name, step in _with_causes(found, near, wide.liveliest(NEAR_SECONDS))
    ]
    # 3. Every second row: what inputs do within a row is a third of the step to rows twice as long.
    try:
        others.append(("when the flight is fitted on a finer grid", _on_coarse_grid(found, half)[places] * unit))
    except np.linalg.LinAlgError:  # it runs away there
        lost = True
    moved = np.array([step for _, step in others]).reshape(-1, len(unit))
    farthest = np.max(np.abs(moved), axis=0, initial=0.0)
    by = np.hypot(between, farthest)
    return Reliability(np.maximum(between, farthest), by, moved, tuple(name for name, _ in others), lost)


def _with_causes(found: Estimate, near: Sequence[Sensitivities], wide: Problem) -> list[tuple[str, FloatArray]]:
    """Causes that take much off the likelihood, beside the one that takes off most, and the step of all parameters.

    Args:
        found: the estimate.
        near: sensitivities by its own parameters.
        wide: the same rows with the whole catalogue free.
    """
    index = {key: i for i, key in enumerate(wide.keys)}
    own = [index[key] for key in found.problem.keys]
    z, nudge = _without(found, wide), np.full(len(index), 1e-5)
    wide = wide.along(z, found.psi)
    # Entries of a cause are freed together; rotors are causes by themselves.
    causes: dict[str, list[int]] = {}
    for (name, _), i in index.items():
        effect = EFFECTS.get(name.split(".")[0])
        if i not in own and effect is not None:
            causes.setdefault(name if effect.name == "weak_rotor" else effect.name, []).append(i)
            if effect.start and effect.name != "weak_rotor":  # what has no slope at nothing has one to where it starts
                nudge[i] = effect.start[effect.entries.index(name)] / wide.size[i]
    added = [i for entries in causes.values() for i in entries]
    mean, sigma = wide.prior
    if wide.vehicle.mass_sigma > 0.0 or wide.vehicle.arm_sigma > 0.0:
        # Sharp priors pull against a wrong mass or arm, which is no cause: see `with_scale_uncertainty`.
        sigma = np.maximum(sigma, WIDE)
    information, gradient = np.diag(1.0 / sigma**2), (z - mean) / sigma**2
    for j, (mine, g) in enumerate(zip(near, wide.passes(z, found.psi)[1], strict=True)):
        more = wide.sensitivities(j, z, found.psi, g, nudge, added)
        entries = [*(own[i] for i in mine.entries), *more.entries]
        of_both, slope = mine._replace(J=np.concatenate([mine.J, more.J])).quadratic()
        gradient[entries] += slope
        information[np.ix_(entries, entries)] += of_both
    least, most = wide.limits - z
    least[added], most[added] = np.maximum(least[added], -MET), np.minimum(most[added], MET)

    promises = _promises(information, gradient, (least, most), own, causes)
    limit = NEAR_BEST * max((gain for _, gain, _ in promises), default=0.0)
    return [(n, step) for n, gain, step in promises if gain > max(exceeded(SELDOM, len(causes[n])), limit)]


def _on_coarse_grid(found: Estimate, half: Problem) -> FloatArray:
    """Errors by the length of rows: a share of the step to every second row, none where chance explains that."""
    z, psi = found.z, found.psi
    half = half.along(z, psi)
    information, gradient = half.normal_equations(z, psi, half.passes(z, psi)[1])
    step = newton_step(information, gradient, 0.0, *(half.limits - z))
    chance = exceeded(CHANCE, 1) * (np.diag(np.linalg.inv(information)) + np.diag(found.covariance))
    return np.where(step**2 > chance, SHARE * step, 0.0)


def _sensitivities(problem: Problem, found: Estimate, gains: Sequence[Gains]) -> list[Sensitivities]:
    """Sensitivities of each flight of a problem at an estimate, under the gains of a pass there."""
    return [problem.sensitivities(j, found.z, found.psi, g) for j, g in enumerate(gains)]


def _blocks(problem: Problem, found: Sequence[Sensitivities]) -> tuple[FloatArray, FloatArray]:
    """Information (BLOCKS, P, P) and slope (BLOCKS, P) of half the objective, without the prior, by blocks of time."""
    count = len(problem.entries)
    grams, slopes = np.zeros((BLOCKS, count, count)), np.zeros((BLOCKS, count))
    rows, begin = sum(len(track.t) for track in problem.tracks), 0
    for mine in found:
        entries, block = mine.entries, (begin + np.arange(len(mine.plain))) * BLOCKS // rows
        begin += len(mine.plain)
        for b in np.unique(block):
            gram, slope = mine.quadratic(block == b)
            slopes[b, entries] += slope
            grams[b][np.ix_(entries, entries)] += gram
    return grams, slopes
