"""Figures: what thinning and rounding may not lose."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.estimate.missing import Missing
from quadid.report.figures import (
    BUDGET,
    VISIBLE,
    WHOLE_POINTS,
    channel_figures,
    error_over_time,
    gain_figure,
    liveliest,
    missing_figures,
    parameter_figure,
)
from quadid.report.page import short
from tests.report.test_page import scored


def test_rounding_keeps_a_two_thousandth_of_the_range() -> None:
    values = np.linspace(-3.0, 17.0, 999) * 1e-4
    kept = np.array(short(values), dtype=np.float64)
    assert np.max(np.abs(kept - values)) <= 20e-4 / 2000.0
    assert short(np.array([np.nan, 1.0]))[0] is None
    assert short(np.array([np.nan, np.inf])) == [None, None]


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
    return Missing(t, acted, 0.1 * acted, acted, 0.1 * acted, control, np.zeros((rows, 8)), 10.0, *np.full((2, 6), 0.1),
                   *np.ones((2, rows, 12)))  # fmt: skip


def test_what_is_missing_is_drawn_with_its_band_for_every_model_and_axis() -> None:
    force, moment = missing_figures({"nominal": [missing(0.5)], "extended": [missing(0.001)]}, "m")
    lines = force["views"][0]["data"]
    assert [line["role"] for line in lines] == ["before"] * 3 + ["after"] * 3 + ["before"] * 3 + ["after"] * 3 + [
        "before"] * 3 + ["after"] * 3  # fmt: skip
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
