"""The estimate of one vehicle while it flies: requests fits, fuses their replies, and states the case for the gate."""

from __future__ import annotations

import hashlib
import math
from collections import Counter
from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Free
from quadid.identification.uncertainty import Uncertainty, parameter_set
from quadid.model.layout import LOSS, B, D, Layout, ThrustModel
from quadid.model.rollout import channels_of
from quadid.online.active_set import ActiveSet
from quadid.online.flexible_fit import with_room
from quadid.online.fusion import DRIFT, Fusion, WindowEstimate
from quadid.online.gate import Case
from quadid.online.grid_buffer import WindowCut
from quadid.online.records import OnlineSet
from quadid.online.window_fit import FitReply, FitRequest, prior_of
from quadid.parameters import NOMINAL_NAMES, ParameterSet, Status
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

HELD_OUT_WINDOWS = 4
"""Newest windows without a common sample in which sets are compared."""
NOISE_EVERY = 5
"""Every so many windows the sensor noise is measured anew, and pooled."""
NOISE_POOL = 24
"""Windows whose noise is pooled, newest counting fully."""
YAW_MISFIT = 2.0
"""Residual variance over sensor noise beyond which the small couplings that yaw parameters rest on are outweighed."""
YAW = ("d", "J_zz", "J_r")
"""Parameters that a set may leave at the vehicle file's guess."""
_YAW_PLACES = [NOMINAL_NAMES.index(n) for n in YAW]
ANY = 1.0
"""Difference (log scale) that is allowed where an estimate says nothing."""


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
        return self.flexible or bool(self.misfit.max() > YAW_MISFIT)

    @property
    def thrust(self) -> ThrustModel:
        """Thrust of the rotors, by the best estimate at hand."""
        return ThrustModel(self._layout, self.theta)

    @property
    def published(self) -> ThrustModel:
        """Thrust by the b that is published and the vehicle file's own effects: what who uses the six has."""
        fused = self.fusion.estimate()
        stated = ThrustModel.stated(self.vehicle)
        return stated if fused is None else stated.with_b(math.exp(fused.z[B]))

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
        measure = len(self.fusion.windows) % NOISE_EVERY == 0
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
        self._pooled[channels] = min(self._pooled[channels] + 1, NOISE_POOL)
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
        return parameter_set(self._free, theta, self._initial, unc)

    def _without_yaw(self, theta: FloatArray, covariance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What couples into yaw alone is as uncertain as before the flight where the model misses it.

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
        """What the gate needs to know about the present estimate; what speaks against the sensors is not in it.

        Args:
            parameters: the estimate.
            request: of the newest fit.
            reply: its answer.
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
        for window in self.fusion.disjoint(HELD_OUT_WINDOWS):
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


def _bytes(window: Window) -> bytes:
    parts = [np.array([window.t0, window.dt]).tobytes()]
    for name in ("rotor_speed", "gyro", "attitude", "accel", "velocity", "position"):
        values = getattr(window, name)
        parts.append(name.encode() if values is None else values.tobytes())
    return b"".join(parts)
