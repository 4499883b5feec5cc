"""Statistics over many flights: drift and outliers are found where they are, and not where they are not."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from quadid.app.fleet_page import DAY, Fleet, summarise
from tests.report.test_page import EVIL


def rows(values: dict[str, np.ndarray], sigma: float = 0.01) -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Logs, one a day for each vehicle, and the parameter b of each, relative to 2e-5."""
    logs, parameters = [], []
    for unit, series in values.items():
        for i, value in enumerate(2e-5 * series):
            name = f"{unit}/{i}.csv"
            logs.append(
                {
                    "name": name,
                    "unit": unit,
                    "status": "done",
                    "reason": "",
                    "started": 1.6e9 + i * DAY,
                    "verdict": None,
                    "dated_by": "log",
                    "mse_initial": 20.0,
                    "mse_fitted": 1.0 + 0.01 * i,
                }
            )
            half = 1.96 * sigma * 2e-5
            parameters.append(
                {
                    "log": name,
                    "parameter": "b",
                    "unit": "N s^2/rad^2",
                    "value": value,
                    "low": value - half,
                    "high": value + half,
                    "status": "identified",
                }
            )
    return logs, parameters


def summed(logs: Sequence[Any], parameters: Sequence[Any], health: Sequence[Any] = ()) -> Fleet:
    """The fleet of these rows."""
    return Fleet({**summarise(logs, parameters, []), "health": list(health)}, logs, parameters)


def test_drift_is_found_with_its_size_and_only_there() -> None:
    rng = np.random.default_rng(3)
    still = 1.0 + 0.01 * rng.standard_normal(60)
    worn = 1.0 - 0.002 * np.arange(60) + 0.01 * rng.standard_normal(60)
    summary = summarise(*rows({"still": still, "worn": worn}), [])
    (drift,) = summary["drifts"]
    assert (drift["unit"], drift["parameter"], drift["flights"]) == ("worn", "b", 60)
    low, high = drift["ci95"]
    assert low < -0.002 / 0.941 < high
    assert drift["change"] == pytest.approx(-0.002 * 59 / 0.941, rel=0.15)


def test_false_alarms_of_drift_and_outliers_are_rare() -> None:
    rng = np.random.default_rng(4)
    drifts = outliers = 0
    for _ in range(60):
        summary = summarise(*rows({"a": 1.0 + 0.01 * rng.standard_normal(25)}), [])
        drifts += len(summary["drifts"])
        outliers += len(summary["outliers"])
    assert drifts <= 3
    assert outliers <= 3


def test_one_flight_far_off_stands_out() -> None:
    series = 1.0 + 0.01 * np.random.default_rng(5).standard_normal(20)
    series[7] = 1.3
    summary = summarise(*rows({"a": series}), [])
    assert [o["log"] for o in summary["outliers"]] == ["a/7.csv"]
    assert summary["outliers"][0]["deviations"] > 10.0


def test_common_findings_count_flights_not_numbers() -> None:
    logs, parameters = rows({"a": np.ones(5)})
    for log in logs:
        log["verdict"] = "explained"
    findings = [
        {"log": f"a/{i}.csv", "effect": "rotor_drag", "confident": 1, "parameter": k, "unit": "1/s", "value": 0.3 + i}
        for i in range(3)
        for k in ("k_x", "k_y")
    ]
    (common,) = summarise(logs, parameters, findings)["common"]
    assert (common["effect"], common["flights"], common["of"], common["median"]) == ("rotor_drag", 3, 5, 1.3)


def test_the_page_is_safe_and_says_what_to_do() -> None:
    logs, parameters = rows({EVIL: np.ones(6)})
    bad = {"name": f"{EVIL}/x.bin", "unit": EVIL, "status": "unreadable", "reason": EVIL, "started": 0.0}
    logs.append({**bad, "verdict": None, "dated_by": EVIL, "mse_initial": None, "mse_fitted": None})
    fleet = summed(logs, parameters)
    verdict = fleet.verdict
    assert verdict.headline == "6 of 7 logs gave parameters."
    assert any("quadid inspect" in step for step in verdict.next_steps)
    html = fleet.page(EVIL)
    assert "<script>alert(1)" not in html
    assert len(html) < 6_000_000
    for part in ("Parameters over time", "Vehicles", "Logs without an answer"):
        assert part in html


def test_every_log_is_named_with_its_error_and_whose_date_it_has() -> None:
    logs, parameters = rows({"a": np.ones(3)})
    broken = {
        **logs[1],
        "status": "unreadable",
        "reason": "empty",
        "dated_by": "file",
        "mse_initial": None,
        "mse_fitted": None,
    }
    logs[1] = broken
    (section,) = [s for s in summed(logs, parameters).sections() if s["id"] == "logs"]
    table = {row[0]: row for row in section["tables"][0]["rows"]}
    assert list(table) == ["a/1.csv", "a/2.csv", "a/0.csv"]
    assert table["a/2.csv"][1:3] == ["done", "20 → 1.02"]
    assert table["a/0.csv"][3] == "2020-09-13 12:26 (log)"
    assert table["a/1.csv"][1:3] == ["unreadable", "–"]
    assert table["a/1.csv"][3].endswith("(file)")
    assert section["tables"][0]["fold"] == "a: 3 logs"


def test_a_fleet_of_bad_fits_is_not_green() -> None:
    logs, parameters = rows({"a": np.ones(3)})
    assert summed(logs, parameters).verdict.level == "good"
    for log in logs:
        log["mse_fitted"] = 50.0
    verdict = summed(logs, parameters).verdict
    assert verdict.level == "poor"
    assert "3 answers miss much of their flights" in verdict.details[0]


def test_flights_are_counted_where_dates_are_those_of_copies() -> None:
    logs, parameters = rows({"a": np.ones(3)})
    for log in logs:
        log |= {"dated_by": "file", "started": 1.6e9}
    logs.append({**logs[0], "name": "a/-.csv", "status": "unreadable"})
    (section,) = [s for s in summed(logs, parameters).sections() if s["id"] == "over-time"]
    assert "counted" in section["intro"]
    assert [trace["x"] for trace in section["figures"][0]["views"][0]["data"]] == [[1, 2, 3]]
