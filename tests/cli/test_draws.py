"""`quadid simulate --draws`: vehicles within the file's uncertainty, each flown under random forces of its own."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import quadid
from quadid.app.outcome import json_text
from quadid.app.simulate import simulate_draws
from quadid.errors import ParameterError, VehicleError
from quadid.vehicle import ParameterPrior, RandomForces, RandomInput, Vehicle
from tests.commands import Cli, one_line

RANDOM = RandomForces(
    horizontal=RandomInput(sigma=0.8, time=0.5), vertical=RandomInput(sigma=0.3, time=0.3),
    roll_pitch=RandomInput(sigma=2.0, time=0.2), yaw=RandomInput(sigma=0.5, time=0.5),
)  # fmt: skip


def uncertain(share: float = 0.02, random: RandomForces | None = RANDOM) -> Vehicle:
    pelican = Vehicle.shipped("pelican")
    priors = {
        n: ParameterPrior(initial=p.initial, sigma=share * p.initial) for n, p in pelican.parameters.items()
    }  # fmt: skip
    return pelican.model_copy(update={"parameters": priors, "random": random})


def test_draws_spread_as_the_file_says_and_repeat_with_their_seed() -> None:
    draws = simulate_draws(uncertain(), 30, seed=4, seconds=0.5)
    logs = np.log([[d.vehicle.parameters[n].initial for n in ("b", "d", "J_xx")] for d in draws])
    assert np.all(np.abs(np.std(logs, axis=0) / 0.02 - 1.0) < 0.5)
    assert [d.seed for d in draws] == list(range(4, 34))
    again = simulate_draws(uncertain(), 2, seed=4, seconds=0.5)
    assert json_text(again[1].entry) == json_text(draws[1].entry)


def test_values_that_were_found_together_are_drawn_together() -> None:
    file = Vehicle.from_yaml(uncertain().to_yaml() + "correlation: {J_xx: {b: 0.95}}\n")
    draws = simulate_draws(file, 40, seed=1, seconds=0.2)
    b, J = np.log([[d.vehicle.parameters[n].initial for n in ("b", "J_xx")] for d in draws]).T
    assert np.corrcoef(b, J)[0, 1] > 0.85
    with pytest.raises(VehicleError, match="did you mean 'J_xx'"):
        Vehicle.from_yaml(uncertain().to_yaml() + "correlation: {J_x: {b: 0.9}}\n")
    with pytest.raises(VehicleError, match="less than or equal to 1"):
        Vehicle.from_yaml(uncertain().to_yaml() + "correlation: {J_xx: {b: 1.2}}\n")


def test_random_forces_act_in_every_draw(tmp_path: Path) -> None:
    """The same vehicle and sticks with and without them; what differs has their size."""
    one, calm = (simulate_draws(uncertain(1e-6, r), 1, seed=7, seconds=20.0)[0].flown for r in (RANDOM, None))
    assert one is not None
    assert calm is not None
    felt = one.flight.window.accel - calm.flight.window.accel  # type: ignore[operator]
    assert 0.5 < np.std(felt[:, 0]) < 1.3
    turned = one.flight.truth.rates - calm.flight.truth.rates
    assert np.std(turned[:, 0]) > 0.05


def test_logs_get_numbers_and_their_seeds_are_told(inside: Cli, tmp_path: Path) -> None:
    file = uncertain().save(tmp_path / "mine.yaml")
    run = inside(
        "simulate",
        tmp_path / "out.csv",
        "--vehicle",
        file,
        "--draws",
        "3",
        "--seconds",
        "5",
        "--seed",
        "2",
        "--json",
        "-",
    )
    assert run.code == 0, run.err
    assert run.data["diverged"] == 0
    assert [d["seed"] for d in run.data["draws"]] == [2, 3, 4]
    assert [Path(d["log"]).name for d in run.data["draws"]] == ["out-1.csv", "out-2.csv", "out-3.csv"]
    assert all(d["diverged"] is None for d in run.data["draws"])
    assert quadid.load(run.data["draws"][2]["log"], vehicle=file).windows


def test_a_draw_that_diverges_says_so(inside: Cli, tmp_path: Path) -> None:
    wild = RANDOM.model_copy(update={"roll_pitch": RandomInput(sigma=400.0, time=0.5)})
    file = uncertain(0.02, wild).save(tmp_path / "wild.yaml")
    run = inside("simulate", tmp_path / "out.csv", "--vehicle", file, "--draws", "2", "--seconds", "5")
    assert run.code == 3
    assert "out-1.csv: diverged, the vehicle crashed" in run.out
    assert not (tmp_path / "out-1.csv").exists()
    assert "all 2 vehicles diverged" in run.err


def test_impossible_numbers_of_draws_are_refused(inside: Cli, tmp_path: Path) -> None:
    for draws in (0, 100000):
        with pytest.raises(ParameterError, match="1 to"):
            simulate_draws("pelican", draws)
    one_line(inside("simulate", "udpout:127.0.0.1:14550", "--draws", "2"), 2)
