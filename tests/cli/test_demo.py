"""`quadid demo` end to end: what was flown is found, what was hidden is named and in the extended vehicle file."""

import json
from pathlib import Path

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
    hidden = result["diagnose_hidden"]
    finding = hidden["findings"][0]
    assert (finding["effect"], hidden["verdict"]) == ("motor_lag", "explained")
    assert abs(finding["parameters"][0]["value"] - 0.04) < 0.003
    assert finding["gain"]["mse_after"] < 1.2 < finding["gain"]["mse_before"]
    path = Path(hidden["vehicle_file"])
    assert path.name == "pelican+motor_lag.yaml"
    extended = Vehicle.from_yaml(path.read_text(encoding="utf-8"))
    assert abs(extended.effects["motor_lag"]["tau"] - 0.04) < 0.003
    for log in result["logs"]:
        assert Path(log).is_file()
    page = Path(result["report"])
    assert 1_000_000 < page.stat().st_size < 6_000_000
    assert "motor lag" in page.read_text(encoding="utf-8")
    assert f"Report: {page}" in run.out
