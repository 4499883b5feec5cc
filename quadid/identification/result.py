"""Scores of parameter vectors on sets, and results as plain dictionaries."""

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import CHANNEL_NAMES, CHANNEL_UNITS, Window
from quadid.errors import NotIdentifiableError
from quadid.identification.elimination import InitialStates
from quadid.identification.fit import Fit, possible_moments
from quadid.identification.noise import NoiseModel
from quadid.identification.predict import SUM_TO, HorizonScore
from quadid.identification.problem import Linearised, Shooting
from quadid.model.layout import Layout
from quadid.parameters import INERTIAS, NOMINAL_NAMES, UNKNOWN, Parameter, ParameterSet, Status, impossible_inertia
from quadid.rotation import euler, product
from quadid.types import FloatArray, JsonDict
from quadid.vehicle import ParameterPrior, Vehicle

# --- Score of a parameter vector on a set: simulation over 1 s segments with estimated initial states
#
# The mean squared residual of each channel is divided by what pure sensor noise would leave there after the initial
# states were fitted, so a perfect model scores 1.0 whatever the segment length, noise colour or channel.


SCORE_SECONDS = 1.0
"""Length of the simulated stretches that a set is scored on [s], whatever the fit used."""
STATE_STEPS = 4
"""Gauss-Newton steps of the initial states; the last ones change nothing but for a far-off parameter vector."""
_ATTITUDE = slice(3, 6)


@dataclass(frozen=True)
class ChannelScore:
    """One output.

    Attributes:
        name: p q r phi theta psi a_x a_y a_z v_n v_e v_d x y z.
        unit: SI unit.
        mse: squared residuals over those of a perfect model; NaN when never measured or of unknown noise.
        rmse: root mean squared error of the simulation, in `unit`.
        fit_percent: 100 (1 - |y - y_sim| / |y - mean y|); 100 is perfect, 0 no better than the mean.
        samples: measured samples.
    """

    name: str
    unit: str
    mse: float
    rmse: float
    fit_percent: float
    samples: int


@dataclass(frozen=True)
class Series:
    """Measured and simulated outputs over time.

    Attributes:
        t: times [s], shape (n,).
        measured, simulated: shape (n, channels), attitude as roll, pitch, yaw [rad] (yaw unwrapped); NaN where not
            measured.
        sigma: standard deviation of the sensor noise that scores count with, shape (channels,).
    """

    t: FloatArray
    measured: FloatArray
    simulated: FloatArray
    sigma: FloatArray


@dataclass(frozen=True)
class SetScore:
    """Score of one parameter vector on one set.

    Attributes:
        mse: mean over channels and samples of the squared residuals over those of a perfect model; 1.0 is the noise
            floor, infinite when the simulation ran away.
        channels: every output.
        series: what was measured and simulated.
    """

    mse: float
    channels: tuple[ChannelScore, ...]
    series: Series


INFINITE = np.errstate(over="ignore", invalid="ignore")
"""A simulation that runs away overflows to infinity or NaN, which is its score and needs no warning."""


@INFINITE
def mse_score(
    windows: Sequence[Window], vehicle: Vehicle, theta: FloatArray, noise: NoiseModel | None = None
) -> SetScore:
    """Scores `theta` on `windows`.

    Args:
        windows: data on one grid.
        vehicle: geometry and mass.
        theta: full parameter vector, shape (size,).
        noise: sensor noise, from the fit; typical MEMS noise by default.  Channels it lacks are simulated and
            compared, but do not count in `mse`.

    Raises:
        NotIdentifiableError: no stretch is long enough for one segment.
    """
    shooting = scored_problem(windows, vehicle, noise)
    lin = settle_states(shooting, theta)
    series = _series(shooting, lin)
    known = shooting.channels if noise is None else len(noise.white)
    tally = tallied(shooting, theta, lin, known)
    return SetScore(tally.mse, _channels(tally, series), series)


@dataclass(frozen=True)
class Tally:
    """Sums that `mse_score` compares, over segments; tallies of different data add up.

    Attributes:
        squares: of the residuals of each channel, shape (channels,).
        expected: what pure noise would leave of them; 0 for channels of unknown noise.
        samples: measured ones.
        ran_away: whether a simulation left every scale of a flight.
    """

    squares: FloatArray
    expected: FloatArray
    samples: FloatArray
    ran_away: bool

    def __add__(self, other: "Tally") -> "Tally":
        return Tally(
            self.squares + other.squares,
            self.expected + other.expected,
            self.samples + other.samples,
            self.ran_away or other.ran_away,
        )

    @property
    def ratio(self) -> FloatArray:
        """Squares over what pure noise leaves, shape (channels,); NaN where nothing is known.

        A channel whose samples are so few that the initial states take them all is no evidence on the model.
        """
        counts = self.expected > 1e-9 * np.maximum(self.squares, 1e-300)
        return np.asarray(np.divide(self.squares, self.expected, out=np.full(len(counts), np.nan), where=counts))

    @property
    def mse(self) -> float:
        """Mean of the ratios over channels and samples; infinite when a simulation ran away, or nothing is known."""
        ratio = self.ratio
        weight = np.where(np.isnan(ratio), 0.0, self.samples)
        if self.ran_away or weight.sum() == 0.0:
            return np.inf
        return float(np.sum(weight * np.nan_to_num(ratio)) / weight.sum())


@INFINITE
def tallied(shooting: Shooting, theta: FloatArray, lin: Linearised | None = None, known: int | None = None) -> Tally:
    """The tally of `theta` on a problem; `known` channels at most have a known noise, all by default."""
    lin = settle_states(shooting, theta) if lin is None else lin
    used = lin.weights > 0.0
    expected = expected_squares(shooting, theta, lin.states).sum(axis=0)
    if known is not None:
        expected[known:] = 0.0
    return Tally(
        np.sum(np.where(used, lin.residuals, 0.0) ** 2, axis=(0, 1)),
        expected,
        np.count_nonzero(used, axis=(0, 1)).astype(np.float64),
        not np.isfinite(lin.cost).all(),
    )


def scored_problem(windows: Sequence[Window], vehicle: Vehicle, noise: NoiseModel | None) -> Shooting:
    """The segments that scores are made of, weighted by `noise`; raises NotIdentifiableError where there are none."""
    shooting = Shooting.cut(windows, vehicle, SCORE_SECONDS)
    if not shooting.rollouts:
        raise NotIdentifiableError(
            f"{windows[0].name or 'window'}: no stretch is long enough to be scored",
            f"{SCORE_SECONDS + 0.4:g} s without gaps",
            "record longer stretches at a steady rate",
        )
    return shooting.with_noise(covering(noise, shooting.channels, vehicle))


def covering(noise: NoiseModel | None, channels: int, vehicle: Vehicle) -> NoiseModel:
    """The noise model for `channels` channels: `noise` as far as it goes, then the typical."""
    typical = NoiseModel.guess(channels, vehicle.noise)
    return typical if noise is None else noise.first(min(channels, len(noise.white))).extended(typical)


@INFINITE
def settle_states(shooting: Shooting, theta: FloatArray, names: Sequence[str] = ()) -> Linearised:
    """Fits the initial state of every segment at fixed `theta`; a step that makes a segment worse is not taken.

    Args:
        shooting: the data.
        theta: full vector.
        names: parameters in use, also at values without effect: they decide which initial states matter.

    Returns:
        The linearisation at the fitted states.
    """
    none = shooting.free(names)
    lin = shooting.linearise(theta, none)
    power = _power(shooting, lin)
    for _ in range(STATE_STEPS):
        trial = shooting.linearise(theta, none, lin.stepped())
        better = _power(shooting, trial) < power
        if not better.all():
            trial = shooting.linearise(theta, none, trial.states.chosen(lin.n_pre, better, lin.states))
        lin, last, power = trial, power, _power(shooting, trial)
        if np.sum(last - power) <= 1e-6 * np.sum(power):
            break
    return lin


def _power(shooting: Shooting, lin: Linearised) -> FloatArray:
    """Whitened squares of every segment at its present initial state, shape (segments,); infinite where it ran away."""
    white = shooting.noise.whitened(lin.residuals[..., None], lin.weights, shooting.dt)
    return np.asarray(np.nan_to_num(np.sum(white**2, axis=(1, 2, 3)), nan=np.inf))


def expected_squares(shooting: Shooting, theta: FloatArray, states: InitialStates | None = None) -> FloatArray:
    """Sum of squares that pure noise leaves in each segment and channel, shape (segments, channels), unit squared.

    With C = L L' the noise covariance of a channel and Q the whitened initial-state directions, fitting the initial
    state leaves E[r' r] = trace(L (I - Q Q') L').
    """
    whitener = shooting.noise.whitener(shooting.length, shooting.dt)
    factor = np.linalg.inv(whitener)
    white = [np.count_nonzero(w - np.diag(np.diag(w))) == 0 for w in whitener]
    variance = shooting.noise.variance
    parts = []
    for i, part in enumerate(shooting.columns(theta, shooting.free([]), states)):
        q = part.basis.reshape(len(part.basis), shooting.length, shooting.channels, -1)
        measured = np.count_nonzero(shooting.measured_weights(i), axis=1)
        left = variance * (measured - np.sum(q**2, axis=(1, 3)))
        for c in np.flatnonzero(~np.array(white)):
            coloured = np.sum(factor[c] ** 2) - np.sum(np.matmul(factor[c], q[:, :, c]) ** 2, axis=(1, 2))
            left[:, c] = np.where(part.complete[:, c], coloured, left[:, c])
        parts.append(np.maximum(left, 0.0))
    return np.concatenate(parts)


def _channels(tally: Tally, series: Series) -> tuple[ChannelScore, ...]:
    out = []
    for c, name in enumerate(CHANNEL_NAMES[: len(tally.samples)]):
        rmse, percent = _errors(series.measured[:, c], series.simulated[:, c])
        ratio, samples = float(tally.ratio[c]), int(tally.samples[c])
        out.append(ChannelScore(name, CHANNEL_UNITS[c], ratio, rmse, percent, samples))
    return tuple(out)


def _errors(measured: FloatArray, simulated: FloatArray) -> tuple[float, float]:
    """Root mean squared error, and normalised-root-mean-squared-error fit [%]; NaN when nothing was measured."""
    good = np.isfinite(measured) & np.isfinite(simulated)
    if not good.any():
        return np.nan, np.nan
    y, error = measured[good], measured[good] - simulated[good]
    rmse, spread = float(np.sqrt(np.mean(error**2))), float(np.sqrt(np.mean((y - y.mean()) ** 2)))
    moves = spread > 1e-12 * max(1.0, float(np.abs(y).max()))
    return rmse, 100.0 * (1.0 - rmse / spread) if moves else np.nan


def _series(shooting: Shooting, lin: Linearised) -> Series:
    parts, place = [], 0
    for rollout, segments in zip(shooting.rollouts, shooting.segments, strict=True):
        rows = segments.rows.ravel()
        part = slice(place, place + len(segments.starts))
        residual = lin.residuals[part].reshape(len(rows), -1)
        place += len(segments.starts)
        known = rollout.measured[rows]
        y = np.concatenate([known[:, :3], np.zeros((len(rows), 3)), known[:, 7:]], axis=1)[:, : shooting.channels]
        y_sim = y + residual
        # Measured and simulated roll, pitch, yaw [rad] from attitudes (n, 4) and the simulation's error (n, 3). The
        # error is twice the vector part of the rotation from measured to simulated body.
        q = known[:, 3:7]
        v = np.clip(0.5 * residual[:, _ATTITUDE], -1.0, 1.0)
        w = np.sqrt(np.maximum(1.0 - np.sum(v * v, axis=1), 0.0))
        simulated = product(q, np.column_stack([w, v]))
        angles, other = euler(q), euler(simulated)
        angles[:, 2] = np.unwrap(angles[:, 2])
        difference = np.remainder(other - angles + np.pi, 2.0 * np.pi) - np.pi
        y[:, _ATTITUDE], y_sim[:, _ATTITUDE] = angles, angles + difference
        absent = ~rollout.valid[rows][:, : shooting.channels]
        y[absent] = y_sim[absent] = np.nan
        parts.append((rollout.window.t[rows], y, y_sim))
    t, y, y_sim = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Series(t, y, y_sim, np.hypot(shooting.noise.white, shooting.noise.slow))


# --- Results as plain dictionaries, ready for JSON: the forms of ``quadid.identify/1`` and ``quadid.score/1``
#
# Numbers stay Python floats; NaN and infinities mean "no answer" and become null when written.


NOTHING_NEW = 0.9
"""Share of the information that the prior brings, above which the data add nothing."""
CORRELATED = 0.01
"""Least correlation that is written into a file."""
_DIGITS = 7
"""Significant digits of a fitted vehicle file; far below any interval."""


@dataclass(frozen=True)
class ScoredSet:
    """One log with its scores.

    Attributes:
        log: its name.
        role: ``train`` or ``validate``.
        initial: score of the initial guess.
        fitted: score of the fit.
        paper: mean squared error of the paper's closed-loop simulation before and after; None without a stabiliser.
        mse: mean square of whitened innovations before and after.
    """

    log: str
    role: str
    initial: SetScore
    fitted: SetScore
    paper: tuple[float, float] | None = None
    mse: tuple[float, float] = (math.nan, math.nan)


def identify_result(
    fit: Fit,
    optimizer: str,
    seed: int,
    seconds: float,
    sets: Sequence[ScoredSet],
    vehicle_file: str | None,
    warnings: Sequence[str] = (),
) -> JsonDict:
    """The result of an identification.

    Args:
        fit: the fit.
        optimizer: name of the search that was used.
        seed: of all random numbers.
        seconds: wall time of the fit, on the caller's clock.
        sets: training and validation sets with their scores.
        vehicle_file: absolute path of the written vehicle file; None when none was written.
        warnings: beyond those of the fit, from reading the logs.
    """
    return {
        "schema": "quadid.identify/1",
        "vehicle": fit.vehicle.name,
        "optimizer": optimizer,
        "seed": seed,
        "seconds": seconds,
        "parameters": [parameter_entry(p) for p in fit.parameters],
        "sets": [_set_entry(s) for s in sets],
        "vehicle_file": vehicle_file,
        "warnings": [*warnings, *fit.warnings, *inertia_warnings(fit.parameters)],
    }


def parameter_entry(p: Parameter) -> JsonDict:
    """One parameter of the contract, and the share of the information that was known before the flight."""
    entry: JsonDict = {
        "name": p.name,
        "unit": p.unit,
        "value": p.value,
        "ci95": list(p.ci95),
        "initial": p.initial,
        "status": p.status.value,
        "prior_share": p.prior_share,
        "measured_before": p.measured_before,
    }
    if p.relative_to is not None:
        entry["relative_to"] = p.relative_to
    return entry


def _set_entry(s: ScoredSet) -> JsonDict:
    seen = [c for c in s.fitted.channels if c.samples > 0]
    paper = None if s.paper is None else {"initial": s.paper[0], "fitted": s.paper[1]}
    return {
        "log": s.log,
        "role": s.role,
        "mse": {"initial": s.mse[0], "fitted": s.mse[1], "noise_floor": 1.0},
        "mse_paper": paper,
        "fit_percent": {c.name: c.fit_percent for c in seen},
        "rmse": {c.name: {"value": c.rmse, "unit": c.unit} for c in seen},
    }


def inertia_warnings(parameters: ParameterSet) -> list[str]:
    """Says when identified moments of inertia cannot belong to a rigid body."""
    values = {p.name: p for p in parameters if p.name in INERTIAS}
    if len(values) < len(INERTIAS) or any(p.status in UNKNOWN for p in values.values()):
        return []
    why = impossible_inertia([values[n].value for n in INERTIAS], slack=1.3)
    if why is None:
        return []
    return [
        f"no rigid body has these moments of inertia: {why}; check mass, rotor positions and units in the vehicle file"
    ]


def answered(parameters: ParameterSet) -> bool:
    """True when the data add to the vehicle file for at least one parameter.

    A value measured before may be decided by that on data that are informative, too.
    """
    return any(
        p.status is not Status.PRIOR_DOMINATED or (p.measured_before and p.prior_share < NOTHING_NEW)
        for p in parameters
    )


def fitted_vehicle(fit: Fit) -> Vehicle:
    """The vehicle with fitted values as initial guess, their standard deviations and correlations, fitted effects."""
    effects = [p.name.split(".")[0] for p in fit.parameters if p.name not in NOMINAL_NAMES]
    return with_correlation(with_values(fit.vehicle, fit.parameters, effects, fit.theta), fit.parameters)


def with_correlation(vehicle: Vehicle, parameters: ParameterSet) -> Vehicle:
    """The vehicle with correlations of those of its values that have a standard deviation."""
    names, found = parameters.names, parameters.correlation
    known = [i for i, n in enumerate(names) if n in NOMINAL_NAMES and vehicle.parameters[n].sigma is not None]
    together = {
        names[i]: {names[j]: round(float(found[i, j]), 3) for j in known if j < i and abs(found[i, j]) >= CORRELATED}
        for i in known
    }
    return vehicle.model_copy(update={"correlation": {one: others for one, others in together.items() if others}})


def with_values(
    vehicle: Vehicle, parameters: Iterable[Parameter], effects: Iterable[str] = (), theta: FloatArray | None = None
) -> Vehicle:
    """The vehicle with the identified nominal values as initial guess, their bounds kept unless a value lies outside.

    Any other value stays as the vehicle has it, without a standard deviation: a guess, or a number of a model that
    misses the flight, never becomes a sharp prior of the next fit.  A moment of inertia that no rigid body has beside
    those identified moves as far as it must.

    Args:
        vehicle: the vehicle.
        parameters: fitted ones; others than nominal are passed over.
        effects: which it has besides, or with other numbers.
        theta: full parameter vector that holds the numbers of these.
    """
    nominal = [p for p in parameters if p.name in NOMINAL_NAMES]
    kept = {p.name: vehicle.parameters[p.name].initial for p in nominal if p.status is not Status.IDENTIFIED}
    written, _ = possible_moments(tuple(replace(p, value=kept.get(p.name, p.value)) for p in nominal))
    priors = {p.name: _prior(vehicle.parameters[p.name], p) for p in written}
    found = {name: dict(values) for name, values in vehicle.effects.items()}
    if theta is not None:
        layout = Layout(vehicle)
        for name in effects:
            found[name] = {k: _rounded(v) for k, v in layout.read_effect(theta, name).items() if math.isfinite(v)}
    told = {"parameters": {**vehicle.parameters, **priors}, "effects": found, "correlation": {}}
    return vehicle.model_copy(update=told)


def _prior(given: ParameterPrior, p: Parameter) -> ParameterPrior:
    value = given.initial if p.value == given.initial else _rounded(p.value)
    known = p.status is Status.IDENTIFIED and math.isfinite(p.sigma) and p.sigma > 0.0
    bounds = given.bounds and (min(given.bounds[0], value), max(given.bounds[1], value))
    return ParameterPrior(initial=value, bounds=bounds, sigma=_rounded(p.sigma) if known else None)


def _rounded(value: float) -> float:
    return float(f"{value:.{_DIGITS}g}")


def score_result(vehicle: str, pooled: HorizonScore, files: Sequence[tuple[str, int, HorizonScore]]) -> JsonDict:
    """The result of ``quadid score``.

    Args:
        vehicle: its name.
        pooled: over all starts of all files.
        files: name, number of gaps, and score of each file.
    """
    return {
        "schema": "quadid.score/1",
        "vehicle": vehicle,
        **_horizon_entry(pooled, sum(gaps for _, gaps, _ in files)),
        "files": [{"log": name, **_horizon_entry(score, gaps)} for name, gaps, score in files],
    }


def _horizon_entry(score: HorizonScore, gaps: int) -> JsonDict:
    return {
        "samples": score.samples,
        "gaps": gaps,
        "horizons": {str(h): score.at(h) for h in score.horizons},
        "spread": {str(h): score.between(h) for h in score.horizons},
        "sum": {"to": SUM_TO, **score.sum},
    }
