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

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import NotIdentifiableError, ParameterError, WindowError, nearest
from quadid.types import BoolArray, ComplexArray, FloatArray, IntArray

Loop = Literal["closed", "open"]
METHODS = ("cva", "moesp")
CUTOFF = 1e-9
"""Directions smaller than this fraction of the largest are taken for empty (data without noise)."""
CHUNK = 4096
"""Rows stacked at a time; bounds the memory."""
ROWS_PER_COLUMN = 2.0
"""Fewer rows than this a column cannot support the regressions."""


@dataclass(frozen=True)
class SubspaceModel:
    """A linear time-invariant model about an operating point; n states, m inputs, p outputs, in the data's units.

        x[k+1] = A x[k] + B u[k] + K e[k] + state_offset
        y[k]   = C x[k] + D u[k] + e[k] + output_offset

    The state has no physical meaning: any change of basis gives the same model.

    Attributes:
        A: (n, n). B: (n, m). C: (p, n). D: (p, m), zero rows where no feedthrough was allowed. K: (n, p).
        state_offset: shape (n,). output_offset: shape (p,).
        innovation_covariance: covariance of e, shape (p, p).
        rows: number of equations the model was fitted to.
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    K: FloatArray
    state_offset: FloatArray
    output_offset: FloatArray
    innovation_covariance: FloatArray
    rows: int

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.A)

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A, shape (n,), by falling magnitude; inside the unit circle where stable."""
        poles = np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)
        return poles[np.lexsort((poles.imag, -np.abs(poles)))]


class Triangle(NamedTuple):
    """R factor of the stacked equation rows ``[1, u_f, z_p, y_f]``, which holds everything that is regressed later.

    Attributes:
        R: upper triangular, shape (columns, columns).
        rows: number of stacked rows.
        one, u_future, z_past, y_future: places of the columns, shapes (1,), (f, m), (past, p + m), (f, p).
        scaling: means and standard deviations of inputs, then of outputs, by which the data were scaled.
    """

    R: FloatArray
    rows: int
    one: IntArray
    u_future: IntArray
    z_past: IntArray
    y_future: IntArray
    scaling: tuple[FloatArray, ...]


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
    triangle = _stacked(u, y, past, future)
    to_state = _state_map(triangle, method, loop, direct)
    return [_regress(triangle, to_state[:, :order], direct) for order in orders]


def as_records(
    inputs: ArrayLike | Sequence[ArrayLike], outputs: ArrayLike | Sequence[ArrayLike]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Returns inputs and outputs as lists of 2-D arrays, one pair a record; one pair of arrays is one record.

    Raises:
        WindowError: unequal numbers of records, rows or columns.
    """
    u, y = (
        [np.array(item, dtype=np.float64) for item in ([values] if getattr(values, "ndim", 1) == 2 else values)]  # type: ignore[union-attr]
        for values in (inputs, outputs)
    )
    if len(u) != len(y) or not u:
        raise WindowError(f"{len(u)} records of inputs, {len(y)} of outputs", "as many of one as of the other")
    for a, b in zip(u, y, strict=True):
        if a.ndim != 2 or b.ndim != 2 or len(a) != len(b):
            raise WindowError(f"a record with inputs {a.shape}, outputs {b.shape}", "(rows, m) and (rows, p)")
        if a.shape[1] != u[0].shape[1] or b.shape[1] != y[0].shape[1]:
            raise WindowError("records with different numbers of columns", "the same channels in every record")
    return u, y


def _stacked(u: Sequence[FloatArray], y: Sequence[FloatArray], past: int, future: int) -> Triangle:
    """Scales, stacks and compresses records to one triangle.

    Row k gives the equation row of the inputs u[k] ... u[k+f-1], the past z_p = (y, u)[k-1] ... (y, u)[k-p], most
    recent first, and the outputs y[k] ... y[k+f-1].  It is usable when all of that lies in one record and is finite, so
    gaps and missing samples cost rows and never join what does not belong together.
    """
    scaling: list[FloatArray] = []
    for name, records in (("input", u), ("output", y)):
        joined = np.concatenate(records)
        finite = np.isfinite(joined)
        if not np.all(finite.any(axis=0)):
            raise NotIdentifiableError(f"{name} {int(np.argmin(finite.any(axis=0)))} was never measured")
        mean, scale = np.nanmean(np.where(finite, joined, np.nan), axis=0), np.nanstd(joined, axis=0, where=finite)
        still = scale <= 1e-12 * np.maximum(np.abs(mean), 1e-300)
        if np.any(still):
            raise NotIdentifiableError(
                f"{name} {int(np.argmax(still))} never moves", "channels that vary", "leave it out, or excite it"
            )
        scaling += [mean, scale]
    u_mean, u_scale, y_mean, y_scale = scaling
    m, p, span = u[0].shape[1], y[0].shape[1], past + future
    columns = np.arange(1 + future * m + past * (p + m) + future * p)
    R, rows = np.zeros((0, len(columns))), 0
    for a, b in zip(u, y, strict=True):
        a, b = (a - u_mean) / u_scale, (b - y_mean) / y_scale
        whole = np.isfinite(a).all(axis=1) & np.isfinite(b).all(axis=1)
        run = np.concatenate([[0], np.cumsum(whole)])
        usable = past + np.flatnonzero(run[span:] - run[:-span] == span)
        for k in (usable[i : i + CHUNK, None] for i in range(0, len(usable), CHUNK)):
            ahead, back = k + np.arange(future), k - 1 - np.arange(past)
            parts = (np.ones((len(k), 1)), a[ahead], np.concatenate([b[back], a[back]], axis=2), b[ahead])
            chunk = np.concatenate([part.reshape(len(k), -1) for part in parts], axis=1)
            R, rows = _triangular(np.concatenate([R, chunk])), rows + len(chunk)
    if rows < ROWS_PER_COLUMN * len(columns):
        raise NotIdentifiableError(
            f"{rows} usable rows for {len(columns)} columns",
            f"at least {round(ROWS_PER_COLUMN * len(columns))}",
            "use longer records without gaps, or a shorter past and future",
        )
    one, u_future, z_past, y_future = np.split(columns, np.cumsum([1, future * m, past * (p + m)]))
    places = u_future.reshape(future, m), z_past.reshape(past, p + m), y_future.reshape(future, p)
    return Triangle(R, rows, one, *places, tuple(scaling))


def _triangular(matrix: FloatArray) -> FloatArray:
    """R factor of a matrix, shape (columns, columns) once it has as many rows."""
    r: Any = np.linalg.qr(matrix, mode="r")  # its stubs do not know what mode r returns
    return np.asarray(r)


def _state_map(t: Triangle, method: str, loop: str, direct: BoolArray) -> FloatArray:
    """Maps the past to states of unit variance, most telling first, shape (past * (p + m), states)."""
    z, y = t.z_past.ravel(), t.y_future.ravel()
    # A high-order ARX model: y[k] = sum_i theta_i (y, u)[k-i] + d u[k] + e[k].
    error, theta, d = _innovations(t, np.eye(len(z)), direct)
    if loop == "open":
        # R is ordered [1, u_f | z_p | y_f]: these blocks are the covariances given the future inputs.
        R = t.R
    else:
        # The future outputs less what inputs and outputs since row k caused depend on the past alone.
        lags = theta[1:].reshape(*t.z_past.shape, -1)
        recent = [np.concatenate([a, b]) for a, b in zip(t.y_future, t.u_future, strict=True)]
        corrected = []
        for j in range(len(recent)):
            block = t.R[:, t.y_future[j]] - t.R[:, t.u_future[j]] @ d
            for i in range(j):
                block = block - t.R[:, recent[j - 1 - i]] @ lags[i]
            corrected.append(block)
        R = _triangular(np.concatenate([t.R[:, np.concatenate([t.one, z])], *corrected], axis=1))
        z, y = 1 + np.arange(len(z)), 1 + len(z) + np.arange(len(y))
    past, cross, rest = R[np.ix_(z, z)], R[np.ix_(z, y)], R[np.ix_(y, y)]
    # `cross` is S_pp^(-1/2) S_pf, the R32 of PO-MOESP transposed.  CVA weighs the future by S_ff^(-1/2).  MOESP weighs
    # it not, so its answer depends on the units of the outputs: here one unit is the one-step prediction error.
    if method == "cva":
        values, vectors = np.linalg.eigh(cross.T @ cross + rest.T @ rest)
        kept = values > CUTOFF * values[-1]
        weighted = cross @ np.asarray((vectors[:, kept] / np.sqrt(values[kept])) @ vectors[:, kept].T)
    else:
        unit = np.sqrt(np.sum(error**2, axis=0) / t.rows) + 1e-6
        weighted = cross / np.tile(unit, len(t.y_future))
    directions = np.linalg.svd(weighted)[0][:, : min(cross.shape)]
    return np.asarray(np.sqrt(t.rows) * np.linalg.pinv(past, rcond=CUTOFF) @ directions)


def _innovations(t: Triangle, to_state: FloatArray, direct: BoolArray) -> tuple[FloatArray, ...]:
    """Regresses y[k] on a constant, on the states of the past and, where `direct`, on u[k].

    Returns:
        R columns of e[k], then [g; C'] of shape (1 + n, p) and D' of shape (m, p).
    """
    known = np.concatenate([t.R[:, t.one], t.R[:, t.z_past.ravel()] @ to_state], axis=1)
    u, y = t.u_future[0], t.y_future[0]
    c, d = np.zeros((known.shape[1], len(y))), np.zeros((len(u), len(y)))
    if np.any(~direct):
        c[:, ~direct] = np.linalg.lstsq(known, t.R[:, y[~direct]], rcond=CUTOFF)[0]
    if np.any(direct):
        both = np.concatenate([known, t.R[:, u]], axis=1)
        solution = np.linalg.lstsq(both, t.R[:, y[direct]], rcond=CUTOFF)[0]
        c[:, direct], d[:, direct] = solution[: known.shape[1]], solution[known.shape[1] :]
    return t.R[:, y] - known @ c - t.R[:, u] @ d, c, d


def _regress(t: Triangle, to_state: FloatArray, direct: BoolArray) -> SubspaceModel:
    """Output equation, innovations, then the state equation with the innovations as known inputs."""
    n, m = to_state.shape[1], t.u_future.shape[1]
    error, gc, dt = _innovations(t, to_state, direct)
    # The past of row k+1 is the past of row k moved on by (y, u)[k]: the next state needs no further data.
    newest = np.concatenate([t.y_future[0], t.u_future[0]])
    moved_on = np.concatenate([newest, t.z_past[:-1].ravel()])
    state, following = t.R[:, t.z_past.ravel()] @ to_state, t.R[:, moved_on] @ to_state
    causes = np.concatenate([state, t.R[:, t.u_future[0]], error, t.R[:, t.one]], axis=1)
    a, b, k, f = np.split(np.linalg.lstsq(causes, following, rcond=CUTOFF)[0].T, np.cumsum([n, m, error.shape[1]]), 1)
    # In the units of the data: u = u_mean + u_scale u', y = y_mean + y_scale y'.
    u_mean, u_scale, y_mean, y_scale = t.scaling
    b = b / u_scale
    c, d = y_scale[:, None] * gc[1:].T, y_scale[:, None] * dt.T / u_scale
    covariance = error.T @ error / t.rows * np.outer(y_scale, y_scale)
    offsets = f[:, 0] - b @ u_mean, y_mean + y_scale * gc[0] - d @ u_mean
    return SubspaceModel(a.copy(), b, c, d, k / y_scale, *offsets, covariance, t.rows)


class Prediction(NamedTuple):
    """Segments simulated from their estimated initial states.

    Attributes:
        starts: first row of each segment, shape (segments,).
        outputs: predicted, shape (segments, length, p).
    """

    starts: IntArray
    outputs: FloatArray


def predict(
    model: SubspaceModel,
    inputs: ArrayLike,
    outputs: ArrayLike,
    length: int,
    starts: ArrayLike | None = None,
    sigma: ArrayLike | None = None,
) -> Prediction:
    """Simulates segments open loop, each from the initial state that fits its own measurements best.

    The same treatment that the physical model gets: nothing but the inputs and one initial state a segment.  That state
    takes n degrees of freedom from the length * p measurements of a segment.

    Args:
        inputs: shape (rows, m), finite.
        outputs: shape (rows, p); NaN where nothing was measured.
        length: rows a segment.
        starts: first rows of the segments; default: back to back from row 0, a shorter rest left out.
        sigma: standard deviations that weigh the outputs, shape (p,); default: of the innovations.

    Raises:
        WindowError: shapes that do not match the model, inputs that are not finite, or no whole segment.
    """
    u, y = np.array(inputs, dtype=np.float64), np.array(outputs, dtype=np.float64)
    p, m = model.D.shape
    if u.ndim != 2 or y.ndim != 2 or u.shape[1] != m or y.shape[1] != p or len(u) != len(y):
        raise WindowError(f"inputs {u.shape}, outputs {y.shape}", f"(rows, {m}) and (rows, {p})")
    if not np.all(np.isfinite(u)):
        raise WindowError("inputs that are not finite", "finite inputs", "split the record there")
    first = np.arange(0, len(u) - length + 1, max(length, 1)) if starts is None else np.array(starts)
    first = first.astype(np.int64)
    if length < 1 or not len(first) or first.min() < 0 or first.max() + length > len(u):
        raise WindowError(f"segments of {length} rows in a record of {len(u)}", "whole segments inside the record")
    if sigma is None:
        sigma = np.sqrt(np.maximum(np.diag(model.innovation_covariance), 1e-24))
    weight = 1.0 / np.broadcast_to(np.asarray(sigma, dtype=np.float64), (p,))
    rows = first[:, None] + np.arange(length)
    u, y = u[rows], y[rows]
    # The response to the inputs from a zero state, and C A^k, which a state adds to it.
    x, row = np.zeros((len(first), model.order)), model.C
    forced, free = np.empty(y.shape), np.empty((length, *model.C.shape))
    for k in range(length):
        forced[:, k] = x @ model.C.T + u[:, k] @ model.D.T + model.output_offset
        x = x @ model.A.T + u[:, k] @ model.B.T + model.state_offset
        free[k], row = row, row @ model.A
    # The states that leave the least of the measurements.
    design = (free * weight[:, None]).reshape(length * p, -1)
    target = ((y - forced) * weight).reshape(len(first), -1)
    complete = np.all(np.isfinite(target), axis=1)
    states = np.zeros((len(first), model.order))
    states[complete] = target[complete] @ np.linalg.pinv(design).T
    for s in np.flatnonzero(~complete):
        seen = np.isfinite(target[s])
        states[s] = np.linalg.lstsq(design[seen], target[s, seen])[0]
    return Prediction(first, forced + np.einsum("kpn,sn->skp", free, states))
