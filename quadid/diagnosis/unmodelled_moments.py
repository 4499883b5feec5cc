"""Physics beside moments that no model has: where they rule, the nominal values are those of the filter.

The selection follows simulated runs, and there such moments, which the controller answers, pass for inertia.  The fit
beside random forces (`quadid.identification.filter_error`) is free of that.  The selected model is fitted so too, its
causes as they were found but for what is late: without them an offset of the centre of gravity would count as a random
moment, free they would take up random moments.  Unless that fit confirms the selection's values, they are held at its
own and the causes refitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.evidence import impossible_causes
from quadid.diagnosis.hypotheses import Model, fit_model, free_names, without
from quadid.diagnosis.search import Search, Stage, pruned
from quadid.estimate.problem import LATE
from quadid.identification.filter_error import Filtered, filtered, has_unmodelled_moments
from quadid.identification.fit import MOST_SEGMENTS, beside_random_forces
from quadid.identification.gauss_newton import polish
from quadid.identification.noise_fit import residual_noise
from quadid.identification.problem import Free, Shooting
from quadid.model.layout import Layout
from quadid.parameters import INERTIAS, NOMINAL_NAMES, UNKNOWN, Parameter, unreliable
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior, Vehicle

HELD = ("b", "J_xx", "J_yy")
"""Parameters at which the causes are refitted."""


@dataclass(frozen=True)
class Held:
    """Parameters held at what the fit beside random forces shows.

    Attributes:
        parameters: all six by name, as an identification gives them.
        vehicle: with those of `HELD`.
        windows, short: the data, and their short segments.
        theta: nominal values of the selected model among neutral ones.
    """

    parameters: Mapping[str, Parameter]
    vehicle: Vehicle
    windows: Sequence[Window]
    short: Shooting
    theta: FloatArray

    def on(self, shooting: Shooting) -> Shooting:
        """The same problem with what is held."""
        return replace(shooting, vehicle=self.vehicle, layout=Layout(self.vehicle))

    def among(self, parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
        """Parameters with those of the filter in their place."""
        return tuple(self.parameters.get(p.name, p) for p in parameters)

    def beside_doubt(self) -> Held:
        """The same where causes leave much or are doubtful: as uncertain as without any, and by the step to that."""
        free = self.short.free(NOMINAL_NAMES)
        alone = filtered(self.windows, self.short.vehicle, self.theta, free)
        if alone is None:
            lost = unreliable(self.parameters.values(), NOMINAL_NAMES)
            return replace(self, parameters={p.name: p for p in lost})
        here = alone.theta.copy()
        for name, p in self.parameters.items():
            here[self.short.layout.entry(name).index] = p.value
        doubt = alone.uncertainty.differing([free.step(here, alone.theta)])
        return replace(self, parameters=_shown(self.short, replace(alone, theta=here, uncertainty=doubt), free))

    @property
    def sentence(self) -> str:
        """Why they are."""
        return (
            f"something that the model lacks moves the vehicle: {', '.join(self.parameters)} were estimated beside "
            "random forces and moments"
        )


def held_by_filter(windows: Sequence[Window], short: Shooting, model: Model) -> Held | None:
    """Parameters that the selected model has wrong because moments that no model has turn the vehicle, or None.

    Args:
        windows: the data.
        short: short segments.
        model: the selected one.
    """
    short = short.at_most(MOST_SEGMENTS)
    brief = polish(short, model.theta, model.free, model.prior, iterations=8)
    if not has_unmodelled_moments(short.with_noise(residual_noise(short, brief)), brief):
        return None
    free = short.free([*NOMINAL_NAMES, *(n for n in free_names(model.causes) if n in LATE)])
    found = filtered(windows, short.vehicle, model.theta, free)
    if found is None:
        return None
    shown = _shown(short, found, free)
    values = dict(zip(model.free.names, model.theta[model.free.index].tolist(), strict=True))
    if all(shown[n].status not in UNKNOWN and shown[n].ci95[0] <= values[n] <= shown[n].ci95[1] for n in HELD):
        return None
    neutral = short.layout.initial(short.vehicle)
    neutral[short.free(NOMINAL_NAMES).index] = model.theta[short.free(NOMINAL_NAMES).index]
    # Together: torque is b times a square over an inertia, and one may be known only relative to another.
    return Held(shown, _holding(short.vehicle, shown), windows, short, neutral)


def _shown(short: Shooting, found: Filtered, free: Free) -> dict[str, Parameter]:
    """Parameters by name that a fit beside random forces shows."""
    return {p.name: p for p in beside_random_forces(short, found, free).parameters if p.name in NOMINAL_NAMES}


def _holding(vehicle: Vehicle, held: Mapping[str, Parameter]) -> Vehicle:
    """The vehicle with parameters that stay where they are, and J_zz no larger than a rigid body's can be then."""
    priors = dict(vehicle.parameters)
    for name in HELD:
        p = held[name]
        priors[name] = ParameterPrior(initial=p.value, bounds=(p.value, p.value), sigma=p.sigma)
    *flat, upright = INERTIAS
    low, high = vehicle.limits(upright)
    if low < (most := sum(held[n].value for n in flat)) < high:
        old = priors[upright]
        priors[upright] = ParameterPrior(initial=min(old.initial, most), bounds=(low, most), sigma=old.sigma)
    return vehicle.model_copy(update={"parameters": priors})


def refitted(held: Held, schedule: Sequence[Shooting], search: Search) -> tuple[list[Shooting], Search]:
    """Schedule and selection with what is held, causes refitted, less those that are of no use there or impossible."""
    before, beside = search.model, [held.on(s) for s in schedule]
    moved = beside[-1].free(before.free.names).move(before.theta, np.zeros(len(before.free.names)))
    stage = Stage.begin(beside, moved, replace(before, theta=moved))
    shooting, model = stage.shooting, pruned(stage.shooting, stage.model)
    while wrong := [c for c in model.causes if c.label in impossible_causes(model)]:
        model = pruned(shooting, without(shooting, model, wrong[0]))
    nominal = fit_model(schedule[stage.rung], search.nominal.theta, ())
    return beside, replace(search, shooting=shooting, model=model, nominal=nominal)
