"""MOESP and CVA: linear black-box models from input and output data, for open- and closed-loop records.

Both find the few combinations of the past that predict the future, call them the state, and regress.  They differ in
how the future is weighted (CVA by its own covariance, MOESP not), and here, for either, in how the effect of future
inputs is taken out:

* ``loop="open"``: by projecting future inputs out, as the ordinary methods do (PO-MOESP, Verhaegen 1994,
  doi:10.1016/0005-1098(94)90229-1; CVA as in Van Overschee & De Moor 1995, doi:10.1016/0005-1098(95)00072-0).  Under
  feedback future inputs carry past noise, and the answer is biased.
* ``loop="closed"``: by a high-order ARX model fitted first, whose one-step predictor is unbiased under feedback:
  Larimore's CVA (1990, doi:10.1109/CDC.1990.203665) in the form of SSARX (Jansson 2003,
  doi:10.1016/S1474-6670(17)34986-8).  With the weight of MOESP it is one of the predictor-based methods reviewed by
  Qin (2006, doi:10.1016/j.compchemeng.2006.05.045).
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import ParameterError, nearest
from quadid.types import BoolArray, FloatArray, IntArray
from quadid_evaluation.paper.hankel import Triangle, as_records, stack, triangular
from quadid_evaluation.paper.state_space import SubspaceModel

Loop = Literal["closed", "open"]
METHODS = ("cva", "moesp")
CUTOFF = 1e-9
"""Directions smaller than this fraction of the largest are taken for empty (data without noise)."""


def fit_subspace(
    method: str,
    inputs: ArrayLike | Sequence[ArrayLike],
    outputs: ArrayLike | Sequence[ArrayLike],
    order: int,
    past: int = 20,
    future: int = 15,
    loop: Loop = "closed",
    feedthrough: bool | Sequence[bool] = True,
) -> SubspaceModel:
    """Fits a linear state-space model.

    Args:
        method: ``cva`` or ``moesp``.
        inputs: shape (rows, m), or one such array a record.
        outputs: shape (rows, p), or one such array a record; rows with NaN are left out with all that reach over them.
        order: number of states.
        past: block rows of the past; the predictor must have forgotten its state after so many rows.
        future: block rows of the future, at most `past`.
        loop: ``closed`` where the inputs were computed from the outputs, as in flight; ``open`` where they were not.
        feedthrough: whether u[k] may act on y[k], for all outputs or each.  Under feedback without delay it must not.

    Raises:
        ParameterError: unknown method, horizons or order that cannot work.
        WindowError: arrays that do not match.
        NotIdentifiableError: too few usable rows, or a channel that never moves.
    """
    return fit_orders(method, inputs, outputs, [order], past, future, loop, feedthrough)[0]


def fit_orders(
    method: str,
    inputs: ArrayLike | Sequence[ArrayLike],
    outputs: ArrayLike | Sequence[ArrayLike],
    orders: Sequence[int],
    past: int = 20,
    future: int = 15,
    loop: Loop = "closed",
    feedthrough: bool | Sequence[bool] = True,
) -> list[SubspaceModel]:
    """Fits one model an order from one pass over the data; arguments and errors as `fit_subspace`."""
    if method not in METHODS:
        raise ParameterError(f"unknown subspace method '{method}'", ", ".join(METHODS), nearest(method, METHODS))
    if not 1 <= future <= past:
        raise ParameterError(f"past {past}, future {future}", "1 <= future <= past")
    u, y = as_records(inputs, outputs)
    p = y[0].shape[1]
    largest = min(p * future, past * (p + u[0].shape[1]))
    for order in orders:
        if not 1 <= order <= largest:
            raise ParameterError(f"order {order}", f"1 to {largest} with this past and future")
    direct = np.broadcast_to(np.asarray(feedthrough, dtype=bool), (p,))
    triangle = stack(u, y, past, future)
    to_state = _state_map(triangle, method, loop, direct)
    return [_regress(triangle, to_state[:, :order], direct) for order in orders]


def _state_map(t: Triangle, method: str, loop: str, direct: BoolArray) -> FloatArray:
    """Maps the past to states of unit variance, most telling first, shape (past * (p + m), states)."""
    z, y = t.z_past.ravel(), t.y_future.ravel()
    # A high-order ARX model: y[k] = sum_i theta_i (y, u)[k-i] + d u[k] + e[k].
    error, theta, d = _innovations(t, np.eye(len(z)), direct)
    if loop == "open":
        # R is ordered [1, u_f | z_p | y_f]: these blocks are the covariances given the future inputs.
        R = t.R
    else:
        # The future less its known causes depends on the past alone: [1 | z_p | y_f - its causes].
        corrected = _corrected_future(t, theta[1:], d)
        R = triangular(np.concatenate([t.R[:, np.concatenate([t.one, z])], corrected], axis=1))
        z, y = 1 + np.arange(len(z)), 1 + len(z) + np.arange(len(y))
    past, cross, rest = R[np.ix_(z, z)], R[np.ix_(z, y)], R[np.ix_(y, y)]
    # `cross` is S_pp^(-1/2) S_pf, the R32 of PO-MOESP transposed.  CVA weighs the future by S_ff^(-1/2).  MOESP weighs
    # it not, so its answer depends on the units of the outputs: here one unit is the one-step prediction error.
    if method == "cva":
        weighted = cross @ _inverse_root(cross.T @ cross + rest.T @ rest)
    else:
        unit = np.sqrt(np.sum(error**2, axis=0) / t.rows) + 1e-6
        weighted = cross / np.tile(unit, len(t.y_future))
    directions = np.linalg.svd(weighted)[0][:, : min(cross.shape)]
    return np.asarray(np.sqrt(t.rows) * np.linalg.pinv(past, rcond=CUTOFF) @ directions)


def _corrected_future(t: Triangle, theta: FloatArray, d: FloatArray) -> FloatArray:
    """R columns of the future outputs less what inputs and outputs since row k caused by the ARX model theta, d."""
    past, width = t.z_past.shape
    theta = theta.reshape(past, width, -1)
    recent = [np.concatenate([y, u]) for y, u in zip(t.y_future, t.u_future, strict=True)]
    out = []
    for j in range(len(recent)):
        block = t.R[:, t.y_future[j]] - t.R[:, t.u_future[j]] @ d
        for i in range(j):
            block = block - t.R[:, recent[j - 1 - i]] @ theta[i]
        out.append(block)
    return np.concatenate(out, axis=1)


def _least_squares(
    t: Triangle, known: FloatArray, u: IntArray, y: IntArray, direct: BoolArray
) -> tuple[FloatArray, FloatArray]:
    """Regresses y[k] on `known` columns and, where `direct`, on u[k]; returns (known, p) and (m, p)."""
    theta, d = np.zeros((known.shape[1], len(y))), np.zeros((len(u), len(y)))
    if np.any(~direct):
        theta[:, ~direct] = np.linalg.lstsq(known, t.R[:, y[~direct]], rcond=CUTOFF)[0]
    if np.any(direct):
        both = np.concatenate([known, t.R[:, u]], axis=1)
        solution = np.linalg.lstsq(both, t.R[:, y[direct]], rcond=CUTOFF)[0]
        theta[:, direct], d[:, direct] = solution[: known.shape[1]], solution[known.shape[1] :]
    return theta, d


def _innovations(t: Triangle, to_state: FloatArray, direct: BoolArray) -> tuple[FloatArray, ...]:
    """R columns of e[k], then [g; C'] of shape (1 + n, p) and D' of shape (m, p)."""
    known = np.concatenate([t.R[:, t.one], t.R[:, t.z_past.ravel()] @ to_state], axis=1)
    c, d = _least_squares(t, known, t.u_future[0], t.y_future[0], direct)
    return t.R[:, t.y_future[0]] - known @ c - t.R[:, t.u_future[0]] @ d, c, d


def _regress(t: Triangle, to_state: FloatArray, direct: BoolArray) -> SubspaceModel:
    """Output equation, innovations, then the state equation with the innovations as known inputs."""
    n, m = to_state.shape[1], t.u_future.shape[1]
    error, c, d = _innovations(t, to_state, direct)
    # The past of row k+1 is the past of row k moved on by (y, u)[k]: the next state needs no further data.
    newest = np.concatenate([t.y_future[0], t.u_future[0]])
    moved_on = np.concatenate([newest, t.z_past[:-1].ravel()])
    state, following = t.R[:, t.z_past.ravel()] @ to_state, t.R[:, moved_on] @ to_state
    causes = np.concatenate([state, t.R[:, t.u_future[0]], error, t.R[:, t.one]], axis=1)
    a, b, k, f = np.split(np.linalg.lstsq(causes, following, rcond=CUTOFF)[0].T, np.cumsum([n, m, error.shape[1]]), 1)
    return _in_data_units(t, (a, b, c[1:].T, d.T, k), f[:, 0], c[0], error.T @ error / t.rows)


def _in_data_units(
    t: Triangle, matrices: tuple[FloatArray, ...], f: FloatArray, g: FloatArray, covariance: FloatArray
) -> SubspaceModel:
    """Undoes the scaling: u = u_mean + u_scale u', y = y_mean + y_scale y'."""
    a, b, c, d, k = matrices
    s = t.scaling
    b = b / s.u_scale
    c, d = s.y_scale[:, None] * c, s.y_scale[:, None] * d / s.u_scale
    return SubspaceModel(
        a.copy(), b, c, d, k / s.y_scale, f - b @ s.u_mean, s.y_mean + s.y_scale * g - d @ s.u_mean,
        covariance * np.outer(s.y_scale, s.y_scale), t.rows,
    )  # fmt: skip


def _inverse_root(covariance: FloatArray) -> FloatArray:
    values, vectors = np.linalg.eigh(covariance)
    kept = values > CUTOFF * values[-1]
    return np.asarray((vectors[:, kept] / np.sqrt(values[kept])) @ vectors[:, kept].T)
