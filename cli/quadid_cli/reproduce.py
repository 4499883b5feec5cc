"""`quadid reproduce`: the paper's protocol, its tables and figures, and what they lack."""

from __future__ import annotations

import datetime
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from quadid.chi_square import Z95
from quadid.types import JsonDict
from quadid_cli.options import JsonTarget, OutFolder, Seed

if TYPE_CHECKING:
    from quadid.workflow.reproduction import Plan, Reproduced

_SPENT = ("quasi_newton", "pso", "pso_polish")
_FIGURES = "paper"
"""Folder of the pictures in the output folder."""


def reproduce(
    quick: Annotated[bool, typer.Option("--quick", help="Flights of 60 s instead of 500 s, a smaller swarm.")] = False,
    seed: Seed = 1,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fly the paper's three sets, fit as it does and better; write Tables 1 and 2, Figures 3 to 8, and one page."""
    from quadid.workflow import reproduction as reproducing
    from quadid_cli import output, terminal

    output.check_file(json, "--json")
    folder = output.out_folder(out)
    plan = reproducing.QUICK if quick else reproducing.Plan()
    begin = time.perf_counter()
    with terminal.progress() as advance:
        done = reproducing.reproduce(folder / "flights", plan, seed, advance)
        command = f"quadid reproduce{' --quick' if quick else ''} --seed {seed}"
        result = summary(done, plan, seed, time.perf_counter() - begin, command)
        advance("draw", 0.0)
        result["files"] = write(done, result, folder)
    output.write_json(result, str(folder / "paper.json"))
    output.write_json(result, json)
    show(result, quiet=json == "-")


def summary(done: Reproduced, plan: Plan, seed: int, seconds: float, command: str) -> JsonDict:
    """All numbers as JSON, of the form ``quadid.reproduce/1``."""
    from quadid import __version__
    from quadid.workflow.reproduction import EFFECTS, STABILISER_RATE

    return {
        "schema": "quadid.reproduce/1",
        "date": datetime.date.today().isoformat(),
        "version": __version__,
        "command": command,
        "seed": seed,
        "seconds": seconds,
        "flight": {
            "seconds": plan.seconds, "stabiliser_rate": STABILISER_RATE, "effects": EFFECTS,
            "truth": dict(done.protocol.truth), "logs": done.protocol.logs,
        },
        "swarm": {"particles": plan.particles, "iterations": plan.iterations, "seeds": plan.seeds},
        "mse_paper": {name: [s.mse for s in scores] for name, scores in done.paper.items()},
        "fit_percent": {name: [s.fit_percent for s in scores] for name, scores in done.paper.items()},
        "mse": done.mse,
        "noise_floor": 1.0,
        "orders": done.orders,
        "parameters": parameters(done),
        "correlations": done.fit.parameters.correlation,
        "verdict": done.diagnosis.verdict.value.replace("_", " "),
        "findings": [finding.to_dict() for finding in done.diagnosis.findings],
        "effort": {
            name: {"evaluations": done.columns[name].evaluations, "seconds": done.columns[name].seconds}
            for name in _SPENT
        },
    }  # fmt: skip


def parameters(done: Reproduced) -> JsonDict:
    """Table 2: every estimate of every parameter, with intervals where there are any."""
    from quadid.parameters import NOMINAL_NAMES

    out = {}
    for i, name in enumerate(NOMINAL_NAMES):
        p, extended, sigma = done.fit.parameters[name], done.columns["extended"].theta[i], done.sigma[name]
        out[name] = {
            "truth": done.protocol.truth[name],
            **{c: float(done.columns[c].theta[i]) for c in ("initial", *_SPENT, "identified", "extended")},
            "pso_seeds": [float(theta[i]) for theta in done.columns["pso"].others],
            "ci95": list(p.ci95),
            "status": p.status.value.replace("_", " ") + (f" to {p.relative_to}" if p.relative_to else ""),
            "extended_ci95": [float(extended - Z95 * sigma), float(extended + Z95 * sigma)],
        }
    return out


def write(done: Reproduced, result: JsonDict, folder: Path) -> list[str]:
    """Writes pictures, Markdown and HTML; returns their absolute paths."""
    from quadid.report.page import render
    from quadid.report.paper_figures import FIGURES, draw, interactive
    from quadid.report.paper_page import paper_markdown, paper_sections
    from quadid_cli.output import out_folder, write_text

    pictures, files = out_folder(folder / _FIGURES), []
    for figure in FIGURES:
        drawn = draw(figure, done.paper)
        for kind in ("png", "pdf"):
            path = pictures / f"figure-{figure.number}.{kind}"
            drawn.savefig(path, dpi=110)
            files.append(str(path))
    page = render(paper_sections(result, [interactive(figure, done.paper) for figure in FIGURES]))
    files.append(str(write_text(folder / "paper.html", page)))
    files.append(str(write_text(folder / "paper.md", paper_markdown(result, _FIGURES))))
    return files


def show(result: JsonDict, quiet: bool) -> None:
    """Prints the tables and where the files are."""
    from quadid.report.paper_tables import all_tables
    from quadid.report.text_table import Column, TextTable
    from quadid_cli import tables, terminal

    console = terminal.console(quiet)
    for table in all_tables(result):
        columns = tuple(Column(head, right=i > 0) for i, head in enumerate(table.head))
        tables.print_tables(console, [TextTable(table.title, columns, tuple(tuple(row) for row in table.rows))])
    for path in result["files"][-2:]:
        console.print(path, soft_wrap=True)
