"""`quadid export`: what other programs would make of the files is the vehicle's own physics."""

import json
import math
import shutil
import subprocess
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadid.app.export import export as exported
from quadid.app.init import init as begin
from quadid.errors import ParameterError, VehicleError
from quadid.report.programs import FORMATS, export
from quadid.vehicle import GRAVITY, Command, ParameterPrior, Proof, RandomForces, RandomInput, ResidualTerm, Vehicle
from tests.commands import Cli, one_line

SPEED = 900.0


@pytest.fixture
def vehicle() -> Vehicle:
    """A lopsided Pelican with effects and a known full rotor speed; b came from data."""
    pelican = Vehicle.shipped("pelican")
    return pelican.model_copy(
        update={
            "command": Command(kind="normalized", max_speed=SPEED),
            "parameters": {**pelican.parameters, "b": ParameterPrior(initial=2.3e-5, sigma=1e-7)},
            "effects": {
                "motor_lag": {"tau": 0.03},
                "cg_offset": {"x": 0.01, "y": -0.005},
                "product_of_inertia": {"J_xy": 1e-3, "J_xz": 2e-4, "J_yz": -3e-4},
                "rotor_drag": {"k_x": 0.3, "k_y": 0.3},
                "gyro_scale": {"x": 0.01, "y": 0.0, "z": 0.0},
            },
        }
    )


def _wrench(vehicle: Vehicle, speeds: np.ndarray) -> tuple[float, np.ndarray]:
    """Thrust and moment about the CG, FRD, from the vehicle file's own conventions."""
    arms = vehicle.rotor_positions - np.array([0.01, -0.005, 0.0])
    b, d = vehicle.parameters["b"].initial, vehicle.parameters["d"].initial
    forces = np.zeros((len(arms), 3))
    forces[:, 2] = -b * speeds**2
    moment = np.cross(arms, forces).sum(axis=0) + np.array([0.0, 0.0, float(np.sum(vehicle.spins * d * speeds**2))])
    return float(-forces[:, 2].sum()), moment


def test_rotorpy_module_gives_the_same_wrench(vehicle: Vehicle) -> None:
    space: dict[str, Any] = {}
    exec(export(vehicle, "rotorpy", "x")["_params.py"], space)
    q = space["quad_params"]
    speeds = np.array([400.0, 420.0, 380.0, 450.0])
    arms = np.array([q["rotor_pos"][f"r{i}"] for i in range(1, 5)])
    forces = np.zeros((4, 3))
    forces[:, 2] = q["k_eta"] * speeds**2
    moment = np.cross(arms, forces).sum(axis=0)
    moment[2] += np.sum(q["rotor_directions"] * q["k_m"] * speeds**2)
    thrust, expected = _wrench(vehicle, speeds)
    assert forces[:, 2].sum() == pytest.approx(thrust)
    np.testing.assert_allclose(moment * [1.0, -1.0, -1.0], expected, rtol=1e-6)
    assert (q["tau_m"], q["rotor_speed_max"], q["mass"]) == (0.03, SPEED, 1.3)
    # FRD tensor entries are the negatives of the products; turning y and z over flips xy and xz once, yz twice.
    assert (q["Ixy"], q["Ixz"], q["Iyz"]) == (1e-3, 2e-4, 3e-4)
    hover = np.full(4, vehicle.hover_speed())
    assert q["k_d"] * hover.sum() == pytest.approx(0.3 * 1.3)


def test_gazebo_links_add_up_to_the_vehicle(vehicle: Vehicle) -> None:
    model = ET.fromstring(export(vehicle, "gazebo", "x")[".sdf"]).find("model")
    assert model is not None
    total, inertia = 0.0, np.zeros((3, 3))
    for link in model.findall("link"):
        mass = float(link.findtext("inertial/mass", "nan"))
        entry = {
            k: float(link.findtext(f"inertial/inertia/{k}", "nan")) for k in ("ixx", "ixy", "ixz", "iyy", "iyz", "izz")
        }
        own = np.array(
            [
                [entry["ixx"], entry["ixy"], entry["ixz"]],
                [entry["ixy"], entry["iyy"], entry["iyz"]],
                [entry["ixz"], entry["iyz"], entry["izz"]],
            ]
        )
        at = np.array([float(v) for v in link.findtext("pose", "0 0 0 0 0 0").split()[:3]])
        total += mass
        inertia += own + mass * (at @ at * np.eye(3) - np.outer(at, at))
    assert total == pytest.approx(1.3)
    np.testing.assert_allclose(np.diag(inertia), [8e-3, 8e-3, 1.5e-2], rtol=1e-5)
    assert inertia[0, 1] == pytest.approx(1e-3, rel=1e-5)
    plugins = model.findall("plugin")
    assert [p.findtext("turningDirection") for p in plugins] == ["cw", "ccw", "cw", "ccw"]
    assert float(plugins[0].findtext("momentConstant", "nan")) == pytest.approx(4e-7 / 2.3e-5)


def test_px4_geometry_and_hover(vehicle: Vehicle) -> None:
    text = export(vehicle, "px4", "x")[".params"]
    rows = [line.split("\t") for line in text.splitlines() if not line.startswith("#")]
    values = {name: float(value) for _, _, name, value, _ in rows}
    assert values["CA_ROTOR_COUNT"] == 4
    assert values["CA_ROTOR2_PX"] == pytest.approx(0.21 - 0.01)
    assert values["CA_ROTOR1_KM"] == pytest.approx(4e-7 / 2.3e-5)
    assert values["CA_ROTOR0_KM"] < 0.0
    assert values["MPC_THR_HOVER"] * SPEED == pytest.approx(np.sqrt(1.3 * GRAVITY / (4 * 2.3e-5)))
    assert values["CA_ROTOR0_CT"] * 4 * values["MPC_THR_HOVER"] ** 2 == pytest.approx(1.3 * GRAVITY)
    assert "gyro_scale" in text
    assert "b = 2.3e-05 N s^2/rad^2: fitted, or given with its uncertainty: 95 % within 0.85 %" in text
    assert "J_xx = 0.008 kg m^2: not from data" in text


def test_ardupilot_frame_is_json_below_its_comments(vehicle: Vehicle) -> None:
    texts = export(vehicle.model_copy(update={"name": "x{y}"}), "ardupilot", "a{b}.yaml")
    frame = texts[".sitl.json"]
    assert frame.index("{") == frame.index("\n{") + 1
    data = json.loads(frame[frame.index("{") :])
    assert data["moment_inertia"] == [8e-3, 8e-3, 1.5e-2]
    assert data["hoverThrOut"] == pytest.approx(1.3 * GRAVITY / (4 * 2.3e-5 * SPEED**2), rel=1e-5)
    assert "MOT_THST_HOVER," in texts[".param"]


def frame_of(vehicle: Vehicle) -> dict[str, Any]:
    text = export(vehicle, "ardupilot", "x.yaml")[".sitl.json"]
    read: dict[str, Any] = json.loads(text[text.index("{") :])
    return read


def test_the_simulator_puts_the_motors_where_the_vehicle_has_them() -> None:
    vehicle = Vehicle.shipped("pelican_x")
    arm = frame_of(vehicle)["diagonal_size"]
    # SIM_Frame.cpp, quad X: angles of the motors from forward, clockwise; at this distance from the centre
    angles = np.radians([45.0, -135.0, -45.0, 135.0])
    placed = arm * np.column_stack([np.cos(angles), np.sin(angles)])
    flown = vehicle.rotor_positions[:, :2]
    assert all(np.linalg.norm(flown - p, axis=1).min() < 1e-4 for p in placed)


def test_ardupilot_gets_the_curve_that_was_fitted_and_names_what_it_cannot_hold(vehicle: Vehicle) -> None:
    curved = vehicle.model_copy(
        update={
            "effects": {"thrust_curve": {"dead_speed": -100.0}, "weak_rotor": {"rotor": 2, "loss": 0.1}},
            "residual": (ResidualTerm(acts_on="moment_x", product=("p",), value=-1e-3),),
        }
    )
    frame = frame_of(curved)
    text = export(curved, "ardupilot", "x.yaml")[".sitl.json"]
    full, e = SPEED, frame["propExpo"]
    speed = np.linspace(0.2, 1.0, 5) * full
    thrust = (speed + 100.0) ** 2 - 100.0**2  # beyond what is left at no command
    np.testing.assert_allclose((1 - e) * speed / full + e * (speed / full) ** 2, thrust / thrust[-1], rtol=1e-5)
    assert "weak_rotor" in text
    assert "residual (moment_x += -0.001 p)" in text
    assert frame_of(vehicle)["propExpo"] == 1.0, "SITL takes 0.65 where none is given"


def test_full_and_hover_thrust_follow_the_thrust_curve_and_weak_rotors(vehicle: Vehicle) -> None:
    curve, weak = {"dead_speed": 120.0}, {"rotor": 2, "loss": 0.1}
    curved = vehicle.model_copy(update={"effects": {"thrust_curve": curve, "weak_rotor": weak}})
    text = export(curved, "px4", "x")[".params"]
    values = {row[2]: float(row[3]) for row in (line.split("\t") for line in text.splitlines() if line[0] != "#")}
    full = 2.3e-5 * (SPEED - 120.0) ** 2
    assert [values[f"CA_ROTOR{i}_CT"] for i in range(4)] == pytest.approx([full, 0.9 * full, full, full])
    assert "SIH_T_MAX" not in values, "it flies four alike rotors"
    hover = 1.3 * GRAVITY / (3.9 * full)
    at_hover = 120.0 + np.sqrt(1.3 * GRAVITY / (3.9 * 2.3e-5))
    assert values["MPC_THR_HOVER"] == pytest.approx(at_hover / SPEED)
    assert f'ctrlrange="0 {full:.8g}"' in export(curved, "mujoco", "x")[".mjcf.xml"]
    parameters = export(curved, "ardupilot", "x")[".param"]
    assert float(next(line for line in parameters.splitlines() if "THST_HOVER" in line)[15:]) == pytest.approx(hover)


def test_pulse_widths_of_the_vehicle_are_spin_limits_of_the_simulator() -> None:
    pelican = Vehicle.shipped("pelican")
    pwm = pelican.command.model_copy(update={"kind": "pwm", "range": (1150.0, 1950.0), "max_speed": 900.0})
    frame = frame_of(pelican.model_copy(update={"command": pwm}))
    assert (frame["spin_min"], frame["spin_max"]) == (0.15, 0.95)


@pytest.mark.parametrize("form", FORMATS)
def test_every_form_from_the_command_line(inside: Cli, tmp_path: Path, form: str) -> None:
    result = inside("export", "--vehicle", "pelican_x", "--format", form, "--out", tmp_path, "--json", "-").data
    assert list(result) == ["schema", "vehicle", "format", "files", "warnings"]
    for file in result["files"]:
        assert "pelican" in Path(file).read_text(encoding="utf-8")
    assert "guesses from the vehicle file" in result["warnings"][0]
    assert any("max_speed" in text for text in result["warnings"]) == (form in ("px4", "ardupilot"))


def test_random_forces_survive_the_own_form_and_their_keys_are_named(inside: Cli, tmp_path: Path) -> None:
    random = {
        "horizontal": {"sigma": 0.31, "time": 0.5},
        "vertical": {"sigma": 0.1, "time": 0.4},
        "roll_pitch": {"sigma": 2.0, "time": 0.2},
        "yaw": {"sigma": 0.3, "time": 1.5},
    }
    file = tmp_path / "mine.yaml"
    text = Vehicle.shipped("pelican").to_yaml()
    file.write_text(text + f"random: {json.dumps(random)}\n", encoding="utf-8")
    run = inside("export", "--vehicle", file, "--format", "yaml", "--out", tmp_path / "out", "--json", "-")
    written = Path(run.data["files"][0]).read_text(encoding="utf-8")
    again = Vehicle.from_yaml(written).random
    assert again is not None
    assert again.model_dump() == random
    assert "roll_pitch: {sigma: 2.0, time: 0.2}" in written
    for slip, told in (("vertikal", "did you mean 'vertical'"), ("sgima", "did you mean 'sigma'")):
        broken = {**random, "vertikal": random["yaw"]} if slip == "vertikal" else {**random, "yaw": {"sgima": 1.0}}
        with pytest.raises(VehicleError, match=told):
            Vehicle.from_yaml(text + f"random: {json.dumps(broken)}\n")
    with pytest.raises(VehicleError, match=r"random\.yaw\.time"):
        Vehicle.from_yaml(text + f"random: {json.dumps({**random, 'yaw': {'sigma': 0.1, 'time': 0.0}})}\n")


def test_unknown_form(inside: Cli, tmp_path: Path) -> None:
    assert "did you mean 'px4'?" in one_line(
        inside("export", "--vehicle", "pelican", "--format", "px5", "--out", tmp_path), 2
    )


def test_awkward_names_break_nothing(vehicle: Vehicle) -> None:
    odd = vehicle.model_copy(update={"name": "a--b]]> <\"'&\n"})
    for form in (f for f in FORMATS if f != "agilicious"):  # it knows no plus
        for ending, text in export(odd, form, "--x--.yaml").items():
            if ending == ".sdf":
                ET.fromstring(text)
            if ending.endswith(".py"):
                compile(text, "x", "exec")
            if ending == ".params.toml":
                tomllib.loads(text)


def test_what_nothing_proves_is_asked_about_and_says_so_at_its_top(
    vehicle: Vehicle, inside: Cli, tmp_path: Path
) -> None:
    red = Proof(verdict="poor", unseen=("other.mcap",), error=48.8)
    for proof, why in (
        (red, "its fit was judged poor: error 48.8 times"),
        (Proof(verdict="fair"), "no flight was predicted"),
    ):
        file = vehicle.model_copy(update={"proof": proof}).save(tmp_path / "fitted.yaml")
        line = one_line(inside("export", "--vehicle", file, "--format", "px4", "--out", tmp_path), 2)
        assert why in line
        assert "--anyway" in line
        for form in set(FORMATS) - {"agilicious"}:  # which takes crosses alone
            run = inside("export", "--vehicle", file, "--format", form, "--out", tmp_path, "--anyway", "--json", "-")
            assert run.code == 0, run.err
            top = Path(run.data["files"][0]).read_text(encoding="utf-8")[:300]
            assert f"NOT PROVEN: {why}" in top, (form, top)
    green = vehicle.model_copy(update={"proof": Proof(verdict="good", unseen=("other.mcap",), error=1.0)})
    run = inside("export", "--vehicle", green.save(tmp_path / "good.yaml"), "--format", "px4", "--out", tmp_path)
    assert run.code == 0
    assert "NOT PROVEN" not in next(tmp_path.glob("*.params")).read_text(encoding="utf-8")


def test_the_list_names_what_the_files_leave_out(inside: Cli, vehicle: Vehicle) -> None:
    carried = inside("export", "--list", "--json", "-").data["formats"]
    assert set(carried) == set(FORMATS)
    assert "drone-models" in inside("export", "--list").out
    cross = Vehicle.shipped("pelican_x")
    every = vehicle.model_copy(
        update={"rotors": cross.rotors, "effects": {**vehicle.effects, "weak_rotor": {"loss_2": 0.04}}}
    )
    for form in FORMATS:
        for text in export(every, form, "x").values():
            said = [line for line in text.splitlines() if "have no place here" in line]
            left = set(said[0].split(": ")[1].split(", ")) if said else set()
            assert set(every.effects) - left <= set(carried[form]["effects"]), form
    # Where the full rotor speed is not known, PX4 holds nothing of single rotors.
    unknown = every.model_copy(update={"command": Command()})
    assert "weak_rotor" in next(iter(export(unknown, "px4", "x").values())).split("no place here")[1].split("\n")[0]


@pytest.mark.parametrize("form", FORMATS)
def test_optional_numbers_that_have_no_place_are_named_too(vehicle: Vehicle, form: str) -> None:
    lag, inflow = {"tau": 0.03, "tau_down": 0.05}, {"k_z": 0.2, "k_climb": 0.03, "central": 0.0}
    rotors, effects = Vehicle.shipped("pelican_x").rotors, {"motor_lag": lag, "axial_inflow": inflow}
    for text in export(vehicle.model_copy(update={"rotors": rotors, "effects": effects}), form, "x").values():
        told = "".join(line for line in text.splitlines() if "have no place here" in line)
        assert ("k_climb" in told) == (form in {"rotorpy", "drone-models", "pegasus", "gym-pybullet-drones", "jsbsim"})
        assert ("tau_down" in told) == (form in {"px4", "rotorpy", "agilicious", "airsim", "pyflyt", "jsbsim"})
        assert "central" not in told, "neutral: nothing is left out"


def test_gazebo_slows_rotors_by_their_own_lag(vehicle: Vehicle) -> None:
    effects = {"motor_lag": {"tau": 0.03, "tau_down": 0.05}}
    text = export(vehicle.model_copy(update={"effects": effects}), "gazebo", "x")[".sdf"]
    assert "<timeConstantUp>0.03<" in text
    assert "<timeConstantDown>0.05<" in text


def test_isaac_lab_ranges_are_the_intervals(vehicle: Vehicle) -> None:
    text = export(vehicle, "isaac-lab", "x")["_isaaclab.py"].replace("from isaaclab_contrib", "#")
    space: dict[str, Any] = {"ThrusterCfg": dict}
    exec(text, space)
    thrusters, turns = space["THRUSTERS"], (2.0 * math.pi) ** 2
    low, high = thrusters["thrust_const_range"]
    assert (low, high) == pytest.approx((turns * (2.3e-5 - 1.96e-7), turns * (2.3e-5 + 1.96e-7)), rel=1e-4)
    # What no flight has shown is drawn as `fit.sample` draws it, and says so; it had no width.
    for ends, value in ((thrusters["tau_inc_range"], 0.03), (space["J_XX_RANGE"], 8e-3)):
        assert ends == pytest.approx((value * math.exp(-0.196), value * math.exp(0.196)), rel=1e-3)
    assert "# not measured: 10% assumed" in text.split("J_XX_RANGE")[1].splitlines()[0]
    assert "not measured" not in text.split("thrust_const_range")[1].splitlines()[0]
    speeds = np.array([400.0, 420.0, 380.0, 450.0])
    thrust, moment = _wrench(vehicle, speeds)
    force = np.array(space["ALLOCATION_MATRIX"]) @ (2.3e-5 * speeds**2)
    np.testing.assert_allclose(force, [0.0, 0.0, thrust, *moment * [1.0, -1.0, -1.0]], rtol=1e-6, atol=1e-9)


def test_isaac_lab_randomises_over_what_acts_at_random(vehicle: Vehicle) -> None:
    random = RandomForces(
        horizontal=RandomInput(sigma=0.3, time=0.5),
        vertical=RandomInput(sigma=0.1, time=0.4),
        roll_pitch=RandomInput(sigma=2.0, time=0.2),
        yaw=RandomInput(sigma=0.5, time=1.5),
    )
    gusty = vehicle.model_copy(update={"random": random})
    facts: dict[str, Any] = {}
    text = next(iter(export(gusty, "isaac-lab", "x").values()))
    exec(text.replace("from isaaclab_contrib.actuators import ThrusterCfg", "ThrusterCfg = dict"), facts)
    J = [vehicle.parameters[n].initial for n in ("J_xx", "J_yy", "J_zz")]
    np.testing.assert_allclose(facts["RANDOM_FORCE_STD"], vehicle.mass * np.array([0.3, 0.3, 0.1]), rtol=1e-6)
    np.testing.assert_allclose(facts["RANDOM_TORQUE_STD"], np.array(J) * [2.0, 2.0, 0.5], rtol=1e-6)
    assert facts["RANDOM_FORCE_TIME"] == (0.5, 0.5, 0.4)
    assert facts["RANDOM_TORQUE_TIME"] == (0.2, 0.2, 1.5)
    assert "RANDOM" not in next(iter(export(vehicle, "isaac-lab", "x").values()))
    assert "random" in "".join(export(gusty, "px4", "x").values()).split("no place here")[1].split("\n")[0]


AIRSIM = """
#include <cmath>
#include <cstdio>
#include <vector>
namespace msr { namespace airlib {
struct Vector3r { float x, y, z; Vector3r(double a = 0, double b = 0, double c = 0) : x(a), y(b), z(c) {} };
struct Matrix3x3r { float m[3][3]; float& operator()(int i, int j) { return m[i][j]; } };
enum class RotorTurningDirection : int { RotorTurningDirectionCCW = -1, RotorTurningDirectionCW = 1 };
struct RotorPose {
    Vector3r at, normal; RotorTurningDirection turn;
    RotorPose(Vector3r a, Vector3r n, RotorTurningDirection t) : at(a), normal(n), turn(t) {}
};
struct RotorParams {
    float C_T, C_P, air_density, max_rpm, propeller_diameter, propeller_height, control_signal_filter_tc;
    void calculateMaxThrust() {}
};
struct MultiRotorParams { struct Params {
    unsigned rotor_count; std::vector<RotorPose> rotor_poses; float mass; Matrix3x3r inertia; Vector3r body_box;
    float linear_drag_coefficient, angular_drag_coefficient; RotorParams rotor_params;
}; };
}}
"""
"""The types of AirLib's MultiRotorParams.hpp and RotorParams.hpp that a vehicle is held in."""
SHOWN = """
#include "vehicle.hpp"
int main() {
    msr::airlib::MultiRotorParams::Params p; msr::airlib::setupFrameQuadid(p); auto& r = p.rotor_params;
    std::printf("{\\"mass\\": %g, \\"count\\": %u, \\"drag\\": %g, \\"box\\": [%g, %g, %g], \\"inertia\\": [",
                p.mass, p.rotor_count, p.linear_drag_coefficient, p.body_box.x, p.body_box.y, p.body_box.z);
    for (int i = 0; i < 9; ++i) std::printf(i ? ", %.8g" : "%.8g", p.inertia.m[i / 3][i % 3]);
    std::printf("], \\"C\\": [%.8g, %.8g], \\"rho\\": %g, \\"rpm\\": %.8g, \\"D\\": %.8g, "
                "\\"h\\": %g, \\"tc\\": %g, \\"rotors\\": [",
                r.C_T, r.C_P, r.air_density, r.max_rpm, r.propeller_diameter, r.propeller_height,
                r.control_signal_filter_tc);
    for (auto& o : p.rotor_poses)
        std::printf("%s[%.8g, %.8g, %.8g, %g, %d]", &o == &p.rotor_poses[0] ? "" : ", ", o.at.x, o.at.y, o.at.z,
                    o.normal.z, static_cast<int>(o.turn));
    std::printf("]}");
}
"""


def test_airsim_compiles_it_and_makes_the_same_wrench(vehicle: Vehicle, tmp_path: Path) -> None:
    compiler = shutil.which("c++") or pytest.skip("no C++ compiler")
    flown = vehicle.model_copy(update={"effects": {**vehicle.effects, "parasitic_drag": {"c": 0.03}}})
    (tmp_path / "vehicles" / "multirotor").mkdir(parents=True)
    (tmp_path / "vehicles" / "multirotor" / "MultiRotorParams.hpp").write_text(AIRSIM, encoding="utf-8")
    (tmp_path / "vehicle.hpp").write_text(export(flown, "airsim", "x \\")[".airsim.hpp"], encoding="utf-8")
    (tmp_path / "main.cpp").write_text(SHOWN, encoding="utf-8")
    subprocess.run([compiler, "-std=c++11", "-I.", "main.cpp", "-o", "main"], cwd=tmp_path, check=True)
    q = json.loads(subprocess.run([tmp_path / "main"], capture_output=True, check=True).stdout)
    # RotorParams.hpp, RotorActuator.hpp: what a rotor makes of a control signal
    speeds, n, rho, D = np.array([400.0, 420.0, 380.0, 450.0]), q["rpm"] / 60.0, q["rho"], q["D"]
    control = (speeds / SPEED) ** 2
    thrust = control * q["C"][0] * rho * n**2 * D**4
    torque = control * q["C"][1] * rho * n**2 * D**5 / (2.0 * np.pi)
    rotors = np.array(q["rotors"])
    assert q["count"] == len(rotors) == 4
    forces = np.outer(thrust, [0.0, 0.0, 1.0]) * rotors[:, 3:4]
    moment = np.cross(rotors[:, :3], forces).sum(axis=0) + [0.0, 0.0, np.sum(rotors[:, 3] * rotors[:, 4] * torque)]
    total, expected = _wrench(vehicle, speeds)
    assert thrust.sum() == pytest.approx(total)
    np.testing.assert_allclose(moment, expected, rtol=1e-5)
    J = np.array([[8e-3, -1e-3, -2e-4], [-1e-3, 8e-3, 3e-4], [-2e-4, 3e-4, 1.5e-2]])
    np.testing.assert_allclose(np.reshape(q["inertia"], (3, 3)), J, rtol=1e-6)
    assert (q["mass"], q["tc"]) == pytest.approx((1.3, 0.03))
    # MultiRotorPhysicsBody.hpp, FastPhysicsEngine.hpp: drag of the front at 5 m/s
    front = q["box"][1] * q["box"][2] + 4 * np.pi * D * q["h"]
    assert front * q["drag"] / 2.0 * rho * 5.0**2 == pytest.approx(1.3 * 0.03 * 5.0**2, rel=1e-4)


def test_airsim_flies_behind_simple_flight_only_what_it_mixes_for() -> None:
    cross = Vehicle.shipped("pelican_x")
    ordered = cross.model_copy(update={"rotors": tuple(cross.rotors[i] for i in (0, 2, 3, 1))})
    for flown, fits in ((ordered, True), (cross, False), (Vehicle.shipped("hexacopter"), False)):
        done = exported(flown, "cosysairsim")
        assert any("SimpleFlight mixes for four alike rotors" in text for text in done.result["warnings"]) != fits


def test_pegasus_has_the_same_mass_inertia_and_wrench(vehicle: Vehicle, tmp_path: Path) -> None:
    Usd = pytest.importorskip("pxr.Usd", reason="pip install usd-core (extra dev)")
    from pxr import UsdGeom, UsdPhysics

    weak = vehicle.model_copy(update={"effects": {**vehicle.effects, "weak_rotor": {"loss_2": 0.1}}})
    texts = export(weak, "pegasus", "x")
    (tmp_path / "v.usda").write_text(texts[".usda"], encoding="utf-8")
    stage = Usd.Stage.Open(str(tmp_path / "v.usda"))
    assert UsdGeom.GetStageUpAxis(stage) == "Z"
    total, inertia, places = 0.0, np.zeros((3, 3)), []
    for name in ("body", *(f"rotor{i}" for i in range(4))):
        link = UsdPhysics.MassAPI(stage.GetPrimAtPath(f"/vehicle/{name}"))
        mass, axes = link.GetMassAttr().Get(), link.GetPrincipalAxesAttr().Get()
        turn = Rotation.from_quat([*axes.imaginary, axes.real]).as_matrix() if axes.real else np.eye(3)
        at = np.array(UsdGeom.Xformable(link).GetLocalTransformation().ExtractTranslation())
        total += mass
        inertia += turn @ np.diag(link.GetDiagonalInertiaAttr().Get()) @ turn.T
        inertia += mass * (at @ at * np.eye(3) - np.outer(at, at))
        places.append(at)
    for i, at in enumerate(places[1:]):
        joint = UsdPhysics.RevoluteJoint(stage.GetPrimAtPath(f"/vehicle/joint{i}"))
        assert joint.GetBody1Rel().GetTargets() == [f"/vehicle/rotor{i}"]
        np.testing.assert_allclose(joint.GetLocalPos0Attr().Get(), at, atol=1e-6)
    assert total == pytest.approx(1.3)
    J = np.array([[8e-3, 1e-3, 2e-4], [1e-3, 8e-3, 3e-4], [2e-4, 3e-4, 1.5e-2]])  # FLU
    np.testing.assert_allclose(inertia, J, rtol=1e-5, atol=1e-8)
    # quadratic_thrust_curve.py, multirotor.py: thrust up at each rotor, the torques about z of the body
    lines = [line for line in texts["_pegasus.py"].split("\n") if not line.startswith("from pegasus")]
    space: dict[str, Any] = {}
    exec("\n".join(lines), space)
    q, speeds = space["THRUST_CURVE"], np.array([400.0, 420.0, 380.0, 450.0])
    forces = np.outer(q["rotor_constant"] * speeds**2, [0.0, 0.0, 1.0])
    moment = np.cross(places[1:], forces).sum(axis=0)
    moment[2] += np.sum(np.array(q["rolling_moment_coefficient"]) * speeds**2 * q["rot_dir"])
    thrust, expected = _wrench(vehicle, speeds * [1.0, math.sqrt(0.9), 1.0, 1.0])
    assert forces[:, 2].sum() == pytest.approx(thrust)
    np.testing.assert_allclose(moment * [1.0, -1.0, -1.0], expected, rtol=1e-5)
    assert space["DRAG"] == pytest.approx([0.3 * 1.3, 0.3 * 1.3, 0.0])
    assert space["PX4"]["input_scaling"] == q["max_rotor_velocity"] == [SPEED] * 4
    with pytest.raises(ParameterError, match="four, which Pegasus takes for granted"):
        export(Vehicle.shipped("hexacopter"), "isaac-sim", "x")


def test_px4_hover_is_what_px4_itself_learned_in_a_recorded_flight(data_dir: Path) -> None:
    """Its THR_MDL_FAC is 0, its estimate of MPC_THR_HOVER in the air 0.48 (hover_thrust_estimate)."""
    log = data_dir / "px4" / "ascend_cubeorange_test.ulg"
    text = export(Vehicle.from_yaml(begin("mine", log).content), "px4", "x")[".params"]
    hover = next(float(line.split("\t")[3]) for line in text.splitlines() if "\tMPC_THR_HOVER\t" in line)
    assert hover == pytest.approx(0.482, abs=0.02)
