"""Figures 3 to 8 of the paper: measurement, quasi-Newton and swarm, as pictures for print and for a page."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from quadid.report.figures import liveliest
from quadid.report.page import axis, trace
from quadid.types import FloatArray, JsonDict
from quadid_evaluation.paper.objective import PaperScore

if TYPE_CHECKING:
    from matplotlib.figure import Figure


GROUPS: dict[str, tuple[str, slice]] = {
    "angles": ("Euler angles", slice(0, 3)),
    "accelerations": ("body accelerations", slice(6, 9)),
    "rates": ("body rates", slice(3, 6)),
}
OUTPUTS = (
    "φ [deg]",
    "θ [deg]",
    "ψ [deg]",
    "p [deg/s]",
    "q [deg/s]",
    "r [deg/s]",
    "a_x [m/s²]",
    "a_y [m/s²]",
    "a_z [m/s²]",
)
"""The paper's outputs with their units."""
SECONDS = 20.0
"""Length of the time segments that are shown [s]."""
# As in the paper: measurement blue, the earlier quasi-Newton estimate dashed red, the swarm yellow.
_STYLES: dict[str, dict[str, Any]] = {
    "measured": {"color": "#1f4fa3", "linewidth": 1.0},
    "quasi_newton": {"color": "#c22f2f", "linewidth": 1.1, "linestyle": "--", "zorder": 3},
    "pso": {"color": "#e0a800", "linewidth": 1.1},
}
NAMES = {"measured": "measurement", "quasi_newton": "quasi-Newton", "pso": "PSO"}
_ROLES = {"measured": "measured", "quasi_newton": "before", "pso": "after"}


@dataclass(frozen=True)
class PaperFigure:
    """One figure: a group of outputs on one or two sets.

    Attributes:
        group: key of `GROUPS`.
        sets: numbers of the sets, from 1.
    """

    number: int
    group: str
    sets: tuple[int, ...]

    @property
    def title(self) -> str:
        """Contents of the figure."""
        role = "training set" if self.sets == (1,) else "validation sets"
        return f"Figure {self.number}: {GROUPS[self.group][0]} in closed loop, {role}"


FIGURES = (
    PaperFigure(3, "angles", (1,)),
    PaperFigure(4, "accelerations", (1,)),
    PaperFigure(5, "rates", (1,)),
    PaperFigure(6, "angles", (2, 3)),
    PaperFigure(7, "accelerations", (2, 3)),
    PaperFigure(8, "rates", (2, 3)),
)
"""The paper's figures of results."""


def _lines(scores: Mapping[str, Sequence[PaperScore]], number: int) -> tuple[FloatArray, dict[str, FloatArray]]:
    """Times [s] and outputs (n, 9) of the liveliest segment of set `number` by line."""
    some = scores["pso"][number - 1]
    step = float(np.median(np.diff(some.t)))
    width = min(int(SECONDS / step), len(some.t))
    # `liveliest` looks at the first three columns: the rates.
    first = int(liveliest(some.t, some.measured[:, 3:6], width)[0])
    rows = slice(min(first, len(some.t) - width), min(first, len(some.t) - width) + width)
    lines = {"measured": some.measured[rows]}
    lines |= {name: scores[name][number - 1].simulated[rows] for name in ("quasi_newton", "pso")}
    return some.t[rows] - some.t[0], lines


def draw(figure: PaperFigure, scores: Mapping[str, Sequence[PaperScore]]) -> Figure:
    """Draws a figure for print; the caller saves it.

    Args:
        scores: by model (``quasi_newton``, ``pso``), of every set.
    """
    from matplotlib.figure import Figure

    outputs = range(9)[GROUPS[figure.group][1]]
    page = Figure(figsize=(5.6 * len(figure.sets) + 1.0, 6.4), layout="constrained")
    axes = page.subplots(3, len(figure.sets), squeeze=False, sharex="col")
    for column, number in enumerate(figure.sets):
        t, lines = _lines(scores, number)
        for row, output in enumerate(outputs):
            plot = axes[row, column]
            for name, values in lines.items():
                plot.plot(t, values[:, output], label=NAMES[name], **_STYLES[name])
            plot.set_ylabel(OUTPUTS[output])
            plot.grid(alpha=0.3)
        axes[0, column].set_title(f"Set {number} ({'training' if number == 1 else 'validation'})", fontsize=10)
        axes[-1, column].set_xlabel("time [s]")
    handles, names = axes[0, 0].get_legend_handles_labels()
    page.legend(handles, names, loc="outside upper center", ncols=3, frameon=False)
    return page


def interactive(figure: PaperFigure, scores: Mapping[str, Sequence[PaperScore]]) -> JsonDict:
    """The same figure for `quadid.report.page.render`: one view a set."""
    outputs = range(9)[GROUPS[figure.group][1]]
    views = []
    for number in figure.sets:
        t, lines = _lines(scores, number)
        data: list[JsonDict] = []
        layout: JsonDict = {"xaxis": axis("time [s]", anchor="y3")}
        for row, output in enumerate(outputs):
            place = "" if row == 0 else str(row + 1)
            layout[f"yaxis{place}"] = axis(
                OUTPUTS[output], domain=[1.0 - (row + 1) / 3.0 + 0.03, 1.0 - row / 3.0 - 0.01]
            )
            for name, values in lines.items():
                where = {"xaxis": "x", "yaxis": f"y{place}", "showlegend": row == 0, "legendgroup": name}
                data.append(trace(_ROLES[name], NAMES[name], t, values[:, output], **where))
        views.append({"label": f"Set {number}", "data": data, "layout": layout})
    return {"id": f"figure-{figure.number}", "title": figure.title, "views": views, "height": 460}
