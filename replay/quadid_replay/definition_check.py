"""Looks at a ROS message definition from an untrusted log before the library parses it.

The library checks names of constants with a pattern that takes time exponential in their length on some wrong ones
(`A_B__C`), and decodes arrays of messages without fields, which no data bound.
"""

from __future__ import annotations

import re

LONGEST = 1 << 17
"""Characters; the longest definition of a type that is read, with all that it depends on, has some ten thousand."""
MOST_ELEMENTS = 10_000
"""Elements of one array of fixed size."""
_CONSTANT = re.compile(r"[A-Z](_?[A-Z0-9])*")
_SIZE = re.compile(r"\[(?:<=)?(\d+)\]")


class DefinitionError(ValueError):
    """A message definition that no true log holds; says why."""


def check_definition(text: str) -> None:
    """Checks a definition with all that it depends on, sections parted by lines of ``=``.

    Raises:
        DefinitionError: too long, a constant with a wrong name, an array beyond `MOST_ELEMENTS`, no field in a message.
    """
    if len(text) > LONGEST:
        raise DefinitionError(f"{len(text)} characters, at most {LONGEST}")
    fields = 0
    for line in [*text.replace("\t", " ").splitlines(), "==="]:
        bare = line.partition("#")[0].strip()
        if bare.startswith("===") and not bare.strip("="):
            if fields == 0:
                raise DefinitionError("a message without fields")
            fields = 0
        elif bare and not bare.startswith("MSG:"):
            kind, _, rest = bare.partition(" ")
            fields += _check_line(kind, rest)


def _check_line(kind: str, rest: str) -> int:
    """Returns 1 for a field, 0 for a constant."""
    name, constant, _ = rest.partition("=")
    if constant:
        if not _CONSTANT.fullmatch(name.strip()):
            raise DefinitionError("a constant whose name is none")
        return 0
    if any(len(size) > 9 or int(size) > MOST_ELEMENTS for size in _SIZE.findall(kind)):
        raise DefinitionError(f"an array of more than {MOST_ELEMENTS} elements")
    return 1
