"""Predictions with bands: what the filter expects of measurements that are withheld from it, beside what they were.

The filter runs along a flight.  From many rows on it is shown nothing for a while but the rotor speeds, then one
measurement; its innovation is the error of a prediction from the filtered state, and the innovation's covariance, of
state, random forces and sensor alike, the prediction's band.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from quadid.attitude_controller import pack_gains, stabilise_rows
from quadid.blas import one_thread
from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.errors import NotIdentifiableError
from quadid.estimate import kalman as k
from quadid.estimate.fit import ALL_NOISE, MOST, NEAR_SECONDS, NO_NOISE, scoring
from quadid.estimate.kalman import Gains, Track
from quadid.estimate.missing import TRIMMING, settled
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.identification.controller_gains import Autopilot
from quadid.model.layout import Layout
from quadid.model.step import Simulator
from quadid.rotation import exponential, product, turn
from quadid.types import FloatArray, IndexArray
from quadid.vehicle import RandomForces, RandomInput, ResidualTerm, Vehicle, mixer_matrix

BANDS: Mapping[str, float] = {"50": 0.67449, "80": 1.28155, "95": Z95}
"""Half-widths of the bands in standard deviations, by per cent."""
LEARNING = 1.0 / 3.0
"""Share of a flight, its first, from which noise, trim and biases are learnt; what comes after it is predicted."""
SHORTEST = 3.0
"""Shortest stretch of flight that has such a share and something after it [s]."""
PHASES = 6
"""Passes that begin their predictions at different rows."""
RECOVERY = 2
"""Times the horizon for which the filter sees everything before the next prediction."""
STARTS, DRAWS = 40, 100
"""Rows of a flight from which it is simulated with the autopilot in the loop, and draws from each."""
_GROUPS = {"velocity": (3, k.VE), "rotation": (1, k.TH), "rate": (0, k.OM)}
"""Group of measurements, and state, of what is predicted."""

Shares = dict[int, dict[str, FloatArray]]


class Forecast:
    """Predictions of one flight: noise, trim and biases from its first part, bands on what comes after."""

    @one_thread()
    def __init__(
        self, windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, random: RandomForces | None
    ) -> None:
        """Learns from the first part.

        Args:
            windows: of one flight.
            vehicle: geometry and mass.
            theta: full parameter vector.
            random: the random forces of the vehicle; None: estimated from the first part, too.

        Raises:
            NotIdentifiableError: no stretch is long enough, or the filter has no finite answer.
        """
        flown = [w for w in windows if len(w) * w.dt >= SHORTEST and w.gyro is not None]
        if not flown:
            raise NotIdentifiableError("no stretch of flight to learn noise from", f"{SHORTEST:g} s with gyro, no gap")
        self.vehicle, self.theta, self.windows = vehicle, theta, flown
        self.first = [round(LEARNING * len(w)) for w in flown]
        # 1. Noise, trim and biases from the first part.
        heads = [w.slice(0, n) for w, n in zip(flown, self.first, strict=True)]
        problem, z = settled(heads, vehicle, theta, None)
        psi, free = problem.first_noise(), ALL_NOISE.copy()
        if random is not None:
            for numbers, at in zip(random.numbers, (k.SIGMA, k.TIME), strict=True):
                psi[at : at + 4], free[at : at + 4] = numbers, False
            psi = np.clip(psi, *problem.noise_bounds.T)
        z, psi, *_ = scoring(problem.liveliest(NEAR_SECONDS), z, psi, MOST, free)
        z, _, value, *_ = scoring(problem, z, psi, TRIMMING, NO_NOISE)
        if not np.isfinite(value):
            raise NotIdentifiableError("the filter has no finite answer on this flight", "a model that follows it")
        # 2. The whole flight; predictions begin after that part.
        tracks = [from_window(w, vehicle, air=t.still > 0.0) for w, t in zip(flown, problem.tracks, strict=True)]
        self.z, self.psi = z, psi
        whole = Problem.fixed(tracks, vehicle, theta, flown)
        self.problem = replace(whole, control=problem.control, tail=problem.tail).along(z, psi)

    def covered(self, samples: Sequence[int]) -> Shares:
        """Numbers of outcomes inside the bands predicted from the filtered state and the logged rotor speeds.

        Args:
            samples: of the grid after the filtered state.

        Returns:
            By horizon and quantity: outcomes inside each of `BANDS`, and all of them, shape (4,).
        """
        out = _none(samples)
        for j, (track, begin) in enumerate(zip(self.problem.tracks, self.first, strict=True)):
            for h in samples:
                for phase in range(PHASES):
                    _add(out[h], self.problem, track, self.problem.physics(self.z, j), self.psi, begin, h, phase)
        return out

    def covered_in_loop(self, samples: Sequence[int], autopilot: Autopilot, seed: int = 0) -> Shares:
        """The same with the autopilot in the loop: simulated draws of state and random forces, steered by references.

        Args:
            samples: of the grid after the filtered state.
            autopilot: the stabiliser; windows without references are passed over.
            seed: of the draws.
        """
        out = _none(samples)
        _, gains = self.problem.passes(self.z, self.psi)
        for j, (window, g) in enumerate(zip(self.windows, gains, strict=True)):
            if window.attitude_reference is None or not np.isfinite(window.attitude_reference).all():
                continue
            last = len(window) - max(samples) - 1
            if last < self.first[j]:
                continue
            rows = np.unique(np.linspace(self.first[j], last, STARTS).astype(int))
            p = self.problem.physics(self.z, j)
            at = np.searchsorted(self.problem.tracks[j].t, window.t[rows] - 0.5 * window.dt)
            own = g._replace(mean=g.mean[at], P=g.P[at], S=g.S[at])
            drawn = _flown_in_loop(
                self.vehicle, self.theta, window, p, self.psi, own, rows, samples, autopilot, seed + j
            )
            for h, states in drawn.items():
                _count(out[h], window, p, self.psi, rows + h, states)
        return out


def _none(samples: Sequence[int]) -> Shares:
    return {h: {name: np.zeros(len(BANDS) + 1) for name in _GROUPS} for h in samples}


def _flown_in_loop(
    vehicle: Vehicle,
    theta: FloatArray,
    window: Window,
    p: FloatArray,
    psi: FloatArray,
    g: Gains,
    rows: IndexArray,
    samples: Sequence[int],
    autopilot: Autopilot,
    seed: int,
) -> dict[int, FloatArray]:
    """States (starts, draws, 13) of simulated draws from some rows on, by horizon.

    States are attitude, rate, velocity and position; `g` has a row for each of `rows`.
    """
    rng, many = np.random.default_rng(seed), len(rows) * DRAWS
    start = np.repeat(g.mean, DRAWS, axis=0)
    # 1. Draws of the filtered state: what a measurement leaves of attitude, rate and velocity; random forces jointly.
    measured = np.where(g.S > 0.0, g.S, np.inf)  # without a measurement nothing is drawn
    spread = np.sqrt(np.maximum((1.0 - psi[: k.M] ** 2 / measured) * psi[: k.M] ** 2 * np.isfinite(measured), 0.0))
    motion = np.repeat(spread, DRAWS, axis=0) * rng.standard_normal((many, k.M))
    inputs = start[:, k.FO + 1 : k.AE + 1].copy()
    for i, covariance in enumerate(g.P[:, k.FO : k.AE, :6]):
        inputs[i * DRAWS : (i + 1) * DRAWS] += rng.multivariate_normal(
            np.zeros(6), 0.5 * (covariance + covariance.T), DRAWS, method="eigh"
        )
    # 2. The vehicle with this flight's trim, its rotors and its stabiliser as they are there.
    moments = p[k.TRIM : k.TRIM + 3] * p[k.JX : k.JX + 3]
    trim = tuple(ResidualTerm(acts_on=f"moment_{a}", value=float(m)) for a, m in zip("xyz", moments, strict=True))
    four = [RandomInput(sigma=float(psi[k.SIGMA + i]), time=float(psi[k.TIME + i])) for i in range(4)]
    random = RandomForces(horizontal=four[0], vertical=four[1], roll_pitch=four[2], yaw=four[3])
    own = vehicle.model_copy(update={"residual": (*vehicle.residual, *trim)})
    layout = Layout(own)
    point = layout.initial(own)
    point[: len(theta)] = theta
    span = window.dt * len(window)
    simulator = Simulator(own, np.repeat(point[None], many, axis=0), random=random, seed=seed, span=span)
    turns = 1 if autopilot.rate is None else max(round(autopilot.rate * window.dt), 1)
    step = window.dt / turns
    state = simulator.start(
        attitude=product(start[:, :4], exponential(motion[:, k.ATTITUDE : k.ATTITUDE + 3])),
        rate=start[:, 4:7] + motion[:, k.GYRO : k.GYRO + 3],
        velocity=start[:, 7:10] + motion[:, k.VELOCITY :],
        rotor_speed=np.repeat(window.rotor_speed[rows], DRAWS, axis=0),
        inputs=inputs,
        dt=step,
    )
    gains, mixer = pack_gains(autopilot.gains), mixer_matrix(vehicle, autopilot.gains)
    integral = np.repeat(_integrals_at(vehicle, window, autopilot, rows), DRAWS, axis=0)
    command, lasting = np.empty((many, len(vehicle.rotors))), np.full(many, step)
    bias, noise = p[k.GYRO_BIAS : k.GYRO_BIAS + 3], psi[k.GYRO : k.GYRO + 3]
    # 3. Fly.
    out = {}
    assert window.attitude_reference is not None
    for h in range(max(samples)):
        reference = np.repeat(window.attitude_reference[rows + h], DRAWS, axis=0)
        for _ in range(turns):
            rate = state.rate + bias + noise * rng.standard_normal((many, 3))
            stabilise_rows(gains, mixer, reference, state.attitude, rate, lasting, integral, command)
            simulator.advance(state, command, step)
        if h + 1 in samples:
            flown = np.column_stack([state.attitude, state.rate, state.velocity, state.position])
            out[h + 1] = flown.reshape(len(rows), DRAWS, 13)
    return out


def _integrals_at(vehicle: Vehicle, window: Window, autopilot: Autopilot, rows: IndexArray) -> FloatArray:
    """Integral torques of the stabiliser [N m] at some rows, by what it commanded there, shape (rows, 3)."""
    seen = (window.attitude_reference, window.attitude, window.gyro)
    reference, attitude, rate = (np.ascontiguousarray(v[rows]) for v in seen if v is not None)
    free = dict(autopilot.gains) | {f"{axis}_rate_i": 0.0 for axis in ("roll", "pitch", "yaw")}
    gains, mixer = pack_gains(free), mixer_matrix(vehicle, free)
    command, some = np.empty((len(rows), len(vehicle.rotors))), np.zeros((len(rows), 3))
    stabilise_rows(gains, mixer, reference, attitude, rate, np.full(len(rows), window.dt), some, command)
    beyond = window.rotor_speed[rows] ** 2 - command**2
    scale = [free["thrust_coefficient"], free["thrust_coefficient"], free["drag_coefficient"]]
    return np.asarray(np.nan_to_num(beyond) @ vehicle.torque_arms * scale)


def _count(
    out: dict[str, FloatArray], window: Window, p: FloatArray, psi: FloatArray, rows: IndexArray, states: FloatArray
) -> None:
    """Adds the outcomes at `rows` beside the draws of `states` (rows, draws, 13)."""
    centre = states[:, 0, :4]
    around = np.broadcast_to(centre[:, None], (*states.shape[:2], 4))
    turned = turn(around.reshape(-1, 4), states[..., :4].reshape(-1, 4)).reshape(*states.shape[:2], 3)
    slow = psi[k.SIGMA + 4 + np.array([0, 0, 1])]
    gyro = None if window.gyro is None else window.gyro[rows] - p[k.GYRO_BIAS : k.GYRO_BIAS + 3]
    attitude = None if window.attitude is None else turn(centre, window.attitude[rows])
    velocity = None if window.velocity is None else window.velocity[rows]
    for name, drawn, values, noise in (
        ("rate", states[..., 4:7], gyro, psi[k.GYRO : k.GYRO + 3]),
        ("rotation", turned, attitude, np.hypot(psi[k.ATTITUDE : k.ATTITUDE + 3], slow)),
        ("velocity", states[..., 7:10], velocity, psi[k.VELOCITY : k.VELOCITY + 3]),
    ):
        if values is None:
            continue
        error = (values - drawn.mean(axis=1)) / np.hypot(drawn.std(axis=1, ddof=1), noise)
        out[name] += _inside(error[np.isfinite(values)])


def _inside(error: FloatArray) -> FloatArray:
    """Numbers of errors, in standard deviations, inside each of `BANDS`, and how many there are, shape (4,)."""
    return np.array([*(np.count_nonzero(np.abs(error) <= b) for b in BANDS.values()), error.size], dtype=np.float64)


def _add(
    out: dict[str, FloatArray],
    problem: Problem,
    track: Track,
    p: FloatArray,
    psi: FloatArray,
    begin: int,
    h: int,
    phase: int,
) -> None:
    """Adds the predictions of one pass, `h` rows from every start on; starts take turns between the quantities."""
    period = h + max(RECOVERY * h, 5)
    starts = np.arange(begin + phase * period // PHASES, len(track.t) - h, period)
    step = float(np.median(np.diff(track.t)))
    even = np.abs(track.t[starts + h] - track.t[starts] - h * step) < 0.5 * step
    seen, turns = track.seen.copy(), (np.arange(len(starts)) + phase) % len(_GROUPS)
    seen[(starts[:, None] + np.arange(1, h + 1)).ravel()] = False
    asked: dict[str, IndexArray] = {}
    for i, (name, (group, _)) in enumerate(_GROUPS.items()):
        rows = (starts + h)[(turns == i) & even]
        asked[name] = rows[track.seen[rows, group]]
        seen[asked[name], group] = True
    _, gains = k.kalman(track._replace(seen=seen), p, psi, problem.tail, True)
    for name, rows in asked.items():
        out[name] += _inside(_errors(gains, rows, *_GROUPS[name]))


def _errors(g: Gains, rows: IndexArray, group: int, state: int) -> FloatArray:
    """Errors of three measurements that alone were seen, each over its own standard deviation, shape (rows, 3).

    The filter takes them one after the other; what the earlier ones told of the later is put back.
    """
    nu, S = (values[rows, 3 * group : 3 * group + 3] for values in (g.nu, g.S))
    K = g.gain[rows, 3 * group : 3 * group + 3]
    told = K[:, :, state : state + 3] + (K[:, :, k.AE : k.AE + 3] if state == k.TH else 0.0)  # of each, by each
    error, variance = nu.copy(), S.copy()
    for m in range(1, 3):
        error[:, m] += np.sum(told[:, :m, m] * nu[:, :m], axis=1)
        variance[:, m] += np.sum(told[:, :m, m] ** 2 * S[:, :m], axis=1)
    return np.asarray(error / np.sqrt(variance))
