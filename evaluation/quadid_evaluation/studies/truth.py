"""Truth of the fit.  Errors against the Cramer-Rao bound, coverage, bias with noise, its memory, status.

    python -m quadid_evaluation.studies.truth --out docs/results
    python -m quadid_evaluation.studies.truth --parts noise --out docs/results

Each seed is a new individual Pelican, a new 60 s flight with all axes moving, and a poor initial guess.  A part that is
run alone replaces its own section of the page and leaves the others.
"""

from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

from quadid.chi_square import Z95
from quadid.data.window import Window
from quadid.flight import draw_truth, fly
from quadid.flight.loop import SensorNoise
from quadid.identification.fit import FitOptions, fit, shaped_noise
from quadid.identification.noise import estimate_noise
from quadid.identification.problem import Shooting
from quadid.identification.result import settle_states
from quadid.identification.uncertainty import bounds_of
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior, Vehicle
from quadid_evaluation.harness import pooled, study, table

SEGMENT = 1.0
NOISE_SCALES = (0.3, 1.0, 3.0)
MEMORIES = (0.3, 0.66, 1.5, 3.0)
"""Of the attitude noise [s]."""
PROFILES = ("hover", "one_axis", "roll_pitch")
"""Flights that do not move enough."""


def with_values(vehicle: Vehicle, values: FloatArray) -> Vehicle:
    """The vehicle with these as initial values of the six, and nothing else known of them."""
    priors = {n: ParameterPrior(initial=float(v)) for n, v in zip(NOMINAL_NAMES, values, strict=True)}
    return vehicle.model_copy(update={"parameters": priors})


def poor_guess(vehicle: Vehicle, truth: Mapping[str, float], seed: int, spread: float = 0.3) -> Vehicle:
    """The vehicle with each initial value off by a log-uniform factor up to exp(`spread`)."""
    rng = np.random.default_rng([seed, 5])
    return with_values(vehicle, np.array([truth[n] * np.exp(rng.uniform(-spread, spread)) for n in NOMINAL_NAMES]))


def bound(window: Window, vehicle: Vehicle, truth: FloatArray) -> FloatArray:
    """Cramer-Rao bound of the log parameters at the truth, with the noise spectrum found at the truth.

    That of one cut into segments with an initial state each; the fit weighs two.
    """
    shooting = Shooting.cut([window], vehicle, SEGMENT)
    theta = shooting.layout.neutral()
    theta[: len(truth)] = truth
    lin = settle_states(shooting, theta)
    shooting = shooting.with_noise(estimate_noise(lin.residuals, lin.weights, shooting.dt, 1.0))
    lin = settle_states(shooting, theta)
    shooting = shooting.with_noise(shaped_noise(shooting, theta, shooting.free([]), lin.states))
    lin = settle_states(shooting, theta)
    return bounds_of(shooting.linearise(theta, shooting.free(NOMINAL_NAMES), lin.states).information)


class Flight(NamedTuple):
    """A flight of a new individual: what `quadid.flight.fly` is told."""

    seed: int
    profile: str = "excited"
    noise_scale: float = 1.0
    outside: Mapping[str, dict[str, float]] = {}
    bounded: bool = True


class Outcome(NamedTuple):
    """One flight: log errors, stated log sigma, bound (NaN if not `bounded`), status of each nominal parameter."""

    error: FloatArray
    sigma: FloatArray
    bound: FloatArray
    status: tuple[str, ...]


def run(flight: Flight) -> Outcome:
    """Flies 60 s and fits them."""
    seed, craft = flight.seed, Vehicle.shipped("pelican")
    truth = draw_truth(craft, seed)
    values = np.array(list(truth.as_dict().values()))
    how: dict[str, Any] = {"noise_scale": flight.noise_scale, "outside": flight.outside}
    window = fly(craft, truth, 60.0, seed, flight.profile, **how).window
    result = fit([window], poor_guess(craft, truth.as_dict(), seed), FitOptions(iterations=0, seed=seed))
    least = bound(window, craft, values) if flight.bounded else np.full(len(values), np.nan)
    error = np.log(result.theta[: len(values)] / values)
    return Outcome(error, result.uncertainty.sigma, least, tuple(p.status.value for p in result.parameters))


def excited(seeds: int, processes: int) -> list[str]:
    """Section on efficiency and coverage."""
    outcomes = pooled(run, [Flight(s) for s in range(seeds)], processes)
    error, sigma, least = (np.array([o[k] for o in outcomes]) for k in range(3))
    inside = np.mean(np.abs(error) <= Z95 * sigma, axis=0)
    rows = [
        (
            name,
            f"{100 * np.sqrt(np.mean(e**2)):.4f}",
            f"{100 * np.sqrt(np.mean(limit**2)):.4f}",
            f"{np.sqrt(np.mean((e / limit) ** 2)):.3f}",
            f"{100 * np.mean(e):.4f} ± {100 * np.std(e) / np.sqrt(seeds):.4f}",
            f"{100 * cover:.1f} ± {100 * np.sqrt(max(cover * (1 - cover), 1e-9) / seeds):.1f}",
        )
        for name, e, limit, cover in zip(NOMINAL_NAMES, error.T, least.T, inside, strict=True)
    ]
    heads = (
        "parameter",
        "RMS error %",
        "bound of one set of segments %",
        "ratio",
        "bias % ± s.e.",
        "coverage % ± s.e.",
    )
    return [f"## {seeds} excited flights of 60 s", "", *table(heads, rows)]


def noise_levels(seeds: int, processes: int) -> list[str]:
    """Section on bias: the same vehicles and flights at three noise levels of the sensors.

    In a closed loop the inputs answer the noise, which biases a plain regression more the noisier the sensors are.
    """
    rows = []
    for x in NOISE_SCALES:
        part = pooled(run, [Flight(10_000 + s, noise_scale=x) for s in range(seeds)], processes)
        z = np.array([o.error / o.sigma for o in part])
        inside = 100.0 * np.mean(np.abs(z) <= Z95, axis=0)
        means = ", ".join(f"{m:+.2f}" for m in np.mean(z, axis=0))
        rows.append((f"× {x:g}", means, f"{inside.min():.1f} to {inside.max():.1f}"))
    return [
        f"## Bias with noise: {seeds} flights of 60 s at three noise levels",
        "",
        f"Mean error in stated standard deviations (standard error {1.0 / np.sqrt(seeds):.2f}) of "
        f"{', '.join(NOMINAL_NAMES)}; coverage [%].",
        "",
        *table(("noise", "mean errors", "coverage"), rows),
    ]


def status(seeds: int, processes: int) -> list[str]:
    """Section on what is claimed where flights do not move enough."""
    parts = [pooled(run, [Flight(20_000 + s, profile) for s in range(seeds)], processes) for profile in PROFILES]

    def cell(part: Sequence[Outcome], j: int) -> str:
        names = [o.status[j] for o in part]
        counts = ", ".join(f"{names.count(s)} {s}" for s in sorted(set(names)))
        return f"{counts}; {100 * np.median([o.bound[j] for o in part]):.3g}"

    rows = [(name, *(cell(part, j) for part in parts)) for j, name in enumerate(NOMINAL_NAMES)]
    return [f"## Status in {seeds} flights of 60 s, and the bound [%]", "", *table(("parameter", *PROFILES), rows)]


def remembering(job: tuple[int, float]) -> tuple[FloatArray, float]:
    """Errors of the three gyro scales in standard deviations, and the memory found, of one seed and one memory."""
    seed, memory = job
    craft = Vehicle.shipped("pelican")
    scale = dict(zip("xyz", np.random.default_rng([seed, 7]).uniform(-0.05, 0.05, 3).tolist(), strict=True))
    noise = SensorNoise(attitude_time=memory)
    flown = fly(craft, draw_truth(craft, seed), 120.0, seed, effects={"gyro_scale": scale}, noise=noise)
    names = {f"gyro_scale.{axis}": value for axis, value in scale.items()}
    found = fit([flown.window], craft, FitOptions(iterations=0), names=[*NOMINAL_NAMES, *names])
    error = [(found.parameters[n].value - value) / found.parameters[n].sigma for n, value in names.items()]
    return np.array(error), found.noise.slow_time


def memories(seeds: int, processes: int) -> list[str]:
    """Section on attitude noise that is remembered for another time."""
    rows = []
    for memory in MEMORIES:
        errors, times = zip(*pooled(remembering, [(30_000 + s, memory) for s in range(seeds)], processes), strict=True)
        z, inside = np.array(errors), 100.0 * np.mean(np.abs(errors) <= Z95)
        estimate = f"{np.median(times):.2f} ({min(times):.2f} … {max(times):.2f})"
        rows.append((f"{memory:g}", estimate, f"{inside:.1f} of {z.size}", f"{np.sqrt(np.mean(z**2)):.2f}"))
    title = f"## Correlation time of attitude noise: {seeds} flights of 120 s, gyro scale of up to 5 % fitted"
    heads = ("time [s]", "estimate: median (range)", "gyro scale: coverage [%]", "RMS error [sigma]")
    return [title, "", *table(heads, rows)]


if __name__ == "__main__":
    study(__doc__, "truth.md", "Truth: efficiency, coverage, bias, status", {
        "excited": lambda g: excited(g.seeds, g.processes), "noise": lambda g: noise_levels(g.noise_seeds, g.processes),
        "status": lambda g: status(g.few, g.processes), "memory": lambda g: memories(g.memory_seeds, g.processes),
    }, seeds=1000, noise_seeds=200, few=20, memory_seeds=20, processes=2)  # fmt: skip
