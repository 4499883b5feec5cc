"""The likelihood over several flights as a function of two vectors: physics in scaled parameters, and noise."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import NamedTuple, TypeVar

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.estimate import kalman as k
from quadid.estimate.kalman import Beyond, Gains, Track
from quadid.estimate.track import quantum, wavering
from quadid.estimate.whole_model import WholeModel
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.rotation import rotated
from quadid.types import BoolArray, FloatArray, IndexArray
from quadid.vehicle import GRAVITY, Vehicle

T = TypeVar("T")
AXES = ("x", "y", "z")
PLACES: dict[str, int] = {
    **{name: i for i, name in enumerate(NOMINAL_NAMES)},
    **{f"trim_moment.{a}": k.TRIM + i for i, a in enumerate(AXES)},
    **{f"gyro_bias.{a}": k.GYRO_BIAS + i for i, a in enumerate(AXES)},
    **{f"accel_bias.{a}": k.ACCEL_BIAS + i for i, a in enumerate(AXES)},
    **{f"rotor_drag.k_{a}": k.DRAG + i for i, a in enumerate("xy")},
    **{f"rotor_drag_moment.h_{a}": k.TILTING + i for i, a in enumerate("xy")},
    **{f"rate_damping.{a}": k.DAMP + i for i, a in enumerate(("l_p", "m_q", "n_r"))},
    **{f"cg_offset.{a}": k.CG + i for i, a in enumerate("xy")},
    "command_delay.delay": k.DELAY,
    "motor_lag.tau": k.LAG,
    "rotor_drag.central": k.CENTRAL,
    "no_gyroscopic_coupling.share": k.UNCOUPLED,
    "thrust_curve.dead_speed": k.DEAD,
    "thrust_curve.offset": k.OFFSET,
    "axial_inflow.k_z": k.INFLOW,
}
"""Entries of the physics vector by name: those that the filter has in its own equations."""
LATE = ("command_delay.delay", "motor_lag.tau")
"""Those that move what rotors make in time."""
PER_FLIGHT = ("trim_moment", "gyro_bias", "accel_bias")
"""Values that belong to a flight and not to the vehicle, beside effects that do."""
UPRIGHT = "accel_bias.z"
"""Told from thrust only where velocity is measured; without, it stays zero."""
TRIMMED = tuple(name for name in PLACES if name.split(".")[0] in PER_FLIGHT and name != UPRIGHT)
"""Parameters free in every model beside its own: a constant moment and the sensors' biases."""
_SIZE = {
    "gyro_bias": 0.05,
    "accel_bias": 0.5,
    "rotor_drag.k_x": 0.5,
    "rotor_drag.k_y": 0.5,
    "rate_damping": 2.0,
    "command_delay": 0.01,
    "motor_lag": 0.02,
}
"""Standard deviation of the prior, in the parameter's unit; about what is met on real vehicles."""
OFF_CENTRE = 0.05
"""The same of the centre of gravity, as a share of the arm; that of a trim moment is the control moment."""
FORCE = (0.1, 0.05)
"""Prior of the random specific force, horizontal and vertical, as a share of gravity …"""
MOMENT = 0.1
"""… and of the random angular acceleration, as a share of the control moment: more is large."""
TILT = 0.02
"""Prior of the attitude estimator's error [rad]."""
MEMORY, MEMORY_SPREAD = 0.3, 1.5
"""Prior of a correlation time [s] and the spread of its logarithm."""
SHORTEST, LONGEST = 3.0, 0.1
"""Correlation times that can be identified: from so many samples to such a share of the flight."""
WHITE = np.repeat([0.02, 0.003, 0.2, 0.05], 3)
"""First guess of the sensors' white noise."""
STRETCH, SETTLED, NUDGE = 200, 30, 1e-3
"""Rows that stand for a flight where only variances matter, those until they are stationary, and a small change."""
PAST = 3
"""Samples from which rotor moments are foreseen."""
WAVER = 0.005
"""Prior of the noise of logged rotor speeds, as a share of hover speed."""
ACTS = np.array(
    [
        [1.0, 0.0, 0.0, 0.0, 0.0, 0.0],
        [1.0, 0.0, -1.0, 0.0, 0.0, 0.0],
        [1.0, 0.0, 0.0, -1.0, 0.0, 0.0],
        [0.0, 1.0, 0.0, 0.0, -1.0, 0.0],
    ]
)
"""Powers of the six in what rotors make of specific thrust and of the angular accelerations."""
AT_ONCE = 16
"""Points whose effects are simulated together: more would only take more memory."""
SETTLING = 2
"""Times that weights of outliers are found anew by their readings."""
RECKONED = 6.0
"""Time [s] after which drag has shown the velocity that a flight began with."""
LEAST = 1e-2
"""Share of its prior below which a random force or a delay is none …"""
UNSEEN = 0.5
"""… and of the accelerometer's scatter: a simulator's may be a hundred times less than a vehicle's."""


def control_moment(tracks: Sequence[Track], p: FloatArray) -> FloatArray:
    """Standard deviation of the angular acceleration that the rotors ask for at physics p, shape (3,) [rad/s^2]."""
    moment = np.concatenate([k.moments(track, 0.0, 0.0, *k.turning(p)[2:])[:-1, :4] for track in tracks])
    arms = np.column_stack([-p[k.B] * moment[:, 2], p[k.B] * moment[:, 1], p[k.D] * moment[:, 3]])
    return np.asarray(np.std(arms / p[k.JX : k.JX + 3], axis=0) + 1e-3)


def _of_flight(name: str) -> bool:
    """Checks whether a value belongs to a flight."""
    effect = name.split(".")[0]
    return effect in PER_FLIGHT or (effect in EFFECTS and EFFECTS[effect].per_log)


def cut(track: Track, first: int, last: int) -> Track:
    """Rows `first` to before `last`, with rotor speeds from as long before and after: what is late moves them."""
    rows = slice(first, last)
    t, beyond = track.t[rows], Beyond(*(array[rows] for array in track.beyond))
    early, late = np.searchsorted(track.piece_t, [2.0 * t[0] - t[-1], 2.0 * t[-1] - t[0]], side="right")
    pieces = slice(max(early - 1, 0), late)
    return track._replace(
        t=t,
        y=track.y[rows],
        seen=track.seen[rows],
        weight=track.weight[rows],
        beyond=beyond,
        piece_t=track.piece_t[pieces],
        speed=track.speed[pieces],
    )


def _rows(track: Track, share: float) -> tuple[int, int]:
    """The stretch of a flight, as long as a share of its rows, with the largest rates."""
    n = len(track.t)
    rows = max(int(share * n), min(n, 2 * STRETCH))
    square = np.concatenate([[0.0], np.cumsum(np.sum(track.y[:, :3] ** 2, axis=1) * track.seen[:, 0])])
    first = int(np.argmax(square[rows:] - square[: n + 1 - rows]))
    return first, first + rows


def reckoned(track: Track, mean: FloatArray) -> FloatArray:
    """Filtered means (n, N_MEAN) whose velocity in the first seconds is reckoned back from after them.

    Where velocity is not measured, drag shows it after a while; until then a larger model would be linearised at
    velocities far off, and drag that grows with their square shows nothing at rest.
    """
    last = min(int(np.searchsorted(track.t, track.t[0] + RECKONED)), len(track.t) - 1)
    if track.seen[:, 3].any() or not track.seen[: last + 1, 2].all():
        return mean
    out, rows = mean.copy(), slice(0, last + 1)
    gained = rotated(mean[rows, :4], track.y[rows, 7:10]) + [0.0, 0.0, GRAVITY]
    steps = 0.5 * (gained[1:] + gained[:-1]) * np.diff(track.t[rows])[:, None]
    out[:last, 7:10] = mean[last, 7:10] - np.cumsum(steps[::-1], axis=0)[::-1]
    return out


def floor_of(tracks: Sequence[Track]) -> FloatArray:
    """Least white noise of every scalar measurement, shape (M,): the step of its numbers / sqrt 12."""
    columns = [0, 1, 2, 4, 5, 6, 7, 8, 9, 10, 11, 12]
    steps = [[quantum(t.y[t.seen[:, m // 3], column]) for t in tracks] for m, column in enumerate(columns)]
    return np.asarray(np.maximum(np.max(steps, axis=1), 1e-5))


def scatter_of(tracks: Sequence[Track]) -> float:
    """Scatter of accelerometer readings about their neighbours, of the quietest axis [m/s^2]; infinite without any."""
    bends = [np.diff(track.y[track.seen[:, 2], 7:10], 2, axis=0) for track in tracks]
    return min((float(np.sqrt(np.mean(b**2, axis=0) / 6.0).min()) for b in bends if len(b)), default=np.inf)


class Simulated(NamedTuple):
    """Effects and rotor moments along a flight: of physics alone, whatever the noise.

    Attributes:
        beyond: see `Track.beyond`.
        table: see `kalman.moments`.
    """

    beyond: Beyond
    table: FloatArray


class Sensitivities(NamedTuple):
    """Whitened innovations of a flight and their derivatives.

    Attributes:
        entries: by which.
        plain: whitened innovations, shape (n, M).
        J: their derivatives, shape (entries, n, M).
        root: root of the information of each that is expected with outliers, over that of a Gaussian, shape (n, M).
    """

    entries: list[int]
    plain: FloatArray
    J: FloatArray
    root: FloatArray

    def quadratic(self, rows: slice | BoolArray = slice(None)) -> tuple[FloatArray, FloatArray]:
        """Expected information (P, P) and half the gradient (P,) that some rows give, by the entries."""
        J, count = self.J[:, rows], len(self.J)
        gradient = J.reshape(count, -1) @ self.plain[rows].ravel()
        J = (J * self.root[rows]).reshape(count, -1)
        return J @ J.T, gradient


@dataclass(frozen=True)
class Problem:
    """Flights of one vehicle, and what of it is free.

    Attributes:
        tracks: the flights.
        vehicle: geometry, mass, guesses and bounds.
        names: free entries of `PLACES` and of `quadid.model.layout.Layout`; those of a flight once for each.
        base: physics vector of what is not free, shape (N_PHYSICS,).
        theta: full vector of what is not free.
        models: one a flight, where more acts or is free than the filter has of its own.
        paths: states along which these simulate effects, filtered means (n, N_MEAN) of each flight; see `along`.
        tail: 1 / degrees of freedom of the noise of gyro, attitude, accelerometer, velocity, shape (4,); 0: Gaussian.
        control: see `control_moment`; unit of what is random.
        borrowed: see `unbiased`, shape (4,).
    """

    tracks: tuple[Track, ...]
    vehicle: Vehicle
    names: tuple[str, ...]
    base: FloatArray
    theta: FloatArray
    models: tuple[WholeModel, ...]
    tail: FloatArray
    control: FloatArray
    paths: tuple[FloatArray, ...] = ()
    borrowed: FloatArray = field(default_factory=lambda: np.zeros(4))

    @classmethod
    def of(
        cls,
        tracks: Sequence[Track],
        vehicle: Vehicle,
        names: Sequence[str] = (),
        windows: Sequence[Window] = (),
        theta: FloatArray | None = None,
        nominal: Sequence[str] = NOMINAL_NAMES,
    ) -> Problem:
        """The six, trim moment, biases and `names` free, from the vehicle file's guess.

        Args:
            tracks: the flights.
            vehicle: geometry, mass, guesses and bounds.
            names: entries to free beside them.
            windows: of the same flights, row by row; without them `names` are of `PLACES`, effects left out.
            theta: full vector of what is not free; default that of the vehicle file.
            nominal: which of the six are free.
        """
        layout = Layout(vehicle)
        if theta is None:
            theta = layout.initial(vehicle) if windows else layout.neutral()
            theta[:6] = vehicle.initial
        upright = (UPRIGHT,) if any(t.seen[:, 3].any() for t in tracks) else ()
        return cls._beside(
            tracks, vehicle, theta, tuple(dict.fromkeys((*nominal, *TRIMMED, *upright, *names))), windows
        )

    @classmethod
    def fixed(
        cls, tracks: Sequence[Track], vehicle: Vehicle, theta: FloatArray, windows: Sequence[Window] = ()
    ) -> Problem:
        """Trim moment and biases free, beside a full parameter vector as given."""
        upright = (UPRIGHT,) if any(t.seen[:, 3].any() for t in tracks) else ()
        return cls._beside(tracks, vehicle, theta, (*TRIMMED, *upright), windows)

    @classmethod
    def _beside(
        cls,
        tracks: Sequence[Track],
        vehicle: Vehicle,
        theta: FloatArray,
        names: tuple[str, ...],
        windows: Sequence[Window],
    ) -> Problem:
        base, layout = np.zeros(k.N_PHYSICS), Layout(vehicle)
        # What the filter has in its own equations it also differentiates: drag tells it the velocity through the
        # accelerometer, which what is only added along its states cannot.
        for name, place in PLACES.items():
            if name in layout.entries:
                base[place] = theta[layout.entry(name).index]
        more = [e for e in layout.entries.values() if e.name not in PLACES]
        acts = not set(names) <= set(PLACES) or any(theta[e.index] != e.neutral for e in more)
        models = tuple(WholeModel(w, vehicle, PLACES) for w in windows) if acts else ()
        return cls(tuple(tracks), vehicle, names, base, theta, models, np.zeros(4), control_moment(tracks, base))

    def based_on(self, z: FloatArray) -> tuple[Problem, FloatArray]:
        """The problem whose control moment, and so its priors, is that at z instead of the guess; and z there."""
        base = self.physics(z, 0)
        new = replace(self._wavering(base), base=base, control=control_moment(self.tracks, base))
        return new, np.asarray(z * self.size / new.size)

    def liveliest(self, seconds: float) -> Problem:
        """The same flights, of each its share of `seconds` in which it turns most: to be near, before all of them."""
        total = sum(float(track.t[-1] - track.t[0]) for track in self.tracks)
        if total <= 1.2 * seconds:
            return self
        return self.cut([_rows(track, seconds / total) for track in self.tracks])

    def settled(self, seconds: float) -> Problem:
        """The same flights without their first `seconds`, a tenth at most: rotors behind a lag begin unknown."""
        rows = [(min(int(np.searchsorted(t.t, t.t[0] + seconds)), len(t.t) // 10), len(t.t)) for t in self.tracks]
        return self.cut(rows)

    def cut(self, rows: Sequence[tuple[int, int]]) -> Problem:
        """The same flights, of each the rows from a first one to before a last one."""
        tracks = tuple(cut(track, *span) for track, span in zip(self.tracks, rows, strict=True))
        models = tuple(model.cut(*span) for model, span in zip(self.models, rows, strict=True)) if self.models else ()
        paths = tuple(path[slice(*span)] for path, span in zip(self.paths, rows, strict=True)) if self.paths else ()
        return replace(self, tracks=tracks, models=models, paths=paths)

    @cached_property
    def layout(self) -> Layout:
        """Names and indices of the full vector."""
        return Layout(self.vehicle)

    @cached_property
    def entries(self) -> tuple[tuple[str, int, int], ...]:
        """Name, place, flight (-1: all) of every scaled parameter; from N_PHYSICS on places are those of `theta`."""
        places = [(n, PLACES[n] if n in PLACES else k.N_PHYSICS + self.layout.entry(n).index) for n in self.names]
        common = [(n, place, -1) for n, place in places if not _of_flight(n)]
        own = [(n, place, j) for j in range(len(self.tracks)) for n, place in places if _of_flight(n)]
        return tuple(common + own)

    @cached_property
    def keys(self) -> tuple[tuple[str, int], ...]:
        """Name and flight (-1: all) of every scaled parameter."""
        return tuple((name, flight) for name, _, flight in self.entries)

    @cached_property
    def size(self) -> FloatArray:
        """Unit of every scaled parameter and standard deviation of its prior; the six are logarithms, of unit 1."""
        out = np.ones(len(self.entries))
        own = _SIZE | {"cg_offset": OFF_CENTRE * self.vehicle.arm}
        own |= {f"trim_moment.{a}": float(size) for a, size in zip(AXES, self.control, strict=True)}
        for i, (name, place, _) in enumerate(self.entries):
            if place >= k.TRIM:
                size = own.get(name, own.get(name.split(".")[0])) if place < k.N_PHYSICS else None
                out[i] = self.layout.entry(name).typical if size is None else size
        return out

    @cached_property
    def limits(self) -> FloatArray:
        """Bounds of the scaled parameters, shape (2, P); effects that the filter has of its own are free but a lag."""
        out = np.tile([[-np.inf], [np.inf]], len(self.entries))
        for i, (name, place, _) in enumerate(self.entries):
            if place < k.TRIM:
                out[:, i] = np.log(self.vehicle.limits(name))
            elif place >= k.LAG:
                entry = self.layout.entry(name)
                out[:, i] = (np.array([entry.lower, entry.upper]) - entry.neutral) / self.size[i]
        return out

    @cached_property
    def prior(self) -> tuple[FloatArray, FloatArray]:
        """Mean and standard deviation of the scaled parameters."""
        mean, sigma = np.zeros(len(self.entries)), np.ones(len(self.entries))
        stand = self.vehicle.stand_thrust
        for i, (name, place, _) in enumerate(self.entries):
            if place < k.TRIM:
                known = self.vehicle.parameters[name]
                mean[i], sigma[i] = np.log(known.initial), known.log_sigma
                if name == "b" and stand is not None:
                    mean[i], sigma[i] = np.log(stand[0]), stand[1]
        return mean, sigma

    def physics(self, z: FloatArray, flight: int) -> FloatArray:
        """Physics vector of one flight at scaled parameters z."""
        p = self.base.copy()
        for (_, place, where), value, size in zip(self.entries, z, self.size, strict=True):
            if where in (-1, flight) and place < k.N_PHYSICS:
                p[place] = np.exp(value) if place < k.TRIM else value * size
        if "thrust_curve.dead_speed" in self.names and "thrust_curve.offset" not in self.names:
            # A curve of the rotors alone leaves the thrust at rest as it is.
            dead, offset = (self.theta[self.layout.entry(f"thrust_curve.{n}").index] for n in ("dead_speed", "offset"))
            p[k.OFFSET] = offset + p[k.B] * (min(dead, 0.0) ** 2 - min(p[k.DEAD], 0.0) ** 2)
        return p

    def vector(self, z: FloatArray, flight: int) -> FloatArray:
        """Full vector of one flight, without the biases; what the filter has of its own is in both else."""
        theta, p = self.theta.copy(), self.physics(z, flight)
        for name, place in PLACES.items():
            if name in self.layout.entries:
                entry = self.layout.entry(name)
                theta[entry.index] = entry.neutral if name.split(".")[0] in PER_FLIGHT else p[place]
        for (name, place, where), value, size in zip(self.entries, z, self.size, strict=True):
            if where in (-1, flight) and place >= k.N_PHYSICS:
                entry = self.layout.entry(name)
                theta[entry.index] = entry.neutral + value * size
        return theta

    def start(self) -> FloatArray:
        """Scaled parameters of the guess."""
        return self.prior[0].copy()

    def at(self, theta: FloatArray) -> FloatArray:
        """Scaled parameters of a full vector, with no trim moment and no biases."""
        z = self.start()
        for i, (name, place, _) in enumerate(self.entries):
            if place < k.TRIM:
                z[i] = np.log(theta[place])
            elif name in self.layout.entries and name.split(".")[0] not in PER_FLIGHT:
                entry = self.layout.entry(name)
                z[i] = (theta[entry.index] - entry.neutral) / self.size[i]
        return np.clip(z, *self.limits)

    def penalty(self, z: FloatArray) -> float:
        """-2 ln of the prior of the physics, tilted by what noise of the rotor speeds explains (`unbiased`)."""
        mean, sigma = self.prior
        return float(np.sum(((z - mean) / sigma) ** 2) - 2.0 * self.taken[0] @ z)

    def unbiased(self, z: FloatArray, psi: FloatArray, gains: Sequence[Gains]) -> Problem:
        """The problem whose objective has its minimum at the truth (if that is z) though logged rotor speeds are noisy.

        The same noise is in an innovation and in its derivative by the physics.  It makes the slope of the sum of
        squares, by every parameter, that of sum G' N G Q (`kalman.backward`) with N frozen; that slope is taken off, so
        that inertias are not too large (corrected score: Nakamura 1990, doi:10.1093/biomet/77.1.127).
        """
        found = [
            k.backward(t, self.physics(z, j), psi, g, False)[3]
            for j, (t, g) in enumerate(zip(self.tracks, gains, strict=True))
        ]
        return replace(self._wavering(self.physics(z, 0)), borrowed=np.sum(found, axis=0))

    def _wavering(self, p: FloatArray) -> Problem:
        """The problem whose rotor noise acts as at physics p; it does not change with the point that is tried."""
        new = wavering(self.vehicle, p[:6])
        return replace(self, tracks=tuple(t._replace(waver=new) for t in self.tracks))

    @cached_property
    def acting(self) -> FloatArray:
        """Derivative of the logarithm of what rotors make, thrust and angular accelerations, by z, shape (4, P).

        A higher dead speed makes thrust and its moments follow speeds less, drag torque as before.
        """
        speed = self.vehicle.hover_speed(float(self.base[k.B]))
        by = {**dict(enumerate(ACTS.T)), k.DEAD: np.array([-1.0, -1.0, -1.0, 0.0]) / speed}
        columns = zip(self.entries, self.size, strict=True)
        return np.column_stack([size * by.get(place, np.zeros(4)) for (_, place, _), size in columns])

    @cached_property
    def taken(self) -> tuple[FloatArray, FloatArray]:
        """Slope and curvature of half the objective that noise of rotor speeds adds, shapes (P,) and (P, P)."""
        return self.borrowed @ self.acting, (self.acting.T * self.borrowed) @ self.acting

    def within_a_step(self, z: FloatArray, gains: Sequence[Gains]) -> FloatArray:
        """Slope of half the objective if rotors answer random moments as soon as they act, by control axis, (3, P).

        How rotor moments answer an innovation of the gyro in the step after it is found by regression beside the past.
        Half as much is answered within the step by a loop faster than the log (a random walk's mean against its end),
        nothing by one as slow: the log does not tell which.
        """
        out = np.zeros((3, len(z)))
        for j, (track, g) in enumerate(zip(self.tracks, gains, strict=True)):
            p, h = self.physics(z, j), np.diff(track.t)
            half = 0.5 * (g.table[:, 1:4] + g.table[:, k.MOMENTS + 1 : k.MOMENTS + 4])
            a = half[:, [1, 0, 2]] * [-p[k.B] / p[k.JX], p[k.B] / p[k.JY], p[k.D] / p[k.JZ]]
            rows = np.arange(PAST, len(h))
            # The sample before is left out: its noise is in the innovation.
            past = [a[rows - lag] for lag in range(2, PAST + 1)] + [
                track.y[rows - lag, :3] for lag in range(1, PAST + 1)
            ]
            for i in range(3):
                seen = np.all(g.S[np.stack([rows - lag for lag in range(PAST + 1)]), i] > 0.0, axis=0)
                beside = np.column_stack([g.nu[rows, i], *past, np.ones(len(rows))])[seen]
                if len(beside) > 4 * beside.shape[1]:
                    answer = float(np.linalg.lstsq(beside, a[rows[seen], i], rcond=None)[0][0])
                    out[i] -= 0.5 * min(answer, 0.0) * float(np.sum(h[rows[seen]])) * self.acting[i + 1]
        return out

    @cached_property
    def noise_scale(self) -> FloatArray:
        """Prior size of f, alpha, e and of the noise of rotor speeds, shape (7,)."""
        tilt = float(np.sqrt(np.mean(self.control[:2] ** 2)))
        return np.array(
            [
                FORCE[0] * GRAVITY,
                FORCE[1] * GRAVITY,
                MOMENT * tilt,
                MOMENT * self.control[2],
                TILT,
                TILT,
                WAVER * self.vehicle.hover_speed(float(self.base[k.B])),
            ]
        )

    @cached_property
    def noise_bounds(self) -> FloatArray:
        """Bounds of the noise numbers, shape (N_NOISE, 2)."""
        out = np.empty((k.N_NOISE, 2))
        out[: k.M, 0], out[: k.M, 1] = floor_of(self.tracks), 100.0 * WHITE
        out[k.SIGMA : k.TIME, 0], out[k.SIGMA : k.TIME, 1] = LEAST * self.noise_scale, 100.0 * self.noise_scale
        force = slice(k.SIGMA, k.SIGMA + 2)
        out[force, 0] = np.minimum(out[force, 0], max(UNSEEN * scatter_of(self.tracks), out[k.ACCEL, 0]))
        out[k.ROTOR, 0] = max(out[k.ROTOR, 0], *(t.speed_noise[0] for t in self.tracks))
        out[k.ROTOR, 1] = max(out[k.ROTOR, 0], min(t.speed_noise[1] for t in self.tracks))
        step = max(float(np.median(np.diff(t.t))) for t in self.tracks)
        long = max(float(t.t[-1] - t.t[0]) for t in self.tracks)
        out[k.TIME :] = SHORTEST * step, max(LONGEST * long, 4.0 * SHORTEST * step)
        return out

    def first_noise(self) -> FloatArray:
        """Noise numbers where the search begins: random forces large, twice their prior."""
        out = np.concatenate([WHITE, 2.0 * self.noise_scale, np.full(5, MEMORY)])
        out[k.SIGMA + 4 : k.ROTOR] = 0.25 * TILT
        return np.asarray(np.clip(out, *self.noise_bounds.T))

    def noise_penalty(self, psi: FloatArray) -> tuple[float, FloatArray]:
        """-2 ln of the prior of the noise numbers, and its derivative by psi.

        Standard deviations have a squared Cauchy density, flat at zero and with a long tail.
        """
        slope = np.zeros(k.N_NOISE)
        share = psi[k.SIGMA : k.TIME] / self.noise_scale
        log = np.log(psi[k.TIME :] / MEMORY) / MEMORY_SPREAD
        slope[k.SIGMA : k.TIME] = 4.0 * share / (1.0 + share**2) / self.noise_scale
        slope[k.TIME :] = 2.0 * log / MEMORY_SPREAD / psi[k.TIME :]
        return float(2.0 * np.sum(np.log1p(share**2)) + np.sum(log**2)), slope

    def noise_curvature(self, psi: FloatArray) -> FloatArray:
        """Second derivative of that prior by the logarithms, without what is negative, shape (N_NOISE,)."""
        out = np.full(k.N_NOISE, 1e-6)
        square = (psi[k.SIGMA : k.TIME] / self.noise_scale) ** 2
        out[k.SIGMA : k.TIME] += 8.0 * square / (1.0 + square) ** 2
        out[k.TIME :] += 2.0 / MEMORY_SPREAD**2
        return out

    def objective(self, z: FloatArray, psi: FloatArray) -> float:
        """-2 ln of likelihood and prior; infinite where the filter has no finite step."""
        return self.passes(z, psi)[0]

    def passes(self, z: FloatArray, psi: FloatArray, there: Sequence[Simulated] = ()) -> tuple[float, list[Gains]]:
        """The same, and the gains of every flight; where a problem has `models`, after `along`.

        `there` is what an earlier pass at the same z simulated, if any.
        """
        found = _each(lambda j: self._pass(z, psi, j, there[j] if there else None), len(self.tracks))
        total = self.penalty(z) + self.noise_penalty(psi)[0] + sum(value for value, _ in found)
        return (total if np.isfinite(total) else np.inf), [g for _, g in found]

    def weighted(self, gains: Sequence[Gains]) -> Problem:
        """The problem with the weights that outliers have in a pass; the same where none are expected."""
        if not self.tail.any():
            return self
        return replace(self, tracks=tuple(t._replace(weight=g.w) for t, g in zip(self.tracks, gains, strict=True)))

    def reweighted(
        self, z: FloatArray, psi: FloatArray, gains: Sequence[Gains], noise: BoolArray
    ) -> tuple[Problem, FloatArray]:
        """The problem with weights of outliers renewed by a pass, and noise numbers for them.

        Weights and the variance of readings may grow by the same factor, which changes the price alone.  It is least
        where weights are 1 in the mean; steps there are those of parameter-expanded EM (Liu, Rubin & Wu 1998,
        doi:10.1093/biomet/85.4.755).

        Args:
            z: scaled parameters.
            psi: noise numbers.
            gains: of a pass there.
            noise: noise numbers that may change, shape (N_NOISE,).
        """
        if not self.tail.any():
            return self, psi
        weights = _each(lambda j: self._weights(j, z, psi, gains[j]), len(gains))
        seen = [measured(track, g) for track, g in zip(self.tracks, gains, strict=True)]
        count = sum(s.sum(axis=0) for s in seen)
        total = sum(np.sum(w * s, axis=0) for w, s in zip(weights, seen, strict=True))
        mean = np.divide(total, count, out=np.ones(k.M), where=count > 0)
        quieter = np.clip(psi[: k.M] / np.sqrt(mean), *self.noise_bounds[: k.M].T)
        moved = np.where(noise, np.append(quieter, psi[k.M :]), psi)
        factor = (moved[: k.M] / psi[: k.M]) ** 2
        weights = [np.where(s, w * factor, w) for w, s in zip(weights, seen, strict=True)]
        tracks = tuple(t._replace(weight=w) for t, w in zip(self.tracks, weights, strict=True))
        return replace(self, tracks=tracks), moved

    def _weights(self, j: int, z: FloatArray, psi: FloatArray, g: Gains) -> FloatArray:
        square, tail = k.backward(self.tracks[j], self.physics(z, j), psi, g, False)[4], np.repeat(self.tail, 3)
        return np.asarray((1.0 + tail) / (1.0 + tail * square))

    def along(self, z: FloatArray, psi: FloatArray, near: Sequence[Gains] = ()) -> Problem:
        """The problem whose effects are simulated along the states of a pass at this point.

        So the objective is one function of z and psi; where its minimum has other states, take those, and search again.

        Args:
            z: scaled parameters.
            psi: noise numbers.
            near: gains of a pass there, whose states are taken; else those that come of a few passes.
        """
        if not self.models:
            return self
        if not near:
            # First along states that follow the measurements: where random forces are small, those without effects run
            # away.  Then along their own.
            near = _each(
                lambda j: k.kalman(self.tracks[j], self.physics(z, j), self.first_noise())[1], len(self.tracks)
            )
            value, gains = self.along(z, psi, near).passes(z, psi)
            near = gains if np.isfinite(value) else near
        return replace(self, paths=tuple(reckoned(t, g.mean) for t, g in zip(self.tracks, near, strict=True)))

    def frozen(self, z: FloatArray) -> Problem:
        """The problem whose effects stay as simulated at z, but for their slope, unless one of them is free."""
        if not self.models or not set(self.names) <= set(PLACES):
            return self
        tracks = tuple(self._simulated(j, z) for j in range(len(self.tracks)))
        return replace(self, tracks=tracks, models=(), paths=())

    def _pass(self, z: FloatArray, psi: FloatArray, j: int, there: Simulated | None = None) -> tuple[float, Gains]:
        track, p = self.tracks[j], self.physics(z, j)
        if there is None:
            there = Simulated(
                self._simulated(j, z).beyond if self.models else track.beyond, k.moments(track, *k.turning(p))
            )
        track = track._replace(beyond=there.beyond)
        value, gains = k.kalman(track, p, psi, there.table)
        for _ in range(SETTLING if self.tail.any() and not len(track.weight) else 0):
            value, gains = k.kalman(track._replace(weight=self._weights(j, z, psi, gains)), p, psi, there.table)
        return float(value) + float(np.sum(self.price(gains))), gains

    def _simulated(self, j: int, z: FloatArray) -> Track:
        """Flight j with its effects simulated at z."""
        return self.tracks[j]._replace(beyond=self.models[j].along(self.vector(z, j), self.paths[j]))

    def price(self, g: Gains) -> FloatArray:
        """Price of the weights of outliers in -2 ln L, by measurement, shape (n, M)."""
        return np.asarray((g.w - 1.0 - np.log(g.w)) / np.repeat(np.where(self.tail > 0.0, self.tail, np.inf), 3))

    def score(self, z: FloatArray, psi: FloatArray, gains: Sequence[Gains]) -> FloatArray:
        """Derivative of the objective by the noise numbers."""
        parts = _each(
            lambda j: k.backward(self.tracks[j], self.physics(z, j), psi, gains[j], False)[0], len(self.tracks)
        )
        return np.asarray(np.sum(parts, axis=0) + self.noise_penalty(psi)[1])

    def noise_information(self, z: FloatArray, psi: FloatArray, gains: Sequence[Gains]) -> FloatArray:
        """Half the expected curvature of the objective by the logarithms of the noise numbers, (N_NOISE, N_NOISE).

        Information of Gaussian innovations, sum of (d ln S)(d ln S)' / 2 + (d nu)(d nu)' / S, by differences over a
        stretch from the middle of every flight, which stands for all of it.
        """
        out = np.zeros((k.N_NOISE, k.N_NOISE))
        for j, track in enumerate(self.tracks):
            n, rows = len(track.t), max(STRETCH // len(self.tracks), 4 * SETTLED)
            first = max((n - rows) // 2, 0)
            part = cut(track._replace(beyond=gains[j].beyond), first, first + rows)
            p, table = self.physics(z, j), gains[j].table[first : first + rows]

            def innovations(
                i: int, part: Track = part, p: FloatArray = p, table: FloatArray = table
            ) -> tuple[FloatArray, FloatArray]:
                moved = psi.copy()
                if i < k.N_NOISE:
                    moved[i] *= np.exp(NUDGE)
                g = k.kalman(part, p, moved, table)[1]
                S = np.where(g.S > 0.0, g.S, 1.0)
                return np.log(S)[SETTLED:].ravel(), g.nu[SETTLED:].ravel()

            *moved, (log_s, nu) = _each(innovations, k.N_NOISE + 1)
            by_s = np.array([(a - log_s) / NUDGE for a, _ in moved])
            by_nu = np.array([(b - nu) / NUDGE for _, b in moved]) * np.exp(-0.5 * log_s)
            share = n / max(len(part.t) - SETTLED, 1)
            out += share * (0.5 * by_s @ by_s.T + by_nu @ by_nu.T)
        return out

    def normal_equations(
        self, z: FloatArray, psi: FloatArray, gains: Sequence[Gains], nudge: float | FloatArray = 1e-5
    ) -> tuple[FloatArray, FloatArray]:
        """Information (P, P) and gradient (P,) of the likelihood in scaled parameters, gains frozen, prior included.

        Sensitivities are differences of innovations over `nudge`, one for all parameters or one each, shape (P,).  Of a
        model that runs away beside these gains they are not finite.
        """
        mean, sigma = self.prior
        information, gradient = np.diag(1.0 / sigma**2) - self.taken[1], (z - mean) / sigma**2 - self.taken[0]
        for j, g in enumerate(gains):
            mine, plain, J, root = self.sensitivities(j, z, psi, g, nudge)
            with np.errstate(over="ignore", invalid="ignore"):
                gradient[mine] += J.reshape(len(mine), -1) @ plain.ravel()
                J *= root
                information[np.ix_(mine, mine)] += J.reshape(len(mine), -1) @ J.reshape(len(mine), -1).T
        if not np.isfinite(information).all():
            return information, gradient
        # What noise of rotor speeds explains is no information, but there is never less than the prior's.
        own, turned = np.linalg.eigh(sigma[:, None] * information * sigma - np.eye(len(z)))
        turned = turned / sigma[:, None]
        return np.diag(1.0 / sigma**2) + (turned * np.maximum(own, 0.0)) @ turned.T, gradient

    def _expected(self, psi: FloatArray, g: Gains) -> FloatArray:
        """Root of the expected information with outliers over that of a Gaussian as wide, shape (n, M).

        Of noise alone with a Student-t density of k degrees of freedom it is 1 - 2 / (k + 3); where noise is a share s
        of the innovation's variance, 1 - 2 sqrt(s) / (k + 3) (integrated numerically: right to 2 %).
        """
        share = np.divide(psi[: k.M] ** 2, g.w * g.S, out=np.zeros_like(g.S), where=g.S > 0.0)
        lost = np.repeat(2.0 * self.tail / (1.0 + 3.0 * self.tail), 3)
        return np.asarray(np.sqrt(1.0 - lost * np.sqrt(np.minimum(share, 1.0))))

    def sensitivities(
        self,
        j: int,
        z: FloatArray,
        psi: FloatArray,
        g: Gains,
        nudge: float | FloatArray = 1e-5,
        only: Collection[int] | None = None,
    ) -> Sensitivities:
        """Whitened innovations of flight j and their derivatives, by `only` these of its entries; default all."""
        steps = np.diag(np.broadcast_to(nudge, len(z)))
        mine = [i for i, (_, _, where) in enumerate(self.entries) if where in (-1, j) and (only is None or i in only)]
        whitened = self._several(j, [z, *(z + steps[i] for i in mine)], psi, g)
        plain, J = whitened[0], whitened[1:]
        J -= plain
        J /= steps[mine, mine][:, None, None]
        return Sensitivities(mine, plain, J, self._expected(psi, g))

    def corner(
        self, z: FloatArray, psi: FloatArray, gains: Sequence[Gains]
    ) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Least and most step of the scaled parameters, bounds and none beyond a corner, and differences to take there.

        Rotor speeds that are held and measurements at the same times give a likelihood with a corner where nothing is
        late: it may rise to either side, and has the slope of the side that a step goes to.

        Args:
            z: scaled parameters.
            psi: noise numbers.
            gains: of a pass there.

        Returns:
            Least and most step, and `nudge` of `normal_equations`, shape (P,) each.
        """
        least, most, nudge = self.limits[0] - z, self.limits[1] - z, np.full(len(z), 1e-5)
        for i, (_, place, _) in enumerate(self.entries):
            if place == k.DELAY and z[i] == 0.0:
                early = late = 0.0  # how the objective rises to either side; a short lag makes the corner round
                for j, g in enumerate(gains):
                    step = LEAST * (np.arange(len(z)) == i)
                    plain, before, after = self._several(j, [z, z - step, z + step], psi, g)
                    early += float(np.sum(before**2 - plain**2))
                    late += float(np.sum(after**2 - plain**2))
                most[i] = most[i] if late < min(early, 0.0) else 0.0
                least[i] = least[i] if early < min(late, 0.0) else 0.0
                nudge[i] = -LEAST if least[i] < 0.0 else nudge[i]
            elif place == k.DELAY:
                least[i], most[i] = (-z[i], most[i]) if z[i] > 0.0 else (least[i], -z[i])
        return least, most, nudge

    def _several(self, j: int, points: Sequence[FloatArray], psi: FloatArray, g: Gains) -> FloatArray:
        """Whitened innovations of flight j, (points, n, M), near the point of the gains."""
        track = self.tracks[j]
        out = np.zeros((len(points), len(track.t), k.M))
        # Trim and biases change no effect: what is the same is simulated once.
        same = np.array([self.vector(z, j) for z in points]) if self.models else np.zeros((len(points), 1))
        kinds, which = np.unique(same, axis=0, return_inverse=True)
        for first in range(0, len(kinds), AT_ONCE):
            mine = np.flatnonzero((which.ravel() >= first) & (which.ravel() < first + AT_ONCE))
            tracks = [track] * len(mine)
            if self.models:
                path = self.paths[j]
                added = self.models[j].beyond(kinds[first : first + AT_ONCE], path)[which.ravel()[mine] - first]
                tracks = [track._replace(beyond=Beyond(a, g.beyond.slope, path[:, 4:10].copy())) for a in added]

            def whiten(i: int, mine: IndexArray = mine, tracks: Sequence[Track] = tracks) -> None:
                p = self.physics(points[mine[i]], j)
                k.replay(tracks[i], p, psi, g, moments_at(tracks[i], g, p), out[mine[i]])

            _each(whiten, len(mine))
        return out


def measured(track: Track, g: Gains) -> BoolArray:
    """Mask of innovations that are of measurements, shape (n, M): a velocity that nobody measured has only a prior."""
    out = g.S > 0.0
    out[:, k.VELOCITY :] &= track.seen[:, 3:]
    return np.asarray(out)


def simulated(gains: Sequence[Gains]) -> list[Simulated]:
    """Simulations of a pass, for another one at the same physics."""
    return [Simulated(g.beyond, g.table) for g in gains]


def moments_at(track: Track, g: Gains, p: FloatArray) -> FloatArray:
    """Rotor moments at physics p: those of the gains where nothing moved in time."""
    made_with = k.turning(p)
    return g.table if made_with == g.made_with else k.moments(track, *made_with)


_THREADS = ThreadPoolExecutor(max_workers=2, thread_name_prefix="filter")


def _each(function: Callable[[int], T], count: int) -> list[T]:
    """Calls a function of 0 to `count` - 1, several at a time; a filter that runs away is seen by its value."""

    def quiet(i: int) -> T:
        with np.errstate(over="ignore", invalid="ignore"):  # each thread has its own
            return function(i)

    return list(_THREADS.map(quiet, range(count))) if count > 1 else [quiet(0)]
