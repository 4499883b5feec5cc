"""`quadid compare` and `compare-vehicles`: every method of the contract, and the file nearer to the truth wins."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from quadid_evaluation.paper.compare import METHODS, check_names

import quadid
from quadid.errors import LogError, ParameterError
from quadid.flight import TruthParameters
from quadid.vehicle import ParameterPrior, Vehicle
from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, one_line

# --- `quadid compare` as users call it: every method of the contract, one score, and relations that must hold


@pytest.fixture(scope="module")
def compared(quadid: Cli, flights: Flights) -> dict[str, Any]:
    done = quadid(
        "compare",
        flights.train,
        "--validate",
        flights.unseen,
        "--vehicle",
        "pelican",
        "--seeds",
        "2",
        "--budget",
        "600",
        "--json",
        "-",
    )
    assert done.code == 0, done.err
    return done.data


def test_every_method_of_the_contract_is_there_with_its_score_and_cost(compared: dict[str, Any]) -> None:
    assert compared["schema"] == "quadid.compare/1"
    assert [m["name"] for m in compared["methods"]] == list(METHODS)
    for m in compared["methods"]:
        assert m["mse"]["train"] > 0.5
        assert len(m["mse"]["validate"]) == 1
        assert m["evaluations"] >= 1
        assert m["seconds"] > 0.0
        assert (m["mse_paper"] is None) == (m["name"] in ("cva", "moesp"))


def test_who_wins_on_a_flight_that_the_model_describes_fully(compared: dict[str, Any]) -> None:
    by_name = {m["name"]: m for m in compared["methods"]}
    train = {name: m["mse"]["train"] for name, m in by_name.items()}
    assert train["pso_polish"] <= train["quasi_newton"] * 1.001
    assert train["pso_polish"] < 1.1 < train["initial"]
    assert train["least_squares"] == pytest.approx(train["pso_polish"], rel=1e-3)
    assert by_name["pso_polish"]["cost"] <= by_name["quasi_newton"]["cost"] * (1.0 + 1e-6)
    assert by_name["pso_polish"]["failures"] == 0
    assert by_name["initial"]["failures"] == 1


def test_black_boxes_predict_but_give_no_physical_parameters(compared: dict[str, Any]) -> None:
    by_name = {m["name"]: m for m in compared["methods"]}
    for name in ("cva", "moesp"):
        assert by_name[name]["parameters"] == {}
        assert by_name[name]["mse"]["validate"][0] < by_name["initial"]["mse"]["validate"][0]
    assert set(by_name["pso"]["parameters"]) == {"b", "d", "J_xx", "J_yy", "J_zz", "J_r"}


def test_random_methods_run_once_a_seed_and_never_overdraw_their_budget(compared: dict[str, Any]) -> None:
    for m in compared["methods"]:
        if m["name"] in ("pso", "pso_polish", "cma_es", "l_shade", "differential_evolution"):
            assert m["runs"] == 2
            assert {t["seed"] for t in m["trials"]} == {1, 2}
            assert m["cost"] == min(t["cost"] for t in m["trials"])  # of two runs the better one stands for a method
        assert all(t["evaluations"] <= 600 for t in m.get("trials", []))


def test_methods_keep_the_order_of_the_table() -> None:
    assert check_names(["moesp", "initial", "pso", "pso"], "shooting") == ("initial", "pso", "moesp")
    assert check_names(None, "shooting") == METHODS


def test_an_unknown_method_is_refused_with_the_nearest_name(inside: Cli, flights: Flights) -> None:
    line = one_line(inside("compare", flights.train, "--vehicle", "pelican", "--method", "cma-es"), 2)
    assert "cma_es" in line


def test_on_the_papers_objective_quasi_newton_and_the_swarm_meet(quadid: Cli, flights: Flights) -> None:
    done = quadid(
        "compare", flights.train, "--vehicle", "pelican", "--objective", "closed_loop", "--budget", "400",
        "--method", "initial", "--method", "quasi_newton", "--method", "pso_polish", "--seeds", "1", "--json", "-",
    )  # fmt: skip
    assert done.code == 0, done.err
    cost = {m["name"]: m["cost"] for m in done.data["methods"]}
    assert cost["pso_polish"] <= cost["quasi_newton"] * 1.001 < cost["initial"]
    for m in done.data["methods"]:
        assert m["mse_paper"]["train"] == pytest.approx(m["cost"], rel=1e-6)


def test_the_papers_objective_needs_references(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    names, rows = table(flights.unseen)
    kept = [i for i, name in enumerate(names) if name not in ("phi_ref", "theta_ref", "psi_ref", "throttle")]
    log = write_table(tmp_path / "bare.csv", [names[i] for i in kept], rows[:, kept])
    line = one_line(
        inside("compare", log, "--vehicle", "pelican", "--objective", "closed_loop", "--method", "initial"), 3
    )
    assert "stabiliser is not known" in line


# --- `quadid compare-vehicles`: the file nearer to the truth predicts better, and a file equals itself


PELICAN = Vehicle.shipped("pelican")


def near(factor: float = 1.0, **more: Any) -> Vehicle:
    """A Pelican with the truth's parameters but for a factor on the roll and pitch inertia."""
    values = {
        n: ParameterPrior(initial=v * (factor if n in ("J_xx", "J_yy") else 1.0), sigma=0.01 * v)
        for n, v in TruthParameters.of(PELICAN).as_dict().items()
    }
    return PELICAN.model_copy(update={"parameters": values, **more})


def test_the_truer_file_predicts_better_from_both_sides(flights: Flights) -> None:
    found = quadid.compare_vehicles(PELICAN, near(), flights.unseen).result
    assert found["better"] == "b"
    assert found["ci95"][0] < found["ratio"] < found["ci95"][1] < 0.9
    rate = found["horizons"]["50"]["rate"]
    assert rate["b"] < rate["a"]
    assert rate["ci95"][0] < rate["ratio"] < rate["ci95"][1]
    turned = quadid.compare_vehicles(near(), PELICAN, flights.unseen).result
    assert turned["better"] == "a"
    assert turned["ratio"] == pytest.approx(1.0 / found["ratio"])
    scored = quadid.score(str(flights.unseen), vehicle=PELICAN).result
    for quantity, value in scored["horizons"]["10"].items():
        assert found["horizons"]["10"][quantity]["a"] == pytest.approx(value, rel=1e-9)


def test_a_file_equals_itself_and_a_small_difference_is_small(flights: Flights) -> None:
    same = quadid.compare_vehicles(near(), near(), flights.unseen).result
    assert same["better"] == "neither"
    assert same["ratio"] == pytest.approx(1.0)
    assert {p["name"]: p["apart"] for p in same["parameters"]}["J_xx"] == 0.0
    apart = quadid.compare_vehicles(near(), near(1.03), flights.unseen).result
    assert {p["name"]: p["apart"] for p in apart["parameters"]}["J_xx"] == pytest.approx(0.03 / 0.01 / 2**0.5)


def test_the_interval_covers_what_other_flights_show(flights: Flights) -> None:
    """Halves of a flight: the ratio on one lies within a few widths of the interval of the other."""
    one, two = (
        quadid.compare_vehicles(PELICAN, near(1.05), f"{flights.unseen}@{span}").result for span in ("0:15", "15:30")
    )
    middle, width = np.log(one["ratio"]), 0.5 * np.log(one["ci95"][1] / one["ci95"][0])
    assert 0.0 < width < 0.5
    assert abs(np.log(two["ratio"]) - middle) < 3.0 * width


def test_two_files_of_one_name_are_told_apart(flights: Flights, tmp_path: Path) -> None:
    for folder, factor in (("old", 1.2), ("new", 1.0)):
        (tmp_path / folder).mkdir()
        near(factor).save(tmp_path / folder / "mine.yaml")
    old, new = (str(tmp_path / folder / "mine.yaml") for folder in ("old", "new"))
    made = quadid.compare_vehicles(old, new, flights.unseen)
    assert (made.result["a"], made.result["b"]) == (old, new)
    assert all(f"A ({old})" in text and f"B ({new})" in text for text in (made.text(), made.page()))
    assert quadid.compare_vehicles("pelican", new, flights.unseen).result["a"] == "pelican"


def test_effects_stand_side_by_side(flights: Flights) -> None:
    lagged = near(effects={"motor_lag": {"tau": 0.001}})
    made = quadid.compare_vehicles(near(1.2), lagged, str(flights.unseen))
    assert made.result["effects"] == [{"effect": "motor_lag", "name": "tau", "a": None, "b": 0.001}]
    assert "predicts better than" in made.text()
    frame = made.to_frame()
    assert len(frame) == 12
    assert frame.loc["rate.10", "low"] <= frame.loc["rate.10", "ratio"] <= frame.loc["rate.10", "high"]
    assert "Effects side by side" in made.page()


def test_what_cannot_be_compared_is_refused(flights: Flights) -> None:
    with pytest.raises(LogError, match="at least one flight"):
        quadid.compare_vehicles(PELICAN, near(), [])
    with pytest.raises(ParameterError, match="horizons"):
        quadid.compare_vehicles(PELICAN, near(), flights.unseen, horizons=(0,))
    with pytest.raises(LogError, match="at least 8 for an interval"):
        quadid.compare_vehicles(PELICAN, near(), f"{flights.unseen}@0:4")
