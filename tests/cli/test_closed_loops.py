"""Exports flown in a closed loop by the programs themselves: hover, a roll step, a yaw step, as our simulation does."""

import inspect
import re
import tempfile
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple
from unittest import mock

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from quadid.app.init import shipped
from quadid.errors import ParameterError
from quadid.model.step import Simulator
from quadid.report.programs import SHORTEST_LAG, export
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

VEHICLES = [entry["name"] for entry in shipped()]
DT, STEPS = 0.01, 100
TO_FLU = np.array([1.0, -1.0, -1.0])
"""Turns vectors of body FRD into FLU and of NED into NWU, and the vector part of the attitude likewise."""


@pytest.fixture(autouse=True)
def array_api(monkeypatch: pytest.MonkeyPatch) -> None:
    """Sets what drone-models asks for before it lets itself be imported."""
    monkeypatch.setenv("SCIPY_ARRAY_API", "1")


class Motion(NamedTuple):
    """Attitude wxyz, rate, velocity, position; FRD and NED."""

    attitude: FloatArray
    rate: FloatArray
    velocity: FloatArray
    position: FloatArray


REST = Motion(np.array([1.0, 0.0, 0.0, 0.0]), np.zeros(3), np.zeros(3), np.array([0.0, 0.0, -10.0]))
Program = Callable[[FloatArray], Motion]
"""Flies on for DT with these rotor speeds [rad/s], held."""


def plain(name: str) -> Vehicle:
    """A shipped vehicle without what no program but ours knows: the gyroscopic torque of its rotors."""
    vehicle = Vehicle.shipped(name)
    still = vehicle.parameters["J_r"].model_copy(update={"initial": 1e-12, "bounds": None})
    return vehicle.model_copy(update={"parameters": {**vehicle.parameters, "J_r": still}, "effects": {}})


def ours(vehicle: Vehicle, lag: float) -> Program:
    effects = {"motor_lag": {"tau": lag}} if lag > 0.0 else {}
    simulator = Simulator(vehicle.model_copy(update={"effects": {**effects, **vehicle.effects}}))
    state = simulator.start(position=REST.position, dt=DT)

    def step(speeds: FloatArray) -> Motion:
        simulator.advance(state, speeds, DT)
        return Motion(state.attitude[0], state.rate[0], state.velocity[0], state.position[0])

    return step


def rotorpy(vehicle: Vehicle) -> Program:
    module = pytest.importorskip("rotorpy.vehicles.multirotor", reason="pip install rotorpy (extra dev)")
    space: dict[str, Any] = {}
    exec(export(vehicle, "rotorpy", "test")["_params.py"], space)
    at = {"x": REST.position * TO_FLU, "v": np.zeros(3), "q": np.array([0.0, 0.0, 0.0, 1.0]), "w": np.zeros(3)}
    at |= {"wind": np.zeros(3), "rotor_speeds": np.full(len(vehicle.rotors), vehicle.hover_speed())}
    precise = {"method": "RK45", "rtol": 1e-8, "atol": 1e-10}
    flier = module.Multirotor(space["quad_params"], at, integrator_kwargs=precise)

    def step(speeds: FloatArray) -> Motion:
        at.update(flier.step(at, {"cmd_motor_speeds": speeds}, DT))
        q = np.append(at["q"][3], at["q"][:3] * TO_FLU)
        return Motion(q, at["w"] * TO_FLU, at["v"] * TO_FLU, at["x"] * TO_FLU)

    return step


def drone_models(vehicle: Vehicle) -> Program:
    program = pytest.importorskip("drone_models.first_principles", reason="pip install drone-models (extra dev)")
    read = tomllib.loads(export(vehicle, "drone-models", "test")[".params.toml"])
    (section,) = read.values()
    wanted = inspect.signature(program.dynamics).parameters.values()
    numbers = {p.name: np.array(section[p.name]) for p in wanted if p.kind is p.KEYWORD_ONLY and p.name != "J_inv"}
    numbers["J_inv"] = np.linalg.inv(numbers["J"])
    to_rpm, n = 60.0 / (2.0 * np.pi), 10
    at = np.concatenate([REST.position * TO_FLU, [0.0, 0.0, 0.0, 1.0], np.zeros(6)])
    at = np.append(at, np.full(4, vehicle.hover_speed() * to_rpm))

    def slope(s: FloatArray, command: FloatArray) -> FloatArray:
        q = s[3:7] / np.linalg.norm(s[3:7])
        place, _, *rest = program.dynamics(s[:3], q, s[7:10], s[10:13], command, s[13:], **numbers)
        # Its own derivative of the quaternion is not to be integrated, as its documentation says.
        turn = 0.5 * np.append(q[3] * s[10:13] + np.cross(q[:3], s[10:13]), -q[:3] @ s[10:13])
        return np.concatenate([place, turn, *rest])

    def step(speeds: FloatArray) -> Motion:
        nonlocal at
        h = DT / n
        for _ in range(n):  # classical Runge-Kutta, of which the lag of 1 ms needs small steps
            k1 = slope(at, speeds * to_rpm)
            k2 = slope(at + 0.5 * h * k1, speeds * to_rpm)
            k3 = slope(at + 0.5 * h * k2, speeds * to_rpm)
            k4 = slope(at + h * k3, speeds * to_rpm)
            at = at + h / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
        q = np.append(at[6], at[3:6] * TO_FLU) / np.linalg.norm(at[3:7])
        return Motion(q, at[10:13] * TO_FLU, at[7:10] * TO_FLU, at[:3] * TO_FLU)

    return step


def mujoco(vehicle: Vehicle) -> Program:
    program = pytest.importorskip("mujoco", reason="pip install mujoco (extra dev)")
    model = program.MjModel.from_xml_string(export(vehicle, "mujoco", "test")[".mjcf.xml"])
    data = program.MjData(model)
    data.qpos[:3] = REST.position * TO_FLU

    def step(speeds: FloatArray) -> Motion:
        data.ctrl[:] = vehicle.parameters["b"].initial * speeds**2
        for _ in range(round(DT / model.opt.timestep)):
            program.mj_step(model, data)
        q = np.append(data.qpos[3], data.qpos[4:7] * TO_FLU)
        return Motion(q, data.qvel[3:] * TO_FLU, data.qvel[:3] * TO_FLU, data.qpos[:3] * TO_FLU)

    return step


def bullet(vehicle: Vehicle) -> Program:
    """The URDF in the engine of gym-pybullet-drones and PyFlyt: a thrust at each rotor's link, as they apply it.

    Bullet gave the rotors' links, which had no inertia, a kilogram each.
    """
    program = pytest.importorskip("pybullet", reason="pip install pybullet")
    client = program.connect(program.DIRECT)
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write(export(vehicle, "urdf", "test")[".urdf"])
        file.flush()
        at = (REST.position * TO_FLU).tolist()
        flags = program.URDF_USE_INERTIA_FROM_FILE
        body = program.loadURDF(file.name, at, flags=flags, physicsClientId=client)
    program.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=client)
    n = 20
    program.setTimeStep(DT / n, physicsClientId=client)
    for link in range(-1, len(vehicle.rotors)):
        program.changeDynamics(body, link, linearDamping=0.0, angularDamping=0.0, physicsClientId=client)
    b, d = (vehicle.parameters[key].initial for key in "bd")

    def step(speeds: FloatArray) -> Motion:
        for _ in range(n):
            for i, speed in enumerate(speeds):
                program.applyExternalForce(body, i, [0, 0, b * speed**2], [0, 0, 0], program.LINK_FRAME, client)
            torque = -float(vehicle.spins @ (d * speeds**2))
            program.applyExternalTorque(body, 0, [0, 0, torque], program.LINK_FRAME, client)
            program.stepSimulation(client)
        return of_bullet(program, client, body)

    return step


def of_bullet(program: Any, client: int, body: int) -> Motion:
    """Place of a body in Bullet, which reports the attitude of the principal axes."""
    axes = program.invertTransform([0.0, 0.0, 0.0], program.getDynamicsInfo(body, -1, client)[4])
    position, xyzw = program.multiplyTransforms(*program.getBasePositionAndOrientation(body, client), *axes)
    velocity, rate = program.getBaseVelocity(body, client)
    turn = np.array(program.getMatrixFromQuaternion(xyzw)).reshape(3, 3)
    q = np.append(xyzw[3], np.array(xyzw[:3]) * TO_FLU)
    return Motion(q, turn.T @ rate * TO_FLU, np.array(velocity) * TO_FLU, np.array(position) * TO_FLU)


def order_in(text: str) -> list[int]:
    """The rotors (from 0) that an exported file says the motors of its program are."""
    found = re.search(r"rotors\s+(\d(?:, \d)*)\s+of the vehicle file", text)
    assert found
    return [int(n) - 1 for n in found[1].split(", ")]


def gym_pybullet_drones(vehicle: Vehicle) -> Program:
    text = export(vehicle, "gym-pybullet-drones", "test")[".cf2x.urdf"]
    program = pytest.importorskip("gym_pybullet_drones.envs.BaseAviary", reason="no package: install from its source")
    envs, order = pytest.importorskip("gym_pybullet_drones.envs.CtrlAviary"), order_in(text)
    n = 20
    with tempfile.NamedTemporaryFile("w", suffix=".urdf", encoding="utf-8") as file:
        file.write(text)
        file.flush()
        with mock.patch.object(program.pkg_resources, "resource_filename", return_value=file.name):
            high = (REST.position * TO_FLU)[None]
            rates = {"pyb_freq": round(n / DT), "ctrl_freq": round(1.0 / DT)}
            flier = envs.CtrlAviary(initial_xyzs=high, physics=envs.Physics.PYB_DRAG, **rates)
    body = int(flier.DRONE_IDS[0])
    program.p.changeDynamics(body, -1, linearDamping=0.0, angularDamping=0.0, physicsClientId=flier.CLIENT)

    def step(speeds: FloatArray) -> Motion:
        flier.step(speeds[None, order] * 60.0 / (2.0 * np.pi))
        return of_bullet(program.p, flier.CLIENT, body)

    return step


def pyflyt(vehicle: Vehicle) -> Program:
    texts = export(vehicle, "pyflyt", "test")
    core, n = pytest.importorskip("PyFlyt.core", reason="pip install pyflyt, which wants NumPy below 2"), 20
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "v.pyflyt"
        place.mkdir()
        for ending, text in texts.items():
            (place / f"v{ending}").write_text(text, encoding="utf-8")
        options = {"drone_model": place.name, "model_dir": folder, "control_hz": round(1.0 / DT)}
        high = (REST.position * TO_FLU)[None]
        with pytest.warns(UserWarning, match="Physics_hz"):
            flier = core.Aviary(high, np.zeros((1, 3)), "quadx", drone_options=options, physics_hz=round(n / DT))
    flier.setTimeStep(DT / n)  # it leaves Bullet at 240 Hz, whatever its own rate
    drone, order = flier.drones[0], order_in(texts[".pyflyt.yaml"])
    flier.set_mode(-1)
    full = drone.motors.max_rpm
    drone.motors.throttle = vehicle.hover_speed() / full

    def step(speeds: FloatArray) -> Motion:
        flier.set_setpoint(0, speeds[order] / full)
        flier.step()
        return of_bullet(pytest.importorskip("pybullet"), flier._client, drone.Id)

    return step


def jsbsim(vehicle: Vehicle) -> Program:
    program = pytest.importorskip("jsbsim", reason="pip install jsbsim (extra dev)")
    n, foot = 20, 0.3048
    with tempfile.TemporaryDirectory() as folder:
        flier = program.FGFDMExec(folder)
        flier.set_debug_level(0)
        flier.set_dt(DT / n)
        Path(folder, "v.jsbsim.xml").write_text(export(vehicle, "jsbsim", "test")[".jsbsim.xml"], encoding="utf-8")
        flier.set_aircraft_path("")
        assert flier.load_model("v.jsbsim", False)
    flier["ic/lat-geod-deg"] = 45.5  # where the Earth's gravity is `GRAVITY`
    flier["ic/h-sl-ft"] = -REST.position[2] / foot
    for motion in ("translational", "rotational"):
        flier[f"simulation/integrator/rate/{motion}"] = 1  # Euler: others remember the fall before the rotors turned
    for i in range(len(vehicle.rotors)):
        flier[f"fcs/rotor-{i + 1}-cmd-rad_sec"] = vehicle.hover_speed()
    flier.run_ic()
    flier.suspend_integration()
    for _ in range(40 * n):  # rotors begin at rest: they reach hover before the vehicle moves
        flier.run()
    flier.resume_integration()

    def step(speeds: FloatArray) -> Motion:
        for i, speed in enumerate(speeds):
            flier[f"fcs/rotor-{i + 1}-cmd-rad_sec"] = speed
        for _ in range(n):
            flier.run()
        rpy = [flier[f"attitude/{axis}-rad"] for axis in ("psi", "theta", "phi")]
        x, y, z, w = Rotation.from_euler("ZYX", rpy).as_quat(canonical=True)
        rate = np.array([flier[f"velocities/{axis}-rad_sec"] for axis in "pqr"])
        velocity = foot * np.array([flier[f"velocities/v-{axis}-fps"] for axis in ("north", "east", "down")])
        at = [flier["position/from-start-neu-n-ft"], flier["position/from-start-neu-e-ft"], -flier["position/h-sl-ft"]]
        return Motion(np.array([w, x, y, z]), rate, velocity, foot * np.array(at))

    return step


class Goal(NamedTuple):
    """References of a flight: roll and yaw [rad], how far to climb [m]."""

    roll: float
    yaw: float
    climb: float


GOAL = Goal(0.2, 0.3, 0.2)


def flown(vehicle: Vehicle, program: Program) -> FloatArray:
    """Attitude, velocity and position under a controller that allocates by the vehicle file, (STEPS, 9)."""
    b, d = (vehicle.parameters[key].initial for key in "bd")
    x, y, _ = vehicle.rotor_positions.T
    mixer = np.linalg.pinv(np.array([np.full(len(x), b), -b * y, b * x, d * vehicle.spins]))
    inertia = np.array([vehicle.parameters[f"J_{axis}{axis}"].initial for axis in "xyz"])
    half = 0.5 * np.array([GOAL.roll, GOAL.yaw])
    wanted = np.array([np.cos(half).prod(), np.sin(half[0]) * np.cos(half[1]), 0.0, np.sin(half[1]) * np.cos(half[0])])
    now, rows = REST, []
    for _ in range(STEPS):
        w, v = now.attitude[0], now.attitude[1:]
        miss = 2.0 * (wanted[0] * v - w * wanted[1:] - np.cross(wanted[1:], v))
        moment = inertia * (-np.array([25.0, 25.0, 9.0]) * miss - np.array([10.0, 10.0, 6.0]) * now.rate)
        high = REST.position[2] - GOAL.climb - now.position[2]
        thrust = vehicle.mass * (GRAVITY - 9.0 * high + 6.0 * now.velocity[2])
        now = program(np.sqrt(np.maximum(mixer @ np.append(thrust, moment), 0.0)))
        sign = np.copysign(1.0, now.attitude[0])
        rows.append(np.concatenate([2.0 * sign * now.attitude[1:], now.velocity, now.position - REST.position]))
    return np.array(rows)


def assert_alike(vehicle: Vehicle, program: Callable[[Vehicle], Program], lag: float) -> None:
    theirs, own = flown(vehicle, program(vehicle)), flown(vehicle, ours(vehicle, lag))
    np.testing.assert_allclose((own[-1, 0], own[-1, 2], -own[-1, 8]), GOAL, atol=0.1)
    for part in (slice(0, 3), slice(3, 6), slice(6, 9)):
        size = float(np.abs(own[:, part]).max())
        assert np.abs(theirs[:, part] - own[:, part]).max() < 0.003 * max(size, 0.1), part


@pytest.mark.parametrize("name", VEHICLES)
@pytest.mark.parametrize(
    ("program", "lag"),
    [
        (rotorpy, SHORTEST_LAG),
        (drone_models, SHORTEST_LAG),
        (mujoco, 0.0),
        (bullet, 0.0),
        (gym_pybullet_drones, 0.0),
        (pyflyt, 1.0 / 240.0),
        (jsbsim, 0.0),
    ],
)
def test_every_program_flies_the_export_as_we_do(program: Callable[[Vehicle], Program], lag: float, name: str) -> None:
    vehicle = plain(name)
    if program not in (mujoco, bullet, jsbsim) and len(vehicle.rotors) != 4:
        with pytest.raises(ParameterError, match="6 rotors.*four, which .* takes for granted"):
            program(vehicle)
        return
    assert_alike(vehicle, program, lag)


ASIDE, WEAK = {"cg_offset": {"x": 8e-4, "y": -6e-4}}, {"weak_rotor": {"loss_2": 0.01}}
OFF_CENTRE = {**ASIDE, "product_of_inertia": {"J_xy": 4e-4, "J_xz": 3e-4, "J_yz": -2e-4}}
LAG, DRAG = {"motor_lag": {"tau": 0.03}}, {"parasitic_drag": {"c": 0.05}}
HUB_DRAG = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3}}
ROTOR_DRAG = {"rotor_drag": {"k_x": 0.3, "k_y": 0.3, "central": 1.0}, "axial_inflow": {"k_z": 0.2, "central": 1.0}}


@pytest.mark.parametrize(
    ("program", "effects"),
    [
        (rotorpy, {**OFF_CENTRE, **LAG, **HUB_DRAG}),
        (drone_models, {**OFF_CENTRE, **LAG}),  # its drag acts at the centre of gravity, ours at every rotor
        (mujoco, {**OFF_CENTRE, **WEAK}),
        (bullet, OFF_CENTRE),
        (gym_pybullet_drones, {**ASIDE, **ROTOR_DRAG}),
        (pyflyt, {**ASIDE, **LAG, **DRAG}),
        (jsbsim, {**OFF_CENTRE, **LAG, **DRAG, **ROTOR_DRAG, **WEAK}),
    ],
)
def test_the_effects_that_a_form_carries_are_flown(
    program: Callable[[Vehicle], Program], effects: dict[str, dict[str, float]]
) -> None:
    assert_alike(plain("pelican").model_copy(update={"effects": effects}), program, 0.0)
