"""Errors a caller can act on.

Every error states what was found, what is allowed and what to do about it.  The command line turns any
`QuadidError` into one line and exit code 2 (bad input) or 3 (the data cannot support an answer).
"""

import re
from collections.abc import Iterable
from os.path import commonprefix

from quadid.sanitise import one_line

_ONE_OF = "use one of "


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
        if fix.startswith(_ONE_OF) and allowed.startswith(fix.removeprefix(_ONE_OF)):  # what is allowed is stated once
            fix = ""
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


IN_MICROSECONDS = "range"
"""The one name of ours whose numbers are in no SI unit: pulse widths."""


def nearest(name: str, valid: Iterable[str]) -> str:
    """Returns ``did you mean 'x'?`` for the valid names that can have been meant, or the list of all.

    A name can mean another that is misspelt by a letter in a word, or has words more or fewer: nothing else is guessed.
    For one that carries a unit of its own, as ``max_rpm``, the answer adds that ours are in SI units.
    """
    options = list(valid)
    unit = FOREIGN_UNIT.search(name)
    given = _words(name.replace(unit[0], "") if unit else name) or _words(name)
    alike = [o for o in options if _misspelt(given, _words(o))] or [o for o in options if _part(given, _words(o))]
    if not 1 <= len(alike) <= 3:
        return _ONE_OF + ", ".join(options)
    foreign = unit and alike != [IN_MICROSECONDS] and not any(map(FOREIGN_UNIT.search, alike))
    in_si = f", in SI units, not {unit[0]}" if unit and foreign else ""
    return f"did you mean {' or '.join(map(repr, alike))}{in_si}?"


def _words(name: str) -> list[str]:
    return re.findall(r"[^\W_]+", name.lower())


def _misspelt(given: list[str], meant: list[str]) -> bool:
    if len(given) != len(meant):
        given, meant = ["".join(given)], ["".join(meant)]
    return all(map(_slip, given, meant))


def _part(given: list[str], meant: list[str]) -> bool:
    if "sigma" in {*meant} - {*given}:  # no quantity is its uncertainty
        return False
    return any(all(any(_stem(w, o) for o in b) for w in a) for a, b in ((given, meant), (meant, given)) if a)


def _stem(a: str, b: str) -> bool:
    """Checks whether two words are one, or one is short for the other."""
    return a == b or len(commonprefix((a, b))) >= max(4, min(len(a), len(b), 6))


def _slip(a: str, b: str) -> bool:
    """Checks whether two words differ by at most one letter, two that are exchanged, or letters that are doubled."""
    if len({re.sub(r"(.)\1+", r"\1", word) for word in (a, b)}) == 1:
        return True
    start = len(commonprefix((a, b)))
    end = len(commonprefix((a[start:][::-1], b[start:][::-1])))
    c, d = a[start : len(a) - end], b[start : len(b) - end]
    return max(len(a), len(b)) >= 3 and (max(len(c), len(d)) <= 1 or (len(c) == 2 and c == d[::-1]))
