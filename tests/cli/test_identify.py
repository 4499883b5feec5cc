"""`quadid identify` from logs to JSON, vehicle file and report."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadid.parameters import NOMINAL_NAMES, NOMINAL_UNITS
from quadid.vehicle import Vehicle
from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, Run


@pytest.fixture(scope="module")
def done(quadid: Cli, flights: Flights, tmp_path_factory: pytest.TempPathFactory) -> tuple[Run, dict[str, Any], Path]:
    """One identification with everything written: the run, its JSON, its folder."""
    out = tmp_path_factory.mktemp("identify")
    run = quadid(
        "identify", flights.train, "--validate", flights.unseen, "--vehicle", "pelican", "--out", "made", "--json",
        "result.json", "--report", "report.html", cwd=out,
    )  # fmt: skip
    return run, json.loads((out / "result.json").read_text(encoding="utf-8")), out


def test_json_has_exactly_the_keys_of_the_contract(done: tuple[Run, dict[str, Any], Path]) -> None:
    run, result, out = done
    assert run.code == 0, run.err
    keys = ["schema", "vehicle", "optimizer", "seed", "seconds", "parameters", "sets", "vehicle_file", "warnings"]
    assert list(result) == [*keys, "missing", "verdict", "report"]
    assert (result["schema"], result["vehicle"], result["optimizer"]) == ("quadid.identify/1", "pelican", "pso_polish")
    assert 0.0 < result["seconds"] < 300.0
    for p in result["parameters"]:
        assert list(p) == ["name", "unit", "value", "ci95", "initial", "status", "prior_share", "measured_before"]
        assert p["unit"] == NOMINAL_UNITS[p["name"]]
    assert [s["role"] for s in result["sets"]] == ["train", "validate"]
    assert [s["log"] for s in result["sets"]] == ["train.mcap", "unseen.csv"]
    for s in result["sets"]:
        assert list(s) == ["log", "role", "mse", "mse_paper", "fit_percent", "rmse", "seconds"]
        assert list(s["mse"]) == ["initial", "fitted", "noise_floor"]
        # the log holds references, so the stabiliser's gains are found and the paper's simulation can be run
        assert 0.0 < s["mse_paper"]["fitted"] < s["mse_paper"]["initial"]
        assert list(s["rmse"]["p"]) == ["value", "unit"]
    assert list(result["sets"][0]["fit_percent"])[:9] == ["p", "q", "r", "phi", "theta", "psi", "a_x", "a_y", "a_z"]
    assert Path(result["report"]) == (out / "report.html").resolve()


def test_the_truth_is_found(done: tuple[Run, dict[str, Any], Path], flights: Flights) -> None:
    truth = flights.train_flight.truth.parameters.as_dict()
    for p in done[1]["parameters"]:
        assert p["status"] == "identified"
        # ci95 holds 1.96 sigma; 3.5 sigma are left for bad luck.
        reach = 3.5 / 1.96 * 0.5 * (p["ci95"][1] - p["ci95"][0])
        assert abs(p["value"] - truth[p["name"]]) < reach, p
        assert reach / p["value"] < 0.15


def test_scores_reach_the_noise_floor_on_both_logs(done: tuple[Run, dict[str, Any], Path]) -> None:
    for s in done[1]["sets"]:
        assert 0.85 < s["mse"]["fitted"] < 1.15
        assert s["mse"]["initial"] > 5.0
        assert min(s["fit_percent"][n] for n in ("p", "q", "r", "phi", "theta", "psi")) > 85.0
        assert s["rmse"]["p"] == {"value": pytest.approx(0.02, rel=0.2), "unit": "rad/s"}


def test_vehicle_file_holds_the_fit_and_can_be_used(
    done: tuple[Run, dict[str, Any], Path], inside: Cli, flights: Flights
) -> None:
    _, result, out = done
    path = Path(result["vehicle_file"])
    assert path.is_absolute()
    assert path == (out / "made" / "pelican.fitted.yaml").resolve()
    text = path.read_text(encoding="utf-8")
    assert re.search(r"# +train\.mcap +sha256 [0-9a-f]{64}", text)
    fitted = Vehicle.from_yaml(text)
    for p in result["parameters"]:
        prior = fitted.parameters[p["name"]]
        assert prior.initial == pytest.approx(p["value"], rel=1e-6)
        assert prior.sigma is not None
        assert math.log(p["ci95"][1] / p["value"]) == pytest.approx(1.96 * prior.sigma / prior.initial, rel=1e-3)
    assert fitted.parameters["b"].bounds == Vehicle.shipped("pelican").parameters["b"].bounds
    before = inside("score", flights.unseen, "--vehicle", "pelican", "--json", "-").data
    after = inside("score", flights.unseen, "--vehicle", path, "--json", "-").data
    assert after["horizons"]["50"]["rate"] < 0.3 * before["horizons"]["50"]["rate"]


def test_people_get_tables_with_units_and_no_control_characters(done: tuple[Run, dict[str, Any], Path]) -> None:
    run = done[0]
    assert "\x1b" not in run.out + run.err
    assert run.err.replace("warning: ", "").count("\r") == 0
    for expected in (
        "N s^2/rad^2",
        "kg m^2",
        "95 % interval",
        "train.mcap",
        "All 6 parameters identified",
        "Vehicle file: /",
    ):
        assert expected in run.out


def test_report_is_one_file_that_asks_for_nothing(done: tuple[Run, dict[str, Any], Path]) -> None:
    page = (done[2] / "report.html").read_bytes()
    assert len(page) < 6_000_000
    text = page.decode("utf-8")
    body = re.sub(r"<script>.*?</script>", "", text, flags=re.S)
    assert not re.search(r"""(src|href|action)\s*=\s*["']?(https?:)?//""", body)
    assert "default-src 'none'" in body
    for expected in ("All 6 parameters identified", "sha256", "quadid identify", "seed", "train.mcap", "unseen.csv"):
        assert expected in body


def test_same_seed_same_answer_and_stdout_is_json_alone(
    done: tuple[Run, dict[str, Any], Path], quadid: Cli, flights: Flights, tmp_path: Path
) -> None:
    run = quadid("identify", flights.train, "--vehicle", "pelican", "--out", tmp_path, "--json", "-")
    assert run.code == 0
    assert run.data["parameters"] == done[1]["parameters"]
    assert "report" not in run.data


def test_nothing_but_the_guess_is_exit_3_and_still_written(inside: Cli, tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    n = 600
    names = ["t", "p", "q", "r", "w1", "w2", "w3", "w4"]
    rows = np.column_stack([0.02 * np.arange(n), 0.02 * rng.standard_normal((n, 3)), np.full((n, 4), 400.0)])
    log = write_table(tmp_path / "still.csv", names, rows)
    run = inside("identify", log, "--vehicle", "pelican", "--out", tmp_path, "--json", tmp_path / "r.json")
    assert run.code == 3
    assert "reveal no parameter" in run.err
    assert "Traceback" not in run.err
    result = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert {p["status"] for p in result["parameters"]} == {"prior_dominated"}
    assert Path(result["vehicle_file"]).is_file()


def test_a_span_of_a_log(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    log = f"{flights.train}@5:20"
    run = inside(
        "identify", log, "--vehicle", "pelican", "--out", tmp_path, "--json", "-", "--optimizer", "least_squares"
    )
    assert run.code == 0
    assert run.data["optimizer"] == "least_squares"
    assert [p["name"] for p in run.data["parameters"]] == list(NOMINAL_NAMES)
    bad = inside("identify", f"{flights.train}@50:60", "--vehicle", "pelican", "--out", tmp_path)
    assert bad.code == 2
    assert "nothing to use between" in bad.err


def test_no_velocity_needed_for_rates(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    names, rows = table(flights.unseen)
    keep = [names.index(n) for n in ("t", "p", "q", "r", "w1", "w2", "w3", "w4")]
    log = write_table(tmp_path / "gyro_only.csv", [names[i] for i in keep], rows[:, keep])
    result = inside("score", log, "--vehicle", "pelican", "--json", "-").data
    assert result["horizons"]["10"]["rate"] > 0.0
    assert result["horizons"]["10"] == {
        **result["horizons"]["10"],
        "position": None,
        "velocity": None,
        "rotation": None,
    }


def test_a_rotor_signal_too_slow_for_inertias_tells_thrust_alone(inside: Cli, data_dir: Path, tmp_path: Path) -> None:
    """Ten motor commands a second: thrust yes, inertia no."""
    vehicle = Path(__file__).parents[2] / "evaluation" / "quadid_evaluation" / "studies" / "vehicles" / "ascend.yaml"
    # A flight of a real PX4 without the setpoints of torque, from which its motors would be known at 50 Hz.
    whole = (data_dir / "px4" / "ascend_cubeorange_test.ulg").read_bytes()
    log = tmp_path / "slow.ulg"
    log.write_bytes(whole.replace(b"vehicle_torque_setpoint", b"vehicle_other_setpoints"))
    run = inside("identify", log, "--vehicle", vehicle, "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    status = {p["name"]: p["status"] for p in run.data["parameters"]}
    assert status.pop("b") == "identified"
    assert set(status.values()) == {"prior_dominated"}
    for p in run.data["parameters"][1:]:
        assert p["value"] == p["initial"]
        assert p["ci95"][0] < 0.5 * p["value"]
    assert any("d, J_xx, J_yy, J_zz, J_r: the vehicle file's values are kept" in w for w in run.data["warnings"])
    assert "rotor signal at 10 Hz is too slow, 30 Hz needed" in run.err


def test_what_rests_on_a_bound_is_not_identified(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    pelican = Vehicle.shipped("pelican")
    narrow = {**pelican.parameters}
    value = 3.0 * flights.train_flight.truth.parameters.as_dict()["J_xx"]
    narrow["J_xx"] = narrow["J_xx"].model_copy(update={"initial": value, "bounds": (0.7 * value, 1.5 * value)})
    file = tmp_path / "narrow.yaml"
    file.write_text(pelican.model_copy(update={"parameters": narrow}).to_yaml(), encoding="utf-8")
    run = inside("identify", flights.train, "--vehicle", file, "--out", tmp_path, "--json", "-")
    by_name = {p["name"]: p for p in run.data["parameters"]}
    assert by_name["J_xx"]["status"] == "unreliable"
    assert any(w.startswith("J_xx = ") and "rests on its bound" in w for w in run.data["warnings"])
