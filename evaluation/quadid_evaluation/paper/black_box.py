"""Subspace models of a vehicle's flights, scored as the physical model is: 1 s segments, estimated initial states.

Rotor speeds squared in, nine measurements out.  No physics is put in but that thrust and torque go with the square of
the rotor speed, Eqs. (3)-(4) of the paper; the subspace method finds a linear relation about the mean of the data.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from quadid_replay.columns import from_euler

from quadid.data.window import Window
from quadid.errors import NotIdentifiableError, WindowError
from quadid.identification.noise import NoiseModel
from quadid.identification.result import SCORE_SECONDS, expected_squares, scored_problem
from quadid.model.layout import Layout
from quadid.rotation import conjugate, euler, product
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.paper.subspace import SubspaceModel, as_records, fit_orders, fit_subspace, predict

ORDERS = tuple(range(4, 25, 2))
"""Numbers of states that are tried."""
HELD_OUT = 0.3
"""Last part of each record that judges the orders fitted to the rest."""
FEEDTHROUGH = (False,) * 6 + (True,) * 3
"""Rotor speeds act at once on the specific force, through an integration on rates and angles.  The stabiliser computes
row k of the rotor speeds from rates and angles of the same instant: allowing a direct effect there would mistake the
stabiliser for the vehicle."""
CHANNELS = len(FEEDTHROUGH)


def quadrotor_io(window: Window) -> tuple[FloatArray, FloatArray]:
    """Returns inputs and outputs of a window for `fit_subspace` and `predict`.

    Returns:
        inputs: rotor speeds squared [rad^2/s^2], shape (n, rotors).
        outputs: rates p, q, r [rad/s], Euler angles phi, theta, psi, yaw unwrapped over missing rows [rad], specific
            force [m/s^2], shape (n, 9); NaN where not measured.

    Raises:
        WindowError: rates, attitude or specific force are absent.
    """
    if window.gyro is None or window.attitude is None or window.accel is None:
        absent = [name for name in ("gyro", "attitude", "accel") if getattr(window, name) is None]
        raise WindowError(f"window without {', '.join(absent)}", "gyro, attitude and accel for a subspace model")
    angles = euler(window.attitude)
    seen = np.isfinite(angles[:, 2])
    angles[seen, 2] = np.unwrap(angles[seen, 2])
    return window.rotor_speed**2, np.column_stack([window.gyro, angles, window.accel])


def order_errors(
    method: str,
    inputs: ArrayLike | Sequence[ArrayLike],
    outputs: ArrayLike | Sequence[ArrayLike],
    orders: Sequence[int],
    length: int,
    sigma: ArrayLike,
    past: int = 20,
    future: int = 15,
    feedthrough: bool | Sequence[bool] = True,
) -> FloatArray:
    """Fits each order to the first 70 % of every record; returns mean squared weighted errors on segments of the rest.

    An information criterion judges one step ahead; a model that is to run a second deserves to be judged by a second.

    Args:
        method: this and all that is not explained here: as `fit_subspace`.
        length: rows a segment.
        sigma: standard deviations that weigh the outputs, shape (p,).

    Raises:
        NotIdentifiableError: no record is long enough to hold a segment out.
    """
    u, y = as_records(inputs, outputs)
    cuts = [round((1.0 - HELD_OUT) * len(record)) for record in u]
    first, then = ([record[:cut] for record, cut in zip(records, cuts, strict=True)] for records in (u, y))
    models = fit_orders(method, first, then, orders, past, future, "closed", feedthrough)
    held = [(a[cut:], b[cut:]) for a, b, cut in zip(u, y, cuts, strict=True) if len(a) - cut >= length]
    if not held:
        raise NotIdentifiableError("no record long enough", f"{length} rows in the last {HELD_OUT:.0%} of a record")
    weight = 1.0 / np.asarray(sigma, dtype=np.float64)
    errors = []
    for model in models:
        squares: list[FloatArray] = []
        for a, b in held:
            prediction = predict(model, a, b, length, sigma=sigma)
            measured = b[prediction.starts[:, None] + np.arange(length)]
            squares.append(np.ravel(((prediction.outputs - measured) * weight) ** 2))
        errors.append(float(np.nanmean(np.concatenate(squares))))
    return np.array(errors)


class BlackBox(NamedTuple):
    """A fitted subspace model, and the number of orders that were fitted to choose one."""

    model: SubspaceModel
    tried: int


def fit_black_box(
    method: str, windows: Sequence[Window], noise: NoiseModel, orders: Sequence[int] = ORDERS
) -> BlackBox:
    """Fits a subspace model to windows, its order chosen on their last parts.

    Args:
        windows: training data on one grid, with gyro, attitude and accel.
        noise: sensor noise; weighs the outputs when orders are compared.

    Raises:
        WindowError: a channel is absent.
        NotIdentifiableError: too few rows.
    """
    inputs, outputs = zip(*(quadrotor_io(window) for window in windows), strict=True)
    sigma, length = np.sqrt(noise.variance[:CHANNELS]), round(SCORE_SECONDS / windows[0].dt)
    errors = order_errors(method, inputs, outputs, orders, length, sigma, feedthrough=FEEDTHROUGH)
    model = fit_subspace(method, inputs, outputs, orders[int(np.argmin(errors))], feedthrough=FEEDTHROUGH)
    return BlackBox(model, len(orders))


def score_black_box(box: BlackBox, windows: Sequence[Window], vehicle: Vehicle, noise: NoiseModel) -> float:
    """Mean squared error of a subspace model on the segments and in the unit of `mse_score`.

    Squares are divided by what a perfect physical model would leave in the same segments, so 1.0 is the same noise
    floor.  Only the nine channels that the model knows are compared, attitude as a body rotation vector.

    Raises:
        NotIdentifiableError: no stretch is long enough for one segment.
    """

    def turns(outputs: FloatArray) -> FloatArray:
        return from_euler(outputs[..., 3:6].reshape(-1, 3)).reshape(*outputs.shape[:-1], 4)

    shooting = scored_problem(windows, vehicle, noise)
    expected = expected_squares(shooting, Layout(vehicle).initial(vehicle)).sum(axis=0)[:CHANNELS]
    squares, samples = np.zeros(CHANNELS), np.zeros(CHANNELS)
    for rollout, segments in zip(shooting.rollouts, shooting.segments, strict=True):
        inputs, outputs = quadrotor_io(rollout.window)
        sigma = np.sqrt(noise.variance[:CHANNELS])
        predicted = predict(box.model, inputs, outputs, segments.length, segments.starts, sigma).outputs
        measured = outputs[segments.rows]
        error = predicted - measured
        turned = product(conjugate(turns(measured)), turns(predicted))
        error[..., 3:6] = 2.0 * np.where(turned[..., :1] >= 0.0, turned[..., 1:], -turned[..., 1:])
        seen = rollout.valid[segments.rows][..., :CHANNELS]
        squares += np.sum(np.where(seen, error, 0.0) ** 2, axis=(0, 1))
        samples += np.count_nonzero(seen, axis=(0, 1))
    told = expected > 0.0
    if not told.any() or not np.isfinite(squares).all():
        return np.inf
    ratio = np.where(told, squares / np.where(told, expected, 1.0), 0.0)
    return float(np.sum(samples * told * ratio) / np.sum(samples * told))
