"""Held-out blocks: against plain refits, and an error that holds under autocorrelation."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.signal import lfilter
from scipy.stats import multivariate_normal

from quadid.diagnosis.hypotheses import block_labels, extend, held_out, paired_gain, steps_without, sum_by_block
from quadid.identification.gauss_newton import polish
from quadid.identification.problem import MEASURED, Linearised, Shooting
from quadid.identification.result import settle_states
from quadid.model.rollout import Segments
from quadid.types import BoolArray, FloatArray
from tests.diagnose.problems import cause, fitted, window_with

ROWS, WIDTH = 30, 5


def linear(rng: np.random.Generator, segments: int) -> tuple[Linearised, FloatArray, FloatArray]:
    """A linear problem r + B z of `segments` one-second segments, and its B and r."""
    b, r = rng.standard_normal((segments, ROWS, WIDTH)), rng.standard_normal((segments, ROWS))
    nothing = np.zeros((segments, 1))
    lin = Linearised(
        gram=np.einsum("srp,srq->spq", b, b),
        grad=np.einsum("srp,sr->sp", b, r),
        cost=np.sum(r * r, axis=1),
        occam=np.zeros(segments),
        rows=np.full(segments, float(ROWS)),
        residuals=nothing,
        weights=nothing,
        back=(nothing, nothing),
        window=np.zeros(segments, dtype=np.intp),
        time=3.0 + np.arange(segments, dtype=np.float64),
        states=MEASURED,
        n_pre=1,
    )
    return lin, b, r


def refitted(b: FloatArray, r: FloatArray, prior: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Mean and covariance of the parameters of a linear problem."""
    rows = np.vstack([b.reshape(-1, WIDTH), np.diag(np.sqrt(prior))])
    z = np.linalg.lstsq(rows, -np.concatenate([r.ravel(), np.zeros(WIDTH)]), rcond=None)[0]
    return z, np.linalg.inv(rows.T @ rows)


def test_held_out_deviance_is_that_of_what_refits_without_each_block_predict() -> None:
    lin, b, r = linear(np.random.default_rng(1), 47)
    labels = block_labels(lin)
    prior = np.array([0.1, 1.0, 10.0, 0.5, 2.0])
    expected = []
    for block in range(labels.max() + 1):
        z, covariance = refitted(b[labels != block], r[labels != block], prior)
        own = b[labels == block].reshape(-1, WIDTH)
        density = multivariate_normal(cov=np.eye(len(own)) + own @ covariance @ own.T)
        noise = len(own) * np.log(2.0 * np.pi)
        expected.append(-2.0 * density.logpdf(r[labels == block].ravel() + own @ z) - noise)
    np.testing.assert_allclose(held_out(lin, prior).block, expected, rtol=1e-10)


def test_steps_without_blocks_are_those_of_refits() -> None:
    lin, b, r = linear(np.random.default_rng(6), 47)
    labels = block_labels(lin)
    prior = np.array([0.1, 1.0, 10.0, 0.5, 2.0])
    steps = steps_without(sum_by_block(lin.gram, labels), sum_by_block(lin.grad, labels), prior)
    for block, step in enumerate(steps):
        np.testing.assert_allclose(step, refitted(b[labels != block], r[labels != block], prior)[0], rtol=1e-9)


def test_the_deviance_of_the_other_blocks_is_that_of_a_refit_to_them() -> None:
    lin, b, r = linear(np.random.default_rng(8), 47)
    labels = block_labels(lin)
    prior = np.array([0.1, 1.0, 10.0, 0.5, 2.0])
    expected = []
    for block in range(labels.max() + 1):
        z = refitted(b[labels != block], r[labels != block], prior)[0]
        expected.append(np.sum((r[labels != block] + b[labels != block] @ z) ** 2) + np.sum(prior * z * z))
    np.testing.assert_allclose(held_out(lin, prior).rest, expected, rtol=1e-10)


def test_a_block_that_alone_determines_a_parameter_does_not_decide_against_it() -> None:
    """One block moves as no other does, and a model error common to all makes the others extrapolate badly.

    The parameter acts in all blocks, weakly in all but one; its error there, of ten of its own standard deviations from
    the others, is what an extrapolation is worth, not what the parameter is.
    """
    rng = np.random.default_rng(7)
    lin, b, r = linear(rng, 40)
    labels = block_labels(lin)
    b[..., 0] *= 0.02
    b[labels == 9, :, 0] *= 1000.0
    r += 3.0 * b[..., 0]
    r[labels != 9] += 0.5 * np.sign(b[labels != 9, :, 0])
    lin = replace(lin, gram=np.einsum("srp,srq->spq", b, b), grad=np.einsum("srp,sr->sp", b, r), cost=np.sum(r * r, 1))
    bare = replace(lin, gram=lin.gram[:, 1:, 1:], grad=lin.grad[:, 1:])
    prior = np.full(WIDTH, 1e-4)
    point = steps_without(sum_by_block(lin.gram, labels), sum_by_block(lin.grad, labels), prior)[9]
    missed = np.sum((r[labels == 9] + b[labels == 9] @ point) ** 2)
    without, whole = held_out(bare, prior[1:]).block, held_out(lin, prior).block
    assert missed > without[9]
    assert whole[9] < 0.01 * without[9]
    assert whole.sum() < without.sum()


def test_parameters_that_fit_only_noise_are_charged_for() -> None:
    """In-sample deviance falls by one a parameter, held-out deviance rises by about as much: Akaike's penalty."""
    fallen, risen = [], []
    for seed in range(60):
        lin, _, _ = linear(np.random.default_rng(100 + seed), 100)
        z = -np.linalg.solve(lin.gram.sum(axis=0), lin.grad.sum(axis=0))
        fallen.append(-float(lin.grad.sum(axis=0) @ z))
        held = held_out(lin, np.full(WIDTH, 1e-9)).block
        risen.append(float(held.sum() - lin.cost.sum()))
    assert np.mean(fallen) == pytest.approx(WIDTH, abs=4.0 * np.std(fallen) / np.sqrt(60.0))
    assert np.mean(risen) == pytest.approx(WIDTH, rel=0.2, abs=4.0 * np.std(risen) / np.sqrt(60.0))


def test_a_model_without_parameters_has_its_own_cost() -> None:
    lin, _, _ = linear(np.random.default_rng(2), 30)
    bare = replace(lin, gram=lin.gram[:, :0, :0], grad=lin.grad[:, :0])
    labels = block_labels(lin)
    expected = np.bincount(labels, lin.cost)
    np.testing.assert_allclose(held_out(bare, np.zeros(0)).block, expected)


@pytest.mark.parametrize(("seconds", "blocks"), [(120, 10), (60, 10), (20, 10), (10, 5)])
def test_blocks_are_tenths_of_a_flight_but_two_segments_at_least(seconds: int, blocks: int) -> None:
    lin, _, _ = linear(np.random.default_rng(3), seconds)
    labels = block_labels(lin)
    assert labels.max() + 1 == blocks
    assert np.all(np.diff(labels) >= 0)
    spans = [np.ptp(lin.time[labels == b]) for b in range(blocks)]
    assert max(spans) - min(spans) <= 1.0, "segments of a second"


def test_no_block_spans_two_flights() -> None:
    lin, _, _ = linear(np.random.default_rng(4), 100)
    lin = replace(lin, window=np.repeat(np.array([0, 1], dtype=np.intp), 50))
    labels = block_labels(lin)
    assert all(len(np.unique(lin.window[labels == b])) == 1 for b in range(labels.max() + 1))
    assert np.all(np.unique(labels) == np.arange(labels.max() + 1))


def test_the_leave_out_step_is_that_of_full_refits_of_a_nonlinear_model() -> None:
    """One Gauss-Newton step from the common optimum against polishing without the block, on a flight with lag."""
    problem = fitted(window_with({"motor_lag": {"tau": 0.04}}))
    model = extend(problem.shooting, problem.nominal, cause(problem, "motor_lag"), iterations=12)
    labels = block_labels(model.lin)
    inside = np.bincount(labels, model.lin.cost + model.lin.occam)
    gram, grad = (sum_by_block(a, labels) for a in (model.lin.gram, model.lin.grad))
    step = steps_without(gram, grad, model.prior.precision)
    left_out = inside + np.einsum("bp,bp->b", 2.0 * grad + np.einsum("bpq,bq->bp", gram, step), step)
    for block in (0, 4, 9):
        rest = without_block(problem.shooting, labels != block)
        theta = polish(rest, model.theta, model.free, iterations=8, tolerance=0.01).theta
        lin = settle_states(problem.shooting, theta, model.free.names)
        refitted = float(np.sum((lin.cost + lin.occam)[labels == block]))
        charge = refitted - inside[block]
        assert charge > 0.0
        assert left_out[block] - inside[block] == pytest.approx(charge, rel=0.1, abs=0.2)


def without_block(shooting: Shooting, keep: BoolArray) -> Shooting:
    """The problem on some of its segments."""
    (window,) = [r.window for r in shooting.rollouts]
    out = Shooting.cut([window], shooting.vehicle, shooting.length * shooting.dt, shooting.noise, shooting.layout)
    (whole,) = out.segments
    return replace(out, segments=(Segments(whole.length, whole.lead, np.ascontiguousarray(whole.starts[keep])),))


def test_the_error_of_a_gain_holds_under_autocorrelation_where_that_of_single_segments_does_not() -> None:
    """No true gain, differences with a memory of 1.5 s, 12 blocks of 10 s: 95 % intervals must hold zero 95 % of the
    time (400 draws: standard error 1.1 %); errors from segments taken as independent hold it far too seldom."""
    rng = np.random.default_rng(5)
    pole = np.exp(-1.0 / 1.5)
    held = naive = 0
    for _ in range(400):
        x = np.asarray(lfilter([1.0], [1.0, -pole], rng.standard_normal(220)))[100:]
        gain = paired_gain(x.reshape(12, 10).sum(axis=1), np.zeros(12))
        held += gain.interval[0] < 0.0 < gain.interval[1]
        naive += abs(x.sum()) < 1.96 * np.sqrt(120.0) * x.std(ddof=1)
    assert 0.91 <= held / 400 <= 0.985
    assert naive / 400 < 0.85


def test_without_spread_there_is_no_evidence() -> None:
    assert paired_gain(np.ones(1), np.zeros(1)).error == float("inf")
    assert paired_gain(np.zeros(5), np.zeros(5)).interval == (0.0, 0.0)
