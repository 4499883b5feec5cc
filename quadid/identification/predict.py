"""Prediction by the simulation alone: open-loop runs, each from a measured state, driven by the logged rotor speeds.

Every sample starts one run.  Rotor speeds are held over each sample; runs never cross a gap.  Rates are compared as the
gyro would read them: bias, scale and misalignment of the model are taken off the measured rate at the start and put on
the predicted one; a delay of the attitude likewise.  Errors are Euclidean for vectors and the angle of the relative
rotation (q and -q alike), as in the IDSIA nano-drone benchmark.
"""

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral

import numpy as np

from quadid.attitude_controller import pack_gains, stabilise_rows
from quadid.blas import one_thread
from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.errors import NotIdentifiableError, ParameterError
from quadid.estimate import kalman as k
from quadid.estimate.fit import ALL_NOISE, MOST, NEAR_SECONDS, NO_NOISE, scoring
from quadid.estimate.kalman import Gains, Track
from quadid.estimate.missing import TRIMMING, settled
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.identification.controller_gains import Autopilot
from quadid.identification.elimination import retract
from quadid.identification.problem import RAN_AWAY
from quadid.model import layout as ix
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments
from quadid.model.simd import LANES, N_STATE
from quadid.model.step import Simulator
from quadid.rotation import exponential, product, turn
from quadid.types import BoolArray, FloatArray, IndexArray
from quadid.vehicle import GRAVITY, RandomForces, RandomInput, ResidualTerm, Vehicle, mixer_matrix

# --- Runs


QUANTITIES: dict[str, str] = {"position": "m", "velocity": "m/s", "rotation": "rad", "rate": "rad/s"}
"""Predicted quantities, with units."""
_PLACES = (12, 9, 3, 0)
"""First of the three residual channels of each quantity."""
_CHUNK = 256
"""Runs rolled at once; keeps the residuals of a chunk in cache."""


class OpenLoop:
    """Runs of one window, from every row with a measured rate.

    Attributes:
        window: the data.
        padded: the data with one row more, which the simulation rolls into and nothing is compared with.
        known: rows at which each channel was measured.
        longest: samples of a run.
        rows: where runs start, shape (starts,).
    """

    def __init__(self, window: Window, vehicle: Vehicle, longest: int) -> None:
        """Finds the starts; raises WindowError when rotor columns do not match the vehicle."""
        self.window, self.longest = window, longest
        self.known, self.padded = _finite(window), _padded(window)
        self._rollout = Rollout(self.padded, vehicle)
        self.rows = np.flatnonzero(self.known["gyro"][: max(len(window) - longest, 0)])

    def counted(self, rows: IndexArray, at: IndexArray) -> BoolArray:
        """Mask of the quantities of runs from `rows` that count `at` samples after the start, shape (rows, at, 4).

        A quantity counts where it was measured at the target and the start was known well enough: a velocity needs
        attitude and velocity at the start, a position its own start too.
        """
        attitude = self.known["attitude"][rows]
        velocity = attitude & self.known["velocity"][rows]
        position = velocity & self.known["position"][rows]
        starts = (position, velocity, attitude, self.known["gyro"][rows])
        valid, target = self._rollout.valid, rows[:, None] + at
        out = np.zeros((*target.shape, 4), dtype=bool)
        for i, (place, started) in enumerate(zip(_PLACES, starts, strict=True)):
            if place < valid.shape[1]:
                out[..., i] = valid[:, place][target] & started[:, None]
        return out

    def parts(self, theta: FloatArray, at: IndexArray) -> Iterator[tuple[IndexArray, FloatArray]]:
        """Yields rows of starts and what runs from them miss by, in turns.

        Args:
            theta: full parameter vectors, shape (vectors, size); all runs start at the rates that the first derives
                from the gyro.
            at: samples after the start, 1 to `longest`.

        Yields:
            Rows, and predicted - measured of each quantity, shape (vectors, rows, at, 4, 3).  A rotation is its axis
            times twice the sine of half its angle.  What is not measured is NaN, what ran away infinite.
        """
        states = initial_states(self.window, theta[0], self.known)
        step = max(_CHUNK // len(theta), LANES)
        for first in range(0, len(self.rows), step):
            rows = self.rows[first : first + step]
            segments = Segments(self.longest, 1, (rows + 1).astype(np.int64))
            blocks = self._rollout.roll(segments, theta, np.ascontiguousarray(states[rows]))[0]
            residual = np.moveaxis(blocks, 4, 1).reshape(-1, *blocks.shape[1:4])[: len(theta)]
            # Channels that the log lacks hold zeros, which do not count.
            residual = np.pad(residual[:, :, at - 1], ((0, 0), (0, 0), (0, 0), (0, 15 - residual.shape[-1])))
            found = np.stack([residual[..., place : place + 3] for place in _PLACES], axis=3)
            ran = np.where(np.abs(found) < RAN_AWAY, found, np.inf)  # a comparison with NaN is false, too
            yield rows, np.where(self.counted(rows, at)[..., None], ran, np.nan)

    def misses(self, theta: FloatArray, at: IndexArray) -> FloatArray:
        """Errors of all runs, shape (vectors, starts, at, 4, 3); see `parts`."""
        none = np.full((len(theta), 0, len(at), 4, 3), np.nan)
        return np.concatenate([none, *(misses for _, misses in self.parts(theta, at))], axis=1)

    def no_change(self, at: IndexArray) -> FloatArray:
        """Errors of predicting that nothing changes, shape (starts, at, 4); NaN for what is not measured."""
        target = self.rows[:, None] + at
        out = np.full((*target.shape, 4), np.nan)
        w = self.window
        for i, values in ((0, w.position), (1, w.velocity), (3, w.gyro)):
            if values is not None:
                out[..., i] = np.linalg.norm(values[target] - values[self.rows][:, None], axis=2)
        if w.attitude is not None:
            cosine = np.abs(np.sum(w.attitude[target] * w.attitude[self.rows][:, None], axis=2))
            out[..., 2] = 2.0 * np.arccos(np.minimum(cosine, 1.0))
        return np.where(self.counted(self.rows, at), out, np.nan)


def lengths(misses: FloatArray) -> FloatArray:
    """Errors (..., 4) out of misses (..., 4, 3): Euclidean, the rotation's as its angle."""
    out: FloatArray = np.linalg.norm(misses, axis=-1)
    half = 0.5 * out[..., 2]
    out[..., 2] = np.where(np.isinf(half), np.inf, 2.0 * np.arcsin(np.minimum(half, 1.0)))
    return out


def no_change(windows: Sequence[Window], vehicle: Vehicle, samples: int) -> dict[str, float]:
    """Mean error of predicting that nothing changes for `samples`, by quantity; NaN for what the logs lack.

    Args:
        windows: of one or more files, on one grid.
        vehicle: geometry and mass.
        samples: after the start.
    """
    at = np.array([samples])
    errors = [OpenLoop(w, vehicle, samples).no_change(at)[:, 0] for w in windows]
    rows = np.concatenate([np.zeros((0, 4)), *errors])
    known = ~np.isnan(rows)
    total, count = np.where(known, rows, 0.0).sum(axis=0), known.sum(axis=0)
    mean = np.divide(total, count, out=np.full(4, np.nan), where=count > 0)
    return dict(zip(QUANTITIES, mean.tolist(), strict=True))


def _padded(window: Window) -> Window:
    """The window as held, with one row more."""

    def extended(values: FloatArray | None, fill: float | None = np.nan) -> FloatArray | None:
        if values is None:
            return None
        last = values[-1:] if fill is None else np.full_like(values[-1:], fill)
        return np.concatenate([values, last])

    rotor = extended(window.rotor_speed, None)
    assert rotor is not None
    return replace(
        window,
        rotor_speed=rotor,
        rotor_slope=None,
        gyro=extended(window.gyro),
        attitude=extended(window.attitude),
        accel=None,
        velocity=extended(window.velocity),
        position=extended(window.position),
        battery=extended(window.battery, None),
        attitude_reference=None,
        sampling="held",
    )


def _finite(window: Window) -> dict[str, BoolArray]:
    """Rows at which each channel was measured."""
    out = {}
    for name in ("gyro", "attitude", "velocity", "position"):
        values = getattr(window, name)
        out[name] = np.zeros(len(window), dtype=bool) if values is None else np.isfinite(values).all(axis=1)
    return out


def initial_states(window: Window, theta: FloatArray, known: dict[str, BoolArray]) -> FloatArray:
    """Measured state of every row, shape (rows, 13): attitude, rate, velocity, position; level, at rest if unknown.

    The model's gyro and its scale of the velocity are undone; an attitude that is late by it is turned on by the rate.
    """
    x = np.zeros((len(window), N_STATE))
    x[:, 0] = 1.0
    for name, place in (("attitude", 0), ("velocity", 7), ("position", 10)):
        values = getattr(window, name)
        if values is not None:
            x[known[name], place : place + values.shape[1]] = values[known[name]]
    x[:, 7:10] /= 1.0 + theta[[ix.VEL_SCALE, ix.VEL_SCALE, ix.VEL_SCALE_Z]]
    if window.gyro is not None:
        x[known["gyro"], 4:7] = true_rate(window.gyro[known["gyro"]], theta)
        delay = float(theta[ix.ATT_DELAY])
        if delay:
            late = known["gyro"] & known["attitude"]
            x[late] = retract(x[late], delay * _rate_before(x, known["gyro"], late, 0.5 * delay / window.dt))
    return x


def _rate_before(x: FloatArray, known: BoolArray, rows: BoolArray, samples: float) -> FloatArray:
    """Rates `samples` before some rows, between two measured ones; where one of those is missing, the row's own."""
    at = np.maximum(np.flatnonzero(rows) - samples, 0.0)
    first = at.astype(int)
    second = np.minimum(first + 1, len(x) - 1)
    share = (at - first)[:, None]
    between = (1.0 - share) * x[first, 4:7] + share * x[second, 4:7]
    return np.where((known[first] & known[second])[:, None], between, x[rows, 4:7])


def true_rate(measured: FloatArray, theta: FloatArray) -> FloatArray:
    """Undoes the model's gyro: measured = (1 + s) exp([m]x) rate + bias, element by element in s; shapes (n, 3)."""
    m = theta[[ix.MAX_, ix.MAY, ix.MAZ]]
    cross = np.array([[0.0, -m[2], m[1]], [m[2], 0.0, -m[0]], [-m[1], m[0], 0.0]])
    mounting = np.eye(3) + cross + 0.5 * cross @ cross  # to second order, as the kernel has it
    sensor = (measured - theta[[ix.GBX, ix.GBY, ix.GBZ]]) / (1.0 + theta[[ix.GSX, ix.GSY, ix.GSZ]])
    return np.asarray(np.linalg.solve(mounting, sensor.T).T)


# --- Scores: errors by samples after the start


HORIZONS = (1, 10, 50)
SUM_TO = 50
"""The summed score adds the mean errors of the first fifty samples."""
LONGEST = 2000
SHARE = 0.9
"""Of the runs whose errors lie within the stated spread, as many above as below it."""


@dataclass(frozen=True)
class HorizonScore:
    """Pooled errors of all starts.

    Attributes:
        samples: number of starts.
        mean: mean error by sample after the start, shape (longest, 4), columns as `QUANTITIES`; row h - 1 is h samples
            on; NaN for what the log lacks.
        horizons: those asked for.
        spread: errors between which `SHARE` of the runs lie, shape (horizons, 2, 4); NaN for what the log lacks.
    """

    samples: int
    mean: FloatArray
    horizons: tuple[int, ...]
    spread: FloatArray

    def at(self, horizon: int) -> dict[str, float]:
        """Mean error after `horizon` samples by quantity; NaN for what the log lacks."""
        return dict(zip(QUANTITIES, self.mean[horizon - 1].tolist(), strict=True))

    def between(self, horizon: int) -> dict[str, list[float]]:
        """Errors after `horizon` samples, one of those asked for, between which `SHARE` of the runs lie."""
        ends = self.spread[self.horizons.index(horizon)].T
        return dict(zip(QUANTITIES, ends.tolist(), strict=True))

    @property
    def sum(self) -> dict[str, float]:
        """Sum of the mean errors after 1, 2, … `SUM_TO` samples, by quantity."""
        return dict(zip(QUANTITIES, self.mean[:SUM_TO].sum(axis=0).tolist(), strict=True))


def horizon_scores(
    files: Sequence[Sequence[Window]], vehicle: Vehicle, theta: FloatArray, horizons: Sequence[int] = HORIZONS
) -> tuple[HorizonScore, list[HorizonScore]]:
    """Scores `theta` on several files.

    Args:
        files: windows of each file, on the file's grid.
        vehicle: geometry and mass.
        theta: full parameter vector, shape (size,); see `Layout.initial` for that of a vehicle file.
        horizons: samples after the start, 1 to `LONGEST`.

    Returns:
        The score pooled over all starts, and that of each file (with no samples where no run fits).

    Raises:
        ParameterError: impossible horizons.
        NotIdentifiableError: no run fits into any file, or there is no gyro.
    """
    wanted = _checked(horizons)
    longest = max(*wanted, SUM_TO)
    tallies = [_tally(windows, vehicle, theta, longest, np.array(wanted) - 1) for windows in files]
    pooled, runs = np.sum([sums for sums, _ in tallies], axis=0), np.concatenate([runs for _, runs in tallies])
    if len(runs) == 0:
        raise NotIdentifiableError(
            f"no run of {longest} samples fits: measured rate, and no gap for {longest} samples after it",
            f"stretches longer than {longest} samples with gyro",
            "log without gaps, or ask for a lower --rate",
        )
    return _score(pooled, runs, wanted), [_score(*tally, wanted) for tally in tallies]


def _checked(horizons: Sequence[int]) -> tuple[int, ...]:
    """The horizons, each once; raises ParameterError for what is none."""
    wanted = tuple(dict.fromkeys(horizons))
    if not wanted or not all(isinstance(h, Integral) and 1 <= h <= LONGEST for h in wanted):
        raise ParameterError(f"horizons {list(horizons)}", f"whole numbers of samples from 1 to {LONGEST}")
    return wanted


def start_errors(windows: Sequence[Window], vehicle: Vehicle, horizons: Sequence[int]) -> list[FloatArray]:
    """Errors of every run, for pairs of models from the same starts.

    Args:
        windows: of one file.
        vehicle: its values, effects included, are taken as they are.
        horizons: samples after the start, 1 to `LONGEST`.

    Returns:
        Of each window, shape (starts, horizons, 4), columns as `QUANTITIES`; NaN for what was not measured.

    Raises:
        ParameterError: impossible horizons.
    """
    wanted = _checked(horizons)
    theta = Layout(vehicle).initial(vehicle)[None]
    return [lengths(OpenLoop(w, vehicle, max(wanted)).misses(theta, np.array(wanted))[0]) for w in windows]


def _score(sums: FloatArray, runs: FloatArray, horizons: tuple[int, ...]) -> HorizonScore:
    total, count = sums
    mean = np.divide(total, count, out=np.full_like(total, np.nan), where=count > 0)
    # Runs in order of their errors, those that do not count last; the two whose ranks are the ends of the spread.
    ordered, known = np.sort(runs, axis=0), np.count_nonzero(~np.isnan(runs), axis=0)
    ranks = np.array([0.5 - 0.5 * SHARE, 0.5 + 0.5 * SHARE])[:, None, None] * np.maximum(known - 1, 0)
    spread = np.full((2, len(horizons), 4), np.nan)
    if len(runs):
        spread = np.take_along_axis(ordered, np.rint(ranks).astype(int), axis=0)
    mean.setflags(write=False)
    return HorizonScore(len(runs), mean, horizons, np.moveaxis(spread, 0, 1))


def _tally(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, longest: int, kept: IndexArray
) -> tuple[FloatArray, FloatArray]:
    """Summed errors of all runs and their counts, shape (2, longest, 4); those after `kept`, (runs, kept, 4)."""
    sums, runs, at = np.zeros((2, longest, 4)), [np.zeros((0, len(kept), 4))], 1 + np.arange(longest)
    for window in windows:
        for _, misses in OpenLoop(window, vehicle, longest).parts(theta[None], at):
            errors = lengths(misses[0])
            known = ~np.isnan(errors)
            sums += np.where(known, errors, 0.0).sum(axis=0), known.sum(axis=0)
            runs.append(errors[:, kept])
    return sums, np.concatenate(runs)


# --- The least error that a prediction from a measured state can have: what sensor noise alone makes of a perfect
# model
#
# A run starts from a measured attitude, rate, velocity and position, each with its noise, and is compared with measured
# ones.  Over a time T an error of the rate grows into one of the attitude (T), a tilt error accelerates the vehicle
# sideways (g T), and so on; damping is left out, so that at long horizons the floor is rather too high than too low.


ORDER = 4
"""Differences of this order leave white noise and take smooth motion away."""
MEAN_LENGTH = math.sqrt(8.0 / math.pi)
"""Mean length of a vector of three Gaussian components over their standard deviation."""


def prediction_floor(windows: Sequence[Window], samples: int) -> dict[str, float]:
    """Mean error `samples` after the start that sensor noise alone makes, by quantity; NaN for what the logs lack.

    Args:
        windows: of one or more files, on one grid.
        samples: after the start.
    """
    sigma = {name: white_noise([_vectors(w, name) for w in windows]) for name in QUANTITIES}
    t = samples * windows[0].dt
    position, velocity, rotation, rate = (sigma[name] for name in QUANTITIES)
    sideways = 2.0 / 3.0  # of three components two feel a tilt
    from_tilt, from_rate = GRAVITY * t * rotation, GRAVITY * t**2 * rate / 2.0
    grown = {
        "rate": 2.0 * rate**2,
        "rotation": 2.0 * rotation**2 + (rate * t) ** 2,
        "velocity": 2.0 * velocity**2 + sideways * (from_tilt**2 + from_rate**2),
        "position": 2.0 * position**2
        + (velocity * t) ** 2
        + sideways * ((from_tilt * t / 2.0) ** 2 + (from_rate * t / 3.0) ** 2),
    }
    return {name: MEAN_LENGTH * math.sqrt(grown[name]) for name in QUANTITIES}


def white_noise(series: Sequence[FloatArray]) -> float:
    """Standard deviation of the white noise of a component, from differences of order `ORDER`; NaN without data.

    Args:
        series: samples (n, 3) of each window; robust against the few rows in which the motion itself is not smooth.
    """
    parts = [np.abs(np.diff(values, ORDER, axis=0)).ravel() for values in series if len(values) > ORDER]
    differences = np.concatenate([np.zeros(0), *parts])
    if len(differences) == 0:
        return math.nan
    return float(1.4826 * np.median(differences) / math.sqrt(math.comb(2 * ORDER, ORDER)))


def _vectors(window: Window, quantity: str) -> FloatArray:
    """Measured rows of a quantity, (n, 3); an attitude as the turns from its first row on, summed up."""
    values = {
        "position": window.position,
        "velocity": window.velocity,
        "rotation": window.attitude,
        "rate": window.gyro,
    }[quantity]
    if values is None:
        return np.zeros((0, 3))
    known = values[np.isfinite(values).all(axis=1)]
    if quantity != "rotation":
        return known
    w, v = known[:, :1], known[:, 1:]
    turned = w[:-1] * v[1:] - w[1:] * v[:-1] - np.cross(v[:-1], v[1:])
    return np.cumsum(2.0 * turned, axis=0)


# --- Predictions with bands: what the filter expects of measurements that are withheld from it, beside what they were
#
# The filter runs along a flight.  From many rows on it is shown nothing for a while but the rotor speeds, then one
# measurement; its innovation is the error of a prediction from the filtered state, and the innovation's covariance, of
# state, random forces and sensor alike, the prediction's band.


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
        self.problem = replace(whole, control=problem.control, tail=problem.tail).along(z, psi).frozen(z)

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
    _, gains = k.kalman(track._replace(seen=seen), p, psi)
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
