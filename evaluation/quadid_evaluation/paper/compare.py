"""The swarm beside other optimisers and beside black-box models, on the same flights."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any

import typer

from quadid.app.identify import check_seed
from quadid.app.logs import settled
from quadid.app.options import Logs, OfVehicle, Seed, Typed, Validate
from quadid.app.outcome import Advance, Outcome, silent
from quadid.data.window import Window
from quadid.errors import NotIdentifiableError, ParameterError, QuadidError, nearest
from quadid.parameters import NOMINAL_NAMES
from quadid.report.tables import Cell, Column, TextTable, number
from quadid.types import JsonDict
from quadid.vehicle import Vehicle
from quadid_evaluation.paper import comparison
from quadid_evaluation.paper.comparison import (
    METHODS,
    Problem,
    Scores,
    Tried,
    black_box_entry,
    check_methods,
    failed_entry,
    optimiser_entry,
)
from quadid_evaluation.paper.subspace import METHODS as BLACK_BOXES

if TYPE_CHECKING:
    from quadid.identification.controller_gains import Autopilot
    from quadid.identification.noise import NoiseModel

OBJECTIVES = ("shooting", "closed_loop")
"""What optimisers may be asked to minimise."""


@dataclass(frozen=True, repr=False)
class Methods(Outcome):
    """Methods beside each other; `result` has the form ``quadid.compare/1``."""

    result: dict[str, Any]
    notes: tuple[str, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """Faults of the logs."""
        return list(self.notes)

    def tables(self) -> list[TextTable]:
        """One row a method."""
        validate = self.result["validate"]
        columns = (
            Column("method"), *(Column(name, right=True) for name in ("train", *validate)),
            Column("paper's MSE", right=True, rank=1), Column("evaluations", right=True),
            Column("seconds", right=True), Column("failed", right=True), Column("remark", rank=2),
        )  # fmt: skip
        rows = tuple(
            (
                m["name"], number(m["mse"]["train"]),
                *(number(v) for v in m["mse"]["validate"] or [None] * len(validate)),
                number(None if m["mse_paper"] is None else m["mse_paper"]["train"]), str(m["evaluations"]),
                number(m["seconds"], 3), f"{m['failures']}/{m['runs']}", m.get("note", m.get("stop", "")),
            )
            for m in self.records()
        )  # fmt: skip
        title = "Methods on the same data (error over 1 s of simulation, 1 = noise floor)"
        return [TextTable(title, columns, rows)]

    @property
    def sentences(self) -> list[Cell]:
        """Definition of a run that failed."""
        most = f"at most {self.result['budget']} simulations a run"
        return [Cell(f"failed: runs that ended above 1.01 times the lowest cost of all; {most}")]

    def records(self) -> list[dict[str, Any]]:
        """One row a method."""
        return list(self.result["methods"])


def check_names(methods: Sequence[str] | None, objective: str) -> Sequence[str]:
    """The methods to run; raises ParameterError for an unknown method or objective."""

    names = check_methods(methods or METHODS)
    if objective not in OBJECTIVES:
        raise ParameterError(f"unknown objective '{objective}'", ", ".join(OBJECTIVES), nearest(objective, OBJECTIVES))
    return names


def compare(
    logs: Logs, validate: Validate = (), *, vehicle: OfVehicle = None,
    methods: Annotated[
        Sequence[str] | None,
        Typed(
            list[str] | None,
            typer.Option("--method", metavar="NAME", help="Only this method; repeatable. Default: all ten."),
        ),
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
    ] = OBJECTIVES[0],
    seed: Seed = 1, advance: Advance = silent,
) -> Methods:  # fmt: skip
    """Runs every method and scores what it found.

    Args:
        logs: a log or several to fit, as paths or from `load`.
        validate: flights that are scored only.
        vehicle: initial guess, bounds, known effects; default that of the first loaded log.
        methods: names; all by default.
        seeds: runs of each random method.
        budget: simulations of the data a run may spend.
        objective: one of `OBJECTIVES`.
        seed: of the first run; the others have the following ones.
        advance: told how far it is.

    Raises:
        ParameterError: an unknown method or objective.
        NotIdentifiableError: too little data, or no stabiliser for the closed loop.
    """
    from quadid.identification.controller_gains import find_autopilot
    from quadid.identification.fit import FitOptions, fit

    names = check_names(methods, objective)
    if seeds < 1:
        raise ParameterError("no seed", "one or more", "for example seeds=3")
    check_seed(seed)
    each = range(seed, seed + seeds)
    given = settled(logs, validate, vehicle)
    described, train, held = given.vehicle, given.train, given.held
    windows, unseen = [w for log in train for w in log.windows], [log.windows for log in held]
    noise = fit(windows, described, FitOptions(seed=seed), progress=lambda _, share: advance("noise", share)).noise
    judge = Judge(described, noise, windows, unseen, find_autopilot(windows, described))
    problem = judge.problem(objective)
    tried, boxes = {}, {}
    for i, name in enumerate(names):
        advance(name, i / len(names))
        if name in BLACK_BOXES:
            boxes[name] = judge.black_box(name)
        else:
            tried[name] = comparison.run_optimiser(name, problem, each, budget, time.perf_counter)
    lowest = comparison.lowest_cost(list(tried.values()))
    scored = {name: judge.optimiser(m, lowest, problem) for name, m in tried.items()}
    result = {
        "schema": "quadid.compare/1", "vehicle": described.name, "objective": objective, "budget": budget,
        "seeds": list(each), "noise_floor": 1.0, "train": [log.recording.name for log in train],
        "validate": [log.recording.name for log in held],
        "methods": [scored[name] if name in scored else boxes[name] for name in names],
    }  # fmt: skip
    return Methods(result, tuple(text for log in (*train, *held) for text in log.warnings))


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
        from quadid_evaluation.optimisers.box import BoxProblem, PaperBox

        if objective == "shooting":
            return BoxProblem(self.train, self.vehicle)
        if self.autopilot is None:
            raise NotIdentifiableError(
                "the stabiliser is not known", "references in the log, or gains in the vehicle file",
                "give `stabiliser: {gains: ...}`, or use --objective shooting",
            )  # fmt: skip
        return PaperBox(self.train, self.vehicle, self.autopilot)

    def optimiser(self, method: Tried, lowest: float, problem: Problem) -> JsonDict:
        """One optimiser's entry of the result."""
        from quadid.identification.paper_objective import paper_score
        from quadid.identification.score import mse_score

        theta = problem.theta(method.typical.found.x)
        sets = (self.train, *self.unseen)
        train, *validate = (mse_score(part, self.vehicle, theta, self.noise).mse for part in sets)
        flown = [paper_score(part, self.vehicle, theta, self.autopilot) for part in sets]
        paper = [math.nan if s is None else s.mse for s in flown]
        parameters = dict(zip(NOMINAL_NAMES, theta[: len(NOMINAL_NAMES)].tolist(), strict=True))
        told = None if self.autopilot is None else Scores(paper[0], tuple(paper[1:]))
        return optimiser_entry(method, lowest, Scores(train, tuple(validate)), told, parameters)

    def black_box(self, name: str) -> JsonDict:
        """Fits and scores one subspace method; one that cannot be fitted to these data has failed, and says why."""
        from quadid_evaluation.paper.black_box import fit_black_box, score_black_box

        begin = time.perf_counter()
        try:
            box = fit_black_box(name, self.train, self.noise)
            seconds = time.perf_counter() - begin
            sets = (self.train, *self.unseen)
            train, *validate = (score_black_box(box, part, self.vehicle, self.noise) for part in sets)
        except QuadidError as error:
            return failed_entry(name, str(error))
        return black_box_entry(name, Scores(train, tuple(validate)), box.model.order, box.tried + 1, seconds)
