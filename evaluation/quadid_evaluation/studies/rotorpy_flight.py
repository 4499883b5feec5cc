"""RotorPy's own vehicle flown by its own controller, logged as a flight of ours: truth that nobody here wrote.

RotorPy flies in FLU and a world with z up; logs are FRD and NED.
"""

import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from quadid.data.window import Window
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

DT = 0.01
HALF = 0.5 * DT
FLIP = np.array([1.0, -1.0, -1.0])
"""FLU to FRD, and north-west-up to north-east-down."""
NAMES = {"b": "k_eta", "d": "k_m", "J_xx": "Ixx", "J_yy": "Iyy", "J_zz": "Izz"}
"""RotorPy's names of our parameters."""


@dataclass(frozen=True)
class RotorpyFlight:
    """A log, the vehicle file of a user who guesses 30 % off, and RotorPy's own parameters."""

    window: Window
    vehicle: Vehicle
    truth: dict[str, Any]


def hummingbird(**changes: Any) -> dict[str, Any]:
    """Parameters of RotorPy's Hummingbird with some of them changed."""
    from rotorpy.vehicles.hummingbird_params import quad_params

    return {**copy.deepcopy(quad_params), **changes}


def vehicle_of(truth: dict[str, Any]) -> Vehicle:
    """Geometry and mass as they are, coefficients 20 to 40 % off."""
    rotors = [
        {"position": (np.array(place) * FLIP).tolist(), "spin": -int(spin)}
        for place, spin in zip(truth["rotor_pos"].values(), truth["rotor_directions"], strict=True)
    ]
    parameters = {
        "b": 0.8 * truth["k_eta"],
        "d": 1.3 * truth["k_m"],
        "J_xx": 1.3 * truth["Ixx"],
        "J_yy": 0.75 * truth["Iyy"],
        "J_zz": 1.2 * truth["Izz"],
        "J_r": 1e-6,
    }
    data = {"name": "hummingbird", "mass": truth["mass"], "rotors": rotors, "parameters": parameters}
    return Vehicle.model_validate(data)


def fly(truth: dict[str, Any], seconds: float, seed: int, aero: bool = True, reach: float = 1.0) -> RotorpyFlight:
    """Flies between random places `reach` metres around the start; commands are held for `DT`."""
    from rotorpy.controllers.quadrotor_control import SE3Control
    from rotorpy.vehicles.multirotor import Multirotor

    rng = np.random.default_rng(seed)
    hover = np.sqrt(truth["mass"] * GRAVITY / (4.0 * truth["k_eta"]))
    at: dict[str, Any] = {
        "x": np.zeros(3),
        "v": np.zeros(3),
        "q": np.array([0.0, 0.0, 0.0, 1.0]),
        "w": np.zeros(3),
        "wind": np.zeros(3),
        "rotor_speeds": np.full(4, hover),
    }
    flier = Multirotor(truth, at, aero=aero, integrator_kwargs={"method": "RK45", "rtol": 1e-8, "atol": 1e-9})
    flier.g = GRAVITY
    flier.weight = np.array([0.0, 0.0, -truth["mass"] * GRAVITY])
    # Gains that a lag of 50 ms allows; the shipped ones want motors ten times as fast.
    pilot, rows = SE3Control({**truth, "kp_att": 60.0, "kd_att": 12.0}), round(seconds / DT)
    turns, sizes = rng.uniform(0.5, 3.0, (3, 4)), reach * rng.uniform(0.3, 0.6, (3, 4)) * [1.0, 1.0, 0.6, 0.5]
    command, state, between = np.empty((rows, 4)), [], [np.zeros(3)]
    for k in range(rows):
        wave = turns * k * DT
        place, speed = np.sum(sizes * np.sin(wave), axis=0), np.sum(sizes * turns * np.cos(wave), axis=0)
        acceleration = -np.sum(sizes * turns**2 * np.sin(wave), axis=0)
        flat = {
            "x": place[:3],
            "x_dot": speed[:3],
            "x_ddot": acceleration[:3],
            "x_dddot": np.zeros(3),
            "x_ddddot": np.zeros(3),
            "yaw": place[3],
            "yaw_dot": speed[3],
            "yaw_ddot": 0.0,
        }
        command[k] = np.clip(pilot.update(k * DT, at, flat)["cmd_motor_speeds"], 0.4 * hover, 1.8 * hover)
        command[k] *= 1.0 + 0.02 * rng.standard_normal(4)
        state.append(at)
        middle = flier.step(at, {"cmd_motor_speeds": command[k]}, HALF)
        between.append(middle["v"])
        at = flier.step(middle, {"cmd_motor_speeds": command[k]}, HALF)
    return RotorpyFlight(_logged(command, state, np.array(between), rng), vehicle_of(truth), truth)


def _logged(command: FloatArray, state: list[dict[str, Any]], between: FloatArray, rng: np.random.Generator) -> Window:
    """Sensors with MEMS noise: specific force is its mean over the sample around each row."""
    n = len(command)
    q = np.array([s["q"] for s in state])
    attitude = np.column_stack([q[:, 3], q[:, 0], -q[:, 1], -q[:, 2]])
    world = np.diff(between, axis=0) / DT * FLIP - np.array([0.0, 0.0, GRAVITY])
    force = Rotation.from_quat(attitude, scalar_first=True).apply(world, inverse=True)
    gyro = np.array([s["w"] for s in state]) * FLIP
    velocity = np.array([s["v"] for s in state]) * FLIP
    noise = rng.standard_normal((3, n, 3)) * np.array([0.02, 0.1, 0.02])[:, None, None]
    window = Window(0.0, DT, command, gyro + noise[0], attitude, force + noise[1], velocity + noise[2], name="rotorpy")
    return window.slice(100, n)
