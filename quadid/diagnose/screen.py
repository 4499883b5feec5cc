"""Screening: how much each cause could gain, from one linearisation of everything.

One Jacobian of the whole catalogue, with initial states eliminated segment by segment, gives every score test by linear
algebra.  Causes that begin at an unknown time are scanned over all segment boundaries by sums from the end.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.candidates import Candidate, all_names, unset_times
from quadid.diagnose.models import Model, settled_states
from quadid.identify.gauss_newton import default_prior
from quadid.identify.shooting import Linearised, Shooting

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """Linear prediction for one candidate.

    Attributes:
        candidate: the cause.
        drop: predicted fall of the deviance on the fitted data.
        z: its scaled parameters at the predicted optimum, shape (its names,).
        time: best moment of onset [s] for timed causes.
        trials: how many alternatives were looked at for it.
    """

    candidate: Candidate
    drop: float
    z: FloatArray
    time: float | None = None
    trials: int = 1


def linearise_all(shooting: Shooting, model: Model, listed: list[Candidate]) -> tuple[Linearised, list[str]]:
    """Linearises the current model with every candidate's entries free; returns it and the entry names."""
    names = list(dict.fromkeys([*model.free.names, *all_names(listed)]))
    states = settled_states(shooting, model)
    theta = unset_times(model.theta, model.effects)
    return shooting.linearise(theta, shooting.free(names), states), names


def screen(shooting: Shooting, model: Model, listed: list[Candidate]) -> list[Score]:
    """Scores all candidates not yet in the model, best first."""
    lin, names = linearise_all(shooting, model, listed)
    place = {n: i for i, n in enumerate(names)}
    own = np.array([place[n] for n in model.free.names])
    precision = 1.0 / default_prior(shooting, model.free).sigma ** 2
    present = {c.label for c in model.causes}
    scores = []
    h, g = lin.gram.sum(axis=0), lin.grad.sum(axis=0)
    for candidate in listed:
        if (
            candidate.label in present
            or any(c.label in present for c in candidate.split)
            or (candidate.requires and candidate.requires not in model.effects)
        ):
            continue
        mine = np.array([place[n] for n in candidate.names])
        if candidate.timed is None:
            scores.append(_score(candidate, h, g, own, mine, precision))
        else:
            scores.append(_scan(candidate, lin, own, mine, precision))
    return sorted(scores, key=lambda s: -s.drop)


def _reduced(
    h_mm: FloatArray, h_mo: FloatArray, h_oo: FloatArray, g_m: FloatArray, g_o: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Predicted fall of the deviance and step of candidates' parameters, the model's own refitted.

    Args:
        h_mm: products of the parameters with themselves, (n, m, m).
        h_mo: and with those of the model, (n, m, o).
        h_oo: products of the model's parameters (o, o).
        g_m: gradient of the parameters (n, m).
        g_o: of those of the model (o,).
    """
    n, m, o = h_mo.shape
    solved = np.linalg.solve(h_oo, np.column_stack([h_mo.reshape(n * m, o).T, g_o]))
    s = h_mm - np.matmul(h_mo, solved[:, :-1].T.reshape(n, m, o).transpose(0, 2, 1))
    g = g_m - h_mo @ solved[:, -1]
    # Directions the model's own parameters already explain carry no information; keep them finite.
    s[:, range(m), range(m)] += 1e-9 * np.einsum("nii->ni", h_mm) + 1e-2
    z = -np.linalg.solve(s, g[..., None])[..., 0]
    return -np.sum(g * z, axis=1), z


def _score(
    candidate: Candidate, h: FloatArray, g: FloatArray, own: NDArray[np.intp], mine: NDArray[np.intp],
    precision: FloatArray,
) -> Score:  # fmt: skip
    h_oo = h[np.ix_(own, own)] + np.diag(precision)
    drop, z = _reduced(h[np.ix_(mine, mine)][None], h[np.ix_(mine, own)][None], h_oo, g[mine][None], g[own])
    return Score(candidate, float(drop[0]), z[0])


def _scan(
    candidate: Candidate, lin: Linearised, own: NDArray[np.intp], mine: NDArray[np.intp], precision: FloatArray
) -> Score:
    """Scans the onset over segment boundaries: sums from the end turn the whole-log column into masked ones."""
    order = np.argsort(lin.time, kind="stable")
    gram, grad = lin.gram, lin.grad[order]
    h_oo = gram.sum(axis=0)[np.ix_(own, own)] + np.diag(precision)
    g_o = grad[:, own].sum(axis=0)
    from_end = slice(None, None, -1)
    h_mm = np.cumsum(gram[order[:, None, None], mine[:, None], mine][from_end], axis=0)[from_end]
    h_mo = np.cumsum(gram[order[:, None, None], mine[:, None], own][from_end], axis=0)[from_end]
    g_m = np.cumsum(grad[:, mine][from_end], axis=0)[from_end]
    margin = max(len(order) // 40, 3)
    tried = slice(margin, len(order) - margin)
    drop, z = _reduced(h_mm[tried], h_mo[tried], h_oo, g_m[tried], g_o)
    if not len(drop):
        return Score(candidate, -np.inf, np.zeros(len(mine)))
    best = int(np.argmax(drop))
    return Score(candidate, float(drop[best]), z[best], float(lin.time[order[margin + best]]), len(order))
