"""One self-contained HTML page from plain data: no request leaves it, and nothing from a log is ever run.

The page carries one copy of plotly.js.  Everything that comes from a log (names, topics, warnings) is escaped by the
template; figure data travel as JSON in a script element that no browser runs, with ``<``, ``>`` and ``&`` escaped.  A
content security policy allows only the page's own two scripts, by hash.
"""

from __future__ import annotations

import base64
import hashlib
import math
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from typing import Any

JsonDict = Mapping[str, Any]


def render(page: JsonDict) -> str:
    """Returns the HTML of a page.

    Args:
        page: what the template shows; absent parts are left out.  ``title``, ``subtitle``, ``verdict`` (of
            `quadid.report.verdict`), ``parameters``, ``parameter_figure``, ``diagnoses``, ``sets``, ``quality``,
            ``noise``, ``warnings``, ``provenance``.
    """
    from jinja2 import Environment, StrictUndefined
    from markupsafe import Markup

    environment = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, lstrip_blocks=True)
    environment.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    environment.filters |= {"number": number, "code": code, "fit": fit}
    scripts = {name: _script(name) for name in ("plotly", "page")}
    policy = " ".join(f"'sha256-{_digest(text)}'" for text in scripts.values())
    template = environment.from_string(_asset("page.html"))
    return template.render(
        page={**_EMPTY, **page},
        figures=all_figures(page),
        style=Markup(_asset("page.css")),
        scripts={name: Markup(text) for name, text in scripts.items()},
        policy=policy,
    )


_EMPTY: dict[str, Any] = {
    "subtitle": "", "verdict": None, "parameters": [], "parameter_figure": None, "diagnoses": [], "sets": [],
    "quality": [], "noise": [], "warnings": [], "provenance": [],
}  # fmt: skip


def all_figures(page: JsonDict) -> dict[str, Any]:
    """Every figure of the page by its identifier."""
    found = [page.get("parameter_figure")]
    parts = list(page.get("sets", ()))
    for diagnosis in page.get("diagnoses", ()):
        parts += [*diagnosis["findings"], *diagnosis["logs"]]
    for part in parts:
        found.extend(part.get("figures", ()))
    return {figure["id"]: figure for figure in found if figure is not None}


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
    return "–" if value is None or not math.isfinite(value) else f"{value:.1f} %".replace("-", "−")


def code(text: str) -> Any:
    """Escaped text in which what stands between backticks is shown as code."""
    from markupsafe import Markup, escape

    parts = text.split("`")
    if len(parts) % 2 == 0:
        return escape(text)
    return Markup("").join(Markup("<code>{}</code>").format(p) if i % 2 else p for i, p in enumerate(parts))


_RAISED = str.maketrans("0123456789-", "⁰¹²³⁴⁵⁶⁷⁸⁹⁻")


@lru_cache(maxsize=4)
def _script(name: str) -> str:
    if name == "plotly":
        from plotly.offline import get_plotlyjs

        text = str(get_plotlyjs())
    else:
        text = _asset(f"{name}.js")
    # Inside a script element this would end it; in a string or comment the escaped form means the same.
    return text.replace("</script", "<\\/script")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@lru_cache(maxsize=4)
def _asset(name: str) -> str:
    return (resources.files("quadid.report") / "assets" / name).read_text(encoding="utf-8")
