"""`make ros-load`: the ROS node on a loaded machine, with the streams of three presets in real time.

A simulated flight is published as ROS, PX4's bridge and MAVROS publish it, while busy loops keep the machine at a load.
Told are the largest backlog of the status and the errors of the sets on the parameter topic.  px4_msgs and mavros_msgs
are built with the fields that the node reads (cmake, a compiler).
"""

import math
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import rclpy
from quadid_node.inputs import message_class, to_message
from quadid_replay import write_mcap
from quadid_replay.columns import flip_attitude, flip_body
from quadid_replay.motors import RPM
from rclpy.qos import HistoryPolicy, QoSProfile, ReliabilityPolicy

from quadid.data.window import Recording
from quadid.flight import fly
from quadid.flight.setup import TABLE_2
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.ros_flight import beside
from quadid_evaluation.harness import options, put, table
from quadid_evaluation.studies.autopilot import stored

ROOT = Path(__file__).resolve().parents[3]
SOURCES = ("canonical", "px4", "mavros")
RATE = 200.0
"""Of every channel [Hz]."""
MESSAGES = {
    "px4_msgs": {
        "SensorCombined": "uint64 timestamp\nfloat32[3] gyro_rad\nuint32 gyro_integral_dt\n"
        "float32[3] accelerometer_m_s2",
        "VehicleAttitude": "uint64 timestamp\nuint64 timestamp_sample\nfloat32[4] q",
        "EscReport": "uint64 timestamp\nint32 esc_rpm\nuint8 actuator_function",
        "EscStatus": "uint64 timestamp\nuint8 esc_count\nEscReport[8] esc",
        "ActuatorMotors": "uint64 timestamp\nfloat32[12] control",
        "VehicleAttitudeSetpoint": "uint64 timestamp\nfloat32[4] q_d\nfloat32[3] thrust_body",
        "VehicleLocalPosition": "uint64 timestamp\nuint64 timestamp_sample\nbool xy_valid\nbool v_xy_valid\n"
        "float32 x\nfloat32 y\nfloat32 z\nfloat32 vx\nfloat32 vy\nfloat32 vz",
        "BatteryStatus": "uint64 timestamp\nfloat32 voltage_v",
        "VehicleStatus": "uint64 timestamp\nuint8 system_type",
    },
    "mavros_msgs": {
        "ESCTelemetryItem": "int32 rpm",
        "ESCTelemetry": "std_msgs/Header header\nESCTelemetryItem[] esc_telemetry",
        "ESCStatusItem": "int32 rpm",
        "ESCStatus": "std_msgs/Header header\nESCStatusItem[] esc_status",
        "RCOut": "std_msgs/Header header\nuint16[] channels",
        "AttitudeTarget": "std_msgs/Header header\ngeometry_msgs/Quaternion orientation\nfloat32 thrust",
    },
}
"""Fields that the node reads, by package and type."""
NEEDED = ("std_msgs", "geometry_msgs")
PACKAGE = """<package format="3"><name>{name}</name><version>0.0.0</version><description>fields in use</description>
<maintainer email="nobody@example.org">nobody</maintainer><license>Apache-2.0</license>
<buildtool_depend>ament_cmake</buildtool_depend><buildtool_depend>rosidl_default_generators</buildtool_depend>{depends}
<exec_depend>rosidl_default_runtime</exec_depend><member_of_group>rosidl_interface_packages</member_of_group>
<export><build_type>ament_cmake</build_type></export></package>"""
CMAKE = """cmake_minimum_required(VERSION 3.16)
project({name})
find_package(ament_cmake REQUIRED)
find_package(rosidl_default_generators REQUIRED)
find_package(std_msgs REQUIRED)
find_package(geometry_msgs REQUIRED)
file(GLOB messages RELATIVE "${{CMAKE_CURRENT_SOURCE_DIR}}" "msg/*.msg")
rosidl_generate_interfaces(${{PROJECT_NAME}} ${{messages}} DEPENDENCIES std_msgs geometry_msgs)
ament_package()
"""


def built(folder: Path) -> dict[str, str]:
    """Builds the message packages where they are not; returns the variables with which Python imports them."""
    prefix = folder / "prefix"
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "COLCON_IGNORE").touch()  # source and installed, each is there twice
    for name, messages in MESSAGES.items():
        source = folder / name
        if (prefix / "share" / name / "package.xml").is_file():
            continue
        (source / "msg").mkdir(parents=True, exist_ok=True)
        for kind, text in messages.items():
            (source / "msg" / f"{kind}.msg").write_text(f"{text}\n", encoding="utf-8")
        depends = "".join(f"<depend>{other}</depend>" for other in NEEDED)
        (source / "package.xml").write_text(PACKAGE.format(name=name, depends=depends), encoding="utf-8")
        (source / "CMakeLists.txt").write_text(CMAKE.format(name=name), encoding="utf-8")
        build_package(source, prefix)
    return importing(prefix)


def build_package(source: Path, prefix: Path) -> None:
    """Builds a message package with the ROS wheels of this Python, and installs it into a folder."""
    environment = {k: v for k, v in os.environ.items() if k not in ("CMAKE_PREFIX_PATH", "PYTHONPATH", "ROS_DISTRO")}
    environment |= {"AMENT_PREFIX_PATH": sys.prefix, "PATH": f"{sys.prefix}/bin:{os.environ['PATH']}"}
    cmake, build = shutil.which("cmake", path=environment["PATH"]), source / "build"
    if cmake is None:
        raise SystemExit("cmake is not installed")
    variables = {
        "BUILD_TESTING": "OFF",
        "CMAKE_PREFIX_PATH": sys.prefix,
        "CMAKE_INSTALL_PREFIX": prefix,
        "Python3_EXECUTABLE": sys.executable,
        "CMAKE_PROJECT_INCLUDE": ROOT / "tools" / "wheel_targets.cmake",
    }
    for arguments in (
        ["-S", source, "-B", build, "-Wno-dev", *(f"-D{name}={value}" for name, value in variables.items())],
        ["--build", build, "--parallel", "2"],
        ["--install", build],
    ):
        subprocess.run(
            [cmake, *map(str, arguments)], env=environment, check=True, stdout=subprocess.DEVNULL, timeout=500
        )


def importing(prefix: Path) -> dict[str, str]:
    """Environment in which Python imports the message packages that are installed in a folder."""
    (packages,) = prefix.glob("lib/python*/site-packages")
    libraries = f"{prefix / 'lib'}:{os.environ.get('LD_LIBRARY_PATH', '')}"
    return {**os.environ, "PYTHONPATH": str(packages), "LD_LIBRARY_PATH": libraries}


Rows = Iterator[tuple[float, str, str, Callable[[float], dict[str, Any]]]]
"""Time in the flight [s], topic, type, and the fields of the message at an absolute time [s]."""


def _header(t: float) -> dict[str, Any]:
    ns = round(t * 1e9)
    return {"stamp": {"sec": ns // 10**9, "nanosec": ns % 10**9}, "frame_id": "base_link"}


def _axes(names: str, values: Any) -> dict[str, float]:
    return dict(zip(names, map(float, values), strict=True))


def px4(recording: Recording) -> Rows:
    """Messages as the uXRCE-DDS bridge publishes them, with ESCs that report."""
    gyro, accel, attitude, rotors = (recording.channels[c] for c in ("gyro", "accel", "attitude", "rotor_speed"))

    def stamped(at: float, **fields: Any) -> dict[str, Any]:
        return {"timestamp": round(at * 1e6), **fields}

    for t, rates, force in zip(gyro.t, gyro.values, accel.values, strict=True):
        fields = partial(stamped, gyro_rad=rates, accelerometer_m_s2=force)
        yield t, "fmu/out/sensor_combined", "px4_msgs/SensorCombined", fields
    for t, q in zip(attitude.t, attitude.values, strict=True):
        yield (
            t,
            "fmu/out/vehicle_attitude",
            "px4_msgs/VehicleAttitude",
            lambda at, q=q: stamped(at, timestamp_sample=round(at * 1e6), q=q),  # type: ignore[misc]
        )
    for t, speeds in zip(rotors.t, rotors.values, strict=True):
        reports = [{"esc_rpm": round(w / RPM), "actuator_function": 101 + i} for i, w in enumerate(speeds)]
        fields = partial(stamped, esc_count=len(speeds), esc=reports + [{}] * (8 - len(speeds)))
        yield t, "fmu/out/esc_status", "px4_msgs/EscStatus", fields


def mavros(recording: Recording) -> Rows:
    """Messages as MAVROS publishes them, with telemetry of the ESCs."""
    gyro, accel, attitude, rotors = (recording.channels[c] for c in ("gyro", "accel", "attitude", "rotor_speed"))
    absent = [-1.0] + [0.0] * 8

    def stamped(at: float, **fields: Any) -> dict[str, Any]:
        return {"header": _header(at), **fields}

    for t, rates, force in zip(gyro.t, flip_body(gyro.values), flip_body(accel.values), strict=True):
        motion: dict[str, Any] = {"angular_velocity": _axes("xyz", rates), "linear_acceleration": _axes("xyz", force)}
        fields = partial(stamped, orientation_covariance=absent, **motion)
        yield t, "mavros/imu/data_raw", "sensor_msgs/Imu", fields
    for t, q in zip(attitude.t, flip_attitude(attitude.values), strict=True):
        yield t, "mavros/imu/data", "sensor_msgs/Imu", partial(stamped, orientation=_axes("wxyz", q))
    for t, speeds in zip(rotors.t, rotors.values, strict=True):
        fields = partial(stamped, esc_telemetry=[{"rpm": round(w / RPM)} for w in speeds])
        yield t, "mavros/esc_telemetry/telemetry", "mavros_msgs/ESCTelemetry", fields


def publish(stack: str, recording: Recording) -> None:
    """Publishes the messages of a stack, each when its time has come."""
    qos = QoSProfile(depth=100, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
    rclpy.init()
    node, publishers = rclpy.create_node("stack"), dict[str, Any]()
    rows = sorted({"px4": px4, "mavros": mavros}[stack](recording), key=lambda row: row[0])
    for _, topic, kind, _ in rows:
        if topic not in publishers:
            publishers[topic] = node.create_publisher(message_class(kind), topic, qos)
    time.sleep(3.0)  # subscribers find them
    begin = time.time() - rows[0][0]
    for t, topic, kind, fields in rows:
        time.sleep(max(begin + t - time.time(), 0.0))
        publishers[topic].publish(to_message(kind, fields(begin + t)))
    time.sleep(0.5)
    node.destroy_node()
    rclpy.shutdown()


def run(source: str, log: Path, seconds: float, environment: dict[str, str]) -> tuple[object, ...]:
    """One node beside one stream: the cells of a row under `HEADS`."""
    player = ["quadid_node.replay_node", str(log)]
    if source != "canonical":
        player = [__spec__.name, "--publish", source, "--seconds", str(seconds)]
    kept, given = log.parent / source, (f"source:={source}", "vehicle:=pelican", "diagnose:=0.0")
    found = beside(player, kept, given, 1.0, more=environment)
    code, told = found["stream"]
    if code:
        raise SystemExit(f"the stream ended:\n{told}")
    notes = found["minutes"]
    begin = next((note["t"] for note in notes if note["messages"]), math.nan)
    sets = [s for s in stored(Path("pelican"), kept / "h.sqlite", [], seconds).published if s["state"] == "accepted"]
    values = [{p["name"]: p["value"] for p in s["parameters"]} for s in sets]
    errors = [max((abs(one[n] / TABLE_2[n] - 1.0) for one in values), default=math.nan) for n in NOMINAL_NAMES]
    return (
        source,
        f"{np.mean([point['load'] for point in found['points']]):.1f}",
        f"{max(note['backlog'] for note in notes):.2f} s",
        notes[-1]["fits"],
        len(sets),
        f"{min((s['wall'] for s in sets), default=math.nan) - begin:.0f} s",
        f"{', '.join(f'{100 * e:.2g}' for e in errors)} %",
    )


WORST = f"largest error of {', '.join(NOMINAL_NAMES)}"
HEADS = ("preset", "load", "largest backlog", "fits", "sets", "first set", WORST)


def flight(seconds: float) -> Recording:
    """The flight that every stack publishes."""
    return fly(Vehicle.shipped("pelican"), seconds=seconds, seed=1, log_rate=RATE).recording


def main() -> None:
    """Runs every preset and writes the page."""
    given = options(__doc__, minutes=10.0, load=10.0, publish="", seconds=0.0)
    if given.publish:
        publish(given.publish, flight(given.seconds))
        return
    seconds, rows = 60.0 * given.minutes, list[tuple[object, ...]]()
    with tempfile.TemporaryDirectory() as scratch, ExitStack() as ends:
        log = Path(scratch, "flight.mcap")
        write_mcap(log, flight(seconds))
        environment = built(ROOT / "build" / "ros_load")
        for _ in range(math.ceil(max(given.load - os.getloadavg()[0], 0.0))):
            ends.callback(subprocess.Popen([sys.executable, "-c", "while True: pass"]).kill)
        for source in SOURCES:
            rows.append(run(source, log, seconds, environment))
            print(*rows[-1], sep=" | ", flush=True)
    told = f"{given.minutes:g} min of flight a preset, {RATE:g} Hz a channel, {os.cpu_count()} processors."
    title, name = "The ROS node on a loaded machine", f"load {given.load:g}, {given.minutes:g} minutes"
    put(given, "ros-load.md", title, name, [told, "", *table(HEADS, rows)])


if __name__ == "__main__":
    main()
