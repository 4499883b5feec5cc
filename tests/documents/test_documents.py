"""Documents that list what the code has: nothing missing, nothing that is not there."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from quadid.effects import EFFECTS
from quadid.parameters import NOMINAL_UNITS
from quadid.vehicle import Vehicle


def test_symbols_and_effects_have_every_parameter_with_its_unit(repository: Path) -> None:
    text = (repository / "docs" / "symbols.md").read_text(encoding="utf-8")
    plain = text.replace("²", "^2")
    for name, unit in NOMINAL_UNITS.items():
        row = next(line for line in plain.splitlines() if line.startswith(f"| {name} | `{name}` |"))
        assert unit in row
    page = (repository / "docs" / "effects.md").read_text(encoding="utf-8")
    parts = dict(re.findall(r"^### (\w+)[^\n]*\n(.*?)\. \*\*What:", page, flags=re.MULTILINE | re.DOTALL))
    for effect in EFFECTS.values():
        groups = [group.strip(" ]").split(" [") for group in parts[effect.name].replace("²", "^2").split(";")]
        stated = [(name.strip(" `"), unit) for names, unit in groups for name in names.split(",")]
        assert stated == [(p.name, p.unit or "1") for p in effect.parameters]


def test_the_map_of_the_house_names_what_is_there(repository: Path) -> None:
    text = (repository / "docs" / "architecture.md").read_text(encoding="utf-8")
    rooms = re.findall(r"^\| `(quadid/\w+)` \|", text, flags=re.MULTILINE)
    there = {f"quadid/{p.parent.name}" for p in (repository / "quadid").glob("*/__init__.py")}
    assert set(rooms) == there
    for path in re.findall(r"`([\w/]+\.(?:py|md|yaml))`", text):
        assert (repository / path).exists(), path


def test_the_vehicle_file_of_the_guide_is_valid_and_sensible(repository: Path) -> None:
    text = (repository / "docs" / "new-vehicle.md").read_text(encoding="utf-8")
    vehicle = Vehicle.from_yaml(text.split("```yaml\n")[1].split("```")[0])
    assert vehicle.arm == pytest.approx(0.226, abs=0.001)
    assert vehicle.stand_thrust is not None
    assert vehicle.stand_thrust[0] == pytest.approx(vehicle.parameters["b"].initial, rel=0.1)
    assert 0.4 < vehicle.hover_speed() / 900.0 < 0.67
