"""Truth of the fit.  Errors against the Cramer-Rao bound, coverage, bias with noise, its memory, status.

    python -m quadid_evaluation.studies.truth --out docs/results
    python -m quadid_evaluation.studies.truth --parts noise --out docs/results

Each seed is a new individual Pelican, a new 60 s flight with all axes moving, and a poor initial guess.  A part that is
run alone replaces its own section of the page and leaves the others.
"""

from collections.abc import Mapping
from dataclasses import dataclass

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


@dataclass(frozen=True)
class Outcome:
    """One seed: log errors, stated log sigma, bound, status of each nominal parameter."""

    seed: int
    error: FloatArray
    sigma: FloatArray
    bound: FloatArray
    status: tuple[str, ...]


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


def run(job: tuple[int, str, float, float]) -> Outcome:
    """Flies and fits one seed: (seed, profile, seconds, noise scale)."""
    seed, profile, seconds, noise_scale = job
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, seed)
    values = np.array(list(truth.as_dict().values()))
    window = fly(craft, truth, seconds, seed, profile, noise_scale=noise_scale).window
    result = fit([window], poor_guess(craft, truth.as_dict(), seed), FitOptions(iterations=0, seed=seed))
    return Outcome(
        seed,
        np.log(result.theta[: len(values)] / values),
        result.uncertainty.sigma,
        bound(window, craft, values),
        tuple(p.status.value for p in result.parameters),
    )


def efficiency(outcomes: list[Outcome]) -> list[str]:
    """Lines of a table of efficiency and coverage."""
    error, sigma = np.array([o.error for o in outcomes]), np.array([o.sigma for o in outcomes])
    limit = np.array([o.bound for o in outcomes])
    n = len(outcomes)
    inside = np.mean(np.abs(error) <= Z95 * sigma, axis=0)
    heads = (
        "parameter",
        "RMS error %",
        "bound of one set of segments %",
        "ratio",
        "bias % ± s.e.",
        "coverage % ± s.e.",
    )
    rows = []
    for j, name in enumerate(NOMINAL_NAMES):
        rms, crb = np.sqrt(np.mean(error[:, j] ** 2)), np.sqrt(np.mean(limit[:, j] ** 2))
        normal = np.sqrt(np.mean((error[:, j] / limit[:, j]) ** 2))
        mean, spread = np.mean(error[:, j]), np.std(error[:, j]) / np.sqrt(n)
        cover = inside[j]
        rows.append(
            (
                name,
                f"{100 * rms:.4f}",
                f"{100 * crb:.4f}",
                f"{normal:.3f}",
                f"{100 * mean:.4f} ± {100 * spread:.4f}",
                f"{100 * cover:.1f} ± {100 * np.sqrt(max(cover * (1 - cover), 1e-9) / n):.1f}",
            )
        )
    return table(heads, rows)


def excited(seeds: int, processes: int) -> str:
    """Section on efficiency and coverage."""
    part = pooled(run, [(s, "excited", 60.0, 1.0) for s in range(seeds)], processes)
    return "\n".join([f"## {seeds} excited flights of 60 s", "", *efficiency(part)])


def noise_levels(seeds: int, processes: int) -> str:
    """Section on bias: the same vehicles and flights at three noise levels of the sensors.

    In a closed loop the inputs answer the noise, which biases a plain regression more the noisier the sensors are.
    """
    parts = {x: pooled(run, [(10_000 + s, "excited", 60.0, x) for s in range(seeds)], processes) for x in NOISE_SCALES}
    text = [
        f"## Bias with noise: {seeds} flights of 60 s at three noise levels",
        "",
        f"Mean error in stated standard deviations (standard error {1.0 / np.sqrt(seeds):.2f}) of "
        f"{', '.join(NOMINAL_NAMES)}; coverage [%].",
        "",
        "| noise | mean errors | coverage |",
        "|---|---|---|",
    ]
    for x, part in parts.items():
        z = np.array([o.error / o.sigma for o in part])
        means = ", ".join(f"{m:+.2f}" for m in np.mean(z, axis=0))
        inside = 100.0 * np.mean(np.abs(z) <= Z95, axis=0)
        text.append(f"| × {x:g} | {means} | {inside.min():.1f} to {inside.max():.1f} |")
    return "\n".join(text)


def status(seeds: int, processes: int) -> str:
    """Section on what is claimed where flights do not move enough."""
    profiles = ("hover", "one_axis", "roll_pitch")
    parts = [pooled(run, [(20_000 + s, profile, 60.0, 1.0) for s in range(seeds)], processes) for profile in profiles]
    text = [
        f"## Status in {seeds} flights of 60 s, and the bound [%]",
        "",
        "| parameter | " + " | ".join(profiles) + " |",
        "|---" * (len(profiles) + 1) + "|",
    ]
    for j, name in enumerate(NOMINAL_NAMES):
        cells = []
        for part in parts:
            names = [o.status[j] for o in part]
            counts = ", ".join(f"{names.count(s)} {s}" for s in sorted(set(names)))
            cells.append(f"{counts}; {100 * np.median([o.bound[j] for o in part]):.3g}")
        text.append(f"| {name} | " + " | ".join(cells) + " |")
    return "\n".join(text)


def remembering(job: tuple[int, float]) -> tuple[FloatArray, float]:
    """Errors of the three gyro scales in standard deviations, and the memory found, of one seed and one memory."""
    seed, memory = job
    craft = Vehicle.shipped("pelican")
    scale = dict(zip("xyz", np.random.default_rng([seed, 7]).uniform(-0.05, 0.05, 3).tolist(), strict=True))
    flown = fly(
        craft,
        draw_truth(craft, seed),
        120.0,
        seed,
        effects={"gyro_scale": scale},
        noise=SensorNoise(attitude_time=memory),
    )
    names = {f"gyro_scale.{axis}": value for axis, value in scale.items()}
    found = fit([flown.window], craft, FitOptions(iterations=0), names=[*NOMINAL_NAMES, *names])
    error = [(found.parameters[n].value - value) / found.parameters[n].sigma for n, value in names.items()]
    return np.array(error), found.noise.slow_time


def memories(seeds: int, processes: int) -> str:
    """Section on attitude noise that is remembered for another time."""
    text = [
        f"## Correlation time of attitude noise: {seeds} flights of 120 s, gyro scale of up to 5 % fitted",
        "",
        "| time [s] | estimate: median (range) | gyro scale: coverage [%] | RMS error [sigma] |",
        "|---|---|---|---|",
    ]
    for memory in MEMORIES:
        part = pooled(remembering, [(30_000 + s, memory) for s in range(seeds)], processes)
        z, found = np.array([error for error, _ in part]), np.array([time for _, time in part])
        inside = 100.0 * np.mean(np.abs(z) <= Z95)
        text.append(
            f"| {memory:g} | {np.median(found):.2f} ({found.min():.2f} … {found.max():.2f}) | {inside:.1f} of "
            f"{z.size} | {np.sqrt(np.mean(z**2)):.2f} |"
        )
    return "\n".join(text)


if __name__ == "__main__":
    study(__doc__, "truth.md", "Truth: efficiency, coverage, bias, status", {
        "excited": lambda g: excited(g.seeds, g.processes), "noise": lambda g: noise_levels(g.noise_seeds, g.processes),
        "status": lambda g: status(g.few, g.processes), "memory": lambda g: memories(g.memory_seeds, g.processes),
    }, seeds=1000, noise_seeds=200, few=20, memory_seeds=20, processes=2)  # fmt: skip
