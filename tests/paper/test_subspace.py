"""Subspace identification: poles of known systems, feedback, order, gaps, units, and an independent implementation."""

import itertools
from collections.abc import Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from quadid_evaluation.paper.black_box import order_errors
from quadid_evaluation.paper.subspace import METHODS, Loop, SubspaceModel, fit_orders, fit_subspace, predict

from quadid.errors import NotIdentifiableError, ParameterError, WindowError
from quadid.types import ComplexArray, FloatArray

LOOPS: tuple[Loop, Loop] = ("closed", "open")
VARIANTS = list(itertools.product(METHODS, LOOPS))


class System(NamedTuple):
    """x[k+1] = A x + B u + K e, y = C x + D u + e."""

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray
    K: FloatArray

    @property
    def poles(self) -> ComplexArray:
        return np.sort_complex(np.linalg.eigvals(self.A).astype(np.complex128))

    def markov(self, count: int) -> FloatArray:
        powers = [np.linalg.matrix_power(self.A, k) for k in range(count - 1)]
        return np.array([self.D, *(self.C @ power @ self.B for power in powers)])

    def run(self, u: FloatArray, e: FloatArray) -> FloatArray:
        """Outputs for inputs (..., rows, m) and innovations (..., rows, p)."""
        x, y = np.zeros((*u.shape[:-2], len(self.A))), np.empty_like(e)
        for k in range(u.shape[-2]):
            now, noise = u[..., k, :], e[..., k, :]
            y[..., k, :] = x @ self.C.T + now @ self.D.T + noise
            x = x @ self.A.T + now @ self.B.T + noise @ self.K.T
        return y


def markov(model: SubspaceModel, count: int) -> FloatArray:
    """Impulse response D, CB, CAB, ..., shape (count, p, m): free of the basis of the state."""
    return System(model.A, model.B, model.C, model.D, model.K).markov(count)


def innovations(model: SubspaceModel, u: FloatArray, y: FloatArray) -> FloatArray:
    """One-step prediction errors of the Kalman predictor, from a state that it does not know."""
    x, e = np.zeros(model.order), np.empty_like(y)
    for k in range(len(y)):
        e[k] = y[k] - model.C @ x - model.D @ u[k] - model.output_offset
        x = model.A @ x + model.B @ u[k] + model.K @ e[k] + model.state_offset
    return e


def resonance() -> System:
    """Two inputs, two outputs; a resonance of radius 0.9 and a lag."""
    A = np.array(
        [[0.9 * np.cos(0.4), 0.9 * np.sin(0.4), 0.0], [-0.9 * np.sin(0.4), 0.9 * np.cos(0.4), 0.0], [0, 0, 0.7]]
    )
    return System(
        A,
        np.array([[1.0, 0.2], [-0.5, 0.8], [0.3, 1.0]]),
        np.array([[1.0, 0.3, -0.5], [0.2, -1.0, 0.8]]),
        np.array([[0.5, 0.0], [0.0, -0.2]]),
        0.1 * np.array([[1.0, 0.5], [-0.3, 0.4], [0.2, 0.6]]),
    )


def unstable() -> System:
    """One input, one output, one pole outside the unit circle; process noise."""
    return System(*(np.array([[number]]) for number in (1.1, 1.0, 1.0, 0.0, 0.5)))


@lru_cache
def data(seed: int, rows: int, noise: float) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    u = rng.normal(size=(rows, 2))
    return u, resonance().run(u, noise * rng.normal(size=(rows, 2)))


def closed_loop_data(seeds: int, rows: int) -> tuple[FloatArray, FloatArray]:
    """u = -0.5 y + 0.3 dither, shapes (seeds, rows, 1): most of the input is fed-back noise."""
    system, rng = unstable(), np.random.default_rng(7)
    x, u, y = np.zeros((seeds, 1)), np.empty((seeds, rows, 1)), np.empty((seeds, rows, 1))
    e, dither = rng.normal(size=(2, rows, seeds, 1))
    for k in range(rows):
        y[:, k] = x @ system.C.T + e[k]
        u[:, k] = -0.5 * y[:, k] + 0.3 * dither[k]
        x = x @ system.A.T + u[:, k] @ system.B.T + e[k] @ system.K.T
    return u, y


def pole_error(model: SubspaceModel, system: System) -> float:
    """Largest distance of a pole, relative to its magnitude."""
    return float(np.max(np.abs(np.sort_complex(model.poles) - system.poles) / np.abs(system.poles)))


@pytest.mark.parametrize(("method", "loop"), VARIANTS)
def test_without_noise_the_system_is_found_exactly(method: str, loop: Any) -> None:
    u, y = data(0, 600, 0.0)
    model = fit_subspace(method, u, y, 3, 8, 6, loop)
    assert pole_error(model, resonance()) < 1e-9
    np.testing.assert_allclose(markov(model, 12), resonance().markov(12), atol=1e-9)


@pytest.mark.parametrize(("method", "loop"), VARIANTS)
def test_with_ten_percent_noise_poles_are_within_one_percent_and_the_impulse_response_within_three(
    method: str, loop: Any
) -> None:
    for seed in range(2):
        u, y = data(seed, 3000, 0.3)
        model = fit_subspace(method, u, y, 3, 12, 8, loop)
        assert pole_error(model, resonance()) < 0.01
        np.testing.assert_allclose(
            markov(model, 12), resonance().markov(12), atol=0.03 * np.max(resonance().markov(12))
        )


def test_error_falls_with_the_root_of_the_number_of_rows() -> None:
    rng, system, errors = np.random.default_rng(0), resonance(), []
    for rows in (600, 9600):
        u, e = rng.normal(size=(10, rows, 2)), 0.3 * rng.normal(size=(10, rows, 2))
        models = [fit_subspace("cva", a, b, 3, 12, 8) for a, b in zip(u, system.run(u, e), strict=True)]
        off = np.array([np.sort_complex(model.poles) - system.poles for model in models])
        errors.append(float(np.sqrt(np.mean(np.abs(off) ** 2))))
    assert 2.5 < errors[0] / errors[1] < 7.0  # 4 expected


def test_the_innovation_form_whitens_the_one_step_errors() -> None:
    u, y = data(0, 6000, 0.5)
    model = fit_subspace("cva", u, y, 3, 15, 10)
    e = innovations(model, u, y)[100:]
    np.testing.assert_allclose(np.cov(e.T), 0.25 * np.eye(2), atol=0.02)
    np.testing.assert_allclose(model.innovation_covariance, 0.25 * np.eye(2), atol=0.02)
    for lag in (1, 2, 5):
        correlation = np.corrcoef(e[lag:].T, e[:-lag].T)[:2, 2:]
        assert np.max(np.abs(correlation)) < 4.0 / np.sqrt(len(e))


@pytest.mark.parametrize("method", METHODS)
def test_under_feedback_the_closed_loop_form_is_right_and_the_ordinary_one_calls_the_plant_stable(method: str) -> None:
    u, y = closed_loop_data(4, 6000)
    closed, ordinary = (
        [fit_subspace(method, u[s], y[s], 1, 15, 8, loop, False).poles.real for s in range(4)] for loop in LOOPS
    )
    assert np.mean(closed) == pytest.approx(1.1, rel=0.01)
    assert np.mean(ordinary) < 1.0


def test_an_integrating_vehicle_axis_flown_by_a_controller_is_found() -> None:
    """Angle and rate of one axis with a motor lag of 50 ms at 50 Hz, unstable without its controller."""
    dt, lag = 0.02, np.exp(-0.02 / 0.05)
    # Motor torque as a lag; rate and angle integrate it, exactly sampled for a torque held over a step.
    A = np.array([[1.0, dt, 0.5 * dt**2], [0.0, 1.0, dt], [0.0, 0.0, lag]])
    B, C = np.array([[0.0], [0.0], [1.0 - lag]]), np.eye(2, 3)
    rng = np.random.default_rng(1)
    rows = 12_000
    stick = np.repeat(0.4 * rng.normal(size=rows // 30), 30)
    x, u, y = np.zeros(3), np.empty((rows, 1)), np.empty((rows, 2))
    for k in range(rows):
        y[k] = C @ x + np.array([0.005, 0.02]) * rng.normal(size=2)
        u[k] = -40.0 * (y[k, 0] - stick[k]) - 9.0 * y[k, 1] + 0.5 * rng.normal()
        x = A @ x + B @ u[k]
    for method in METHODS:
        model = fit_subspace(method, u, y, 3, 20, 12, feedthrough=False)
        np.testing.assert_allclose(np.sort(np.abs(model.poles)), [lag, 1.0, 1.0], rtol=0.01)
        assert not np.any(model.D)


def test_the_order_that_simulates_unseen_segments_best_is_the_true_one_or_close() -> None:
    u, y = data(4, 3000, 0.3)
    errors = order_errors("cva", u, y, [1, 2, 3, 5], 25, [0.3, 0.3], 12, 8)
    assert errors[2] < 1.05 * min(errors)
    assert errors[1] > 1.2 * errors[2]
    with pytest.raises(NotIdentifiableError, match="no record long enough"):
        order_errors("cva", u, y, [3], 1000, [1.0, 1.0], 12, 8)


def test_agrees_with_nfoursid_far_within_the_statistical_error() -> None:
    """nfoursid 1.0.2 finds the subspace by PO-MOESP too; its regression and weights differ in detail."""
    import pandas
    from nfoursid.nfoursid import NFourSID

    own_errors, differences = [], []
    for seed in range(3):
        u, y = data(seed, 3000, 0.3)
        peer = NFourSID(
            pandas.DataFrame(np.hstack([u, y]), columns=["u0", "u1", "y0", "y1"]), ["y0", "y1"], ["u0", "u1"], 12
        )
        peer.subspace_identification()
        theirs = peer.system_identification(3)[0]
        own = fit_subspace("moesp", u, y, 3, 12, 12, "open")
        peer_markov = System(theirs.a, theirs.b, theirs.c, theirs.d, resonance().K).markov(10)
        np.testing.assert_allclose(markov(own, 10), peer_markov, atol=0.02)
        own_errors.append(pole_error(own, resonance()))
        differences.append(pole_error(own, System(theirs.a, theirs.b, theirs.c, theirs.d, resonance().K)))
    assert np.mean(differences) < 0.5 * np.mean(own_errors)


def test_records_are_never_joined_and_a_missing_row_is_a_gap() -> None:
    first, second = data(0, 900, 0.1), data(1, 1100, 0.1)
    apart = fit_subspace("cva", [first[0], second[0]], [first[1], second[1]], 3, 10, 8)
    missing = np.full((1, 2), np.nan)
    joined = fit_subspace(
        "cva",
        np.concatenate([first[0], [[0.0, 0.0]], second[0]]),
        np.concatenate([first[1], missing, second[1]]),
        3,
        10,
        8,
    )
    assert apart.rows == joined.rows == 900 + 1100 - 2 * 17
    np.testing.assert_allclose(markov(apart, 8), markov(joined, 8), rtol=1e-6, atol=1e-9)
    assert pole_error(apart, resonance()) < 0.01
    wrong = fit_subspace("cva", np.concatenate([first[0], second[0]]), np.concatenate([first[1], second[1]]), 3, 10, 8)
    assert wrong.rows > apart.rows


@settings(max_examples=15)
@given(
    u_scale=st.floats(1e-4, 1e6),
    y_scale=st.floats(1e-4, 1e6),
    u_offset=st.floats(-100.0, 100.0),
    y_offset=st.floats(-100.0, 100.0),
    variant=st.sampled_from(VARIANTS),
)
def test_units_and_offsets_change_the_numbers_but_not_the_model(
    u_scale: float, y_scale: float, u_offset: float, y_offset: float, variant: tuple[str, Any]
) -> None:
    u, y = data(3, 700, 0.1)
    moved_u, moved_y = u_scale * (u + u_offset), y_scale * (y + y_offset)
    plain = fit_subspace(variant[0], u, y, 3, 8, 6, variant[1])
    moved = fit_subspace(variant[0], moved_u, moved_y, 3, 8, 6, variant[1])
    np.testing.assert_allclose(markov(moved, 6) * u_scale / y_scale, markov(plain, 6), rtol=1e-4, atol=1e-5)
    a, b = predict(plain, u, y, 50), predict(moved, moved_u, moved_y, 50)
    np.testing.assert_allclose(b.outputs / y_scale - y_offset, a.outputs, atol=1e-4)


def test_segments_are_simulated_from_their_best_initial_state() -> None:
    u, y = data(0, 2000, 0.0)
    model = fit_subspace("cva", u, y, 3, 8, 6)
    prediction = predict(model, u, y, 50)
    assert prediction.outputs.shape == (40, 50, 2)
    np.testing.assert_allclose(prediction.outputs.reshape(-1, 2), y, atol=1e-8)
    shifted = predict(model, u, y, 30, starts=[7, 400, 1970])
    np.testing.assert_allclose(shifted.outputs[2], y[1970:], atol=1e-8)


def test_white_measurement_noise_is_the_floor_of_the_segment_error_less_the_initial_states() -> None:
    system, rng = resonance()._replace(K=np.zeros((3, 2))), np.random.default_rng(5)
    u = rng.normal(size=(10_000, 2))
    y = system.run(u, np.array([0.2, 0.5]) * rng.normal(size=(10_000, 2)))
    model = fit_subspace("cva", u[:5000], y[:5000], 3, 15, 10)
    sigma = np.array([0.2, 0.5])
    residual = (predict(model, u[5000:], y[5000:], 50, sigma=sigma).outputs.reshape(-1, 2) - y[5000:]) / sigma
    assert np.mean(residual**2) == pytest.approx(1.0 - 3 / 100, abs=0.04)


def test_missing_outputs_leave_the_state_to_the_others() -> None:
    u, y = data(0, 400, 0.0)
    model = fit_subspace("cva", *data(0, 800, 0.0), 3, 8, 6)
    holes = y.copy()
    holes[10:20, 0] = np.nan
    holes[60] = np.nan
    np.testing.assert_allclose(predict(model, u, holes, 50).outputs.reshape(-1, 2), y, atol=1e-7)


def test_fit_orders_equals_single_fits() -> None:
    u, y = data(0, 800, 0.2)
    a = fit_subspace("moesp", u, y, 4, 8, 6)
    several = fit_orders("moesp", u, y, [2, 4], 8, 6)
    assert [model.order for model in several] == [2, 4]
    np.testing.assert_array_equal(several[1].A, a.A)
    np.testing.assert_array_equal(several[1].K, a.K)


def test_feedthrough_can_be_allowed_output_by_output() -> None:
    u, y = data(0, 2000, 0.1)
    model = fit_subspace("cva", u, y, 3, 10, 8, feedthrough=[False, True])
    assert not np.any(model.D[0])
    np.testing.assert_allclose(model.D[1], [0.0, -0.2], atol=0.02)


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"method": "mosp"}, ParameterError, "did you mean 'moesp'"),
        ({"order": 0}, ParameterError, "1 to 12"),
        ({"order": 13}, ParameterError, "1 to 12"),
        ({"past": 4, "future": 5}, ParameterError, "future <= past"),
        ({"outputs": np.zeros((10, 2))}, WindowError, "a record with inputs"),
        ({"outputs": [np.zeros((10, 2))] * 2}, WindowError, "as many of one"),
        ({"outputs": np.column_stack([np.arange(300.0), np.ones(300)])}, NotIdentifiableError, "output 1 never moves"),
        ({"outputs": np.full((300, 2), np.nan)}, NotIdentifiableError, "never measured"),
        ({"past": 30}, NotIdentifiableError, "usable rows"),
    ],
)
def test_what_cannot_be_identified_is_refused(arguments: dict[str, Any], error: type[Exception], message: str) -> None:
    u, y = data(0, 300, 0.1)
    usual: dict[str, Any] = {"method": "cva", "inputs": u, "outputs": y, "order": 3, "past": 8, "future": 6}
    with pytest.raises(error, match=message):
        fit_subspace(**(usual | arguments))


@pytest.mark.parametrize(
    ("inputs", "outputs", "length", "starts", "message"),
    [
        (np.zeros((9, 1)), np.zeros((9, 2)), 3, None, r"\(rows, 2\)"),
        (np.full((9, 2), np.nan), np.zeros((9, 2)), 3, None, "not finite"),
        (np.zeros((9, 2)), np.zeros((9, 2)), 10, None, "whole segments"),
        (np.zeros((9, 2)), np.zeros((9, 2)), 3, [7], "whole segments"),
        (np.zeros((9, 2)), np.zeros((9, 2)), 0, None, "whole segments"),
    ],
)
def test_what_cannot_be_predicted_is_refused(
    inputs: FloatArray, outputs: FloatArray, length: int, starts: Sequence[int] | None, message: str
) -> None:
    model = fit_subspace("cva", *data(0, 300, 0.1), 3, 8, 6)
    with pytest.raises(WindowError, match=message):
        predict(model, inputs, outputs, length, starts)
