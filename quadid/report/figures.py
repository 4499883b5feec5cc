"""Figures of results as plain descriptions without colours."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy.signal import welch

from quadid.chi_square import Z95, exceeded
from quadid.data.window import CHANNEL_NAMES, CHANNEL_UNITS
from quadid.errors import ParameterError
from quadid.estimate.missing import Missing
from quadid.identification.result import SCORE_SECONDS, ScoredSet, SetScore
from quadid.report.page import axis, band, figure, listed, stacked, trace, upright
from quadid.types import FloatArray, IndexArray, JsonDict

# --- Figures of results: channels over time, errors, parameters, gains; see `quadid.report.page` for their form


GROUPS: dict[str, tuple[str, tuple[int, ...]]] = {
    "rates": ("Body rates", (0, 1, 2)),
    "attitude": ("Attitude", (3, 4, 5)),
    "accel": ("Specific force", (6, 7, 8)),
    "velocity": ("Velocity", (9, 10, 11)),
    "position": ("Position", (12, 13, 14)),
}
PARAMETERS = ("current parameters", "proposed parameters")
MODELS = ("model without the findings", "model with the findings")
LABELS = {"phi": "φ", "theta": "θ", "psi": "ψ"}
DECADES = 30.0
"""Ratio of bars from which they are drawn on a logarithmic axis."""
WHOLE_POINTS = 800
"""Points a trace over a whole log keeps at most."""
DETAIL_POINTS = 600
DETAIL_SECONDS = 12.0
SPECTRUM_ROWS = 200
"""Samples of a stretch whose spectra are averaged, at most."""
VISIBLE = 0.01
"""Share of weight and of rotor moment that a picture of what is missing shows at least."""
MOST_LOGS = 4
"""Logs that get pictures; the others are in the tables."""
BUDGET = 90_000
"""Numbers that all pictures of channels may take together, so that a page stays below 6 MB."""


def channel_figures(
    scored: ScoredSet, prefix: str, logs: int = 1, labels: tuple[str, str] = PARAMETERS
) -> list[JsonDict]:
    """Measured and simulated outputs of one log, one figure a group of channels: the whole log and its liveliest part.

    Args:
        prefix: makes the figures' identifiers unique.
        logs: number of logs that share the page.
        labels: what the two simulations are called.
    """
    series = scored.fitted.series
    share = min(
        1.0, BUDGET / (3 * series.measured.shape[1] * logs * (WHOLE_POINTS + 2 * DETAIL_POINTS + SPECTRUM_ROWS))
    )
    whole = thinned(series.measured, int(share * WHOLE_POINTS))
    detail = liveliest(series.t, series.measured, int(share * DETAIL_POINTS))
    out = []
    for key, (title, channels) in GROUPS.items():
        here = [c for c in channels if c < series.measured.shape[1] and np.isfinite(series.measured[:, c]).any()]
        if here:
            views = [
                {"label": "Most excited part, every sample", **_stack(scored, detail, here, labels)},
                {"label": "Whole log", **_stack(scored, whole, here, labels)},
            ]
            shown = views if len(whole) > len(detail) else views[1:]
            residual = {"label": "Residual, every sample", **_stack(scored, detail, here, labels, residual=True)}
            shown = [*shown, residual, _spectra(scored, here, labels)]
            out.append({"id": f"{prefix}-{key}", "title": title, "views": shown, "height": 130 * len(here) + 70})
    return out


def _label(channel: int) -> str:
    """Name of an output for people."""
    return LABELS.get(CHANNEL_NAMES[channel], CHANNEL_NAMES[channel])


def _stack(
    scored: ScoredSet, rows: IndexArray, channels: Sequence[int], labels: tuple[str, str], residual: bool = False
) -> JsonDict:
    """Channels above each other with one time axis; with `residual`: measured less simulated."""
    after, before = scored.fitted.series, scored.initial.series
    t = after.t[rows] - after.t[0]
    drawn = []
    for c in channels:
        measured = after.measured[rows, c]
        lines = [("before", labels[0], before.simulated[rows, c]), ("after", labels[1], after.simulated[rows, c])]
        if residual:
            lines = [(role, label, measured - y) for role, label, y in lines]
        else:
            lines.insert(0, ("measured", "measured", measured))
        drawn.append((lines, _focus(lines[-1][2] if residual else measured)))
    panels = [
        (f"{_label(c)} [{CHANNEL_UNITS[c]}]", {"range": list(limits)})
        for c, (_, limits) in zip(channels, drawn, strict=True)
    ]
    places, layout = stacked(panels, "time [s]")
    data = []
    for i, (where, (lines, (low, high))) in enumerate(zip(places, drawn, strict=True)):
        for role, label, y in lines:
            # A poor first guess may run far away; what leaves the picture need not be kept.
            inside = np.clip(y, low - 3.0 * (high - low), high + 3.0 * (high - low))
            data.append(trace(role, label, None, inside, legendgroup=role, showlegend=i == 0, **where))
    return {"x": listed(t), "data": data, "layout": layout}


def _spectra(scored: ScoredSet, channels: Sequence[int], labels: tuple[str, str]) -> JsonDict:
    """Amplitude spectra of the residuals (Welch); the band holds those of white noise of the same size.

    The simulation starts anew every `SCORE_SECONDS`, so slower errors than that do not show.
    """
    after, before = scored.fitted.series, scored.initial.series
    step = float(np.median(np.diff(after.t)))
    rows = min(max(round(2.0 * SCORE_SECONDS / step), 8), SPECTRUM_ROWS, len(after.t))
    parts = len(after.t) // rows
    low, high = (math.sqrt(exceeded(p, 2 * parts) / (2 * parts)) for p in (0.975, 0.025))
    panels = [(f"{_label(c)} [{CHANNEL_UNITS[c]}/√Hz]", {"type": "log"}) for c in channels]
    places, layout = stacked(panels, "frequency [Hz]")
    data = []
    for i, (c, where) in enumerate(zip(channels, places, strict=True)):
        residuals = np.nan_to_num([after.measured[:, c] - s.simulated[:, c] for s in (before, after)])
        f, power = welch(residuals, 1.0 / step, nperseg=rows, noverlap=0)
        f, (then, now) = f[1:], np.sqrt(power[:, 1:])
        white = np.full(len(f), np.sqrt(power[1, 1:].mean()))
        data += [
            *band("floor", "white noise", f, low * white, high * white, **where),
            trace("before", labels[0], f, then, legendgroup="before", showlegend=i == 0, **where),
            trace("after", labels[1], f, now, legendgroup="after", showlegend=i == 0, **where),
        ]
    return {"label": "Spectrum of the residual", "data": data, "layout": layout}


def missing_figures(parts: Mapping[str, Sequence[Missing]], prefix: str) -> list[JsonDict]:
    """Force [N] and moment [N m] that each model misses on one log, over time with 95 % bands, body axes.

    An axis shows `VISIBLE` of the weight, or of the rms rotor moment, at least: what is missing by less looks like it.

    Args:
        parts: stretches of the log by model, the nominal one first.
        prefix: makes the figures' identifiers unique.
    """
    roles = ("before", "after") if len(parts) > 1 else ("after",)
    labels = MODELS if len(parts) > 1 else ("missing in the simulation",)
    first = next(iter(parts.values()))
    control = np.concatenate([p.control for p in first]).std(axis=0)
    out = []
    for key, sign, of in (("force", "F", np.full(3, first[0].weight)), ("moment", "M", control)):
        drawn = []
        for role, label, stretches in zip(roles, labels, parts.values(), strict=True):
            t, value, sigma = (_joined([getattr(p, n) for p in stretches]) for n in ("t", key, f"{key}_sigma"))
            rows = np.unique(np.linspace(0, len(t) - 1, WHOLE_POINTS // 2).astype(int))
            drawn.append((role, label, t[rows], value[rows], Z95 * sigma[rows]))
        reach = np.max([np.nanmax(np.abs(value) + width, axis=0) for *_, value, width in drawn], axis=0)
        reach = np.maximum(reach.max() if key == "force" else reach, VISIBLE * of)
        unit = "N" if key == "force" else "N m"
        panels = [(f"{sign}{a} [{unit}]", {"range": [-reach[i], reach[i]]}) for i, a in enumerate("xyz")]
        places, layout = stacked(panels, "time [s]")
        data = []
        for i, where in enumerate(places):
            for role, label, t, value, width in drawn:
                y, half, group = value[:, i], width[:, i], {"legendgroup": role, **where}
                data += band(role, label, t, y - half, y + half, **group)
                data.append(trace(role, label, t, y, solid=True, showlegend=i == 0, **group))
        out.append(figure(f"{prefix}-{key}", f"Missing {key}", data, layout, 460))
    return out


def _joined(stretches: Sequence[FloatArray]) -> FloatArray:
    """Stretches of a log as one array, with a hole (not a number) between them, so that no line bridges a gap."""
    first, *others = stretches
    hole = np.full((1, *first.shape[1:]), np.nan)
    return np.concatenate([first, *(part for other in others for part in (hole, other))])


def _focus(measured: FloatArray) -> tuple[float, float]:
    """Axis limits that show the measurement."""
    good = measured[np.isfinite(measured)]
    if len(good) == 0:
        return -1.0, 1.0
    low, high = float(good.min()), float(good.max())
    margin = 0.15 * max(high - low, 1e-3)
    return low - margin, high + margin


def thinned(values: FloatArray, points: int) -> IndexArray:
    """Rows that keep the peaks: of each bin the rows where the liveliest channel is smallest and largest."""
    n = len(values)
    if n <= points:
        return np.arange(n)
    loud = values[:, int(np.argmax(np.nan_to_num(values[:, :3]).std(axis=0)))]
    edges = np.linspace(0, n, points // 2 + 1).astype(np.intp)
    filled = np.nan_to_num(loud)
    keep = [
        i + np.array([filled[i:j].argmin(), filled[i:j].argmax()]) for i, j in zip(edges[:-1], edges[1:], strict=True)
    ]
    return np.unique(np.concatenate(keep))


def liveliest(t: FloatArray, values: FloatArray, points: int = DETAIL_POINTS) -> IndexArray:
    """Rows of the `DETAIL_SECONDS`, or as many as `points` last, with the most rotation."""
    n = len(t)
    step = float(np.median(np.diff(t))) if n > 1 else 1.0
    width = min(n, points, max(int(DETAIL_SECONDS / step), 2))
    energy = np.concatenate([[0.0], np.cumsum(np.nan_to_num(np.sum(values[:, :3] ** 2, axis=1)))])
    first = int(np.argmax(energy[width:] - energy[:-width])) if n > width else 0
    return np.arange(first, first + width)


def error_figure(scored: ScoredSet, identifier: str, labels: tuple[str, str] = PARAMETERS) -> JsonDict:
    """Error over time: mean squared residual of each second over that of a perfect model, before and after."""
    zero = float(scored.fitted.series.t[0])
    data = []
    for role, name, score in (("before", labels[0], scored.initial), ("after", labels[1], scored.fitted)):
        t, ratio = error_over_time(score, scored.fitted)
        data.append(trace(role, name, t - zero, ratio))
    ends = scored.fitted.series.t[[0, -1]] - zero
    data.append(trace("floor", "sensor noise alone", ends, np.ones(2)))
    layout = {"xaxis": axis("time [s]"), "yaxis": axis("squared error / noise", type="log", dtick=1)}
    return figure(identifier, "Error over the flight", data, layout, 240)


def error_over_time(score: SetScore, fitted: SetScore) -> tuple[FloatArray, FloatArray]:
    """Time [s] and squared error over that of a perfect model, one value for about a second.

    Args:
        score: whose residuals.
        fitted: gives the size of those of a perfect model.
    """
    perfect = np.array([c.rmse / np.sqrt(c.mse) if c.samples and c.mse > 0.0 else np.nan for c in fitted.channels])
    series = score.series
    squares = ((series.simulated - series.measured) / perfect) ** 2
    step = float(np.median(np.diff(series.t)))
    width = max(round(1.0 / step), len(series.t) // WHOLE_POINTS, 1)
    bins = np.arange(0, len(series.t) - width + 1, width)
    mean = [np.nanmean(part) if np.isfinite(part).any() else np.nan for part in (squares[i : i + width] for i in bins)]
    return series.t[bins] + 0.5 * width * step, np.array(mean)


def parameter_figure(parameters: Sequence[Mapping[str, Any]], truth: Mapping[str, float] | None = None) -> JsonDict:
    """Proposed over current value with its interval, one row a parameter; and the truth of a simulation."""
    shown = [p for p in parameters if p["initial"] and np.isfinite(p["initial"])][::-1]
    names = [p["name"] for p in shown]
    scale = np.array([p["initial"] for p in shown])
    value = np.array([p["value"] for p in shown]) / scale
    interval = (
        np.array([[np.nan if v is None else v for v in p["ci95"]] for p in shown]).reshape(-1, 2) / scale[:, None]
    )
    upper, lower = listed(interval[:, 1] - value), listed(value - interval[:, 0])
    bars = {"type": "data", "symmetric": False, "array": upper, "arrayminus": lower}
    common = {"y": names, "mode": "markers", "type": "scatter"}
    data: list[JsonDict] = [
        {"role": "before", "name": "current", "x": [1.0] * len(names), **common},
        {"role": "after", "name": "proposed, 95 % interval", "x": listed(value), "error_x": bars, **common},
    ]
    if truth:
        known = np.array([truth.get(n, np.nan) for n in names]) / scale
        data.append({"role": "truth", "name": "truth", "x": listed(known), **common})
    layout = {"xaxis": axis("value / current value"), "yaxis": {"type": "category"}}
    return figure("parameters", "Proposed against current", data, layout, 120 + 38 * len(names))


def gain_figure(finding: Mapping[str, Any], floor: float, identifier: str) -> JsonDict:
    """Error on unseen data with the finding, with each alternative in its place, and without either.

    Args:
        finding: of the form ``quadid.diagnose/1``.
        floor: noise floor in the same measure.
    """
    title = finding["effect"].replace("_", " ")
    rows = [("without it", finding["gain"]["mse_before"], "before"), (title, finding["gain"]["mse_after"], "after")]
    rows += [(a["effect"].replace("_", " "), a["mse_after"], "measured") for a in finding["alternatives"]]
    data = [
        {"role": role, "name": name, "type": "bar", "orientation": "h", "x": [value], "y": [name], "showlegend": False}
        for name, value, role in rows[::-1]
    ]
    sizes = [v for _, v, _ in rows if v is not None and math.isfinite(v) and v > 0.0] or [floor]
    lowest, highest = min(*sizes, floor), 1.05 * max(sizes)
    # Bars that differ much are drawn in decades, else the short ones would not be seen.
    decades = {"type": "log", "range": [math.log10(0.5 * lowest), math.log10(highest)]}
    scale = decades if highest > DECADES * lowest else {"range": [0.0, highest]}
    layout = {
        "xaxis": axis(f"error, {finding['gain']['seconds']:g} s runs (noise = 1)", **scale),
        "yaxis": {"type": "category"},
        "hovermode": "closest",
        "shapes": [upright(floor)],
    }
    return figure(identifier, "Validation error with and without it", data, layout, 90 + 32 * len(rows))


# --- The report's descriptions of figures as plotly figures, for notebooks


COLOURS = {"measured": "#555555", "before": "#c2762b", "after": "#1f6fb2"}
"""Of every role on a light page."""


def channel_plot(scored: ScoredSet, group: str = "rates", labels: tuple[str, str] = PARAMETERS) -> Any:
    """Measured and simulated outputs of one log as a ``plotly.graph_objects.Figure``.

    Args:
        group: one of `figures.GROUPS`.
        labels: what the two simulations are called.

    Raises:
        ParameterError: no such group in this log.
    """
    import plotly.graph_objects as go

    found = {f["id"].removeprefix("plot-"): f for f in channel_figures(scored, "plot", labels=labels)}
    if group not in found:
        raise ParameterError(f"no group '{group}' in {scored.log}", ", ".join(n for n in GROUPS if n in found))
    view = found[group]["views"][0]
    lines = [
        {**{k: v for k, v in line.items() if k != "role"}, "x": view["x"], "line": {"color": COLOURS[line["role"]]}}
        for line in view["data"]
    ]
    figure = go.Figure(lines, view["layout"])
    return figure.update_layout(title=f"{found[group]['title']}, {scored.log}", height=found[group]["height"])
