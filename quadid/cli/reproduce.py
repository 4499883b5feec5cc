"""`quadid reproduce`: the paper's protocol, its tables and figures, and what they lack."""

from collections.abc import Mapping, Sequence
from itertools import product
from pathlib import Path
from typing import Annotated

import typer
from quadid_evaluation.paper import protocol
from quadid_evaluation.paper.figures import FIGURES, draw, interactive
from quadid_evaluation.paper.page import all_tables, paper_markdown, paper_sections

from quadid.app.kernels import FIT
from quadid.app.logs import check_folder, write_text, written_whole
from quadid.app.options import JsonTarget, OutFolder, Seed
from quadid.cli import terminal
from quadid.identification.controller_gains import PaperScore
from quadid.report.page import render
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
    terminal.check_file(json, "--json")
    folder = check_folder(out, "--out", "paper.json", "paper.html", "paper.md")
    check_folder(folder / _FIGURES, "--out", "figure-*")
    flights = check_folder(folder / "flights", "--out", "set?.mcap", "pelican.yaml")
    plan = protocol.QUICK if quick else protocol.Plan()
    with terminal.progress(FIT) as advance:
        command = f"quadid reproduce{' --quick' if quick else ''} --seed {seed}"
        result, scores = protocol.reproduce(flights, plan, seed, advance, command)
        advance("draw", 0.0)
        result["files"] = write(result, scores, folder)
    terminal.write_json(result, str(folder / "paper.json"))
    terminal.write_json(result, json)
    console = terminal.console(json == "-")
    terminal.print_tables(console, all_tables(result))
    for path in result["files"][-2:]:
        console.print(path, soft_wrap=True)


def write(result: JsonDict, scores: Mapping[str, Sequence[PaperScore]], folder: Path) -> list[str]:
    """Writes pictures, Markdown and HTML; returns their absolute paths."""
    from matplotlib import rc_context, rcParamsDefault

    pictures, files = check_folder(folder / _FIGURES, "--out"), []
    for figure, kind in product(FIGURES, ("png", "pdf")):
        path = pictures / f"figure-{figure.number}.{kind}"
        # Without the settings of a matplotlibrc in this folder, which can have LaTeX run on what they hold.
        with rc_context(rcParamsDefault), written_whole(path) as part:
            draw(figure, scores).savefig(part, dpi=110)
        files.append(str(path))
    page = render(paper_sections(result, [interactive(figure, scores) for figure in FIGURES]))
    files.append(str(write_text(folder / "paper.html", page)))
    files.append(str(write_text(folder / "paper.md", paper_markdown(result, _FIGURES))))
    return files
