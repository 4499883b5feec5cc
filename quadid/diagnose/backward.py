"""From the general to the specific: for flights that the nominal model is too far from to be extended one by one.

When several causes act at once and strongly, none of them alone leads out of the basin that the nominal fit fell into.
The flexible model, with everything the catalogue can free at once, is outside of it; causes that it does not need are
taken away one after the other, the least missed first.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model, fit_model
from quadid.identify.noise_estimation import flexible_names
from quadid.identify.shooting import Shooting

FloatArray = NDArray[np.float64]

PASSES = 4
MISSED = 0.01
"""Share of the noise by which the deviance must grow for a cause to be kept."""


def eliminate(shooting: Shooting, theta: FloatArray, listed: Sequence[Candidate]) -> Model:
    """Fits everything at once from `theta` and takes away what is not missed.

    Args:
        shooting: the problem, short segments.
        theta: optimum of the flexible fit, full vector.
        listed: the catalogue.

    Returns:
        The model with what is left.
    """
    allowed = set(flexible_names(shooting.layout, shooting))
    causes = tuple(c for c in listed if c.timed is None and not c.split and set(c.names) <= allowed)
    model = fit_model(shooting, _only(shooting, theta, causes), causes, iterations=8)
    for _ in range(PASSES):
        kept = _missed(model)
        if len(kept) == len(model.causes):
            break
        model = fit_model(shooting, _only(shooting, model.theta, kept), kept, model.states, iterations=8)
    return model


def _missed(model: Model) -> tuple[Candidate, ...]:
    """Causes whose loss the others could not make up for, by the linearised problem."""
    h = model.lin.gram.sum(axis=0) + np.diag(1.0 / model.prior.sigma**2)
    z = model.free.from_neutral(model.theta)
    kept = list(model.causes)
    alive = np.ones(len(z), dtype=bool)
    least = MISSED * model.rows
    place = {n: i for i, n in enumerate(model.free.names)}
    # Half of what is left at most: the linear picture does not hold for all at once.
    for _ in range(max(len(kept) // 2, 1)):
        losses = []
        for cause in kept:
            if any(c.requires == cause.effect for c in kept):
                continue
            mine = np.array([place[n] for n in cause.names])
            rest = np.flatnonzero(alive & ~np.isin(np.arange(len(z)), mine))
            cross = h[np.ix_(rest, mine)]
            schur = h[np.ix_(mine, mine)] - cross.T @ np.linalg.solve(h[np.ix_(rest, rest)], cross)
            losses.append((float(z[mine] @ schur @ z[mine]), cause, mine))
        if not losses:
            break
        loss, cause, mine = min(losses, key=lambda item: item[0])
        if loss > least:
            break
        kept.remove(cause)
        alive[mine] = False
    return tuple(kept)


def _only(shooting: Shooting, theta: FloatArray, causes: Sequence[Candidate]) -> FloatArray:
    """The vector with all effects at neutral but those of `causes`."""
    out = shooting.layout.initial(shooting.vehicle)
    index = shooting.free([n for c in causes for n in c.names]).index
    out[:6] = theta[:6]
    out[index] = theta[index]
    return out
