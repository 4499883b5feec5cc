"""The swarm beside other optimisers and beside black-box models on the same flights: `quadid compare`.

Optimisers all minimise one objective in one box from one start, and may spend one budget; each is run with several
seeds.  Subspace models are fitted to the same windows.  Whatever found it, a model is scored as every other.
"""

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import typer

from quadid.app.identify import check_seed
from quadid.app.logs import settled
from quadid.app.options import Logs, OfVehicle, Seed, Typed, Validate
from quadid.app.outcome import Advance, Outcome, silent
from quadid.errors import NotIdentifiableError, ParameterError, QuadidError, nearest
from quadid.parameters import NOMINAL_NAMES
from quadid.report.tables import Cell, Column, TextTable, number
from quadid.types import JsonDict
from quadid_evaluation.optimisers.minimise import NAMES, Result, minimise
from quadid_evaluation.paper.subspace import METHODS as BLACK_BOXES

METHODS = (
    "initial",
    "quasi_newton",
    "least_squares",
    "pso",
    "pso_polish",
    "cma_es",
    "l_shade",
    "differential_evolution",
    *BLACK_BOXES,
)
"""Methods by name, in the order of the table."""
KNOWN = (*METHODS, *(name for name in NAMES if name not in METHODS))
"""All names that may be asked for."""
SEEDLESS = ("initial", "quasi_newton", "least_squares")
"""Optimisers without randomness: run once, whatever the number of seeds."""
SUCCESS = 1.01
"""A run has failed when its cost is above this multiple of the lowest cost that any run of any method found."""
BLACK_BOX = "a black box: predicts, gives no physical parameters"
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
            Column("method"),
            *(Column(name, right=True) for name in ("train", *validate)),
            Column("paper's MSE", right=True, rank=1),
            Column("evaluations", right=True),
            Column("seconds", right=True),
            Column("failed", right=True),
            Column("remark", rank=2),
        )
        rows = tuple(
            (
                m["name"],
                number(m["mse"]["train"]),
                *(number(v) for v in m["mse"]["validate"] or [None] * len(validate)),
                number(None if m["mse_paper"] is None else m["mse_paper"]["train"]),
                str(m["evaluations"]),
                number(m["seconds"], 3),
                f"{m['failures']}/{m['runs']}",
                m.get("note", m.get("stop", "")),
            )
            for m in self.records()
        )
        title = "Methods on the same data (error over 1 s of simulation, 1 = noise floor)"
        return [TextTable(title, columns, rows)]

    @property
    def sentences(self) -> list[Cell]:
        """Definition of a run that failed."""
        most = f"at most {self.result['budget']} simulations a run"
        return [Cell(f"failed: runs that ended above {SUCCESS} times the lowest cost of all; {most}")]

    def records(self) -> list[dict[str, Any]]:
        """One row a method."""
        return list(self.result["methods"])


def check_names(methods: Sequence[str] | None, objective: str) -> Sequence[str]:
    """The methods to run, each once, in the order of the table; raises ParameterError for unknown names."""
    for name in methods or ():
        if name not in KNOWN:
            raise ParameterError(f"unknown method '{name}'", ", ".join(KNOWN), nearest(name, KNOWN))
    if objective not in OBJECTIVES:
        raise ParameterError(f"unknown objective '{objective}'", ", ".join(OBJECTIVES), nearest(objective, OBJECTIVES))
    return tuple(name for name in KNOWN if name in (methods or METHODS))


def compare(
    logs: Logs,
    validate: Validate = (),
    *,
    vehicle: OfVehicle = None,
    methods: Annotated[Sequence[str] | None, Typed(list[str] | None, typer.Option("--method", metavar="NAME"))] = None,
    seeds: Annotated[int, typer.Option(metavar="N", min=1)] = 3,
    budget: Annotated[int, typer.Option(metavar="N", min=100)] = 4000,
    objective: Annotated[str, typer.Option(metavar="NAME")] = OBJECTIVES[0],
    seed: Seed = 1,
    advance: Advance = silent,
) -> Methods:
    """Sets the initial guess, quasi-Newton, least squares, swarms, evolution, CVA and MOESP side by side.

    Args:
        logs: a log or several to fit, as paths or from `load`.
        validate: flights that are scored only.
        vehicle: initial guess, bounds, known effects; default that of the first loaded log.
        methods: only these; all ten by default.
        seeds: runs of each random method.
        budget: simulations of the data that each run may spend.
        objective: what optimisers minimise: shooting (short stretches, initial states estimated) or closed_loop (the
            paper's: the whole set under its stabiliser, from references and throttle).
        seed: of the first run; the others have the following ones.

    Raises:
        ParameterError: an unknown method or objective.
        NotIdentifiableError: too little data, or no stabiliser for the closed loop.
    """
    from quadid.identification.controller_gains import find_autopilot
    from quadid.identification.fit import FitOptions, fit
    from quadid.identification.result import mse_score
    from quadid_evaluation.optimisers.box import BoxProblem
    from quadid_evaluation.paper.black_box import fit_black_box, score_black_box
    from quadid_evaluation.paper.objective import PaperBox, paper_score

    names = check_names(methods, objective)
    if seeds < 1:
        raise ParameterError("no seed", "one or more", "for example seeds=3")
    check_seed(seed)
    given = settled(logs, validate, vehicle)
    craft, train, held = given.vehicle, given.train, given.held
    windows = [w for log in train for w in log.windows]
    sets = [windows, *(log.windows for log in held)]
    noise = fit(windows, craft, FitOptions(seed=seed), progress=lambda _, share: advance("noise", share)).noise
    autopilot = find_autopilot(windows, craft)
    if objective == "shooting":
        problem: BoxProblem | PaperBox = BoxProblem(windows, craft)
    elif autopilot is not None:
        problem = PaperBox(windows, craft, autopilot)
    else:
        raise NotIdentifiableError(
            "the stabiliser is not known",
            "references in the log, or gains in the vehicle file",
            "give `stabiliser: {gains: ...}`, or use --objective shooting",
        )

    # Fits, every optimiser with every seed.
    p, boxes = problem, dict[str, JsonDict]()
    runs: dict[str, list[tuple[int, Result]]] = {}
    for i, name in enumerate(names):
        advance(name, i / len(names))
        if name in BLACK_BOXES:
            begin = time.perf_counter()
            try:
                box = fit_black_box(name, windows, noise)
                seconds = time.perf_counter() - begin
                scores = [score_black_box(box, part, craft, noise) for part in sets]
                more = {"order": box.model.order, "failures": 0, "note": BLACK_BOX}
                boxes[name] = _entry(name, scores, None, box.tried + 1, seconds) | {"runs": 1, **more}
            except QuadidError as error:  # cannot be fitted to these data
                more = {"failures": 1, "note": str(error)}
                boxes[name] = _entry(name, [math.nan], None, 0, math.nan) | {"runs": 1, **more}
        else:
            runs[name] = [
                (s, minimise(name, p.cost, p.start, p.lower, p.upper, budget, s, p.residual, time.perf_counter))
                for s in range(seed, seed + (1 if name in SEEDLESS else seeds))
            ]

    # Scores: the run of median cost, the lower one of two, stands for an optimiser.
    lowest = min((found.cost for tried in runs.values() for _, found in tried), default=math.inf)
    for name, tried in runs.items():
        chosen, found = sorted(tried, key=lambda run: run[1].cost)[(len(tried) - 1) // 2]
        theta = problem.theta(found.x)
        scores = [mse_score(part, craft, theta, noise).mse for part in sets]
        judged = (paper_score(part, craft, theta, autopilot) for part in sets)
        paper = None if autopilot is None else [math.nan if s is None else s.mse for s in judged]
        boxes[name] = _entry(name, scores, paper, found.evaluations, found.seconds) | {
            "cost": found.cost,
            "parameters": dict(zip(NOMINAL_NAMES, theta[:6].tolist(), strict=True)),
            "seed": chosen,
            "stop": found.stop.value,
            "runs": len(tried),
            "failures": sum(not run.cost <= SUCCESS * lowest for _, run in tried),
            "trials": [
                {"seed": s, "cost": run.cost, "evaluations": run.evaluations, "seconds": run.seconds}
                for s, run in tried
            ],
        }
    result = {
        "schema": "quadid.compare/1",
        "vehicle": craft.name,
        "objective": objective,
        "budget": budget,
        "seeds": list(range(seed, seed + seeds)),
        "noise_floor": 1.0,
        "train": [log.recording.name for log in train],
        "validate": [log.recording.name for log in held],
        "methods": [boxes[name] for name in names],
    }
    return Methods(result, tuple(text for log in (*train, *held) for text in log.warnings))


def _entry(name: str, mse: Sequence[float], paper: list[float] | None, evaluations: int, seconds: float) -> JsonDict:
    """Entries of every method in ``quadid.compare/1``; `mse` and `paper` are its scores on each set."""
    return {
        "name": name,
        "mse": {"train": mse[0], "validate": list(mse[1:])},
        "mse_paper": None if paper is None else {"train": paper[0], "validate": paper[1:]},
        "evaluations": evaluations,
        "seconds": seconds,
        "parameters": {},
    }
