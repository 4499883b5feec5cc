"""Examples for controllers: the shortest one in Python against a publisher; the checks of the one in C++, compiled."""

import importlib.util
import shutil
import subprocess
import sys
from pathlib import Path

import pytest
from quadid_node.inputs import to_message

from quadid_node import messages
from tests.node.peers import Ear, Process
from tests.online.test_gate import TRUE, online_set, scaled
from tests.ros.test_workspace import colcon

CHECKS = """
#include <cmath>
#include <functional>
#include <iostream>
#include "checks.hpp"
using quadid_example::Set;
int main() {
  auto good = [] {
    Set s; s.schema_version = Set::SCHEMA_VERSION; s.state = Set::STATE_ACCEPTED; s.sequence = 9; s.mass = 1.3;
    s.names = {"b", "J_xx"}; s.units = {"N s^2/rad^2", "kg m^2"}; s.values = {2e-5, 0.012}; s.status = {0, 0};
    return s;
  };
  const std::function<void(Set &)> spoil[] = {
    [](Set &) {}, [](Set & s) {s.schema_version = 2;}, [](Set & s) {s.state = Set::STATE_NONE;},
    [](Set & s) {s.sequence = 0;}, [](Set & s) {s.out_of_date = true;}, [](Set & s) {s.mass = std::nan("");},
    [](Set & s) {s.status[1] = Set::STATUS_UNRELIABLE;}, [](Set & s) {s.units[1] = "g m^2";},
    [](Set & s) {s.values[1] = 0.02;}, [](Set & s) {s.values[1] = std::nan("");}, [](Set & s) {s.names[1] = "d";},
    [](Set & s) {s.values.pop_back();}, [](Set & s) {s.units.clear();}, [](Set & s) {s.status.resize(1);},
  };
  for (const auto & change : spoil) {
    Set s = good(); change(s); double value = 0.0;
    std::cout << (quadid_example::objection(s, {}, value).empty() ? "applied" : "refused") << "\\n";
  }
}
"""


def test_the_checks_in_cpp_apply_a_good_set_and_refuse_each_spoilt_one(tmp_path: Path, repository: Path) -> None:
    compiler = shutil.which("g++") or shutil.which("clang++")
    if compiler is None:
        pytest.skip("no C++ compiler")
    include = Path(sys.prefix, "include")
    packages = [f"-I{folder}" for folder in include.iterdir() if folder.is_dir()]
    source, program = tmp_path / "checks.cpp", tmp_path / "checks"
    source.write_text(CHECKS)
    own = f"-I{repository / 'examples' / 'cpp_controller' / 'src'}"
    command = [compiler, "-std=c++17", "-Wall", "-Wextra", "-Werror", own, *packages, str(source), "-o", str(program)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    said = subprocess.run([str(program)], capture_output=True, text=True, check=True).stdout.split()
    assert said == ["applied"] + ["refused"] * 13


def test_colcon_sees_the_package_in_cpp_and_builds_it_where_rclcpp_is(tmp_path: Path, repository: Path) -> None:
    package = repository / "examples" / "cpp_controller"
    assert "quadid_cpp_controller" in colcon(tmp_path, "list", "--base-paths", str(package))
    if not Path(sys.prefix, "share", "rclcpp").is_dir():
        pytest.skip("rclcpp is on no package index: built where ROS is installed")
    colcon(tmp_path, "build", "--base-paths", str(package))


def test_the_shortest_controller_has_forty_lines_and_applies_a_set(repository: Path) -> None:
    from quadid_msgs.msg import ParameterSet
    from quadid_node.publish import LATCHED_QOS

    assert importlib.util.find_spec("rclpy") is not None
    path = repository / "examples" / "minimal_controller.py"
    assert len(path.read_text().splitlines()) <= 42
    with Ear() as ear, Process(sys.executable, str(path)) as controller:
        publisher = ear.node.create_publisher(ParameterSet, "quadid/parameters", LATCHED_QOS)

        def send(values: dict[str, float], sequence: int, **fields: float) -> None:
            told = messages.parameter_set(online_set(values), "quad1")
            publisher.publish(to_message(messages.PARAMETER_SET, {**told, "mass": 1.3, "sequence": sequence, **fields}))

        send(scaled(J_xx=1.2), 1)
        assert ear.until(lambda: "set 1: J_xx" in controller.text, 30.0), controller.text
        send(TRUE, 2, mass=1.5)
        send(scaled(J_xx=2.5), 3)
        send(TRUE, 4)
        assert ear.until(lambda: "set 4" in controller.text, 20.0), controller.text
        assert "set 2" not in controller.text
        assert "set 3" not in controller.text
