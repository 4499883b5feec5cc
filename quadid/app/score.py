"""Open-loop prediction error of a vehicle on logs, and of two vehicles beside each other."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np
import typer

from quadid.app.logs import Given, Log, fitted_before, listed, read, settled
from quadid.app.missing import ROWS, SECONDS
from quadid.app.options import Described, Horizons, Logs, OfVehicle, OwnRate, Seed, Typed
from quadid.app.outcome import LIBRARY, Reported, provenance, with_ends
from quadid.chi_square import Z95
from quadid.data.window import Window, beginning, sample_period
from quadid.errors import LogError, NotIdentifiableError, ParameterError
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_UNITS
from quadid.report.page import axis, band, figure, level, section, stacked, trace
from quadid.report.tables import Cell, Column, TextTable, heads, number
from quadid.report.verdict import Verdict, percent, score_verdict
from quadid.types import FloatArray, Json, JsonDict
from quadid.vehicle import Vehicle

HORIZONS = (1, 10, 50)
OPEN = 0.1
"""Longest horizon with bands [s] while rotor speeds are those of the log: what was flown in closed loop answers the
disturbances to come."""

Coverage = dict[str, dict[str, dict[str, float] | None] | None]
"""Shares of outcomes inside each band by horizon and quantity; None where none is predicted."""


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
        result, units = self.result, self.result["units"]
        many, last = len(result["files"]) > 1, list(result["horizons"])[-1]
        rows = []
        for entry in [*(result["files"] if many else []), result]:
            label = entry.get("log", "all" if many else result["files"][0]["log"])
            total = f"sum 1..{entry['sum']['to']}"
            for after, errors in {**entry["horizons"], total: entry["sum"]}.items():
                values = ("ran away" if errors[n] == math.inf else number(errors[n]) for n in units)
                rows.append((label, after, *values))
                label = ""
        for label, key in (("noise floor", "noise_floor"), ("no change predicted", "no_change")):
            rows.append((label, last, *(number(result[key][last][n]) for n in units)))
        title = f"Open-loop prediction error of '{result['vehicle']}' after n samples, mean of {result['samples']} runs"
        ranked = zip(units.items(), (2, 1, 0, 0), strict=True)
        quantities = (Column(f"{name} [{unit}]", right=True, rank=rank) for (name, unit), rank in ranked)
        errors = TextTable(title, (*heads("log | after >"), *quantities), tuple(rows))
        inside = []
        for after, known in result["coverage"].items():
            for name, shares in (known or {"": None}).items():
                told = ["–"] * 3 if shares is None else [f"{100.0 * shares[b]:.0f} %" for b in ("50", "80", "95")]
                inside.append((after, name, *told))
        columns = heads("after > | of | 50 % band > | 80 % band > | 95 % band >")
        title = "Outcomes inside the predicted bands, n samples after a filtered state"
        return [errors, TextTable(title, columns, tuple(inside))]

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
        after, units = result["horizons"], result["units"]
        x = np.array([int(h) for h in after], dtype=np.float64)
        known = [n for n in units if not all(math.isnan(errors[n]) for errors in after.values())]
        places, layout = stacked([(f"{n} [{units[n]}]", {"type": "log"}) for n in known], "samples ahead")
        lines = (
            ("before", "no change predicted", result["no_change"]),
            ("floor", "noise floor", result["noise_floor"]),
            ("after", "error", after),
        )
        bands, data = list[JsonDict](), list[JsonDict]()
        for i, (name, where) in enumerate(zip(known, places, strict=True)):
            low, high = np.array([result["spread"][h][name] for h in after], dtype=np.float64).T
            bands += band("after", "of the runs", x, low, high, **where)
            for role, label, of in lines:
                y = np.array([of[h][name] for h in after], dtype=np.float64)
                style = {"mode": "lines+markers", "showlegend": i == 0, "legendgroup": role}
                data.append(trace(role, label, x, y, **style, **where))
        caption = (
            f"mean error from the measured state on, and the band in which {100 * SHARE:.0f} % of the runs lie; at "
            "the noise floor an error is no larger than the sensors' own"
        )
        height = 130 * len(known) + 70
        drawn = figure("horizons", "Error over the horizon", bands + data, layout, height, caption=caption)
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
    # A quantity measured so seldom that no run of these horizons begins and ends at a reading.
    for name in ("position", "velocity"):
        having = [log for log in opened if any(getattr(w, name) is not None for w in log.windows)]
        if having and all(math.isnan(errors[name]) for errors in result["horizons"].values()):
            hz = 1.0 / max(sample_period(log.recording.channels[name].t) for log in having)
            told = f"{name} is measured at {hz:.3g} Hz: no run of these horizons begins and ends at a reading"
            seen.append(f"{told}; --rate {hz:.3g} compares it")
    return Scored(result, (*seen, *(text for log in opened for text in log.warnings)), tuple(opened))


def ahead(horizons: str | Sequence[int | str], windows: Sequence[Window]) -> list[int]:
    """Samples of the grid that horizons stand for: numbers of them, or times as ``0.1s``, one by one or with commas.

    Raises:
        ParameterError: neither, or a time on grids of several rates.
    """
    out, steps = list[int](), {round(w.dt, 9) for w in windows}
    for horizon in horizons.split(",") if isinstance(horizons, str) else horizons:
        if not isinstance(horizon, str):
            out.append(horizon)
            continue
        text, timed = horizon.strip(), horizon.strip().endswith("s")
        try:
            value = float(text[:-1]) if timed else int(text)
            if timed and not 0.0 < value < math.inf:
                raise ValueError(text)
        except ValueError as error:
            allowed = "whole numbers of samples, or times in seconds"
            raise ParameterError(f"--horizons {text}", allowed, "for example --horizons 1,10,0.5s") from error
        if timed and len(steps) > 1:
            rates = ", ".join(f"{1.0 / step:.4g}" for step in sorted(steps))
            raise ParameterError(f"--horizons {text} on logs of {rates} Hz", "one rate", "give --rate, or samples")
        out.append(max(round(value / windows[0].dt), 1) if timed else int(value))
    return out


def coverage(
    logs: Sequence[Log], vehicle: Vehicle, theta: FloatArray, wanted: Sequence[int], closed_loop: bool
) -> tuple[Coverage, str]:
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
    out: Coverage = dict.fromkeys(map(str, wanted))
    for h, sums in total.items():
        shares = {name: (c[:-1] / c[-1]).tolist() if c[-1] else None for name, c in sums.items()}
        out[str(h)] = {name: found and dict(zip(BANDS, found, strict=True)) for name, found in shares.items()}
    source = "of the vehicle file" if vehicle.random is not None else "found in the first third of each log"
    told = [f"Bands: random forces {source}; sensor noise, trim and biases from the first third of each log"]
    if autopilot is not None:
        told.append(f"autopilot in the loop, its gains {autopilot.source}")
    elif closed_loop:
        told.append("no autopilot is known: neither gains in the vehicle file nor references that show them in the log")
    if any(h not in total for h in wanted):
        told.append(f"none beyond {OPEN:g} s from logged rotor speeds, which already contain the controller's answer")
    return out, f"{'; '.join([*told, *reasons])}."


# --- Two vehicle files on the same flights: which predicts better, by how much, and how they differ


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
            {"name": f"{name}.{h}", "after": int(h), "quantity": name, **with_ends(e)}
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
                y = np.array(values, dtype=np.float64)
                if np.isfinite(y).any():
                    more = {"line": {"dash": "dot"}, "showlegend": False} if edge else {"mode": "lines+markers"}
                    data.append(trace(role, name + edge, after, y, **more))
        ratio = axis("error of B over that of A")
        layout = {"xaxis": axis("samples after the start"), "yaxis": ratio, "shapes": [level(1.0)]}
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
    # Mean errors of both, (2, horizons, 4), and of drawn blocks, (draws, 2, horizons, 4).
    known = [~np.isnan(block).any(axis=0) for block in blocks]
    sums = np.array([np.where(k, block, 0.0).sum(axis=1) for block, k in zip(blocks, known, strict=True)])
    counts = np.array([k.sum(axis=0) for k in known], dtype=np.float64)
    picked = np.random.default_rng(seed).multinomial(len(blocks), np.full(len(blocks), 1.0 / len(blocks)), DRAWS)
    with np.errstate(invalid="ignore", divide="ignore"):
        total = np.asarray(sums.sum(axis=0) / counts.sum(axis=0))
        drawn = np.asarray(np.tensordot(picked, sums, 1) / np.tensordot(picked, counts, 1)[:, None])
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
        # Numbers of the effects of either; None where one has none.
        "effects": [
            {"effect": e, "name": k, **{x: v.effects.get(e, {}).get(k) for x, v in zip("ab", pair, strict=True)}}
            for e, k in dict.fromkeys((e, k) for v in pair for e, numbers in v.effects.items() for k in numbers)
        ],
        "warnings": [*dict.fromkeys([*warnings, *(text for log in opened[0] for text in log.warnings)])],
    }
    return Compared(result, tuple(opened[0]))


def _entry(mean: FloatArray, drawn: FloatArray) -> Json:
    """Errors of both, the ratio of B's to A's, and its interval; None for what the logs lack."""
    a, b = (None if math.isnan(m) else m for m in mean.tolist())
    if a is None or b is None or not (math.isfinite(a) and math.isfinite(b) and a > 0.0):
        return {"a": a, "b": b, "ratio": None, "ci95": [None, None]}
    return {"a": a, "b": b, "ratio": b / a, "ci95": np.nanquantile(drawn[:, 1] / drawn[:, 0], [0.025, 0.975]).tolist()}


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
        entry: JsonDict = {"name": name, "unit": unit}
        for side, vehicle in (("a", a), ("b", b)):
            value, sigma = vehicle.parameters[name].initial, vehicle.parameters[name].sigma
            ends = None if sigma is None else [value - Z95 * sigma, value + Z95 * sigma]
            entry |= {side: value, f"{side}_ci95": ends}
        sigmas = [v.parameters[name].sigma for v in (a, b)]
        apart = (entry["b"] - entry["a"]) / math.hypot(*(s or 0.0 for s in sigmas)) if all(sigmas) else None
        out.append({**entry, "apart": apart})
    return out
