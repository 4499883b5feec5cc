"""The diagnosis from windows to verdict: fit, noise floor, selection, remainder, validation."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import cache
from typing import NamedTuple

import numpy as np

from quadid.blas import one_thread
from quadid.data.window import DataFault, Window, data_faults, without_copies
from quadid.diagnosis.evidence import (
    NominalFit,
    better,
    cause_gains,
    impossible_causes,
    late_unknown,
    slight_causes,
    stated_errors,
    unproven_causes,
)
from quadid.diagnosis.hypotheses import BLOCKS, Model, candidates, fit_model, free_names, refit, without
from quadid.diagnosis.residual_tests import Remainder, inconstant_causes, remainder
from quadid.diagnosis.result import Diagnosis, Explanation, describe
from quadid.diagnosis.rough_air import RoughAir, in_rough_air
from quadid.diagnosis.search import LINEAR_MISFIT, Search, from_everything, pruned, select
from quadid.effects import EFFECTS
from quadid.identification.filter_error import filtered
from quadid.identification.fit import (
    FAR_ITERATIONS,
    NO_FILTER,
    SWARM_SECONDS,
    Fit,
    FitOptions,
    Progress,
    beside_random_forces,
    check_windows,
    flexible_fit,
    possible_moments,
    residual_noise,
    swarm_search,
    tied,
)
from quadid.identification.gauss_newton import polish
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting
from quadid.identification.result import with_values
from quadid.identification.uncertainty import SPREAD_LIMIT, parameter_set
from quadid.model.layout import with_reference_voltage
from quadid.parameters import NOMINAL_NAMES, Parameter
from quadid.types import FloatArray
from quadid.vehicle import Vehicle

# --- Numbers of a diagnosis: the selected model by the likelihood of innovations
#
# The selection follows simulated runs of short segments, each of which finds a state of its own: that takes a second
# for twenty models, but leaves much of what a flight shows unused, and moments that no model has, which the controller
# answers, pass for inertia there.  The selected model is then fitted as an identification fits
# (`quadid.identification.filter_error`), the numbers of its causes with it.


def fit_numbers(
    windows: Sequence[Window], short: Shooting, model: Model, noise: FloatArray | None = None
) -> Fit | None:
    """The fit of `model` by the likelihood of innovations: the six and what belongs to the vehicle of its causes.

    Args:
        windows: the data.
        short: segments of them, for the vehicle and its names.
        model: the selected one.
        noise: its noise numbers, if they are known.

    Returns:
        None where the filter has no finite answer.
    """
    flight = [n for c in model.causes if EFFECTS[c.effect].per_log for n in c.names]
    free = short.free([n for n in model.free.names if n not in flight])
    found = filtered(windows, short.vehicle, model.theta, free, flight, noise)
    return None if found is None else beside_random_forces(short, found, free)


def with_numbers(model: Model, found: Fit) -> Model:
    """`model` with the numbers of `found` and their covariance in place of its own; its residuals stay."""
    names = found.parameters.names
    places = np.array([model.free.names.index(n) for n in names])
    theta, covariance = model.theta.copy(), model.uncertainty.covariance.copy()
    index = model.free.index[places]
    theta[index] = found.theta[index]
    covariance[places], covariance[:, places] = 0.0, 0.0
    covariance[np.ix_(places, places)] = found.uncertainty.covariance
    return replace(model, theta=theta, known=replace(model.uncertainty, covariance=covariance))


# --- The diagnosis from windows to verdict: fit, noise floor, selection, remainder, validation


DECIDE_SECONDS = (4.0, 2.0, 1.0, 0.5)
"""Lengths of segments that may decide (the longest as `segment_schedule.USUAL_SECONDS` allows), longest first;
below them only the short ones of the first fit."""
NOISE_FELL = 0.7
"""Share below which a channel's noise variance must fall, once causes are known, for a selection with the new one."""
SHARE_TO_NAME = 0.8
"""Named causes must account for this share of all structure, else the answer is `unknown` …"""
SHARE_ALONE = 0.9
"""… and a cause that stands alone for this one: nothing else is there to have left the rest, so its form is wrong."""
LEAST_REMOVED = 0.3
"""Share of the squared missing force and moment that causes must take beside random forces to be named …"""
REMOVED_ALONE = 0.5
"""… and one that stands alone, as above."""
LEAST_STRUCTURE = 0.01
"""Structure below this share of the noise is not worth a word …"""
LEAST_OF_EXPLAINED = 1e-3
"""… nor below this share of what is explained: a huge effect is never described to the last digit."""


@one_thread()
def diagnose(
    windows: Sequence[Window],
    vehicle: Vehicle,
    validation: Sequence[Window] = (),
    seed: int = 0,
    progress: Progress | None = None,
    swarm: bool = False,
    nominal: Fit | None = None,
) -> tuple[Diagnosis, Search]:
    """Says what the simulation of `vehicle` gets wrong on `windows`, why, and what a better one gains.

    Args:
        windows: data to diagnose.
        vehicle: nominal vehicle; effects already in its file are kept as they are.
        validation: flights to measure the gain on; without them blocks of `windows` are left out.
        seed: for the swarm, where asked for, and drawn noise.
        progress: called with a stage and a fraction.
        swarm: search globally first, for poor initial guesses.
        nominal: identification of `windows`, where there is one: errors are stated with it.

    Raises:
        WindowError, NotIdentifiableError: as `quadid.identification.fit.fit`.
    """
    report = progress or (lambda stage, share: None)
    check_windows(windows)
    faults = data_faults([*windows, *validation])
    windows, validation = without_copies(windows), without_copies(validation)
    vehicle = with_reference_voltage(vehicle, windows)
    # Which causes, on short segments; their numbers and the vehicle's, by the likelihood of innovations.
    schedule, search = _selected(windows, vehicle, FitOptions(seed=seed) if swarm else None, report)
    plain = search.nominal
    alone = cache(lambda: nominal or fit_numbers(windows, schedule[-1], plain))
    data = _Data(windows, vehicle, validation, faults, nominal, alone)
    left = remainder(search.shooting, search.model, seed)
    answer = rough = None
    if judge(plain, search.model, left) is not Explanation.UNKNOWN:
        answer = _concluded(data, schedule[-1], search, left, report)
    # Where something remains and no cause is sure: beside random forces.
    sure = (Explanation.NOTHING_FOUND, Explanation.EXPLAINED)
    if answer is None or not (answer[0].verdict in sure or any(f.confident for f in answer[0].findings)):
        report("random forces", 0.0)
        rough = in_rough_air(windows, search)
    if rough is not None:
        search = with_causes_of(search, rough)
        left = remainder(search.shooting, search.model, seed)
    if answer is None or rough is not None:
        answer = _concluded(data, schedule[-1], search, left, report, rough)
    report("done", 1.0)
    return answer


class _Data(NamedTuple):
    """Data of a diagnosis, as `diagnose` has them, with what is wrong with them; `alone` fits no cause, once."""

    windows: Sequence[Window]
    vehicle: Vehicle
    validation: Sequence[Window]
    faults: Sequence[DataFault]
    nominal: Fit | None
    alone: Callable[[], Fit | None]


def _concluded(
    data: _Data, short: Shooting, search: Search, left: Remainder, report: Progress, rough: RoughAir | None = None
) -> tuple[Diagnosis, Search]:
    """The answer that a selection leads to, and the selection with the final numbers.

    Args:
        data: the data.
        short: short segments of them.
        search: the selection.
        left: what it leaves in segments.
        report: progress.
        rough: what it leaves beside random forces, if it was made there.
    """
    windows, vehicle, validation, faults, nominal, alone = data
    # Numbers.
    report("numbers", 0.0)
    decisive, selected = search.shooting, search.model
    found = (
        nominal
        if nominal and not selected.causes
        else fit_numbers(windows, short, selected, rough.model.psi if rough else None)
    )
    model = selected if found is None else with_numbers(selected, found)
    # What each cause gains on unseen data.
    report("validation", 0.0)
    fewer = {c.label: without(decisive, selected, c) for c in selected.causes}
    deciding, worth = cause_gains(decisive, search.nominal, selected, fewer, validation)
    plain = model if validation and not model.causes else search.nominal
    stated = nominal or NominalFit(vehicle, plain.theta, decisive.noise)
    # Blocks are left out of the fit to segments, at whose optimum their part in it is known.
    outcome = stated_errors(stated, model if validation else selected, windows, validation, deciding)
    # Doubtful causes, with numbers that no vehicle has or of another form, and the six beside the others.
    doubts = impossible_causes(model)
    doubts |= inconstant_causes(rough.model, rough.sites) if rough else inconstant_causes(selected, left.sites)
    doubted = {label: selected.free.step(selected.theta, fewer[label].theta) for label in doubts}
    slight = slight_causes(model) | unproven_causes(model, len(search.listed))

    def beside(without_causes: bool) -> tuple[tuple[Parameter, ...], tuple[str, ...], dict[str, str]]:
        fits = [found]
        if without_causes:
            fits.append(alone() if model.causes else nominal or found)
        parameters, reasons = _nominal_parameters(short, model, fits, doubted)
        parameters, moved = possible_moments(parameters)
        remarks = (*reasons, *([] if moved is None else [moved]))
        return parameters, remarks, late_unknown(model, parameters) | slight

    parameters, remarks, weak = beside(without_causes=bool(doubts))
    # The verdict: what doubtful causes take away counts as left, beside random forces what any takes that is not sure.
    taken = {w.cause.label: max(w.deviance, 0.0) for w in worth}
    if rough is None:
        verdict = judge(search.nominal, selected, left, sum(taken[label] for label in doubts))
    else:
        unsure = sum(taken[label] for label in doubts | weak)
        verdict = judge_in_rough_air(rough, unsure / max(sum(taken.values()), 1.0))
    saturated = any(f.kind == "saturated" for f in faults)
    # In gusts inertias that are too large, answering them as the autopilot did, predict best: no measure of causes.
    contradicted = outcome.contradicted and rough is None
    if model.causes and (contradicted or saturated or len(doubts) == len(model.causes)):
        verdict = Explanation.UNKNOWN
    if verdict is Explanation.UNKNOWN and not doubts:
        parameters, remarks, weak = beside(without_causes=True)
    # Findings; those are confident that nothing speaks against.
    alike = {c.family for c in model.causes if c.label in doubts}
    believed = [c for c in model.causes if c.family not in alike and c.label not in weak]
    search = replace(search, model=model)
    findings = describe(decisive, search, worth, [] if verdict is Explanation.UNKNOWN else believed)
    warnings = [
        *(f.text for f in faults),
        *(f"{reason}: it replaces another cause and is not confident" for reason in doubts.values()),
        *(f"{label} is not named with confidence: {reason}" for label, reason in weak.items()),
        *remarks,
    ]
    physical = with_values(vehicle, parameters, [c.effect for c in model.causes], model.theta)
    result = Diagnosis(
        verdict,
        findings,
        outcome,
        left,
        parameters,
        physical,
        "+".join([vehicle.name, *dict.fromkeys(f.effect for f in findings)]),
        tuple(warnings),
    )
    return result, search


def _nominal_parameters(
    short: Shooting, model: Model, fits: Sequence[Fit | None], doubted: Mapping[str, FloatArray]
) -> tuple[tuple[Parameter, ...], tuple[str, ...]]:
    """The nominal six beside the findings, as an identification gives them, and remarks on them.

    Args:
        short: segments, for names and the vehicle's guess.
        model: the selected one, with its final numbers.
        fits: its fit; where causes are doubtful or leave what has no name, also that without any cause: then numbers
            are as uncertain as in this one, and by the step to it.  None: the filter has no finite answer.
        doubted: step of the scaled parameters to a fit without each doubtful cause, by label.
    """
    free, initial = short.free(NOMINAL_NAMES), short.layout.initial(short.vehicle)
    finite = [f for f in fits if f is not None]
    if len(finite) < len(fits):
        rows = parameter_set(model.free, model.theta, initial, model.uncertainty).unreliable(NOMINAL_NAMES)
        return tuple(p for p in rows if p.name in NOMINAL_NAMES), (NO_FILTER,)
    found, *alone = finite
    nominal, reasons = tuple(p for p in found.parameters if p.name in NOMINAL_NAMES), found.warnings
    for without_causes in alone:
        steps = [free.step(model.theta, without_causes.theta), *(step[: len(nominal)] for step in doubted.values())]
        nominal = parameter_set(free, model.theta, initial, without_causes.uncertainty.differing(steps)).parameters
    for label, step in doubted.items():
        moved = [n for n, s in zip(NOMINAL_NAMES, step, strict=False) if abs(s) > SPREAD_LIMIT]
        if moved:
            reasons = (*reasons, f"{', '.join(moved)}: more than {SPREAD_LIMIT:.0%} different without {label}")
    for cause in model.causes:
        nominal = tied(nominal, EFFECTS[cause.effect].ties)
    return nominal, reasons


def _selected(
    windows: Sequence[Window], vehicle: Vehicle, swarm: FitOptions | None, report: Progress
) -> tuple[list[Shooting], Search]:
    """Selects causes: the data cut into segments of falling length under the noise that is left, and the search."""
    # 1. The nominal model on short segments.
    short = Shooting.cut(windows, vehicle, SWARM_SECONDS)
    free = short.free(NOMINAL_NAMES)
    start = short.layout.initial(vehicle)
    if swarm is not None:
        settings = replace(swarm.swarm, iterations=swarm.iterations)
        start, _ = swarm_search(short, start, free, settings, swarm.particles, swarm.seed, report)
    report("fit", 0.0)
    typical, first = short.noise, polish(short, start, free, iterations=8)
    far = first.cost > LINEAR_MISFIT * first.lin.total_rows
    short = short.with_noise(residual_noise(short, first))
    nominal = polish(short, first.theta, free, states=first.states, iterations=8).theta
    # 2. The noise floor.  Far off, what the nominal model leaves is no measure of the noise, nor its optimum a start.
    report("noise floor", 0.0)
    begun = ([nominal, start], free, typical, FAR_ITERATIONS) if far else ([nominal], free, short.noise)
    flexible = flexible_fit(windows, short, *begun)
    short = short.with_noise(flexible.noise)
    # 3. Causes that these data could show.
    rotors = ["readings" if vehicle.command.sampling == "instant" else "commands"]
    if vehicle.reference_voltage is not None and all(w.battery is not None for w in windows):
        rotors.append("battery")
    listed = candidates(short.layout, short.has_velocity, short.channels >= 15, rotors)
    listed = [c for c in listed if c.effect not in vehicle.effects]
    # 4. The search; where one by one led nowhere, from everything at once it may lead somewhere.
    schedule = [Shooting.cut(windows, vehicle, t, short.noise, short.layout) for t in DECIDE_SECONDS]
    schedule = [*(s for s in schedule if s.count >= BLOCKS), short]
    search = select(schedule, nominal, listed, report)
    if search.model.lin.reduced_chi_square > LINEAR_MISFIT:
        other = select(schedule, nominal, listed, report, from_everything(short, flexible.theta, listed))
        longer = other.shooting.length - search.shooting.length
        search = other if longer > 0 or (longer == 0 and better(other.model, search.model)) else search
    # 5. Again, while causes show the noise to be less.
    while search.model.causes:
        report("noise floor", 0.5)
        before = search.shooting.noise.variance
        noise = _noise_around(windows, schedule[-1], search.model)
        growth = noise.variance / before
        if np.mean(np.log(growth)) > 0.0:
            break  # around the causes there is no less noise than before
        schedule, search = _with_noise(noise, schedule, search)
        if np.all(growth > NOISE_FELL):
            break
        again = select(schedule, nominal, listed, report, search.model)
        search = replace(again, rounds=(*search.rounds, *again.rounds))
    # 6. Under other noise a cause may be nothing any more.
    return schedule, replace(search, model=pruned(search.shooting, search.model))


def _noise_around(windows: Sequence[Window], short: Shooting, model: Model) -> NoiseModel:
    """Re-estimates the noise around the selected model, where the flexible fit is nearly linear."""
    wide = short.free(free_names(model.causes))
    return flexible_fit(windows, short, [model.theta], wide, iterations=2).noise


def with_causes_of(search: Search, rough: RoughAir) -> Search:
    """`search` with the causes selected beside random forces, fitted to the segments that decided."""
    model = fit_model(search.shooting, rough.model.theta, rough.model.causes, tried=rough.model.tried)
    return replace(search, model=model, rounds=(*search.rounds, *rough.rounds))


def _with_noise(noise: NoiseModel, schedule: Sequence[Shooting], search: Search) -> tuple[list[Shooting], Search]:
    """Problems under another noise model, nominal and selected model refitted there."""
    decisive = search.shooting.with_noise(noise)
    model, nominal = (refit(decisive, m, m.states) for m in (search.model, search.nominal))
    return [s.with_noise(noise) for s in schedule], replace(search, shooting=decisive, model=model, nominal=nominal)


def judge_in_rough_air(rough: RoughAir, unnamed: float = 0.0) -> Explanation:
    """Verdict where random forces act: what causes take of them, and whether innovations follow anything else.

    Args:
        rough: what was found there.
        unnamed: share of what causes take away that is of doubtful ones; it counts as left.
    """
    followed, explained = rough.followed + unnamed * rough.explained, (1.0 - unnamed) * rough.explained
    least = max(LEAST_STRUCTURE * rough.model.rows, LEAST_OF_EXPLAINED * explained)
    enough = rough.removed >= (LEAST_REMOVED if len(rough.model.effects) > 1 else REMOVED_ALONE)
    named = followed <= least or explained >= SHARE_TO_NAME * (explained + followed)
    return Explanation.PARTLY_EXPLAINED if enough and named else Explanation.UNKNOWN


def judge(nominal: Model, model: Model, left: Remainder, unnamed: float = 0.0) -> Explanation:
    """Verdict from what the causes explain and what is left.

    Args:
        nominal: model without causes.
        model: the selected one.
        left: what it leaves.
        unnamed: deviance that causes with implausible numbers take away; it counts as left.
    """
    explained = max(float(nominal.held_out.sum() - model.held_out.sum()) - unnamed, 0.0)
    least = max(LEAST_STRUCTURE * model.rows, LEAST_OF_EXPLAINED * explained)
    structure = left.deviance + unnamed if left.deviance + unnamed > least else 0.0
    if not model.causes:
        return Explanation.UNKNOWN if structure else Explanation.NOTHING_FOUND
    if not structure:
        return Explanation.EXPLAINED
    share = SHARE_TO_NAME if len(model.effects) > 1 else SHARE_ALONE
    return Explanation.PARTLY_EXPLAINED if explained >= share * (explained + structure) else Explanation.UNKNOWN
