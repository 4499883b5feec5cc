"""Strings of strangers in every field of every generated file: each format's own parser finds nothing of them outside.

The vehicles and manoeuvres here are built past the checks of `Vehicle`, so that it is the escaping that is tested.
"""

import ast
import copy
import html.parser
import io
import json
import re
import tokenize
import tomllib
import xml.etree.ElementTree as ET
from collections.abc import Callable
from dataclasses import replace
from functools import cache
from typing import Any, ClassVar

import pytest
import yaml
from lupa import lua53

from quadid.experiment import Proposal, manoeuvre_file
from quadid.report.manoeuvres import FORMS, written_as
from quadid.report.page import part, quiet, section
from quadid.report.page import render as page
from quadid.report.programs import FORMATS, export
from quadid.vehicle import Command, FittedFlight, ParameterPrior, Proof, ResidualTerm, Vehicle
from tests.report.manoeuvre_plan import PLAN, SEGMENTS

MARK = "INJECTED"
"""Stands in every hostile string; outside of strings and comments it is never met."""
HOSTILE = {
    "line break": f"x\n{MARK} = 1 --",
    "carriage return": f"x\r{MARK} = 1\r\n{MARK} = 2",
    "line separators": f"x\u2028{MARK} = 1\u2029{MARK} = 2\x85{MARK} = 3\x0b{MARK} = 4\x0c{MARK} = 5\x1c{MARK} = 6",
    "double quote": f'x" {MARK}="1" y="',
    "single quote": f"x' + {MARK} + '",
    "three quotes": f'"""\n{MARK}\n"""',
    "backslash": f'x\\" {MARK} \\',
    "end of a comment": f"x--> <{MARK}/> <!--",
    "hyphens": f"--{MARK}--",
    "long brackets": f"[[x]] {MARK} ]==] --[[ {MARK}",
    "element": f"</comment></model></x><{MARK} a='b'/>",
    "script": f"</script><script>{MARK}()</script>",
    "entity": f"&{MARK}; &#60;{MARK}/&#62; <![CDATA[ ]]><{MARK}/>",
    "template": f"{{{{ {MARK} }}}} {{% for i in {MARK} %}}",
    "placeholder": f"@NAME@ @HEADER@ @SEGMENTS@ @{MARK}@",
    "shell": f"${{{MARK}}} $({MARK}) `{MARK}`",
    "number sign": f"x # {MARK}\n# {MARK}",
    "zero byte": f"x\x00{MARK}",
    "escape sequences": f"\x1b[31m{MARK}\x07\x9b",
    "other direction": f"x\u202e{MARK}\u2066\u200f",
    "encoding": f"coding: utf-7 +AAo-{MARK} = 1",
    "encoding of emacs": f"-*- coding=utf_7 -*- +AAo-{MARK}",
    "yaml": f"x: {{y: [{MARK}]}}\n- !!python/object:os.{MARK} &a *a",
    "toml": f'x]\n[{MARK}]\ny = "',
    "trigraph": f"x\n{MARK} = 1; ????/",
    "tab and comma": f"x\t1\t{MARK},2",
    "surrogate": f"x\ud800\ufffe\uffff{MARK}",
    "format": f"%s %({MARK})s {{0.__class__}} {{{MARK}}}",
    "json": f'x"}}, "{MARK}": {{',
}


def hostile_vehicle(text: str, full_speed: float | None) -> Vehicle:
    """A vehicle with the text in every field that holds a string, or a key; effects where thrust needs none."""
    cross = Vehicle.shipped("pelican_x")

    class Term(ResidualTerm):
        formula: ClassVar[str] = text

    term = Term.model_construct(acts_on="moment_x", product=("p",), value=1.0)
    flight = FittedFlight.model_construct(log=text, seconds=1.0, begin=None, marks=text)
    proof = Proof.model_construct(verdict=text, unseen=(text,), error=2.0, fitted=(flight,))
    sigma = ParameterPrior(initial=2e-5, sigma=1e-7)
    vehicle = Vehicle.model_construct(
        **{
            **{name: getattr(cross, name) for name in Vehicle.model_fields},
            "name": text,
            "mixer": text,
            "columns": {text: text},
            "residual": (term,),
            "proof": proof,
            "correlation": {text: {text: 0.5}},
            "effects": {"motor_lag": {"tau": 0.03}} | ({} if full_speed else {text: {text: 1.0}}),
            "command": Command.model_construct(kind=text, sampling=text, max_speed=full_speed, range=(1000.0, 2000.0)),
            "parameters": {**cross.parameters, "b": sigma},
        }
    )
    return vehicle.with_remark(f"{text}\n{text}")


def check_lua(text: str) -> None:
    loaded = lua53.LuaRuntime(unpack_returned_tuples=True).eval("load")(text)
    assert not isinstance(loaded, tuple), loaded
    assert not set(text) & set("\r\x0b\x0c\x85\u2028\u2029\x00")
    for line in text.split("\n"):
        assert MARK not in re.sub(r'"(\\.|[^"\\])*"', '""', line).split("--")[0]


def check_python(text: str) -> None:
    raw = text.encode()
    assert tokenize.detect_encoding(io.BytesIO(raw).readline)[0] == "utf-8"
    tree = ast.parse(raw)
    names = {n.id for n in ast.walk(tree) if isinstance(n, ast.Name)} | {
        n.attr for n in ast.walk(tree) if isinstance(n, ast.Attribute)
    }
    assert MARK not in names
    assert raw.splitlines() == [line.encode() for line in text.split("\n")[:-1]], "one kind of line break"
    texts = {n.value for n in ast.walk(tree) if isinstance(n, ast.Constant) and isinstance(n.value, str)}
    for one in texts:
        if MARK in one and one not in HOSTILE.values():
            check_yaml(one)  # a whole vehicle file in one string


def check_xml(text: str) -> None:
    root = ET.fromstring(text.encode())
    assert MARK not in {part for element in root.iter() for part in (element.tag, *element.keys())}
    if root.tag == "mujoco":
        mujoco = pytest.importorskip("mujoco", reason="pip install mujoco (extra dev)")
        assert mujoco.MjModel.from_xml_string(text).nu == 4


def elements(text: str) -> list[tuple[str, list[str]]]:
    """Every element of an XML file, with the names of its attributes."""
    return [(e.tag, list(e.keys())) for e in ET.fromstring(text.encode()).iter()]


def check_lines(text: str, form: str, separator: str) -> None:
    assert text.isprintable() or {c for c in text if not c.isprintable()} <= {"\n", "\t"}
    for line in text.split("\n"):
        if line and not line.startswith("#"):
            assert MARK not in line
            assert re.fullmatch(form, line), line
            assert separator in line


def check_code(text: str, sign: str) -> None:
    """Strangers' text stands in comments of one line only."""
    assert text.isprintable() or {c for c in text if not c.isprintable()} == {"\n"}
    for line in text.split("\n"):
        assert MARK not in line.split(sign)[0]
        assert sign == "#" or not re.search(r"(\\|\?\?/)$", line), "the next line would belong to the comment"


def check_json(text: str) -> None:
    data = json.loads(text[text.index("{") :])
    assert set(data) - {"hoverThrOut", "propExpo"} == {"mass", "diagonal_size", "moment_inertia", "num_motors"}
    assert MARK not in json.dumps(data)


def check_toml(text: str) -> None:
    (section,) = tomllib.loads(text).values()
    assert all(isinstance(value, float | int | list) for value in section.values())


def check_yaml(text: str) -> None:
    data = yaml.safe_load(text)
    known = {"mass", "inertia", "tbm_fr", "tbm_bl", "tbm_br", "tbm_fl", "motor_omega_min", "motor_omega_max",
             "motor_tau", "thrust_map", "kappa", "thrust_min", "thrust_max", "rotors_config", "aero_coeff_1",
             "aero_coeff_3", "aero_coeff_h"}  # fmt: skip
    assert set(data) in (
        known,
        {"motor_params", "drag_params", "control_params"},
        {*Vehicle.model_fields}
        - {"reference_voltage", "stabiliser", "mounting", "random", "mass_sigma", "arm_sigma", "thrust_stand"},
    )
    assert all(line[:1] != "#" or line.isprintable() for line in re.split("[\n\r\x85\u2028\u2029]", text))


CHECKS: dict[str, Callable[[str], None]] = {
    ".lua": check_lua,
    ".py": check_python,
    ".sdf": check_xml,
    ".xml": check_xml,
    ".urdf": check_xml,
    ".params": lambda t: check_lines(t, r"1\t1\t[A-Z0-9_]+\t[-+.e\d]+\t[69]", "\t"),
    ".param": lambda t: check_lines(t, r"[A-Z0-9_]+,[-+.e\d]+", ","),
    ".hpp": lambda t: check_code(t, "//"),
    ".usda": lambda t: check_code(t, "#"),
    ".json": check_json,
    ".toml": check_toml,
    ".yaml": check_yaml,
    ".txt": lambda t: check_lines("".join(f"# {line}\n" for line in t.split("\n")), "", ""),
}


def check(ending: str, text: str) -> None:
    CHECKS["." + ending.rpartition(".")[2]](text)


def encodable(text: str) -> str:
    return text.encode("utf-8", "replace").decode()


@cache
def harmless(form: str, full_speed: float | None) -> dict[str, str]:
    """The files of a vehicle whose texts are words."""
    return export(hostile_vehicle("harmless", full_speed), form, "harmless")


@pytest.mark.parametrize("kind", list(HOSTILE))
@pytest.mark.parametrize("form", FORMATS)
@pytest.mark.parametrize("full_speed", [900.0, None])
def test_an_export_holds_strangers_text_as_text(form: str, kind: str, full_speed: float | None) -> None:
    text = HOSTILE[kind]
    if form == "yaml":
        text = encodable(text)
    files = export(hostile_vehicle(text, full_speed), form, text)
    for (ending, content), expected in zip(files.items(), harmless(form, full_speed).values(), strict=True):
        content.encode()
        check(ending, content)
        if CHECKS["." + ending.rpartition(".")[2]] is check_xml:
            assert elements(content) == elements(expected)
        if form == "yaml":
            read = yaml.safe_load(content)
            assert (read["name"], read["columns"], read["mixer"]) == (text, {text: text}, text)


@pytest.mark.parametrize("kind", list(HOSTILE))
@pytest.mark.parametrize("form", list(FORMS))
def test_a_manoeuvre_holds_strangers_text_as_text(form: str, kind: str) -> None:
    text = HOSTILE[kind]
    named = [{**s, "axis": text, "kind": text} for s in PLAN.segments]
    plan = replace(PLAN, vehicle=text, segments=named, promise={text: 0.1}, promise_sweeps={text: 0.1})
    for ending, content in written_as(plan, form, 0.3).items():
        content.encode()
        check(ending, content)


@pytest.mark.parametrize("kind", list(HOSTILE))
def test_a_manoeuvre_file_holds_strangers_text_as_text(kind: str) -> None:
    text = encodable(HOSTILE[kind])
    segment, proposal = copy.copy(SEGMENTS[0]), Proposal.__new__(Proposal)
    object.__setattr__(segment, "axis", text)
    for name, value in (("seconds", 13.0), ("segments", (segment,))):
        object.__setattr__(proposal, name, value)
    read = yaml.safe_load(manoeuvre_file(text, proposal))
    assert (read["vehicle"], set(read)) == (text, {"vehicle", "seconds", "segments"})
    assert {s["axis"] for s in read["segments"]} == {text}


class _Tags(html.parser.HTMLParser):
    def __init__(self) -> None:
        super().__init__()
        self.tags: list[str] = []
        self.keys: set[str] = set()

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append(tag)
        self.keys |= {key for key, _ in attrs}


def tags(text: str) -> _Tags:
    parser = _Tags()
    parser.feed(text)
    return parser


@pytest.mark.parametrize("kind", list(HOSTILE))
def test_a_page_holds_strangers_text_as_text(kind: str) -> None:
    def shown(text: str) -> _Tags:
        verdict = {"level": "good", "headline": text, "details": [text], "next_steps": [text]}
        table: dict[str, Any] = {"kind": "", "head": [text], "rows": [[text]], "classes": [""], "fold": text}
        figure = {
            "id": "f",
            "title": text,
            "caption": text,
            "height": 100,
            "views": [{"label": text, "data": [{"type": "scatter", "name": text, "x": [1.0], "y": [1.0]}]}],
        }
        inner = part(text, text, lines=[text], after=[text], verdict=verdict, kind="finding")
        whole = section("s", text, text, [figure], [table], lines=[quiet(text)], parts=[inner], menu=text)
        return tags(
            page(
                {
                    "title": text,
                    "subtitle": text,
                    "verdict": verdict,
                    "sections": [whole],
                    "warnings": [text],
                    "provenance": [{"name": text, "value": text}],
                }
            )
        )

    plain, evil = shown("text"), shown(HOSTILE[kind])
    quotes = "code" if "`" in HOSTILE[kind] else ""
    assert [t for t in evil.tags if t != quotes] == plain.tags
    assert evil.keys == plain.keys


@pytest.mark.parametrize("text", [t for t in HOSTILE.values() if not t.isprintable()])
@pytest.mark.parametrize("field", ["name", "columns", "keys of columns", "mixer", "proof", "flight"])
def test_a_vehicle_is_not_made_with_text_that_does_not_print(field: str, text: str) -> None:
    fields: dict[str, dict[str, Any]] = {
        "name": {"name": text},
        "columns": {"columns": {"p": text}},
        "keys of columns": {"columns": {text: "p"}},
        "mixer": {"mixer": text},
        "proof": {"proof": {"verdict": "good", "unseen": [text]}},
        "flight": {"proof": {"verdict": "good", "fitted": [{"log": text, "seconds": 1.0}]}},
    }
    with pytest.raises(ValueError, match=r"does not print|unicode"):
        Vehicle.model_validate({**Vehicle.shipped("pelican").model_dump(), **fields[field]})
