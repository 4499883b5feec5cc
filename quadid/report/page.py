"""HTML page from plain data, self-contained: no request leaves it, and nothing from a log is ever run."""

from __future__ import annotations

import base64
import hashlib
import math
import re
from collections.abc import Mapping
from functools import lru_cache
from importlib import resources
from typing import Any

import numpy as np
from markupsafe import Markup, escape

from quadid.report.templating import environment
from quadid.report.verdict import digits
from quadid.types import Json

# --- One self-contained HTML page from plain data: no request leaves it, and nothing from a log is ever run
#
# The page carries one copy of plotly.js, as far as its figures use it.  Everything that comes from a log (names,
# topics, warnings) is escaped by the template; figure data travel as JSON in a script element that no browser runs,
# with ``<``, ``>`` and ``&`` escaped.  A content security policy allows only the page's own two scripts, by hash.


def render(page: Json) -> str:
    """Returns the HTML of a page.

    Args:
        page: what the template shows; absent parts are left out.  ``title``, ``subtitle``, ``verdict`` (of
            `quadid.report.verdict`), ``parameters``, ``parameter_figure``, ``diagnoses``, ``sets``, ``quality``,
            ``noise``, ``warnings``, ``provenance``.
    """
    language = environment("html")
    language.policies["json.dumps_kwargs"] = {"separators": (",", ":")}
    language.filters |= {"number": number, "code": code, "unit": unit, "digits": digits}
    figures = all_figures(page)
    scripts = {name: closed(text) for name, text in (("plotly", _drawing(figures)), ("page", _asset("page.js")))}
    policy = " ".join(f"'sha256-{_digest(text)}'" for text in scripts.values())
    return language.get_template("page.html.j2").render(
        page={**_EMPTY, **page},
        figures=packed(figures),
        style=Markup(_asset("page.css")),
        scripts={name: Markup(text) for name, text in scripts.items()},
        policy=policy,
    )


_EMPTY: dict[str, Any] = {
    "subtitle": "", "verdict": None, "parameters": [], "parameter_figure": None, "diagnoses": [], "sets": [],
    "sections": [], "excitation": None, "quality": [], "noise": [], "warnings": [], "provenance": [],
}  # fmt: skip


def all_figures(page: Json) -> dict[str, Any]:
    """Every figure of the page by its identifier."""
    found = [page.get("parameter_figure")]
    parts = [*page.get("sets", ()), *page.get("sections", ())]
    for diagnosis in page.get("diagnoses", ()):
        parts += [*diagnosis["findings"], *diagnosis["logs"]]
    for part in parts:
        found.extend(part.get("figures", ()))
    return {figure["id"]: figure for figure in found if figure is not None}


PACKED_FROM = 40
"""Rows of numbers at least this long travel packed."""
_HOLE = -32768


def packed(value: Any) -> Any:
    """Long rows of numbers as 16 bit integers in base64: a third of their size, to a 65000th of their range.

    ``{"i2": text, "low": a, "step": s}`` holds little-endian integers n from 0 to 65000, less 32767: the value is
    a + s (n + 32767); -32768 is a hole (None).
    """
    if isinstance(value, Mapping):
        return {k: packed(v) for k, v in value.items()}
    if not isinstance(value, list | tuple):
        return value
    if len(value) < PACKED_FROM or not all(v is None or isinstance(v, int | float) for v in value):
        return [packed(v) for v in value]
    row = np.array([np.nan if v is None else v for v in value], dtype=np.float64)
    good = np.isfinite(row)
    low, high = (float(row[good].min()), float(row[good].max())) if good.any() else (0.0, 0.0)
    step = (high - low) / 65000.0 or 1.0
    whole = np.full(len(row), _HOLE, dtype="<i2")
    whole[good] = np.rint((row[good] - low) / step).astype(np.int64) - 32767
    return {"i2": base64.b64encode(whole.tobytes()).decode(), "low": low, "step": step}


def unit(text: str) -> str:
    """A unit with raised powers: ``N s^2/rad^2`` -> ``N s²/rad²``; a dash for none."""
    raised = re.sub(r"\^(-?\d+)", lambda m: m[1].translate(_RAISED), text)
    return raised.replace(" ", "\u00a0") or "–"


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


def _drawing(figures: Mapping[str, Any]) -> str:
    views = [view for figure in figures.values() for view in figure["views"]]
    return plotly_source(frozenset(trace.get("type", "scatter") for view in views for trace in view["data"]))


def closed(script: str) -> str:
    """A script that cannot end its element early; in a string or comment the escaped form means the same."""
    return script.replace("</script", "<\\/script")


def _digest(text: str) -> str:
    return base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()


@lru_cache(maxsize=4)
def _asset(name: str) -> str:
    return (resources.files("quadid.report") / "assets" / name).read_text(encoding="utf-8")


# --- Plotly.js as a page needs it: what its kinds of trace reach, and nothing else
#
# The Python package brings one bundle with every kind of trace, maps and 3-D included.  To open a page, a browser
# takes almost two seconds of processor time for those 4.8 MB; the lines and bars of a report reach a quarter of them.
# The bundle is a chain of modules, ``var name=W((exports,module)=>{...});``, each evaluated when another calls
# ``name()``, and a last one that registers the kinds of trace.  Registering fewer, and leaving out modules whose name
# no remaining text contains, changes nothing that remains.  A bundle of another form, or a kind of trace that is not
# found, gives the whole.


CORE = frozenset({"scatter"})
"""Kinds of trace that plotly.js has without registering them."""
# The two ways in which esbuild makes a module wait for its first call; their short names differ between versions.
_COMMON = re.compile(r"([\w$]+)=\(\w,\w\)=>\(\)=>(?:(?!=>).){0,60}?\{exports:\{\}\}")
_LAZY = re.compile(r"([\w$]+)=\([\w,]+\)=>\(\)=>(?:(?!=>).){0,60}?=\w\(\w=0\)")
_REGISTER = re.compile(r"\.register\(\[((?:[\w$]+\(\),?)+)\]\)")
_NAME, _LAST_NAME = re.compile(r"[A-Za-z_$][\w$]*"), re.compile(r"[\w$]+$")
_OPENED, _OPENED_EAGERLY = ': this, () => {\n"use strict";', ': this, (() => {\n"use strict";'
_CLOSED, _CLOSED_EAGERLY = "return Plotly;\n}));", "return Plotly;\n})));"


@lru_cache(maxsize=4)
def plotly_source(kinds: frozenset[str]) -> str:
    """The text of plotly.js for traces of these kinds, or the whole where it cannot be shortened.

    Args:
        kinds: types of the traces, for example ``{"scatter", "bar"}``.
    """
    from plotly.offline import get_plotlyjs

    whole = str(get_plotlyjs())
    return shortened(whole, kinds) or whole


def shortened(whole: str, kinds: frozenset[str]) -> str | None:
    """The bundle with what these kinds of trace reach; None if its form is not the one this module knows.

    Args:
        whole: text of plotly.min.js.
        kinds: types of the traces.
    """
    common, lazy = _COMMON.search(whole), _LAZY.search(whole)
    if common is None or lazy is None or whole.count(_OPENED) != 1 or whole.count(_CLOSED) != 1:
        return None
    head, modules = _modules(whole, common[1])
    found = _REGISTER.search(modules[-1][1]) if modules else None
    if found is None:
        return None
    texts = dict(modules)
    listed = {_kind(name, texts): name for name in _NAME.findall(found[1])}
    if not kinds - CORE <= set(listed):
        return None
    calls = ",".join(f"{listed[kind]}()" for kind in sorted(kinds - CORE))
    modules[-1] = (modules[-1][0], modules[-1][1].replace(found[0], f".register([{calls}])"))
    body = head + "".join(_reached(head, modules, lazy[1]))
    # A function within brackets is compiled once and at once, not first skimmed for its end.
    return body.replace(_OPENED, _OPENED_EAGERLY).replace(_CLOSED, _CLOSED_EAGERLY)


def _modules(whole: str, helper: str) -> tuple[str, list[tuple[str, str]]]:
    """What comes before the modules; then name and text of each, up to the next one."""
    starts = list(re.finditer(rf"var ([\w$]+)={re.escape(helper)}\(", whole))
    places = [m.start() for m in starts] + [len(whole)]
    return whole[: places[0]], [(m[1], whole[m.start() : end]) for m, end in zip(starts, places[1:], strict=True)]


def _kind(name: str, texts: dict[str, str]) -> str:
    """Kind of trace that a registered module brings; the module's own name where it brings none."""
    inner = re.search(r"\.exports=([\w$]+)\(\)\}", texts.get(name, ""))
    kind = re.search(r'moduleType:"trace",name:"(\w+)"', texts.get(inner[1], "")) if inner else None
    return kind[1] if kind else name


def _reached(head: str, modules: list[tuple[str, str]], lazy: str) -> list[str]:
    """Texts of the modules whose names the head, the last module, or another such text contains, in order.

    A module of the newer kind (`lazy`) stands behind one of the older kind and is kept or left out with it.
    """
    texts = [text for _, text in modules]
    before = [(i, part[-40:]) for i, text in enumerate(texts) for part in text.split(f"={lazy}(")[:-1]]
    owner = {found[0]: i for i, part in before if (found := _LAST_NAME.search(part))}
    owner |= {name: i for i, (name, _) in enumerate(modules)}
    keep = {len(texts) - 1}
    waiting = [head, texts[-1]]
    while waiting:
        new = {owner[name] for name in set(_NAME.findall(waiting.pop())) if name in owner} - keep
        keep |= new
        waiting += [texts[i] for i in new]
    return [texts[i] for i in sorted(keep)]
