"""`quadid health`, `quadid.health` and the health of a fleet: JSON, exit codes, report, recorded flights."""

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_evaluation.studies.health.flights import Wrong, hover
from quadid_replay import write_csv

import quadid
from quadid.app.fleet import Job, identify_one
from quadid.app.fleet_page import BASELINE, FEWEST, health_trend
from quadid.condition import flight_trim
from quadid.condition.trim import flight_to_dict
from quadid.errors import LogError
from quadid.vehicle import Vehicle
from tests.report.test_fleet_page import summed

# --- `quadid health` and `quadid.health`: contract JSON, exit codes, report, and recorded flights


HEALTHY = ("controller_067", "controller_068", "motor_144", "motor_145", "motor_146")
"""Healthy flights of airframe E9, both kinds of log."""


def paths(folder: Path, *names: str) -> list[str]:
    return [str(folder / "crazypad" / f"{name}.usd") for name in names]


def test_a_cut_propeller_is_named_in_the_form_of_the_contract(data_dir: Path, tmp_path: Path) -> None:
    done = quadid.health(paths(data_dir, "controller_055"), paths(data_dir, *HEALTHY), vehicle="crazyflie")
    result = json.loads(done.to_json())
    assert result["schema"] == "quadid.health/1"
    assert (result["verdict"], result["logs"]) == ("changed", ["controller_055.usd"])
    assert len(result["baseline"]) == len(HEALTHY)
    change = result["changes"][0]
    assert change["effect"] == "weak_rotor"
    assert change["p_value"] < 0.01
    numbers = {p["name"]: p for p in change["parameters"]}
    assert (numbers["rotor"]["value"], numbers["rotor"]["ci95"]) == (3, None)
    assert numbers["loss"]["ci95"][0] < numbers["loss"]["value"] < numbers["loss"]["ci95"][1]
    assert change["alternatives"][0]["p_value"] > 0.0
    page = done.report(tmp_path / "health.html").read_text()
    assert 'class="disc damaged"' in page or 'class="disc suspect"' in page
    assert "Next:" in done.text()


def test_a_healthy_flight_of_either_kind_is_unchanged(data_dir: Path) -> None:
    for name in HEALTHY:
        rest = [other for other in HEALTHY if other != name]
        done = quadid.health(paths(data_dir, name), paths(data_dir, *rest), vehicle="crazyflie")
        assert done.result["verdict"] == "unchanged", name


def test_a_flight_is_not_compared_with_itself(data_dir: Path) -> None:
    with pytest.raises(LogError, match="in question and in the baseline"):
        quadid.health(paths(data_dir, "motor_144"), paths(data_dir, *HEALTHY), vehicle="crazyflie")


def test_a_flight_counts_once_whatever_its_file_is_called(data_dir: Path, tmp_path: Path) -> None:
    first, second = paths(data_dir, "motor_144", "motor_145")
    copy = shutil.copy(first, tmp_path / "copy.usd")
    with pytest.raises(LogError, match=r"copy\.usd holds the bytes of motor_144\.usd: .* in question and in the base"):
        quadid.health(first, [copy, second], vehicle="crazyflie")
    with pytest.raises(LogError, match=r"motor_144\.usd is twice in the baseline"):
        quadid.health(second, [first, first], vehicle="crazyflie")
    with pytest.raises(LogError, match=r"motor_144\.usd is twice in the baseline"):
        quadid.health(second, [f"{first}@3:14", f"{first}@12:23"], vehicle="crazyflie")


def test_parts_of_a_flight_are_compared(tmp_path: Path) -> None:
    pelican = Vehicle.shipped("pelican_x")
    write_csv(tmp_path / "a.csv", hover(pelican, seconds=60.0))
    found = quadid.health(tmp_path / "a.csv@33:", tmp_path / "a.csv@:31", vehicle=pelican)
    assert found.result["verdict"] == "unchanged"


def test_one_baseline_is_said_to_be_few(data_dir: Path) -> None:
    done = quadid.health(paths(data_dir, "motor_145"), paths(data_dir, "motor_144"), vehicle="crazyflie")
    assert any("1 baseline flight" in text for text in done.warnings)
    assert done.result["verdict"] == "unchanged"


def test_a_span_outside_the_log_is_named(data_dir: Path) -> None:
    late, healthy = paths(data_dir, "motor_145", "motor_144")
    with pytest.raises(LogError, match="nothing between 5000.0 and 6000.0 s"):
        quadid.health(f"{late}@5000:6000", healthy, vehicle="crazyflie")


# --- The health of a fleet over its flights: the flight after which a propeller was cut stands out, and is named


PELICAN_X = Vehicle.shipped("pelican_x")


def fleet() -> tuple[list[dict[str, Any]], list[dict[str, Any]]]:
    """Rows of the logs and of the trims of two vehicles; a propeller of vehicle a is cut after the seventh flight."""
    logs, trims = [], []
    for unit, cut_after in (("a", 6), ("b", 99)):
        for k in range(9):
            wrong = Wrong({3: 0.25}, {3: 0.25}) if k > cut_after else None
            name = f"{unit}/{k}.mcap"
            flown = flight_trim(hover(PELICAN_X, wrong, seed=17 * k + ord(unit)), PELICAN_X)
            started = 1.7e9 + 86400.0 * k
            logs.append({"name": name, "unit": unit, "started": started, "status": "refused", "reason": "gentle",
                         "dated_by": "log", "mse_initial": None, "mse_fitted": None, "verdict": None})  # fmt: skip
            trims.append({"log": name, "trim": json.dumps(flight_to_dict(flown))})
    return logs, trims


def test_each_flight_is_compared_with_the_first_ones_of_its_vehicle() -> None:
    logs, trims = fleet()
    text = PELICAN_X.to_yaml()
    order = np.random.default_rng(1).permutation(len(logs))
    rows = health_trend([logs[i] for i in order], trims, {"a": text, "b": text})
    assert [row["log"] for row in rows] == [log["name"] for log in logs], "by vehicle, in the order of time"
    assert sum(row["baseline"] for row in rows) == 2 * BASELINE
    changed = [row for row in rows if not row["baseline"] and row["verdict"] == "changed"]
    assert [row["log"] for row in changed] == ["a/7.mcap", "a/8.mcap"]
    assert {row["changes"][0]["parameters"][0]["value"] for row in changed} == {3}
    verdict = summed(logs, [], rows).verdict
    assert verdict.details[0].startswith("a has changed: rotor 3: 2")
    assert not any(text.startswith("b ") for text in verdict.details)
    page = summed(logs, [], rows).page()
    assert "Health over flights" in page
    assert "a/7.mcap" in page


def test_a_flight_that_few_baseline_flights_cannot_judge_is_no_change() -> None:
    logs, _ = fleet()
    row = {"unit": "a", "log": "a/8.mcap", "baseline": False, "verdict": "unknown", "changes": [], "unfamiliar": ""}
    for lacking, changed in ((2, False), (0, True)):
        verdict = summed(logs, [], [{**row, "baseline_lacking": lacking}]).verdict
        assert verdict.headline.endswith("vehicles have changed.") == changed


def test_a_vehicle_with_few_flights_has_no_trend() -> None:
    logs, trims = [], []
    for k in range(FEWEST):
        logs.append({"name": str(k), "unit": "a", "started": float(k)})
        flown = flight_trim(hover(PELICAN_X, seed=k), PELICAN_X)
        trims.append({"log": str(k), "trim": json.dumps(flight_to_dict(flown))})
    assert health_trend(logs, trims, {"a": PELICAN_X.to_yaml()}) == []


def test_a_log_without_a_gyro_has_its_place_in_the_trend(tmp_path: Path) -> None:
    file, text = tmp_path / "a.csv", PELICAN_X.to_yaml()
    write_csv(file, hover(PELICAN_X, Wrong({3: 0.25}, {3: 0.25}), seed=5))
    row = identify_one(Job(str(file), "a/last.mcap", "a", text, file.stat().st_size, 0, "", 50.0, 1, False))
    assert (row["status"], row["reason"][:22]) == ("refused", "a.csv: no gyro in the ")
    logs, trims = fleet()
    trims.append({"log": row["name"], **row["trims"][0]})
    rows = health_trend([*logs, {**row, "started": 1.8e9}], trims, {"a": text})
    assert (rows[-1]["log"], rows[-1]["verdict"]) == ("a/last.mcap", "changed")
    assert "a/last.mcap" in summed([*logs, row], [], rows).page()
