"""The ROS 2 script of a manoeuvre against real topics: px4_msgs with the fields that it uses are built here.

A stand-in of PX4 hovers, is switched to Offboard, and listens.
"""

import math
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadid.flight.pilot import AXES, PILOT_STEP, scripted
from quadid.report.manoeuvres import written_as
from tests.report.manoeuvre_plan import PLAN, SECONDS, SEGMENTS

pytestmark = pytest.mark.slow
POSITION_MODE, OFFBOARD = 2, 14
SETTLE = 5.0
MESSAGES = {
    "BatteryStatus": "uint64 timestamp\nfloat32 remaining\n",
    "OffboardControlMode": "uint64 timestamp\nbool position\nbool velocity\nbool acceleration\nbool attitude\n",
    "VehicleAttitude": "uint64 timestamp\nfloat32[4] q\n",
    "VehicleAttitudeSetpoint": "uint32 MESSAGE_VERSION = 1\nuint64 timestamp\nfloat32[4] q_d\nfloat32[3] thrust_body\n",
    "VehicleCommand": "uint64 timestamp\nfloat32 param1\nfloat32 param2\nfloat32 param3\nuint32 command\n"
    "uint8 target_system\nuint8 target_component\nuint8 source_system\nuint16 source_component\nbool from_external\n",
    "VehicleLocalPosition": "uint64 timestamp\nbool xy_valid\nbool z_valid\nbool v_xy_valid\nbool v_z_valid\n"
    "float32 x\nfloat32 y\nfloat32 z\nfloat32 vx\nfloat32 vy\nfloat32 vz\n",
    "VehicleStatus": "uint64 timestamp\nuint8 nav_state\n",
}
PACKAGE = """<package format="3"><name>px4_msgs</name><version>0.0.0</version><description>fields in use</description>
<maintainer email="nobody@example.org">nobody</maintainer><license>Apache-2.0</license>
<buildtool_depend>ament_cmake</buildtool_depend><buildtool_depend>rosidl_default_generators</buildtool_depend>
<exec_depend>rosidl_default_runtime</exec_depend><member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>"""
CMAKE = """cmake_minimum_required(VERSION 3.16)
project(px4_msgs)
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
file(GLOB messages RELATIVE "${CMAKE_CURRENT_SOURCE_DIR}" "msg/*.msg")
rosidl_generate_interfaces(${PROJECT_NAME} ${messages})
ament_package()
"""


@pytest.fixture(scope="module")
def px4_messages(tmp_path_factory: pytest.TempPathFactory) -> dict[str, str]:
    """The environment in which Python imports px4_msgs."""
    from quadid_evaluation.studies.ros_load import build_package, importing

    source = tmp_path_factory.mktemp("px4_msgs")
    (source / "msg").mkdir()
    for name, text in MESSAGES.items():
        (source / "msg" / f"{name}.msg").write_text(text, encoding="utf-8")
    (source / "package.xml").write_text(PACKAGE, encoding="utf-8")
    (source / "CMakeLists.txt").write_text(CMAKE, encoding="utf-8")
    build_package(source, source / "prefix")
    return importing(source / "prefix")


@pytest.fixture
def script(px4_messages: dict[str, str], tmp_path: Path) -> tuple[Path, dict[str, str]]:
    """The script and the environment it runs in."""
    path = tmp_path / "fly.py"
    (text,) = written_as(PLAN, "px4", 0.3).values()
    path.write_text(text, encoding="utf-8")
    return path, px4_messages


STAND_IN = """
import json, sys, threading
import rclpy
from px4_msgs.msg import *
from rclpy.executors import ExternalShutdownException
from rclpy.qos import QoSProfile, ReliabilityPolicy
low_at = float(sys.argv[1])
rclpy.init()
node = rclpy.create_node("px4")
qos = QoSProfile(depth=1, reliability=ReliabilityPolicy.BEST_EFFORT)
heard = {"modes": [], "setpoints": [], "commands": []}
clock = lambda: node.get_clock().now().nanoseconds * 1e-9
state = {"nav": 2, "since": None}
def mode(m):
    heard["modes"].append(m.attitude)
    if len(heard["modes"]) == 50:
        state["nav"], state["since"] = 14, clock()
def command(m):
    heard["commands"].append([m.command, m.param1, m.param2, m.param3])
    state["nav"] = 4
node.create_subscription(OffboardControlMode, "fmu/in/offboard_control_mode", mode, qos)
node.create_subscription(VehicleAttitudeSetpoint, "fmu/in/vehicle_attitude_setpoint_v1",
    lambda m: heard["setpoints"].append(
        [1e-6 * m.timestamp, state["nav"], *map(float, m.q_d), float(m.thrust_body[2])]), qos)
node.create_subscription(VehicleCommand, "fmu/in/vehicle_command", command, qos)
out = {k: node.create_publisher(t, "fmu/out/" + k, qos) for k, t in (("battery_status", BatteryStatus),
    ("vehicle_attitude", VehicleAttitude), ("vehicle_local_position", VehicleLocalPosition),
    ("vehicle_status", VehicleStatus))}
def tick():
    low = state["since"] is not None and clock() - state["since"] > low_at
    out["battery_status"].publish(BatteryStatus(remaining=0.2 if low else 0.9))
    out["vehicle_attitude"].publish(VehicleAttitude(q=[1.0, 0.0, 0.0, 0.0]))
    out["vehicle_local_position"].publish(VehicleLocalPosition(
        xy_valid=True, z_valid=True, v_xy_valid=True, v_z_valid=True,
        x=1.0, y=2.0, z=-20.0))
    out["vehicle_status"].publish(VehicleStatus(nav_state=state["nav"]))
node.create_timer(0.02, tick)
threading.Thread(target=lambda: (sys.stdin.read(), rclpy.try_shutdown()), daemon=True).start()
try:
    rclpy.spin(node)
except ExternalShutdownException:
    pass  # how `try_shutdown` ends `spin`
print(json.dumps(heard))
"""


def fly(script: tuple[Path, dict[str, str]], low_at: float, hover: float = 0.4) -> tuple[int, str, dict[str, Any]]:
    """Exit code and words of the script, and what the stand-in heard; the battery falls `low_at` s after Offboard."""
    import json

    path, environment = script
    stand_in = path.with_name("stand_in.py")
    stand_in.write_text(STAND_IN, encoding="utf-8")
    autopilot = subprocess.Popen(
        [sys.executable, str(stand_in), str(low_at)],
        env=environment,
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
    )
    try:
        done = subprocess.run(
            [sys.executable, str(path), "--ros-args", "-p", f"hover_thrust:={hover}"],
            env=environment,
            capture_output=True,
            text=True,
            timeout=900,
            check=False,
        )
        out, _ = autopilot.communicate("", timeout=900)
    finally:
        autopilot.kill()
    return done.returncode, done.stdout + done.stderr, json.loads(out)


def test_it_flies_the_manoeuvre_once_in_offboard_and_asks_for_hold(script: tuple[Path, dict[str, str]]) -> None:
    code, text, heard = fly(script, math.inf)
    assert code == 0, text
    assert "begun" in text
    assert "done" in text
    assert all(heard["modes"])
    assert heard["commands"] == [[176, 1.0, 4.0, 3.0]]
    rows = np.array(heard["setpoints"])
    before = rows[rows[:, 1] == POSITION_MODE]
    np.testing.assert_allclose(before[:, 2:], np.tile([1.0, 0.0, 0.0, 0.0, -0.4], (len(before), 1)), atol=1e-6)
    flown = rows[rows[:, 1] == OFFBOARD]
    t = flown[:, 0] - flown[0, 0] - SETTLE
    assert t[-1] == pytest.approx(SECONDS, abs=1.5)
    w, x, y, z = flown[:, 2:6].T
    angles = {
        "roll": np.arctan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y)),
        "pitch": np.arcsin(2 * (w * y - z * x)),
        "yaw": np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z)),
    }
    wanted = scripted(SEGMENTS, 1, round(SECONDS / PILOT_STEP))
    grid = PILOT_STEP * np.arange(len(wanted))
    angles["throttle"] = -flown[:, 6] / 0.4 * np.cos(angles["roll"]) * np.cos(angles["pitch"]) - 1.0

    def missed(late: float, axis: str) -> float:
        asked = np.interp(t - late, grid, wanted[:, AXES.index(axis)], left=0.0, right=0.0)
        return float(np.std(angles[axis] - asked) / np.std(asked))

    # When exactly it begins, only the script knows: topics take their time.
    late = min(np.arange(-1.5, 1.5, 0.005), key=lambda shift: missed(shift, "roll"))
    assert {axis: missed(late, axis) for axis in AXES} == pytest.approx(dict.fromkeys(AXES, 0.0), abs=0.05)


def test_a_low_battery_ends_it(script: tuple[Path, dict[str, str]]) -> None:
    code, text, heard = fly(script, SETTLE + 2.0)
    assert code == 1
    assert "ended, battery 20 %" in text
    assert heard["commands"] == [[176, 1.0, 4.0, 3.0]]
    rows = np.array(heard["setpoints"])
    assert np.ptp(rows[rows[:, 1] == OFFBOARD][:, 0]) < SETTLE + 3.0


def test_without_a_hover_thrust_it_does_not_start(script: tuple[Path, dict[str, str]]) -> None:
    """A guess could be half of it or twice."""
    code, text, heard = fly(script, math.inf, 0.0)
    assert code == 1
    assert "give hover_thrust" in text
    assert not heard["setpoints"]
