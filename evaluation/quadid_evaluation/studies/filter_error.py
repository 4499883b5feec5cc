"""The estimator of `identify` (filter error) on simulated and recorded flights.

    python -m quadid_evaluation.studies.filter_error --out docs/results
    python -m quadid_evaluation.studies.filter_error --parts exact speed --flights 20

Parts: exact and gusty simulated flights, guesses far off, a loop faster than its log, a hidden motor lag, recorded
vehicles, their single flights, speed.  A part that is run alone replaces its own section of the page.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from itertools import combinations
from pathlib import Path

import numpy as np
from quadid_replay.opening import open_log

import quadid
from quadid.data.grid import grid_recording
from quadid.effects import EFFECTS
from quadid.estimate.fit import estimate
from quadid.estimate.missing import control_size, size, smoothed
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_recording, from_window
from quadid.flight import draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES, Status
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior, Vehicle
from quadid_evaluation.harness import Given, options, pooled, put, table
from quadid_evaluation.studies import fast_loop
from quadid_evaluation.studies.campaign import GUSTS
from quadid_evaluation.studies.truth import Flight, poor_guess, run

FREE = (
    "rotor_drag.k_x",
    "rotor_drag.k_y",
    "rate_damping.l_p",
    "rate_damping.m_q",
    "rate_damping.n_r",
    "cg_offset.x",
    "cg_offset.y",
    "command_delay.delay",
)
"""Free beside the six on recorded flights."""
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
SINGLE = {"crazyflie_rpm": "figure8_??.csv", "brushed": "jana0?.csv", "nanodrone": "*_run?.csv"}
"""Folder and pattern of flights that are identified one by one."""
KNOWN = {
    "brushed": "b 2.02e-8 (thrust stand), J 1.5–1.9e-5, speeds act 4–8 ms late",
    "crazyflie_rpm": "b 3.70e-8",
    "nanodrone": "b 3.72e-8; its low-passed states yield a wrong J",
    "iris": "b 5.84e-6, J_xx, J_yy 0.0291; commands at 10 Hz",
}
LATE = tuple(
    name for e in EFFECTS.values() if e.family == "late" and not e.needs for name in (*e.entries, *e.refinements)
)
"""Lag, lag down, delay of commands, filter of the IMU, delay of the attitude: one family of nested models."""
SECONDS = 60.0


def simulated(gusty: bool, flights: int, processes: int) -> list[str]:
    """Flights of drawn vehicles, guesses off by up to a third: bias, coverage and half-width of each parameter."""
    outside = GUSTS if gusty else {}
    found = pooled(run, [Flight(100 + seed, outside=outside, bounded=False) for seed in range(flights)], processes)
    error, sigma = np.array([o.error for o in found]), np.array([o.sigma for o in found])
    inside = np.abs(error) <= 1.96 * sigma
    truth = "0.6, 0.3 m/s^2, 1.0, 0.3 rad/s^2" if gusty else "none"
    rows = (
        ("bias ± s.e. [%]", *(f"{100 * e.mean():+.2f} ± {100 * e.std() / np.sqrt(flights):.2f}" for e in error.T)),
        ("inside 95 % [%]", *(f"{100 * share:.0f}" for share in inside.mean(axis=0))),
        ("half-width, median [%]", *(f"{196 * s:.2f}" for s in np.median(sigma, axis=0))),
    )
    return [
        f"{flights} flights of {SECONDS:.0f} s at 50 Hz, one drawn Pelican each, seeds from 100; guesses off by up "
        f"to 35 %.  Random forces and moments that acted (horizontal, vertical; roll and pitch, yaw): {truth}.",
        "",
        *table(("", *NOMINAL_NAMES), rows),
        "",
        f"All six together: {100 * inside.mean():.1f} % inside 95 %.",
    ]


def guesses(count: int) -> list[str]:
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
    return [
        f"One flight of 30 s in gusts, {count} guesses with every value off by up to a factor 4, a seed each: "
        f"{100 * same:.0f} % end within 0.2 standard deviations of the median in all six; farthest {apart.max():.2f}."
    ]


def looped(job: tuple[int, int, float, float]) -> FloatArray:
    """One flight of the fast loop: log error and stated standard deviation of J_xx, shape (2,)."""
    seed, every, share, speed = job
    vehicle = Vehicle.shipped("pelican")
    window = fast_loop.fly(vehicle, SECONDS, seed, every=every, share=share, speed=speed)
    found = fit([window], vehicle, FitOptions(iterations=0, seed=seed))
    return np.array([np.log(found.theta[2] / vehicle.initial[2]), found.uncertainty.sigma[2]])


def spread(error: FloatArray, sigma: FloatArray) -> tuple[str, str]:
    """Cells: share inside 95 %, median half-width."""
    return f"{100 * np.mean(np.abs(error) < 1.96 * sigma):.0f} %", f"{196 * np.median(sigma):.2f}"


def feedback(flights: int, processes: int) -> list[str]:
    """The loop at 500 Hz logged at 10, 50, 100 Hz."""
    rows = []
    for every, share, speed in ((10, 0.0, 0.0), (10, 0.2, 0.0), (10, 0.2, 0.005), (5, 0.2, 0.005), (50, 0.2, 0.005)):
        error, sigma = np.array(pooled(looped, [(s, every, share, speed) for s in range(flights)], processes)).T
        bias = f"{100 * error.mean():+.1f} ± {100 * error.std() / np.sqrt(flights):.1f}"
        rows.append((f"{500 / every:.0f} Hz", f"{share:.0%}", f"{speed:.1%}", bias, *spread(error, sigma)))
    heads = ("log", "random moments", "noise of speeds", "J_xx [%]", "inside 95 %", "half-width, median [%]")
    return [
        f"{flights} flights of {SECONDS:.0f} s each: a stabiliser at 500 Hz reads a gyro of 0.01 rad/s and an attitude "
        "estimator fed by it; the log holds mean commands.  Random moments of 0.3 s.",
        "",
        *table(heads, rows),
    ]


def lagging(job: tuple[int, float]) -> FloatArray:
    """One flight with a hidden motor lag [s]: errors and sigma of J_xx, J_yy without and with `LATE`, (2, 2, 2)."""
    seed, lag = job
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, seed)
    numbers = truth.as_dict()
    window = fly(craft, truth, SECONDS, seed, effects={"motor_lag": {"tau": lag}} if lag else {}).window
    vehicle, names = poor_guess(craft, numbers, seed), ("J_xx", "J_yy")
    track, out = from_window(window, vehicle), []
    for free in ((), LATE):
        found = estimate(Problem.of([track], vehicle, free, [window]))
        values, sigma = zip(*map(found.value, names), strict=True)
        out.append([np.log(np.divide(values, [numbers[n] for n in names])), sigma])
    return np.array(out)


def late(flights: int, processes: int) -> list[str]:
    """A hidden motor lag, with and without the family of late causes among the free parameters."""
    rows = []
    for lag in (0.0, 0.03, 0.04):
        found = np.array(pooled(lagging, [(300 + s, lag) for s in range(flights)], processes))
        for free, (error, sigma) in zip(("the six", "and the family"), found.transpose(1, 2, 0, 3), strict=True):
            rows.append((f"{1e3 * lag:.0f} ms", free, f"{100 * error.mean():+.1f}", *spread(error, sigma)))
    heads = ("motor lag", "free", "J_xx, J_yy, mean error [%]", "inside 95 %", "half-width, median [%]")
    about = f"{flights} flights of {SECONDS:.0f} s a row, drawn Pelicans.  The family: {', '.join(LATE)}."
    return [about, "", *table(heads, rows)]


def recorded(data: Path) -> list[str]:
    """Recorded vehicles, with rotor drag, damping, centre of gravity and delay free."""
    rows = []
    for folder, files, rate in RECORDED:
        vehicle = Vehicle.named(data / folder / "vehicle.yaml")
        tracks = []
        for name in files:
            log = open_log(data / folder / name)
            windows = [] if rate is None else grid_recording(log, vehicle, rate).windows
            tracks += [from_window(w, vehicle, air=True) for w in windows] or [from_recording(log, vehicle, air=True)]
        found = estimate(Problem.of(tracks, vehicle, FREE))
        delay, sigma = found.value("command_delay.delay")
        acted = smoothed(found)
        force = size(acted, force=True)[0] / acted[0].weight
        moment = size(acted, force=False)[0] / control_size(acted)
        rows.append(
            (
                f"`{folder}` {', '.join(f.removesuffix('.csv') for f in files)}",
                rate or "own",
                *(f"{v:.4g} ± {196 * s:.1f} %" for v, s in map(found.value, ("b", "J_xx", "J_yy"))),
                f"{1e3 * delay:.1f} ± {1.96e3 * sigma:.1f}",
                f"force {force.max():.1%}, moment {moment[0]:.0%}, {moment[1]:.0%}",
                KNOWN[folder],
            )
        )
    return [
        "Free: the six, " + ", ".join(FREE) + ", trim moment and biases a flight.  ± 95 %.  Missing: rms of the "
        "smoothed random force as a share of weight, and moment as a share of the rotors' (roll, pitch).",
        "",
        *table(("data", "grid", "b", "J_xx", "J_yy", "delay [ms]", "missing", "known"), rows),
    ]


def single(data: Path) -> list[str]:
    """Single flights of one vehicle, identified one by one: whether their intervals hold each other, what is left."""
    rows, white = [], []
    for folder, pattern in SINGLE.items():
        vehicle = Vehicle.named(data / folder / "vehicle.yaml")
        logs = [quadid.load(path, vehicle) for path in sorted((data / folder).glob(pattern))]
        found = [quadid.identify(log).parameters for log in logs]
        for name in ("b", "J_xx", "J_yy"):
            known = [p[name] for p in found if p[name].status is Status.IDENTIFIED]
            half = [np.log(p.ci95[1] / p.value) for p in known]
            agree = [
                abs(np.log(p.value / q.value)) < np.hypot(a, b)
                for (p, a), (q, b) in combinations(zip(known, half, strict=True), 2)
            ]
            values = f"{min(p.value for p in known):.4g} to {max(p.value for p in known):.4g}" if known else "–"
            width = f"{np.median(half):.1%}" if known else "–"
            rows.append(
                (f"`{folder}`", name, f"{len(known)} of {len(found)}", values, width, f"{sum(agree)} of {len(agree)}")
            )
        tracks = [[from_window(w, vehicle, air=True) for w in log.windows] for log in logs]
        left = [w for track in tracks for w in estimate(Problem.of(track, vehicle, FREE)).whitened]
        for group, channel in enumerate(("gyro", "attitude", "accelerometer", "velocity")):
            parts = [w[w[:, 3 * group] != 0.0, 3 * group : 3 * group + 3] for w in left]
            square = np.mean([np.mean(z**2) for z in parts if len(z)])
            follows = [np.mean([np.mean(z[lag:] * z[:-lag]) for z in parts if len(z)]) / square for lag in range(1, 11)]
            white.append(
                (f"`{folder}`", channel, f"{square:.2f}", f"{follows[0]:+.2f}", f"{max(follows[1:], key=abs):+.2f}")
            )
    return [
        "Values called identified by `identify`, and pairs of flights whose difference lies within both intervals.",
        "",
        *table(("data", "parameter", "identified", "values", "half-width, median", "pairs that agree"), rows),
        "",
        "Innovations over their standard deviations, parameters free as for recorded vehicles: mean square, and "
        "autocorrelation at lag 1 and where it is largest at lags 2 to 10.",
        "",
        *table(("data", "channel", "mean square", "lag 1", "lags 2 to 10"), white),
    ]


def speed() -> list[str]:
    """Time of `identify` for a flight of 500 s at 50 Hz, calm and in gusts, and of one filter pass."""
    begin, craft = time.perf_counter(), Vehicle.shipped("pelican")
    truth = draw_truth(craft, 1)
    vehicle = poor_guess(craft, truth.as_dict(), 1)
    fit([fly(craft, truth, 20.0, 1, outside=GUSTS).window], vehicle)
    told = [f"First fit of a fresh process, kernels compiled or loaded: {time.perf_counter() - begin:.1f} s."]
    for air, outside in (("calm", {}), ("in gusts", GUSTS)):
        window = fly(craft, truth, 500.0, 1, outside=outside).window
        begin, own = time.perf_counter(), time.process_time()
        fit([window], vehicle)
        whole, own = time.perf_counter() - begin, time.process_time() - own
        told.append(
            f"500 s at 50 Hz, {air}, swarm of 64 x 60, noise, intervals: {whole:.1f} s on the clock, {own:.1f} s of "
            "processor time."
        )
    problem = Problem.of([from_window(window, vehicle)], vehicle)
    z, psi = problem.start(), problem.first_noise()
    begin = time.thread_time()
    problem.objective(z, psi)
    once = time.thread_time() - begin
    each = f"One filter pass {once:.2f} s, {1e6 * once / len(window):.1f} us a step.  On a machine with other work."
    return ["  ".join([*told, each])]


PARTS: Mapping[str, tuple[str, Callable[[Given], Sequence[str]]]] = {
    "exact": ("Simulated flights, exact model", lambda g: simulated(False, g.flights, g.processes)),
    "gusty": ("The same in gusts", lambda g: simulated(True, g.flights, g.processes)),
    "guesses": ("Guesses far off", lambda g: guesses(max(g.flights // 3, 3))),
    "loop": ("A loop faster than its log", lambda g: feedback(max(g.flights // 5, 4), g.processes)),
    "late": ("A hidden motor lag", lambda g: late(max(g.flights // 10, 4), g.processes)),
    "recorded": ("Recorded vehicles", lambda g: recorded(g.data)),
    "single": ("Single flights of recorded vehicles", lambda g: single(g.data)),
    "speed": ("Speed", lambda g: speed()),
}

if __name__ == "__main__":
    given = options(__doc__, PARTS, flights=60, processes=2)
    for part in given.parts:
        title, measured = PARTS[part]
        command = f"`python -m quadid_evaluation.studies.filter_error --parts {part} --flights {given.flights}`"
        put(given, "filter-error.md", "The estimator", part, [f"## {title}", "", command, "", *measured(given)])
