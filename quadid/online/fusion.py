"""Estimate of one vehicle while it flies: fusion of window estimates, requests for their fits, the case for the gate.

Every window gives a quadratic model of its cost around its estimate.  In scaled parameters z (logarithms of the nominal
six) that is a Fisher information matrix H and a vector h = H z - g; both add.  Windows overlap, so each counts with the
share of its time that no earlier window has counted.  Old information fades, and a window that contradicts it is seen.
"""

from __future__ import annotations

import hashlib
import math
from collections import Counter, deque
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.chi_square import Z95, exceeded
from quadid.data.window import Window
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Free
from quadid.identification.uncertainty import Uncertainty, parameter_set
from quadid.model.layout import LOSS, B, D, Layout, ThrustModel
from quadid.model.rollout import channels_of
from quadid.online.active_set import ActiveSet
from quadid.online.fit_job import FitReply, FitRequest, WindowEstimate, prior_of, with_room
from quadid.online.gate import Case
from quadid.online.grid_buffer import WindowCut
from quadid.online.records import OnlineSet
from quadid.parameters import NOMINAL_NAMES, TANGENT, ParameterSet, Status
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

DRIFT = 0.02
"""Parameters may honestly differ this much (log scale) from window to window: what no simulation of this kind has."""
SCATTER_PRIOR = 30.0
"""Degrees of freedom with which windows are believed to scatter as they claim."""
KEPT_WINDOWS = 120
"""Window estimates kept for agreement and held-out gain."""
YAW = ("d", "J_zz", "J_r")
"""Parameters that a set may leave at the vehicle file's guess."""
_YAW_PLACES = [NOMINAL_NAMES.index(n) for n in YAW]
ANY = 1.0
"""Difference (log scale) that is allowed where an estimate says nothing."""


@dataclass(frozen=True)
class Fused:
    """A fused estimate: scaled parameters and covariance (prior included), shapes (P,) and (P, P)."""

    z: FloatArray
    covariance: FloatArray

    @property
    def sigma(self) -> FloatArray:
        """Standard deviations, shape (P,)."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))


@dataclass(frozen=True)
class _Sum:
    """Accumulated information up to a time."""

    stop: float
    matrix: FloatArray
    vector: FloatArray


class Fusion:
    """Running estimate of one vehicle.

    Attributes:
        windows: estimates that were taken in, oldest first.
        counted: end of the data taken in [s].
        drift: honest difference between windows by parameter, log scale, shape (P,).
    """

    def __init__(self, mean: FloatArray, sigma: FloatArray, memory: float) -> None:
        """Starts from the prior.

        Args:
            mean: scaled parameters of the prior, shape (P,).
            sigma: its standard deviations, shape (P,).
            memory: time constant of forgetting [s] of data taken in.
        """
        self._mean, self._precision = mean, np.diag(1.0 / sigma**2)
        self._memory = memory
        self.drift: FloatArray = np.full(len(mean), DRIFT)
        self.windows: deque[WindowEstimate] = deque(maxlen=KEPT_WINDOWS)
        self._sums: deque[_Sum] = deque(maxlen=KEPT_WINDOWS)
        self.counted = -math.inf

    def forget(self) -> None:
        """Drops everything learned: the vehicle has changed."""
        self.windows.clear()
        self._sums.clear()

    def agrees(self, window: WindowEstimate) -> bool:
        """True if a window fits the estimate from data before it, where there is one (chi-square)."""
        earlier = self._before(window.start)
        if earlier is None:
            return True
        before = self._solve(earlier)
        distance = self._distance(window, before.z, before.covariance + np.diag(self.drift**2))
        return distance <= exceeded(1e-5, len(self._mean))  # less probable: a change, if the next window agrees

    def add(self, window: WindowEstimate) -> None:
        """Takes a window in, with the share of its time that is new."""
        fresh = window.stop - max(window.start, self.counted)
        share = min(max(fresh / (window.stop - window.start), 0.0), 1.0)
        size = len(self._mean)
        old = self._sums[-1] if self._sums else _Sum(-math.inf, np.zeros((size, size)), np.zeros(size))
        fade = math.exp(-max(fresh, 0.0) / self._memory) if math.isfinite(old.stop) else 0.0
        weight = share * window.scale
        matrix = fade * old.matrix + weight * window.information
        vector = fade * old.vector + weight * (window.information @ window.z - window.score)
        self._sums.append(_Sum(window.stop, matrix, vector))
        self.windows.append(window)
        self.counted = max(self.counted, window.stop)

    def estimate(self) -> Fused | None:
        """The fused estimate, its covariance widened where windows scatter more than they should; None before data."""
        if not self._sums:
            return None
        fused = self._solve(self._sums[-1])
        return Fused(fused.z, fused.covariance * self.scatter(fused.z))

    def before(self, start: float) -> FloatArray | None:
        """Scaled parameters from windows that ended by `start`; None when there are none."""
        earlier = self._before(start)
        return None if earlier is None else self._solve(earlier).z

    def disjoint(self, most: int = 12) -> list[WindowEstimate]:
        """Newest windows that share no sample, newest first."""
        out: list[WindowEstimate] = []
        for window in reversed(self.windows):
            if not out or window.stop <= out[-1].start + 1e-6:
                out.append(window)
                if len(out) == most:
                    break
        return out

    def scatter(self, z: FloatArray) -> float:
        """Variance of disjoint windows about `z` relative to what they claim, at least 1, shrunk towards 1."""
        windows = self.disjoint()
        if len(windows) < 3:
            return 1.0
        total = sum(self._distance(window, z, 0.0) for window in windows)
        freedom = len(z) * (len(windows) - 1)
        return max((total + SCATTER_PRIOR) / (freedom + SCATTER_PRIOR), 1.0)

    def _distance(self, window: WindowEstimate, z: FloatArray, covariance: FloatArray | float) -> float:
        """Squared Mahalanobis distance of a window's own estimate from `z`, which has a covariance too."""
        own = self._alone(window)
        difference = own.z - z
        return float(difference @ np.linalg.solve(own.covariance + covariance, difference))

    def left_out(self) -> FloatArray | None:
        """Mean `WindowEstimate.left_out` of disjoint windows, widened where they scatter, shape (2, R + 1)."""
        told = np.array([w.left_out for w in self.disjoint()])
        if not len(told):
            return None
        weight = 1.0 / told[:, 1] ** 2
        mean = np.sum(weight * told[:, 0], axis=0) / weight.sum(axis=0)
        scatter = np.sum(weight * (told[:, 0] - mean) ** 2, axis=0) / max(len(told) - 1, 1)
        return np.stack([mean, np.sqrt(np.maximum(scatter, 1.0) / weight.sum(axis=0))])

    def agreement(self, most: int) -> tuple[int, tuple[int, float] | None]:
        """Number of the newest disjoint windows that agree in a row with the fused estimate, `most` at most.

        And of the first that does not: which parameter is farthest off, and by how much, log scale.
        """
        fused = self.estimate()
        windows = self.disjoint(most) if fused is not None else []
        limit = exceeded(1e-3, len(self._mean))
        for agreeing, window in enumerate(windows):
            if fused is not None and self._distance(window, fused.z, np.diag(self.drift**2)) > limit:
                spread = np.sqrt(np.maximum(np.diag(np.linalg.pinv(window.information)), 1e-12) + self.drift**2)
                away = window.z - fused.z
                farthest = int(np.argmax(np.abs(away) / spread))
                return agreeing, (farthest, float(away[farthest]))
        return len(windows), None

    def walked(self, share: FloatArray, most: int) -> tuple[float, float] | None:
        """Change of a sum of parameters from the oldest to the newest of disjoint windows, and its deviation.

        Args:
            share: of each parameter in the sum, shape (P,).
            most: windows at most; None where there are fewer than two.
        """
        windows = self.disjoint(most)
        if len(windows) < 2:
            return None
        newest, oldest = self._alone(windows[0]), self._alone(windows[-1])
        variance = share @ (newest.covariance + oldest.covariance) @ share
        return float(share @ (newest.z - oldest.z)), math.sqrt(variance)

    def _before(self, start: float) -> _Sum | None:
        return next((s for s in reversed(self._sums) if s.stop <= start + 1e-6), None)

    def _alone(self, window: WindowEstimate) -> Fused:
        """Estimate of a window by itself and the prior."""
        matrix = window.scale * window.information
        vector = window.scale * (window.information @ window.z - window.score)
        return self._solve(_Sum(window.stop, matrix, vector))

    def _solve(self, total: _Sum) -> Fused:
        matrix = total.matrix + self._precision
        z = np.linalg.solve(matrix, total.vector + self._precision @ self._mean)
        return Fused(np.asarray(z), np.asarray(np.linalg.inv(matrix)))


# --- Estimate of one vehicle: requests fits, fuses their replies, and states the case for the gate


class Estimator:
    """Estimate of one vehicle.

    Attributes:
        vehicle: of the vehicle file.
        model: the same, with room for its bare guesses once effects are fitted along; windows are fitted with it.
        flexible: every effect that moves the vehicle is fitted along, as the vehicle file's model misses the flight.
        fusion: the fused windows.
        misfit: residual variance of gyro and accelerometer over that of their own noise, shape (6,); NaN: not measured.
        theta: full parameter vector, the best at hand.
        noises: pooled sensor noise by number of residual channels, as velocity and position come and go in flight.
        learned: whether `theta` rests on data.
        excitation: of the newest window, shape (6,); NaN before.
        start: first time of the data learned from [s]; NaN before.
        rows: grid rows learned from.
        input_hash: SHA-256 over seed and windows learned from.
    """

    def __init__(self, vehicle: Vehicle, memory: float, seed: int) -> None:
        """Starts from the vehicle file."""
        self.vehicle, self._memory, self._seed = vehicle, memory, seed
        self.excitation = np.full(len(NOMINAL_NAMES), np.nan)
        self._hash = hashlib.sha256(f"quadid {vehicle.to_yaml()} {seed}".encode()).digest()
        self.reset()

    def reset(self) -> None:
        """Begins as from the vehicle file: nothing that was learned is kept, not even the noise."""
        self._begin(self.vehicle, flexible=False)

    def fit_along(self) -> None:
        """Later windows are fitted with every effect that moves the vehicle; what was learned is forgotten."""
        self._begin(with_room(self.vehicle), flexible=True)

    def _begin(self, model: Vehicle, flexible: bool) -> None:
        self.model, self.flexible = model, flexible
        self._layout = Layout(model)
        self._initial = self._layout.initial(model)
        self._free = Free(tuple(self._layout.entry(n) for n in NOMINAL_NAMES))
        prior = prior_of(model)
        self._prior_sigma = prior.sigma
        self.fusion = Fusion(np.log(prior.mean), prior.sigma, self._memory)
        self.noises: dict[int, NoiseModel] = {}
        self._pooled: Counter[int] = Counter()
        self.theta = self._initial
        self.misfit = np.full(6, np.nan)
        self.forget()

    @property
    def _scatter(self) -> float:
        fused = self.fusion.estimate()
        return 1.0 if fused is None else self.fusion.scatter(fused.z)

    @property
    def _yaw_missed(self) -> bool:
        # Residuals twice the sensors' noise outweigh the small couplings that yaw parameters rest on.
        return self.flexible or bool(self.misfit.max() > 2.0)

    @property
    def thrust(self) -> ThrustModel:
        """Thrust of the rotors, by the best estimate at hand."""
        return ThrustModel(self._layout, self.theta)

    @property
    def published(self) -> ThrustModel:
        """Thrust by what is published and the vehicle file's own effects: what who uses a set has."""
        fused, beyond = self.fusion.estimate(), self._slope_beyond_b
        model = ThrustModel.stated(self.vehicle)
        if fused is None:
            return model
        model = model.with_b(math.exp(fused.z[B]))
        return model if beyond is None else model.with_tangent(math.exp(beyond[0]), self.vehicle.mass * GRAVITY)

    @property
    def _slope_beyond_b(self) -> tuple[float, float] | None:
        """Change of thrust with speed at hover over that by b (log), mean of the rotors, and its standard deviation.

        None while no effects are fitted along.
        """
        left_out = self.fusion.left_out() if self.flexible else None
        return None if left_out is None else (float(left_out[0, :-1].mean()), float(left_out[1, :-1].mean()))

    @property
    def input_hash(self) -> str:
        """SHA-256 (hex) over vehicle, seed and all windows learned from."""
        return self._hash.hex()

    @property
    def z_sigma(self) -> FloatArray:
        """Standard deviations of the nominal six, log scale; the prior's before anything was learned."""
        fused = self.fusion.estimate()
        return self._prior_sigma if fused is None else fused.sigma

    @property
    def torque_sigma(self) -> FloatArray:
        """Standard deviations of log(b / J_xx) and log(b / J_yy)."""
        return np.asarray(np.hypot(self.z_sigma[0], self.z_sigma[2:4]))

    @property
    def stated(self) -> dict[str, tuple[float, float]]:
        """Value and standard deviation of the parameters that the vehicle file claims to know."""
        return {n: (p.initial, p.sigma) for n, p in self.vehicle.parameters.items() if p.sigma}

    def value(self, name: str) -> float:
        """A nominal parameter, the best at hand."""
        return float(self.theta[NOMINAL_NAMES.index(name)])

    def start_from(self, known: OnlineSet) -> None:
        """Starts the search from a restored set instead of the vehicle file's guess."""
        for p in known.parameters:
            if p.name in NOMINAL_NAMES:
                self.theta = self.theta.copy()
                self.theta[self._layout.entry(p.name).index] = min(max(p.value, p.bounds[0]), p.bounds[1])

    def forget(self) -> None:
        """The vehicle has changed: what was learned no longer holds; the next fit searches globally."""
        self.fusion.forget()
        self.start, self.rows, self._search, self.learned = math.nan, 0, True, False

    def request(self, number: int, cut: WindowCut, start: float, stop: float) -> FitRequest:
        """The fit of a window."""
        # Every fifth window measures the sensor noise anew.
        measure = len(self.fusion.windows) % 5 == 0
        return FitRequest(
            number, self.model, cut.windows, start, stop, self.theta, self.noise_of(cut.windows), self._search,
            self._seed, measure, self.flexible, cut.spacing,
        )  # fmt: skip

    def noise_of(self, windows: Sequence[Window]) -> NoiseModel | None:
        """Sensor noise of the channels that these windows have; None where no such window was fitted yet."""
        return self.noises.get(min(map(channels_of, windows), default=0))

    def take(self, request: FitRequest, reply: FitReply) -> None:
        """Fuses a reply, where it holds an estimate."""
        if reply.excitation is not None:
            self.excitation = reply.excitation
        if reply.estimate is None or reply.theta is None:
            return
        self._pool_noise(reply)
        if reply.misfit is not None:
            self.misfit = reply.misfit
        self.fusion.drift[_YAW_PLACES] = ANY if self._yaw_missed else DRIFT
        for window in request.windows:
            self._hash = hashlib.sha256(self._hash + _bytes(window)).digest()
            self.start = window.t0 if math.isnan(self.start) else self.start
        new = reply.estimate.stop - max(self.fusion.counted, reply.estimate.start)
        self.rows += round(max(new, 0.0) / request.windows[0].dt)
        self.fusion.add(reply.estimate)
        self._search = False
        fused = self.fusion.estimate()
        assert fused is not None
        best = reply.theta if reply.excited or not self.learned else self.theta
        self.theta, self.learned = self._free.placed(best, fused.z), True
        # Windows tell the b of the vehicle file's model; the curve and the losses that are fitted along have their own.
        self.theta[B] = self.published.like(ThrustModel(self._layout, self.theta), self.vehicle.mass * GRAVITY)
        # Thrust knows b and the losses by their products only: the mean of the losses is the vehicle file's.
        losses = slice(LOSS, LOSS + self._layout.rotors)
        share = float(np.mean(1.0 - self.theta[losses]) / np.mean(1.0 - self._initial[losses]))
        self.theta[losses] = 1.0 - (1.0 - self.theta[losses]) / share
        self.theta[[B, D]] *= share

    def _pool_noise(self, reply: FitReply) -> None:
        if reply.noise is None:
            return
        channels = len(reply.noise.white)
        known = self.noises.get(channels)
        if known is None or self._search or not np.array_equal(reply.noise.white, known.white):
            self.noises[channels], self._pooled[channels] = reply.noise, 1  # the first, or the fit had to find it anew
            return
        if reply.measured is None:
            return
        # The newest of 24 windows counts fully.
        self._pooled[channels] = min(self._pooled[channels] + 1, 24)
        share = 1.0 / self._pooled[channels]
        white, slow = (
            np.sqrt((1.0 - share) * old**2 + share * new**2)
            for old, new in ((known.white, reply.measured.white), (known.slow, reply.measured.slow))
        )
        self.noises[channels] = NoiseModel(white, slow, known.slow_time)

    def parameters(self) -> ParameterSet | None:
        """The fused estimate with intervals and status; None before data."""
        fused = self.fusion.estimate()
        if fused is None:
            return None
        theta = self._free.placed(self._initial, fused.z)
        covariance = fused.covariance
        if self._yaw_missed:
            theta, covariance = self._without_yaw(theta, covariance)
        unc = Uncertainty(covariance, np.ones(len(fused.z)), self._prior_sigma)
        six = parameter_set(self._free, theta, self._initial, unc)
        beyond = self._slope_beyond_b
        return six if beyond is None else with_tangent(six, *beyond)

    def _without_yaw(self, theta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The estimate with what couples into yaw alone as uncertain as before the flight, where the model misses it.

        Roll and pitch rest on torque over inertia; d, J_zz and J_r on small couplings, which what is missed outweighs.
        Where every effect is fitted along, the coupling itself is free, and yaw knows their ratios only.
        """
        theta, covariance, place = theta.copy(), covariance.copy(), _YAW_PLACES
        theta[place] = self.vehicle.initial[place]
        flat = theta[NOMINAL_NAMES.index("J_xx")] + theta[NOMINAL_NAMES.index("J_yy")]
        theta[NOMINAL_NAMES.index("J_zz")] = min(theta[NOMINAL_NAMES.index("J_zz")], flat)
        covariance[place, :] = covariance[:, place] = 0.0
        covariance[place, place] = self._prior_sigma[place] ** 2
        return theta, covariance

    def deviance(self, window: WindowEstimate, known: OnlineSet | None) -> float:
        """Deviance of a set, or of the first guess, in a window, relative to how windows scatter."""
        return window.deviance(self._z(known)) / self._scatter

    def _z(self, known: OnlineSet | None) -> FloatArray:
        theta = self._initial.copy()
        for p in known.parameters if known is not None else ():
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
        missed = () if reply.between_rows is None else zip(NOMINAL_NAMES, reply.between_rows.tolist(), strict=True)
        left_out = self.fusion.left_out()
        assert left_out is not None
        return Case(
            parameters, reply.excited, self._thrust_ratio(request.windows), agreeing, disagreement,
            self._held_out(sets.in_force, sets.seen), sets.in_force, sets.baseline, sets.approval,
            self.fusion.counted - sets.seen, stated=self.stated, walked=self._walked(most), between_rows=dict(missed),
            left_out=left_out,
        )  # fmt: skip

    def scores(self) -> tuple[float, float]:
        """Mean squared residual of the newest window: fitted, and under an estimate that had not seen it, or NaN."""
        if not self.fusion.windows:
            return math.nan, math.nan
        newest = self.fusion.windows[-1]
        earlier = self.fusion.before(newest.start)
        if earlier is None:
            return newest.mse, math.nan
        return newest.mse, newest.mse + newest.deviance(earlier) / newest.scale / max(newest.rows, 1.0)

    def _walked(self, most: int) -> dict[str, tuple[float, float]]:
        """Change of torque over inertia (log) from the oldest to the newest of the windows, and its deviation."""
        out = {}
        for name in ("J_xx", "J_yy"):
            share = np.zeros(len(NOMINAL_NAMES))
            share[B], share[NOMINAL_NAMES.index(name)] = 1.0, -1.0
            walked = self.fusion.walked(share, most)
            if walked is not None:
                out[name] = walked
        return out

    def _held_out(self, in_force: OnlineSet | None, seen: float) -> tuple[float, ...]:
        """Gain over the set in force in disjoint windows after `seen` [s], by estimates that had not seen them."""
        reference, scatter, out = self._z(in_force), self._scatter, []
        for window in self.fusion.disjoint(4):
            earlier = self.fusion.before(window.start)
            if earlier is not None and window.start >= seen - 1e-6:
                if self._yaw_missed:
                    earlier[_YAW_PLACES] = reference[_YAW_PLACES]
                out.append((window.deviance(reference) - window.deviance(earlier)) / scatter)
        return tuple(out)

    def _thrust_ratio(self, windows: Sequence[Window]) -> float:
        """Thrust by the published numbers over what the accelerometer felt."""
        lift = [-w.accel[:, 2] for w in windows if w.accel is not None]
        felt = float(np.nanmean(np.concatenate(lift))) if lift else GRAVITY
        published = self.published
        total = float(np.mean(np.concatenate([published.total(w.rotor_speed) for w in windows])))
        return total / (self.vehicle.mass * max(felt, 1e-3))


def with_tangent(six: ParameterSet, share: float, sigma: float) -> ParameterSet:
    """The six and, beside b, the slope of thrust over speed: `share` (log) of that by b, known to `sigma`."""
    b = six["b"]
    value, both = b.value * math.exp(share), math.hypot(b.sigma / b.value, sigma)
    low, high = (value * math.exp(z * both) for z in (-Z95, Z95))
    new = replace(b, name=TANGENT, value=value, sigma=value * both, ci95=(low, high), measured_before=False)
    spread = np.zeros((len(six.parameters) + 1,) * 2)
    spread[:-1, :-1] = six.covariance
    spread[-1, :-1] = spread[:-1, -1] = six.covariance[six.names.index("b")] * value / b.value
    spread[-1, -1] = new.sigma**2
    return ParameterSet((*six.parameters, new), spread)


def _bytes(window: Window) -> bytes:
    parts = [np.array([window.t0, window.dt]).tobytes()]
    for name in ("rotor_speed", "gyro", "attitude", "accel", "velocity", "position"):
        values = getattr(window, name)
        parts.append(name.encode() if values is None else values.tobytes())
    return b"".join(parts)
