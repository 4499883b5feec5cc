"""Tables and verdicts of the library on a terminal: as wide as it is, in colours where it has them."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

from quadid_report.text_table import SPACE, Cell, TextTable

if TYPE_CHECKING:
    from quadid_report.verdict import Verdict
    from quadid_workflow.outcome import Outcome
    from rich.console import Console

_STYLES = {"": "", "good": "green", "fair": "yellow", "poor": "red", "title": "bold", "head": "underline", "dim": "dim"}


def print_tables(console: Console, tables: Sequence[TextTable]) -> None:
    """Prints tables, an empty line after each; columns that the terminal has no room for are left out."""
    from rich.text import Text

    for table in tables:
        for line in table.lines(console.width):
            text = Text()
            for i, cell in enumerate(line):
                text.append(SPACE * (i > 0) + cell.text, style=_STYLES[cell.tone])
            text.rstrip()
            console.print(text, soft_wrap=True)
        console.print()


def print_cell(console: Console, cell: Cell) -> None:
    """Prints one sentence."""
    from rich.text import Text

    console.print(Text(cell.text, style=_STYLES[cell.tone]))


def print_verdict(console: Console, verdict: Verdict) -> None:
    """Prints the headline, details and next steps."""
    headline, *rest = verdict.lines()
    print_cell(console, Cell(headline, verdict.level))
    for line in rest:
        print_cell(console, Cell(line))


def print_outcome(console: Console, outcome: Outcome) -> None:
    """Prints tables, verdict and written files of a result; its warnings go to stderr."""
    from quadid_cli.terminal import warn

    print_tables(console, outcome.tables())
    if outcome.verdict is not None:
        print_verdict(console, outcome.verdict)
    for key, label in (("vehicle_file", "Vehicle file"), ("prediction_file", "Prediction file"), ("report", "Report")):
        if outcome.result.get(key):
            console.print(f"{label}: {outcome.result[key]}", soft_wrap=True)
    for path in outcome.result.get("series", ()):
        console.print(f"Simulated against measured: {path}", soft_wrap=True)
    warn(outcome.warnings)
