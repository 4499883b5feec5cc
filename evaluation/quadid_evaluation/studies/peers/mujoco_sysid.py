"""`mujoco.sysid` on our logs, as its authors use it: an MJCF quadrotor, measured trajectories in chunks, Gauss-Newton.

The vehicle is a free body; thrusts, drag torques and the rotors' gyroscopic torque are actuators with gains b, d and
J_r, driven by the measured rotor speeds and, for the last, rates.  The world is NED, the body FRD, gravity points along
+z.  Chunks of a second begin in the measured attitude and rate; residuals are divided by the sensors' noise.
"""

import contextlib
import io
import time
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import mujoco
import numpy as np
from mujoco import sysid

from quadid.data.window import Window
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, Vehicle

CHUNK = 1.0
"""Length of the chunks [s]: those of our own last fit."""
FINER = 2
"""Steps of the simulation within one of the log."""
FLATTEST = 0.999
"""Largest J_zz as a share of J_xx + J_yy; MuJoCo refuses what no body has."""
_J_XX, _J_YY, _J_ZZ = (NOMINAL_NAMES.index(name) for name in ("J_xx", "J_yy", "J_zz"))
NOISE = (0.02, 0.2, 0.0025)
"""Noise of the simulated logs: gyro [rad/s], accelerometer [m/s^2], a quaternion's parts."""


class Answer(NamedTuple):
    """Logarithms of the parameters, half-widths of their 95 % intervals, as `NOMINAL_NAMES`; processor time [s]."""

    values: FloatArray
    half: FloatArray
    seconds: float


def mjcf(vehicle: Vehicle) -> str:
    """The vehicle without the numbers that are sought: body, actuators, sensors."""
    places = "".join(
        f'<site name="s{k}" pos="{x} {y} {z}"/>' for k, (x, y, z) in enumerate((r.position for r in vehicle.rotors), 1)
    )
    drives = "".join(f'<motor name="t{k}" site="s{k}" gear="0 0 -1 0 0 0"/>' for k in range(1, len(vehicle.rotors) + 1))
    return (
        f'<mujoco><option gravity="0 0 {GRAVITY}" integrator="RK4"/><worldbody><body name="base">'
        f'<freejoint name="free"/><site name="imu"/>{places}'
        f'<inertial pos="0 0 0" mass="{vehicle.mass}" diaginertia="1 1 1"/></body></worldbody>'
        f'<actuator>{drives}<motor name="gx" site="imu"/><motor name="gy" site="imu"/></actuator>'
        '<sensor><gyro name="gyro" site="imu"/><accelerometer name="accelerometer" site="imu"/>'
        '<framequat name="attitude" objtype="site" objname="imu"/></sensor></mujoco>'
    )


def _apply(vehicle: Vehicle) -> Callable[[Any, Any], None]:
    """Writes the numbers into the model."""
    spins = [rotor.spin for rotor in vehicle.rotors]

    def modifier(spec: Any, parameter: Any) -> None:
        p = dict(zip(NOMINAL_NAMES, np.exp(_logarithms(parameter.value)), strict=True))
        spec.body("base").inertia = [p["J_xx"], p["J_yy"], p["J_zz"]]
        for k, spin in enumerate(spins, 1):
            spec.actuator(f"t{k}").gear = [0, 0, -p["b"], 0, 0, spin * p["d"]]
        spec.actuator("gx").gear = [0, 0, 0, p["J_r"], 0, 0]
        spec.actuator("gy").gear = [0, 0, 0, 0, p["J_r"], 0]

    return modifier


def identify(
    windows: Sequence[Window],
    vehicle: Vehicle,
    noise: tuple[float, float, float] = NOISE,
    factor: float = 4.0,
    chunk: float = CHUNK,
) -> Answer:
    """Estimates the nominal parameters (their logarithms) of flights with gyro, attitude and accelerometer.

    Args:
        noise: standard deviations of gyro [rad/s], accelerometer [m/s^2] and a quaternion's parts.
        factor: bounds, as factors of the guess.
        chunk: length of the simulated pieces [s].
    """
    begin = time.process_time()
    spec = mujoco.MjSpec.from_string(mjcf(vehicle))
    guess = {name: p.initial for name, p in vehicle.parameters.items()}
    spec.option.timestep = windows[0].dt / FINER
    start = np.log([guess[name] for name in NOMINAL_NAMES])
    low, high = start - np.log(factor), start + np.log(factor)
    start[_J_ZZ] = min(guess["J_zz"] / (guess["J_xx"] + guess["J_yy"]), FLATTEST - 0.01)
    low[_J_ZZ], high[_J_ZZ] = 0.5, FLATTEST
    parameters = sysid.ParameterDict()
    parameters.add(sysid.Parameter("numbers", start, low, high, modifier=_apply(vehicle)))
    _apply(vehicle)(spec, parameters["numbers"])
    # The flights in chunks, each from the state that was measured.
    model = spec.compile()
    states, controls, sensors = [], [], []
    for window in windows:
        steps = round(chunk / window.dt)
        for first in range(0, len(window) - steps, steps):
            state, held, measured = _chunk(window.slice(first, first + steps + 1), vehicle, model)
            states.append(state)
            controls.append(held)
            sensors.append(measured)
    names = [f"chunk{k}" for k in range(len(states))]
    sequences = sysid.ModelSequences("quadrotor", spec, names, states, controls, sensors)
    residual = sysid.build_residual_fn(
        models_sequences=[sequences], modify_residual=_difference(noise), n_threads=2, resample_true=False
    )
    with contextlib.redirect_stdout(io.StringIO()):  # it prints every step
        found, result = sysid.optimize(parameters, residual, verbose=False)
    residuals, _, _ = residual(found.as_vector(), found)
    covariance, half = sysid.calculate_intervals(residuals, result.jac)
    x = np.asarray(found.as_vector())
    slope = _slope_of_log_j_zz(x)
    half[_J_ZZ] = half[0] / np.sqrt(covariance[0, 0]) * np.sqrt(slope @ covariance @ slope)
    return Answer(_logarithms(x), np.asarray(half), time.process_time() - begin)


def _logarithms(x: FloatArray) -> FloatArray:
    """Logarithms of the nominal parameters; J_zz is sought as a share of J_xx + J_yy, so that it is that of a body."""
    out = np.array(x, dtype=np.float64)
    out[_J_ZZ] = np.log(x[_J_ZZ] * (np.exp(x[_J_XX]) + np.exp(x[_J_YY])))
    return out


def _slope_of_log_j_zz(x: FloatArray) -> FloatArray:
    """Derivative of log J_zz by what is sought."""
    slope = np.zeros(len(x))
    weight = np.exp(x[[_J_XX, _J_YY]])
    slope[[_J_XX, _J_YY]] = weight / weight.sum()
    slope[_J_ZZ] = 1.0 / x[_J_ZZ]
    return slope


def _chunk(chunk: Window, vehicle: Vehicle, model: Any) -> tuple[Any, Any, Any]:
    """Initial state, actuators' inputs and measurements."""
    gyro, attitude, accel = chunk.gyro, chunk.attitude, chunk.accel
    assert gyro is not None
    assert attitude is not None
    assert accel is not None
    speed, dt = chunk.rotor_speed, chunk.dt / FINER
    total = speed @ np.array([rotor.spin for rotor in vehicle.rotors])
    drive = np.column_stack([speed**2, total * gyro[:, 1], -total * gyro[:, 0]])
    held = np.repeat(drive, FINER, axis=0)[: (len(chunk) - 1) * FINER + 1]
    place, moving = np.concatenate([np.zeros(3), attitude[0]]), np.concatenate([np.zeros(3), gyro[0]])
    measured = np.hstack([gyro, accel, attitude])
    return (
        sysid.create_initial_state(model, place, moving),
        sysid.TimeSeries(dt * np.arange(len(held)), held),
        sysid.TimeSeries.from_names(chunk.dt * np.arange(len(chunk)), measured, model),
    )


def _difference(noise: tuple[float, float, float]) -> Callable[..., tuple[FloatArray, Any, Any]]:
    """Differences over noise: rates and attitudes at the log's times, accelerations as means over one of its steps."""
    sigma = np.repeat(noise, (3, 3, 4))

    def difference(
        parameters: Any, predicted: Any, measured: Any, model: Any, return_all: bool, state: FloatArray, **_: Any
    ) -> tuple[FloatArray, Any, Any]:
        rows = np.arange(1, (len(state) - FINER // 2) // FINER)
        after = state[FINER * rows - 1, 1:]  # state k is that after step k; forces of step k come before it
        force = predicted.data[:, 3:6]
        mean = sum(force[FINER * rows + k] for k in range(-(FINER // 2), FINER // 2)) / FINER
        data = np.hstack([after[:, 10:13], mean, after[:, 3:7]])
        times, mapping = measured.times[rows], measured.signal_mapping
        both = [sysid.TimeSeries(times, d, mapping) for d in (data, measured.data[rows])]
        return (both[1].data - both[0].data) / sigma, *both

    return difference
