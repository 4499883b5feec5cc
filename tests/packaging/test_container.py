"""The container files as far as they can be checked without an engine; `make lint` checks their syntax."""

import re
import subprocess
import sys
import tomllib
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

import pytest
import yaml
from packaging.requirements import Requirement
from packaging.utils import canonicalize_name
from quadid_node.process import ARGUMENTS, NODE_ARGUMENTS


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


def test_the_images_are_named_by_their_digests(dockerfile: str) -> None:
    built, run = re.findall(r"^FROM (\S+)", dockerfile, re.MULTILINE)
    assert re.fullmatch(r"ros:jazzy-ros-base@sha256:[0-9a-f]{64}", built)
    assert re.fullmatch(r"ros:jazzy-ros-core@sha256:[0-9a-f]{64}", run), "ros-base has a compiler, colcon and git"


def test_what_only_builds_stays_in_the_first_stage(dockerfile: str, repository: Path) -> None:
    """No compiler, Dask, pyarrow or plots in the image; kernels are compiled where they run, into the volume."""
    _, last = dockerfile.split(" AS build", 1)[1].split("\nFROM ")
    said = re.sub(r"^#.*\n", "", last, flags=re.MULTILINE)
    for tool in ("build-essential", "gcc", "g++", "git", "-dev", "colcon", "ros-base"):
        assert tool not in said, tool
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


def built_for(page: str) -> list[str]:
    """Machines of the page's table, as wheels name them."""
    rows = re.findall(r"^\| `linux/(\w+)` \|", page, re.MULTILINE)
    return [{"amd64": "x86_64", "arm64": "aarch64"}[row] for row in rows]


def test_the_page_says_for_which_machines_and_how_large(dockerfile: str, repository: Path) -> None:
    page = (repository / "docs" / "using-with-ros.md").read_text(encoding="utf-8")
    assert built_for(page) == ["x86_64", "aarch64"]
    assert "docker buildx build --platform linux/arm64 --file docker/Dockerfile" in page
    assert "docker image inspect --format '{{.Size}}' quadid" in page
    assert "--platform" not in dockerfile, "each stage is of the machine that is asked for"


@pytest.mark.slow
def test_everything_that_is_pinned_has_a_wheel_for_each_machine(tmp_path: Path, repository: Path) -> None:
    """The image compiles nothing of the package index: `--only-binary :all:` with the hashes, for Ubuntu 24.04."""
    for machine in built_for((repository / "docs" / "using-with-ros.md").read_text(encoding="utf-8")):
        given = [f"--platform=manylinux_2_{libc}_{machine}" for libc in (17, 27, 28, 31, 34, 39)]
        given += [f"--platform=manylinux2014_{machine}", "--platform=any", "--python-version=3.12"]
        done = subprocess.run(
            [sys.executable, "-m", "pip", "install", "--dry-run", "--ignore-installed", f"--target={tmp_path}",
             "--no-deps", "--require-hashes", "--only-binary=:all:", *given,
             "--requirement", str(repository / "docker" / "requirements.txt")],
            capture_output=True, text=True, check=False,
        )  # fmt: skip
        if "ConnectionError" in done.stderr or "Retrying" in done.stderr:
            pytest.skip(f"no package index here: {done.stderr[-200:]}")
        assert done.returncode == 0, f"{machine}: {done.stderr[-2000:]}"


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
