"""plotly.js as a page needs it: what its kinds of trace reach, and nothing else.

The Python package brings one bundle with every kind of trace, maps and 3-D included.  To open a page, a browser takes
almost two seconds of processor time for those 4.8 MB; the lines and bars of a report reach a quarter of them.  The
bundle is a chain of modules, ``var name=W((exports,module)=>{...});``, each evaluated when another calls ``name()``,
and a last one that registers the kinds of trace.  Registering fewer, and leaving out modules whose name no remaining
text contains, changes nothing that remains.  A bundle of another form, or a kind of trace that is not found, gives the
whole.
"""

from __future__ import annotations

import re
from functools import lru_cache

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
