"""The report's descriptions of figures as plotly figures, for notebooks."""

from __future__ import annotations

from typing import Any

from quadid.errors import ParameterError
from quadid.identify.result import ScoredSet
from quadid_report.figures import GROUPS, PARAMETERS, channel_figures

COLOURS = {"measured": "#555555", "before": "#c2762b", "after": "#1f6fb2"}
"""Of every role on a light page."""


def channel_plot(scored: ScoredSet, group: str = "rates", labels: tuple[str, str] = PARAMETERS) -> Any:
    """Measured and simulated outputs of one log as a ``plotly.graph_objects.Figure``.

    Args:
        scored: the log with both scores.
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
