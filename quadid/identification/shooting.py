"""Multiple shooting: short segments, each with its own initial state, which is eliminated exactly.

For every segment the residual is linearised in its initial state a and the free parameters z, weighted and whitened:
``r(a, z) = r0 + A da + B dz``.  Minimising over da leaves ``r' = P r0 + P B dz`` with P the projector onto the
complement of A.  All later steps (Gauss-Newton, covariance, excitation, score tests, cross-validation) are linear
algebra on the small matrices ``B' P B``, ``B' P r0``, ``r0' P r0`` of each segment.

A problem is frozen: noise and weights are replaced (`with_noise`, …), initial states are values of their own.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.identification.elimination import Reduced, StatePrior
from quadid.identification.elimination_kernel import reduce_segments
from quadid.identification.initial_states import InitialStates, Starts
from quadid.identification.noise_model import NoiseModel
from quadid.identification.parameterization import Free as Free
from quadid.identification.segment_cost import Linearised as Linearised
from quadid.identification.segment_jacobian import Columns
from quadid.model.layout import Layout, places
from quadid.model.rollout import Rollout, Segments, packed, packing, shared_rollout
from quadid.types import FloatArray, IndexArray, check_shapes
from quadid.vehicle import Vehicle

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
        left_out: residual channels that do not count, as if nothing had been measured but where segments begin.
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
    left_out: tuple[int, ...] = ()

    @classmethod
    def cut(
        cls, windows: Sequence[Window], vehicle: Vehicle, seconds: float, noise: NoiseModel | None = None,
        layout: Layout | None = None,
    ) -> Shooting:  # fmt: skip
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
        """Whether initial velocities are found with the parameters `names`: airspeed matters and is not measured."""
        return not self.has_velocity and bool(np.isin(self.free(names).index, _AIR).any())

    def with_noise(self, noise: NoiseModel) -> Shooting:
        """The same problem weighted with another noise model."""
        return replace(self, noise=noise)

    def with_robust(self, weights: FloatArray | None) -> Shooting:
        """The same problem with other weights against outliers."""
        return replace(self, robust=weights)

    def leaving_out(self, channels: Sequence[int]) -> Shooting:
        """The same problem without the residuals of these channels, and only these."""
        return replace(self, left_out=tuple(channels))

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
        return replace(
            self,
            rollouts=tuple(self.rollouts[i] for i in windows),
            segments=tuple(self.segments[i].at(kept[i]) for i in windows),
            robust=None if self.robust is None else self.robust[np.concatenate(self._of_all(kept))],
        )

    def _of_all(self, kept: Sequence[IndexArray]) -> list[IndexArray]:
        """Places of segments within their windows as places among the segments of all windows."""
        ends = np.cumsum([len(s.starts) for s in self.segments])
        return [k + end - len(s.starts) for k, end, s in zip(kept, ends, self.segments, strict=True)]

    def at_most(self, most: int) -> Shooting:
        """The same problem on at most about `most` segments, spread evenly."""
        return self.taking(self.places(most))

    def between(self) -> Shooting:
        """The same problem cut half a segment later, so that borders lie where the middle of segments was.

        Windows too short for that are left out.
        """
        cuts = [(r, s.later(s.length // 2, len(r))) for r, s in zip(self.rollouts, self.segments, strict=True)]
        cuts = [(r, s) for r, s in cuts if len(s.starts)]
        return replace(self, rollouts=tuple(r for r, _ in cuts), segments=tuple(s for _, s in cuts), robust=None)

    def start_of(self, theta: FloatArray, free: Free) -> tuple[int, int]:
        """Rows to roll before a segment and directions of its initial state that matter."""
        warm, moves = _uses(_WARM_UP, theta, free), _uses(_AIR, theta, free)
        tangents = {9: 9 if moves else 6, 12: 9, 15: 12}[self.channels]
        return (self.lead if warm else 1), tangents

    def starts(self, n_pre: int, states: InitialStates | None = None) -> Starts:
        """Where simulations start, `n_pre` rows before the segments: of `states`, else as measured."""
        return (states or MEASURED).at(n_pre, self.rollouts, self.segments)

    def linearise(self, theta: FloatArray, free: Free, states: InitialStates | None = None) -> Linearised:
        """Linearises all segments at `theta` and `states` (as measured by default); eliminates the initial states."""
        n_pre, k = self.start_of(theta, free)
        starts = self.starts(n_pre, states)
        states = (states or MEASURED).replaced(n_pre, starts)
        weights = self._weights()
        into = Reduced.room(self.count, k, len(free.entries), self.length, self.channels)
        place, counts = 0, [len(s.starts) for s in self.segments]
        for i, (x0, reckoned) in enumerate(zip(*starts, strict=True)):
            which = slice(place, place + counts[i])
            prior = self._state_prior(i, x0[:, 7:10] - reckoned, k)
            self._reduce(i, theta, free, x0.copy(), prior, n_pre, k, weights[which], into.part(which))
            place = which.stop
        times = [r.window.t[s.starts] for r, s in zip(self.rollouts, self.segments, strict=True)]
        return Linearised(
            into.gram, into.grad, into.cost, into.occam, np.count_nonzero(weights, axis=(1, 2)) - into.fitted,
            into.base, weights, (into.offset, into.slope),
            np.repeat(np.arange(len(counts), dtype=np.intp), counts), np.concatenate(times), states, n_pre,
        )  # fmt: skip

    def _state_prior(self, i: int, away: FloatArray, k: int) -> StatePrior:
        ridge = 1.0 / RIDGE[:k] ** 2
        unknown = k >= 9 and self.rollouts[i].channels <= 9
        return StatePrior(ridge, VELOCITY_PRIOR**-2.0 if unknown else 0.0, np.ascontiguousarray(away))

    def measured_weights(self, i: int) -> FloatArray:
        """1 where a window's segments were measured and count, 0 elsewhere, shape (segments, length, channels)."""
        weights = np.array(self.rollouts[i].valid[self.segments[i].rows][..., : self.channels], dtype=np.float64)
        weights[..., list(self.left_out)] = 0.0
        return weights

    def _weights(self) -> FloatArray:
        """1 where measured or the robust weight, 0 elsewhere, shape (segments of all windows, length, channels)."""
        if self.robust is not None:
            return self.robust
        return np.concatenate([self.measured_weights(i) for i in range(len(self.rollouts))])

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
        self, i: int, theta: FloatArray, free: Free, x0: FloatArray, prior: StatePrior, n_pre: int, k: int,
        weights: FloatArray, into: Reduced,
    ) -> None:  # fmt: skip
        """Linearises the segments of one window and eliminates the initial state of each."""
        segments = self.segments[i]
        thetas, dx, steps = self._directions(theta, free, k)
        lane = packing(thetas, self.layout.rotors, self.channels)
        thetas, dx = packed(thetas, lane), packed(dx, lane)
        whitening = self.noise.whitening(self.length, self.dt)

        def use(which: slice, out: FloatArray) -> None:
            reduce_segments(out, lane, steps, weights[which], whitening, prior.part(which), into.part(which))

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
            lanes = out[..., : self.channels, :].transpose(1, 2, 3, 0, 4).reshape(*weights.shape, -1)
            del out  # of a long log each of these is a large part of all memory
            base = lanes[..., :1].copy()
            rows = np.concatenate([(lanes[..., 1 : 1 + len(steps)] - base) / steps, base], axis=3)
            del lanes
            white = self.noise.whitened(rows, weights, self.dt)
            del rows
            flat = white.reshape(len(white), -1, len(steps) + 1)
            ridge = np.repeat(np.diag(1.0 / RIDGE[:k])[None], len(flat), axis=0)
            basis = np.linalg.qr(np.concatenate([flat[..., :k], ridge], axis=1))[0][:, :-k]
            yield Columns(
                self.rollouts[i].window, self.segments[i].rows, basis, white[..., -1], np.all(weights > 0.0, axis=1),
                flat[..., k:-1], base[..., 0], weights, self.noise,
            )  # fmt: skip


def _uses(places: tuple[int, ...], theta: FloatArray, free: Free) -> bool:
    """Whether any of these entries acts at `theta` or may, being free."""
    return bool(np.isin(free.index, places).any() or theta[list(places)].any())
