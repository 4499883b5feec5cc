"""What people see: tables, notes, progress; colours and bars on a terminal only, nothing beside JSON on stdout."""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import TYPE_CHECKING

from quadid_workflow.progress import Advance as Advance
from quadid_workflow.progress import silent

from quadid.sanitise import one_line
from quadid_cli.compiling import prepare

if TYPE_CHECKING:
    from rich.console import Console

_PIPE_WIDTH = 120


def console(quiet: bool = False, stderr: bool = False) -> Console:
    """Returns the console to print on.

    Args:
        quiet: print nothing (stdout carries JSON).
        stderr: print on stderr instead of stdout.

    Nothing is markup.  Colours follow the terminal and ``NO_COLOR``; a pipe gets plain text that is not broken at 80
    columns.
    """
    from rich.console import Console

    stream = sys.stderr if stderr else sys.stdout
    width = None if stream.isatty() or "COLUMNS" in os.environ else _PIPE_WIDTH
    return Console(stderr=stderr, quiet=quiet, width=width, highlight=False, markup=False)


def warn(messages: tuple[str, ...] | list[str]) -> None:
    """Prints warnings on stderr, one line each, without control characters that a name in a log may hold."""
    for message in messages:
        print(f"warning: {one_line(message)}", file=sys.stderr)


@contextmanager
def progress(compiled: Sequence[str] = ("simulation", "statistics", "estimate")) -> Iterator[Advance]:
    """Shows a progress bar on stderr while the block runs, if stderr is a terminal; yields how to advance it.

    Args:
        compiled: kernels that the block needs (`quadid_workflow.kernels.PARTS`), compiled first where they are not.
    """
    if not sys.stderr.isatty():
        prepare(compiled, silent)
        yield silent
        return
    from rich.progress import BarColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        TextColumn("{task.percentage:>3.0f} %"),
        TimeElapsedColumn(),
        TextColumn("left"),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console(stderr=True), transient=True) as bar:
        task = bar.add_task("", total=1.0)

        def advance(stage: str, share: float) -> None:
            bar.update(task, description=stage, completed=share)

        prepare(compiled, advance)
        yield advance
