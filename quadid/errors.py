"""Errors a caller can act on.

Every error states what was found, what is allowed and what to do about it.  The command line turns any
`QuadidError` into one line and exit code 2 (bad input) or 3 (the data cannot support an answer).
"""

from __future__ import annotations

import difflib
import re
from collections.abc import Iterable

from quadid.sanitise import one_line


class QuadidError(Exception):
    """Base of all errors raised on purpose; each is one line of printable text, whatever it quotes.

    Attributes:
        found: what was met, as text.
        allowed: what would have been valid.
        fix: what the user can do.
    """

    exit_code = 2

    def __init__(self, found: str, allowed: str = "", fix: str = "") -> None:
        found, allowed, fix = map(one_line, (found, allowed, fix))
        fix = "" if allowed and fix == _one_of(allowed) else fix  # what is allowed is stated once
        self.found, self.allowed, self.fix = found, allowed, fix
        parts = [found]
        if allowed:
            parts.append(f"allowed: {allowed}")
        if fix:
            parts.append(f"fix: {fix}")
        super().__init__("; ".join(parts))


class VehicleError(QuadidError):
    """A vehicle description that cannot be a flying vehicle."""


class LogError(QuadidError):
    """A log that cannot be read, or lacks what was asked of it."""


class WindowError(QuadidError):
    """Arrays that do not form a valid window: shape, unit, order or finiteness."""


class ParameterError(QuadidError):
    """A parameter outside its bounds, or an unknown name."""


class NotIdentifiableError(QuadidError):
    """The data were read well but cannot support an answer."""

    exit_code = 3


FOREIGN_UNIT = re.compile(
    r"rpm|dps|degrees|(?<![a-z])(deg|rev|ms|us|ns|g|mm|cm|km|kmh|kph|mph|ft|inch|pct|percent)(?![a-z])", re.IGNORECASE
)
"""Units in names of others that no name of ours has."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Returns ``did you mean 'x'?`` for the valid name closest to `name`, or the list of valid names.

    A name that carries a unit of its own, as ``max_rpm``, is told that ours are in SI units.
    """
    options = list(valid)
    close = difflib.get_close_matches(name, options, n=1, cutoff=0.5)
    if not close:
        return _one_of(", ".join(options))
    unit = FOREIGN_UNIT.search(name)
    in_si = f", in SI units, not {unit[0]}" if unit and not FOREIGN_UNIT.search(close[0]) else ""
    return f"did you mean '{close[0]}'{in_si}?"


def _one_of(options: str) -> str:
    return f"use one of {options}"
