"""The HTML page: complete in itself, safe against what a log may contain, and small."""

from __future__ import annotations

import base64
import hashlib
import json
import re
from html.parser import HTMLParser
from typing import Any

import numpy as np
import pytest

from quadid.identification.result import ScoredSet
from quadid.identification.score import ChannelScore, Series, SetScore
from quadid.model.rollout import CHANNEL_NAMES, CHANNEL_UNITS
from quadid.report.fit_pages import chance, diagnosis_part, findings_section, identify_page
from quadid.report.page import code, fit, measures, number, packed, part, render
from tests.faults.evidence import Happened

EVIL = "<script>alert(1)</script>\"'&</title>`rm`{{7*7}}"


def scored(name: str, rows: int = 3000, channels: int = 9, seed: int = 0) -> ScoredSet:
    """A log with made-up scores."""
    rng = np.random.default_rng(seed)
    t = 100.0 + 0.02 * np.arange(rows)
    measured = np.sin(t[:, None] * np.arange(1, channels + 1)) + 0.05 * rng.standard_normal((rows, channels))

    def one(error: float) -> SetScore:
        series = Series(
            np.asarray(t, dtype=np.float64),
            measured,
            measured + error * rng.standard_normal(measured.shape),
            np.full(channels, 0.05),
        )
        entries = tuple(
            ChannelScore(n, u, (error / 0.05) ** 2, error, 90.0, rows)
            for n, u in zip(CHANNEL_NAMES[:channels], CHANNEL_UNITS, strict=False)
        )
        return SetScore((error / 0.05) ** 2, entries, series)

    return ScoredSet(name, "train" if seed == 0 else "validate", one(0.5), one(0.05))


def result(sets: list[ScoredSet]) -> dict[str, Any]:
    """An identification's dictionary for `sets`."""
    names = ("b", "d", "J_xx", "J_yy", "J_zz", "J_r")
    status = ("identified", "ratio_only", "identified", "identified", "prior_dominated", "identified")
    parameters = []
    for i, (name, word) in enumerate(zip(names, status, strict=True)):
        entry = {"name": name, "unit": "kg m^2", "value": 1.1, "ci95": [1.0, 1.2], "initial": 1.0, "status": word}
        parameters.append(entry | ({"relative_to": "J_zz"} if i == 1 else {}))
    entries = [
        {
            "log": s.log,
            "role": s.role,
            "mse": {"initial": 100.0, "fitted": 1.0, "noise_floor": 1.0},
            "mse_paper": None,
            "fit_percent": {c.name: c.fit_percent for c in s.fitted.channels},
            "rmse": {c.name: {"value": c.rmse, "unit": c.unit} for c in s.fitted.channels},
        }
        for s in sets
    ]
    return {
        "schema": "quadid.identify/1", "vehicle": EVIL, "optimizer": "pso_polish", "seed": 1, "seconds": 1.0,
        "parameters": parameters, "sets": entries, "vehicle_file": "/x.yaml", "warnings": [EVIL],
    }  # fmt: skip


def page(sets: list[ScoredSet]) -> str:
    """The page of an identification from logs with nasty names."""
    from quadid.identification.noise import NoiseModel

    quality = [part(EVIL, tables=[measures(("Channel", "Source"), [("gyro", EVIL)], ())], lines=[EVIL])]
    provenance = [{"name": EVIL, "value": EVIL}]
    return render(identify_page(result(sets), sets, NoiseModel.guess(9), quality, provenance, {"b": 1.05}))


class Reader(HTMLParser):
    """Collects elements, scripts and visible text."""

    def __init__(self) -> None:
        super().__init__()
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.scripts: list[tuple[str | None, str]] = []
        self.text = ""
        self.inside = False

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        self.tags.append((tag, dict(attrs)))
        self.inside = tag == "script"
        if self.inside:
            self.scripts.append((dict(attrs).get("type"), ""))

    def handle_endtag(self, tag: str) -> None:
        self.inside = False

    def handle_data(self, data: str) -> None:
        if self.inside:
            kind, text = self.scripts[-1]
            self.scripts[-1] = (kind, text + data)
        else:
            self.text += data


@pytest.fixture(scope="module")
def html() -> str:
    """A page of two logs."""
    return page([scored(EVIL), scored("b.csv", seed=1)])


@pytest.fixture(scope="module")
def read(html: str) -> Reader:
    """The page, parsed."""
    reader = Reader()
    reader.feed(html)
    return reader


def test_nothing_from_a_log_becomes_markup(read: Reader, happened: Happened) -> None:
    assert [kind for kind, _ in read.scripts] == ["application/json", None, None]
    assert read.text.count("<script>alert(1)</script>") > 5  # shown as text
    assert "{{7*7}}" in read.text
    assert [tag for tag, _ in read.tags].count("title") == 1
    happened(20, "script tags and template marks as log name: shown as text in the report, no element made of them")


def test_policy_allows_exactly_the_two_scripts(read: Reader) -> None:
    (policy,) = (a["content"] for tag, a in read.tags if tag == "meta" and "http-equiv" in a)
    assert policy is not None
    allowed = re.search(r"script-src ([^;]*)", policy)
    assert allowed is not None
    digests = [base64.b64encode(hashlib.sha256(t.encode()).digest()).decode() for k, t in read.scripts if k is None]
    assert allowed[1].split() == [f"'sha256-{d}'" for d in digests]
    assert "default-src 'none'" in policy
    assert not any(tag in ("link", "img", "iframe", "object") for tag, _ in read.tags)
    assert not any(name.startswith("on") or name == "src" for _, a in read.tags for name in a)
    assert all(str(a["href"]).startswith("#") for _, a in read.tags if "href" in a)


def test_figures_are_data_and_each_has_its_place(read: Reader) -> None:
    figures = json.loads(read.scripts[0][1])
    places = [str(a["data-figure"]) for tag, a in read.tags if tag == "div" and a.get("class") == "plot"]
    assert sorted(places) == sorted(figures)
    assert {"parameters", "log0-rates", "log1-attitude", "log0-error"} <= set(figures)
    for figure in figures.values():
        for view in figure["views"]:
            for trace in view["data"]:
                x = trace.get("x", view.get("x"))
                assert len(unpacked(x)) == len(unpacked(trace["y"]))


def unpacked(value: Any) -> list[Any]:
    """A row of numbers as the page reads it."""
    if isinstance(value, list):
        return value
    whole = np.frombuffer(base64.b64decode(value["i2"]), dtype="<i2").astype(float)
    return [None if n == -32768 else value["low"] + value["step"] * (n + 32767) for n in whole]


def test_packed_rows_keep_values_and_holes() -> None:
    row = [None if i == 7 else -3.0 + 0.01 * i for i in range(500)]
    back = unpacked(packed({"x": [row]})["x"][0])
    assert back[7] is None
    assert back == [None if v is None else pytest.approx(v, abs=5.0 / 65000.0) for v in row]
    assert unpacked(packed([2.5] * 50)) == [2.5] * 50
    assert unpacked(packed([None] * 50)) == [None] * 50
    assert packed(["a"] * 50) == ["a"] * 50
    assert packed([1, 2]) == [1, 2]


def test_headline_parameters_units_and_advice_are_there(read: Reader) -> None:
    for expected in (
        "4 of 6 parameters identified",
        "quick yaw doublets",
        "kg\u00a0m²",
        "only its ratio to J_zz",
        "Truth",
        "1.05",
    ):
        assert expected in read.text


@pytest.mark.parametrize(("logs", "rows", "channels"), [(6, 25_000, 9), (4, 25_000, 15)])
def test_long_flights_and_many_logs_stay_below_six_megabytes(logs: int, rows: int, channels: int) -> None:
    text = page([scored(f"{i}.csv", rows, channels, i) for i in range(logs)])
    assert len(text.encode()) < 6_000_000


def test_diagnosis_part_shows_findings_and_what_remains() -> None:
    finding = {
        "effect": "motor_lag", "confident": True, "p_value": 1e-9, "evidence": EVIL,
        "parameters": [{"name": "tau", "unit": "s", "value": 0.05, "ci95": [0.04, None]}],
        "gain": {"mse_before": 3.1, "mse_after": 1.0, "ci95": [1.9, 2.2], "seconds": 4.0},
        "alternatives": [{"effect": "command_delay", "mse_after": 1.3}],
    }  # fmt: skip
    data = {
        "schema": "quadid.diagnose/1", "verdict": "partly_explained", "statement": "Some remains.",
        "findings": [finding],
        "validation": {"mse_nominal": 3.1, "mse_extended": 1.0, "noise_floor": 1.0}, "unexplained": {"p": 0.02},
        "vehicle_file": "/x.yaml",
    }  # fmt: skip
    reader = Reader()
    reader.feed(
        render({"title": "t", "sections": [findings_section([diagnosis_part(data, [scored("a")], "d", EVIL, EVIL)])]})
    )
    for expected in (
        "Found: motor lag",
        "0.05",
        "a controller can compensate it",
        "Validation error with and without it",
        "2 %",
        "95 % interval 1.9 to 2.2",
        "32 % without motor lag",
        "command delay (1.3)",
        "error is in p",
    ):
        assert expected in reader.text
    assert len(reader.scripts) == 3


@pytest.mark.parametrize(
    ("value", "text"),
    [
        (2.33e-5, "2.33·10⁻⁵"),
        (-0.5, "−0.5"),
        (None, "–"),
        (float("nan"), "–"),
        (float("inf"), "–"),
        (1e9, "1·10⁹"),
        (0.0, "0"),
    ],
)
def test_numbers_for_people(value: float | None, text: str) -> None:
    assert number(value) == text


@pytest.mark.parametrize(
    ("value", "text"), [(-0.04, "0.0\u00a0%"), (-3.0, "−3.0\u00a0%"), (97.16, "97.2\u00a0%"), (None, "–")]
)
def test_fit_in_per_cent(value: float | None, text: str) -> None:
    assert fit(value) == text


def test_code_between_backticks() -> None:
    assert str(code("see `a <b>` & c")) == "see <code>a &lt;b&gt;</code> &amp; c"
    assert str(code("one ` alone <")) == "one ` alone &lt;"


def test_a_chance_claims_no_more_than_its_distribution_holds() -> None:
    assert chance(0.012) == "p = 0.012"
    assert chance(1e-300) == chance(0.0) == "p < 1e-9"
