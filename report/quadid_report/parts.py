"""Pieces of a page: sections, tables, and figures as plain Plotly descriptions without colours.

The page gives every trace the colour of its role: ``measured``, ``before`` (current parameters), ``after`` (proposed
ones), ``truth``, ``floor``.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from quadid.types import FloatArray, JsonDict


def section(
    identifier: str, title: str, intro: str = "", figures: Sequence[Mapping[str, Any]] = (),
    tables: Sequence[Mapping[str, Any]] = (),
    **more: Any,
) -> JsonDict:  # fmt: skip
    """A section of the page: what it says, then its figures and tables."""
    return {
        "id": identifier, "title": title, "intro": intro, "figures": list(figures), "tables": list(tables), **more,
    }  # fmt: skip


def rows_of(
    head: Sequence[str], rows: Sequence[Sequence[Any]], fold: str = "", kind: str = "cards",
    classes: Sequence[str] | None = None,
) -> JsonDict:  # fmt: skip
    """A table; folded under a line where one is given; `classes` are of the cells of each column.

    On a phone each row is a card (`kind` ``cards``, ``cards narrow``), or a line or two (``compact``).
    """
    given = list(classes or ["wrap"] * len(head))
    return {"head": list(head), "rows": [list(row) for row in rows], "fold": fold, "kind": kind, "classes": given}


def measures(head: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int]) -> JsonDict:
    """A narrow table in which the columns `numbers`, counted from 0, hold numbers."""
    return rows_of(head, rows, kind="cards narrow", classes=["number" * (i in numbers) for i in range(len(head))])


def figure(
    identifier: str, title: str, data: Sequence[Mapping[str, Any]], layout: JsonDict, height: int, **more: Any
) -> JsonDict:
    """A figure of one view."""
    views = [{"label": "", "data": list(data), "layout": layout}]
    return {"id": identifier, "title": title, "views": views, "height": height, **more}


def axis(text: str, **more: Any) -> JsonDict:
    """An axis with its title."""
    return {"title": {"text": text}, **more}


def upright(x: float) -> JsonDict:
    """An upright line through a figure."""
    return {"type": "line", "x0": x, "x1": x, "y0": 0, "y1": 1, "yref": "paper", "role": "floor"}


def level(y: float) -> JsonDict:
    """A line across a figure at the height that all should keep to."""
    return {"type": "line", "x0": 0, "x1": 1, "xref": "paper", "y0": y, "y1": y, "role": "floor"}


def trace(role: str, name: str, x: FloatArray | None, y: FloatArray, **more: Any) -> JsonDict:
    """One line of a figure; without `x` it takes that of its view.  Numbers keep what a picture can show."""
    across = {} if x is None else {"x": short(x)}
    return {"role": role, "name": name, **across, "y": short(y), "type": "scatter", "mode": "lines", **more}


def short(values: FloatArray, resolution: float | None = None) -> list[float | None]:
    """Numbers rounded to a two-thousandth of their range, so that a page stays small; None where not finite.

    Args:
        values: shape (n,).
        resolution: smallest difference to keep, instead.
    """
    good = values[np.isfinite(values)]
    if len(good) == 0:
        return [None] * len(values)
    finest = resolution or max(float(np.ptp(good)), 1e-3 * float(np.abs(good).max()), 1e-12) / 2000.0
    decimals = max(0, math.ceil(-math.log10(finest)))
    return [round(v, decimals) if math.isfinite(v) else None for v in values.tolist()]
