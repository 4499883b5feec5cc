"""The HTML page: complete in itself, safe against what a log may contain, small; its figures, maps and flight part."""

import base64
import hashlib
import json
import re
from dataclasses import asdict, replace
from enum import StrEnum
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_replay import open_log
from quadid_replay.columns import mode_changes
from quadid_replay.dataflash import ARDUCOPTER

from quadid.data.grid import to_windows
from quadid.data.window import CHANNEL_NAMES, CHANNEL_UNITS, Channel
from quadid.effects import EFFECTS, NEVER
from quadid.estimate.missing import Missing
from quadid.flight import fly
from quadid.identification.result import ChannelScore, ScoredSet, Series, SetScore
from quadid.identification.uncertainty import Excitation
from quadid.jsonable import jsonable
from quadid.model.layout import Layout
from quadid.report.figures import (
    BUDGET,
    PAIRS,
    VISIBLE,
    WHOLE_POINTS,
    ResidualMap,
    channel_figures,
    error_over_time,
    gain_figure,
    liveliest,
    map_figure,
    missing_figures,
    parameter_figure,
    residual_map,
    switched_off,
)
from quadid.report.fit_pages import (
    SHARP,
    chance,
    diagnosis_part,
    excitation_part,
    findings_section,
    flight_section,
    identify_sections,
    mode_rows,
    quality_section,
    spectrum,
)
from quadid.report.page import code, fit, listed, measures, number, packed, part, render
from quadid.report.verdict import identify_verdict
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened

# --- The HTML page: complete in itself, safe against what a log may contain, and small


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
        "schema": "quadid.identify/1",
        "vehicle": EVIL,
        "optimizer": "pso_polish",
        "seed": 1,
        "seconds": 1.0,
        "parameters": parameters,
        "sets": entries,
        "vehicle_file": "/x.yaml",
        "warnings": [EVIL],
    }


def page(sets: list[ScoredSet]) -> str:
    """The page of an identification from logs with nasty names."""
    from quadid.identification.noise import NoiseModel

    quality = [part(EVIL, tables=[measures(("Channel", "Source"), [("gyro", EVIL)], ())], lines=[EVIL])]
    provenance = [{"name": EVIL, "value": EVIL}]
    found = result(sets)
    sections = identify_sections(found, sets, None, [], [quality_section(quality, NoiseModel.guess(9))], {"b": 1.05})
    verdict = asdict(identify_verdict(found))
    return render(
        {"title": EVIL, "verdict": verdict, "sections": sections, "warnings": [EVIL], "provenance": provenance}
    )


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
    assert value["dtype"] == "f4"
    return [None if np.isnan(v) else float(v) for v in np.frombuffer(base64.b64decode(value["bdata"]), dtype="<f4")]


def test_packed_rows_keep_values_and_holes() -> None:
    row = [None if i == 7 else -3.0 + 0.01 * i for i in range(500)]
    back = unpacked(packed({"x": [row]})["x"][0])
    assert back[7] is None
    assert back == [None if v is None else pytest.approx(v, rel=1e-7, abs=1e-7) for v in row]
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
        "effect": "motor_lag",
        "confident": True,
        "p_value": 1e-9,
        "evidence": EVIL,
        "parameters": [{"name": "tau", "unit": "s", "value": 0.05, "ci95": [0.04, None]}],
        "gain": {"mse_before": 3.1, "mse_after": 1.0, "ci95": [1.9, 2.2], "seconds": 4.0},
        "alternatives": [{"effect": "command_delay", "mse_after": 1.3}],
    }
    data = {
        "schema": "quadid.diagnose/1",
        "verdict": "partly_explained",
        "statement": "Some remains.",
        "findings": [finding],
        "validation": {"mse_nominal": 3.1, "mse_extended": 1.0, "noise_floor": 1.0},
        "unexplained": {"p": 0.02},
        "vehicle_file": "/x.yaml",
    }
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


# --- Figures: what thinning may not lose


def test_what_is_not_finite_is_a_hole() -> None:
    assert listed(np.array([np.nan, 1.0, -np.inf])) == [None, 1.0, None]


def test_thinning_keeps_the_peak_of_the_liveliest_channel() -> None:
    log = scored("long", rows=25_000)
    log.fitted.series.measured[12_345, 1] = 40.0
    views = {v["label"]: v for f in channel_figures(log, "x") if f["id"] == "x-rates" for v in f["views"]}
    whole = views["Whole log"]
    assert len(whole["x"]) <= WHOLE_POINTS
    assert max(v for v in whole["data"][3]["y"] if v is not None) == pytest.approx(40.0, abs=0.05)


def test_residuals_are_measured_less_simulated() -> None:
    log = scored("small", rows=100)
    view = next(v for v in channel_figures(log, "x")[0]["views"] if v["label"].startswith("Residual"))
    assert [line["role"] for line in view["data"][:2]] == ["before", "after"]
    after = log.fitted.series
    expected = after.measured[:, 0] - after.simulated[:, 0]
    assert np.asarray(view["data"][1]["y"], dtype=float) == pytest.approx(expected, abs=0.01)


def test_the_spectrum_of_white_residuals_lies_in_its_band_and_that_of_a_tone_does_not() -> None:
    log = scored("tone", rows=10_000)
    log.initial.series.simulated[:, 0] += 3.0 * np.sin(2.0 * np.pi * 5.0 * log.initial.series.t)
    view = channel_figures(log, "x")[0]["views"][-1]
    high, low, before, after = (np.asarray(line["y"], dtype=float) for line in view["data"][:4])
    assert np.mean((low <= after) & (after <= high)) == pytest.approx(0.95, abs=0.08)
    peak = int(np.argmax(before))
    assert view["data"][2]["x"][peak] == pytest.approx(5.0, abs=0.5)
    assert before[peak] > 5.0 * high[peak]


def missing(size: float, rows: int = 100) -> Missing:
    """A stretch on which a model misses a force of this size [N] and as large a moment [N m]."""
    t, acted = 0.02 * np.arange(rows, dtype=np.float64), np.full((rows, 3), size)
    control = np.outer(np.sin(0.3 * np.arange(rows)), np.ones(3))
    return Missing(
        t,
        acted,
        0.1 * acted,
        acted,
        0.1 * acted,
        control,
        np.zeros((rows, 8)),
        10.0,
        *np.full((2, 6), 0.1),
        *np.ones((2, rows, 12)),
    )


def test_what_is_missing_is_drawn_with_its_band_for_every_model_and_axis() -> None:
    force, moment = missing_figures({"nominal": [missing(0.5)], "extended": [missing(0.001)]}, "m")
    lines = force["views"][0]["data"]
    assert [line["role"] for line in lines] == ["before"] * 3 + ["after"] * 3 + ["before"] * 3 + ["after"] * 3 + [
        "before"
    ] * 3 + ["after"] * 3
    upper, lower, value = (np.asarray(line["y"], dtype=float) for line in lines[:3])
    assert value == pytest.approx(0.5)
    assert (upper - lower) / 2.0 == pytest.approx(1.96 * 0.05, rel=0.01)
    assert moment["views"][0]["layout"]["yaxis"]["title"]["text"] == "Mx [N m]"


def test_a_model_that_misses_next_to_nothing_looks_like_it() -> None:
    (force, _) = missing_figures({"nominal": [missing(1e-6)]}, "m")
    low, high = force["views"][0]["layout"]["yaxis2"]["range"]
    assert (low, high) == (-VISIBLE * 10.0, VISIBLE * 10.0)


def test_no_line_bridges_a_gap_of_the_log() -> None:
    (force, _) = missing_figures({"nominal": [missing(0.5, 40), missing(0.5, 40)]}, "m")
    assert force["views"][0]["data"][2]["y"].count(None) == 1


def test_a_runaway_guess_is_clipped_but_marked_by_leaving_the_picture() -> None:
    log = scored("wild")
    log.initial.series.simulated[:] = 1e12
    view = channel_figures(log, "x")[0]["views"][0]
    low, high = view["layout"]["yaxis"]["range"]
    before = view["data"][1]
    assert before["role"] == "before"
    assert min(before["y"]) > high
    assert max(before["y"]) < high + 4.0 * (high - low)


def test_pictures_of_all_logs_share_a_budget() -> None:
    log = scored("long", rows=25_000, channels=15)
    figures = channel_figures(log, "x", logs=4)
    numbers = sum(len(trace["y"]) for f in figures for view in f["views"] for trace in view["data"])
    assert numbers <= BUDGET / 4 * 1.02


def test_liveliest_part_is_where_the_rotation_is() -> None:
    t = 0.02 * np.arange(5000, dtype=np.float64)
    rates = np.where((t[:, None] > 60.0) & (t[:, None] < 70.0), 2.0, 0.1) * np.ones((5000, 3), dtype=np.float64)
    rows = liveliest(t, rates)
    assert t[rows[0]] < 61.0
    assert t[rows[-1]] > 69.0


def test_error_over_time_is_one_for_noise_and_grows_with_error() -> None:
    log = scored("a")
    t, after = error_over_time(log.fitted, log.fitted)
    _, before = error_over_time(log.initial, log.fitted)
    assert (t[0], t[1] - t[0]) == (pytest.approx(100.5), pytest.approx(1.0))
    assert np.mean(after) == pytest.approx(1.0, abs=0.05)
    assert np.mean(before) == pytest.approx(100.0, rel=0.05)


def test_parameter_figure_is_relative_to_the_current_value() -> None:
    parameters = [
        {"name": "b", "value": 3.0, "initial": 2.0, "ci95": [2.8, 3.4]},
        {"name": "d", "value": 1.0, "initial": 0.0, "ci95": [None, None]},
    ]
    view = parameter_figure(parameters, {"b": 3.2})["views"][0]
    after, truth = view["data"][1], view["data"][2]
    assert after["y"] == ["b"]
    assert after["x"] == [pytest.approx(1.5)]
    assert after["error_x"]["array"] == [pytest.approx(0.2)]
    assert after["error_x"]["arrayminus"] == [pytest.approx(0.1)]
    assert truth["x"] == [pytest.approx(1.6)]


def test_gain_figure_names_the_finding_and_its_rivals() -> None:
    rivals = [{"effect": "imu_lag", "mse_after": None}]
    finding = {
        "effect": "motor_lag",
        "gain": {"mse_before": 3.0, "mse_after": 1.0, "seconds": 4.0},
        "alternatives": rivals,
    }
    data = gain_figure(finding, 1.0, "g")["views"][0]["data"]
    assert [(d["y"], d["x"]) for d in data] == [(["imu lag"], [None]), (["motor lag"], [1.0]), (["without it"], [3.0])]


# --- The picture of a cause: where the physics says it shows, as large as that says, and flat once it is modelled


@pytest.fixture(scope="module")
def pelican() -> Vehicle:
    """The Pelican with the true parameters, so that nothing but the effect is missing."""
    from quadid.flight import TruthParameters

    vehicle = Vehicle.shipped("pelican")
    truth = TruthParameters.of(vehicle).as_dict()
    parameters = {n: p.model_copy(update={"initial": truth[n]}) for n, p in vehicle.parameters.items()}
    return vehicle.model_copy(update={"parameters": parameters})


def drawn(
    vehicle: Vehicle,
    effect: str,
    values: dict[str, float],
    names: tuple[str, ...],
    extras: tuple[str, ...] = ("velocity", "position"),
) -> ResidualMap:
    """The map of an effect that a vehicle flew with, at its true values."""
    flight = fly(vehicle, seconds=40.0, seed=8, effects={effect: values}, extras=extras)
    layout = Layout(vehicle)
    theta = layout.initial(vehicle)
    for name in names:
        entry = layout.entry(name)
        theta[entry.index] = values["loss"] if effect == "weak_rotor" else values[name.split(".")[1]]
    found = residual_map(to_windows(flight.recording, vehicle), vehicle, theta, effect, names)
    assert found is not None
    return found


def slope(found: ResidualMap) -> float:
    """Slope of the mean residual without the cause."""
    return float(np.polyfit(found.x, found.before, 1)[0])


def flat(found: ResidualMap) -> bool:
    """Checks whether nearly all bins with the cause hold zero in their interval, widened a little."""
    return bool(np.mean(np.abs(found.after) < 1.7 * found.after_error) > 0.85)


def test_a_lag_is_an_error_in_step_with_angular_acceleration(pelican: Vehicle) -> None:
    found = drawn(pelican, "motor_lag", {"tau": 0.04}, ("motor_lag.tau",))
    assert found.channel in ("p", "q", "r")
    assert "acceleration" in found.against
    # Late by tau: measured - simulated = -tau times the rate of change.
    assert slope(found) == pytest.approx(-0.04, rel=0.15)
    assert flat(found)


@pytest.mark.parametrize("extras", [("velocity", "position"), ()])
def test_drag_is_a_force_in_step_with_speed(pelican: Vehicle, extras: tuple[str, ...]) -> None:
    found = drawn(pelican, "rotor_drag", {"k_x": 0.3, "k_y": 0.3}, ("rotor_drag.k_x", "rotor_drag.k_y"), extras)
    assert (found.channel, found.unit, found.against_unit) in {("a_x", "m/s^2", "m/s"), ("a_y", "m/s^2", "m/s")}
    assert slope(found) == pytest.approx(-0.3, rel=0.15)
    assert flat(found)


def test_a_weak_rotor_is_an_angular_acceleration(pelican: Vehicle) -> None:
    found = drawn(pelican, "weak_rotor", {"rotor": 2.0, "loss": 0.03}, ("weak_rotor.loss_2",))
    assert found.channel == "dp/dt"
    hover, arm, inertia = 1.3 * 9.81 / 4.0, 0.21, pelican.parameters["J_xx"].initial
    assert abs(float(np.median(found.before))) == pytest.approx(0.03 * hover * arm / inertia, rel=0.1)
    assert flat(found)


def test_every_effect_has_its_place_and_every_time_is_switched_off(pelican: Vehicle) -> None:
    assert set(PAIRS) == set(EFFECTS)
    assert all(PAIRS.values())
    layout = Layout(pelican)
    theta = layout.initial(pelican)
    theta[layout.entry("mass_change.time").index] = 12.0
    theta[layout.entry("mass_change.fraction").index] = 0.2
    off = switched_off(layout, theta, "mass_change", ("mass_change.fraction",))
    assert off[layout.entry("mass_change.fraction").index] == 0.0
    assert off[layout.entry("mass_change.time").index] == NEVER
    assert theta[layout.entry("mass_change.time").index] == 12.0


def test_figure_names_quantity_unit_and_both_models() -> None:
    one = np.ones(3)
    found = ResidualMap("a_x", "m/s^2", "forward speed", "m/s", one, one, 0 * one, one, one, 5.0)
    figure = map_figure(found, "x", "rotor drag")
    assert [d["name"] for d in figure["views"][0]["data"]] == ["without rotor drag", "with rotor drag"]
    assert figure["views"][0]["layout"]["xaxis"]["title"]["text"] == "forward speed [m/s]"


def test_a_flight_too_short_has_no_map(pelican: Vehicle) -> None:
    windows = to_windows(fly(pelican, seconds=3.0, seed=1).recording, pelican)
    layout = Layout(pelican)
    assert residual_map(windows, pelican, layout.initial(pelican), "motor_lag", ("motor_lag.tau",)) is None


@pytest.mark.parametrize("extras", [(), ("velocity", "position")])
def test_rotor_drag_is_drawn_against_speed_whether_measured_or_not(pelican: Vehicle, extras: tuple[str, ...]) -> None:
    """In a slow drift time tells as much as speed does, and explains nothing."""
    names = ("rotor_drag.k_x", "rotor_drag.k_y")
    found = drawn(pelican, "rotor_drag", {"k_x": 0.3, "k_y": 0.3}, names, extras)
    assert found.against in ("forward speed", "speed to the right")
    assert slope(found) == pytest.approx(-0.3, rel=0.25)


# --- What a log tells of its flight: modes as logged, and a spectrum that finds what shakes


PELICAN = Vehicle.shipped("pelican")


def test_a_shaking_shows_at_its_frequency_with_its_power() -> None:
    rng = np.random.default_rng(1)
    t = np.arange(0.0, 60.0, 0.005)
    values = rng.normal(0.0, 0.2, (len(t), 3)) + [0.0, 0.0, -9.81]
    values[:, 1] += 0.5 * np.sin(2.0 * np.pi * 31.0 * t)
    found = spectrum(Channel("accel", t, values), ((5.0, 55.0),))
    assert found is not None
    frequency, density = found
    assert frequency[np.argmax(density[:, 1])] == pytest.approx(31.0, abs=0.5)
    near = np.abs(frequency - 31.0) < 2.0
    power = float(np.sum(density[near, 1] ** 2) * np.diff(frequency).mean())
    assert power == pytest.approx(0.5**2 / 2.0, rel=0.1)
    # White noise of 0.2 at 200 Hz: 0.2 / sqrt(100 Hz).
    assert np.median(density[:, 0]) == pytest.approx(0.02, rel=0.1)
    assert spectrum(Channel("accel", t, values), ((5.0, 6.0),)) is None


def test_the_rotors_are_placed_in_it_or_said_to_be_beyond_it() -> None:
    slow = fly(PELICAN, seconds=20.0, seed=3).recording
    section = flight_section(slow, PELICAN, 0)
    assert section is not None
    turns = float(slow.channels["rotor_speed"].values.mean()) / (2.0 * np.pi)
    assert f"turn {turns:.0f} times a second, faster than this log can show (25 Hz)" in section["intro"]
    quick = fly(PELICAN, seconds=20.0, seed=3, log_rate=500.0).recording
    shown = flight_section(quick, PELICAN, 1)
    assert shown is not None
    assert [f["title"] for f in shown["figures"]] == ["Rotor signals", "Vibration in the air"]
    (line,) = shown["figures"][1]["views"][0]["layout"]["shapes"]
    assert line["x0"] == pytest.approx(turns, rel=0.02)
    assert not section["figures"][1]["views"][0]["layout"]["shapes"]


def test_modes_are_told_from_the_first_imu_sample_on() -> None:
    modes = mode_changes(
        np.array([99.0, np.nan, 103.0, 104.0, 110.0]), np.array([0.0, 5.0, 5.0, 5.0, 99.0]), ARDUCOPTER
    )
    assert modes == ((99.0, "Stabilize"), (103.0, "Loiter"), (110.0, "mode 99"))
    t = np.arange(100.0, 120.001, 0.01)
    gyro = Channel("gyro", t, np.zeros((len(t), 3)))
    recording = replace(fly(PELICAN, seconds=2.0, seed=1).recording, channels={"gyro": gyro}, modes=modes)
    assert mode_rows(recording) == [["Stabilize", "0.0", "3.0"], ["Loiter", "3.0", "10.0"], ["mode 99", "10.0", "20.0"]]


@pytest.mark.parametrize(
    ("log", "names"),
    [
        ("ardupilot/log171.bin", {"Loiter", "Acro"}),
        ("px4/ascend_cubeorange_test.ulg", {"Takeoff", "Hold", "Land"}),
        ("nanodrone/square_run1.csv", set()),
    ],
)
def test_recorded_flights(data_dir: Path, log: str, names: set[str]) -> None:
    assert {name for _, name in open_log(data_dir / log).modes} == names


# --- What to fly next: sharp, hidden, coupled and merely short flights get different advice


def advice(bound: list[float], alone: list[float]) -> list[str]:
    """Advice for b, d, J_zz with these bounds."""
    names = ("b", "d", "J_zz")
    found = Excitation(names, np.array(bound), np.array(alone), np.eye(3))
    return [row[3] for row in excitation_part(found, 60.0)["tables"][0]["rows"]]


def test_each_reason_has_its_advice() -> None:
    sharp, hidden, coupled = advice([0.001, np.inf, 0.3], [0.001, np.inf, 0.01])
    assert sharp == "nothing more"
    assert hidden.endswith("this flight does not show it")
    assert "apart from the others" in coupled


def test_a_flight_too_short_says_how_long() -> None:
    short = advice([2 * SHARP, 0.001, 0.001], [2 * SHARP, 0.001, 0.001])[0]
    assert "240 s" in short


def test_nothing_more_when_all_are_sharp() -> None:
    found = Excitation(("b",), np.array([0.001]), np.array([0.001]), np.eye(1))
    assert excitation_part(found, 60.0)["after"]


# --- Results become data that any JSON parser reads


class Word(StrEnum):
    GOOD = "good"


def test_everything_that_results_hold_becomes_plain() -> None:
    value = {
        Word.GOOD: Word.GOOD,
        "path": Path("/a/b"),
        "row": np.array([1.0, np.nan, np.inf]),
        "number": np.float64(2.5),
        "whole": np.int32(7),
        "flag": np.bool_(True),
        "pair": (1, {"inner": float("-inf")}),
        3: None,
    }
    expected = {
        "good": "good",
        "path": "/a/b",
        "row": [1.0, None, None],
        "number": 2.5,
        "whole": 7,
        "flag": True,
        "pair": [1, {"inner": None}],
        "3": None,
    }
    assert jsonable(value) == expected
    assert json.loads(json.dumps(jsonable(value), allow_nan=False)) == expected
