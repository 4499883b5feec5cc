"""What `quadid reproduce` computes: the paper's flights, every column of its tables, and what it lacks."""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from quadid.app.outcome import Advance
    from quadid.data.window import Window
    from quadid.diagnosis import Diagnosis
    from quadid.identification.fit import Fit
    from quadid.identification.noise import NoiseModel
    from quadid.identification.paper_objective import PaperScore
    from quadid.types import FloatArray
    from quadid.vehicle import Vehicle
    from quadid_evaluation.optimisers.box import PaperBox

VEHICLE = "pelican"
EFFECTS = {
    "motor_lag": {"tau": 0.035},
    "rotor_drag": {"k_x": 0.30, "k_y": 0.26},
    "cg_offset": {"x": 0.002, "y": -0.0015},
    "axial_inflow": {"k_z": 0.25},
}
"""What the flown vehicle has and the nominal model lacks; sizes as measured on vehicles of this class."""
STABILISER_RATE = 1000.0
"""On board, as in the paper [Hz]."""
SIMULATED_RATE = 200.0
"""At which the simulation being fitted runs the stabiliser [Hz]: a fifth of the time of the full rate."""
BUDGET = 400
"""Simulations that quasi-Newton may spend; it converges in fewer."""


@dataclass(frozen=True)
class Plan:
    """How much is done.

    Attributes:
        seconds: of each flight.
        particles, iterations, seeds: of the paper's swarm.
    """

    seconds: float = 500.0
    particles: int = 32
    iterations: int = 40
    seeds: int = 3


QUICK = Plan(60.0, 32, 25, 2)


@dataclass(frozen=True)
class Protocol:
    """The flights and what is known about the vehicle.

    Attributes:
        vehicle: nominal, with the gains of its stabiliser.
        sets: windows of the three sets, the first for training.
        truth: the six true parameters by name.
        perfect: full parameter vector of the flown vehicle.
        logs: where the flights were written.
    """

    vehicle: Vehicle
    sets: list[list[Window]]
    truth: Mapping[str, float]
    perfect: FloatArray
    logs: list[str]


@dataclass
class Column:
    """One column of the tables: a model and how it was found.

    Attributes:
        theta: full parameter vector.
        evaluations, seconds: spent on finding it.
        others: parameter vectors of other seeds.
    """

    theta: FloatArray
    evaluations: int = 0
    seconds: float = 0.0
    others: list[FloatArray] = field(default_factory=list)


@dataclass(frozen=True)
class Reproduced:
    """Everything the tables and figures need.

    Attributes:
        protocol: flights.
        columns: models by name.
        fit: quadid's own identification of the nominal model.
        diagnosis: of set 1, validated on the others.
        sigma: standard deviations of the extended model's six parameters.
        noise: sensor noise that the scores are measured by.
        paper: by column, the paper's score on each set.
        mse: by column, the score over 1 s stretches on each set; subspace models too.
        orders: of the subspace models.
    """

    protocol: Protocol
    columns: dict[str, Column]
    fit: Fit
    diagnosis: Diagnosis
    sigma: Mapping[str, float]
    noise: NoiseModel
    paper: dict[str, list[PaperScore]]
    mse: dict[str, list[float]]
    orders: dict[str, int]


def reproduce(folder: Path, plan: Plan, seed: int, advance: Advance) -> Reproduced:
    """Flies, fits and scores all.

    Args:
        folder: for the logs.
        plan: how much.
        seed: of flights and searches.
        advance: told how far it is.
    """
    from quadid.identification.controller_gains import find_autopilot
    from quadid.identification.score import mse_score
    from quadid_evaluation.optimisers.box import PaperBox

    flown = fly(folder, plan, seed, advance)
    train, vehicle = flown.sets[0], flown.vehicle
    autopilot = find_autopilot(train, vehicle)
    assert autopilot is not None  # its gains are in the vehicle file
    problems = [PaperBox(windows, vehicle, autopilot) for windows in flown.sets]
    columns = _searches(problems[0], plan, seed, advance)
    fit, diagnosis, extended, noise = _own(flown, seed, advance)
    columns |= {"identified": Column(fit.theta, fit.evaluations), "extended": Column(extended)}
    nominal = columns["initial"].theta.copy()
    nominal[: len(flown.truth)] = list(flown.truth.values())
    columns |= {"true_nominal": Column(nominal), "perfect": Column(flown.perfect)}
    advance("score", 0.0)
    paper = {name: [p.score(c.theta) for p in problems] for name, c in columns.items()}
    mse = {n: [mse_score(w, vehicle, c.theta, noise).mse for w in flown.sets] for n, c in columns.items()}
    boxes, orders = _black_boxes(flown, noise, advance)
    sigma = extended_sigma(diagnosis)
    return Reproduced(flown, columns, fit, diagnosis, sigma, noise, paper, mse | boxes, orders)


def fly(folder: Path, plan: Plan, seed: int, advance: Advance) -> Protocol:
    """Flies the three sets, writes them as logs, and reads them back as any other log."""
    from quadid.app.logs import GRID, load, load_vehicle, write_recording, write_text
    from quadid.flight import fly as fly_once
    from quadid.model.layout import Layout
    from quadid.parameters import NOMINAL_NAMES
    from quadid.vehicle import Stabiliser

    base, sets, logs = load_vehicle(VEHICLE), [], []
    folder.mkdir(parents=True, exist_ok=True)
    place = folder.resolve()
    for i in range(3):
        advance(f"fly set {i + 1}", i / 3)
        flight = fly_once(base, seconds=plan.seconds, seed=10 * seed + i, effects=EFFECTS, command_rate=STABILISER_RATE)
        path = place / f"set{i + 1}.mcap"
        write_recording(path, flight.recording)
        flown = base.model_copy(update={"stabiliser": Stabiliser(gains=dict(flight.gains), rate=STABILISER_RATE)})
        sets.append(load(path, flown, rate=GRID).windows)
        logs.append(str(path))
    vehicle = base.model_copy(update={"stabiliser": Stabiliser(gains=dict(flight.gains), rate=SIMULATED_RATE)})
    write_text(place / "pelican.yaml", vehicle.to_yaml())
    values = flight.truth.parameters.as_dict()
    truth = {name: values[name] for name in NOMINAL_NAMES}
    layout = Layout(vehicle)
    perfect = layout.neutral()
    perfect[: len(truth)] = list(truth.values())
    layout.write_effects(perfect, EFFECTS)
    return Protocol(vehicle, sets, truth, perfect, logs)


def _searches(problem: PaperBox, plan: Plan, seed: int, advance: Advance) -> dict[str, Column]:
    """The paper's columns, all on its objective: initial guess, quasi-Newton, its swarm; and the swarm polished."""
    from quadid_evaluation.optimisers.minimise import minimise

    columns = {"initial": Column(problem.theta(problem.start))}
    for i, name in enumerate(("quasi_newton", "pso_polish")):
        advance(f"{name} on the paper's objective", i / 2)
        found = minimise(
            name, problem.cost, problem.start, problem.lower, problem.upper, BUDGET, seed, problem.residual,
            time.perf_counter,
        )  # fmt: skip
        columns[name] = Column(problem.theta(found.x), found.evaluations, found.seconds)
    runs = []
    for i in range(plan.seeds):
        advance("swarm on the paper's objective", i / plan.seeds)
        runs.append(algorithm_1(problem, plan, seed + i))
    ranked = sorted(runs, key=lambda run: run[0])
    median = ranked[(len(ranked) - 1) // 2][1]
    median.others = [column.theta for _, column in runs]
    columns["pso"] = median
    return columns


def algorithm_1(problem: PaperBox, plan: Plan, seed: int) -> tuple[float, Column]:
    """One run of the paper's Algorithm 1, the guess among its particles; returns the cost and the column.

    As printed (global best, inertia weight, positions clamped to the box), but that the particles of an iteration are
    evaluated together and not one after the other.
    """

    from quadid.identification.particle_swarm import Stop, Swarm, SwarmOptions

    begin = time.perf_counter()
    options = replace(
        SwarmOptions.algorithm_1(plan.iterations), update="batch", initial_points=problem.start[None], tolerance=1e-4
    )
    swarm = Swarm(problem.lower, problem.upper, plan.particles, seed, options)
    while swarm.stop is Stop.RUNNING:
        swarm.tell(problem.cost(swarm.ask()))
    seconds = time.perf_counter() - begin
    return swarm.best_cost, Column(problem.theta(swarm.best), swarm.evaluations, seconds)


def _own(flown: Protocol, seed: int, advance: Advance) -> tuple[Fit, Diagnosis, FloatArray, NoiseModel]:
    """Quadid's own columns: the nominal model identified, and extended by what the diagnosis finds."""

    from quadid.diagnosis import diagnose
    from quadid.identification.fit import FitOptions, fit

    train, unseen = flown.sets[0], [w for windows in flown.sets[1:] for w in windows]
    found = fit(train, flown.vehicle, FitOptions(seed=seed), progress=lambda stage, share: advance(stage, share))
    diagnosis, search = diagnose(train, flown.vehicle, unseen, seed, advance)
    # One noise for all columns: that which the better model leaves.
    noise = search.shooting.noise
    return replace(found, noise=noise), diagnosis, search.model.theta, noise


def _black_boxes(flown: Protocol, noise: NoiseModel, advance: Advance) -> tuple[dict[str, list[float]], dict[str, int]]:
    from quadid_evaluation.paper.black_box import fit_black_box, score_black_box
    from quadid_evaluation.paper.subspace import METHODS

    scores, orders = {}, {}
    for i, method in enumerate(METHODS):
        advance(method, i / len(METHODS))
        box = fit_black_box(method, flown.sets[0], noise)
        scores[method] = [score_black_box(box, windows, flown.vehicle, noise) for windows in flown.sets]
        orders[method] = box.model.order
    return scores, orders


def extended_sigma(diagnosis: Diagnosis) -> dict[str, float]:
    """Standard deviations of the extended model's six parameters, from its vehicle file; NaN where there is none."""
    from quadid.vehicle import Vehicle

    told = Vehicle.from_yaml(diagnosis.vehicle_yaml).parameters
    return {name: prior.sigma if prior.sigma is not None else float("nan") for name, prior in told.items()}
