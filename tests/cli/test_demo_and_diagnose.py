"""`quadid demo` and `quadid diagnose` end to end."""

import json
from pathlib import Path

from quadid_replay import write_csv

from quadid.flight import fly
from quadid.vehicle import Vehicle
from tests.commands import Cli


def test_demo_finds_what_was_flown(quadid: Cli, tmp_path: Path) -> None:
    run = quadid("demo", "--quick", "--out", tmp_path, "--json", tmp_path / "all.json")
    assert run.code == 0, run.err
    result = json.loads((tmp_path / "all.json").read_text(encoding="utf-8"))
    assert result["schema"] == "quadid.demo/1"
    truth = result["truth"]["parameters"]
    for p in result["identify"]["parameters"]:
        assert abs(p["value"] / truth[p["name"]] - 1.0) < 0.05
    assert [s["role"] for s in result["identify"]["sets"]] == ["train", "validate", "validate"]
    assert all(s["mse"]["fitted"] < 1.2 for s in result["identify"]["sets"])
    assert result["diagnose"]["verdict"] == "nothing_found"
    assert result["diagnose_hidden"]["findings"][0]["effect"] == "motor_lag"
    assert result["diagnose_hidden"]["verdict"] == "explained"
    for log in result["logs"]:
        assert Path(log).is_file()
    page = Path(result["report"])
    assert 1_000_000 < page.stat().st_size < 6_000_000
    assert f"Report: {page}" in run.out


def test_diagnose_names_the_cause_and_writes_the_extended_vehicle(quadid: Cli, tmp_path: Path) -> None:
    pelican = Vehicle.shipped("pelican")
    logs = []
    for seed in (21, 22):
        flight = fly(pelican, seconds=40.0, seed=seed, effects={"command_delay": {"delay": 0.03}})
        logs.append(tmp_path / f"late{seed}.csv")
        write_csv(logs[-1], flight.recording)
    run = quadid(
        "diagnose",
        logs[0],
        "--validate",
        logs[1],
        "--vehicle",
        "pelican",
        "--out",
        tmp_path,
        "--json",
        "-",
        "--report",
        tmp_path / "report.html",
    )
    assert run.code == 0, run.err
    result = run.data
    for key in ("schema", "verdict", "findings", "validation", "unexplained", "vehicle_file"):
        assert key in result
    finding = result["findings"][0]
    assert finding["effect"] == "command_delay"
    assert abs(finding["parameters"][0]["value"] - 0.03) < 0.003
    assert finding["gain"]["mse_after"] < 1.2 < finding["gain"]["mse_before"]
    path = Path(result["vehicle_file"])
    assert path.name == "pelican+command_delay.yaml"
    extended = Vehicle.from_yaml(path.read_text(encoding="utf-8"))
    assert abs(extended.effects["command_delay"]["delay"] - 0.03) < 0.003
    assert "command delay" in (tmp_path / "report.html").read_text(encoding="utf-8")
