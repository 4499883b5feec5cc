"""The checkout in a ROS environment: colcon workspace, quadid_msgs, and the recipe of docs/using-with-ros.md."""

import importlib.util
import os
import re
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.conftest import absent

# --- The checkout as source of a colcon workspace: three packages, laid out as `ros2 run` and `ros2 launch` want them


def colcon(scratch: Path, *arguments: str, **environment: str) -> str:
    """Run this environment's colcon in a scratch folder; its output, or the test fails with it."""
    if importlib.util.find_spec("colcon_core") is None:
        absent(f"colcon is not installed in {sys.prefix}: run 'make dev'")
    path = f"{Path(sys.prefix, 'bin')}{os.pathsep}{os.environ['PATH']}"
    done = subprocess.run(
        [sys.executable, "-m", "colcon", "--log-base", str(scratch / "log"), *arguments],
        cwd=scratch,
        env={**os.environ, "PATH": path, **environment},
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def assert_layout(prefix: Path, package: Path) -> None:
    """Files that `ros2 run quadid_node identify` and `ros2 launch quadid_node identify.launch.py` find there."""
    assert (prefix / "share/ament_index/resource_index/packages/quadid_node").is_file()
    assert (prefix / "share/quadid_node/package.xml").is_file()
    for executable in ("identify", "replay", "bridge"):
        assert os.access(prefix / "lib/quadid_node" / executable, os.X_OK)
    for folder in ("launch", "config"):
        expected = {path.name for path in (package / folder).iterdir() if path.suffix in (".py", ".yaml", ".xml")}
        assert expected
        assert {path.name for path in (prefix / "share/quadid_node" / folder).iterdir()} == expected


@pytest.mark.parametrize("depth", ["root", "workspace"])
def test_colcon_finds_exactly_three_packages(depth: str, tmp_path: Path, repository: Path) -> None:
    base = repository
    if depth == "workspace":
        base = tmp_path / "ws"
        (base / "src").mkdir(parents=True)
        (base / "src" / "quadid").symlink_to(repository)
    listed = colcon(tmp_path, "list", "--base-paths", str(base)).splitlines()
    found = {line.split("\t")[0]: line.split("\t")[2] for line in listed}
    ours = {"quadid": "(ros.ament_python)", "quadid_msgs": "(ros.ament_cmake)", "quadid_node": "(ros.ament_python)"}
    assert found == ours


@pytest.mark.parametrize("package", ["core", "msgs", "quadid_node", "examples/cpp_controller"])
def test_a_manifest_is_valid_and_warns_of_nothing(package: str, repository: Path) -> None:
    parsed = pytest.importorskip("catkin_pkg.package", reason="comes with the ros extra")
    warnings = list[str]()
    found = parsed.parse_package(str(repository / package), warnings=warnings)
    found.validate(warnings=warnings)
    assert warnings == []
    assert found.licenses == ["Apache-2.0"]


def test_the_linters_that_the_messages_name_are_run_with_their_tests(repository: Path) -> None:
    """`colcon test` of an interface package runs what its build asks for, not what its manifest names."""
    named = re.findall(r"<test_depend>(\w+)</test_depend>", (repository / "msgs" / "package.xml").read_text())
    assert named == ["ament_lint_auto", "ament_lint_common"]
    build = (repository / "msgs" / "CMakeLists.txt").read_text(encoding="utf-8")
    assert re.search(r"if\(BUILD_TESTING\)\s+find_package\(ament_lint_auto REQUIRED\)\s+ament_lint_auto_find", build)


@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "symlinked"])
def test_the_core_builds_whole_and_brings_its_command(options: list[str], tmp_path: Path, repository: Path) -> None:
    """All that is tracked is there, as in the wheel; the command runs from the workspace, not from this environment."""
    before = sorted(path.name for path in (repository / "core").iterdir())
    colcon(tmp_path, "build", *options, "--base-paths", str(repository / "core"))
    assert sorted(path.name for path in (repository / "core").iterdir()) == before, "the build left something there"
    prefix = tmp_path / "install" / "quadid"
    assert (prefix / "share/ament_index/resource_index/packages/quadid").is_file()
    (built,) = (prefix / "lib").glob("python*/site-packages")
    place = tmp_path / "build" / "quadid" if options else built
    command = [sys.executable, str(prefix / "bin" / "quadid"), "vehicles"]
    paths = os.pathsep.join([str(place), str(built)])
    environment = {**os.environ, "PYTHONPATH": paths}
    done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False)
    assert "pelican" in done.stdout, done.stderr
    where = [sys.executable, "-c", "import quadid, quadid_command; print(quadid.__file__)"]
    told = subprocess.run(where, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True).stdout
    assert told.startswith(str(place))
    folders = {"quadid": "quadid", "replay/quadid_replay": "quadid_replay", "aliases": ""}
    folders |= {"evaluation/quadid_evaluation": "quadid_evaluation", "msgs/msg": "quadid_replay/schemas/quadid_msgs"}
    for folder, name in folders.items():
        listed = subprocess.run(["git", "ls-files", folder], cwd=repository, capture_output=True, text=True, check=True)
        for path in map(Path, listed.stdout.split()):
            if path.name != "COLCON_IGNORE" and not (repository / path).is_dir():
                assert (place / name / path.relative_to(folder)).is_file(), path


@pytest.mark.parametrize("options", [[], ["--symlink-install"]], ids=["copied", "symlinked"])
def test_node_builds_and_lands_where_ros2_looks(options: list[str], tmp_path: Path, repository: Path) -> None:
    package = repository / "quadid_node"
    before = sorted(path.name for path in package.iterdir())
    colcon(tmp_path, "build", *options, "--base-paths", str(package))
    assert_layout(tmp_path / "install" / "quadid_node", package)
    assert sorted(path.name for path in package.iterdir()) == before, "the build left something in the checkout"


def test_colcon_runs_the_tests_of_the_node(tmp_path: Path, repository: Path) -> None:
    package = str(repository / "quadid_node")
    colcon(tmp_path, "build", "--base-paths", package)
    colcon(tmp_path, "test", "--base-paths", package, "--return-code-on-test-failure")
    told = colcon(tmp_path, "test-result", "--all")
    counted = re.search(r"Summary: (\d+) tests, (\d+) errors, (\d+) failures", told)
    assert counted is not None, told
    assert int(counted[1]) >= 5
    assert counted[2] == counted[3] == "0"


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_whole_workspace_builds(tmp_path: Path, repository: Path) -> None:
    """Core, messages and node by one `colcon build`, as in a ROS installation; about a minute."""
    colcon(
        tmp_path,
        *("build", "--base-paths", str(repository), "--cmake-args", "-DBUILD_TESTING=OFF", "-Wno-dev"),
        *(f"-DPython3_EXECUTABLE={sys.executable}", f"-DCMAKE_PROJECT_INCLUDE={repository}/tools/wheel_targets.cmake"),
        AMENT_PREFIX_PATH=sys.prefix,
        CMAKE_PREFIX_PATH=sys.prefix,
    )
    assert_layout(tmp_path / "install" / "quadid_node", repository / "quadid_node")
    messages = tmp_path / "install" / "quadid_msgs"
    assert (messages / "share/ament_index/resource_index/rosidl_interfaces/quadid_msgs").is_file()
    assert (messages / "share/quadid_msgs/msg/ParameterSet.json").is_file()  # carries the type hash


@pytest.mark.parametrize(("target", "wanted"), [("messages", False), ("test-slow", True)])
def test_who_wants_the_messages_needs_no_linters(target: str, wanted: bool, tmp_path: Path, repository: Path) -> None:
    make = shutil.which("make")
    if make is None:
        pytest.skip("no make")
    command = [make, "--dry-run", target, f"VENV={tmp_path / 'venv'}", f"PYTHON={sys.executable}"]
    environment = {k: v for k, v in os.environ.items() if k not in ("MAKEFLAGS", "MAKELEVEL")}
    done = subprocess.run(command, cwd=repository, env=environment, capture_output=True, text=True, check=True)
    assert ".[ros]" in done.stdout
    assert (".[dev]" in done.stdout) is wanted
    if wanted:
        assert done.stdout.index(".[dev]") < done.stdout.index(".[ros]")


# --- quadid_msgs in this environment: complete and documented


NAMES = ("AttitudeCommand", "Diagnosis", "Finding", "FitStatus", "MotorCommand", "ParameterSet")


@pytest.mark.parametrize("name", NAMES)
def test_every_message_has_type_support(name: str) -> None:
    import quadid_msgs.msg
    from rclpy.serialization import deserialize_message, serialize_message

    kind: Any = getattr(quadid_msgs.msg, name)
    message = kind()
    assert deserialize_message(serialize_message(message), kind) == message


@pytest.mark.parametrize("name", NAMES)
def test_installed_definition_is_the_one_in_the_checkout(name: str, repository: Path) -> None:
    installed = Path(sys.prefix, "share", "quadid_msgs", "msg", f"{name}.msg").read_text(encoding="utf-8")
    assert installed == (repository / "msgs" / "msg" / f"{name}.msg").read_text(encoding="utf-8"), "run 'make messages'"


@pytest.mark.parametrize("name", NAMES)
def test_every_number_names_its_unit_or_meaning(name: str, repository: Path) -> None:
    text = (repository / "msgs" / "msg" / f"{name}.msg").read_text(encoding="utf-8")
    fields = [line for line in text.splitlines() if re.match(r"[A-Za-z]", line) and "=" not in line.split("#")[0]]
    assert fields
    for line in fields:
        assert "#" in line, f"{name}: no comment on '{line}'"
        if line.startswith("float64"):
            assert re.search(r"# \[\S+\]|# row-major", line), f"{name}: no unit in '{line}'"


def test_the_study_of_load_builds_every_message_of_its_stacks() -> None:
    from quadid_evaluation.studies.ros_load import MESSAGES, SOURCES
    from quadid_node.inputs import source

    heard = {entry.type for name in SOURCES for entry in source(name).inputs}
    built = {f"{package}/{kind}" for package, kinds in MESSAGES.items() for kind in kinds}
    assert {kind for kind in heard if kind.split("/")[0] in MESSAGES} <= built


def test_what_the_study_of_load_builds_is_no_package_of_the_checkout(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """`colcon build` refused the checkout once the study had run in it: each of its packages is there twice."""
    from quadid_evaluation.studies.ros_load import built

    monkeypatch.setattr(shutil, "which", lambda *names, **options: None)
    with pytest.raises(SystemExit, match="cmake is not installed"):
        built(tmp_path / "build" / "ros_load")
    assert (tmp_path / "build" / "ros_load" / "COLCON_IGNORE").is_file()


# --- The environment that docs/using-with-ros.md makes beside the Python packages of Debian, line by line


DEBIANS = Path("/usr/bin/python3")
COLCON = "colcon-core colcon-ros colcon-python-setup-py colcon-recursive-crawl colcon-package-selection 'setuptools<80'"
SHOW = "import sys, pydantic; print(pydantic.VERSION, sys.prefix)"


def page_lines(repository: Path) -> list[str]:
    """The lines of the page that make the environment, install into it and build."""
    text = (repository / "docs" / "using-with-ros.md").read_text(encoding="utf-8")
    (block,) = re.findall(r"^```\n(.*?python3 -m venv.*?)^```", text.split("## Run")[0], re.S | re.M)
    return [line for line in block.splitlines() if line.startswith(("python3 -m venv", "venv/bin/"))]


def put_debians_packages(folder: Path) -> None:
    """Stands in for packages of Debian that are too old: seen by every Python there, with no list of their files."""
    for name, version, text in (
        ("pydantic", "1.10.14", 'VERSION = "1.10.14"\n'),
        ("coverage", "7.4.4", "class Coverage: ...\n"),  # comes with colcon; numba imports it
    ):
        for file, lines in {
            f"{name}/__init__.py": text,
            f"{name}-{version}.dist-info/METADATA": f"Metadata-Version: 2.1\nName: {name}\nVersion: {version}\n",
            f"{name}-{version}.dist-info/INSTALLER": "debian\n",
        }.items():
            (folder / file).parent.mkdir(parents=True, exist_ok=True)
            (folder / file).write_text(lines, encoding="utf-8")


def test_the_page_runs_programs_by_the_environment_that_it_makes(repository: Path) -> None:
    """Debian's own Python finds pydantic 1.10, with which the examples do not even start."""
    text = (repository / "docs" / "using-with-ros.md").read_text(encoding="utf-8")
    assert re.findall(r"^python\S* (?!-m venv).*", text, re.M) == []
    assert all((repository / path).is_file() for path in re.findall(r"src/quadid/(\S+\.(?:py|yaml|txt))", text))


@pytest.mark.slow
@pytest.mark.timeout(3600)
def test_the_environment_beside_debians_packages(tmp_path: Path, repository: Path) -> None:
    """Debian's pydantic 1.10, which cannot be uninstalled, stays; the environment has what quadid needs."""
    python = DEBIANS if DEBIANS.exists() else Path(sys.executable)
    scrubbed = {k: v for k, v in os.environ.items() if not k.startswith(("_ROS", "LD_", "VIRTUAL", "PYTHON"))}
    environment = {**scrubbed, "PATH": f"{python.parent}{os.pathsep}{os.environ['PATH']}"}
    environment["PYTHONUSERBASE"] = str(tmp_path / "debian")

    def run(line: str, **options: bool) -> str:
        done = subprocess.run(
            line, shell=True, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        if "ensurepip" in done.stderr or "No matching distribution" in done.stderr:
            pytest.skip(f"no venv module or no package index here: {done.stderr[-200:]}")
        assert options.get("may_fail") or done.returncode == 0, f"{line}\n{done.stdout}{done.stderr}"
        return done.stdout.strip()

    (tmp_path / "src").mkdir()
    (tmp_path / "src" / "quadid").symlink_to(repository)
    if not run(f"{python} -c '{SHOW}'", may_fail=True).startswith("1."):
        put_debians_packages(Path(run(f"{python} -m site --user-site", may_fail=True)))
    before = run(f"{python} -c '{SHOW}'")
    assert before.startswith("1."), "as Debian 12 and Ubuntu 24.04 have it"
    make, install, build = page_lines(repository)
    for line in (make, install):
        assert "--break-system-packages" not in line
        run(line)
    run(f"venv/bin/pip install {COLCON}")  # in ROS, colcon is apt's
    assert build.startswith("venv/bin/python -m colcon build && source install/setup.bash")
    run("venv/bin/python -m colcon build --packages-select quadid")  # the other two need ROS
    version, prefix = run(f"venv/bin/python -c '{SHOW}'").split()
    assert int(version.split(".")[0]) >= 2
    run("venv/bin/python -c 'import numba'")
    assert Path(prefix) == tmp_path / "venv"
    assert "pelican" in run(". install/local_setup.sh && quadid vehicles")
    assert run(". install/local_setup.sh && command -v quadid") == str(tmp_path / "install/quadid/bin/quadid")
    assert "not found" in run("venv/bin/pip show quadid 2>&1 || true"), "installed once"
    assert run(f"{python} -c '{SHOW}'") == before, "Debian's own packages are as they were"
