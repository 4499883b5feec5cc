"""Figures of results, and of causes in the residual, as plain descriptions without colours."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from scipy.signal import welch

from quadid.chi_square import Z95, exceeded
from quadid.data.window import CHANNEL_NAMES, CHANNEL_UNITS, Window, beginning
from quadid.effects import EFFECTS, NEVER
from quadid.errors import ParameterError
from quadid.estimate.missing import Missing
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Linearised, Shooting
from quadid.identification.result import SCORE_SECONDS, ScoredSet, SetScore, covering, settle_states
from quadid.model.layout import Layout
from quadid.report.page import axis, band, figure, level, listed, stacked, trace, upright
from quadid.rotation import conjugate, rotated
from quadid.types import BoolArray, FloatArray, IndexArray, JsonDict
from quadid.vehicle import GRAVITY, Vehicle

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
LABELS = [{"phi": "φ", "theta": "θ", "psi": "ψ"}.get(name, name) for name in CHANNEL_NAMES]
"""Names of the outputs for people."""
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
                {"label": "Residual, every sample", **_stack(scored, detail, here, labels, residual=True)},
                _spectra(scored, here, labels),
            ][len(whole) <= len(detail) :]
            out.append({"id": f"{prefix}-{key}", "title": title, "views": views, "height": 130 * len(here) + 70})
    return out


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
        # Axis limits that show the measurement.
        good = lines[-1][2] if residual else measured
        good = good[np.isfinite(good)]
        low, high = (float(good.min()), float(good.max())) if len(good) else (-1.0, 1.0)
        margin = 0.15 * max(high - low, 1e-3)
        drawn.append((lines, (low - margin, high + margin)))
    panels = [
        (f"{LABELS[c]} [{CHANNEL_UNITS[c]}]", {"range": list(limits)})
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
    panels = [(f"{LABELS[c]} [{CHANNEL_UNITS[c]}/√Hz]", {"type": "log"}) for c in channels]
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
    interval = np.array([p["ci95"] for p in shown], dtype=np.float64).reshape(-1, 2) / scale[:, None]
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


# --- Picture of a cause in the residual: binned against the quantity it depends on, with the cause and without
#
# A cause leaves a shape: a lag an error in step with the angular acceleration, drag one in step with speed, a failing
# battery one in step with time.  Every effect lists the few pairs of channel and quantity where its equation puts it;
# the pair where switching it off shows most is drawn.  Flat at zero is what a complete model leaves.


Mode = Literal["value", "slope"]

BINS = 24
SLOPE_SECONDS = 0.1
"""Span over which a residual's rate of change is taken [s]."""
MOST_SECONDS = 300.0
"""Flight that a map is made of, at most [s]."""
_VELOCITY = slice(7, 10)


def _pair(text: str) -> tuple[Mode, int, str]:
    """Kind of residual, its channel, and what it is drawn against, from the table's words."""
    channel, against = text.split(": ")
    return ("slope" if channel.endswith("'") else "value"), CHANNEL_NAMES.index(channel.rstrip("'")), against


PAIRS = {e.name: tuple(_pair(text) for text in e.shows) for e in EFFECTS.values()}
"""Place at which each effect shows: how the residual is taken, its channel, and the quantity it is drawn against."""
_NAMES = {
    "time": ("time", "s"), "p": ("roll rate", "rad/s"), "q": ("pitch rate", "rad/s"), "r": ("yaw rate", "rad/s"),
    "p_dot": ("roll acceleration", "rad/s^2"), "q_dot": ("pitch acceleration", "rad/s^2"),
    "r_dot": ("yaw acceleration", "rad/s^2"), "v_x": ("forward speed", "m/s"), "v_y": ("speed to the right", "m/s"),
    "v_z": ("downward speed", "m/s"), "thrust": ("thrust over its mean", ""), "heading": ("heading", "rad"),
    "thrust_rate": ("rate of change of thrust over its mean", "1/s"), "rotor_speed": ("mean rotor speed", "rad/s"),
    "spin_rate": ("rate of change of the summed rotor speed", "rad/s^2"), "height": ("height", "m"),
    "v_n": ("logged velocity north", "m/s"), "v_e": ("logged velocity east", "m/s"),
    "v_d": ("logged velocity down", "m/s"),
}  # fmt: skip


@dataclass(frozen=True)
class ResidualMap:
    """Mean residual (measured less simulated) in bins of a quantity.

    Attributes:
        channel, unit: what is off.
        against, against_unit: what it is drawn against.
        x: middle of the bins, shape (bins,).
        before, after: mean residual without and with the cause, shape (bins,).
        before_error, after_error: 95 % half-widths from the spread between stretches of 1 s.
        seen: mean square of the bins without the cause less that with it, in variances of a sample with it.
    """

    channel: str
    unit: str
    against: str
    against_unit: str
    x: FloatArray
    before: FloatArray
    after: FloatArray
    before_error: FloatArray
    after_error: FloatArray
    seen: float


def residual_map(
    windows: Sequence[Window],
    vehicle: Vehicle,
    theta: FloatArray,
    effect: str,
    names: Sequence[str],
    noise: NoiseModel | None = None,
) -> ResidualMap | None:
    """Residual with a cause and with it switched off, all else unchanged, where it shows most.

    Args:
        windows: flight; its first `MOST_SECONDS` are used.
        theta: full parameter vector with the cause, shape (size,).
        effect: name of the cause.
        names: its entries of the vector, as ``motor_lag.tau``.

    Returns:
        The map, against time only where nothing else of the equation is known; None where the flight lacks the
        channels.
    """
    shooting = Shooting.cut(beginning(windows, MOST_SECONDS, 2.0 * SCORE_SECONDS)[0], vehicle, SCORE_SECONDS)
    if not shooting.rollouts or effect not in PAIRS:
        return None
    shooting = shooting.with_noise(covering(noise, shooting.channels, vehicle))
    settled = settle_states(shooting, theta)
    after = _residuals(settled)
    signals = _signals(shooting, after, settled)
    before = _residuals(settle_states(shooting, switched_off(shooting.layout, theta, effect, names)))
    drawn = [
        (quantity == "time", _binned(shooting, before, after, mode, channel, quantity, signals[quantity]))
        for mode, channel, quantity in PAIRS[effect]
        if quantity in signals
    ]
    # Against time everything shows; what the equation depends on shows more.
    found = [(late, m) for late, m in drawn if m is not None]
    return max(found, key=lambda f: (not f[0], f[1].seen), default=(True, None))[1]


def switched_off(layout: Layout, theta: FloatArray, effect: str, names: Sequence[str]) -> FloatArray:
    """The vector with one cause at neutral."""
    out = layout.without(theta, names)
    if f"{effect}.time" in layout.entries:
        out[layout.entry(f"{effect}.time").index] = NEVER
    return out


def _residuals(lin: Linearised) -> FloatArray:
    """Measured less simulated, (segments, length, channels); NaN where not measured."""
    return np.where(lin.weights > 0.0, -lin.residuals, np.nan)


def _signals(shooting: Shooting, residual: FloatArray, settled: Linearised) -> dict[str, FloatArray]:
    """Quantities at the samples of all segments, (segments, length); rates are simulated ones, free of gyro noise."""
    starts = settled.states.at(settled.n_pre, shooting.rollouts, shooting.segments).x0
    parts: list[dict[str, FloatArray]] = []
    place, before = 0, settled.n_pre
    for rollout, segments, x0 in zip(shooting.rollouts, shooting.segments, starts, strict=True):
        w, rows, dt = rollout.window, segments.rows, rollout.window.dt
        rates = rollout.measured[rows][..., :3] - residual[place : place + len(rows), :, :3]
        place += len(rows)
        # Time, rotors, and rates with their rate of change.
        start = w.log_span[0] if np.isfinite(w.log_span[0]) else w.t0
        level = np.mean(w.rotor_speed**2, axis=1)
        level = level / level.mean()
        part = {
            "time": w.t[rows] - start,
            "thrust": level[rows],
            "thrust_rate": np.gradient(level, dt)[rows],
            "rotor_speed": w.rotor_speed.mean(axis=1)[rows],
            "spin_rate": np.gradient(w.rotor_speed @ shooting.vehicle.spins, dt)[rows],
        }
        for i, name in enumerate("pqr"):
            part |= {name: rates[..., i], f"{name}_dot": np.gradient(rates[..., i], dt, axis=1)}
        # Velocity and height as logged.
        v = None if w.velocity is None else w.velocity[rows]
        part |= {} if v is None else {name: v[..., i] for i, name in enumerate(("v_n", "v_e", "v_d"))}
        part |= {} if w.position is None else {"height": -w.position[rows, 2]}
        if w.attitude is not None:
            # Heading; velocity as measured, else from that fitted `before` rows ahead of each segment and the
            # accelerometer; in the body.
            q_w, x, y, z = w.attitude[rows].transpose(2, 0, 1)
            part["heading"] = np.arctan2(2.0 * (q_w * z + x * y), 1.0 - 2.0 * (y * y + z * z))
            if v is None and w.accel is not None:
                along = np.concatenate([rows[:, :1] + np.arange(1 - before, 0), rows], axis=1)
                pull = rotated(w.attitude[along], w.accel[along]) + [0.0, 0.0, GRAVITY]
                v = (x0[:, None, _VELOCITY] + dt * np.cumsum(pull, axis=1))[:, before - 1 :]
            if v is not None:
                body = rotated(conjugate(w.attitude[rows]), v)
                part |= {name: body[..., i] for i, name in enumerate(("v_x", "v_y", "v_z"))}
        parts.append(part)
    shared = set.intersection(*(set(p) for p in parts))
    return {name: np.concatenate([p[name] for p in parts]) for name in shared}


def _binned(
    shooting: Shooting,
    before: FloatArray,
    after: FloatArray,
    mode: str,
    channel: int,
    quantity: str,
    signal: FloatArray,
) -> ResidualMap | None:
    if channel >= before.shape[2]:
        return None
    both = [before[..., channel], after[..., channel]]
    if mode == "slope":
        k = max(round(SLOPE_SECONDS / shooting.dt), 1)
        both = [(r[:, k:] - r[:, :-k]) / (k * shooting.dt) for r in both]
        total = np.cumsum(np.concatenate([np.zeros((len(signal), 1)), signal], axis=1), axis=1)
        signal = (total[:, k:-1] - total[:, : -k - 1]) / k
    good = np.isfinite(both[0]) & np.isfinite(both[1]) & np.isfinite(signal)
    if np.count_nonzero(good) < 20 * BINS or np.ptp(signal[good]) <= 0.0:
        return None
    values = signal[good]
    spread = np.linspace(values.min(), values.max(), BINS + 1)
    edges = spread if quantity == "time" else np.quantile(values, np.linspace(0.0, 1.0, BINS + 1))
    label = np.clip(np.searchsorted(edges, signal, side="right") - 1, 0, BINS - 1)
    (x, _), (mean_b, error_b), (mean_a, error_a) = (_means(of, label, good) for of in (signal, *both))
    told = np.isfinite(error_b) & np.isfinite(error_a) & (error_b > 0.0) & (error_a > 0.0)
    if np.count_nonzero(told) < BINS // 2:
        return None
    seen = float(np.mean(mean_b[told] ** 2 - mean_a[told] ** 2) / max(float(np.var(both[1][good])), 1e-300))
    name, unit = CHANNEL_NAMES[channel], CHANNEL_UNITS[channel]
    if mode == "slope":
        name, unit = f"d{name}/dt", f"{unit}^2" if unit.endswith("/s") else f"{unit}/s"
    return ResidualMap(
        name, unit, *_NAMES[quantity], x[told], mean_b[told], mean_a[told], error_b[told], error_a[told], seen
    )


def _means(values: FloatArray, label: IndexArray, good: BoolArray) -> tuple[FloatArray, FloatArray]:
    """Mean of each bin, and its 95 % half-width from the means of the stretches, which are nearly independent."""
    segment = np.broadcast_to(np.arange(len(values))[:, None], values.shape)
    key = (segment * BINS + label)[good]
    size = len(values) * BINS
    count = np.bincount(key, minlength=size).reshape(-1, BINS)
    total = np.bincount(key, weights=values[good], minlength=size).reshape(-1, BINS)
    samples = count.sum(axis=0)
    stretches = np.count_nonzero(count, axis=0)
    with np.errstate(divide="ignore", invalid="ignore"):
        mean = total.sum(axis=0) / samples
        scatter = np.sum((total - count * mean) ** 2, axis=0) / samples**2
        error = Z95 * np.sqrt(scatter * stretches / np.maximum(stretches - 1, 1))
    return mean, np.where(stretches >= 4, error, np.nan)


def map_figure(found: ResidualMap, identifier: str, title: str) -> dict[str, Any]:
    """The picture of a cause: residual against its quantity, with the cause in the model and with it switched off."""
    data = []
    for role, name, mean, error in (
        ("before", f"without {title}", found.before, found.before_error),
        ("after", f"with {title}", found.after, found.after_error),
    ):
        bars = {"type": "data", "array": error.tolist()}
        data.append(trace(role, name, found.x, mean, mode="lines+markers", error_y=bars, showlegend=True))
    unit = f" [{found.against_unit}]" if found.against_unit else ""
    layout = {
        "xaxis": axis(f"{found.against}{unit}"),
        "yaxis": axis(f"{found.channel} [{found.unit}]", zeroline=True),
        "hovermode": "closest",
        "shapes": [level(0.0)],
    }
    caption = f"mean of measured less simulated {found.channel} against {found.against}; flat at zero is right"
    return figure(identifier, "What it looks like", data, layout, 280, caption=caption)
