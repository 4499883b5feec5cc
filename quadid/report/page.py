"""HTML page from plain data, self-contained: no request leaves it, and nothing from a log is ever run."""

import base64
import hashlib
import math
import re
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from quadid.report.templating import environment
from quadid.types import FloatArray, Json, JsonDict

# --- One self-contained HTML page from plain data: no request leaves it, and nothing from a log is ever run
#
# The page carries one copy of plotly.js.  Everything that comes from a log (names,
# topics, warnings) is escaped by the template; figure data travel as JSON in a script element that no browser runs,
# with ``<``, ``>`` and ``&`` escaped.  A content security policy allows only the page's own two scripts, by hash.


def render(page: Json) -> str:
    """Returns the HTML of a page.

    Args:
        page: ``title``, and where there are any ``subtitle``, ``verdict`` (of `quadid.report.verdict`), ``sections``
            (of `section`), ``warnings`` (sentences) and ``provenance`` (rows of name and value), which stand last.
    """
    language = environment("html")
    language.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    language.filters |= {"code": code}
    sections = list(page.get("sections", ()))
    if warnings := page.get("warnings"):
        lines = Markup("").join(Markup("<li>{}</li>").format(code(line)) for line in warnings)
        sections.append(section("warnings", "Warnings", lines=[Markup("<ul>{}</ul>").format(lines)], kind="plain"))
    if rows := page.get("provenance"):
        table = rows_of((), [(row["name"], row["value"]) for row in rows], "", "cards narrow", ("", "wrap"))
        sections.append(section("provenance", "Where this comes from", tables=[table], menu="Provenance"))
    figures = {one["id"]: one for part in sections for one in figures_of(part)}
    plotly = ""
    if figures:  # the bundle that comes with plotly: 4.8 MB a page, for a drawing library that the page need not load
        from plotly.offline import get_plotlyjs

        plotly = get_plotlyjs()
    scripts = {"plotly": closed(plotly), "page": closed(_asset("page.js"))}
    digests = [hashlib.sha256(text.encode()).digest() for text in scripts.values()]
    policy = " ".join(f"'sha256-{base64.b64encode(digest).decode()}'" for digest in digests)
    return language.get_template("page.html.j2").render(
        page={"subtitle": "", "verdict": None, **page, "sections": sections},
        figures=packed(figures),
        style=Markup(_asset("page.css")),
        scripts={name: Markup(text) for name, text in scripts.items()},
        policy=policy,
    )


def figures_of(part: Json) -> Iterator[Json]:
    """Every figure of a section, those of its parts too."""
    yield from part["figures"]
    for inner in part["parts"]:
        yield from figures_of(inner)


PACKED_FROM = 40
"""Rows of numbers at least this long travel packed."""


def packed(value: Any) -> Any:
    """Long rows of numbers as plotly's typed arrays: single precision in base64, NaN for a hole (None)."""
    if isinstance(value, Mapping):
        return {k: packed(v) for k, v in value.items()}
    if not isinstance(value, list | tuple):
        return value
    if len(value) < PACKED_FROM or not all(v is None or isinstance(v, int | float) for v in value):
        return [packed(v) for v in value]
    row = np.array(value, dtype="<f4")
    return {"dtype": "f4", "bdata": base64.b64encode(row.tobytes()).decode()}


def unit(text: str) -> str:
    """A unit with raised powers: ``N s^2/rad^2`` -> ``N s²/rad²``; a dash for none."""
    return raised(text).replace(" ", "\u00a0") or "–"


def raised(text: str) -> str:
    """A text with raised powers in its units."""
    return re.sub(r"\^(-?\d+)", lambda m: m[1].translate(_RAISED), text)


def number(value: float | None, digits: int = 4) -> str:
    """A number for people: `digits` that matter, a real minus, powers of ten written out; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    text = f"{value:.{digits}g}"
    mantissa, _, exponent = text.partition("e")
    if exponent:
        text = f"{mantissa}·10{str(int(exponent)).translate(_RAISED)}"
    return text.replace("-", "−")


def fit(value: float | None) -> str:
    """A fit in per cent with one decimal; a dash for none."""
    if value is None or not math.isfinite(value):
        return "–"
    return f"{round(value, 1) + 0.0:.1f}\u00a0%".replace("-", "−")  # + 0.0: no minus before a zero


def code(text: str) -> Any:
    """Escaped text in which what stands between backticks is shown as code."""
    parts = text.split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else p for i, p in enumerate(parts))


_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


def closed(script: str) -> str:
    """A script that cannot end its element early; in a string or comment the escaped form means the same."""
    return script.replace("</script", "<\\/script")


@lru_cache(maxsize=4)
def _asset(name: str) -> str:
    return (resources.files("quadid.report") / "assets" / name).read_text(encoding="utf-8")


# --- Pieces of a page: sections, tables, and figures as plain Plotly descriptions without colours
#
# The page gives every trace the colour of its role: ``measured``, ``before`` (current parameters), ``after`` (proposed
# ones), ``truth``, ``floor``.


def part(
    title: str = "",
    intro: str = "",
    figures: Sequence[Json] = (),
    tables: Sequence[Json] = (),
    *,
    lines: Sequence[str] = (),
    after: Sequence[str] = (),
    parts: Sequence[Json] = (),
    verdict: Json | None = None,
    picture: str = "",
    kind: str = "",
) -> JsonDict:
    """A part of a section, in the order in which it is shown.

    Args:
        title: heading.
        intro: quiet sentence below it.
        lines: paragraphs.
        verdict: of `quadid.report.verdict`.
        picture: SVG.
        figures: of `figure`.
        tables: of `rows_of`.
        parts: inner parts.
        after: paragraphs at the end.
        kind: ``finding`` for a card, ``open`` or ``folded`` for what can be folded, ``chapter`` for one of several.
    """
    return {
        "title": title,
        "intro": intro,
        "lines": list(filter(None, lines)),
        "verdict": verdict,
        "picture": picture,
        "figures": list(figures),
        "tables": list(tables),
        "parts": list(parts),
        "after": list(filter(None, after)),
        "kind": kind,
    }


def section(
    identifier: str,
    title: str,
    intro: str = "",
    figures: Sequence[Json] = (),
    tables: Sequence[Json] = (),
    *,
    menu: str = "",
    **more: Any,
) -> JsonDict:
    """A section of the page: a `part` with its identifier and its name in the menu.

    It can be folded, and is where `kind` is ``folded``; of kind ``plain`` it cannot.
    """
    return {"id": identifier, "menu": menu or title, **part(title, intro, figures, tables, **more)}


def quiet(text: str, kind: str = "quiet") -> Markup:
    """Text that stands back."""
    return Markup('<span class="{}">{}</span>').format(kind, text)


def rows_of(
    head: Sequence[str],
    rows: Sequence[Sequence[Any]],
    fold: str = "",
    kind: str = "cards",
    classes: Sequence[str] | None = None,
) -> JsonDict:
    """A table; folded under a line where one is given; `classes` are of the cells of each column.

    On a phone each row is a card (`kind` ``cards``, ``cards narrow``), or a line or two (``compact``).
    """
    given = list(classes or ["wrap"] * len(head))
    return {"head": list(head), "rows": [list(row) for row in rows], "fold": fold, "kind": kind, "classes": given}


def measures(head: Sequence[str], rows: Sequence[Sequence[Any]], numbers: Sequence[int]) -> JsonDict:
    """A narrow table in which the columns `numbers`, counted from 0, hold numbers."""
    return rows_of(head, rows, kind="cards narrow", classes=["number" * (i in numbers) for i in range(len(head))])


def figure(
    identifier: str, title: str, data: Sequence[Mapping[str, Any]], layout: JsonDict, height: int, **more: Any
) -> JsonDict:
    """A figure of one view."""
    views = [{"label": "", "data": list(data), "layout": layout}]
    return {"id": identifier, "title": title, "views": views, "height": height, **more}


def axis(text: str, **more: Any) -> JsonDict:
    """An axis with its title."""
    return {"title": {"text": text}, **more}


def stacked(panels: Sequence[tuple[str, JsonDict]], across: str) -> tuple[list[JsonDict], JsonDict]:
    """Panels above each other with one axis across: where the lines of each go, and the layout.

    Args:
        panels: title and further settings of the vertical axis of each.
        across: title of the common axis.
    """
    n = len(panels)
    places = ["" if i == 0 else str(i + 1) for i in range(n)]
    layout = {
        f"yaxis{place}": {"domain": [1.0 - (i + 1) / n + 0.03, 1.0 - i / n - 0.01], **axis(title, **more)}
        for i, (place, (title, more)) in enumerate(zip(places, panels, strict=True))
    }
    layout["xaxis"] = axis(across, anchor=f"y{places[-1]}")
    return [{"xaxis": "x", "yaxis": f"y{place}"} for place in places], layout


def band(role: str, name: str, x: FloatArray, low: FloatArray, high: FloatArray, **where: Any) -> list[JsonDict]:
    """A filled band without an entry in the legend."""
    edge = {**where, "edge": True, "showlegend": False, "hoverinfo": "skip"}
    return [trace(role, name, x, high, **edge), trace(role, name, x, low, fill="tonexty", **edge)]


def upright(x: float) -> JsonDict:
    """An upright line through a figure."""
    return {"type": "line", "x0": x, "x1": x, "y0": 0, "y1": 1, "yref": "paper", "role": "floor"}


def level(y: float) -> JsonDict:
    """A line across a figure at the height that all should keep to."""
    return {"type": "line", "x0": 0, "x1": 1, "xref": "paper", "y0": y, "y1": y, "role": "floor"}


def trace(role: str, name: str, x: FloatArray | None, y: FloatArray, **more: Any) -> JsonDict:
    """One line of a figure; without `x` it takes that of its view."""
    across = {} if x is None else {"x": listed(x)}
    return {"role": role, "name": name, **across, "y": listed(y), "type": "scatter", "mode": "lines", **more}


def listed(values: FloatArray) -> list[float | None]:
    """Numbers (n,) as JSON has them: None where not finite."""
    return [v if math.isfinite(v) else None for v in values.tolist()]
