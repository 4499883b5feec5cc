"""Physics beside moments that no model has: where they rule, b, J_xx and J_yy are those that fast motion shows.

The selection follows slow motion too, and there such moments, which the controller answers, pass for inertia.  Quick
motion by itself (`quadid.identification.fast_motion`) is free of that.  The selected model is fitted to it too, its
causes as they were found but for what is late: without them an offset of the centre of gravity would count as a random
moment, free they would take up random moments.  Unless fast motion confirms b, J_xx and J_yy, all three are held at its
estimates and the causes refitted.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from quadid.data.window import Window
from quadid.diagnosis.evidence import impossible_causes
from quadid.diagnosis.hypotheses import Model, fit_model, free_names, without
from quadid.diagnosis.search import Search, Stage, pruned
from quadid.effects import EFFECTS
from quadid.identification.fast_motion import MOST_SEGMENTS, fast_motion
from quadid.identification.fit import YAW, fast_fit, has_unmodelled_moments
from quadid.identification.gauss_newton import polish
from quadid.identification.noise_fit import residual_noise
from quadid.identification.problem import Shooting
from quadid.identification.uncertainty import SPREAD_LIMIT
from quadid.model.layout import Layout
from quadid.parameters import INERTIAS, NOMINAL_NAMES, UNKNOWN, Parameter, ParameterSet
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior, Vehicle

SHOWN = tuple(n for n in NOMINAL_NAMES if n not in YAW)
"""Parameters that fast motion shows."""


@dataclass(frozen=True)
class Held:
    """Parameters held at what fast motion shows.

    Attributes:
        parameters: by name, as an identification gives them.
        vehicle: with these values.
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
        """Parameters with those held in their place, and no trust in what fast motion does not show."""
        listed = ParameterSet(tuple(parameters), np.zeros((len(parameters), len(parameters)))).unreliable(YAW)
        return tuple(self.parameters.get(p.name, p) for p in listed)

    def regardless(self) -> set[str]:
        """Names of those that fast motion shows without any cause too."""
        alone = fast_motion(self.windows, self.short, self.theta, NOMINAL_NAMES)
        if alone is None:
            return set()
        fitted = dict(zip(alone.free.names, alone.found.theta[alone.free.index], strict=True))
        return {n for n, p in self.parameters.items() if abs(np.log(fitted[n] / p.value)) <= SPREAD_LIMIT}

    @property
    def sentence(self) -> str:
        """Why they are."""
        return (
            f"something that the model lacks turns the vehicle: {', '.join(self.parameters)} were estimated from fast "
            f"motion, which does not reveal {', '.join(YAW)}"
        )


def held_by_fast_motion(windows: Sequence[Window], short: Shooting, model: Model) -> Held | None:
    """Errors of the selected model because moments that no model has turn the vehicle; None where it has not.

    Args:
        windows: the data.
        short: short segments.
        model: the selected one.
    """
    short = short.at_most(MOST_SEGMENTS)
    brief = polish(short, model.theta, model.free, model.prior, iterations=8)
    if not has_unmodelled_moments(short.with_noise(residual_noise(short, brief)), brief):
        return None
    names = free_names(tuple(c for c in model.causes if c.family == "late" and EFFECTS[c.effect].turns))
    quick = fast_motion(windows, short, model.theta, names)
    if quick is None:
        return None
    shown = {p.name: p for p in fast_fit(quick, names).parameters if p.name in SHOWN}
    values = dict(zip(model.free.names, model.theta[model.free.index].tolist(), strict=True))
    if all(p.status not in UNKNOWN and p.ci95[0] <= values[n] <= p.ci95[1] for n, p in shown.items()):
        return None
    neutral = short.layout.initial(short.vehicle)
    neutral[short.free(NOMINAL_NAMES).index] = model.theta[short.free(NOMINAL_NAMES).index]
    # Together: torque is b times a square over an inertia, and one may be known only relative to another.
    return Held(shown, _holding(short.vehicle, shown), windows, short, neutral)


def _holding(vehicle: Vehicle, held: Mapping[str, Parameter]) -> Vehicle:
    """The vehicle with parameters that stay where they are, and J_zz no larger than a rigid body's can be then."""
    priors = dict(vehicle.parameters)
    for name, p in held.items():
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
