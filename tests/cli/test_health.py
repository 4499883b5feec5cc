"""`quadid health` and `quadid.health`: contract JSON, exit codes, report, and recorded flights."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from quadid_evaluation.studies.health.flights import hover
from quadid_replay import write_csv

import quadid
from quadid.errors import LogError
from quadid.vehicle import Vehicle

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
