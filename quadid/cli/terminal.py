"""Terminal and files of a command: console, progress, tables, JSON, errors as one line."""

from __future__ import annotations

import os
import shlex
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from quadid.app.logs import OutputError, check_place, write_text
from quadid.app.outcome import Advance, Outcome, json_text, silent
from quadid.errors import QuadidError, nearest
from quadid.report.tables import SPACE, Cell, TextTable
from quadid.report.verdict import Verdict
from quadid.sanitise import one_line, plain

if TYPE_CHECKING:
    from rich.console import Console


# --- What people see: tables, notes, progress; colours and bars on a terminal only, nothing beside JSON on stdout


_PIPE_WIDTH = 120


def console(quiet: bool = False, stderr: bool = False) -> Console:
    """Returns the console to print on.

    Nothing is markup, and nothing that is printed holds characters that a terminal acts on, whoever named it.  Colours
    follow the terminal and ``NO_COLOR``; a pipe gets plain text that is not broken at 80 columns.
    """
    from rich.console import Console, ConsoleOptions, RenderableType
    from rich.segment import Segment

    class Plain(Console):
        def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterable[Segment]:
            for part in super().render(renderable, options):
                lines = "\n".join(plain(line, len(line)) for line in part.text.split("\n"))
                yield part if part.control else Segment(lines, part.style)

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() or "COLUMNS" in os.environ else _PIPE_WIDTH
    return Plain(stderr=stderr, quiet=quiet, width=width, highlight=False, markup=False)


def warn(messages: tuple[str, ...] | list[str]) -> None:
    """Prints warnings on stderr, one line each, without control characters that a name in a log may hold."""
    for message in messages:
        print(f"warning: {one_line(message)}", file=sys.stderr)


@contextmanager
def progress() -> Iterator[Advance]:
    """Shows a progress bar on stderr while the block runs, if stderr is a terminal; yields how to advance it."""
    if not sys.stderr.isatty():
        yield silent
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
    )
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task("starting", total=1.0)

        def advance(stage: str, share: float) -> None:
            bar.update(task, description=stage, completed=share)

        yield advance


# --- Written results: folders that are checked before long work, and JSON that any parser accepts


def check_file(path: Path | str | None, option: str) -> None:
    """Raises OutputError when a file to be written later cannot be; ``-`` and None are fine."""
    if path is None or str(path) == "-":
        return
    file = Path(path)
    if option == "--report" and file.suffix.lower() not in (".html", ".htm") and not file.is_dir():
        raise OutputError(
            f"{option} {file}: a report is an HTML page",
            "a name that ends in .html",
            f"{file.stem}.html; a browser prints it to PDF, in eight pages at most",
        )
    check_place(file, option)


def command_line() -> str:
    """The command as it was typed, for reports."""
    return shlex.join(["quadid", *sys.argv[1:]])


def write_json(result: Mapping[str, Any], target: str | None) -> None:
    """Writes a result as JSON to a file, or to stdout for ``-``; numbers that JSON has no word for become null."""
    if target is None:
        return
    text = json_text(result)
    if target == "-":
        sys.stdout.write(text)
    else:
        write_text(Path(target), text)


# --- Tables and verdicts of the library on a terminal: as wide as it is, in colours where it has them


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


def show(done: Outcome, json: str | None, files: Sequence[tuple[str, Path]] = ()) -> None:
    """Prints a result, also as JSON, and names the files that were written."""
    write_json(done.result, json)
    out = console(quiet=json == "-")
    for cell in done.opening:
        print_cell(out, cell)
    print_tables(out, done.tables())
    if done.verdict is not None:
        print_verdict(out, done.verdict)
    for cell in done.sentences:
        print_cell(out, cell)
    for label, path in files:
        out.print(f"{label}: {path}", soft_wrap=True)
    warn(done.warnings)


# --- Errors as one line for people: what was found, what is allowed, what to do


_NO_OPTION, _MISSING = "NoSuchOption", "MissingParameter"
"""An error of usage for what was not given, with what it may be as its help."""


class Failure(NamedTuple):
    """One line without line breaks, and the exit code that goes with it."""

    line: str
    exit_code: int


def explain(error: Exception) -> Failure | None:
    """Returns the line for an error that the user can act on, or None for a defect of the program."""
    if isinstance(error, QuadidError):
        return Failure(one_line(str(error)), error.exit_code)
    if isinstance(error, OSError):
        where = f"{error.filename}: " if error.filename else ""
        return Failure(
            one_line(f"{where}{error.strerror or error}; fix: check the path, its permissions and the disk"), 2
        )
    if isinstance(error, ModuleNotFoundError) and (name := (error.name or "quadid").partition(".")[0]) != "quadid":
        return Failure(f"{name} is not installed; fix: pip install {name}", 2)
    if type(error).__name__ == "LinAlgError":
        cause = "the equations have no unique solution: these data cannot support an answer"
        return Failure(f"{cause}; fix: look at the log with `quadid inspect`, use a livelier flight", 3)
    # typer brings its own copy of click or uses the one installed; both have this method on errors of usage.
    told = getattr(error, "format_message", None)
    if callable(told):
        context = getattr(error, "ctx", None)
        path = context.command_path if context is not None else "quadid"
        wanted = getattr(getattr(error, "param", None), "help", None) if type(error).__name__ == _MISSING else None
        allowed = f"; allowed: {wanted[0].lower()}{wanted[1:].rstrip('.')}" if wanted else ""
        text = str(told()).rstrip(".")
        slip = getattr(error, "option_name", "")
        if type(error).__name__ == _NO_OPTION and context is not None:  # not what typer takes it for
            options = [n for p in context.command.params for n in p.opts if n.startswith("--")]
            text, allowed = f"No such option: {slip}", f"; fix: {nearest(slip, options)}"
        return Failure(one_line(f"{text}{allowed}; see `{path} --help`"), 2)
    return None
