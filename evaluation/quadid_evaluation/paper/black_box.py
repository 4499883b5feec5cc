"""Subspace models of a vehicle's flights, scored as the physical model is: 1 s segments, estimated initial states."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from quadid.data.window import Window
from quadid.identification.noise import NoiseModel
from quadid.identification.score import SCORE_SECONDS, expected_squares, scored_problem
from quadid.model.layout import Layout
from quadid.rotation import conjugate, product
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.paper.order import choose_order
from quadid_evaluation.paper.quadrotor_io import FEEDTHROUGH, OUTPUT_NAMES, quadrotor_io
from quadid_evaluation.paper.state_space import SubspaceModel, predict
from quadid_evaluation.paper.subspace import fit_subspace

ORDERS = tuple(range(4, 25, 2))
"""Numbers of states that are tried."""
_CHANNELS = len(OUTPUT_NAMES)


@dataclass(frozen=True)
class BlackBox:
    """A fitted subspace model.

    Attributes:
        model: the model.
        tried: number of orders that were fitted to choose one.
    """

    model: SubspaceModel
    tried: int


def fit_black_box(
    method: str, windows: Sequence[Window], noise: NoiseModel, orders: Sequence[int] = ORDERS
) -> BlackBox:
    """Fits a subspace model to windows, its order chosen on their last parts.

    Args:
        method: ``cva`` or ``moesp``.
        windows: training data on one grid, with gyro, attitude and accel.
        noise: sensor noise; weighs the outputs when orders are compared.
        orders: candidates.

    Raises:
        WindowError: a channel is absent.
        NotIdentifiableError: too few rows.
    """
    inputs, outputs = zip(*(quadrotor_io(window) for window in windows), strict=True)
    sigma, length = _sigma(noise), round(SCORE_SECONDS / windows[0].dt)
    choice = choose_order(method, inputs, outputs, orders, length, sigma, feedthrough=FEEDTHROUGH)
    model = fit_subspace(method, inputs, outputs, choice.order, feedthrough=FEEDTHROUGH)
    return BlackBox(model, len(orders))


def score_black_box(box: BlackBox, windows: Sequence[Window], vehicle: Vehicle, noise: NoiseModel) -> float:
    """Mean squared error of a subspace model on the segments and in the unit of `mse_score`.

    Squares are divided by what a perfect physical model would leave in the same segments, so 1.0 is the same noise
    floor.  Only the nine channels that the model knows are compared.

    Raises:
        NotIdentifiableError: no stretch is long enough for one segment.
    """
    shooting = scored_problem(windows, vehicle, noise)
    expected = expected_squares(shooting, Layout(vehicle).initial(vehicle)).sum(axis=0)[:_CHANNELS]
    squares, samples = np.zeros(_CHANNELS), np.zeros(_CHANNELS)
    for rollout, segments in zip(shooting.rollouts, shooting.segments, strict=True):
        inputs, outputs = quadrotor_io(rollout.window)
        prediction = predict(box.model, inputs, outputs, segments.length, segments.starts, _sigma(noise))
        error = _error(prediction.outputs, outputs[segments.rows])
        seen = rollout.valid[segments.rows][..., :_CHANNELS]
        squares += np.sum(np.where(seen, error, 0.0) ** 2, axis=(0, 1))
        samples += np.count_nonzero(seen, axis=(0, 1))
    told = expected > 0.0
    if not told.any() or not np.isfinite(squares).all():
        return np.inf
    ratio = np.where(told, squares / np.where(told, expected, 1.0), 0.0)
    return float(np.sum(samples * told * ratio) / np.sum(samples * told))


def _sigma(noise: NoiseModel) -> FloatArray:
    return np.asarray(np.sqrt(noise.variance[:_CHANNELS]))


def _error(predicted: FloatArray, measured: FloatArray) -> FloatArray:
    """Predicted minus measured, attitude as a body rotation vector as in the physical model; shape (..., 9)."""
    error = predicted - measured
    turned = product(conjugate(_quaternion(measured[..., 3:6])), _quaternion(predicted[..., 3:6]))
    error[..., 3:6] = 2.0 * np.where(turned[..., :1] >= 0.0, turned[..., 1:], -turned[..., 1:])
    return np.asarray(error)


def _quaternion(angles: FloatArray) -> FloatArray:
    """Unit quaternions wxyz, body to world, of roll, pitch, yaw [rad] (z-y-x)."""
    (cx, cy, cz), (sx, sy, sz) = np.moveaxis(np.cos(0.5 * angles), -1, 0), np.moveaxis(np.sin(0.5 * angles), -1, 0)
    return np.stack(
        [cx * cy * cz + sx * sy * sz, sx * cy * cz - cx * sy * sz, cx * sy * cz + sx * cy * sz,
         cx * cy * sz - sx * sy * cz], axis=-1,
    )  # fmt: skip
