"""`quadid init`, `quadid vehicles`, and logs whose columns have other names."""

from __future__ import annotations

from pathlib import Path

import pytest

import quadid
from quadid.app.init import init
from quadid.vehicle import Vehicle
from tests.cli.conftest import Flights
from tests.commands import Cli, one_line


def test_a_template_is_a_vehicle_and_says_what_to_fill_in(inside: Cli, tmp_path: Path) -> None:
    run = inside("init", "my quad", "--mass", "0.9", "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    vehicle = Vehicle.from_yaml(Path(run.data["file"]).read_text(encoding="utf-8"))
    assert (vehicle.name, vehicle.mass) == ("my quad", 0.9)
    assert run.data["fill_in"] == ["rotors"]
    refused = one_line(inside("identify", "any.csv", "--vehicle", run.data["file"]), 2)
    assert "rotors is a guess of `quadid init`" in refused
    assert "is there already" in one_line(inside("init", "my quad", "--out", tmp_path), 2)


def test_a_log_of_an_autopilot_fills_it(inside: Cli, data_dir: Path, tmp_path: Path) -> None:
    log = data_dir / "px4" / "ascend_cubeorange_test.ulg"
    run = inside("init", "copter", "--from", log, "--out", tmp_path, "--json", "-")
    assert run.code == 0, run.err
    text = Path(run.data["file"]).read_text(encoding="utf-8")
    assert text == init("copter", log).content
    assert len(Vehicle.from_yaml(text).rotors) >= 4
    assert "mass" in run.data["fill_in"]


def test_a_log_without_an_airframe_is_refused(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    assert "airframe" in one_line(inside("init", "x", "--from", flights.train, "--out", tmp_path), 2)


def test_shipped_vehicles(inside: Cli, monkeypatch: pytest.MonkeyPatch) -> None:
    rows = inside("vehicles", "--json", "-").data["vehicles"]
    assert {"pelican", "hexacopter", "crazyflie_brushless"} <= {row["name"] for row in rows}
    for width in (60, 80):
        monkeypatch.setenv("COLUMNS", str(width))
        assert max(map(len, inside("vehicles").out.splitlines())) <= width


def test_columns_of_other_names(inside: Cli, flights: Flights, tmp_path: Path) -> None:
    header, _, rows = flights.unseen.read_text(encoding="utf-8").partition("\n")
    renamed = {"t": "time_s", "p": "gyro_x", "q": "gyro_y", "r": "gyro_z"}
    log = tmp_path / "named.csv"
    log.write_text(",".join(renamed.get(n, n) for n in header.split(",")) + "\n" + rows, encoding="utf-8")
    options = ["--columns", "time_s=t,gyro_x=p", "--columns", "gyro_y=q,gyro_z=r"]
    expected = inside("score", flights.unseen, "--vehicle", "pelican", "--json", "-").data
    assert (
        inside("score", log, "--vehicle", "pelican", *options, "--json", "-").data["horizons"] == expected["horizons"]
    )
    file = Vehicle.shipped("pelican").model_copy(update={"columns": renamed}).save(tmp_path / "mine.yaml")
    assert quadid.score(quadid.load(log, vehicle=file)).result["horizons"] == expected["horizons"]
    for wrong, why in (
        ("gyro_x", "NAME_IN_FILE=NAME"),
        ("gyrox=p,time_s=t", "gyro_x"),
        ("time_s=t,gyro_x=pp", "unknown"),
    ):
        assert why in one_line(inside("score", log, "--vehicle", "pelican", "--columns", wrong), 2)
