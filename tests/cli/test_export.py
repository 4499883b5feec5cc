"""`quadid export`: what other programs would make of the files is the vehicle's own physics."""

from __future__ import annotations

import json
import math
import tomllib
import xml.etree.ElementTree as ET
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from quadid.app.init import init as begin
from quadid.errors import VehicleError
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
        "horizontal": {"sigma": 0.31, "time": 0.5}, "vertical": {"sigma": 0.1, "time": 0.4},
        "roll_pitch": {"sigma": 2.0, "time": 0.2}, "yaw": {"sigma": 0.3, "time": 1.5},
    }  # fmt: skip
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
        assert ("k_climb" in told) == (form in {"rotorpy", "drone-models"})
        assert ("tau_down" in told) == (form in {"px4", "rotorpy", "agilicious"})
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
    assert thrusters["tau_inc_range"] == (0.03, 0.03)
    assert space["J_XX_RANGE"] == (vehicle.parameters["J_xx"].initial,) * 2  # not from data
    speeds = np.array([400.0, 420.0, 380.0, 450.0])
    thrust, moment = _wrench(vehicle, speeds)
    force = np.array(space["ALLOCATION_MATRIX"]) @ (2.3e-5 * speeds**2)
    np.testing.assert_allclose(force, [0.0, 0.0, thrust, *moment * [1.0, -1.0, -1.0]], rtol=1e-6, atol=1e-9)


def test_isaac_lab_randomises_over_what_acts_at_random(vehicle: Vehicle) -> None:
    random = RandomForces(
        horizontal=RandomInput(sigma=0.3, time=0.5), vertical=RandomInput(sigma=0.1, time=0.4),
        roll_pitch=RandomInput(sigma=2.0, time=0.2), yaw=RandomInput(sigma=0.5, time=1.5),
    )  # fmt: skip
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


def test_px4_hover_is_what_px4_itself_learned_in_a_recorded_flight(data_dir: Path) -> None:
    """Its THR_MDL_FAC is 0, its estimate of MPC_THR_HOVER in the air 0.48 (hover_thrust_estimate)."""
    log = data_dir / "px4" / "ascend_cubeorange_test.ulg"
    text = export(Vehicle.from_yaml(begin("mine", log).content), "px4", "x")[".params"]
    hover = next(float(line.split("\t")[3]) for line in text.splitlines() if "\tMPC_THR_HOVER\t" in line)
    assert hover == pytest.approx(0.482, abs=0.02)
