"""What a cause is worth on an aircraft where everything is a little untidy.

Every real vehicle has its centre of gravity half a millimetre off and rotors that differ by half a percent.  Taking one
such cause out of the model and counting what is lost would rank it by what its neighbours were forbidden to take up.
So the model a cause is measured against may use the whole catalogue, within the small sizes that any vehicle has: a
cause is worth what none of these can explain.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.candidates import Candidate, all_names
from quadid.diagnose.exchange import left_over
from quadid.diagnose.models import Model, as_model, free_names
from quadid.effects import EFFECTS
from quadid.identify.gauss_newton import bounded_step, default_prior, polish, scaled_difference
from quadid.identify.parameterization import Free
from quadid.identify.segment_cost import Linearised
from quadid.identify.shooting import Shooting
from quadid.parameters import NOMINAL_NAMES

FloatArray = NDArray[np.float64]

UNTIDY = 0.2
"""How far, in typical sizes, each effect may be from neutral, or from its found value, on any vehicle."""
TAKES_UP = 0.001
"""Entries that would move by less than this many typical sizes are left where they are, but for what acts through
another effect (a moment through drag): while that one is at neutral, a linear problem does not see it."""
_ITERATIONS = 4


def untidy_names(listed: Sequence[Candidate]) -> list[str]:
    """Entries of the catalogue that may be a little off on any vehicle; changes at a moment are events, not clutter."""
    return all_names([c for c in listed if c.timed is None and not EFFECTS[c.effect].needs])


def without_in_clutter(
    shooting: Shooting, model: Model, cause: Candidate | None, listed: Sequence[Candidate], everything: Linearised
) -> Model:
    """Refits `model` without `cause` (None: with all its causes) amid clutter.

    Nominal parameters are free, effects that are left move within the sizes of clutter.

    Args:
        shooting: the problem.
        model: the extended model.
        cause: what to take out.
        listed: the catalogue.
        everything: linearisation at `model` with `clutter_names` free.
    """
    causes, theta = (model.causes, model.theta) if cause is None else left_over(shooting, model, cause)
    names = clutter_names(model, listed)
    gone = [n for n in free_names(model.causes) if n not in free_names(causes)]
    free = _boxed(shooting, [n for n in names if n not in gone], theta)
    step = _predicted(shooting, model, names, free, gone, theta, everything)
    always = {*NOMINAL_NAMES, *untidy_names([c for c in listed if c.requires])}
    takes_up = [abs(z) > TAKES_UP or e.name in always for z, e in zip(step, free.entries, strict=True)]
    used = Free(tuple(e for e, keep in zip(free.entries, takes_up, strict=True) if keep))
    start = used.move(theta, step[np.array(takes_up)])
    result = polish(shooting, start, used, states=model.states, iterations=_ITERATIONS, tolerance=0.1, settled=True)
    return replace(as_model(shooting, result, used, causes), worth=model.worth)


def ordinary(shooting: Shooting, model: Model, cause: Candidate, listed: Sequence[Candidate]) -> bool:
    """Whether `cause` is no larger in `model` than it may be on any vehicle."""
    entries = shooting.free(cause.names)
    near = np.abs(entries.from_neutral(model.theta)) <= UNTIDY
    return bool(near.all()) and set(cause.names) <= set(untidy_names(listed))


def clutter_names(model: Model, listed: Sequence[Candidate]) -> list[str]:
    """Entries of the model and of the untidy rest."""
    return list(dict.fromkeys([*model.free.names, *untidy_names(listed)]))


def _boxed(shooting: Shooting, names: Sequence[str], theta: FloatArray) -> Free:
    """Free parameters whose effects stay within untidy sizes of where `theta` has them."""
    out = []
    for entry in shooting.free(names).entries:
        if entry.name not in NOMINAL_NAMES:
            room, value = UNTIDY * entry.typical, float(theta[entry.index])
            entry = replace(entry, lower=max(entry.lower, value - room), upper=min(entry.upper, value + room))
        out.append(entry)
    return Free(tuple(out))


def _predicted(
    shooting: Shooting, model: Model, names: list[str], free: Free, gone: list[str], theta: FloatArray,
    everything: Linearised,
) -> FloatArray:  # fmt: skip
    """Step of `free` that makes up best for the loss of `gone`, from the linearised problem."""
    place = {n: i for i, n in enumerate(names)}
    mine = np.array([place[n] for n in free.names])
    lost = np.array([place[n] for n in gone], dtype=np.intp)
    h, g = everything.gram.sum(axis=0), everything.grad.sum(axis=0)
    z = scaled_difference(shooting.free(gone), model.theta, theta)
    prior = default_prior(shooting, free)
    return bounded_step(
        free, theta, h[np.ix_(mine, mine)] + np.diag(1.0 / prior.sigma**2), g[mine] + h[np.ix_(mine, lost)] @ z
    )
