"""The estimator of `identify` (filter error) on simulated and recorded flights.

    python -m quadid_evaluation.studies.filter_error --out docs/results
    python -m quadid_evaluation.studies.filter_error --parts exact speed --flights 20

Parts: exact and gusty simulated flights, guesses far off, a loop faster than its log, a hidden motor lag, recorded
vehicles, speed.  A part that is run alone replaces its own section of the page and leaves the others.
"""

import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
from quadid_replay.opening import open_log

from quadid.data.grid import grid_recording
from quadid.estimate.fit import estimate
from quadid.estimate.missing import control_size, size, smoothed
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_recording, from_window
from quadid.flight import draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import ParameterPrior, Vehicle
from quadid_evaluation.harness import Given, options, pooled, put
from quadid_evaluation.studies.campaign import GUSTS
from quadid_evaluation.studies.filter_error.jobs import LATE, SECONDS, exact, fast_loop, lagging
from quadid_evaluation.studies.truth import poor_guess

EFFECTS = (
    "rotor_drag.k_x",
    "rotor_drag.k_y",
    "rate_damping.l_p",
    "rate_damping.m_q",
    "rate_damping.n_r",
    "cg_offset.x",
    "cg_offset.y",
    "command_delay.delay",
)
RECORDED: tuple[tuple[str, tuple[str, ...], float | None], ...] = (
    *(("brushed", ("jana00.csv", "jana02.csv"), rate) for rate in (50.0, 100.0, 200.0)),
    ("brushed", ("jana00.csv",), 100.0),
    ("brushed", ("jana02.csv",), 100.0),
    ("crazyflie_rpm", ("figure8_17.csv", "figure8_22.csv"), 100.0),
    ("crazyflie_rpm", ("figure8_27.csv", "figure8_34.csv"), 100.0),
    ("nanodrone", ("random_run1.csv",), 100.0),
    ("iris", ("sideways.csv",), 50.0),
)
"""Folder of the recorded data, flights, rate [Hz]; None: every channel at its own rate."""
KNOWN = {
    "brushed": "b 2.02e-8 (thrust stand), J 1.5–1.9e-5, speeds act 4–8 ms late",
    "crazyflie_rpm": "b 3.70e-8",
    "nanodrone": "b 3.72e-8; its low-passed states yield a wrong J",
    "iris": "b 5.84e-6, J_xx, J_yy 0.0291; commands at 10 Hz",
}


def simulated(gusty: bool, flights: int, processes: int) -> str:
    """Flights of drawn vehicles, guesses off by up to a third: bias, coverage and half-width of each parameter."""
    found = np.array(pooled(exact, [(100 + seed, gusty) for seed in range(flights)], processes))
    error, sigma = found[:, 0], found[:, 1]
    inside = np.abs(error) <= 1.96 * sigma
    truth = "0.6, 0.3 m/s^2, 1.0, 0.3 rad/s^2" if gusty else "none"
    rows = {
        "bias ± s.e. [%]": [f"{100 * e.mean():+.2f} ± {100 * e.std() / np.sqrt(flights):.2f}" for e in error.T],
        "inside 95 % [%]": [f"{100 * share:.0f}" for share in inside.mean(axis=0)],
        "half-width, median [%]": [f"{196 * s:.2f}" for s in np.median(sigma, axis=0)],
    }
    return "\n".join(
        [
            f"{flights} flights of {SECONDS:.0f} s at 50 Hz, one drawn Pelican each, seeds from 100; guesses off by up "
            f"to 35 %.  Random forces and moments that acted (horizontal, vertical; roll and pitch, yaw): {truth}.",
            "",
            "| | " + " | ".join(NOMINAL_NAMES) + " |",
            "|---|" + "---|" * len(NOMINAL_NAMES),
            *(f"| {name} | " + " | ".join(cells) + " |" for name, cells in rows.items()),
            "",
            f"All six together: {100 * inside.mean():.1f} % inside 95 %.",
        ]
    )


def guesses(count: int) -> str:
    """One flight in gusts, guesses off by up to a factor 4: whether all seeds of `identify` end at one optimum."""
    craft, seed = Vehicle.shipped("pelican"), 7
    truth = draw_truth(craft, seed)
    window, numbers = fly(craft, truth, 30.0, seed, outside=GUSTS).window, truth.as_dict()
    values = []
    for guess in range(count):
        rng = np.random.default_rng([guess, 11])
        priors = {
            n: ParameterPrior(initial=v * float(np.exp(rng.uniform(-1, 1) * np.log(4.0)))) for n, v in numbers.items()
        }
        found = fit([window], craft.model_copy(update={"parameters": priors}), FitOptions(seed=guess))
        values.append([np.log(found.theta[:6]), found.uncertainty.sigma])
    apart = np.abs(np.array(values)[:, 0] - np.median(np.array(values)[:, 0], axis=0)) / np.array(values)[:, 1]
    same = np.mean(np.all(apart < 0.2, axis=1))
    return (
        f"One flight of 30 s in gusts, {count} guesses with every value off by up to a factor 4, a seed each: "
        f"{100 * same:.0f} % end within 0.2 standard deviations of the median in all six; farthest {apart.max():.2f}."
    )


def feedback(flights: int, processes: int) -> str:
    """The loop at 500 Hz logged at 10, 50, 100 Hz."""
    lines = [
        f"{flights} flights of {SECONDS:.0f} s each: a stabiliser at 500 Hz reads a gyro of 0.01 rad/s and an attitude "
        "estimator fed by it; the log holds mean commands.  Random moments of 0.3 s.",
        "",
        "| log | random moments | noise of speeds | J_xx [%] | inside 95 % | half-width, median [%] |",
        "|---|---|---|---|---|---|",
    ]
    for every, share, speed in ((10, 0.0, 0.0), (10, 0.2, 0.0), (10, 0.2, 0.005), (5, 0.2, 0.005), (50, 0.2, 0.005)):
        found = np.array(pooled(fast_loop, [(s, every, share, speed) for s in range(flights)], processes))
        error, sigma = found[:, 0, 2], found[:, 1, 2]
        lines.append(
            f"| {500 / every:.0f} Hz | {share:.0%} | {speed:.1%} | "
            f"{100 * error.mean():+.1f} ± {100 * error.std() / np.sqrt(flights):.1f} | "
            f"{100 * np.mean(np.abs(error) < 1.96 * sigma):.0f} % | {196 * np.median(sigma):.2f} |"
        )
    return "\n".join(lines)


def recorded(data: Path) -> str:
    """Recorded vehicles, with rotor drag, damping, centre of gravity and delay free."""
    lines = [
        "Free: the six, " + ", ".join(EFFECTS) + ", trim moment and biases a flight.  ± 95 %.  Missing: rms of the "
        "smoothed random force as a share of weight, and moment as a share of the rotors' (roll, pitch).",
        "",
        "| data | grid | b | J_xx | J_yy | delay [ms] | missing | known |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for folder, files, rate in RECORDED:
        vehicle = Vehicle.from_yaml((data / folder / "vehicle.yaml").read_text(encoding="utf-8"))
        tracks = []
        for name in files:
            log = open_log(data / folder / name)
            windows = [] if rate is None else grid_recording(log, vehicle, rate).windows
            tracks += [from_window(w, vehicle, air=True) for w in windows] or [from_recording(log, vehicle, air=True)]
        found = estimate(Problem.of(tracks, vehicle, EFFECTS))
        delay, late = found.value("command_delay.delay")
        acted = smoothed(found)
        force = size(acted, force=True)[0] / acted[0].weight
        moment = size(acted, force=False)[0] / control_size(acted)
        six = {n: found.value(n) for n in ("b", "J_xx", "J_yy")}
        lines.append(
            f"| `{folder}` {', '.join(f.removesuffix('.csv') for f in files)} | {rate or 'own'} | "
            + " | ".join(f"{v:.4g} ± {196 * s:.1f} %" for v, s in six.values())
            + f" | {1e3 * delay:.1f} ± {1.96e3 * late:.1f} | force {force.max():.1%}, moment {moment[0]:.0%}, "
            f"{moment[1]:.0%} | {KNOWN[folder]} |"
        )
    return "\n".join(lines)


def late(flights: int, processes: int) -> str:
    """A hidden motor lag, with and without the family of late causes among the free parameters."""
    lines = [
        f"{flights} flights of {SECONDS:.0f} s a row, drawn Pelicans.  The family: {', '.join(LATE)}.",
        "",
        "| motor lag | free | J_xx, J_yy, mean error [%] | inside 95 % | half-width, median [%] |",
        "|---|---|---|---|---|",
    ]
    for lag in (0.0, 0.03, 0.04):
        found = np.array(pooled(lagging, [(300 + s, lag) for s in range(flights)], processes))
        for which, free in enumerate(("the six", "and the family")):
            error, sigma = found[:, which, 0, 2:4], found[:, which, 1, 2:4]
            lines.append(
                f"| {1e3 * lag:.0f} ms | {free} | {100 * error.mean():+.1f} | "
                f"{100 * np.mean(np.abs(error) < 1.96 * sigma):.0f} % | {196 * np.median(sigma):.2f} |"
            )
    return "\n".join(lines)


def speed() -> str:
    """Time of `identify` for a flight of 500 s at 50 Hz, calm and in gusts, and of one filter pass."""
    begin = time.perf_counter()
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, 1)
    vehicle = poor_guess(craft, truth.as_dict(), 1)
    fit([fly(craft, truth, 20.0, 1, outside=GUSTS).window], vehicle)
    lines = [f"First fit of a fresh process, kernels compiled or loaded: {time.perf_counter() - begin:.1f} s."]
    for air, outside in (("calm", {}), ("in gusts", GUSTS)):
        window = fly(craft, truth, 500.0, 1, outside=outside).window
        begin, own = time.perf_counter(), time.process_time()
        fit([window], vehicle)
        whole, own = time.perf_counter() - begin, time.process_time() - own
        lines.append(
            f"500 s at 50 Hz, {air}, swarm of 64 x 60, noise, intervals: {whole:.1f} s on the clock, {own:.1f} s of "
            "processor time."
        )
    problem = Problem.of([from_window(window, vehicle)], vehicle)
    z, psi = problem.start(), problem.first_noise()
    begin = time.thread_time()
    problem.objective(z, psi)
    once = time.thread_time() - begin
    lines.append(
        f"One filter pass {once:.2f} s, {1e6 * once / len(window):.1f} us a step.  On a machine with other work."
    )
    return "  ".join(lines)


PARTS: Mapping[str, tuple[str, Callable[[Given], str]]] = {
    "exact": ("Simulated flights, exact model", lambda g: simulated(False, g.flights, g.processes)),
    "gusty": ("The same in gusts", lambda g: simulated(True, g.flights, g.processes)),
    "guesses": ("Guesses far off", lambda g: guesses(max(g.flights // 3, 3))),
    "loop": ("A loop faster than its log", lambda g: feedback(max(g.flights // 5, 4), g.processes)),
    "late": ("A hidden motor lag", lambda g: late(max(g.flights // 10, 4), g.processes)),
    "recorded": ("Recorded vehicles", lambda g: recorded(g.data)),
    "speed": ("Speed", lambda g: speed()),
}

if __name__ == "__main__":
    given = options(__doc__, PARTS, flights=60, processes=2)
    for part in given.parts:
        title, run = PARTS[part]
        command = f"`python -m quadid_evaluation.studies.filter_error --parts {part} --flights {given.flights}`"
        lines = [f"## {title}", "", command, "", run(given)]
        put(given, "filter-error.md", "The estimator", part, lines)
