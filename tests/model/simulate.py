"""Runs the rollout as a plain simulator: no measurements, whole trajectories out."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.model.rollout import Rollout, Segments
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.flights import vector
from tests.model.independent import Input


@dataclass(frozen=True)
class Trajectory:
    """Simulated rows 1 .. n - 2 of an input of n rows: quaternion, rate, specific force, velocity, position."""

    quaternion: FloatArray
    rate: FloatArray
    force: FloatArray
    velocity: FloatArray
    position: FloatArray
    end: FloatArray


def state(
    quaternion: tuple[float, ...] = (1.0, 0.0, 0.0, 0.0),
    rate: tuple[float, ...] = (0.0, 0.0, 0.0),
    velocity: tuple[float, ...] = (0.0, 0.0, 0.0),
    position: tuple[float, ...] = (0.0, 0.0, 0.0),
) -> FloatArray:
    """Initial state, shape (13,)."""
    q = np.array(quaternion) / np.linalg.norm(quaternion)
    return np.concatenate([q, rate, velocity, position])


def simulate(vehicle: Vehicle, values: Mapping[str, float], given: Input, start: FloatArray) -> Trajectory:
    """Simulates from `start` (13,) at row 0: against zeros, and the identity, residuals are states."""
    n = len(given.rows)
    zero, level = np.zeros((n, 3)), np.tile([1.0, 0.0, 0.0, 0.0], (n, 1))
    window = Window(given.t0, given.dt, given.rows, zero, level, zero, zero, zero, sampling=given.sampling)
    segments = Segments(n - 2, 1, np.array([1]))
    out, ends = Rollout(window, vehicle).roll(segments, vector(vehicle, values)[None], start[None])
    rows = out[0, 0, :, :, 0]
    half = 0.5 * rows[:, 3:6]  # the sign is chosen so that the scalar part is positive
    quaternion = np.column_stack([np.sqrt(np.maximum(1.0 - np.sum(half**2, axis=1), 0.0)), half])
    return Trajectory(quaternion, rows[:, :3], rows[:, 6:9], rows[:, 9:12], rows[:, 12:15], ends[0, 0, :, 0])


def finer(given: Input, parts: int) -> Input:
    """The same held input on a grid `parts` times as fine, ending at the same time."""
    rows = np.concatenate([np.repeat(given.rows[:-1], parts, axis=0), given.rows[-1:]])
    return Input(rows, given.dt / parts, given.t0, given.sampling)


def held(rows: FloatArray, dt: float = 0.02) -> Input:
    """A held input that runs for as long as it has rows."""
    return Input(np.concatenate([rows, rows[-1:]]), dt)
