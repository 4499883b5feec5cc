"""The `quadid` command: finds the asked-for command, runs it, and turns errors into one line and an exit code.

What the commands are: `quadid.cli.commands`.
"""

import atexit
import gc
import importlib
import os
import sys
import threading
import time
from typing import Annotated, Any, TextIO

import typer
from typer.core import TyperCommand, TyperGroup
from typer.main import get_command

from quadid.cli.commands import COMMANDS, load
from quadid.errors import QuadidError, nearest

# --- A word on the terminal until a command has something of its own to print


class Loading:
    """Seconds of loading in one line of stderr, on a terminal only; the first text that anything prints ends it."""

    def __init__(self) -> None:
        self._ended = threading.Event()
        self._terminal = sys.stderr
        self._line = threading.Thread(target=self._count, daemon=True)
        self._streams = [_First(stream, self.end) for stream in (sys.stdout, sys.stderr) if stream is not None]
        if len(self._streams) == 2 and self._terminal.isatty():
            sys.stdout, sys.stderr = self._streams
            self._line.start()

    def _count(self) -> None:
        begin = time.monotonic()
        while not self._ended.wait(0.25):  # nothing is said where that is enough
            print(f"\rquadid: loading, {time.monotonic() - begin:.0f} s", end="", file=self._terminal, flush=True)

    def end(self) -> None:
        """Erases the line, if there is one, for good."""
        if self._line.is_alive() and not self._ended.is_set():
            self._ended.set()
            self._line.join()
            print("\r\x1b[2K", end="", file=self._terminal, flush=True)


class _First:
    """A stream that calls `begun` before it is written to."""

    def __init__(self, stream: TextIO, begun: Any) -> None:
        self._stream, self._begun = stream, begun

    def write(self, text: str) -> int:
        self._begun()
        return self._stream.write(text)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stream, name)


# --- The `quadid` command: finds the asked-for command, runs it, and turns errors into one line and an exit code


class UnknownCommandError(QuadidError):
    """A command that is not in the table."""


class LazyGroup(TyperGroup):
    """Lists every command from a table, and imports one only to run it."""

    def __init__(self, **attributes: Any) -> None:
        super().__init__(**attributes)
        for name, command in COMMANDS.items():
            self.commands[name] = TyperCommand(
                name, help=command.short, short_help=command.short, rich_markup_mode=None
            )

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Finds the command asked for, imported and complete."""
        if args[0] not in self.commands and not args[0].startswith("-"):
            raise UnknownCommandError(f"No such command '{args[0]}'", fix=nearest(args[0], self.commands))
        name, command, rest = super().resolve_command(ctx, args)
        return name, None if command is None else load(str(command.name)), rest


def _version(wanted: bool) -> None:
    if wanted:
        from quadid.version import __version__

        typer.echo(f"quadid {__version__}")
        raise typer.Exit


app = typer.Typer(name="quadid", cls=LazyGroup, rich_markup_mode=None)


@app.callback(
    epilog="All quantities SI; world NED, body FRD. Exit codes: 0 done, 2 bad input, 3 the data cannot answer."
)
def _quadid(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Print the version.")
    ] = False,
) -> None:
    """Identifies the parameters of a multirotor simulation from flight data, and names what it still gets wrong."""


BLAS_THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
"""Variables of numpy's number of threads.  Our linear algebra is of small matrices, and the simulation uses every
core itself: more threads than one only wait for each other, on a busy machine for most of the time."""


def app_main() -> int:
    """Runs the command line; returns the exit code: 0 done, 2 bad input, 3 the data cannot support an answer."""
    if sys.stderr is None:  # closed by the shell: what is written to it goes nowhere
        sys.stderr = open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115 - it stays open to the end
    if sys.stdout is None:
        print("quadid: stdout is closed; fix: send it to a file, or to /dev/null", file=sys.stderr)
        return 2
    try:
        importlib.import_module("quadid")  # refuses a folder that would run foreign code
    except ImportError as error:
        print(f"quadid: {error}", file=sys.stderr)
        return 2
    for name in BLAS_THREADS:
        os.environ.setdefault(name, "1")
    atexit.register(gc.freeze)  # the end would look through all that numba and its compiler made, for seconds
    loading = Loading()
    try:
        result = get_command(app).main(sys.argv[1:] or ["--help"], prog_name="quadid", standalone_mode=False)
        sys.stdout.flush()
    except BrokenPipeError:
        # The reader of our pipe left; nothing more can be said there, not even at exit.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
        return 1
    except (KeyboardInterrupt, typer.Abort):
        print("quadid: stopped", file=sys.stderr)
        return 130
    except Exception as error:
        from quadid.cli.terminal import explain

        reason = explain(error)
        if reason is None:
            raise
        print(f"quadid: {reason.line}", file=sys.stderr)
        return reason.exit_code
    finally:
        loading.end()
    return result if isinstance(result, int) else 0
