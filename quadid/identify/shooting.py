"""Multiple shooting: short segments, each with its own initial state, which is eliminated exactly.

For every segment the residual is linearised in its initial state a and the free parameters z, weighted and whitened:
``r(a, z) = r0 + A da + B dz``.  Minimising over da leaves ``r' = P r0 + P B dz`` with P the projector onto the
complement of A.  All later steps (polish, covariance, excitation, screening, cross-validation) are linear algebra on
the small matrices ``B' P B``, ``B' P r0``, ``r0' P r0`` of each segment.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from copy import copy

import numpy as np
from numpy.typing import NDArray

from quadid.effects import EFFECTS
from quadid.identify.elimination import Reduced, StatePrior
from quadid.identify.elimination_kernel import reduce_segments
from quadid.identify.initial_states import first_states, retract
from quadid.identify.noise_model import NoiseModel
from quadid.identify.parameterization import Free as Free
from quadid.identify.segment_cost import Linearised as Linearised
from quadid.identify.segment_cost import join
from quadid.identify.segment_jacobian import Columns
from quadid.model.kernel import LANES
from quadid.model.layout import Layout, places
from quadid.model.packing import packed, packing
from quadid.model.rollout import Rollout, Segments, shared_rollout
from quadid.vehicle import Vehicle
from quadid.window import Window

FloatArray = NDArray[np.float64]

LEAD_SECONDS = 0.2
"""Stretch before a segment in which filters and delays settle."""
_TANGENT_STEP = np.array([1e-6] * 3 + [1e-6] * 3 + [1e-5] * 3 + [1e-5] * 3)
_RIDGE = np.array([1.0] * 3 + [20.0] * 3 + [30.0] * 3 + [100.0] * 3)
"""Step size of the initial state beyond which it is held back: rad, rad/s, m/s, m; no pull at convergence."""
RAN_AWAY = 1e30
"""Products of whitened columns above which, or without a value, a simulation has left every scale of a flight."""
LOCAL_SIGMA = 10.0
"""Standard deviation, in typical sizes, of parameters that are free in every segment (`Shooting.local`)."""
VELOCITY_PRIOR = 4.0
"""Standard deviation [m/s] of a segment's initial velocity around dead reckoning where none is measured."""
_WARM_UP = places(*(e.name for e in EFFECTS.values() if e.memory))
_AIR = places(*(e.name for e in EFFECTS.values() if e.acts == "air"))
_STEP_FRACTION = 1e-4


class Shooting:
    """The residual problem of several windows cut into segments.

    Attributes:
        noise: noise model used for weights.
        robust: row weights against outliers, per window, or None.
        local: parameters that each segment has a value of its own for, eliminated with its initial state; what they
            explain, such as slow moments that the model lacks, no longer pulls at the others.
    """

    def __init__(
        self, windows: Sequence[Window], vehicle: Vehicle, seconds: float, noise: NoiseModel | None = None,
        layout: Layout | None = None,
    ) -> None:  # fmt: skip
        """Cuts `windows` into segments of about `seconds` with room for filters and delays before each."""
        self.vehicle = vehicle
        self.layout = layout or Layout(vehicle)
        dt = windows[0].dt
        self.dt = dt
        length, lead = max(round(seconds / dt), 4), max(round(LEAD_SECONDS / dt), 1)
        fits = [w for w in windows if len(w) > length + lead]
        self.rollouts = [shared_rollout(w, vehicle) for w in fits]
        self.channels = min((r.channels for r in self.rollouts), default=9)
        self.segments = [Segments.cut(len(r), length, lead) for r in self.rollouts]
        self.length, self.lead = length, lead
        self.noise = noise or NoiseModel.guess(self.channels, vehicle.noise)
        self._x0: dict[int, list[FloatArray]] = {}
        self._reckoned: dict[int, list[FloatArray]] = {}
        self.robust: list[FloatArray | None] = [None] * len(self.rollouts)
        self.local: tuple[str, ...] = ()

    @property
    def count(self) -> int:
        """Number of segments."""
        return sum(len(s.starts) for s in self.segments)

    def free(self, names: Sequence[str]) -> Free:
        """Returns the free parameters called `names`."""
        return Free(tuple(self.layout.entry(n) for n in names))

    def states(self, n_pre: int) -> list[FloatArray]:
        """Initial states `n_pre` rows before the segments; at first measured ones, with velocities found so far."""
        if n_pre not in self._x0:
            pairs = zip(self.rollouts, self.segments, strict=True)
            measured = [first_states(r, s, n_pre) for r, s in pairs]
            self._reckoned[n_pre] = [x[:, 7:10].copy() for x in measured]
            for x, near, reckoned in zip(measured, self._x0.get(1, ()), self._reckoned.get(1, ()), strict=False):
                x[:, 7:10] += near[:, 7:10] - reckoned
            self._x0[n_pre] = measured
        return self._x0[n_pre]

    def has_states(self, theta: FloatArray, free: Free) -> bool:
        """Whether initial states are known as early as the model of `theta` and `free` begins."""
        return self._shape(theta, free)[0] in self._x0

    def set_states(self, n_pre: int, states: list[FloatArray]) -> None:
        """Replaces the initial states."""
        self._x0[n_pre] = states

    def _shape(self, theta: FloatArray, free: Free) -> tuple[int, int]:
        """Rows to roll before a segment and directions of its initial state that matter."""
        warm = _uses(_WARM_UP, theta, free)
        moves = _uses(_AIR, theta, free)
        tangents = {9: 9 if moves else 6, 12: 9, 15: 12}[self.channels]
        return (self.lead if warm else 1), tangents

    def finds_velocity(self, names: Sequence[str]) -> bool:
        """Whether initial velocities are found with the parameters `names`: airspeed matters and is not measured."""
        return not self.has_velocity and bool(np.isin(self.free(names).index, _AIR).any())

    @property
    def has_velocity(self) -> bool:
        """True when velocity or position is measured in every window."""
        return self.channels > 9

    @property
    def seconds(self) -> float:
        """Length of a segment [s]."""
        return self.length * self.dt

    def snapshot(self) -> dict[int, list[FloatArray]]:
        """Copy of the current initial states, for `restore`."""
        return dict(self._x0)

    def restore(self, kept: dict[int, list[FloatArray]]) -> None:
        """Puts back what `snapshot` gave."""
        self._x0 = dict(kept)

    def thinned(self, every: int) -> Shooting:
        """The same problem on every n-th segment of each window, the first included."""
        return self.taking([np.arange(0, len(s.starts), every) for s in self.segments])

    def taking(self, kept: Sequence[NDArray[np.intp]]) -> Shooting:
        """The same problem on some segments of each window, by their places; states are its own copy.

        Windows of which none is kept are left out.
        """
        windows = [i for i, k in enumerate(kept) if len(k)]
        out = copy(self)
        out.rollouts = [self.rollouts[i] for i in windows]
        out.segments = [self.segments[i].at(kept[i]) for i in windows]
        out.robust = [r if r is None else r[kept[i]] for i, r in enumerate(self.robust) if len(kept[i])]
        out._x0 = {n: [x[i][kept[i]] for i in windows] for n, x in self._x0.items()}
        out._reckoned = {n: [v[i][kept[i]] for i in windows] for n, v in self._reckoned.items()}
        return out

    def on(self, windows: Sequence[Window]) -> Shooting:
        """The same problem on other data."""
        return Shooting(windows, self.vehicle, self.seconds, self.noise, self.layout)

    def at_most(self, most: int) -> Shooting:
        """The same problem on at most about `most` segments, spread evenly."""
        return self.thinned(max(-(-self.count // most), 1))

    def between(self) -> Shooting:
        """The same problem cut half a segment later, so that borders lie where the middle of segments was.

        Windows too short for that are left out.
        """
        later = copy(self)
        cuts = [(r, s.later(s.length // 2, len(r))) for r, s in zip(self.rollouts, self.segments, strict=True)]
        later.rollouts = [r for r, s in cuts if len(s.starts)]
        later.segments = [s for _, s in cuts if len(s.starts)]
        later.robust = [None] * len(later.rollouts)
        later._x0, later._reckoned = {}, {}
        return later

    def swarm_cost(self, theta: FloatArray, free: Free, most: int) -> Callable[[FloatArray], FloatArray]:
        """Cost of many parameter vectors at once on at most `most` segments, spread evenly.

        The directions of the initial states are taken at `theta` and projected out (variable projection): within a
        short segment they hardly depend on the parameters.

        Returns:
            A function of parameter vectors (m, size) giving costs (m,).
        """
        n_pre, k = self._shape(theta, free)
        every = -(-self.count // most)
        jobs = []
        for i, (rollout, segments) in enumerate(zip(self.rollouts, self.segments, strict=True)):
            cut = segments.every(every)
            x0 = np.ascontiguousarray(self.states(n_pre)[i][::every])
            rolled, steps = self._roll_directions(rollout, cut, theta, self.free([]), x0, n_pre, k)
            weights = _weights(rollout, cut, self.channels) / np.sqrt(self.noise.variance)
            columns = rolled[0, ..., : self.channels, 1 : k + 1] - rolled[0, ..., : self.channels, :1]
            flat = (columns / steps * weights[..., None]).reshape(len(x0), -1, k)
            flat = np.concatenate([flat, np.repeat(np.diag(1e-6 / _RIDGE[:k])[None], len(flat), axis=0)], axis=1)
            basis = np.ascontiguousarray(np.linalg.qr(flat)[0][:, :-k])  # once, not at every call
            row_weights = rollout.valid[:, : self.channels] / np.sqrt(self.noise.variance)
            jobs.append((rollout, cut, x0, row_weights, basis))

        def cost(thetas: FloatArray) -> FloatArray:
            parts = [r.costs(cut, thetas, x0, weights, basis, n_pre) for r, cut, x0, weights, basis in jobs]
            return np.asarray(np.sum(parts, axis=0), dtype=np.float64)

        return cost

    def linearise(self, theta: FloatArray, free: Free) -> Linearised:
        """Linearises all segments at `theta` and the current initial states; eliminates the initial states."""
        n_pre, k = self._shape(theta, free)
        states = self.states(n_pre)
        both = Free((*self.free(self.local).entries, *free.entries))
        parts = []
        for i in range(len(self.rollouts)):
            away = states[i][:, 7:10] - self._reckoned[n_pre][i]
            prior = self._state_prior(i, away, k)
            parts.append(self._reduced(i, theta, both, states[i], prior, n_pre, k))
        return join(parts)

    def _state_prior(self, i: int, away: FloatArray, k: int) -> StatePrior:
        ridge = np.concatenate([1.0 / _RIDGE[:k] ** 2, np.full(len(self.local), LOCAL_SIGMA**-2.0)])
        unknown = k >= 9 and not self._has_velocity(i)
        return StatePrior(ridge, VELOCITY_PRIOR**-2.0 if unknown else 0.0, np.ascontiguousarray(away))

    def _row_weights(self, i: int) -> FloatArray:
        """Weights of the rows of a window's segments, shape (segments, length, channels)."""
        weights = _weights(self.rollouts[i], self.segments[i], self.channels)
        robust = self.robust[i]
        return weights if robust is None or robust.shape != weights.shape else weights * robust

    def _directions(self, theta: FloatArray, free: Free, k: int) -> tuple[FloatArray, FloatArray, FloatArray]:
        """One lane for the base and for each direction: vectors (1 + k + P, size), offsets (…, 12), steps (k + P,)."""
        m = 1 + k + len(free.entries)
        thetas = np.repeat(theta[None], m, axis=0)
        dx = np.zeros((m, 12))
        steps = np.empty(m - 1)
        steps[:k] = _TANGENT_STEP[:k]
        dx[1 + np.arange(k), np.arange(k)] = _TANGENT_STEP[:k]
        scale = free.jacobian(theta)
        for j, e in enumerate(free.entries):
            # Step inwards at an upper bound, so that no lane leaves the allowed range.
            h = _STEP_FRACTION if theta[e.index] + scale[j] * _STEP_FRACTION <= e.upper else -_STEP_FRACTION
            thetas[1 + k + j, e.index] += h * scale[j]
            steps[k + j] = h
        return thetas, dx, steps

    def _roll_directions(
        self, rollout: Rollout, segments: Segments, theta: FloatArray, free: Free, x0: FloatArray, n_pre: int, k: int
    ) -> tuple[FloatArray, FloatArray]:
        """Rolls the base and one lane a direction; returns the residuals (blocks, …, LANES) and the steps (k + P,)."""
        thetas, dx, steps = self._directions(theta, free, k)
        return rollout.roll(segments, thetas, x0, dx, n_pre)[0], steps

    def _reduced(
        self, i: int, theta: FloatArray, free: Free, x0: FloatArray, prior: StatePrior, n_pre: int, k: int
    ) -> Linearised:
        """Linearises the segments of one window, local parameters first in `free`, and eliminates what each has own."""
        segments, local, weights = self.segments[i], len(self.local), self._row_weights(i)
        thetas, dx, steps = self._directions(theta, free, k)
        lane = packing(thetas, self.channels)
        thetas, dx = packed(thetas, lane), packed(dx, lane)
        whitening = self.noise.whitening(self.length, self.dt)
        into = Reduced.room(len(x0), k + local, len(steps) - k - local, self.length, self.channels)
        moved = np.empty((*weights.shape, local))

        def use(which: slice, out: FloatArray) -> None:
            reduce_segments(out, lane, steps, weights[which], whitening, prior.part(which), into.part(which))
            for j, at in enumerate(lane[1 + k : 1 + k + local]):
                changed = out[at // LANES, ..., : self.channels, at % LANES]
                moved[which][..., j] = (changed - into.base[which]) / steps[k + j]

        self.rollouts[i].roll_parts(segments, thetas, x0, dx, n_pre, use)
        if not np.max(into.largest, initial=0.0) < RAN_AWAY:
            into.run_away(prior)
        if local:
            # What the local parameters explain is no residual.
            into.base[...] -= np.einsum("silj,sj->sil", moved, into.offset[:, k:])
        return Linearised(
            into.gram, into.grad, into.cost, into.occam, np.count_nonzero(weights, axis=(1, 2)) - into.fitted,
            into.base, weights, (into.offset, into.slope), np.full(len(x0), i, dtype=np.intp),
            self.rollouts[i].window.t[segments.starts],
        )  # fmt: skip

    def columns(self, theta: FloatArray, free: Free, parameters: bool = True) -> Iterator[Columns]:
        """For each window the whitened residual at `theta`, and what initial states and `free` can do to it.

        Args:
            theta: full parameter vector.
            free: free parameters; they decide which directions of an initial state matter.
            parameters: whether to work out the columns of `free`.
        """
        n_pre, k = self._shape(theta, free)
        free = free if parameters else self.free([])
        whitener = self.noise.whitener(self.length, self.dt)
        for i, (rollout, segments) in enumerate(zip(self.rollouts, self.segments, strict=True)):
            out, steps = self._roll_directions(rollout, segments, theta, free, self.states(n_pre)[i], n_pre, k)
            weights = _weights(rollout, segments, self.channels)
            lanes = out[..., : self.channels, :].transpose(1, 2, 3, 0, 4).reshape(*weights.shape, -1)
            del out  # of a long log each of these is a large part of all memory
            base = lanes[..., :1].copy()
            rows = np.concatenate([(lanes[..., 1 : 1 + len(steps)] - base) / steps, base], axis=3)
            del lanes
            white = self.whiten(rows, weights)
            del rows
            flat = white.reshape(len(white), -1, len(steps) + 1)
            ridge = np.repeat(np.diag(1.0 / _RIDGE[:k])[None], len(flat), axis=0)
            basis = np.linalg.qr(np.concatenate([flat[..., :k], ridge], axis=1))[0][:, :-k]
            yield Columns(
                rollout.window, segments.starts[:, None] + np.arange(segments.length), basis, white[..., -1],
                np.all(weights > 0.0, axis=1), flat[..., k:-1], base[..., 0], weights,
                np.sqrt(self.noise.variance), self.noise.coloured, whitener,
            )  # fmt: skip

    def _has_velocity(self, i: int) -> bool:
        return self.rollouts[i].channels > 9

    def whiten(self, rows: FloatArray, weights: FloatArray) -> FloatArray:
        """Weights and whitens rows of shape (segments, length, channels, columns); masked channels stay unwhitened."""
        whitener = self.noise.whitener(self.length, self.dt)
        out = rows * (weights / np.sqrt(self.noise.variance))[..., None]
        for c in np.flatnonzero(self.noise.coloured):
            full = np.all(weights[:, :, c] > 0.0, axis=1)
            scaled = rows[full, :, c] * weights[full, :, c, None]
            out[full, :, c] = np.matmul(whitener[c], scaled)
        return out

    def step_states(self, theta: FloatArray, free: Free, lin: Linearised, z: FloatArray) -> list[FloatArray]:
        """Initial states after the parameter step `z`, shapes as `states`; does not store them."""
        n_pre, k = self._shape(theta, free)
        offset, slope = lin.back[0][:, :k], lin.back[1][:, :k]
        da = -(offset + slope @ z)
        limit = np.array([0.5] * 3 + [10.0] * 3 + [15.0] * 3 + [50.0] * 3)[:k]
        da = np.clip(da, -limit, limit)
        out, place = [], 0
        for x0 in self.states(n_pre):
            out.append(retract(x0, da[place : place + len(x0)]))
            place += len(x0)
        return out

    def adopt(self, theta: FloatArray, free: Free, states: list[FloatArray]) -> None:
        """Stores initial states that belong to the model of `theta` and `free`."""
        self.set_states(self._shape(theta, free)[0], states)


def _weights(rollout: Rollout, segments: Segments, channels: int) -> FloatArray:
    rows = segments.starts[:, None] + np.arange(segments.length)
    return np.asarray(rollout.valid[rows][..., :channels], dtype=np.float64)


def _uses(places: tuple[int, ...], theta: FloatArray, free: Free) -> bool:
    """Whether any of these entries acts at `theta` or may, being free."""
    return bool(np.isin(free.index, places).any() or theta[list(places)].any())
