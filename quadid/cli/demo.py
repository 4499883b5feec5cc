"""`quadid demo`: flies, logs, identifies and diagnoses a simulated Pelican, and writes a report."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from quadid.app.options import JsonTarget, OutFolder, Seed

if TYPE_CHECKING:
    from quadid.app.demo import Shown


def demo(
    quick: Annotated[bool, typer.Option("--quick", help="Flights of 60 s instead of 500 s.")] = False,
    seed: Seed = 1,
    json: JsonTarget = None,
    out: OutFolder = Path(),
) -> None:
    """Fly three Pelican flights, identify on the first, validate on the others, diagnose; write logs and a report."""
    from quadid.app import demo as work
    from quadid.app.logs import write_text
    from quadid.cli import terminal

    terminal.check_file(json, "--json")
    folder = terminal.out_folder(out)
    with terminal.progress(("simulation", "statistics", "estimate", "flight")) as advance:
        shown = work.run(work.QUICK_SECONDS if quick else work.SECONDS, seed, folder, advance)
    page = folder / "report.html"
    result = work.summary(shown, str(page))
    write_text(page, work.html(shown, seed, terminal.command_line()))
    terminal.write_json(result, str(folder / "result.json"))
    terminal.write_json(result, json)
    show(shown, page, quiet=json == "-")


def show(shown: Shown, page: Path, quiet: bool) -> None:
    """Prints both results beside the truth, and where the files are."""
    from quadid.app.demo import HIDDEN_SECTION, TRUE_SECTION
    from quadid.cli import terminal

    console = terminal.console(quiet)
    terminal.print_tables(console, shown.identified.tables(shown.truth))
    terminal.print_verdict(console, shown.identified.verdict)
    for title, part in ((TRUE_SECTION, shown.diagnosed), (HIDDEN_SECTION, shown.hidden)):
        console.print(f"\n{title}")
        terminal.print_tables(console, part.tables())
        terminal.print_verdict(console, part.verdict)
    console.print(f"\nLogs and vehicle files: {page.parent}", soft_wrap=True)
    console.print(f"Report: {page}", soft_wrap=True)
