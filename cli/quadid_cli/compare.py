"""`quadid compare`: the swarm beside other optimisers and beside black-box models, on the same flights."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.errors import ParameterError, nearest
from quadid_cli.identify import GRID
from quadid_cli.options import (
    JsonTarget,
    Logs,
    OutFolder,
    Preset,
    Rate,
    Seed,
    Start,
    Stop,
    Unchecked,
    Validate,
    VehicleName,
)

if TYPE_CHECKING:
    from quadid.baselines.comparison import Problem, Tried
    from quadid.identify.controller_gains import Autopilot
    from quadid.identify.noise_model import NoiseModel
    from quadid.vehicle import Vehicle
    from quadid.window import Window
    from quadid_cli.loading import Log
    from quadid_cli.terminal import Advance

JsonDict = dict[str, Any]
OBJECTIVES = ("shooting", "closed_loop")
"""What optimisers may be asked to minimise."""


def compare(
    logs: Logs,
    vehicle: VehicleName,
    validate: Validate = None,
    method: Annotated[
        list[str] | None,
        typer.Option("--method", metavar="NAME", help="Only this method; may be given again. Default: all ten."),
    ] = None,
    seeds: Annotated[int, typer.Option("--seeds", metavar="N", min=1, help="Runs of each random method.")] = 3,
    budget: Annotated[
        int, typer.Option("--budget", metavar="N", min=100, help="Simulations of the data that each run may spend.")
    ] = 4000,
    objective: Annotated[
        str,
        typer.Option(
            "--objective",
            metavar="NAME",
            help="What optimisers minimise: shooting (short stretches, initial states estimated) or closed_loop (the "
            "paper's: the whole set under its stabiliser, from references and throttle).",
        ),
    ] = "shooting",
    seed: Seed = 1,
    rate: Rate = None,
    start: Start = None,
    stop: Stop = None,
    preset: Preset = "auto",
    unchecked: Unchecked = False,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Set the initial guess, quasi-Newton, least squares, swarms, evolution, CVA and MOESP side by side."""
    from quadid.baselines.comparison import METHODS, check_methods
    from quadid_cli import loading, output, terminal

    output.check_file(json, "--json")
    output.out_folder(out)
    names = check_methods(method or METHODS)
    if objective not in OBJECTIVES:
        raise ParameterError(f"unknown objective '{objective}'", ", ".join(OBJECTIVES), nearest(objective, OBJECTIVES))
    described = loading.load_vehicle(vehicle)
    hertz = GRID if rate is None else rate
    train = loading.load_logs(logs, described, hertz, start, stop, preset, unchecked)
    held = loading.load_logs(validate or [], described, hertz, start, stop, preset, unchecked)
    with terminal.progress() as advance:
        result = run(described, train, held, names, range(seed, seed + seeds), budget, objective, advance)
    output.write_json(result, json)
    show(result, quiet=json == "-")
    terminal.warn([text for log in (*train, *held) for text in log.warnings])


def run(
    vehicle: Vehicle, train: Sequence[Log], held: Sequence[Log], names: Sequence[str], seeds: Sequence[int],
    budget: int, objective: str, advance: Advance,
) -> JsonDict:  # fmt: skip
    """Runs every method and scores what it found.

    Args:
        vehicle: initial guess, bounds, known effects.
        train: logs to fit.
        held: logs to score only.
        names: methods.
        seeds: one run of each random method a seed.
        budget: simulations of the data a run may spend.
        objective: one of `OBJECTIVES`.
        advance: told how far it is.
    """
    from quadid.baselines import comparison
    from quadid.baselines.subspace import METHODS as BLACK_BOXES
    from quadid.identify.controller_gains import find_autopilot
    from quadid.identify.fit import FitOptions, fit
    from quadid_cli.searching import check_length

    windows, unseen = [w for log in train for w in log.windows], [log.windows for log in held]
    check_length(windows)
    noise = fit(windows, vehicle, FitOptions(seed=seeds[0]), progress=lambda _, share: advance("noise", share)).noise
    judge = Judge(vehicle, noise, windows, unseen, find_autopilot(windows, vehicle))
    problem = judge.problem(objective)
    tried, boxes = {}, {}
    for i, name in enumerate(names):
        advance(name, i / len(names))
        if name in BLACK_BOXES:
            boxes[name] = judge.black_box(name)
        else:
            tried[name] = comparison.run_optimiser(name, problem, seeds, budget, time.perf_counter)
    lowest = comparison.lowest_cost(list(tried.values()))
    scored = {name: judge.optimiser(m, lowest, problem) for name, m in tried.items()}
    return {
        "schema": "quadid.compare/1", "vehicle": vehicle.name, "objective": objective, "budget": budget,
        "seeds": list(seeds), "noise_floor": 1.0, "train": [log.recording.name for log in train],
        "validate": [log.recording.name for log in held],
        "methods": [scored[name] if name in scored else boxes[name] for name in names],
    }  # fmt: skip


@dataclass(frozen=True)
class Judge:
    """Scores what any method found on the same data.

    Attributes:
        vehicle: initial guess, bounds, known effects.
        noise: sensor noise.
        train: training windows.
        unseen: windows of each validation log.
        autopilot: the stabiliser, or None where it is not known.
    """

    vehicle: Vehicle
    noise: NoiseModel
    train: Sequence[Window]
    unseen: Sequence[Sequence[Window]]
    autopilot: Autopilot | None

    def problem(self, objective: str) -> Problem:
        """The problem that optimisers solve; raises NotIdentifiableError where the data do not hold what it needs."""
        from quadid.errors import NotIdentifiableError
        from quadid.identify.paper_objective import PaperProblem
        from quadid.identify.shooting_objective import BoxProblem

        if objective == "shooting":
            return BoxProblem(self.train, self.vehicle)
        if self.autopilot is None:
            raise NotIdentifiableError(
                "the stabiliser is not known", "references in the log, or gains in the vehicle file",
                "give `stabiliser: {gains: ...}`, or use --objective shooting",
            )  # fmt: skip
        return PaperProblem(self.train, self.vehicle, self.autopilot)

    def optimiser(self, method: Tried, lowest: float, problem: Problem) -> JsonDict:
        """One optimiser's entry of the result."""
        from quadid.baselines.comparison import Scores, optimiser_entry
        from quadid.identify.paper_objective import paper_score
        from quadid.identify.score import mse_score
        from quadid.parameters import NOMINAL_NAMES

        theta = problem.theta(method.typical.point)
        sets = (self.train, *self.unseen)
        train, *validate = (mse_score(part, self.vehicle, theta, self.noise).mse for part in sets)
        flown = [paper_score(part, self.vehicle, theta, self.autopilot) for part in sets]
        paper = [math.nan if s is None else s.mse for s in flown]
        parameters = dict(zip(NOMINAL_NAMES, theta[: len(NOMINAL_NAMES)].tolist(), strict=True))
        told = None if self.autopilot is None else Scores(paper[0], tuple(paper[1:]))
        return optimiser_entry(method, lowest, Scores(train, tuple(validate)), told, parameters)

    def black_box(self, name: str) -> JsonDict:
        """Fits and scores one subspace method; one that cannot be fitted to these data has failed, and says why."""
        from quadid.baselines.black_box import fit_black_box, score_black_box
        from quadid.baselines.comparison import Scores, black_box_entry, failed_entry
        from quadid.errors import QuadidError

        begin = time.perf_counter()
        try:
            box = fit_black_box(name, self.train, self.noise)
            seconds = time.perf_counter() - begin
            sets = (self.train, *self.unseen)
            train, *validate = (score_black_box(box, part, self.vehicle, self.noise) for part in sets)
        except QuadidError as error:
            return failed_entry(name, str(error))
        return black_box_entry(name, Scores(train, tuple(validate)), box.model.order, box.tried + 1, seconds)


def show(result: JsonDict, quiet: bool) -> None:
    """Prints the table for people."""
    from rich.table import Table

    from quadid_cli import terminal
    from quadid_cli.tables import number

    console = terminal.console(quiet)
    table = Table(title="Methods on the same data (error over 1 s stretches, 1 = noise floor)")
    columns = ("method", "train", *result["validate"], "paper's MSE", "evaluations", "seconds", "failed", "remark")
    for heading in columns:
        table.add_column(heading, justify="left" if heading in ("method", "remark") else "right")
    for m in result["methods"]:
        held = m["mse"]["validate"] or [None] * len(result["validate"])
        table.add_row(
            m["name"], number(m["mse"]["train"]), *(number(v) for v in held),
            number(None if m["mse_paper"] is None else m["mse_paper"]["train"]), str(m["evaluations"]),
            number(m["seconds"], 3), f"{m['failures']}/{m['runs']}", m.get("note", m.get("stop", "")),
        )  # fmt: skip
    console.print(table)
    console.print(
        f"failed: runs that ended above 1.01 times the lowest cost of all; at most {result['budget']} simulations a run"
    )
