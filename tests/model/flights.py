"""Flights that the tests of the model share: inputs that move every axis, and a parameter vector for them."""

from collections.abc import Mapping

import numpy as np

from quadid.data.window import Sampling
from quadid.model.layout import Layout
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.independent import Flown, Independent, Input


def lively_input(vehicle: Vehicle, seconds: float, dt: float, seed: int = 1, sampling: Sampling = "held") -> Input:
    """Rotor speeds around hover: slow sines on thrust, roll, pitch and yaw that hold the attitude within 40 degrees."""
    rng = np.random.default_rng(seed)
    t = dt * np.arange(round(seconds / dt) + 1)
    x, y, spin = vehicle.rotor_positions[:, 0], vehicle.rotor_positions[:, 1], vehicle.spins
    arm = np.abs(vehicle.rotor_positions[:, :2]).max()
    rows = np.ones((len(t), len(vehicle.rotors)))
    for mode, size in ((np.ones_like(x), 0.05), (x / arm, 0.012), (-y / arm, 0.012), (spin, 0.06)):
        for _ in range(3):
            turns = 2.0 * np.pi * rng.uniform(0.7, 3.5)
            wave = np.sin(turns * t + rng.uniform(0.0, 2.0 * np.pi))
            rows += size * wave[:, None] * mode
    return Input(vehicle.hover_speed() * rows, dt, sampling=sampling)


def values_of(vehicle: Vehicle, effects: Mapping[str, float] | None = None) -> dict[str, float]:
    """The vehicle's six parameters and effects by dotted name."""
    six = {name: prior.initial for name, prior in vehicle.parameters.items()}
    return {**six, **(effects or {})}


def vector(vehicle: Vehicle, values: Mapping[str, float]) -> FloatArray:
    """Parameter vector of values by dotted name, shape (size,)."""
    layout = Layout(vehicle)
    theta = layout.neutral()
    for name, value in values.items():
        theta[layout.entry(name).index] = value
    return theta


def fly(vehicle: Vehicle, values: Mapping[str, float], given: Input) -> Flown:
    """Flies an input from a moving start: tilted, turning, drifting, 1.5 m above the ground."""
    return Independent(vehicle, values).fly(
        given,
        np.array([0.1, -0.15, 0.4]),
        np.array([0.3, -0.2, 0.25]),
        np.array([2.0, -1.0, 0.4]),
        np.array([1.0, -2.0, -1.5]),
    )
