"""`quadid compare` as users call it: every method of the contract, one score, and relations that must hold."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest
from quadid_evaluation.paper.compare import METHODS, check_names

from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, one_line


@pytest.fixture(scope="module")
def compared(quadid: Cli, flights: Flights) -> dict[str, Any]:
    done = quadid(
        "compare", flights.train, "--validate", flights.unseen, "--vehicle", "pelican", "--seeds", "2",
        "--budget", "600", "--json", "-",
    )  # fmt: skip
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
