"""Checks of `colcon test` without a running middleware: the package's manifest, its launch files, its lint."""

import ast
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest
import yaml
from quadid_replay.ros_messages import TYPES

PACKAGE = Path(__file__).resolve().parents[1]
ROS = ("_msgs", "_interfaces", "_srvs")
"""Ends of the names of interface packages; the others begin with one of:"""
LIBRARIES = ("rclpy", "ament_", "launch", "rosidl_", "rpyutils", "tf2_")
OPTIONAL = {"px4_msgs", "mavros_msgs", "actuator_msgs", "mav_msgs"}
"""Whoever has such a stack has its messages."""


def depends(kind: str) -> set[str]:
    """Packages that the manifest names for a purpose."""
    return {element.text or "" for element in ET.parse(PACKAGE / "package.xml").findall(kind)}


def test_every_ros_package_that_is_imported_is_named_and_no_other() -> None:
    roots = {kind.split("/")[0] for kind in TYPES}  # types of inputs are imported by their names
    for file in (*PACKAGE.glob("quadid_node/*.py"), *PACKAGE.glob("launch/*.py")):
        for node in ast.walk(ast.parse(file.read_text(encoding="utf-8"))):
            names = [a.name for a in node.names] if isinstance(node, ast.Import) else []
            names += [node.module] if isinstance(node, ast.ImportFrom) and node.module else []
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                names += re.findall(r"^(\w+_(?:msgs|srvs))/(?:\w+/)?\w+$", node.value)
            roots |= {name.split(".")[0] for name in names}
    used = {name for name in roots if name.endswith(ROS) or name.startswith(LIBRARIES)}
    assert {"rclpy", "launch_ros"} <= used
    used |= {"bond", "quadid"}  # imported by its name, where it is installed; the core
    missing = used - depends("exec_depend") - OPTIONAL
    assert not missing, f"package.xml: name {sorted(missing)} as exec_depend"
    others = {name for name in depends("exec_depend") - used - {"ros2launch"} if not name.startswith("python3-")}
    assert not others, f"package.xml: {sorted(others)} are imported nowhere"
    debian = {name.removeprefix("python3-") for name in depends("exec_depend") if name.startswith("python3-")}
    assert debian <= roots, "Debian's packages that the node does not import, or has in another version"
    assert "pydantic" not in debian, "Ubuntu 24.04 has version 1.10, which is too old: pip brings it"


@pytest.mark.parametrize("file", sorted(PACKAGE.glob("launch/*.launch.py")), ids=lambda file: file.name)
def test_a_launch_file_has_what_ros2_launch_calls(file: Path) -> None:
    tree = ast.parse(file.read_text(encoding="utf-8"))
    assert "generate_launch_description" in {n.name for n in tree.body if isinstance(n, ast.FunctionDef)}


def test_the_configuration_of_rosdoc2_is_where_the_manifest_says() -> None:
    export = ET.parse(PACKAGE / "package.xml").find("export")
    assert export is not None
    about, given = yaml.safe_load_all((PACKAGE / (export.findtext("rosdoc2") or "")).read_text(encoding="utf-8"))
    assert about == {"type": "rosdoc2 config", "version": 1}
    assert (PACKAGE / given["settings"]["python_source"] / "__init__.py").is_file()


def test_the_manifest_is_valid_by_its_schema() -> None:
    xmllint = pytest.importorskip("ament_xmllint.main", reason="one of ROS' linters: runs where ROS is installed")
    assert xmllint.main(argv=[str(PACKAGE)]) == 0


def test_code_passes_the_linter_of_ros_with_lines_of_this_length() -> None:
    flake8 = pytest.importorskip("ament_flake8.main", reason="one of ROS' linters: comes with ROS, and with 'make dev'")
    assert flake8.main(argv=["--config", str(PACKAGE / "setup.cfg"), str(PACKAGE)]) == 0


def test_docstrings_pass_the_linter_of_ros_in_the_form_that_is_used_here() -> None:
    pep257 = pytest.importorskip("ament_pep257.main", reason="one of ROS' linters: comes with ROS, and with 'make dev'")
    left_out = ["D105", "D107", "D417"]  # magic methods; arguments that their names explain
    given = ["--convention", "google", "--add-ignore", *left_out, "--"]
    assert pep257.main(argv=[*given, str(PACKAGE / "quadid_node"), str(PACKAGE / "launch")]) == 0
