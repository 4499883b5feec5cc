"""Tables and verdicts of the library on a terminal: as wide as it is, in colours where it has them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

from quadid_report.text_table import SPACE, Cell, TextTable

if TYPE_CHECKING:
    from pathlib import Path

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


def conclude(
    done: Outcome, json: str | None, report: Path | None = None, files: Mapping[str, Path] | None = None,
    series: Sequence[str] | None = None,
) -> None:  # fmt: skip
    """Writes what a command gives beside what it prints, names that in its JSON, and prints the result.

    Args:
        done: the result; its warnings go to stderr.
        json: where its JSON goes, as `output.write_json`.
        report: where its HTML report goes.
        files: where its ``vehicle``, and its ``prediction``, go.
        series: forms of simulated against measured, written beside the vehicle file.
    """
    from quadid_cli import output, terminal

    whole: Any = done  # which of these a command offers depends on its result
    for name, path in (files or {}).items():
        done.result[f"{name}_file"] = str(output.write_text(path, getattr(done, name).to_yaml()))
    if report is not None:
        done.result["report"] = str(report.absolute())
        whole.report(report, output.command_line())
    if series and files:
        done.result["series"] = [str(path) for path in whole.save_series(files["vehicle"].parent, series)]
    output.write_json(done.result, json)
    console = terminal.console(quiet=json == "-")
    if done.heading:
        console.print(done.heading)
    print_tables(console, done.tables())
    if done.verdict is not None:
        print_verdict(console, done.verdict)
    if done.result.get("missing"):
        console.print(done.result["missing"]["statement"], soft_wrap=True)
    for key, label in (("vehicle_file", "Vehicle file"), ("prediction_file", "Prediction file"), ("report", "Report")):
        if done.result.get(key):
            console.print(f"{label}: {done.result[key]}", soft_wrap=True)
    for path in done.result.get("series", ()):
        console.print(f"Simulated against measured: {path}", soft_wrap=True)
    terminal.warn(done.warnings)
