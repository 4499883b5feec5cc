"""The black-box model that subspace identification yields, and its prediction of short segments.

Innovation form, in the units of the data:
    x[k+1] = A x[k] + B u[k] + K e[k] + f
    y[k]   = C x[k] + D u[k] + e[k] + g
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import WindowError
from quadid.types import ComplexArray, FloatArray, IntArray


@dataclass(frozen=True)
class SubspaceModel:
    """A linear time-invariant model about an operating point; n states, m inputs, p outputs.

    The state has no physical meaning: any change of basis gives the same model.

    Attributes:
        A: shape (n, n).
        B: shape (n, m).
        C: shape (p, n).
        D: shape (p, m); zero rows where no feedthrough was allowed.
        K: shape (n, p), gain of the innovations.
        state_offset: f, shape (n,), and
        output_offset: g, shape (p,): what the operating point adds.
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

    def __post_init__(self) -> None:
        """Makes the arrays read-only."""
        for item in fields(self):
            value = getattr(self, item.name)
            if isinstance(value, np.ndarray):
                value.setflags(write=False)

    @property
    def order(self) -> int:
        """Number of states n."""
        return len(self.A)

    @property
    def poles(self) -> ComplexArray:
        """Eigenvalues of A, shape (n,), by falling magnitude; inside the unit circle where stable."""
        poles = np.asarray(np.linalg.eigvals(self.A), dtype=np.complex128)
        return poles[np.lexsort((poles.imag, -np.abs(poles)))]


class Prediction(NamedTuple):
    """Segments simulated from their estimated initial states.

    Attributes:
        starts: first row of each segment, shape (segments,).
        outputs: predicted, shape (segments, length, p).
        initial_states: shape (segments, n).
    """

    starts: IntArray
    outputs: FloatArray
    initial_states: FloatArray


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
        model: n states.
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
    rows = first[:, None] + np.arange(length)
    if sigma is None:
        sigma = np.sqrt(np.maximum(np.diag(model.innovation_covariance), 1e-24))
    weight = 1.0 / np.broadcast_to(np.asarray(sigma, dtype=np.float64), (p,))
    return _from_best_states(model, first, u[rows], y[rows], weight)


def _from_best_states(
    model: SubspaceModel, first: IntArray, u: FloatArray, y: FloatArray, weight: FloatArray
) -> Prediction:
    segments, length, p = y.shape
    forced, free = _forced(model, u), _free(model, length)
    design = (free * weight[:, None]).reshape(length * p, -1)
    target = ((y - forced) * weight).reshape(segments, -1)
    complete = np.all(np.isfinite(target), axis=1)
    states = np.zeros((segments, model.order))
    states[complete] = target[complete] @ np.linalg.pinv(design).T
    for s in np.flatnonzero(~complete):
        seen = np.isfinite(target[s])
        states[s] = np.linalg.lstsq(design[seen], target[s, seen])[0]
    return Prediction(first, forced + np.einsum("kpn,sn->skp", free, states), states)


def _forced(model: SubspaceModel, u: FloatArray) -> FloatArray:
    """Response to inputs (segments, length, m) from a zero state, shape (segments, length, p)."""
    x = np.zeros((len(u), model.order))
    out = np.empty((*u.shape[:2], len(model.C)))
    for k in range(u.shape[1]):
        out[:, k] = x @ model.C.T + u[:, k] @ model.D.T + model.output_offset
        x = x @ model.A.T + u[:, k] @ model.B.T + model.state_offset
    return out


def _free(model: SubspaceModel, length: int) -> FloatArray:
    """C A^k for k = 0 ... length - 1, shape (length, p, n)."""
    out, row = np.empty((length, *model.C.shape)), model.C
    for k in range(length):
        out[k] = row
        row = row @ model.A
    return out
