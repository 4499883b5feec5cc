"""plotly.js, shortened: only what the traces reach, the whole where its form is not known."""

from __future__ import annotations

import re

import pytest
from plotly.offline import get_plotlyjs

from quadid.report.page import plotly_source, render, shortened

HEAD = (
    ': this, () => {\n"use strict";var Plotly=(()=>{var L=(e,t)=>()=>(e&&(t=e(e=0)),t);'
    "var C=(e,t)=>()=>(t||e((t={exports:{}}).exports,t),t.exports);"
)
TRACES = {"bar": "_bar", "box": "_box"}
MODULES = "".join(
    f"var {name}=C((a,b)=>{{b.exports={name}Inner()}});"
    f'var {name}Inner=C((a,b)=>{{b.exports={{moduleType:"trace",name:"{kind}",use:{name}Helper()}}}});'
    f"var {name}Helper=C((a,b)=>{{b.exports=1}});"
    for kind, name in TRACES.items()
)
NEWER = "var anchor=C((a,b)=>{b.exports=2});function shape(){}var newer=L(()=>{shape()});"
LAST = (
    "var root=C((a,b)=>{var core=anchor();core.register([_bar(),_box()]);b.exports=core});"
    "return root();})();\nreturn Plotly;\n}));"
)
WHOLE = HEAD + MODULES + NEWER + "var lonely=C((a,b)=>{newer()});" + LAST


def names(text: str | None) -> list[str]:
    """Modules that a bundle has."""
    assert text is not None
    return re.findall(r"var ([\w$]+)=C\(\(a", text)


def test_what_is_not_reached_is_left_out() -> None:
    text = shortened(WHOLE, frozenset({"scatter", "bar"}))
    assert names(text) == ["_bar", "_barInner", "_barHelper", "anchor", "root"]
    assert text is not None
    assert "register([_bar()])" in text
    assert ": this, (() => {" in text
    assert text.endswith("return Plotly;\n})));")


def test_a_module_of_the_newer_kind_stays_while_it_is_called() -> None:
    called = WHOLE.replace("b.exports=1}", "newer()}")
    assert "newer=L(" in str(shortened(called.replace("anchor();", "null;"), frozenset({"bar"})))
    assert "newer=L(" not in str(shortened(WHOLE.replace("anchor();", "null;"), frozenset({"bar"})))


@pytest.mark.parametrize(
    "whole",
    [
        "",
        "var Plotly = {};",
        WHOLE.replace("register", "enlist"),
        WHOLE.replace("exports:{}", "other:{}"),
        WHOLE.replace("return Plotly;", ""),
    ],
)
def test_a_bundle_of_another_form_is_not_touched(whole: str) -> None:
    assert shortened(whole, frozenset({"scatter"})) is None


def test_an_unknown_kind_of_trace_gets_the_whole() -> None:
    assert shortened(WHOLE, frozenset({"surface"})) is None
    assert plotly_source(frozenset({"no such trace"})) == get_plotlyjs()


def test_the_installed_plotly_is_known_and_comes_to_a_third_at_most() -> None:
    whole = get_plotlyjs()
    short = plotly_source(frozenset({"scatter", "bar"}))
    assert len(short) < len(whole) / 3
    assert 'name:"bar"' in short
    assert 'name:"heatmap"' not in short
    assert "Licensed under the MIT license" in short


def test_a_page_carries_what_its_figures_need() -> None:
    def size(kind: str) -> int:
        view = {"label": "", "data": [{"role": "after", "type": kind, "y": [1]}], "layout": {}}
        figure = {"id": "one", "title": "one", "views": [view], "height": 100}
        return len(render({"title": "t", "parameters": [], "parameter_figure": figure}))

    assert size("scatter") < size("bar") < size("heatmap") < size("surface")
