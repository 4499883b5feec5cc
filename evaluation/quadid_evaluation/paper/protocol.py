"""Computation of `quadid reproduce`: the paper's flights, every column of its tables, and what it lacks."""

import datetime
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np

from quadid.app.logs import GRID, load, write_recording, write_text
from quadid.app.outcome import Advance
from quadid.chi_square import Z95
from quadid.diagnosis import diagnose
from quadid.flight import fly
from quadid.identification.controller_gains import find_autopilot
from quadid.identification.fit import FitOptions, fit
from quadid.identification.particle_swarm import Stop, Swarm
from quadid.identification.result import mse_score
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, JsonDict
from quadid.vehicle import Stabiliser, Vehicle
from quadid.version import __version__
from quadid_evaluation.optimisers.minimise import algorithm_1, minimise
from quadid_evaluation.paper.black_box import fit_black_box, score_black_box
from quadid_evaluation.paper.objective import PaperBox, PaperScore
from quadid_evaluation.paper.subspace import METHODS

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
    """Amount of work."""

    seconds: float = 500.0
    particles: int = 32
    iterations: int = 40
    seeds: int = 3


SPENT = ("quasi_newton", "pso", "pso_polish")
"""Searches on the paper's objective, whose effort is told."""
QUICK = Plan(60.0, 32, 25, 2)


@dataclass
class Column:
    """One column of the tables: a model and how it was found.

    Attributes:
        evaluations, seconds: spent on finding it.
        others: parameter vectors of other seeds.
    """

    theta: FloatArray
    evaluations: int = 0
    seconds: float = 0.0
    others: list[FloatArray] = field(default_factory=list)


def reproduce(
    folder: Path, plan: Plan, seed: int, advance: Advance, command: str
) -> tuple[JsonDict, dict[str, list[PaperScore]]]:
    """Flies, fits and scores all.

    Args:
        command: that renews the result.

    Returns:
        All numbers as JSON, of the form ``quadid.reproduce/1``; by column, the paper's score on each set.
    """
    begin = time.perf_counter()
    # The three sets, written as logs and read back as any other log; the first trains.
    base, sets, logs = Vehicle.named(VEHICLE), [], []
    folder.mkdir(parents=True, exist_ok=True)
    place = folder.resolve()
    for i in range(3):
        advance(f"fly set {i + 1}", i / 3)
        flight = fly(base, seconds=plan.seconds, seed=10 * seed + i, effects=EFFECTS, command_rate=STABILISER_RATE)
        path = place / f"set{i + 1}.mcap"
        write_recording(path, flight.recording)
        sets.append(load(path, _with(base, flight.gains, STABILISER_RATE), rate=GRID).windows)
        logs.append(str(path))
    vehicle = _with(base, flight.gains, SIMULATED_RATE)
    write_text(place / "pelican.yaml", vehicle.to_yaml())
    values = flight.truth.parameters.as_dict()
    truth = {name: values[name] for name in NOMINAL_NAMES}
    train, unseen = sets[0], [w for windows in sets[1:] for w in windows]

    # The paper's columns, all on its objective: initial guess, quasi-Newton, its swarm; and the swarm polished.
    autopilot = find_autopilot(train, vehicle)
    assert autopilot is not None  # its gains are in the vehicle file
    problem, *others = (PaperBox(windows, vehicle, autopilot) for windows in sets)
    columns = {"initial": Column(problem.theta(problem.start))}
    for i, name in enumerate(("quasi_newton", "pso_polish")):
        advance(f"{name} on the paper's objective", i / 2)
        inside = (problem.start, problem.lower, problem.upper)
        found = minimise(name, problem.cost, *inside, BUDGET, seed, problem.residual, time.perf_counter)
        columns[name] = Column(problem.theta(found.x), found.evaluations, found.seconds)
    runs = []
    for i in range(plan.seeds):
        advance("swarm on the paper's objective", i / plan.seeds)
        runs.append(_algorithm_1(problem, plan, seed + i))
    columns["pso"] = sorted(runs, key=lambda run: run[0])[(len(runs) - 1) // 2][1]
    columns["pso"].others = [column.theta for _, column in runs]

    # Quadid's own: the nominal model identified, and extended by what the diagnosis finds; and the truth.
    nominal = fit(train, vehicle, FitOptions(seed=seed), progress=advance)
    diagnosis, search = diagnose(train, vehicle, unseen, seed, advance)
    noise = search.shooting.noise  # one noise for all columns: that which the better model leaves
    columns |= {"identified": Column(nominal.theta, nominal.evaluations), "extended": Column(search.model.theta)}
    exact = columns["initial"].theta.copy()
    exact[: len(truth)] = list(truth.values())
    layout = Layout(vehicle)
    perfect = layout.neutral()
    perfect[: len(truth)] = list(truth.values())
    layout.write_effects(perfect, EFFECTS)
    columns |= {"true_nominal": Column(exact), "perfect": Column(perfect)}

    # Scores, of subspace models too.
    advance("score", 0.0)
    paper = {name: [p.score(c.theta) for p in (problem, *others)] for name, c in columns.items()}
    mse = {n: [mse_score(w, vehicle, c.theta, noise).mse for w in sets] for n, c in columns.items()}
    orders = {}
    for i, method in enumerate(METHODS):
        advance(method, i / len(METHODS))
        box = fit_black_box(method, train, noise)
        mse[method] = [score_black_box(box, windows, vehicle, noise) for windows in sets]
        orders[method] = box.model.order

    spread = Vehicle.from_yaml(diagnosis.vehicle_yaml).parameters
    parameters = {}
    for i, name in enumerate(NOMINAL_NAMES):
        p, extended, sigma = nominal.parameters[name], columns["extended"].theta[i], spread[name].sigma
        half = Z95 * (np.nan if sigma is None else sigma)
        parameters[name] = {
            "truth": truth[name],
            **{c: float(columns[c].theta[i]) for c in ("initial", *SPENT, "identified", "extended")},
            "pso_seeds": [float(theta[i]) for theta in columns["pso"].others],
            "ci95": list(p.ci95),
            "status": p.status.value.replace("_", " ") + (f" to {p.relative_to}" if p.relative_to else ""),
            "extended_ci95": [float(extended - half), float(extended + half)],
        }
    result = {
        "schema": "quadid.reproduce/1", "date": datetime.date.today().isoformat(), "version": __version__,
        "command": command, "seed": seed, "seconds": time.perf_counter() - begin,
        "flight": {
            "seconds": plan.seconds, "stabiliser_rate": STABILISER_RATE, "effects": EFFECTS, "truth": truth,
            "logs": logs,
        },
        "swarm": {"particles": plan.particles, "iterations": plan.iterations, "seeds": plan.seeds},
        "mse_paper": {name: [s.mse for s in scores] for name, scores in paper.items()},
        "fit_percent": {name: [s.fit_percent for s in scores] for name, scores in paper.items()},
        "mse": mse, "noise_floor": 1.0, "orders": orders, "parameters": parameters,
        "correlations": nominal.parameters.correlation, "verdict": diagnosis.verdict.value.replace("_", " "),
        "findings": [finding.to_dict() for finding in diagnosis.findings],
        "effort": {n: {"evaluations": columns[n].evaluations, "seconds": columns[n].seconds} for n in SPENT},
    }  # fmt: skip
    return result, paper


def _with(base: Vehicle, gains: Mapping[str, float], rate: float) -> Vehicle:
    """The vehicle with its stabiliser."""
    return base.model_copy(update={"stabiliser": Stabiliser(gains=dict(gains), rate=rate)})


def _algorithm_1(problem: PaperBox, plan: Plan, seed: int) -> tuple[float, Column]:
    """One run of the paper's Algorithm 1, the guess among its particles; returns the cost and the column.

    As printed (global best, inertia weight, positions clamped to the box), but that the particles of an iteration are
    evaluated together and not one after the other.
    """
    begin = time.perf_counter()
    options = replace(algorithm_1(plan.iterations), update="batch", initial_points=problem.start[None], tolerance=1e-4)
    swarm = Swarm(problem.lower, problem.upper, plan.particles, seed, options)
    while swarm.stop is Stop.RUNNING:
        swarm.tell(problem.cost(swarm.ask()))
    return swarm.best_cost, Column(problem.theta(swarm.best), swarm.evaluations, time.perf_counter() - begin)
