"""The node lives on its own list of requirements, beside NumPy 1.26; `make node` installs it so and runs it."""

import subprocess
import sys
import tomllib
from collections.abc import Iterable
from importlib import metadata
from pathlib import Path

import pytest
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from quadid.cli.terminal import Failure, explain

LEFT_OUT = {"jinja2", "plotly", "matplotlib", "cma", "dask", "pandas", "pyarrow"}
"""Plots, reports, other optimisers, many logs at once."""
BESIDE_UBUNTU = {"coverage"}
"""Needed only where an older one is seen: colcon brings Ubuntu's, with which numba cannot be imported."""
NEEDS_ROS = ("quadid_node.node", "quadid_node.publish", "quadid_node.replay_node")


@pytest.fixture(scope="module")
def core(repository: Path) -> dict[str, Requirement]:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return {r.name: r for r in map(Requirement, project["dependencies"])}


def test_the_list_is_that_of_the_core_without_what_the_node_never_uses(
    core: dict[str, Requirement], repository: Path
) -> None:
    lines = (repository / "quadid_node" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    listed = {r.name: r for r in (Requirement(line) for line in lines if not line.startswith("#"))}
    assert not BESIDE_UBUNTU - set(listed)
    there = {n: r.specifier for n, r in listed.items() if n not in BESIDE_UBUNTU}
    assert there == {n: r.specifier for n, r in core.items() if n not in LEFT_OUT}
    assert core["numpy"].specifier.contains("1.26.4")


def test_the_page_names_all_that_is_left_out(repository: Path) -> None:
    page = (repository / "docs" / "using-with-ros.md").read_text(encoding="utf-8")
    (line,) = [line for line in page.splitlines() if line.startswith("For plots")]
    named = line.split("pip install ", 1)[1].split("`")[0].replace('"', "").replace("[distributed]", "").split()
    assert {*named} == LEFT_OUT


def brought(names: Iterable[str]) -> set[str]:
    """Distributions that come with these: what they require, and what that requires."""
    found, waiting = set[str](), [canonicalize_name(name) for name in names]
    while waiting:
        if (name := waiting.pop()) not in found:
            found.add(name)
            needed = map(Requirement, metadata.requires(name) or [])
            waiting += [canonicalize_name(r.name) for r in needed if not r.marker or r.marker.evaluate({"extra": ""})]
    return found


def test_all_that_the_node_imports_comes_with_its_list(repository: Path) -> None:
    """Nothing that is installed here for another reason, as markupsafe is for jinja2."""
    lines = (repository / "quadid_node" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    listed = brought(Requirement(line).name for line in lines if not line.startswith("#")) | {"quadid"}
    absent = sorted(
        module
        for module, of in metadata.packages_distributions().items()
        if not {canonicalize_name(name) for name in of} & listed and not any(name.startswith("ros-") for name in of)
    )
    assert {"dask", "jinja2", "plotly"} < set(absent)
    code = f"""
import importlib, pkgutil, sys
class Block:
    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] in {absent!r}:
            raise ModuleNotFoundError(name)
sys.meta_path.insert(0, Block())
import quadid, quadid.errors, quadid_node, quadid_replay
for top in (quadid, quadid_node, quadid_replay):
    for module in pkgutil.walk_packages(top.__path__, top.__name__ + "."):
        if module.name.split(".")[1] != "report" and module.name not in {NEEDS_ROS!r}:
            try:
                importlib.import_module(module.name)
            except quadid.errors.QuadidError as error:
                assert "pip install 'quadid[" in str(error), error
import quadid.cli.serve, quadid.cli.replay, quadid.cli.history, quadid.cli.serve, quadid.cli.serve
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


def test_a_command_says_which_library_is_not_there() -> None:
    lacking = explain(ModuleNotFoundError("No module named 'dask'", name="dask"))
    assert lacking == Failure("dask is not installed; fix: pip install dask", 2)
    assert explain(ModuleNotFoundError("No module named 'quadid.nowhere'", name="quadid.nowhere")) is None
