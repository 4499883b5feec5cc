"""`quadid reproduce`: the paper's protocol, its tables and figures, and what they lack."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Annotated

import typer
from quadid_evaluation.paper import protocol
from quadid_evaluation.paper.protocol import Reproduced
from quadid_evaluation.paper.result import summary

from quadid.app.options import JsonTarget, OutFolder, Seed
from quadid.types import JsonDict

_FIGURES = "paper"
"""Folder of the pictures in the output folder."""


def reproduce(
    quick: Annotated[bool, typer.Option("--quick", help="Flights of 60 s instead of 500 s, a smaller swarm.")] = False,
    seed: Seed = 1,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fly the paper's three sets, fit as it does and better; write Tables 1 and 2, Figures 3 to 8, and one page."""

    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    folder = terminal.out_folder(out)
    plan = protocol.QUICK if quick else protocol.Plan()
    begin = time.perf_counter()
    with terminal.progress() as advance:
        done = protocol.reproduce(folder / "flights", plan, seed, advance)
        command = f"quadid reproduce{' --quick' if quick else ''} --seed {seed}"
        result = summary(done, plan, seed, time.perf_counter() - begin, command)
        advance("draw", 0.0)
        result["files"] = write(done, result, folder)
    terminal.write_json(result, str(folder / "paper.json"))
    terminal.write_json(result, json)
    show(result, quiet=json == "-")


def write(done: Reproduced, result: JsonDict, folder: Path) -> list[str]:
    """Writes pictures, Markdown and HTML; returns their absolute paths."""
    from quadid_evaluation.paper.figures import FIGURES, draw, interactive
    from quadid_evaluation.paper.page import paper_markdown, paper_sections

    from quadid.app.logs import write_text
    from quadid.cli.terminal import out_folder
    from quadid.report.page import render

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
    from quadid_evaluation.paper.tables import all_tables

    from quadid.cli import terminal

    console = terminal.console(quiet)
    terminal.print_tables(console, all_tables(result))
    for path in result["files"][-2:]:
        console.print(path, soft_wrap=True)
