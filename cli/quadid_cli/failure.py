"""Errors as one line for people: what was found, what is allowed, what to do."""

from __future__ import annotations

from typing import NamedTuple

from quadid.errors import QuadidError
from quadid.sanitise import one_line

_MISSING = "MissingParameter"
"""An error of usage for what was not given; its help says what that may be."""


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
        return Failure(one_line(f"{str(told()).rstrip('.')}{allowed}; see `{path} --help`"), 2)
    return None
