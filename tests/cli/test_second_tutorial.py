"""The second tutorial: every command as it stands there, on a flight of ArduCopter in its own simulator."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.cli.followed_page import commands
from tests.commands import Cli


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_from_a_raw_log_to_an_exported_file(
    inside: Cli, tmp_path: Path, repository: Path, data_dir: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    shutil.copy(data_dir / "ardupilot_sitl" / "quad_sq.bin", "flight.bin")
    page = (repository / "docs" / "tutorial-flight.md").read_text(encoding="utf-8")
    found: dict[str, Any] = {}
    said, scores = [], []
    for name, *arguments in commands(repository / "docs" / "tutorial-flight.md"):
        file = found.get("vehicle_file", "")
        run = inside(name, *(a.replace("mine+….yaml", file) for a in arguments), "--json", f"{name}.json")
        assert run.code == 0, (name, arguments, run.err)
        said.append(" ".join(run.out.split()))
        result = json.loads(Path(f"{name}.json").read_text(encoding="utf-8"))
        found = result if name == "diagnose" else found
        scores += [result["horizons"]["25"]["velocity"]] if name == "score" else []
    # 1. What the page quotes was printed.
    quoted = re.findall(r"^> (.+)$", page, re.MULTILINE)
    assert len(quoted) == 5
    for sentence in quoted:
        assert any(sentence in out for out in said), sentence
    # 2. Its table holds what was found, near what the simulator's sources say.
    values = {p["name"]: p["value"] for p in found["parameters"]}
    values |= {f"{f['effect']}.{p['name']}": p["value"] for f in found["findings"] for p in f["parameters"]}
    rows = re.findall(r"^\| `([\w.]+)`[^|]* \| ([\d.e-]+) \| ([\d.e-]+) \|$", page, re.MULTILINE)
    assert len(rows) == 7
    for name, stated, truth in rows:
        assert values[name] == pytest.approx(float(stated), rel=0.01), name
        assert values[name] == pytest.approx(float(truth), rel=0.04), name
    before, after = re.findall(r"off by (\d\.\d+) m/s.*?it is by (\d\.\d+)", page)[0]
    assert scores == [pytest.approx(float(before), rel=0.02), pytest.approx(float(after), rel=0.1)]
    for written in ("mine.sitl.json", "mine.param", "diagnosis.html", "series/flight.bin.missing.csv"):
        assert Path(written).is_file(), written
