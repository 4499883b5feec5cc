"""Text in other languages from Jinja templates; what strangers named stays in the string or comment it is put into.

Numbers and plain words are written as they are.  Any other text needs a filter of the file's language, ``comment`` or
``literal``; without one the template fails, but for XML and HTML, where all text is escaped.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping
from functools import cache
from typing import TYPE_CHECKING, Any, NamedTuple

from markupsafe import Markup, escape

from quadid.sanitise import LONGEST_LINE, plain

if TYPE_CHECKING:
    from jinja2 import Environment

_WORD = re.compile(r"(?:[+-]?[\w.]+(?:[+-][\w.]+)*)?", re.ASCII)


def number(value: float) -> str:
    """A number with eight digits, never minus zero."""
    return f"{float(value) + 0.0:.8g}"


def yaml_number(value: float) -> str:
    """A number that every YAML reader takes for one: 2.0e-05, since 2e-05 is text to YAML 1.1."""
    mantissa, e, exponent = number(value).partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"


def _word(value: str) -> Markup:
    if not _WORD.fullmatch(value):
        raise ValueError(f"{value[:40]!r} is written without a filter of its language; fix: comment or literal")
    return Markup(value)


def _no_literal(text: str) -> str:
    raise ValueError(f"{text[:40]!r}: files of this kind hold no strings")


def _lua_literal(text: str) -> str:
    kept = (chr(c) if 32 <= c < 127 and c not in b'"\\' else f"\\{c:03d}" for c in text.encode("utf-8", "replace"))
    return f'"{"".join(kept)}"'


def _python_literal(text: str) -> str:
    return f'"{ascii(text)[1:-1]}"' if '"' not in text and "'" not in text else ascii(text)


class _Language(NamedTuple):
    """A language of files.

    Attributes:
        comment: what may not stand in a comment, as a regular expression, and what replaces it.
        literal: a string with its quotes.
        bare: text without either.
    """

    comment: tuple[str, str] = ("$^", "")
    literal: Callable[[str], str] = _no_literal
    bare: Callable[[str], Markup] = _word
    number: Callable[[float], str] = number


_LANGUAGES = {
    "html": _Language(bare=escape, number=str),
    "yaml": _Language(number=yaml_number),
    "lua": _Language(literal=_lua_literal),
    # In its first two lines Python takes ``coding: NAME`` for the encoding of what follows.
    "py": _Language((r"coding(?=[:=])", "coding "), _python_literal),
    # SITL takes the first brace for the beginning of its JSON.
    "json": _Language((r"[{}]", "|")),
    # A backslash, or what once stood for one, at the end of a line would take the next one into the comment.
    "hpp": _Language((r"\\|\?+/", "/")),
    # Two hyphens end a comment of XML.
    "xml": _Language((r"-(?=-)", "- "), bare=lambda text: escape(plain(text, LONGEST_LINE))),
}
_LANGUAGES |= dict.fromkeys(("sdf", "urdf", "svg"), _LANGUAGES["xml"])
"""By the ending of a template's name; any other ending has line comments and numbers only."""


def render(template: str, facts: Mapping[str, Any]) -> str:
    """Returns the text of ``templates/TEMPLATE.j2`` for these facts.

    Raises:
        ValueError: a template that writes text without the filter of its language.
    """
    return environment(template.rpartition(".")[2]).get_template(f"{template}.j2").render(facts)


@cache
def environment(ending: str) -> Environment:
    """Templates of the language with that ending."""
    from jinja2 import Environment, PackageLoader, StrictUndefined, Undefined

    language = _LANGUAGES.get(ending, _Language())

    def written(value: Any) -> Any:
        """Text of a value; escaped or filtered text stays as it is."""
        if isinstance(value, Markup | Undefined):
            return value
        return language.bare(value if isinstance(value, str) else language.number(value))

    def row(values: Iterable[Any], separator: str = ", ") -> Markup:
        return Markup(separator).join(map(written, values))

    out = Environment(
        autoescape=True,
        finalize=written,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
        loader=PackageLoader("quadid.report"),
    )
    out.filters |= {
        "comment": lambda text: Markup(re.sub(*language.comment, plain(str(text), LONGEST_LINE))),
        "literal": lambda text: Markup(language.literal(str(text))),
        "digits": lambda value, digits: Markup(f"{float(value) + 0.0:.{digits}g}"),
        "row": row,
        "matrix": lambda values: Markup(f"[{row(Markup(f'[{row(line)}]') for line in values)}]"),
    }
    return out
