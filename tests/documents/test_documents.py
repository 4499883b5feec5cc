"""Documents that list what the code has: nothing missing, nothing that is not there; the API page and its recipes."""

import importlib
import re
import subprocess
import sys
from pathlib import Path

import pytest

import quadid
from quadid.effects import EFFECTS
from quadid.parameters import NOMINAL_UNITS
from quadid.vehicle import Vehicle

# --- Documents that list what the code has: nothing missing, nothing that is not there


def test_symbols_and_effects_have_every_parameter_with_its_unit(repository: Path) -> None:
    text = (repository / "docs" / "symbols.md").read_text(encoding="utf-8")
    plain = text.replace("²", "^2")
    for name, unit in NOMINAL_UNITS.items():
        row = next(line for line in plain.splitlines() if line.startswith(f"| {name} | `{name}` |"))
        assert unit in row
    page = (repository / "docs" / "effects.md").read_text(encoding="utf-8")
    parts = dict(re.findall(r"^### (\w+)[^\n]*\n(.*?\])\. ", page, flags=re.MULTILINE | re.DOTALL))
    for effect in EFFECTS.values():
        groups = [group.strip(" ]").split(" [") for group in parts[effect.name].replace("²", "^2").split(";")]
        stated = [(name.strip(" `"), unit) for names, unit in groups for name in names.split(",")]
        assert stated == [(p.name, p.unit or "1") for p in effect.parameters]


def test_the_map_of_the_house_names_what_is_there(repository: Path) -> None:
    text = (repository / "ARCHITECTURE.md").read_text(encoding="utf-8")
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


# --- The API page: its recipes run and have types, and it documents the functions that `import quadid` offers


@pytest.fixture(scope="module")
def page(repository: Path) -> str:
    """The page as text."""
    return (repository / "docs" / "api" / "index.md").read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def recipes(page: str) -> list[str]:
    """Code of the cookbook, a recipe each."""
    return [part.split("```python\n")[1].split("```")[0] for part in page.split("## Functions")[0].split("\n### ")[1:]]


def test_twelve_recipes_run_one_after_the_other(
    recipes: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    pytest.importorskip("xarray")
    monkeypatch.chdir(tmp_path)
    assert len(recipes) == 12
    names: dict[str, object] = {}
    for number, recipe in enumerate(recipes, 1):
        exec(compile(recipe, f"recipe {number}", "exec"), names)
    said = capsys.readouterr().out
    assert "usable for identification" in said
    assert names["low"] < 0.04 < names["high"]  # type: ignore[operator]
    assert names["tau"] == pytest.approx(0.04, rel=0.05)
    assert names["b"] == pytest.approx(2.33e-5, rel=0.05)
    assert names["ahead"].between(0.0, 1.0)[["error", "inside_95"]].all()  # type: ignore[attr-defined]
    assert names["ahead"]["low"] < names["ahead"]["error"] < names["ahead"]["high"]  # type: ignore[index]
    assert "rotor 2" in str(names["health"])
    assert names["flown"]["status"]["today.csv"] == "done", names["flown"]["reason"]  # type: ignore[index]
    assert (names["spread"] > 0.0).any()  # type: ignore[operator, attr-defined]
    for file in ("mine.yaml", "diagnosis.html", "mine.params", "gains.params", "plan"):
        assert (tmp_path / file).exists(), file


def test_every_call_of_a_recipe_has_types(recipes: list[str], repository: Path, tmp_path: Path) -> None:
    file = tmp_path / "recipes.py"
    file.write_text("\n".join(recipes), encoding="utf-8")
    checked = subprocess.run(
        [sys.executable, "-m", "mypy", "--config-file", str(repository / "pyproject.toml"), str(file)],
        cwd=repository,
        capture_output=True,
        text=True,
        check=False,
    )
    assert checked.returncode == 0, checked.stdout


def test_the_page_documents_what_the_module_offers(page: str) -> None:
    functions = re.findall(r"^::: ([\w.]+)", page.split("## Functions")[1].split("\n## ")[0], re.MULTILINE)
    assert sorted(functions) == [f"quadid.{name}" for name in dir(quadid) if name != "__version__"]
    for path in re.findall(r"^::: ([\w.]+)", page, re.MULTILINE):
        assert _there(path).__doc__, path


def test_a_result_of_a_function_is_documented(page: str) -> None:
    for name in dir(quadid):
        returned = getattr(getattr(quadid, name), "__annotations__", {}).get("return")
        if returned is not None and not isinstance(getattr(quadid, name), type):
            kind = getattr(returned, "__name__", returned)
            assert re.search(rf"^::: [\w.]+\.{kind}$", page, re.MULTILINE), (name, kind)


def _there(path: str) -> object:
    """The object or module of that path."""
    module, _, name = path.rpartition(".")
    found = getattr(importlib.import_module(module), name, None)
    return importlib.import_module(path) if found is None else found
