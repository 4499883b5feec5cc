"""Two vehicle files on the same flights: which predicts better, by how much, and how they differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.app.logs import Given, Log, as_vehicle, fitted_before, listed, read
from quadid.app.outcome import LIBRARY, Reported, provenance
from quadid.app.score import HORIZONS, ahead
from quadid.chi_square import Z95
from quadid.errors import LogError
from quadid.identification.predict import QUANTITIES, start_errors
from quadid.parameters import NOMINAL_UNITS
from quadid.report.verdict import Verdict
from quadid.types import FloatArray, Json
from quadid.vehicle import Vehicle

if TYPE_CHECKING:
    from quadid.report.tables import TextTable

BLOCK = 1.0
"""Least length of a block of starts that is drawn as one [s]: runs that overlap err alike."""
DRAWS = 2000
FEWEST_BLOCKS = 8
"""With fewer blocks an interval would be made up."""


@dataclass(frozen=True, repr=False)
class Compared(Reported):
    """Two vehicles beside each other.

    Attributes:
        result: of the form ``quadid.compare_vehicles/1``.
        logs: the flights, as read for the first vehicle.
    """

    result: dict[str, Any]
    logs: tuple[Log, ...]

    @property
    def verdict(self) -> Verdict:
        """Which predicts better, and by how much."""
        from quadid.report.compare_page import compare_verdict

        return compare_verdict(self.result)

    def tables(self) -> list[TextTable]:
        """Errors after every horizon, and parameters side by side."""
        from quadid.report.compare_page import compare_tables

        return compare_tables(self.result)

    def records(self) -> list[dict[str, Any]]:
        """One row a horizon and quantity."""
        return [
            {"after": int(h), "quantity": name, **{k: v for k, v in e.items() if k != "ci95"},
             "low": e["ci95"][0], "high": e["ci95"][1]}
            for h, errors in self.result["horizons"].items() for name, e in errors.items()
        ]  # fmt: skip

    def page(self, command: str = LIBRARY) -> str:
        """One page: errors, ratios with intervals, parameters."""
        from quadid.report.compare_page import compare_page
        from quadid.report.page import render

        return render(compare_page(self.result, provenance(self.logs, command)))


def compare_vehicles(
    a: str | Path | Vehicle, b: str | Path | Vehicle, on: Given, *, horizons: str | Sequence[int | str] = HORIZONS,
    rate: float | None = None, seed: int = 0,
) -> Compared:  # fmt: skip
    """Predicts the same flights with two vehicle files, from the same starts.

    The ratio of their mean errors comes with an interval from whole blocks of starts, drawn anew with their errors by
    both (paired block bootstrap): runs that overlap err alike, and a hard stretch is hard for both.

    Args:
        a: a shipped name, a YAML file or a `Vehicle`; its values are taken as they are.
        b: likewise.
        on: a log or several, as paths or from `load`.
        horizons: samples of the grid after the start of each run, or times, as ``0.1s``.
        rate: of the grid [Hz]; None for each log's own.
        seed: decides the draws.

    Raises:
        LogError: no log, one that does not fit both vehicles, or flights too short for an interval.
        ParameterError: horizons that are no positive numbers.
        VehicleError: no such vehicle.
    """
    if not listed(on):
        raise LogError("no log", "at least one flight", "name flights with --on")
    pair = [as_vehicle(v) for v in (a, b)]
    opened = [[log.at(rate) for log in read(on, vehicle)] for vehicle in pair]
    both = list(zip(pair, opened, strict=True))
    steps = ahead(horizons, [w for log in opened[0] for w in log.windows])
    found = [[start_errors(log.windows, vehicle, steps) for log in logs] for vehicle, logs in both]
    if [[len(w) for w in log] for log in found[0]] != [[len(w) for w in log] for log in found[1]]:
        raise LogError(
            "the two vehicles read these logs on different grids", "the same meaning of the rotor columns",
            "use one `command` in both files, or a common --rate",
        )  # fmt: skip
    blocks = []
    for k, log in enumerate(opened[0]):
        size = max(max(steps), round(BLOCK / log.windows[0].dt))
        for one, two in zip(found[0][k], found[1][k], strict=True):
            errors = np.stack([one, two])
            blocks += [errors[:, i : i + size] for i in range(0, errors.shape[1], size)]
    if len(blocks) < FEWEST_BLOCKS:
        raise LogError(
            f"{len(blocks)} stretches of {max(steps)} samples", f"at least {FEWEST_BLOCKS} for an interval",
            "use longer flights, or shorter horizons",
        )  # fmt: skip
    total, drawn = _means(blocks, seed)
    wanted = tuple(dict.fromkeys(steps))
    entries = {
        str(h): {name: _entry(total[:, i, q], drawn[:, :, i, q]) for q, name in enumerate(QUANTITIES)}
        for i, h in enumerate(wanted)
    }
    overall, spread = _overall(total[:, -1]), np.array([_overall(d) for d in drawn[:, :, -1]])
    low, high = np.quantile(spread, [0.025, 0.975]) if np.isfinite(spread).all() else (0.0, math.inf)
    warnings = [
        f"{label}: {log.name}: the vehicle file was fitted to this flight, so its errors are no proof"
        for label, (vehicle, logs) in zip("AB", both, strict=True) for log in logs if fitted_before(vehicle, log)
    ]  # fmt: skip
    result = {
        "schema": "quadid.compare_vehicles/1", "a": pair[0].name, "b": pair[1].name,
        "logs": [log.recording.name for log in opened[0]], "samples": sum(block.shape[1] for block in blocks),
        "blocks": len(blocks), "horizons": entries, "units": dict(QUANTITIES),
        "ratio": overall, "ci95": [float(low), float(high)], "after": wanted[-1],
        "better": "b" if high < 1.0 else "a" if low > 1.0 else "neither",
        "parameters": _parameters(*pair), "effects": _effects(*pair),
        "warnings": [*dict.fromkeys([*warnings, *(text for log in opened[0] for text in log.warnings)])],
    }  # fmt: skip
    return Compared(result, tuple(opened[0]))


def _means(blocks: Sequence[FloatArray], seed: int) -> tuple[FloatArray, FloatArray]:
    """Mean errors of both, (2, horizons, 4), and of drawn blocks, (draws, 2, horizons, 4)."""
    known = [~np.isnan(block).any(axis=0) for block in blocks]
    sums = np.array([np.where(k, block, 0.0).sum(axis=1) for block, k in zip(blocks, known, strict=True)])
    counts = np.array([k.sum(axis=0) for k in known], dtype=np.float64)
    picked = np.random.default_rng(seed).multinomial(len(blocks), np.full(len(blocks), 1.0 / len(blocks)), DRAWS)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = sums.sum(axis=0) / counts.sum(axis=0)
        drawn = np.tensordot(picked, sums, 1) / np.tensordot(picked, counts, 1)[:, None]
    return np.asarray(total), np.asarray(drawn)


def _entry(mean: FloatArray, drawn: FloatArray) -> Json:
    """Errors of both, the ratio of B's to A's, and its interval; None for what the logs lack."""
    if not np.isfinite(mean).all() or not mean[0] > 0.0:
        told = [None if math.isnan(m) else float(m) for m in mean]
        return {"a": told[0], "b": told[1], "ratio": None, "ci95": [None, None]}
    low, high = np.nanquantile(drawn[:, 1] / drawn[:, 0], [0.025, 0.975])
    return {
        "a": float(mean[0]),
        "b": float(mean[1]),
        "ratio": float(mean[1] / mean[0]),
        "ci95": [float(low), float(high)],
    }


def _overall(mean: FloatArray) -> float:
    """Geometric mean over the quantities of B's error over A's, (2, 4); infinite where B alone runs away."""
    known = ~np.isnan(mean).any(axis=0) & ~np.isinf(mean).all(axis=0)
    with np.errstate(divide="ignore"):
        logs = np.log(mean[1, known]) - np.log(mean[0, known])
    return float(np.exp(np.mean(logs))) if known.any() else math.nan


def _parameters(a: Vehicle, b: Vehicle) -> list[Json]:
    """Parameters of both with 95 % intervals; how far they are apart in standard deviations, where both have one."""
    out: list[Json] = []
    for name, unit in NOMINAL_UNITS.items():
        one, two = a.parameters[name], b.parameters[name]
        apart = None
        if one.sigma and two.sigma:
            apart = (two.initial - one.initial) / math.hypot(one.sigma, two.sigma)
        ends = [None if p.sigma is None else [p.initial - Z95 * p.sigma, p.initial + Z95 * p.sigma] for p in (one, two)]
        out.append({
            "name": name, "unit": unit, "a": one.initial, "a_ci95": ends[0], "b": two.initial, "b_ci95": ends[1],
            "apart": apart,
        })  # fmt: skip
    return out


def _effects(a: Vehicle, b: Vehicle) -> Sequence[Json]:
    """Numbers of the effects of either; None where one has none."""
    keys = dict.fromkeys((e, k) for v in (a, b) for e, numbers in v.effects.items() for k in numbers)
    return [
        {"effect": e, "name": k, "a": a.effects.get(e, {}).get(k), "b": b.effects.get(e, {}).get(k)} for e, k in keys
    ]
