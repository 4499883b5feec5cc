"""Open-loop prediction error of a vehicle on logs."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer

from quadid.app.logs import Log, fitted_before, settled
from quadid.app.missing import ROWS, SECONDS
from quadid.app.options import Horizons, Logs, OfVehicle, OwnRate
from quadid.app.outcome import LIBRARY, Reported, provenance
from quadid.data.window import Window, beginning, sample_period
from quadid.errors import NotIdentifiableError, ParameterError
from quadid.model.layout import Layout
from quadid.report.page import band, figure, section, stacked, trace
from quadid.report.tables import Cell, Column, TextTable, number
from quadid.report.verdict import Verdict, score_verdict
from quadid.types import FloatArray, Json
from quadid.vehicle import Vehicle

HORIZONS = (1, 10, 50)
OPEN = 0.1
"""Longest horizon with bands [s] while rotor speeds are those of the log: what was flown in closed loop answers the
disturbances to come."""


@dataclass(frozen=True, repr=False)
class Scored(Reported):
    """Prediction errors; `result` has the form ``quadid.score/1``."""

    result: dict[str, Any]
    notes: tuple[str, ...] = ()
    logs: tuple[Log, ...] = ()

    @property
    def warnings(self) -> list[str]:
        """Problems of the logs."""
        return list(self.notes)

    @property
    def verdict(self) -> Verdict:
        """Errors beside sensor noise, and beside predicting no change."""
        return score_verdict(self.result)

    def tables(self) -> list[TextTable]:
        """Errors after every horizon, pooled and a log; what lies inside the predicted bands."""
        return [horizon_table(self.result), coverage_table(self.result)]

    @property
    def sentences(self) -> list[Cell]:
        """Basis of the bands."""
        return [Cell(self.result["bands"])]

    def records(self) -> list[dict[str, Any]]:
        """One row a quantity and horizon; those of single logs, which follow, have the name of the log in theirs."""
        from quadid.identification.predict import BANDS

        result, out = self.result, []
        for entry in [{"log": None, **result}, *(result["files"] if len(result["files"]) > 1 else ())]:
            for h, errors in entry["horizons"].items():
                for quantity, error in errors.items():
                    low, high = entry["spread"][h][quantity]
                    row = {
                        "name": ".".join(filter(None, (entry["log"], quantity, h))),
                        "log": entry["log"],
                        "quantity": quantity,
                        "after": int(h),
                        "unit": result["units"][quantity],
                        "error": error,
                        "low": low,
                        "high": high,
                    }
                    if entry["log"] is None:
                        row |= {key: result[key][h][quantity] for key in ("noise_floor", "no_change")}
                        inside = (result["coverage"][h] or {}).get(quantity) or dict.fromkeys(BANDS)
                        row |= {f"inside_{band}": share for band, share in inside.items()}
                    out.append(row)
        return out

    def page(self, command: str = LIBRARY) -> str:
        """One page: errors over the horizon beside sensor noise and beside predicting no change, and the bands."""
        from quadid.identification.predict import SHARE

        result, (errors, inside) = self.result, self.tables()
        steps = [int(h) for h in result["horizons"]]
        units = result["units"]
        known = [n for n in units if not all(math.isnan(errors[n]) for errors in result["horizons"].values())]
        places, layout = stacked([(f"{n} [{units[n]}]", {"type": "log"}) for n in known], "samples ahead")
        lines = (
            ("before", "no change predicted", result["no_change"]),
            ("floor", "noise floor", result["noise_floor"]),
            ("after", "error", result["horizons"]),
        )
        drawn_bands = [
            part
            for i, (name, where) in enumerate(zip(known, places, strict=True))
            for part in band(
                "after",
                "of the runs",
                np.array(steps, dtype=np.float64),
                *np.array([result["spread"][str(h)][name] for h in steps], dtype=np.float64).T,
                **where,
            )
        ]
        data = drawn_bands + [
            trace(
                role,
                label,
                np.array(steps, dtype=np.float64),
                np.array([math.nan if (v := of[str(h)][name]) is None else v for h in steps], dtype=np.float64),
                mode="lines+markers",
                showlegend=i == 0,
                legendgroup=role,
                **where,
            )
            for i, (name, where) in enumerate(zip(known, places, strict=True))
            for role, label, of in lines
        ]
        caption = (
            f"mean error from the measured state on, and the band in which {100 * SHARE:.0f} % of the runs lie; at "
            "the noise floor an error is no larger than the sensors' own"
        )
        drawn = figure("horizons", "Error over the horizon", data, layout, 130 * len(known) + 70, caption=caption)
        sections = [
            section("errors", "Prediction errors", errors.title, [drawn], [errors.part()]),
            section("bands", "Predicted bands", result["bands"], tables=[inside.part()]),
        ]
        subtitle = f"{result['samples']} runs on {', '.join(log.name for log in self.logs)}"
        return self.rendered(f"Prediction of {result['vehicle']}", subtitle, sections, provenance(self.logs, command))


def score(
    logs: Logs,
    *,
    vehicle: OfVehicle = None,
    horizons: Horizons = HORIZONS,
    rate: OwnRate = None,
    closed_loop: Annotated[bool, typer.Option("--closed-loop")] = False,
) -> Scored:
    """Open-loop prediction error after h samples: every sample starts one run from the measured state.

    Args:
        logs: a log or several, as paths or from `load`.
        vehicle: whose values are scored as they are; default that of the first loaded log.
        horizons: samples of the grid after the start of each run, or times, as ``0.1s``.
        rate: of the grid [Hz]; None for each log's own, whatever it was loaded with.
        closed_loop: predict bands with the autopilot in the loop, as the vehicle file or the logs describe it.

    Raises:
        LogError: a log that does not fit the vehicle.
        ParameterError: horizons that are no positive numbers, or times on logs of several rates.
    """
    from quadid.identification.predict import QUANTITIES, horizon_scores, no_change, prediction_floor
    from quadid.identification.result import score_result

    given = settled(logs, (), vehicle)
    described, opened = given.vehicle, [log.at(rate) for log in given.train]
    theta = Layout(described).initial(described)
    windows = [w for log in opened for w in log.windows]
    steps = ahead(horizons, windows)
    pooled, each = horizon_scores([log.windows for log in opened], described, theta, steps)
    files = [(log.recording.name, log.grid.gaps, one) for log, one in zip(opened, each, strict=True)]
    result = score_result(described.name, pooled, files)
    wanted = [int(h) for h in result["horizons"]]
    result["noise_floor"] = {str(h): prediction_floor(windows, h) for h in wanted}
    result["no_change"] = {str(h): no_change(windows, described, h) for h in wanted}
    result["units"] = dict(QUANTITIES)
    result["coverage"], result["bands"] = coverage(opened, described, theta, wanted, closed_loop)
    result["verdict"] = score_verdict(result).level
    seen = [
        f"{log.name}: the vehicle file was fitted to this flight, so these errors are no proof"
        for log in opened
        if fitted_before(described, log)
    ]
    notes = (*seen, *unmet(opened, result), *(text for log in opened for text in log.warnings))
    return Scored(result, notes, tuple(opened))


def unmet(logs: Sequence[Log], result: Json) -> list[str]:
    """Says where logs measure a quantity so seldom that no run of these horizons begins and ends at a reading."""
    out = []
    for name in ("position", "velocity"):
        slow = [log.recording.channels[name] for log in logs if any(getattr(w, name) is not None for w in log.windows)]
        if slow and all(math.isnan(errors[name]) for errors in result["horizons"].values()):
            rate = 1.0 / max(sample_period(channel.t) for channel in slow)
            told = f"{name} is measured at {rate:.3g} Hz: no run of these horizons begins and ends at a reading"
            out.append(f"{told}; --rate {rate:.3g} compares it")
    return out


def ahead(horizons: str | Sequence[int | str], windows: Sequence[Window]) -> list[int]:
    """Samples of the grid that horizons stand for, as ``1,10,0.5s`` or one by one; raises as `samples`."""
    return [samples(h, windows) for h in (horizons.split(",") if isinstance(horizons, str) else horizons)]


def samples(horizon: int | str, windows: Sequence[Window]) -> int:
    """Samples of the grid that a horizon stands for: a number of them, or a time as ``0.1s``.

    Raises:
        ParameterError: neither, or a time on grids of several rates.
    """
    if not isinstance(horizon, str):
        return horizon
    text = horizon.strip()
    try:
        if not text.endswith("s"):
            return int(text)
        seconds = float(text[:-1])
        if not 0.0 < seconds < math.inf:
            raise ValueError(text)
    except ValueError as error:
        raise ParameterError(
            f"--horizons {text}", "whole numbers of samples, or times in seconds", "for example --horizons 1,10,0.5s"
        ) from error
    steps = {round(w.dt, 9) for w in windows}
    if len(steps) > 1:
        rates = ", ".join(f"{1.0 / step:.4g}" for step in sorted(steps))
        raise ParameterError(f"--horizons {text} on logs of {rates} Hz", "one rate", "give --rate, or samples")
    return max(round(seconds / windows[0].dt), 1)


def coverage(
    logs: Sequence[Log], vehicle: Vehicle, theta: FloatArray, wanted: Sequence[int], closed_loop: bool
) -> tuple[dict[str, dict[str, dict[str, float] | None] | None], str]:
    """Shares of outcomes inside the predicted bands by horizon and quantity, and what the bands rest on.

    Args:
        theta: its full parameter vector.
        wanted: samples ahead.
        closed_loop: simulate with the autopilot in the loop instead of taking the logged rotor speeds.
    """
    from quadid.identification.controller_gains import find_autopilot
    from quadid.identification.predict import BANDS, Forecast

    total: dict[int, dict[str, FloatArray]] = {}
    reasons = []
    autopilot = find_autopilot([w for log in logs for w in log.windows], vehicle) if closed_loop else None
    for log in logs:
        windows, _ = beginning(log.windows, min(SECONDS, ROWS * log.windows[0].dt))
        near = [h for h in wanted if autopilot is not None or h * windows[0].dt <= OPEN + 1e-9]
        if not near:
            continue
        try:
            forecast = Forecast(windows, vehicle, theta, vehicle.random)
        except NotIdentifiableError as error:
            reasons.append(f"{log.name}: none, {error}")
            continue
        found = forecast.covered(near) if autopilot is None else forecast.covered_in_loop(near, autopilot)
        for h, by_quantity in found.items():
            sums = total.setdefault(h, {})
            for name, counts in by_quantity.items():
                sums[name] = sums.get(name, 0.0) + counts
    out: dict[str, dict[str, dict[str, float] | None] | None] = {}
    for h in wanted:
        out[str(h)] = (
            None
            if h not in total
            else {
                name: dict(zip(BANDS, (c[:-1] / c[-1]).tolist(), strict=True)) if c[-1] else None
                for name, c in total[h].items()
            }
        )
    source = "of the vehicle file" if vehicle.random is not None else "found in the first third of each log"
    told = [f"Bands: random forces {source}; sensor noise, trim and biases from the first third of each log"]
    if autopilot is not None:
        told.append(f"autopilot in the loop, its gains {autopilot.source}")
    elif closed_loop:
        told.append("no autopilot is known: neither gains in the vehicle file nor references that show them in the log")
    if any(h not in total for h in wanted):
        told.append(f"none beyond {OPEN:g} s from logged rotor speeds, which already contain the controller's answer")
    return out, f"{'; '.join([*told, *reasons])}."


def horizon_table(result: Json) -> TextTable:
    """Open-loop prediction errors, pooled and for each file.

    Args:
        result: of the form ``quadid.score/1``.
    """
    many = len(result["files"]) > 1
    columns = (
        Column("log"),
        Column("after", right=True),
        *(
            Column(f"{name} [{unit}]", right=True, rank=max(2 - i, 0))
            for i, (name, unit) in enumerate(result["units"].items())
        ),
    )
    rows = []
    for entry in [*(result["files"] if many else []), result]:
        label = entry.get("log", "all" if many else result["files"][0]["log"])
        for horizon, errors in entry["horizons"].items():
            rows.append((label, str(horizon), *(_error(errors[n]) for n in result["units"])))
            label = ""
        total = entry["sum"]
        rows.append(("", f"sum 1..{total['to']}", *(_error(total[n]) for n in result["units"])))
    last = list(result["horizons"])[-1]
    for label, key in (("noise floor", "noise_floor"), ("no change predicted", "no_change")):
        rows.append((label, last, *(number(result[key][last][n]) for n in result["units"])))
    title = f"Open-loop prediction error of '{result['vehicle']}' after n samples, mean of {result['samples']} runs"
    return TextTable(title, columns, tuple(rows))


def coverage_table(result: Json) -> TextTable:
    """Shares of outcomes inside the predicted bands of 50, 80 and 95 %.

    Args:
        result: of the form ``quadid.score/1``.
    """
    bands = ("50", "80", "95")
    columns = (Column("after", right=True), Column("of"), *(Column(f"{band} % band", right=True) for band in bands))
    rows = []
    for horizon, quantities in result["coverage"].items():
        for name, shares in (quantities or {"": None}).items():
            told = ["–"] * len(bands) if shares is None else [f"{100.0 * shares[band]:.0f} %" for band in bands]
            rows.append((horizon, name, *told))
    return TextTable("Outcomes inside the predicted bands, n samples after a filtered state", columns, tuple(rows))


def _error(value: float | None) -> str:
    return "ran away" if value == math.inf else number(value)
