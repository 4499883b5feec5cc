"""Past and future of records, stacked and compressed to one triangle.

Each usable row k gives one equation row ``[1, u_f, z_p, y_f]``: the future inputs u[k] ... u[k+f-1], the past
z_p = (y, u)[k-1] ... (y, u)[k-p], most recent first, and the future outputs y[k] ... y[k+f-1].  A row is usable when
all of that lies in one record and is finite, so gaps and missing samples cost rows and never join what does not belong
together.  All later least-squares problems are in these columns, so the R factor of the stack holds everything.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import NotIdentifiableError, WindowError
from quadid.types import FloatArray, IntArray

CHUNK = 4096
"""Rows stacked at a time; bounds the memory."""
ROWS_PER_COLUMN = 2.0
"""Fewer rows than this a column cannot support the regressions."""


@dataclass(frozen=True)
class Scaling:
    """Means and standard deviations that bring all channels to a common size.

    Attributes:
        u_mean: shape (m,), and u_scale: shape (m,).
        y_mean: shape (p,), and y_scale: shape (p,).
    """

    u_mean: FloatArray
    u_scale: FloatArray
    y_mean: FloatArray
    y_scale: FloatArray


@dataclass(frozen=True)
class Triangle:
    """R factor of the stacked rows, with the places of its columns.

    Attributes:
        R: upper triangular, shape (columns, columns).
        rows: number of stacked rows.
        one: place of the constant column, shape (1,).
        u_future: places of u[k+j], shape (f, m).
        z_past: places of (y, u)[k-1-i], shape (past, p + m).
        y_future: places of y[k+j], shape (f, p).
        scaling: of the data that were stacked.
    """

    R: FloatArray
    rows: int
    one: IntArray
    u_future: IntArray
    z_past: IntArray
    y_future: IntArray
    scaling: Scaling


def as_records(
    inputs: ArrayLike | Sequence[ArrayLike], outputs: ArrayLike | Sequence[ArrayLike]
) -> tuple[list[FloatArray], list[FloatArray]]:
    """Returns inputs and outputs as lists of 2-D arrays, one pair a record; one pair of arrays is one record.

    Raises:
        WindowError: unequal numbers of records, rows or columns.
    """
    u, y = _as_list(inputs), _as_list(outputs)
    if len(u) != len(y) or not u:
        raise WindowError(f"{len(u)} records of inputs, {len(y)} of outputs", "as many of one as of the other")
    for a, b in zip(u, y, strict=True):
        if a.ndim != 2 or b.ndim != 2 or len(a) != len(b):
            raise WindowError(f"a record with inputs {a.shape}, outputs {b.shape}", "(rows, m) and (rows, p)")
        if a.shape[1] != u[0].shape[1] or b.shape[1] != y[0].shape[1]:
            raise WindowError("records with different numbers of columns", "the same channels in every record")
    return u, y


def triangular(matrix: FloatArray) -> FloatArray:
    """R factor of a matrix, shape (columns, columns) once it has as many rows."""
    r: Any = np.linalg.qr(matrix, mode="r")  # its stubs do not know what mode r returns
    return np.asarray(r)


def _as_list(values: ArrayLike | Sequence[ArrayLike]) -> list[FloatArray]:
    if isinstance(values, np.ndarray) and values.ndim == 2:
        return [np.asarray(values, dtype=np.float64)]
    items = [np.array(item, dtype=np.float64) for item in values]  # type: ignore[union-attr]
    return [np.array(items)] if items and items[0].ndim == 1 else items


def stack(u: Sequence[FloatArray], y: Sequence[FloatArray], past: int, future: int) -> Triangle:
    """Scales, stacks and compresses records.

    Args:
        u: inputs of each record, (rows, m).
        y: outputs of each record, (rows, p).
        past: block rows of the past.
        future: block rows of the future.

    Raises:
        NotIdentifiableError: too few usable rows, or a channel that never moves.
    """
    scaling = _scaling(u, y)
    m, p = u[0].shape[1], y[0].shape[1]
    columns = np.arange(1 + future * m + past * (p + m) + future * p)
    ends = np.cumsum([1, future * m, past * (p + m)])
    R, rows = np.zeros((0, len(columns))), 0
    for a, b in zip(u, y, strict=True):
        a, b = (a - scaling.u_mean) / scaling.u_scale, (b - scaling.y_mean) / scaling.y_scale
        for usable in _usable_rows(a, b, past, future):
            chunk = _equation_rows(a, b, usable, past, future)
            R, rows = triangular(np.concatenate([R, chunk])), rows + len(chunk)
    if rows < ROWS_PER_COLUMN * len(columns):
        raise NotIdentifiableError(
            f"{rows} usable rows for {len(columns)} columns",
            f"at least {round(ROWS_PER_COLUMN * len(columns))}",
            "use longer records without gaps, or a shorter past and future",
        )
    one, u_future, z_past, y_future = np.split(columns, ends)
    return Triangle(
        R, rows, one, u_future.reshape(future, m), z_past.reshape(past, p + m), y_future.reshape(future, p), scaling
    )


def _scaling(u: Sequence[FloatArray], y: Sequence[FloatArray]) -> Scaling:
    parts = []
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
        parts += [mean, scale]
    return Scaling(*parts)


def _usable_rows(u: FloatArray, y: FloatArray, past: int, future: int) -> list[IntArray]:
    """Rows k whose whole past and future are in the record and finite, in chunks."""
    span = past + future
    if len(u) < span:
        return []
    finite = np.isfinite(u).all(axis=1) & np.isfinite(y).all(axis=1)
    run = np.concatenate([[0], np.cumsum(finite)])
    k = past + np.flatnonzero(run[span:] - run[:-span] == span)
    return [k[i : i + CHUNK] for i in range(0, len(k), CHUNK)]


def _equation_rows(u: FloatArray, y: FloatArray, k: IntArray, past: int, future: int) -> FloatArray:
    ahead, back = k[:, None] + np.arange(future), k[:, None] - 1 - np.arange(past)
    z = np.concatenate([y[back], u[back]], axis=2)
    parts = (np.ones((len(k), 1)), u[ahead], z, y[ahead])
    return np.concatenate([part.reshape(len(k), -1) for part in parts], axis=1)
