"""Problem of a fit: free parameters with priors, and windows cut into short segments (multiple shooting).

Every segment has an initial state of its own, which is eliminated exactly.  The residual is linearised in the initial
state a and the free parameters z, weighted and whitened: ``r(a, z) = r0 + A da + B dz``.  Minimising over da leaves
``r' = P r0 + P B dz`` with P the projector onto the complement of A.  All later steps (Gauss-Newton, covariance,
excitation, score tests, cross-validation) are linear algebra on the small matrices ``B' P B``, ``B' P r0``,
``r0' P r0`` of each segment.

A problem is frozen: noise and weights are replaced (`with_noise`, ...), initial states are values of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.identification.elimination import (
    InitialStates,
    Reduced,
    Starts,
    StatePrior,
    columns_of,
    frozen,
    reduce_segments,
)
from quadid.identification.noise import NoiseModel
from quadid.model.layout import Entry, Layout, places
from quadid.model.rollout import Rollout, Segments, packed, packing, shared_rollout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import BoolArray, FloatArray, IndexArray, IntArray, check_shapes
from quadid.vehicle import Vehicle


@dataclass(frozen=True)
class Free:
    """The free parameters of a problem and how they are scaled.

    Nominal parameters are searched on the log scale, effects in units of their typical size.

    Attributes:
        entries: in vector order.
    """

    entries: tuple[Entry, ...]

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Dotted names."""
        return tuple(e.name for e in self.entries)

    @cached_property
    def index(self) -> IndexArray:
        """Places in the full vector."""
        return np.array([e.index for e in self.entries], dtype=np.intp)

    @cached_property
    def is_log(self) -> BoolArray:
        """True for parameters on the log scale."""
        return np.array([e.name in NOMINAL_NAMES for e in self.entries], dtype=bool)

    @cached_property
    def scale(self) -> FloatArray:
        """Size of one unit of a linear parameter."""
        return np.array([e.typical for e in self.entries])

    @cached_property
    def bounds(self) -> tuple[FloatArray, FloatArray]:
        """Lower and upper bounds of the values, shapes (parameters,)."""
        return np.array([e.lower for e in self.entries]), np.array([e.upper for e in self.entries])

    @cached_property
    def _origin(self) -> FloatArray:
        return np.where(self.is_log, 1.0, 0.0)

    def scaled(self, values: FloatArray) -> FloatArray:
        """Scaled parameters of values, last axis of both (parameters,)."""
        return self.difference(values, self._origin)

    def unscaled(self, z: FloatArray) -> FloatArray:
        """Values of scaled parameters, last axis of both (parameters,)."""
        return self.shifted(self._origin, z)

    def shifted(self, values: FloatArray, z: FloatArray) -> FloatArray:
        """Values moved by the scaled step `z`, bounds or not, last axis of all (parameters,)."""
        with np.errstate(over="ignore", invalid="ignore"):
            return np.where(self.is_log, values * np.exp(z), values + z * self.scale)

    def placed(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Full vector `theta` with the free entries replaced by scaled parameters `z`."""
        out = theta.copy()
        out[self.index] = self.unscaled(z)
        return out

    def step(self, theta: FloatArray, moved: FloatArray) -> FloatArray:
        """The scaled step that leads from full vector `theta` to `moved`, shape (parameters,)."""
        return self.difference(moved[self.index], theta[self.index])

    def difference(self, values: FloatArray, start: FloatArray) -> FloatArray:
        """The scaled step that leads from values `start` to `values`, shape (parameters,)."""
        with np.errstate(divide="ignore", invalid="ignore"):
            return np.where(self.is_log, np.log(values / start), (values - start) / self.scale)

    def from_neutral(self, theta: FloatArray) -> FloatArray:
        """Distances of effects from neutral at `theta`, in typical sizes, shape (parameters,)."""
        return np.asarray((theta[self.index] - np.array([e.neutral for e in self.entries])) / self.scale)

    def move(self, theta: FloatArray, z: FloatArray) -> FloatArray:
        """Returns `theta` moved by the scaled step `z`, clamped to the bounds."""
        out = theta.copy()
        out[self.index] = np.minimum(np.maximum(self.shifted(out[self.index], z), self.bounds[0]), self.bounds[1])
        return out

    def jacobian(self, theta: FloatArray) -> FloatArray:
        """Derivative of the parameters to z at `theta`, shape (parameters,)."""
        return np.where(self.is_log, theta[self.index], self.scale)


_LONGEST_STEP = np.array([0.5] * 3 + [10.0] * 3 + [15.0] * 3 + [50.0] * 3)
"""Longest step of an initial state: rad, rad/s, m/s, m."""


@dataclass(frozen=True)
class Linearised:
    """Per-segment quadratic model of the cost in the free parameters, initial states eliminated.

    Attributes:
        gram: shape (segments, P, P); grad: (segments, P); cost: (segments,), all for scaled parameters z:
            ``cost(z) = cost + 2 grad z + z gram z``.
        occam: what freeing unmeasured initial velocities costs, shape (segments,): the log-determinant that turns the
            profile deviance into the marginal one; added when models are compared, zero where velocity matters not.
        rows: independent residuals of each segment, measured samples less fitted initial-state directions.
        residuals: predicted - measured at the linearisation point, channel units, (segments, length, channels).
        weights: 1 where measured (times robust weight), 0 elsewhere, same shape.
        back: what gives the initial-state steps back: (offset (segments, k), slope (segments, k, P)).
        window: index of the window of each segment; time: its first scored time [s].
        states: initial states it was linearised at.
        n_pre: rows between the start of the simulation and the segment.
    """

    gram: FloatArray
    grad: FloatArray
    cost: FloatArray
    occam: FloatArray
    rows: FloatArray
    residuals: FloatArray
    weights: FloatArray
    back: tuple[FloatArray, FloatArray]
    window: IndexArray
    time: FloatArray
    states: InitialStates
    n_pre: int

    @cached_property
    def information(self) -> FloatArray:
        """Of all segments on the scaled parameters, shape (P, P), read-only."""
        return frozen(self.gram.sum(axis=0))

    @cached_property
    def gradient(self) -> FloatArray:
        """Half the slope of the cost of all segments, shape (P,), read-only."""
        return frozen(self.grad.sum(axis=0))

    @cached_property
    def total_cost(self) -> float:
        """Cost of all segments."""
        return float(self.cost.sum())

    @cached_property
    def total_rows(self) -> float:
        """Independent residuals of all segments."""
        return float(self.rows.sum())

    @property
    def spacing(self) -> float:
        """Time from one segment to the next [s]; 1 s where there is one only."""
        return float(np.median(np.diff(self.time))) if len(self.time) > 1 else 1.0

    @property
    def reduced_chi_square(self) -> float:
        """Cost per independent residual; 1 at the noise floor."""
        return self.total_cost / max(self.total_rows, 1.0)

    def stepped(self, z: FloatArray | None = None) -> InitialStates:
        """Initial states after the scaled parameter step `z`, or with parameters held."""
        offset, slope = self.back
        da = -(offset if z is None else offset + slope @ z)
        limit = _LONGEST_STEP[: da.shape[1]]
        return self.states.stepped(self.n_pre, np.clip(da, -limit, limit))


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

    def whiten(self, rows: FloatArray, channel: int) -> FloatArray:
        """Weights and whitens changes of one channel, shape (segments, length, columns)."""
        return self.noise.whitened(rows[:, :, None], self.weights[:, :, [channel]], self.window.dt, [channel])[:, :, 0]


LEAD_SECONDS = 0.2
"""Stretch before a segment in which filters and delays settle."""
_TANGENT_STEP = np.array([1e-6] * 3 + [1e-6] * 3 + [1e-5] * 3 + [1e-5] * 3)
RIDGE = np.array([1.0] * 3 + [20.0] * 3 + [30.0] * 3 + [100.0] * 3)
"""Step size of the initial state beyond which it is held back: rad, rad/s, m/s, m; no pull at convergence."""
RAN_AWAY = 1e30
"""Products of whitened columns above which, or without a value, a simulation has left every scale of a flight."""
VELOCITY_PRIOR = 4.0
"""Standard deviation [m/s] of a segment's initial velocity around dead reckoning where none is measured."""
_WARM_UP = places(*(e.name for e in EFFECTS.values() if e.memory))
_AIR = places(*(e.name for e in EFFECTS.values() if e.acts == "air"))
_STEP_FRACTION = 1e-4
MEASURED = InitialStates()
"""Initial states as measured."""


@dataclass(frozen=True)
class Shooting:
    """The residual problem of several windows cut into segments.

    Attributes:
        vehicle: the vehicle; layout: of its parameter vector.
        rollouts: simulation of each window; segments: their cuts.
        channels: residual channels, the first 9, 12 or 15.
        length: rows of a segment; lead: rows before it in which filters settle; dt: grid step [s].
        noise: noise model used for weights.
        robust: weights against outliers, 0 where nothing was measured, (segments of all windows, length, channels);
            or None.
    """

    vehicle: Vehicle
    layout: Layout
    rollouts: tuple[Rollout, ...]
    segments: tuple[Segments, ...]
    channels: int
    length: int
    lead: int
    dt: float
    noise: NoiseModel
    robust: FloatArray | None = None

    @classmethod
    def cut(
        cls,
        windows: Sequence[Window],
        vehicle: Vehicle,
        seconds: float,
        noise: NoiseModel | None = None,
        layout: Layout | None = None,
    ) -> Shooting:
        """Cuts `windows` into segments of about `seconds` with room for filters and delays before each.

        Channels count that every window has and whose noise is known; without `noise`, typical noise.
        """
        dt = windows[0].dt
        length, lead = max(round(seconds / dt), 4), max(round(LEAD_SECONDS / dt), 1)
        rollouts = tuple(shared_rollout(w, vehicle) for w in windows if len(w) > length + lead)
        known = 15 if noise is None else len(noise.white)
        channels = min((r.channels for r in rollouts), default=min(known, 9))
        channels = min(channels, known)
        segments = tuple(Segments.cut(len(r), length, lead) for r in rollouts)
        noise = NoiseModel.guess(channels, vehicle.noise) if noise is None else noise.first(channels)
        return cls(vehicle, layout or Layout(vehicle), rollouts, segments, channels, length, lead, dt, noise)

    def __post_init__(self) -> None:
        """Checks noise and weights against the channels; raises ValueError."""
        check_shapes("shooting", ("noise", self.noise.white, (self.channels,)))
        if self.robust is not None:
            check_shapes("shooting", ("robust", self.robust, (self.count, self.length, self.channels)))

    @property
    def count(self) -> int:
        """Number of segments."""
        return sum(len(s.starts) for s in self.segments)

    @property
    def seconds(self) -> float:
        """Length of a segment [s]."""
        return self.length * self.dt

    @property
    def has_velocity(self) -> bool:
        """True when velocity or position is measured in every window."""
        return self.channels > 9

    def free(self, names: Sequence[str]) -> Free:
        """Returns the free parameters called `names`."""
        return Free(tuple(self.layout.entry(n) for n in names))

    def finds_velocity(self, names: Sequence[str]) -> bool:
        """True if initial velocities are found with the parameters `names`: airspeed matters and is not measured."""
        return not self.has_velocity and bool(np.isin(self.free(names).index, _AIR).any())

    def with_noise(self, noise: NoiseModel) -> Shooting:
        """The same problem weighted with another noise model."""
        return replace(self, noise=noise)

    def with_robust(self, weights: FloatArray | None) -> Shooting:
        """The same problem with other weights against outliers."""
        return replace(self, robust=weights)

    def on(self, windows: Sequence[Window]) -> Shooting:
        """The same problem on other data."""
        return Shooting.cut(windows, self.vehicle, self.seconds, self.noise, self.layout)

    def places(self, most: int) -> list[IndexArray]:
        """Every n-th segment of each window, the first included: about `most` of all at most."""
        every = max(-(-self.count // most), 1)
        return [np.arange(0, len(s.starts), every) for s in self.segments]

    def taking(self, kept: Sequence[IndexArray]) -> Shooting:
        """The same problem on some segments of each window, by their places.

        Windows of which none is kept are left out.
        """
        windows = [i for i, k in enumerate(kept) if len(k)]
        first = np.cumsum([0, *(len(s.starts) for s in self.segments)])
        of_all = [k + before for k, before in zip(kept, first[:-1], strict=True)]
        return replace(
            self,
            rollouts=tuple(self.rollouts[i] for i in windows),
            segments=tuple(self.segments[i].at(kept[i]) for i in windows),
            robust=None if self.robust is None else self.robust[np.concatenate(of_all)],
        )

    def at_most(self, most: int) -> Shooting:
        """The same problem on at most about `most` segments, spread evenly."""
        return self.taking(self.places(most))

    def start_of(self, theta: FloatArray, free: Free) -> tuple[int, int]:
        """Rows to roll before a segment and directions of its initial state that matter."""
        # Whether any of these entries acts at `theta` or may, being free.
        warm, moves = (
            bool(np.isin(free.index, entries).any() or theta[list(entries)].any()) for entries in (_WARM_UP, _AIR)
        )
        tangents = {9: 9 if moves else 6, 12: 9, 15: 12}[self.channels]
        return (self.lead if warm else 1), tangents

    def starts(self, n_pre: int, states: InitialStates | None = None) -> Starts:
        """Starts of simulations, `n_pre` rows before the segments: of `states`, else as measured."""
        return (states or MEASURED).at(n_pre, self.rollouts, self.segments)

    def linearise(self, theta: FloatArray, free: Free, states: InitialStates | None = None) -> Linearised:
        """Linearises all segments at `theta` and `states` (as measured by default); eliminates the initial states."""
        n_pre, k = self.start_of(theta, free)
        starts = self.starts(n_pre, states)
        states = (states or MEASURED).replaced(n_pre, starts)
        weights = self.robust
        if weights is None:
            weights = np.concatenate([self.measured_weights(i) for i in range(len(self.rollouts))])
        into = Reduced.room(self.count, k, len(free.entries), self.length, self.channels)
        place, counts = 0, [len(s.starts) for s in self.segments]
        for i, (x0, reckoned) in enumerate(zip(*starts, strict=True)):
            which = slice(place, place + counts[i])
            # Where velocity matters and is not measured, dead reckoning holds it.
            known = VELOCITY_PRIOR**-2.0 if k >= 9 and self.rollouts[i].channels <= 9 else 0.0
            prior = StatePrior(1.0 / RIDGE[:k] ** 2, known, np.ascontiguousarray(x0[:, 7:10] - reckoned))
            self._reduce(i, theta, free, x0.copy(), prior, n_pre, k, weights[which], into.part(which))
            place = which.stop
        times = [r.window.t[s.starts] for r, s in zip(self.rollouts, self.segments, strict=True)]
        return Linearised(
            into.gram,
            into.grad,
            into.cost,
            into.occam,
            np.count_nonzero(weights, axis=(1, 2)) - into.fitted,
            into.base,
            weights,
            (into.offset, into.slope),
            np.repeat(np.arange(len(counts), dtype=np.intp), counts),
            np.concatenate(times),
            states,
            n_pre,
        )

    def measured_weights(self, i: int) -> FloatArray:
        """1 where a window's segments were measured, 0 elsewhere, shape (segments, length, channels)."""
        return np.array(self.rollouts[i].valid[self.segments[i].rows][..., : self.channels], dtype=np.float64)

    def _directions(self, theta: FloatArray, free: Free, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """One lane for the base and for each direction: vectors (1 + k + P, size), offsets (…, 12), steps (k + P,)."""
        m = 1 + k + len(free.entries)
        thetas = np.repeat(theta[None], m, axis=0)
        dx, steps = np.zeros((m, 12)), np.empty(m - 1)
        dx[1 + np.arange(k), np.arange(k)] = steps[:k] = _TANGENT_STEP[:k]
        scale = free.jacobian(theta)
        for j, e in enumerate(free.entries):
            # Step inwards at an upper bound, so that no lane leaves the allowed range.
            h = _STEP_FRACTION if theta[e.index] + scale[j] * _STEP_FRACTION <= e.upper else -_STEP_FRACTION
            thetas[1 + k + j, e.index] += h * scale[j]
            steps[k + j] = h
        return thetas, dx, steps

    def roll_directions(
        self, i: int, theta: FloatArray, free: Free, x0: FloatArray, n_pre: int, k: int
    ) -> tuple[FloatArray, FloatArray]:
        """Rolls a window's base and one lane a direction: residuals (blocks, …, LANES) and steps (k + P,)."""
        thetas, dx, steps = self._directions(theta, free, k)
        return self.rollouts[i].roll(self.segments[i], thetas, x0, dx, n_pre)[0], steps

    def _reduce(
        self,
        i: int,
        theta: FloatArray,
        free: Free,
        x0: FloatArray,
        prior: StatePrior,
        n_pre: int,
        k: int,
        weights: FloatArray,
        into: Reduced,
    ) -> None:
        """Linearises the segments of one window and eliminates the initial state of each."""
        segments = self.segments[i]
        thetas, dx, steps = self._directions(theta, free, k)
        lane = packing(thetas, self.layout.rotors)
        thetas, dx = packed(thetas, lane), packed(dx, lane)

        @np.errstate(over="ignore", invalid="ignore")
        def use(which: slice, out: FloatArray) -> None:
            rows, part = columns_of(out, lane, steps, self.channels), into.part(which)
            part.base[:] = rows[..., 0]
            white = self.noise.whitened(rows, weights[which], self.dt)
            reduce_segments(white.reshape(len(white), -1, len(lane)), prior.part(which), part)

        self.rollouts[i].roll_parts(segments, thetas, x0, dx, n_pre, use)
        if not np.max(into.largest, initial=0.0) < RAN_AWAY:
            into.run_away(prior)

    def columns(
        self, theta: FloatArray, free: Free, states: InitialStates | None = None, parameters: bool = True
    ) -> Iterator[Columns]:
        """For each window the whitened residual at `theta`, and what initial states and `free` can do to it.

        Args:
            theta: full parameter vector.
            free: free parameters; they decide which directions of an initial state matter.
            states: initial states; as measured by default.
            parameters: whether to work out the columns of `free`.
        """
        n_pre, k = self.start_of(theta, free)
        free = free if parameters else self.free([])
        for i, x0 in enumerate(self.starts(n_pre, states).x0):
            out, steps = self.roll_directions(i, theta, free, x0.copy(), n_pre, k)
            weights = self.measured_weights(i)
            rows = columns_of(out, np.arange(1 + len(steps)), steps, self.channels)
            del out  # of a long log each of these is a large part of all memory
            white, base = self.noise.whitened(rows, weights, self.dt), rows[..., 0].copy()
            del rows
            flat = white.reshape(len(white), -1, 1 + len(steps))
            ridge = np.repeat(np.diag(1.0 / RIDGE[:k])[None], len(flat), axis=0)
            basis = np.linalg.qr(np.concatenate([flat[..., 1 : 1 + k], ridge], axis=1))[0][:, :-k]
            yield Columns(
                self.rollouts[i].window,
                self.segments[i].rows,
                basis,
                white[..., 0],
                np.all(weights > 0.0, axis=1),
                flat[..., 1 + k :],
                base,
                weights,
                self.noise,
            )


# --- Priors on the free parameters, and normal equations of data and prior


PRIOR_SIGMA_LINEAR = 10.0
"""Weak prior of an effect parameter: this many typical sizes."""


@dataclass(frozen=True)
class Prior:
    """Gaussian prior on the scaled parameters: ``mean`` of the parameter, ``sigma`` in scaled units, shapes (P,)."""

    mean: FloatArray
    sigma: FloatArray

    @property
    def precision(self) -> FloatArray:
        """Of each scaled parameter, shape (P,)."""
        return np.asarray(1.0 / self.sigma**2)


def default_prior(shooting: Shooting, free: Free) -> Prior:
    """Prior of each free parameter: thrust stand, else the file's (`ParameterPrior.log_sigma`); weak on effects."""
    mean, sigma = [], []
    stand = shooting.vehicle.stand_thrust
    for e in free.entries:
        known = shooting.vehicle.parameters.get(e.name)
        if e.name == "b" and stand is not None:
            mean.append(stand[0])
            sigma.append(stand[1])
        elif known is not None:
            mean.append(known.initial)
            sigma.append(known.log_sigma)
        else:
            mean.append(e.neutral)
            sigma.append(PRIOR_SIGMA_LINEAR)
    return Prior(np.array(mean), np.array(sigma))


def prior_terms(free: Free, prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Precision (P,), gradient (P,) and cost of the prior at `theta`, in scaled parameters."""
    z = free.difference(theta[free.index], prior.mean)
    return prior.precision, prior.precision * z, float(np.sum(prior.precision * z * z))


def normal_equations(lin: Linearised, free: Free, prior: Prior, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Of data and prior at `theta`: h (P, P) and g (P,) of the cost ``2 g z + z h z`` of a scaled step z."""
    precision, pull, _ = prior_terms(free, prior, theta)
    return lin.information + np.diag(precision), lin.gradient + pull


def posterior_covariance(information: FloatArray, prior: Prior) -> FloatArray:
    """Covariance (P, P) of the scaled parameters, given their information from data, (P, P), and the prior."""
    return np.asarray(np.linalg.inv(information + np.diag(prior.precision)))
