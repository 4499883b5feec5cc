"""Results as tables with units, for a terminal."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

    from quadid.report.verdict import Verdict

JsonDict = Mapping[str, Any]
_STATUS_STYLE = {"identified": "green", "ratio_only": "yellow", "prior_dominated": "red"}
_LEVEL_STYLE = {"good": "bold green", "fair": "bold yellow", "poor": "bold red"}
_RATES = ("p", "q", "r", "a_z")


def number(value: float | None, digits: int = 4) -> str:
    """A number with `digits` that matter, or a dash."""
    return "-" if value is None or not math.isfinite(value) else f"{value:.{digits}g}"


def print_verdict(console: Console, verdict: Verdict) -> None:
    """Prints the headline, details and next steps."""
    from rich.text import Text

    console.print(Text(verdict.headline, style=_LEVEL_STYLE[verdict.level]))
    for line in verdict.details:
        console.print(Text(line))
    for line in verdict.next_steps:
        console.print(Text(f"Next: {line}"))


def print_parameters(
    console: Console, parameters: Sequence[JsonDict], truth: Mapping[str, float] | None = None
) -> None:
    """Prints current and proposed values with intervals, status, and the truth where a simulation knows it."""
    from rich.table import Table
    from rich.text import Text

    from quadid.report.verdict import digits, percent, relative_halfwidth

    table = Table(title="Parameters")
    for heading in (
        "parameter",
        "current",
        "fitted",
        "95 % interval",
        "+-",
        *(["truth"] if truth else []),
        "unit",
        "status",
    ):
        table.add_column(heading, justify="left" if heading in ("parameter", "unit", "status") else "right")
    for p in parameters:
        low, high = p["ci95"]
        known = [number(truth.get(p["name"]))] if truth else []
        status = p["status"] + (f" to {p['relative_to']}" if "relative_to" in p else "")
        table.add_row(
            p["name"],
            number(p["initial"]),
            number(p["value"], digits(p)),
            f"{number(low, digits(p))} .. {number(high, digits(p))}",
            percent(relative_halfwidth(p)),
            *known,
            p["unit"] or "1",
            Text(status, style=_STATUS_STYLE[p["status"]]),
        )
    console.print(table)


def print_sets(console: Console, sets: Sequence[JsonDict]) -> None:
    """Prints what the simulation explains of each log, before and after."""
    from rich.table import Table
    from rich.text import Text

    table = Table(title="Simulation over 1 s stretches (error: 1 = noise floor; fit: 100 % = perfect)")
    for heading in ("log", "role", "error before", "after", *(f"fit {n}" for n in _RATES)):
        table.add_column(heading, justify="left" if heading in ("log", "role") else "right")
    for s in sets:
        fits = [s["fit_percent"].get(n) for n in _RATES]
        table.add_row(
            Text(s["log"]),
            s["role"],
            number(s["mse"]["initial"], 3),
            number(s["mse"]["fitted"], 3),
            *("-" if v is None or not math.isfinite(v) else f"{max(v, -999.0):.0f} %" for v in fits),
        )
    console.print(table)


def print_horizons(console: Console, result: JsonDict) -> None:
    """Prints open-loop prediction errors, pooled and for each file."""
    from rich.table import Table
    from rich.text import Text

    from quadid.identify.open_loop import QUANTITIES

    table = Table(title=f"Open-loop prediction error of '{result['vehicle']}', mean over {result['samples']} starts")
    table.add_column("log")
    table.add_column("after", justify="right")
    for name, unit in QUANTITIES.items():
        table.add_column(f"{name} [{unit}]", justify="right")
    many = len(result["files"]) > 1
    for entry in [*(result["files"] if many else []), result]:
        label = Text(entry.get("log", "all" if many else result["files"][0]["log"]))
        for horizon, errors in entry["horizons"].items():
            table.add_row(
                label, f"{horizon} sample{'s' * (int(horizon) != 1)}", *(number(errors[n]) for n in QUANTITIES)
            )
            label = Text("")
        total = entry["sum"]
        table.add_row("", f"sum 1..{total['to']}", *(number(total[n]) for n in QUANTITIES), end_section=True)
    console.print(table)


def print_findings(console: Console, findings: Sequence[JsonDict]) -> None:
    """Prints every named cause with its numbers, what it gains on unseen data, and the best look-alike."""
    from rich.table import Table
    from rich.text import Text

    from quadid.report.verdict import digits

    table = Table(title="What the simulation gets wrong (error on unseen data in noise variances, 1 = noise floor)")
    for heading in ("cause", "value", "95 % interval", "error without", "with", "best look-alike"):
        table.add_column(heading, justify="right" if heading in ("error without", "with") else "left")
    for finding in findings:
        rival = min(finding["alternatives"], key=lambda a: a["mse_after"], default=None)
        name = Text(finding["effect"], style="" if finding["confident"] else "yellow")
        for i, p in enumerate(finding["parameters"]):
            low, high = p["ci95"]
            first = i == 0
            table.add_row(
                name if first else "",
                f"{p['name']} = {number(p['value'], digits(p))} {p['unit']}".rstrip(),
                f"{number(low, digits(p))} .. {number(high, digits(p))}",
                number(finding["gain"]["mse_before"], 3) if first else "",
                number(finding["gain"]["mse_after"], 3) if first else "",
                f"{rival['effect']} ({number(rival['mse_after'], 3)})" if first and rival else "",
            )
    console.print(table)
