"""Estimate of one vehicle while it flies: sums of what windows say, requests for their fits, the case for the gate.

Every window gives a quadratic model of what its new rows say: in scaled parameters z a Fisher information H and a
vector h = H z - g; both add.  Old information fades.  Differences of the sums are what a stretch of the flight says by
itself, so that one which contradicts the others is seen.

All are linearised at one point: what together no window tells (how large all six, and a support, are) would else be
told by the differences of where they were (as in mapping: Huang et al., International Journal of Robotics Research 29
(2010) 502).  That point is the likelihood's maximum over what had been flown, and is taken anew, with all that was said
there, whenever twice as much has been.
"""

from __future__ import annotations

import hashlib
import math
from collections import deque
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from quadid.chi_square import Z95, exceeded
from quadid.data.window import Window
from quadid.identification.filter_error import UNCOUPLED
from quadid.identification.problem import Free
from quadid.identification.uncertainty import CHANCE, SHARE, Uncertainty, parameter_set
from quadid.model.layout import B, Layout, ThrustModel
from quadid.online.fit_job import (
    CURVE,
    LOOSE,
    SIX,
    Curve,
    FitReply,
    FitRequest,
    Noise,
    WindowEstimate,
    own_names,
    prior_of,
    thrust_names,
)
from quadid.online.gate import ActiveSet, Case, with_room
from quadid.online.grid_buffer import GridBuffer, WindowCut
from quadid.online.records import OnlineSet
from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS, TANGENT, Parameter, ParameterSet, Status
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

DRIFT = 0.02
"""Parameters may honestly differ this much (log scale) from window to window: what no simulation of this kind has."""
SCATTER_PRIOR = 30.0
"""Degrees of freedom with which stretches are believed to scatter as they claim."""
KEPT = 600
"""Sums kept for agreement and held-out gain."""
CONFIRMED = 2
"""Windows without a common sample that must agree before a change is judged by what they say."""
POOLED = 24
"""The newest of so many measured noises counts fully."""
_YAW = [NOMINAL_NAMES.index(n) for n in ("d", "J_zz", "J_r")]
_EPS = 1e-6
NOTHING = 1e-3
"""Share of its prior width within which what is there without evidence is none."""
WIDTH = 3.0
"""Prior width of what thrust may have beside b, in its typical size."""


class Sum(NamedTuple):
    """Accumulated information up to a time [s], of `flown` [s] of data; else as `WindowEstimate`.

    `information` is without `noise`; vectors are h = H z - g.
    """

    stop: float
    flown: float
    information: FloatArray
    vector: FloatArray
    noise: FloatArray
    loose: FloatArray
    half_information: FloatArray
    half_vector: FloatArray

    @classmethod
    def none(cls, stop: float, count: int) -> Sum:
        """Nothing yet."""
        square, vector = np.zeros((count, count)), np.zeros(count)
        return cls(stop, 0.0, square, vector, square, np.zeros((LOOSE, count)), square, vector)

    @classmethod
    def told(cls, e: WindowEstimate, flown: float) -> Sum:
        """The new rows of a window; where they are noisier than was known, they count for less."""
        net = e.information - e.noise
        arrays = net, net @ e.z - e.score, e.noise, e.loose, e.half_information, e.half_information @ e.z - e.half_score
        return cls(e.stop, flown, *(a / max(e.mse, 1.0) for a in arrays))

    def and_(self, share: float, later: Sum) -> Sum:
        """`share` of this and all of a later one."""
        return Sum(later.stop, later.flown, *(share * a + b for a, b in zip(self[2:], later[2:], strict=True)))


@dataclass(frozen=True)
class Fused:
    """An estimate: scaled parameters and covariance (prior included), shapes (P,) and (P, P).

    Attributes:
        between_rows: standard deviations by what happens between two rows, in the covariance, shape (P,).
    """

    z: FloatArray
    covariance: FloatArray
    between_rows: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (P,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class Stretch:
    """Estimate of the six from a stretch of the flight by itself, whatever the others are there.

    Attributes:
        start, stop: its time [s].
        z, covariance: with the prior of all, shapes (6,) and (6, 6).
        best, information: without that of the six.
    """

    start: float
    stop: float
    z: FloatArray
    covariance: FloatArray
    best: FloatArray
    information: FloatArray

    def deviance(self, z: FloatArray) -> float:
        """Cost of six scaled parameters in this stretch above that of its own estimate."""
        step = z - self.best
        return float(step @ self.information @ step)

    def distance(self, z: FloatArray, covariance: FloatArray | float = 0.0) -> float:
        """Squared Mahalanobis distance from an estimate of the six, which has a covariance too."""
        difference = self.z - z
        return float(difference @ np.linalg.solve(self.covariance + covariance, difference))


class Fusion:
    """Running estimate of one vehicle.

    Attributes:
        newest: what was taken in last, or None; taken: how many windows.
        counted: end of the data taken in [s].
    """

    def __init__(
        self,
        mean: FloatArray,
        sigma: FloatArray,
        own: int,
        memory: float,
        length: float,
        positive: Sequence[int] = (),
        unusual: Sequence[int] = (),
    ) -> None:
        """Starts from the prior.

        Args:
            mean: scaled parameters of the prior, shape (P,), the six first.
            sigma: its standard deviations, shape (P,).
            own: so many are estimated; the others are looked at beside them.
            memory: time constant of forgetting [s] of data taken in.
            length: of stretches that are compared [s].
            positive: places of those that are not negative.
            unusual: of those that are none without evidence, their prior's mean being none.
        """
        self._mean, self._sigma, self._positive, self._unusual = mean, sigma, positive, list(unusual)
        self._met = ~np.isin(np.arange(len(sigma)), unusual)
        self._own, self._memory, self._length = own, memory, length
        self._sums: deque[Sum] = deque(maxlen=KEPT)
        self._known: dict[bool, Fused] = {}
        self._stretches: dict[tuple[float, float], Stretch] = {}
        self.newest: WindowEstimate | None = None
        self.taken, self.counted = 0, -math.inf

    def agrees(self, window: WindowEstimate) -> bool:
        """True if the last stretch, a window included, fits what is known from before it, where that is something."""
        total = self._with(window)
        before = self._begin(total)
        if before is None or before.flown == 0.0:
            return True
        known = self._solve(before, self._own)
        allowed = known.covariance[:SIX, :SIX] + np.eye(SIX) * DRIFT**2
        # Less probable: a change, if the next window agrees.
        return self._stretch(before, total).distance(known.z[:SIX], allowed) <= exceeded(1e-5, SIX)

    def add(self, window: WindowEstimate) -> None:
        """Takes a window in."""
        total = self._with(window)
        if not self._sums:
            self._sums.append(Sum.none(window.start, len(self._mean)))
        self._sums.append(total)
        self._known.clear()
        before, self._met = self._met, np.ones(len(self._mean), dtype=np.bool_)
        free = self._solve(total, self._own)
        found = (free.z - self._mean[: self._own]) ** 2 > exceeded(CHANCE, 1) * np.diag(free.covariance)
        self._met[self._unusual] = found[self._unusual]
        if not np.array_equal(self._met, before):
            self._stretches.clear()
        self.newest, self.taken = window, self.taken + 1
        self.counted = max(self.counted, window.stop)

    @property
    def flown(self) -> float:
        """Time of the data taken in [s]."""
        return self._sums[-1].flown if self._sums else 0.0

    def _with(self, window: WindowEstimate) -> Sum:
        old = self._sums[-1] if self._sums else Sum.none(window.start, len(self._mean))
        fresh = max(window.stop - max(window.start, self.counted), 0.0)
        return old.and_(self._fade(fresh), Sum.told(window, old.flown + fresh))

    def _fade(self, seconds: float) -> float:
        return math.exp(-seconds / self._memory)

    def estimate(self, wide: bool = False) -> Fused | None:
        """The estimate, its covariance widened where stretches scatter more than they should; None before data.

        Args:
            wide: with what thrust may have beside b; else that is taken to be none.
        """
        if not self._sums:
            return None
        if wide not in self._known:
            fused = self._solve(self._sums[-1], len(self._mean) if wide else self._own)
            six = fused.z if not wide or (plain := self.estimate()) is None else plain.z
            self._known[wide] = replace(fused, covariance=fused.covariance * self.scatter(six[:SIX]))
        return self._known[wide]

    def spans(self) -> list[tuple[float, float]]:
        """Begin and end [s] of the data taken in, in parts of a quarter of a stretch or a little longer."""
        told = [(new.stop - (new.flown - old.flown), new.stop) for old, new in pairwise(self._sums)]
        return _joined(told, self._length / 4)

    def before(self, start: float) -> FloatArray | None:
        """The six from data up to `start`, shape (6,); None when there are none."""
        earlier = next((s for s in reversed(self._sums) if s.stop <= start + 1e-6 and s.flown > 0.0), None)
        return None if earlier is None else self._solve(earlier, self._own).z[:SIX]

    def disjoint(self, most: int = 12) -> list[Stretch]:
        """Newest stretches that share no sample, newest first."""
        out: list[Stretch] = []
        last = self._sums[-1] if self._sums else None
        while last is not None and len(out) < most and (first := self._begin(last)) is not None:
            key = first.stop, last.stop
            if key not in self._stretches:
                self._stretches[key] = self._stretch(first, last)
            out.append(self._stretches[key])
            last = first
        return out

    def scatter(self, z: FloatArray) -> float:
        """Variance of stretches about six parameters relative to what they claim, at least 1, shrunk towards 1."""
        told = self.disjoint()
        if len(told) < 3:
            return 1.0
        total = sum(s.distance(z) for s in told)
        return max((total + SCATTER_PRIOR) / (SIX * (len(told) - 1) + SCATTER_PRIOR), 1.0)

    def agreement(self, most: int) -> tuple[int, tuple[int, float] | None]:
        """Number of the newest disjoint stretches that agree in a row with the estimate, `most` at most.

        And of the first that does not: which parameter is farthest off, and by how much, log scale.
        """
        fused, limit = self.estimate(), exceeded(1e-3, SIX)
        told = self.disjoint(most) if fused is not None else []
        for agreeing, one in enumerate(told):
            if fused is not None and one.distance(fused.z[:SIX], np.eye(SIX) * DRIFT**2) > limit:
                away = one.z - fused.z[:SIX]
                farthest = int(np.argmax(np.abs(away) / np.sqrt(np.diag(one.covariance) + DRIFT**2)))
                return agreeing, (farthest, float(away[farthest]))
        return len(told), None

    def walked(self, share: FloatArray, most: int) -> tuple[float, float] | None:
        """Change, from the oldest to the newest of `most` stretches, of a sum with `share` (6,) of each of the six.

        And its standard deviation; None where there are fewer than two.
        """
        told = self.disjoint(most)
        if len(told) < 2:
            return None
        newest, oldest = told[0], told[-1]
        return float(share @ (newest.z - oldest.z)), math.sqrt(share @ (newest.covariance + oldest.covariance) @ share)

    def _begin(self, last: Sum) -> Sum | None:
        """The newest sum after which a whole stretch follows up to `last`; the first window may be a little shorter."""
        return next((s for s in reversed(self._sums) if s.flown <= last.flown - self._length + 0.5), None)

    def _stretch(self, first: Sum, last: Sum) -> Stretch:
        """Stretch from the end of one sum to that of another."""
        part = first.and_(-self._fade(last.flown - first.flown), last)
        alone = self._solve(part, self._own)
        covariance = alone.covariance[:SIX, :SIX]
        prior, both = np.diag(1.0 / self._sigma[:SIX] ** 2), np.linalg.inv(covariance)
        information = both - prior
        best = np.linalg.lstsq(information, both @ alone.z[:SIX] - prior @ self._mean[:SIX], rcond=None)[0]
        return Stretch(first.stop, last.stop, alone.z[:SIX], covariance, np.asarray(best), information)

    def _solve(self, total: Sum, own: int) -> Fused:
        """Estimate from a sum by the first `own` parameters, the rest taken to be none."""
        part, mean = slice(own), self._mean[:own]
        # Beside all that thrust may have, nothing is taken to be none.
        met = self._met if own == self._own else np.ones_like(self._met)
        sigma = np.where(met, self._sigma, NOTHING * self._sigma)[part]
        precision, net, loose = 1.0 / sigma**2, total.information[part, part], total.loose[:, part]
        # What noise of the rotors explains is no information, but there is never less than the prior's; where noise
        # explains more than there is, nothing was told.
        size, turned = np.linalg.eigh(sigma[:, None] * net * sigma)
        lost, turned = turned[:, size < 0.0], turned / sigma[:, None]
        vector = total.vector[part] - lost @ (lost.T @ (sigma * total.vector[part])) / sigma
        inverse = np.linalg.inv(np.diag(precision) + (turned * np.maximum(size, 0.0)) @ turned.T)
        # A loop faster than the log answers a random moment within a step: by nothing to all of twice `half`.
        half, doubt = loose[:-1], loose[-1]
        z = inverse @ (vector + precision * mean + half.sum(axis=0))
        for i in self._positive:
            z = z - inverse[:, i] / inverse[i, i] * min(z[i], 0.0)
        spread = net + total.noise[part, part] + np.diag(precision) + half.T @ half / 3.0 + np.outer(doubt, doubt)
        covariance = inverse @ spread @ inverse
        # Errors of the six by the length of rows: a share of the step to every second row, none where chance explains
        # that.
        twice = np.linalg.inv(total.half_information[part, part] + np.diag(precision))
        step = twice @ (total.half_vector[part] + precision * mean) - z
        chance = exceeded(CHANCE, 1) * (np.diag(twice) + np.diag(covariance))
        between = np.where((step**2 > chance) & (np.arange(len(z)) < SIX), SHARE * np.abs(step), 0.0)
        return Fused(z, covariance + np.diag(between**2), between)


# --- Estimate of one vehicle: requests fits, fuses their replies, and states the case for the gate


class Estimator:
    """Estimate of one vehicle.

    Attributes:
        vehicle: of the vehicle file.
        fusion: what windows said.
        theta: full parameter vector, the best at hand.
        noise: noise numbers; None: the next fit searches for everything.
        left_out: of thrust by b w^2 and standard deviations, shape (2, R + 1); None before.
        excitation: of the newest window, shape (6,); NaN before.
        start: first time of the data learned from [s]; NaN before.
        rows: grid rows learned from.
        in_order: a fit was taken in, after rotors were asked for their order: no change in flight exchanges them.
        input_hash: SHA-256 over seed and windows learned from.
    """

    def __init__(self, vehicle: Vehicle, memory: float, length: float, seed: int) -> None:
        """Starts from the vehicle file; windows have `length` [s]."""
        self.vehicle, self._seed = vehicle, seed
        self.excitation = np.full(SIX, np.nan)
        self._hash = hashlib.sha256(f"quadid {vehicle.to_yaml()} {seed}".encode()).digest()
        self._layout = Layout(with_room(vehicle))
        self._initial = self._layout.initial(vehicle)
        self._stated = ThrustModel(self._layout, self._initial)
        self._free = Free(tuple(self._layout.entry(n) for n in NOMINAL_NAMES))
        names, beside = own_names(vehicle), thrust_names(vehicle)
        self._thrust = [self._layout.entry(name) for name in (CURVE, *beside)]
        # A support is estimated too, losses of single rotors are looked at beside.
        prior, count, own = prior_of(vehicle), len(names) + len(beside), len(names) + 1
        self._prior_sigma = prior.sigma
        mean, sigma = np.zeros(count), np.ones(count)
        mean[:SIX], sigma[:SIX] = np.log(prior.mean), prior.sigma
        self._dead, curve = names.index(CURVE), self._thrust[0]
        mean[self._dead], sigma[self._dead :] = self._initial[curve.index] / curve.typical, WIDTH
        lags = [i for i, name in enumerate(names) if name == "motor_lag.tau"]
        unusual = [*(i for i, name in enumerate(names) if name in (UNCOUPLED, CURVE)), len(names)]
        self._nothing = partial(Fusion, mean, sigma, own, memory, length, lags, unusual)
        self._z = mean
        self.reset()

    def reset(self) -> None:
        """Begins as from the vehicle file: nothing that was learned is kept."""
        self.theta, self.in_order = self._initial, False
        self.forget()

    def forget(self) -> None:
        """The vehicle has changed: what was learned no longer holds; the next fit searches globally."""
        self.fusion = self._nothing()
        self.noise: Noise | None = None
        self.left_out: FloatArray | None = None
        self.start, self.rows, self._measured, self._enough = math.nan, 0, 0, 0.0

    @property
    def learned(self) -> bool:
        """True if `theta` rests on data of this flight."""
        return self.fusion.newest is not None

    @property
    def confirmed(self) -> bool:
        """True if windows agree: one may have moved too little for its own interval to be right."""
        return self.learned and self.fusion.agreement(CONFIRMED)[0] == CONFIRMED

    @property
    def thrust(self) -> ThrustModel:
        """Thrust of the rotors, by the best estimate at hand."""
        return ThrustModel(self._layout, self.theta)

    @property
    def published(self) -> ThrustModel:
        """Thrust by what is published and the vehicle file's own effects: what who uses a set has."""
        fused, beyond = self.fusion.estimate(), self._slope_beyond_b
        if fused is None:
            return self._stated
        model = self._stated.with_b(math.exp(fused.z[B]))
        return model if beyond is None else model.with_tangent(math.exp(beyond[0]), self.vehicle.mass * GRAVITY)

    @property
    def _slope_beyond_b(self) -> tuple[float, float] | None:
        """Change of thrust with speed at hover over that by b (log), mean of the rotors, and its standard deviation.

        None where that is nothing as far as is known.
        """
        if self.left_out is None:
            return None
        value, sigma = self.left_out[:, :-1].mean(axis=1).tolist()
        return (value, sigma) if value**2 > exceeded(CHANCE, 1) * sigma**2 else None

    @property
    def input_hash(self) -> str:
        """SHA-256 (hex) over vehicle, seed and all windows learned from."""
        return self._hash.hex()

    @property
    def z_sigma(self) -> FloatArray:
        """Standard deviations of the nominal six, log scale; the prior's before anything was learned."""
        fused = self.fusion.estimate()
        return self._prior_sigma if fused is None else fused.sigma[:SIX]

    @property
    def torque_sigma(self) -> FloatArray:
        """Standard deviations of log(b / J_xx) and log(b / J_yy)."""
        return np.asarray(np.hypot(self.z_sigma[0], self.z_sigma[2:4]))

    @property
    def stated(self) -> ParameterSet:
        """Parameters that the vehicle file claims to know."""
        priors = self.vehicle.parameters
        at = [i for i, n in enumerate(NOMINAL_NAMES) if priors[n].sigma]
        known = (Parameter(n, NOMINAL_UNITS[n], priors[n].initial, priors[n].sigma or 0.0) for n in NOMINAL_NAMES)
        return ParameterSet(tuple(p for p in known if p.sigma), self.vehicle.covariance[np.ix_(at, at)])

    def value(self, name: str) -> float:
        """A nominal parameter, the best at hand."""
        return float(self.theta[NOMINAL_NAMES.index(name)])

    def start_from(self, known: OnlineSet) -> None:
        """Starts the search from a restored set instead of the vehicle file's guess."""
        for p in by_b(known.parameters):
            if p.name in NOMINAL_NAMES:
                self.theta = self.theta.copy()
                self.theta[self._layout.entry(p.name).index] = min(max(p.value, p.bounds[0]), p.bounds[1])

    def request(
        self, number: int, cut: WindowCut, start: float, stop: float, rows: GridBuffer | None = None
    ) -> FitRequest:
        """The fit of a window from `start` to `stop` [s]; every fifth one measures the noise anew.

        Where enough was learned from since, and all of it is in the `rows` of the flight, the point is taken anew.
        """
        spans: tuple[tuple[float, float], ...] = ((max(start, self.fusion.counted), stop),)
        learned: tuple[Window, ...] = ()
        flown = self.fusion.flown
        if rows is not None and 0.0 < self._enough <= flown and rows.start <= self.start:
            spans, self._enough = (*self.fusion.spans(), *spans), 2.0 * flown
            learned = tuple(w for run in _joined(spans) for w in rows.cut(run[0] - _EPS, run[1] - _EPS).windows)
        z, best = self._z, self.fusion.estimate()
        if learned and best is not None:
            z = np.append(best.z, np.zeros(len(z) - len(best.z)))
        return FitRequest(
            number,
            self.vehicle,
            cut.windows,
            start,
            stop,
            self.theta,
            z,
            self.noise,
            self._seed,
            spans,
            learned,
            self.fusion.taken % 5 == 0,
        )

    def agrees(self, request: FitRequest, reply: FitReply) -> bool:
        """True if a reply's estimate by its newest rows agrees with that from before them."""
        return self._before(request, reply).agrees(reply.estimates[-1])

    def _before(self, request: FitRequest, reply: FitReply) -> Fusion:
        """Fusion of the rows before the newest ones, linearised as they are."""
        if not request.learned:
            return self.fusion
        fusion = self._nothing()
        for earlier in reply.estimates[:-1]:
            fusion.add(earlier)
        return fusion

    def take(self, request: FitRequest, reply: FitReply) -> None:
        """Takes in a reply, where it holds an estimate."""
        if reply.excitation is not None:
            self.excitation = reply.excitation
        if not reply.estimates or reply.theta is None:
            return
        self._pool(reply.noise, bool(request.learned))
        for window in request.windows:
            self._hash = hashlib.sha256(self._hash + _bytes(window)).digest()
        start, stop = request.spans[-1]
        self.start = start if math.isnan(self.start) else self.start
        self.rows += round((stop - start) / request.windows[0].dt)
        self.fusion = self._before(request, reply)
        self.fusion.add(reply.estimates[-1])
        self._enough = self._enough or 2.0 * self.fusion.flown
        fused = self.fusion.estimate()
        assert fused is not None
        if fused.sigma[B] >= self._prior_sigma[B]:
            # Less sure than the guess, which it contains: linear in a point that too little motion showed.
            self.forget()
            return
        self._z, self.in_order = reply.estimates[-1].z, True
        self.theta = self._free.placed(reply.theta, fused.z[:SIX])
        self.left_out = self._beyond_b()

    def _pool(self, found: Noise | None, of_all: bool) -> None:
        """Takes in noise that a fit found: that of all that was flown, or of one more window."""
        if found is None:
            return
        self._measured = min(self._measured + 1, POOLED)
        known, share = self.noise, 1.0 / self._measured
        if known is not None and not of_all:
            psi = np.sqrt((1.0 - share) * known.psi**2 + share * found.psi**2)
            found = replace(known, psi=psi)
        self.noise = found

    def parameters(self, most: float = math.inf) -> ParameterSet | None:
        """The estimate with intervals and status; None before data.

        Args:
            most: d, J_zz and J_r whose 95 % interval is wider than this, relative, stay as uncertain as they were.
        """
        fused = self.fusion.estimate()
        if fused is None:
            return None
        theta, covariance = self._free.placed(self._initial, fused.z[:SIX]), fused.covariance[:SIX, :SIX].copy()
        vague, beyond = [i for i in _YAW if Z95 * fused.sigma[i] > most], self._slope_beyond_b
        theta[vague] = self._initial[vague]
        flat, zz = theta[[NOMINAL_NAMES.index("J_xx"), NOMINAL_NAMES.index("J_yy")]].sum(), NOMINAL_NAMES.index("J_zz")
        flat *= math.exp(beyond[0]) if beyond is not None else 1.0
        theta[zz] = min(theta[zz], flat) if zz in vague else theta[zz]
        covariance[vague, :] = covariance[:, vague] = 0.0
        covariance[vague, vague] = self._prior_sigma[vague] ** 2
        unc = Uncertainty(covariance, np.ones(SIX), self._prior_sigma)
        six = parameter_set(self._free, theta, self._initial, unc)
        return six if beyond is None else with_tangent(six, *beyond)

    def _beyond_b(self) -> FloatArray:
        """Thrust beyond b w^2: a row of values and one of their standard deviations, shape (2, R + 1).

        The value of a rotor is the logarithm of its thrust's change with speed at hover, with what thrust may have
        beside b, over that by the b that carries as much.  A thrust curve, a support force and an accelerometer of
        another scale give all rotors the same, a weak rotor itself.  The last value tells them apart: the thrust that
        there is where no rotor turns, over the weight.  A rotor's own curve has none there; what a support carries, or
        the bias that hides a wrong scale, is there.
        """
        fused, weight = self.fusion.estimate(wide=True), self.vehicle.mass * GRAVITY
        assert fused is not None
        places = [*range(SIX), *range(self._dead, len(fused.z))]
        curve, (dead, offset, *losses) = Curve(self.vehicle), self._thrust

        def value(changed: FloatArray) -> FloatArray:
            z, theta = fused.z.copy(), self._initial.copy()
            z[places] = changed
            theta[B], theta[dead.index], theta[offset.index] = curve.law(z)
            for entry, effect in zip(losses, changed[SIX + 2 :], strict=True):
                theta[entry.index] += effect * entry.typical
            full = ThrustModel(self._layout, theta)
            six = self._stated.with_b(full.like(self._stated, weight))
            own = np.log(np.maximum(full.slope(weight), 1e-12) / six.slope(weight))
            return np.append(own, (full.at_rest - six.at_rest) / weight)

        # Where it was linearised: a curve and a support are known well together, and badly by themselves.
        z, step = self._z[places], 1e-5
        here = value(z)
        slopes = np.array([(value(z + one) - here) / step for one in step * np.eye(len(z))])
        here += (fused.z[places] - z) @ slopes
        covariance = fused.covariance[np.ix_(places, places)]
        return np.stack([here, np.sqrt(np.einsum("pr,pq,qr->r", slopes, covariance, slopes))])

    def deviance(self, stretch: Stretch, known: OnlineSet | None) -> float:
        """Deviance of a set, or of the first guess, in a stretch, relative to how stretches scatter."""
        return stretch.deviance(self._scaled(known)) / self._scatter

    @property
    def _scatter(self) -> float:
        fused = self.fusion.estimate()
        return 1.0 if fused is None else self.fusion.scatter(fused.z[:SIX])

    def _scaled(self, known: OnlineSet | None) -> FloatArray:
        theta = self._initial.copy()
        for p in by_b(known.parameters) if known is not None else ():
            if p.name in NOMINAL_NAMES:
                place = self._layout.entry(p.name).index
                theta[place] = self.theta[place] if p.status is Status.PRIOR_DOMINATED else p.value
        return self._free.scaled(theta[self._free.index])

    def case(
        self, parameters: ParameterSet, request: FitRequest, reply: FitReply, sets: ActiveSet, windows: int
    ) -> Case:
        """The case for the gate, without what speaks against the sensors.

        Args:
            request: of the newest fit.
            sets: what was published before.
            windows: whose agreement is asked for.
        """
        most = max(windows, 3)
        agreeing, odd = self.fusion.agreement(most)
        disagreement = f"{NOMINAL_NAMES[odd[0]]} differs by {np.expm1(odd[1]):+.1%} in one of them" if odd else ""
        fused = self.fusion.estimate()
        assert fused is not None
        assert self.left_out is not None
        missed = zip(NOMINAL_NAMES, fused.between_rows[:SIX].tolist(), strict=True)
        return Case(
            parameters,
            reply.excited,
            self._thrust_ratio(request.windows),
            agreeing,
            disagreement,
            self._held_out(sets.in_force, sets.seen),
            sets.in_force,
            sets.baseline,
            sets.approval,
            self.fusion.counted - sets.seen,
            stated=self.stated,
            walked=self._walked(most),
            between_rows=dict(missed),
            left_out=self.left_out,
        )

    def scores(self) -> tuple[float, float]:
        """Mean squared innovation of the newest rows: as fitted, and by the six of data before the window, or NaN."""
        newest = self.fusion.newest
        if newest is None:
            return math.nan, math.nan
        earlier = self.fusion.before(newest.start)
        if earlier is None:
            return newest.mse, math.nan
        step = earlier - newest.z[:SIX]
        more = 2.0 * newest.score[:SIX] @ step + step @ newest.information[:SIX, :SIX] @ step
        return newest.mse, newest.mse + float(more) / max(newest.rows, 1.0)

    def _walked(self, most: int) -> dict[str, tuple[float, float]]:
        """Change of torque over inertia (log) from the oldest to the newest of the windows, and its deviation."""
        out = {}
        for name in ("J_xx", "J_yy"):
            share = np.zeros(SIX)
            share[B], share[NOMINAL_NAMES.index(name)] = 1.0, -1.0
            walked = self.fusion.walked(share, most)
            if walked is not None:
                out[name] = walked
        return out

    def _held_out(self, in_force: OnlineSet | None, seen: float) -> tuple[float, ...]:
        """Gain over the set in force in disjoint windows after `seen` [s], by estimates that had not seen them."""
        reference, scatter, out = self._scaled(in_force), self._scatter, []
        for stretch in self.fusion.disjoint(4):
            earlier = self.fusion.before(stretch.start)
            if earlier is not None and stretch.start >= seen - 1e-6:
                out.append((stretch.deviance(reference) - stretch.deviance(earlier)) / scatter)
        return tuple(out)

    def _thrust_ratio(self, windows: Sequence[Window]) -> float:
        """Thrust by the published numbers over what the accelerometer felt."""
        lift = [-w.accel[:, 2] for w in windows if w.accel is not None]
        felt = float(np.nanmean(np.concatenate(lift))) if lift else GRAVITY
        published = self.published
        total = float(np.mean(np.concatenate([published.total(w.rotor_speed) for w in windows])))
        return total / (self.vehicle.mass * max(felt, 1e-3))


def with_tangent(six: ParameterSet, share: float, sigma: float) -> ParameterSet:
    """The six and, beside b, the slope of thrust over speed: `share` (log) of that by b, known to `sigma`.

    The six are fitted with thrust b w^2, whose slope at hover is another: torque over inertia is right, and drag torque
    and inertias are those that go with the slope.
    """
    beside = replace(six["b"], name=TANGENT, measured_before=False)
    rows = [*range(len(six.parameters)), six.names.index("b")]
    both = ParameterSet((*six.parameters, beside), six.covariance[np.ix_(rows, rows)])
    return both.scaled_together(sigma, math.exp(share), ("b",))


def by_b(known: ParameterSet) -> tuple[Parameter, ...]:
    """Parameters with the values that thrust b w^2 would have them at, of a set that may state another slope."""
    steep = known["b"].value / known[TANGENT].value if TANGENT in known.names else 1.0
    guessed = Status.PRIOR_DOMINATED
    return tuple(p if p.status is guessed or p.name == "b" else replace(p, value=p.value * steep) for p in known)


def _joined(spans: Sequence[tuple[float, float]], enough: float = math.inf) -> list[tuple[float, float]]:
    """Begins and ends [s], joined where they touch until they are long enough [s]."""
    out: list[tuple[float, float]] = []
    for start, stop in spans:
        begin, end = out[-1] if out else (start, -math.inf)
        if start - end < _EPS and end - begin < enough - _EPS:
            out[-1] = begin, stop
        else:
            out.append((start, stop))
    return out


def _bytes(window: Window) -> bytes:
    parts = [np.array([window.t0, window.dt]).tobytes()]
    for name in ("rotor_speed", "gyro", "attitude", "accel", "velocity", "position"):
        values = getattr(window, name)
        parts.append(name.encode() if values is None else values.tobytes())
    return b"".join(parts)
