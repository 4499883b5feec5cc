"""Contents of `pip install .`: seven packages with their data, one version, and imports that cost nothing."""

import re
import subprocess
import sys
import tomllib
import xml.etree.ElementTree as ElementTree
import zipfile
from pathlib import Path

import pytest

PACKAGES = ("quadid", "quadid_replay", "quadid_node", "quadid_evaluation")
OLD_NAMES = {"quadid_command.py", "quadid_cli.py"}
"""Modules that stand in for packages of the release before."""
HEAVY = ("numba", "scipy", "pandas", "plotly", "dask", "distributed", "zenoh", "pymavlink", "mcap", "pyulog", "rclpy")


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory, repository: Path) -> list[str]:
    """Names of the files in a freshly built wheel."""
    folder = tmp_path_factory.mktemp("wheel")
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "--target", "wheel", "--directory", str(folder)],
        cwd=repository,
        check=True,
        capture_output=True,
    )
    (built,) = folder.glob("quadid-*.whl")
    with zipfile.ZipFile(built) as archive:
        return archive.namelist()


def test_all_packages_are_at_the_top_and_typed(wheel: list[str]) -> None:
    assert {name.split("/")[0] for name in wheel if ".dist-info" not in name} == {*PACKAGES, *OLD_NAMES}
    for package in PACKAGES:
        assert f"{package}/__init__.py" in wheel
        assert f"{package}/py.typed" in wheel


def test_data_files_are_in_and_markers_are_out(wheel: list[str], repository: Path) -> None:
    """Every tracked file of a package that is not Python source is data that the package reads."""
    folders = {"quadid": "quadid", "replay": "replay/quadid_replay", "quadid_node": "quadid_node/quadid_node"}
    folders |= {"evaluation": "evaluation/quadid_evaluation"}
    tracked = subprocess.run(
        ["git", "ls-files", *folders.values()], cwd=repository, check=True, capture_output=True, text=True
    ).stdout.split()
    assert "quadid/vehicles/pelican.yaml" in tracked
    links = {path: sorted((repository / path).iterdir()) for path in tracked if (repository / path).is_dir()}
    assert links
    for path in (*tracked, *(f"{link}/{file.name}" for link, files in links.items() for file in files)):
        if path in links:
            continue
        name = re.sub(r"^(replay|evaluation|quadid_node(?=/quadid_node/))/", "", path)
        assert (name in wheel) == (Path(path).name != "COLCON_IGNORE"), path


def test_one_version_everywhere(repository: Path) -> None:
    import quadid

    version = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]["version"]
    assert quadid.__version__ == version
    for package in ("core", "msgs", "quadid_node"):
        assert ElementTree.parse(repository / package / "package.xml").findtext("version") == version, package
    for package in ("core", "quadid_node"):
        assert f'version="{version}"' in (repository / package / "setup.py").read_text(encoding="utf-8")


@pytest.mark.parametrize("package", PACKAGES)
def test_importing_a_package_imports_nothing_heavy(package: str) -> None:
    code = f"import sys, {package}; print(*sorted(set({HEAVY!r}) & set(sys.modules)))"
    printed = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout
    assert printed.split() == []
