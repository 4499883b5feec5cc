"""Identification: fits the parameters of a vehicle to flight logs, and scores the fit on them and on others."""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from numbers import Integral
from typing import TYPE_CHECKING, Annotated, Any

import numpy as np
import typer
from quadid_evaluation.optimisers.minimise import minimise

from quadid.app.logs import Log, file_name, remembered, settled
from quadid.app.missing import Beside, compared
from quadid.app.options import Bounds, Fix, Free, KnownEffects, Logs, OfVehicle, Priors, Seed, Validate
from quadid.app.outcome import (
    LIBRARY,
    Advance,
    Fitted,
    UnansweredError,
    known,
    provenance,
    quality,
    silent,
    told,
    with_ends,
)
from quadid.checks.findings import farthest
from quadid.data.window import Window
from quadid.errors import ParameterError, nearest
from quadid.model.layout import Layout, with_reference_voltage
from quadid.parameters import NOMINAL_NAMES, ParameterSet
from quadid.report.tables import Cell, Column, TextTable, heads, number, parameter_table
from quadid.report.verdict import Verdict, identify_verdict
from quadid.sanitise import LONGEST_LINE, plain
from quadid.types import FloatArray, Json
from quadid.vehicle import Proof, Vehicle
from quadid.version import __version__

if TYPE_CHECKING:
    from quadid.identification.controller_gains import Autopilot
    from quadid.identification.fit import Fit
    from quadid.identification.result import ScoredSet

# --- The searches that an identification offers, behind one call


OPTIMIZERS = (
    "pso_polish",
    "pso",
    "initial",
    "quasi_newton",
    "least_squares",
    "cma_es",
    "l_shade",
    "differential_evolution",
    "pso_algorithm_1",
)
FITS = ("p", "q", "r", "a_z")
"""Channels whose fit is printed."""
BUDGET = 4000
"""Simulations of the data that any search but the standard one may spend."""


def check_optimizer(optimizer: str) -> None:
    """Raises ParameterError for an unknown search, with the nearest known one."""
    if optimizer not in OPTIMIZERS:
        raise ParameterError(f"unknown optimizer '{optimizer}'", ", ".join(OPTIMIZERS), nearest(optimizer, OPTIMIZERS))


def check_seed(seed: int) -> None:
    """Raises ParameterError for a seed that no generator takes."""
    if not isinstance(seed, Integral) or seed < 0:
        raise ParameterError(f"seed {seed}", "a whole number from 0 on")


def search(
    name: str,
    windows: Sequence[Window],
    vehicle: Vehicle,
    seed: int,
    advance: Advance,
    out_of_reach: Mapping[str, str] | None = None,
    names: Sequence[str] | None = None,
    off: Mapping[str, float] | None = None,
) -> Fit:
    """Identifies the parameters with the search called `name`.

    The sensor noise, which decides intervals and scores, always comes from the standard fit; with the other searches
    the parameters are where that search ended, not where the standard fit ends.  Parameters `out_of_reach` of the
    channels, with the reason, keep the file's value; intervals hold how far the log's doubts put estimates `off`.

    Raises:
        ParameterError: another search with `names` to free.
    """
    from quadid.identification.fit import FitOptions, final_answer, fit

    if name == OPTIMIZERS[0]:
        return fit(windows, vehicle, FitOptions(seed=seed), names, advance, out_of_reach, off)
    if names is not None:
        raise ParameterError(f"free or fix with {name}, which fits the six", OPTIMIZERS[0], "leave optimizer out")

    from quadid_evaluation.optimisers.box import BoxProblem, fit_at

    standard = fit(windows, vehicle, FitOptions(seed=seed), progress=lambda stage, share: advance("noise", share))
    advance(name, 0.0)
    problem = BoxProblem(windows, vehicle)
    found = minimise(name, problem.cost, problem.start, problem.lower, problem.upper, BUDGET, seed, problem.residual)
    at = fit_at(windows, vehicle, problem.theta(found.x), standard.noise, found.evaluations, str(found.stop))
    return final_answer(at, out_of_reach or {}, off)


# --- Identification: fits the parameters of a vehicle to flight logs, and scores the fit on them and on others


@dataclass(frozen=True, repr=False)
class Identified(Fitted):
    """Result of an identification.

    Attributes:
        result: of the form ``quadid.identify/1``; ``vehicle_file`` is None until a file is written.
    """

    title = "Identification"
    fit: Fit

    @property
    def parameters(self) -> ParameterSet:
        """Parameters with intervals, statuses and covariance."""
        return self.fit.parameters

    @property
    def vehicle(self) -> Vehicle:
        """The vehicle with what was found; ``vehicle.save("mine.yaml")`` writes it."""
        from quadid.identification.result import fitted_vehicle

        fit, sets = self.fit, self.result["sets"]
        return proven(fitted_vehicle(fit), fit.vehicle, self.verdict, sets, self.train, self.beside)

    @property
    def file_name(self) -> str:
        """Name of the vehicle file, ``pelican.fitted.yaml``."""
        return f"{file_name(self.fit.vehicle.name)}.fitted.yaml"

    @property
    def verdict(self) -> Verdict:
        """Checks whether the result may be used, and what to do next."""
        return identify_verdict(self.result)

    @property
    def opening(self) -> list[Cell]:
        """Basis of the values."""
        return [Cell(f"{self.fit.vehicle.name}: {known(self.fit.vehicle)}, from its file. All values depend on these.")]

    def tables(self, truth: Mapping[str, float] | None = None) -> list[TextTable]:
        """Parameters, beside the truth of a simulation, and how well each log is followed."""
        columns = (*heads("log | role | current > | fitted >"), *(Column(f"fit {n}", right=True, rank=1) for n in FITS))
        rows = []
        for s in self.result["sets"]:
            errors = (number(s["mse"][key], 3) for key in ("initial", "fitted"))
            fits = [s["fit_percent"].get(n) for n in FITS]
            told = ("-" if v is None or not math.isfinite(v) else f"{max(v, -999.0):.0f} %" for v in fits)
            rows.append((s["log"], s["role"], *errors, *told))
        title = "Squared errors, relative to what the model expects (1: as large as expected)"
        followed = TextTable(title, columns, tuple(rows))
        return [parameter_table(self.result["parameters"], truth), followed]

    def records(self) -> list[dict[str, Any]]:
        """One row a parameter."""
        found = zip(self.result["parameters"], self.parameters, strict=True)
        return [with_ends({**p, "sigma": fitted.sigma}) for p, fitted in found]

    def sample(self, n: int, seed: int = 0) -> tuple[FloatArray, dict[str, str]]:
        """Draws vehicles from the joint covariance, for `quadid.Simulator(fit.vehicle, thetas)`.

        Args:
            n: number of vehicles.
            seed: decides them.

        Returns:
            Full parameter vectors, shape (n, size); and, by name, why a parameter has only a floor for its spread:
            not identified by this flight, or an effect that the vehicle file states and no flight fitted, which stays
            as it is.
        """
        values, floors = self.parameters.sample(n, seed)
        layout = Layout(self.vehicle)
        thetas = np.repeat(layout.initial(self.vehicle)[None], n, axis=0)
        thetas[:, [layout.entry(name).index for name in self.parameters.names]] = values
        fitted = {name.split(".")[0] for name in self.parameters.names}
        held = [*(n for n in NOMINAL_NAMES if n not in fitted), *(e for e in self.vehicle.effects if e not in fitted)]
        return thetas, floors | dict.fromkeys(held, "as in the vehicle file, without a spread")

    def plot(self, log: int = -1, group: str = "rates") -> Any:
        """Measured and simulated outputs of one log as a plotly figure.

        Args:
            log: which of the logs, in the order given, training logs first; -1 is the last.
            group: rates, attitude, accel, velocity or position.
        """
        from quadid.report.figures import channel_plot

        return channel_plot(self.sets[log], group)

    def page(self, command: str = LIBRARY) -> str:
        """The page: parameters, errors of every log, correlations, what the flights excite."""
        from quadid.report.figures import MOST_LOGS
        from quadid.report.fit_pages import correlation_section, flight_section

        result, fit = self.result, self.fit
        searched = f"{result['optimizer']}, {fit.evaluations} simulations of the data; {fit.outcome.value}"
        file = result["vehicle_file"] or "not written"
        own = {"seed": result["seed"], "search": searched, "vehicle file": file, "taken as known": known(fit.vehicle)}
        rows = provenance(self.logs, command, own)
        flights = [flight_section(log.recording, fit.vehicle, i) for i, log in enumerate(self.logs[:MOST_LOGS])]
        more = [correlation_section(fit.parameters), *(f for f in flights if f is not None)]
        lacking = None if self.forces is None else self.forces.section()
        return self.written_up(f"Identification of {result['vehicle']}", lacking, more, self.logs, rows)

    def written_up(
        self,
        title: str,
        lacking: Json | None,
        more: Sequence[Json],
        logs: Sequence[Log],
        origin: Sequence[Json],
        truth: Mapping[str, float] | None = None,
    ) -> str:
        """The page, with other sections among its own; arguments as of `identify_sections` and `rendered`."""
        from quadid.report.fit_pages import identify_sections, quality_section

        after = [told(self.fit, self.train), quality_section([quality(log) for log in logs], self.fit.noise)]
        sections = identify_sections(self.result, self.sets, lacking, more, after, truth)
        subtitle = f"{self.used('fitted')}; search {self.result['optimizer']}, {self.result['seconds']:.1f} s"
        return self.rendered(title, subtitle, sections, origin)


def identify(
    logs: Logs,
    validate: Validate = (),
    *,
    vehicle: OfVehicle = None,
    optimizer: Annotated[
        str, typer.Option("--optimizer", metavar="NAME", help=f"How to search: {', '.join(OPTIMIZERS)}.")
    ] = OPTIMIZERS[0],
    seed: Seed = 1,
    free: Free = (),
    fix: Fix = (),
    bounds: Bounds = None,
    priors: Priors = None,
    effects: KnownEffects = None,
    advance: Advance = silent,
) -> Identified:
    """Fits b, d, J_xx, J_yy, J_zz and J_r to flight logs; states how well each is known, and how well they predict.

    Args:
        logs: a log or several, as paths or from `load`.
        validate: flights that are scored only.
        vehicle: initial guess and known effects; default that of the first loaded log.
        optimizer: one of `OPTIMIZERS`.
        seed: of all random numbers.
        free: numbers of known effects to fit beside the six, as ``motor_lag.tau``, from their present values.
        fix: parameters of the six that keep the file's value.
        bounds: of parameters of the six, instead of the file's.
        priors: value and standard deviation of parameters of the six, instead of the file's.
        effects: known effects, beside or instead of the file's.
        advance: called with the stage and the share done.

    Raises:
        UnansweredError: the data reveal no parameter.
        NotIdentifiableError: too little data.
        LogError: a log that does not fit the vehicle.
        ParameterError: an unknown search, parameter or effect, or nothing left to fit.
    """
    from quadid.identification.controller_gains import find_autopilot
    from quadid.identification.result import answered, fitted_vehicle, identify_result, parameter_entry

    check_optimizer(optimizer)
    check_seed(seed)
    # Logs on the grid, and the vehicle as stated: its guesses, bounds, priors and known effects.
    given = settled(logs, validate, vehicle)
    train, held = given.train, given.held
    windows = [w for log in train for w in log.windows]
    described = stated(with_reference_voltage(given.vehicle, windows), bounds or {}, priors or {}, effects or {})
    names = freed(described, free, fix)
    # The fit.
    begin = time.perf_counter()
    off = farthest([log.off for log in train])
    fit = search(optimizer, windows, described, seed, advance, out_of_reach(train), names, off)
    seconds = time.perf_counter() - begin
    # How well guess and fit predict each log, and what force and moment they miss.
    guess = Layout(fit.vehicle).initial(fit.vehicle)
    forces, squares = compared(train, held, fit.vehicle, {"nominal": fit.theta}, {"initial": guess}, advance)
    advance("scores", 0.0)
    autopilot, flown = find_autopilot(windows, described), [*train, *held]
    roles = ["train"] * len(train) + ["validate"] * len(held)
    sets = [
        scored(log, role, fit, autopilot, (square["initial"], square["nominal"]))
        for log, role, square in zip(flown, roles, squares, strict=True)
    ]
    result = identify_result(fit, optimizer, seed, seconds, sets, None, given.warnings)
    for entry, log in zip(result["sets"], flown, strict=True):
        entry["seconds"] = log.grid.seconds_used
    result["missing"] = None if forces is None else forces.result()
    if identify_verdict(result).level == "poor":
        fit = replace(fit, parameters=fit.parameters.unreliable(fit.parameters.names))
        result["parameters"] = [parameter_entry(p) for p in fit.parameters]
    advance("random forces", 0.0)
    beside = None if forces is None else forces.beside(fitted_vehicle(fit), terms=False)
    done = Identified(result, sets, flown, forces, beside, fit)
    result["verdict"] = done.verdict.level
    if not answered(fit.parameters):
        raise UnansweredError(done)
    return done


def stated(
    vehicle: Vehicle,
    bounds: Mapping[str, tuple[float, float]],
    priors: Mapping[str, tuple[float, float]],
    effects: Mapping[str, Mapping[str, float]],
) -> Vehicle:
    """The vehicle with bounds, priors and effects that a caller states; checked as a file is.

    Raises:
        ParameterError: a name that is none of the six.
        VehicleError: what no vehicle can have.
    """
    if not (bounds or priors or effects):
        return vehicle
    values = dict(vehicle.parameters)
    for name in (*bounds, *priors):
        if name not in NOMINAL_NAMES:
            raise ParameterError(f"unknown parameter '{name}'", ", ".join(NOMINAL_NAMES), nearest(name, NOMINAL_NAMES))
    for name, (low, high) in bounds.items():
        values[name] = values[name].model_copy(update={"bounds": (float(low), float(high))})
    for name, (value, sigma) in priors.items():
        values[name] = values[name].model_copy(update={"initial": float(value), "sigma": float(sigma)})
    known = {name: {k: float(v) for k, v in numbers.items()} for name, numbers in effects.items()}
    changed = vehicle.model_copy(update={"parameters": values, "effects": {**vehicle.effects, **known}})
    return Vehicle.from_yaml(changed.to_yaml(), f"{vehicle.name}, as stated")


def freed(vehicle: Vehicle, free: Sequence[str], fix: Sequence[str]) -> list[str] | None:
    """Names to fit: the six without `fix`, and `free`; None for the six.

    Raises:
        ParameterError: an unknown name, an effect that the vehicle does not have, or nothing left.
    """
    if not free and not fix:
        return None
    layout = Layout(vehicle)
    for name in fix:
        if name not in NOMINAL_NAMES:
            raise ParameterError(f"fix '{name}'", ", ".join(NOMINAL_NAMES), nearest(name, NOMINAL_NAMES))
    added = [layout.entry(name).name for name in free if name not in NOMINAL_NAMES]
    for name in added:
        effect = name.split(".")[0]
        if effect not in vehicle.effects:
            raise ParameterError(
                f"free '{name}': the vehicle has no {effect}",
                "numbers of its effects",
                f"begin somewhere: effects={{'{effect}': {{...}}}}",
            )
    names = [*(name for name in NOMINAL_NAMES if name not in fix), *added]
    if not names:
        raise ParameterError("every parameter is fixed", "at least one to fit", "fix fewer")
    return names


def out_of_reach(logs: Sequence[Log]) -> dict[str, str]:
    """Parameters that no log can show, because a channel is missing or too slow, each with the reason."""
    from quadid.checks.findings import parameter_outlook
    from quadid.checks.motion import channel_facts

    outlooks = [parameter_outlook(channel_facts(log.recording)) for log in logs]
    each = [{o.parameter: o.reason for o in outlook if not o.possible} for outlook in outlooks]
    return {name: each[0][name] for name in each[0] if all(name in one for one in each)} if each else {}


def scored(log: Log, role: str, fit: Fit, autopilot: Autopilot | None, mse: tuple[float, float]) -> ScoredSet:
    """Scores the initial guess and the fit on one log; as the paper does, too, where the stabiliser is known."""
    from quadid_evaluation.paper.objective import paper_score

    from quadid.identification.result import ScoredSet, mse_score

    initial = Layout(fit.vehicle).initial(fit.vehicle)
    before, after = (mse_score(log.windows, fit.vehicle, theta, fit.noise) for theta in (initial, fit.theta))
    flown = [paper_score(log.windows, fit.vehicle, theta, autopilot) for theta in (initial, fit.theta)]
    paper = None if flown[0] is None or flown[1] is None else (flown[0].mse, flown[1].mse)
    return ScoredSet(log.recording.name, role, before, after, paper, mse)


def proven(
    vehicle: Vehicle,
    former: Vehicle,
    verdict: Verdict,
    sets: Sequence[Mapping[str, Any]],
    train: Sequence[Log],
    beside: Beside | None,
) -> Vehicle:
    """The vehicle with what was found beside its values, their proof, and where it all comes from.

    A red fit keeps the guesses and bounds of the former file, without `sigma`.

    Args:
        vehicle: with the fitted values; former: as it was given.
        sets: its scored logs, as in ``quadid.identify/1``.
        train: the logs that were fitted.
        beside: what acts beside its values; None keeps what its file has.
    """
    unseen = [s for s in sets if s["role"] == "validate"]
    errors = [s["mse"]["fitted"] for s in unseen]
    proof = Proof(
        verdict=verdict.level,
        unseen=tuple(s["log"] for s in unseen),
        error=max(errors) if errors and all(math.isfinite(e) for e in errors) else None,
        fitted=remembered(train, vehicle),
    )
    whole = vehicle if beside is None else beside.in_vehicle(vehicle)
    update: dict[str, Any] = {"proof": proof}
    if verdict.level == "poor":
        guesses = {n: p.model_copy(update={"sigma": None}) for n, p in former.parameters.items()}
        update |= {"parameters": guesses, "correlation": {}}
    # Sources of a fitted vehicle file
    lines = [f"Fitted by quadid {__version__}; `initial` with a `sigma` was fitted, without it was not. From:"]
    lines += [f"  {log.recording.name}  sha256 {log.recording.sha256 or 'unknown'}" for log in train]
    return whole.model_copy(update=update).with_remark("\n".join(plain(line, LONGEST_LINE) for line in lines))
