"""`quadid score`: the JSON, gaps, files, and agreement with what can be computed without a simulation."""

import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from quadid_replay import write_csv

import quadid
from quadid.identification import predict
from quadid.vehicle import Stabiliser, Vehicle
from tests.cli.conftest import Flights, table, write_table
from tests.commands import Cli, one_line

QUANTITIES = ["position", "velocity", "rotation", "rate"]


def test_json_has_exactly_the_keys_of_the_contract(inside: Cli, flights: Flights) -> None:
    result = inside("score", flights.train, flights.unseen, "--vehicle", "pelican", "--json", "-").data
    keys = ["schema", "vehicle", "samples", "gaps", "horizons", "spread", "sum", "files"]
    assert list(result) == [*keys, "noise_floor", "no_change", "units", "coverage", "bands", "verdict"]
    assert result["schema"] == "quadid.score/1"
    assert list(result["horizons"]) == ["1", "10", "50"]
    assert all(list(h) == QUANTITIES for h in result["horizons"].values())
    assert list(result["sum"]) == ["to", *QUANTITIES]
    assert result["sum"]["to"] == 50
    assert result["samples"] == 2 * (1500 - 50)
    first, second = result["files"]
    assert [first["log"], second["log"]] == ["train.mcap", "unseen.csv"]
    assert first["horizons"]["50"]["velocity"] is None
    assert second["horizons"]["50"]["velocity"] > 0.0
    pooled = 0.5 * (first["horizons"]["10"]["rate"] + second["horizons"]["10"]["rate"])
    assert result["horizons"]["10"]["rate"] == pytest.approx(pooled)


def test_runs_never_cross_a_gap(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    names, rows = table(flights.unseen)
    log = write_table(tmp_path / "gap.csv", names, np.delete(rows, slice(400, 430), axis=0))
    whole = write_table(tmp_path / "whole.csv", names, rows)
    result = inside("score", log, whole, "--vehicle", "pelican", "--json", "-").data
    assert (result["gaps"], result["files"][0]["gaps"], result["files"][1]["gaps"]) == (1, 1, 0)
    assert result["files"][0]["samples"] == (400 - 50) + (1070 - 50)


def test_without_torque_the_rate_error_is_that_of_no_change(inside: Cli, data_dir: Path, tmp_path: Path) -> None:
    """A vehicle too heavy to turn predicts the measured rate forever; real flight, own log rate, held speeds."""
    vehicle = yaml.safe_load((data_dir / "nanodrone" / "vehicle.yaml").read_text(encoding="utf-8"))
    vehicle["parameters"] |= {n: {"initial": 1e3, "bounds": [2e-5, 1e4]} for n in ("J_xx", "J_yy", "J_zz")}
    file = tmp_path / "stiff.yaml"
    file.write_text(yaml.safe_dump(vehicle), encoding="utf-8")
    log = data_dir / "nanodrone" / "square_run1.csv"
    result = inside("score", log, "--vehicle", file, "--json", "-").data
    names, rows = table(log)
    rate = rows[:, [names.index(n) for n in "pqr"]]
    starts = len(rate) - 50
    naive = [np.linalg.norm(rate[h : h + starts] - rate[:starts], axis=1).mean() for h in range(1, 51)]
    assert result["samples"] == starts
    for horizon in (1, 10, 50):
        assert result["horizons"][str(horizon)]["rate"] == pytest.approx(naive[horizon - 1], rel=1e-4)
    assert result["sum"]["rate"] == pytest.approx(sum(naive), rel=1e-4)


def test_a_vehicle_that_runs_away_is_called_that_and_warns_of_nothing_else(
    inside: Cli, data_dir: Path, tmp_path: Path
) -> None:
    """Rates that grow by themselves, e^30-fold a second: squares of such misses leave the range of numbers."""
    vehicle = yaml.safe_load((data_dir / "nanodrone" / "vehicle.yaml").read_text(encoding="utf-8"))
    vehicle["effects"] = {"rate_damping": {"l_p": -30.0, "m_q": -30.0, "n_r": -30.0}}
    file = tmp_path / "wild.yaml"
    file.write_text(yaml.safe_dump(vehicle), encoding="utf-8")
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = inside("score", data_dir / "nanodrone" / "square_run1.csv", "--vehicle", file, "--horizons", "1,1500")
    assert run.code == 0
    assert "after 1500 samples the simulation diverges" in run.out
    assert run.out.count("ran away") >= 4


def test_rate_and_horizons_are_options(inside: Cli, flights: Flights) -> None:
    result = inside(
        "score", flights.unseen, "--vehicle", "pelican", "--rate", "25", "--horizons", "5,60", "--json", "-"
    ).data
    assert list(result["horizons"]) == list(result["coverage"]) == ["5", "60"]
    assert result["sum"]["to"] == 50
    assert 600 < result["samples"] < 750 - 60


def test_a_horizon_may_be_a_time(inside: Cli, flights: Flights) -> None:
    score = ("score", flights.unseen, "--vehicle", "pelican", "--json", "-")
    one, other = (inside(*score, "--horizons", h).data for h in ("0.1s,0.5s", "5,25"))
    assert one == other
    assert list(one["horizons"]) == ["5", "25"]
    line = one_line(inside("score", flights.train, flights.unseen, "--vehicle", "pelican", "--horizons", "-1s"), 2)
    assert "--horizons -1s" in line
    slow = quadid.load(flights.unseen, vehicle="pelican", rate=25.0)
    assert list(quadid.score(slow, horizons=["0.2s"], rate=25.0).result["horizons"]) == ["5"]


def test_bands_are_predicted_up_to_a_tenth_of_a_second_and_the_reason_stands_below(
    inside: Cli, flights: Flights, monkeypatch: pytest.MonkeyPatch
) -> None:
    run = inside("score", flights.unseen, "--vehicle", "pelican", "--horizons", "1,5,10")
    assert "already contain the controller's answer" in run.out
    assert "found in the first third of each log" in run.out
    coverage = inside("score", flights.unseen, "--vehicle", "pelican", "--horizons", "1,5,10", "--json", "-").data
    coverage = coverage["coverage"]
    assert coverage["10"] is None, "0.2 s at 50 Hz"
    for h in ("1", "5"):
        for quantity in ("velocity", "rotation", "rate"):
            shares = coverage[h][quantity]
            assert list(shares) == ["50", "80", "95"]
            assert 0.0 <= shares["50"] <= shares["80"] <= shares["95"] <= 1.0
    monkeypatch.setattr(predict, "SHORTEST", 60.0)
    short = inside("score", flights.unseen, "--vehicle", "pelican", "--horizons", "1", "--json", "-").data
    assert short["coverage"] == {"1": None}
    assert "60 s with gyro" in short["bands"]


def test_the_autopilot_in_the_loop_predicts_further(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    asked = ("--horizons", "5,25", "--closed-loop", "--json", "-")
    found = inside("score", flights.train, "--vehicle", "pelican", *asked).data
    assert "its gains identified" in found["bands"]
    assert 0.5 < found["coverage"]["25"]["rate"]["95"] <= 1.0
    gains = Stabiliser(gains=dict(flights.train_flight.gains))
    known = Vehicle.shipped("pelican").model_copy(update={"stabiliser": gains}).save(tmp_path / "known.yaml")
    assert "its gains given" in inside("score", flights.train, "--vehicle", known, *asked).data["bands"]
    names, rows = table(flights.unseen)
    keep = [i for i, name in enumerate(names) if not name.endswith("_ref") and name != "throttle"]
    log = write_table(tmp_path / "bare.csv", [names[i] for i in keep], rows[:, keep])
    bare = inside("score", log, "--vehicle", "pelican", *asked).data
    assert "no autopilot is known" in bare["bands"]
    assert bare["coverage"]["25"] is None
    assert bare["coverage"]["5"] is not None


def test_tables_name_units(inside: Cli, flights: Flights) -> None:
    run = inside("score", flights.unseen, "--vehicle", "pelican")
    assert run.code == 0
    for expected in ("position [m]", "velocity [m/s]", "rotation [rad]", "rate [rad/s]", "sum 1..50"):
        assert expected in run.out
    assert "\x1b" not in run.out


def test_a_quantity_measured_too_seldom_for_the_horizons_is_said(flights: Flights, tmp_path: Path) -> None:
    flown = flights.unseen_flight.recording
    known = flown.channels["velocity"]
    slow = replace(known, t=known.t[::16], values=known.values[::16])
    write_csv(tmp_path / "slow.csv", replace(flown, channels={**flown.channels, "velocity": slow}))
    made = quadid.score(tmp_path / "slow.csv", vehicle="pelican")
    assert [w for w in made.warnings if "velocity is measured at 3.1" in w and "--rate 3.1" in w]
    assert not [w for w in made.warnings if "position is measured" in w]
    met = quadid.score(tmp_path / "slow.csv", vehicle="pelican", horizons=(16,))
    assert not [w for w in met.warnings if "is measured at" in w]
