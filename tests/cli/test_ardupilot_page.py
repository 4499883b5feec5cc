"""The page for users of ArduPilot, "From logs": every command as it stands there, on flights of its own simulator.

What a person fills in is the mass, the arm, the speed at full output, and the file that `diagnose` names.
"""

from __future__ import annotations

import re
import shutil
from pathlib import Path
from typing import Any

import pytest

from tests.cli.followed_page import follow
from tests.commands import Cli

SQUARE = {"mass": 1.8, "b": 1.983e-5, "J_xx": 0.018, "J_yy": 0.024}
X = {"mass": 3.0, "b": 4.24e-5, "J_xx": 0.02297, "J_yy": 0.02297}
"""Truth; b of the default frame is the secant of its thrust curve at hover."""
MAX_SPEED = 754.0


def errors(parameters: list[dict[str, Any]], truth: dict[str, float]) -> dict[str, float]:
    return {p["name"]: abs(p["value"] / truth[p["name"]] - 1.0) for p in parameters if p["name"] in truth}


@pytest.mark.slow
@pytest.mark.timeout(1800)
@pytest.mark.parametrize(("flight", "truth", "arm"), [("quad_sq", SQUARE, 0.25), ("x", X, 0.35)])
def test_first_flight_with_ardupilot(
    flight: str, truth: dict[str, float], arm: float, inside: Cli, tmp_path: Path, repository: Path, data_dir: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    shutil.copy(data_dir / "ardupilot_sitl" / f"{flight}.bin", "flight.bin")

    def filled_in(text: str) -> str:
        assert text.count("FILL IN") == 2
        text = re.sub(r"(?m)^mass: \S+", f"mass: {truth['mass']}", text)
        text = text.replace("0.1768", f"{arm / 2**0.5:.4f}")
        return text.replace("sampling: instant}", f"sampling: instant, max_speed: {MAX_SPEED}}}")

    told = follow(repository / "docs" / "using-with-ardupilot.md", inside, filled_in)
    published = told["replay"]["published"]
    assert published
    for item in published:
        off = errors(item["parameters"], truth)
        assert off.keys() == {"b", "J_xx", "J_yy"}
        assert max(off.values()) < 0.03, off
    known = [p for p in told["diagnose"]["parameters"] if p["status"] == "identified" and p["name"] != "b"]
    off = errors(known, truth)
    assert off.keys() == {"J_xx", "J_yy"}
    assert max(off.values()) < 0.03, off
    assert all(Path(file).is_file() for file in told["export"]["files"])
