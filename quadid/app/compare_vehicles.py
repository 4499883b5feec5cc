"""Two vehicle files on the same flights: which predicts better, by how much, and how they differ."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer

from quadid.app.logs import Given, Log, fitted_before, listed, read
from quadid.app.options import Described, Horizons, OwnRate, Seed, Typed
from quadid.app.outcome import LIBRARY, Reported, provenance
from quadid.app.score import HORIZONS, ahead
from quadid.chi_square import Z95
from quadid.errors import LogError
from quadid.parameters import NOMINAL_UNITS
from quadid.report.page import axis, figure, level, section, trace
from quadid.report.tables import TextTable, heads, number
from quadid.report.verdict import Verdict, percent
from quadid.types import FloatArray, Json
from quadid.vehicle import Vehicle

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
        """Better file, and by how much."""
        result = self.result
        low, high = result["ci95"]
        span = f"Ratio of errors B / A {number(result['ratio'], 3)}, 95 % {number(low, 3)} to {number(high, 3)}"
        names = {"a": f"A ({result['a']})", "b": f"B ({result['b']})"}
        details = (f"{span}, over all quantities after {result['after']} samples.",)
        if result["better"] == "neither":
            return Verdict("fair", "Neither file predicts better on these flights", details, ())
        better, worse = (names[k] for k in (("b", "a") if result["better"] == "b" else ("a", "b")))
        share = abs(1.0 - (result["ratio"] if result["better"] == "b" else 1.0 / result["ratio"]))
        return Verdict("good", f"{better} predicts better than {worse}, by {percent(share)}", details, ())

    def tables(self) -> list[TextTable]:
        """Errors after every horizon, parameters and effects side by side."""
        result = self.result
        columns = heads("after > | quantity | A > | B > | B / A > | 95 % interval >1")
        rows = tuple(
            (
                after,
                f"{name} [{result['units'][name]}]",
                number(e["a"]),
                number(e["b"]),
                number(e["ratio"], 3),
                " .. ".join(number(v, 3) for v in e["ci95"]),
            )
            for after, errors in result["horizons"].items()
            for name, e in errors.items()
        )
        title = (
            f"Mean open-loop error of A ({result['a']}) and B ({result['b']}) after n samples, {result['samples']} "
            f"runs in {result['blocks']} blocks"
        )
        out = [TextTable(title, columns, rows)]
        sides = heads("parameter | A > | A, 95 % >2 | B > | B, 95 % >2 | apart [sigma] > | unit <1")
        ends = [
            [" .. ".join(number(v) for v in p[k]) if p[k] else "a guess" for k in ("a_ci95", "b_ci95")]
            for p in result["parameters"]
        ]
        values = tuple(
            (p["name"], number(p["a"]), one, number(p["b"]), two, number(p["apart"], 2), p["unit"])
            for p, (one, two) in zip(result["parameters"], ends, strict=True)
        )
        out.append(TextTable("Parameters side by side", sides, values))
        numbered = heads("effect | number | A > | B >")
        numbers = tuple((e["effect"], e["name"], number(e["a"]), number(e["b"])) for e in result["effects"])
        return [*out, TextTable("Effects side by side", numbered, numbers)] if numbers else out

    def records(self) -> list[dict[str, Any]]:
        """One row a horizon and quantity."""
        return [
            {
                "name": f"{name}.{h}",
                "after": int(h),
                "quantity": name,
                **{k: v for k, v in e.items() if k != "ci95"},
                "low": e["ci95"][0],
                "high": e["ci95"][1],
            }
            for h, errors in self.result["horizons"].items()
            for name, e in errors.items()
        ]

    def page(self, command: str = LIBRARY) -> str:
        """One page: errors, ratios with intervals, parameters."""
        result = self.result
        errors, *rest = self.tables()
        after = np.array([float(h) for h in result["horizons"]])
        data = []
        for role, name in zip(("measured", "before", "after", "truth"), result["units"], strict=True):
            found = [result["horizons"][h][name] for h in result["horizons"]]
            for key, edge in (("ratio", ""), (0, ", 95 %"), (1, ", 95 %")):
                values = [e["ratio"] if key == "ratio" else e["ci95"][key] for e in found]
                y = np.array([np.nan if v is None else v for v in values], dtype=np.float64)
                if np.isfinite(y).any():
                    more = {"line": {"dash": "dot"}, "showlegend": False} if edge else {"mode": "lines+markers"}
                    data.append(trace(role, name + edge, after, y, **more))
        layout = {
            "xaxis": axis("samples after the start"),
            "yaxis": axis("error of B over that of A"),
            "shapes": [level(1.0)],
        }
        caption = "below 1: B predicts better; dotted: 95 % interval"
        ratios = figure("ratios", "Errors of B over those of A", data, layout, 320, caption=caption)
        sections = [
            section("errors", "Errors", errors.title, [ratios], [errors.part()]),
            *(section(f"side-{i}", t.title, "", tables=[t.part()]) for i, t in enumerate(rest)),
        ]
        title = f"{result['a']} and {result['b']} on the same flights"
        return self.rendered(title, ", ".join(result["logs"]), sections, provenance(self.logs, command))


def compare_vehicles(
    a: Annotated[Described, Typed(str, typer.Argument(metavar="A"), ..., Vehicle.named)],
    b: Annotated[Described, Typed(str, typer.Argument(metavar="B"), ..., Vehicle.named)],
    on: Annotated[Given, Typed(list[str], typer.Option(metavar="LOG"), ..., opened=True)],
    *,
    horizons: Horizons = HORIZONS,
    rate: OwnRate = None,
    seed: Seed = 0,
) -> Compared:
    """Predicts the same flights with two vehicle files, from the same starts.

    The ratio of their mean errors gets an interval by a paired block bootstrap: whole blocks of starts are drawn anew,
    because runs that overlap have similar errors, and each block with the errors of both files.

    Args:
        a: a shipped vehicle or a vehicle file; its values are taken as they are.
        b: the other vehicle or vehicle file.
        on: a flight to predict, or several.
        horizons: samples of the grid after the start of each run, or times, as ``0.1s``.
        rate: of the grid [Hz]; None for each log's own.
        seed: decides the draws.

    Raises:
        LogError: no log, one that does not fit both vehicles, or flights too short for an interval.
        ParameterError: horizons that are no positive numbers.
        VehicleError: no such vehicle.
    """
    from quadid.identification.predict import QUANTITIES, start_errors

    if not listed(on):
        raise LogError("no log", "at least one flight", "name flights with --on")
    pair = [Vehicle.named(v) for v in (a, b)]
    opened = [[log.at(rate) for log in read(on, vehicle)] for vehicle in pair]
    both = list(zip(pair, opened, strict=True))
    steps = ahead(horizons, [w for log in opened[0] for w in log.windows])
    found = [[start_errors(log.windows, vehicle, steps) for log in logs] for vehicle, logs in both]
    if [[len(w) for w in log] for log in found[0]] != [[len(w) for w in log] for log in found[1]]:
        raise LogError(
            "the two vehicles read these logs on different grids",
            "the same meaning of the rotor columns",
            "use one `command` in both files, or a common --rate",
        )
    blocks = []
    for k, log in enumerate(opened[0]):
        size = max(max(steps), round(BLOCK / log.windows[0].dt))
        for one, two in zip(found[0][k], found[1][k], strict=True):
            errors = np.stack([one, two])
            blocks += [errors[:, i : i + size] for i in range(0, errors.shape[1], size)]
    if len(blocks) < FEWEST_BLOCKS:
        raise LogError(
            f"{len(blocks)} stretches of {max(steps)} samples",
            f"at least {FEWEST_BLOCKS} for an interval",
            "use longer flights, or shorter horizons",
        )
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
        for label, (vehicle, logs) in zip("AB", both, strict=True)
        for log in logs
        if fitted_before(vehicle, log)
    ]
    labels = [v.name for v in pair] if pair[0].name != pair[1].name else [v.label for v in pair]
    result = {
        "schema": "quadid.compare_vehicles/1",
        **dict(zip("ab", labels, strict=True)),
        "logs": [log.recording.name for log in opened[0]],
        "samples": sum(block.shape[1] for block in blocks),
        "blocks": len(blocks),
        "horizons": entries,
        "units": dict(QUANTITIES),
        "ratio": overall,
        "ci95": [float(low), float(high)],
        "after": wanted[-1],
        "better": "b" if high < 1.0 else "a" if low > 1.0 else "neither",
        "parameters": _parameters(*pair),
        "effects": _effects(*pair),
        "warnings": [*dict.fromkeys([*warnings, *(text for log in opened[0] for text in log.warnings)])],
    }
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
        out.append(
            {
                "name": name,
                "unit": unit,
                "a": one.initial,
                "a_ci95": ends[0],
                "b": two.initial,
                "b_ci95": ends[1],
                "apart": apart,
            }
        )
    return out


def _effects(a: Vehicle, b: Vehicle) -> Sequence[Json]:
    """Numbers of the effects of either; None where one has none."""
    keys = dict.fromkeys((e, k) for v in (a, b) for e, numbers in v.effects.items() for k in numbers)
    return [
        {"effect": e, "name": k, "a": a.effects.get(e, {}).get(k), "b": b.effects.get(e, {}).get(k)} for e, k in keys
    ]
