"""Exports read back by others: what their libraries and mixers make of the files is the vehicle's own physics."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from quadid.app.export import export as exported
from quadid.app.init import shipped
from quadid.errors import ParameterError
from quadid.report.programs import export
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Command, Vehicle

VEHICLES = [entry["name"] for entry in shipped()]
TO_FLU = np.array([1.0, -1.0, -1.0])


def with_effects(effects: dict[str, Any]) -> Vehicle:
    """A Pelican with effects and a full rotor speed far away."""
    pelican = Vehicle.shipped("pelican")
    return pelican.model_copy(update={"effects": effects})


def test_agilicious_yaml_holds_the_same_physics() -> None:
    cross = Vehicle.shipped("pelican_x").model_copy(
        update={"effects": {"motor_lag": {"tau": 0.03}, "rotor_drag": {"k_x": 0.3, "k_y": 0.2}}}
    )
    q = yaml.safe_load(export(cross, "agilicious", "test")[".agilicious.yaml"])
    b, d = cross.parameters["b"].initial, cross.parameters["d"].initial
    assert q["mass"] == cross.mass
    assert q["thrust_map"] == pytest.approx([b, 0.0, 0.0])
    assert q["kappa"] * q["thrust_map"][0] == pytest.approx(d)
    assert q["motor_tau"] == 0.03
    assert q["aero_coeff_1"] == pytest.approx([0.3 * cross.mass, 0.2 * cross.mass, 0.0])
    assert q["inertia"] == pytest.approx([cross.parameters[n].initial for n in ("J_xx", "J_yy", "J_zz")])
    # Its own allocation: moments of the thrusts T in the order fr, bl, br, fl.
    t = np.array([1.0, 2.0, 3.0, 4.0])
    places = np.array([q[f"tbm_{n}"] for n in ("fr", "bl", "br", "fl")])
    moment = np.array([places[:, 1] @ t, -places[:, 0] @ t, q["kappa"] * (np.array([-1.0, -1.0, 1.0, 1.0]) @ t)])
    mine = np.zeros(3)
    for place, thrust in zip(places, t, strict=True):
        i = int(np.argmin(np.linalg.norm(cross.rotor_positions * TO_FLU - place, axis=1)))
        force = np.array([0.0, 0.0, -thrust])
        mine += np.cross(cross.rotor_positions[i], force)
        mine[2] += cross.spins[i] * d / b * thrust
    np.testing.assert_allclose(moment * TO_FLU, mine, rtol=1e-7)


def test_agilicious_refuses_what_it_cannot_hold() -> None:
    with pytest.raises(ParameterError, match="not one in each quadrant"):
        export(Vehicle.shipped("pelican"), "agilicious", "x")
    cross = Vehicle.shipped("pelican_x")
    turned = cross.model_copy(update={"rotors": tuple(r.model_copy(update={"spin": -r.spin}) for r in cross.rotors)})
    with pytest.raises(ParameterError, match="turn the other way"):
        export(turned, "agilicious", "x")


def test_quadid_yaml_reads_back_as_the_same_vehicle() -> None:
    vehicle = with_effects({"motor_lag": {"tau": 0.04}})
    assert Vehicle.from_yaml(export(vehicle, "yaml", "x")[".yaml"]) == vehicle


def test_parameter_files_are_read_by_the_ground_station_libraries(tmp_path: Path) -> None:
    from pymavlink.mavparm import MAVParmDict

    pelican = Vehicle.shipped("pelican")
    known = pelican.model_copy(
        update={"command": pelican.command.model_copy(update={"kind": "normalized", "max_speed": 800.0})}
    )
    hover = pelican.mass * GRAVITY / (4 * pelican.parameters["b"].initial * 800.0**2)
    file = tmp_path / "x.param"
    file.write_text(export(known, "ardupilot", "x")[".param"], encoding="utf-8")
    read = MAVParmDict()
    assert read.load(str(file))
    assert read["MOT_THST_HOVER"] == pytest.approx(hover, rel=1e-4)
    assert "MOT_THST_EXPO" not in read  # no curve was fitted


def test_px4_simulation_in_hardware_and_drag_fusion_get_only_what_was_fitted() -> None:
    pelican = as_px4_has_it(Vehicle.shipped("pelican_x"))
    bare = export(pelican, "px4", "x")[".params"]
    rich = export(
        pelican.model_copy(
            update={
                "effects": {
                    "rotor_drag": {"k_x": 0.3, "k_y": 0.2},
                    "parasitic_drag": {"c": 0.03},
                    "motor_lag": {"tau": 0.04},
                }
            }
        ),
        "px4",
        "x",
    )[".params"]
    values = {row.split("\t")[2]: float(row.split("\t")[3]) for row in rich.splitlines() if not row.startswith("#")}
    assert values["SIH_MASS"] == pelican.mass
    assert values["SIH_IXX"] == pytest.approx(pelican.parameters["J_xx"].initial)
    assert values["SIH_KDV"] == pytest.approx(0.25 * pelican.mass)
    assert values["SIH_T_TAU"] == 0.04
    assert values["EKF2_MCOEF"] == pytest.approx(0.25)
    assert values["EKF2_BCOEF_X"] == pytest.approx(0.5 * 1.225 / 0.03)
    for name in ("SIH_KDV", "SIH_T_TAU", "EKF2_MCOEF", "THR_MDL_FAC"):
        assert f"\t{name}\t" not in bare


ARDUPILOT = {
    "+": "90 ccw, -90 ccw, 0 cw, 180 cw",
    "X": "45 ccw, -135 ccw, -45 cw, 135 cw",
    "hexa": "0 cw, 180 ccw, -120 cw, 60 ccw, -60 ccw, 120 cw",
    "hexax": "90 cw, -90 ccw, -30 cw, 150 ccw, 30 ccw, -150 cw",
}
"""AP_MotorsMatrix.cpp: motors 1, 2, ... of a frame: angle from forward, clockwise [deg], and how each turns."""
CROSSES = ("crazyflie", "crazyflie_brushless", "pelican_x")


def as_px4_has_it(cross: Vehicle) -> Vehicle:
    """A shipped cross with its rotors in PX4's order."""
    return cross.model_copy(update={"rotors": tuple(cross.rotors[i] for i in (0, 2, 3, 1))})


def moments(vehicle: Vehicle) -> FloatArray:
    """Roll, pitch, yaw moment of a newton of each rotor, FRD, shape (3, rotors)."""
    x, y, _ = vehicle.rotor_positions.T
    return np.array([-y, x, vehicle.spins * vehicle.parameters["d"].initial / vehicle.parameters["b"].initial])


def assert_identity(product: FloatArray) -> None:
    """Each axis asked for is the axis that moves; how much is a matter of gains."""
    assert (np.diag(product) > 0.0).all()
    scale = np.sqrt(np.outer(np.abs(np.diag(product)), np.abs(np.diag(product))))
    np.testing.assert_allclose(product / scale, np.eye(3), atol=0.01)


def px4_rows(text: str) -> dict[str, float]:
    lines = (line.split("\t") for line in text.splitlines() if not line.startswith("#"))
    return {name: float(value) for _, _, name, value, _ in lines}


@pytest.mark.parametrize(
    ("name", "ordered"), [*((name, False) for name in VEHICLES), *((name, True) for name in CROSSES)]
)
def test_px4_allocates_what_the_vehicle_and_its_simulator_do(name: str, ordered: bool) -> None:
    vehicle = as_px4_has_it(Vehicle.shipped(name)) if ordered else Vehicle.shipped(name)
    full = vehicle.model_copy(update={"command": Command(kind="normalized", max_speed=3.0 * vehicle.hover_speed())})
    q = px4_rows(export(full, "px4", "x")[".params"])
    n = int(q["CA_ROTOR_COUNT"])
    # ActuatorEffectivenessRotors.cpp: moment = CT (position x axis) - CT KM axis, axis (0, 0, -1)
    columns = [[-q[f"CA_ROTOR{i}_PY"], q[f"CA_ROTOR{i}_PX"], q[f"CA_ROTOR{i}_KM"]] for i in range(n)]
    allocation = np.linalg.pinv(np.vstack([np.array(columns).T, np.full(n, -1.0)]))[:, :3]
    assert_identity(moments(vehicle) @ allocation)
    assert ("SIH_MASS" in q) == ordered
    if "SIH_MASS" in q:
        # sih.cpp, generate_force_and_torques: quadrotor in X
        roll, pitch, yaw = q["SIH_L_ROLL"] * q["SIH_T_MAX"], q["SIH_L_PITCH"] * q["SIH_T_MAX"], q["SIH_Q_MAX"]
        simulated = np.array([[-roll, roll, roll, -roll], [pitch, -pitch, pitch, -pitch], [yaw, yaw, -yaw, -yaw]])
        assert_identity(simulated @ allocation)
        np.testing.assert_allclose(simulated / q["SIH_T_MAX"], moments(vehicle), rtol=0.01)


@pytest.mark.parametrize("name", VEHICLES)
def test_ardupilot_mixes_what_its_simulator_does_and_the_vehicle_is(name: str) -> None:
    vehicle = Vehicle.shipped(name)
    text = export(vehicle, "ardupilot", "x")[".sitl.json"]
    found = re.search(r"-f (\S+):FILE.* are the rotors ([\d, ]+) of the vehicle file", text)
    assert found
    motors = [part.split() for part in ARDUPILOT[found[1]].split(", ")]
    angles = np.radians([float(angle) for angle, _ in motors])
    turns = np.array([1.0 if turn == "ccw" else -1.0 for _, turn in motors])
    # AP_MotorsMatrix::add_motor: roll cos(angle + 90 deg), pitch cos(angle), yaw by the sense of rotation
    mixer = np.array([np.cos(angles + 0.5 * np.pi), np.cos(angles), turns])
    arm = json.loads(text[text.index("{") :])["diagonal_size"]
    # SIM_Motor.cpp: thrust upwards at the motor's place, torque against its turning
    simulated = np.array([-arm * np.sin(angles), arm * np.cos(angles), turns])
    assert_identity(simulated @ mixer.T)
    behind = [int(n) - 1 for n in found[2].split(", ")]
    assert_identity(moments(vehicle)[:, behind] @ mixer.T)


def test_what_sitl_and_sih_cannot_be_is_left_out_with_its_reason() -> None:
    cross = Vehicle.shipped("pelican_x")
    stretched = [r.model_copy(update={"position": (1.3 * r.position[0], *r.position[1:])}) for r in cross.rotors]
    long = cross.model_copy(update={"rotors": tuple(stretched)})
    done = exported(long, "ardupilot")
    assert [name for name in done.texts if name.endswith(".json")] == []
    assert any("has no such frame" in text for text in done.result["warnings"])
    reversed_spins = [r.model_copy(update={"spin": -r.spin}) for r in cross.rotors]
    done = exported(cross.model_copy(update={"rotors": tuple(reversed_spins)}), "px4")
    assert any("yaw of this vehicle would come out wrong" in text for text in done.result["warnings"])
    assert "SIH_" not in "".join(line for line in done.texts["pelican_x.params"].splitlines() if line[0] != "#")


@pytest.mark.parametrize(
    ("asked", "form"),
    [
        ("sdf", "gazebo"),
        ("mjcf", "mujoco"),
        ("crazyflow", "drone-models"),
        ("SITL", "ardupilot"),
        ("isaac", "isaac-lab"),
        ("URDF", "urdf"),
        ("PyFlyt", "pyflyt"),
    ],
)
def test_programs_and_kinds_of_files_name_a_form(asked: str, form: str) -> None:
    cross = Vehicle.shipped("pelican_x")
    assert exported(cross, asked).texts == exported(cross, form).texts
    for nobody in ("yaml2", "json"):  # a kind of file of many programs names none of them
        with pytest.raises(ParameterError, match="unknown format"):
            exported(cross, nobody)


def test_a_motor_lag_that_nobody_measured_is_written_as_such() -> None:
    for form in ("isaac-lab", "rotorpy", "agilicious", "drone-models", "gazebo"):
        for lag in ({}, {"motor_lag": {"tau": 0.03}}):
            vehicle = Vehicle.shipped("pelican_x").model_copy(update={"effects": lag})
            (text,) = export(vehicle, form, "x").values()
            assert ("not measured: a small value, for rotors that follow at once" in text) == (not lag), form


@pytest.mark.parametrize("form", ["gym-pybullet-drones", "pyflyt"])
def test_three_rotors_that_turn_alike_are_refused_where_pairs_are_taken_for_granted(form: str) -> None:
    cross = Vehicle.shipped("pelican_x")
    first, *others = cross.rotors
    odd = (first.model_copy(update={"spin": -first.spin}), *others)
    with pytest.raises(ParameterError, match="two of each, which .* takes for granted"):
        export(cross.model_copy(update={"rotors": odd}), form, "x")
