"""Which order a black-box model should have, judged by what it is for: simulating segments it has not seen."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from quadid.errors import NotIdentifiableError
from quadid.types import FloatArray
from quadid_evaluation.paper.hankel import as_records
from quadid_evaluation.paper.state_space import predict
from quadid_evaluation.paper.subspace import fit_orders

HELD_OUT = 0.3
"""Last part of each record that judges the orders fitted to the rest."""


@dataclass(frozen=True)
class OrderChoice:
    """The chosen order and what it was chosen from.

    Attributes:
        order: lowest error.
        orders: candidates.
        errors: mean squared weighted error of each on the held-out segments.
    """

    order: int
    orders: tuple[int, ...]
    errors: tuple[float, ...]


def choose_order(
    method: str,
    inputs: ArrayLike | Sequence[ArrayLike],
    outputs: ArrayLike | Sequence[ArrayLike],
    orders: Sequence[int],
    length: int,
    sigma: ArrayLike,
    past: int = 20,
    future: int = 15,
    feedthrough: bool | Sequence[bool] = True,
) -> OrderChoice:
    """Fits each order to the first 70 % of every record and scores it on segments of the rest.

    An information criterion judges one step ahead; a model that is to run a second deserves to be judged by a second.
    No record but those given is looked at.

    Args:
        method: this and all that is not explained here: as `quadid_evaluation.paper.subspace.fit_subspace`.
        inputs: (rows, m) a record.
        outputs: (rows, p) a record.
        orders: candidates.
        length: rows a segment.
        sigma: standard deviations that weigh the outputs, shape (p,).
        past: block rows.
        future: block rows.
        feedthrough: for all outputs or each.

    Raises:
        NotIdentifiableError: no record is long enough to hold a segment out.
    """
    u, y = as_records(inputs, outputs)
    cuts = [round((1.0 - HELD_OUT) * len(record)) for record in u]
    early = [record[:cut] for record, cut in zip(u, cuts, strict=True)]
    models = fit_orders(
        method, early, [record[:cut] for record, cut in zip(y, cuts, strict=True)],
        list(orders), past, future, "closed", feedthrough,
    )  # fmt: skip
    held = [(a[cut:], b[cut:]) for a, b, cut in zip(u, y, cuts, strict=True) if len(a) - cut >= length]
    if not held:
        raise NotIdentifiableError("no record long enough", f"{length} rows in the last {HELD_OUT:.0%} of a record")
    weight = 1.0 / np.asarray(sigma, dtype=np.float64)
    errors = []
    for model in models:
        squares: list[FloatArray] = []
        for a, b in held:
            prediction = predict(model, a, b, length, sigma=sigma)
            measured = b[prediction.starts[:, None] + np.arange(length)]
            squares.append(np.ravel(((prediction.outputs - measured) * weight) ** 2))
        errors.append(float(np.nanmean(np.concatenate(squares))))
    return OrderChoice(int(orders[int(np.argmin(errors))]), tuple(orders), tuple(errors))
