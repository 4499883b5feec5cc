"""The container files as far as they can be checked without an engine; `make lint` checks their syntax."""

from __future__ import annotations

import re
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from quadid_node.launching import ARGUMENTS, NODE_ARGUMENTS


@pytest.fixture(scope="module")
def dockerfile(repository: Path) -> str:
    text = (repository / "docker" / "Dockerfile").read_text(encoding="utf-8")
    return re.sub(r"\\\n", " ", text)


@pytest.fixture(scope="module")
def services(repository: Path) -> dict[str, Any]:
    composed: dict[str, Any] = yaml.safe_load((repository / "docker" / "compose.yaml").read_text(encoding="utf-8"))
    found: dict[str, Any] = composed["services"]
    return found


def test_everything_copied_exists_and_passes_the_ignore_file(dockerfile: str, repository: Path) -> None:
    lines = (repository / "docker" / "Dockerfile.dockerignore").read_text(encoding="utf-8").splitlines()
    allowed = [line[1:] for line in lines if line.startswith("!")]
    lines_of_files = re.findall(r"^COPY (?!--from)(.+)$", dockerfile, re.MULTILINE)
    copied = [source for line in lines_of_files for source in line.split()[:-1]]
    assert copied
    for source in copied:
        assert (repository / source).exists(), source
        assert any(fnmatch(source, pattern) for pattern in allowed), f"{source} is kept out by Dockerfile.dockerignore"


def test_the_packages_of_the_wheel_are_all_copied(dockerfile: str, repository: Path) -> None:
    project = tomllib.loads((repository / "pyproject.toml").read_text(encoding="utf-8"))
    for package in project["tool"]["hatch"]["build"]["targets"]["wheel"]["packages"]:
        folder = package.split("/")[0]
        assert f"COPY {folder} src/{folder}" in dockerfile


def test_the_base_image_is_named_by_its_digest(dockerfile: str) -> None:
    built, run = re.findall(r"^FROM (\S+)", dockerfile, re.MULTILINE)
    assert built == run
    assert re.fullmatch(r"ros:jazzy-ros-base@sha256:[0-9a-f]{64}", run)


def test_what_only_builds_stays_in_the_first_stage(dockerfile: str, repository: Path) -> None:
    """No compiler, Dask, pyarrow or plots in the image; kernels are compiled where they run, into the volume."""
    _, last = dockerfile.split(" AS build", 1)[1].split("\nFROM ")
    assert "build-essential" not in last
    assert "pip install" not in last
    assert "--break-system-packages" not in dockerfile
    assert "quadid warmup" not in dockerfile
    (volume,) = re.findall(r'^VOLUME \["(.+)"\]$', dockerfile, re.MULTILINE)
    (kernels,) = re.findall(r"^ENV NUMBA_CACHE_DIR=(\S+)$", dockerfile, re.MULTILINE)
    assert kernels.startswith(f"{volume}/")
    pins = (repository / "docker" / "requirements.txt").read_text(encoding="utf-8")
    assert "\nnumpy==1.26.4 " in pins, "as apt has it: ROS' messages are compiled with it"
    for heavy in ("dask", "distributed", "pyarrow", "pandas", "plotly", "matplotlib"):
        assert not re.search(rf"^{heavy}==", pins, re.MULTILINE), heavy


def test_everything_of_the_package_index_is_pinned_with_hashes(dockerfile: str, repository: Path) -> None:
    node = (repository / "quadid_node" / "requirements.txt").read_text(encoding="utf-8").splitlines()
    wanted = [Requirement(line) for line in node if line[:1] not in ("", "#")]
    text = (repository / "docker" / "requirements.txt").read_text(encoding="utf-8").replace("\\\n", " ")
    pinned = dict(re.findall(r"^([\w.-]+)==(\S+) .*--hash=sha256:[0-9a-f]{64}", text, re.MULTILINE))
    assert len(pinned) == len(re.findall(r"^\w", text, re.MULTILINE)), "a line without version or hash"
    for requirement in wanted:
        version = pinned.get(canonicalize_name(requirement.name))
        assert version, f"{requirement.name} is not in docker/requirements.txt: make pins"
        assert requirement.specifier.contains(version), f"{requirement} against {version}: make pins"
    assert "//" not in text.replace("# ", ""), "no address of a package host belongs there"
    installs = re.findall(r"pip install[^&]+", dockerfile)
    assert installs
    assert all("--require-hashes" in i for i in installs)


def test_the_last_user_is_not_root(dockerfile: str) -> None:
    (user,) = re.findall(r"^USER (\S+)$", dockerfile, re.MULTILINE)
    assert user not in ("0", "root")


def test_the_history_outlives_the_container(dockerfile: str, services: dict[str, Any]) -> None:
    (volume,) = re.findall(r'^VOLUME \["(.+)"\]$', dockerfile, re.MULTILINE)
    (history,) = re.findall(r"^ENV QUADID_HISTORY=(\S+)$", dockerfile, re.MULTILINE)
    assert Path(history).parent == Path(volume)
    assert services["node"]["volumes"] == [f"history:{volume}"]


def test_launch_arguments_of_the_node_service_exist(services: dict[str, Any], repository: Path) -> None:
    package, launch, *arguments = services["node"]["command"].split()[2:]
    assert package == "quadid_node"
    assert (repository / package / "launch" / launch).is_file()
    assert arguments
    assert {a.split(":=")[0] for a in arguments} <= {"namespace", "config", *ARGUMENTS, *NODE_ARGUMENTS}


def test_only_the_router_is_reachable_and_only_from_this_machine(services: dict[str, Any]) -> None:
    for name, service in services.items():
        ports = service.get("ports", [])
        assert bool(ports) == (name == "router")
        assert all(port.startswith("127.0.0.1:") for port in ports)
