"""Gauss-Newton: reaches the optimum, stays inside the bounds, steps back from simulations that run away."""

from dataclasses import dataclass, replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import lsq_linear

from quadid.errors import NotIdentifiableError, QuadidError
from quadid.identification import gauss_newton as polishing
from quadid.identification.elimination import InitialStates
from quadid.identification.fit import FitOptions, fit
from quadid.identification.gauss_newton import LONGEST_STEP, Convergence, Polished, bounded_step, polish, robust_weights
from quadid.identification.problem import (
    MEASURED,
    PRIOR_SIGMA_LINEAR,
    Free,
    Linearised,
    Shooting,
    default_prior,
    prior_terms,
)
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import ParameterPrior
from tests.identify.flights import PELICAN, at_truth, flown, guessed, values_of

LAYOUT = Layout(PELICAN)
MIXED = ("b", "d", "J_xx", "motor_lag.tau", "parasitic_drag.c", "rotor_drag.k_x", "cg_offset.x", "battery_sag.fraction")


@pytest.fixture(scope="module")
def optimum() -> Polished:
    """Optimum on one-second segments, started from the truth."""
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    return polish(shooting, at_truth(shooting, flown(3).truth.parameters), shooting.free(NOMINAL_NAMES), iterations=30)


def distance(optimum: Polished, theta: FloatArray) -> FloatArray:
    """Distance of `theta` from the optimum, in standard deviations of each parameter."""
    sigma = np.sqrt(np.diag(np.linalg.inv(optimum.lin.gram.sum(axis=0))))
    return np.asarray(np.log(theta[:6] / optimum.theta[:6]) / sigma)


@pytest.mark.parametrize("seed", range(4))
def test_every_perturbed_start_leads_to_the_same_optimum(optimum: Polished, seed: int) -> None:
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    free = shooting.free(NOMINAL_NAMES)
    start = free.move(optimum.theta, np.random.default_rng(seed).uniform(-0.35, 0.35, 6))
    result = polish(shooting, start, free, iterations=30)
    assert result.outcome is Convergence.CONVERGED
    assert np.abs(distance(optimum, result.theta)).max() < 0.05
    assert result.cost == pytest.approx(optimum.cost, rel=1e-6)
    assert result.iterations <= 15


def test_at_the_optimum_no_direction_lowers_the_cost(optimum: Polished) -> None:
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    free = shooting.free(NOMINAL_NAMES)
    _, pull, _ = prior_terms(free, default_prior(shooting, free), optimum.theta)
    left = optimum.lin.gradient + pull
    sigma = 1.0 / np.sqrt(np.diag(optimum.lin.gram.sum(axis=0)))
    assert np.abs(left * sigma).max() < 0.1


def test_a_polish_with_outliers_settles_too() -> None:
    """Weights are renewed at every step, so costs before and after must be compared under the same weights."""
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    free, start = shooting.free(NOMINAL_NAMES), shooting.layout.initial(guessed(flown(3).truth.parameters))
    robust, plain = (polish(shooting, start, free, robust=robust) for robust in (True, False))
    assert robust.outcome is plain.outcome is Convergence.CONVERGED
    # Gaussian noise: hardly a sample lies beyond four sigma, so both must agree.
    moved = np.log(robust.theta[:6] / plain.theta[:6]) * np.sqrt(np.diag(plain.lin.information))
    assert np.abs(moved).max() < 0.05


def test_outliers_lose_their_pull() -> None:
    """One gyro row in a hundred is off by 2 rad/s."""
    flight = flown(3)
    rng = np.random.default_rng(0)
    assert flight.window.gyro is not None
    gyro = flight.window.gyro.copy()
    hit = rng.choice(len(gyro), len(gyro) // 100, replace=False)
    gyro[hit] += 2.0 * rng.choice([-1.0, 1.0], (len(hit), 3))
    window = replace(flight.window, gyro=gyro)
    truth = values_of(flight.truth.parameters)
    found = fit([window], guessed(flight.truth.parameters), FitOptions(iterations=0)).theta[:6]
    assert np.abs(np.log(found / truth))[[2, 3]].max() < 0.03


def test_weights_of_good_samples_are_one_and_of_outliers_fall_with_their_size() -> None:
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    theta = at_truth(shooting, flown(3).truth.parameters)
    lin = shooting.linearise(theta, shooting.free([]))
    white = np.abs(lin.residuals) / np.sqrt(shooting.noise.variance)
    weights = robust_weights(shooting, lin)
    np.testing.assert_array_equal(weights[white <= polishing.HUBER], 1.0)
    far = white > polishing.HUBER
    np.testing.assert_allclose((weights * white)[far] ** 2, polishing.HUBER * white[far])


def entry_bounds(free: Free, theta: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Bounds of the scaled step, written out."""
    low, high = [], []
    for e in free.entries:
        value = theta[e.index]
        if e.name in NOMINAL_NAMES:
            low.append(np.log(e.lower / value))
            high.append(np.log(e.upper / value))
        else:
            low.append((e.lower - value) / e.typical)
            high.append((e.upper - value) / e.typical)
    return np.array(low), np.array(high)


def random_quadratic(seed: int, tilt: float, near: bool) -> tuple[Free, FloatArray, FloatArray, FloatArray]:
    """A least-squares problem |A z - y|^2 in scaled steps; `near` places the parameters close to their bounds."""
    rng = np.random.default_rng(seed)
    free = Free(tuple(LAYOUT.entry(n) for n in MIXED))
    theta = LAYOUT.initial(PELICAN)
    if near:
        for e in free.entries:
            share = rng.choice([0.0, 0.02, 0.5, 0.98, 1.0])
            theta[e.index] = e.lower + share * (e.upper - e.lower)
    a = rng.standard_normal((14, 8)) @ (np.eye(8) + tilt * rng.standard_normal((8, 8)))
    return free, theta, a, 5.0 * rng.standard_normal(14)


@settings(max_examples=100)
@given(seed=st.integers(0, 2**32), tilt=st.floats(0.0, 2.0), near=st.booleans())
def test_a_step_never_leaves_the_bounds(seed: int, tilt: float, near: bool) -> None:
    free, theta, a, y = random_quadratic(seed, tilt, near)
    z = bounded_step(free, theta, a.T @ a, -a.T @ y)
    low, high = entry_bounds(free, theta)
    assert np.all((z >= low - 1e-9) & (z <= high + 1e-9))
    moved = free.move(theta, z)
    for e in free.entries:
        assert e.lower <= moved[e.index] <= e.upper
    np.testing.assert_allclose(free.step(theta, moved), z, atol=1e-7)


@pytest.mark.parametrize("near", [False, True])
@pytest.mark.parametrize("tilt", [0.0, 0.3, 1.0])
def test_a_step_is_the_best_within_the_bounds(tilt: float, near: bool) -> None:
    """Against scipy's bounded least squares, from well to badly conditioned problems."""
    for seed in range(60):
        free, theta, a, y = random_quadratic(seed, tilt, near)
        h, g = a.T @ a, -a.T @ y
        z = bounded_step(free, theta, h, g)
        low, high = entry_bounds(free, theta)
        best = lsq_linear(a, y, (low - 1e-12, high + 1e-12), method="bvls", tol=1e-14).x
        found, least = (float(2.0 * g @ x + x @ h @ x) for x in (z, best))
        assert found <= 1e-9  # never worse than not moving
        assert found == pytest.approx(least, rel=1e-6, abs=1e-6), (seed, tilt, near)


@dataclass(frozen=True)
class Cliff(Shooting):
    """A problem whose simulation runs away where J_xx is above `edge`."""

    edge: float = np.inf
    sign: str = "cost"

    def linearise(self, theta: FloatArray, free: Free, states: InitialStates | None = None) -> Linearised:
        lin = super().linearise(theta, free, states)
        if theta[LAYOUT.entry("J_xx").index] > self.edge:
            if self.sign == "cost":
                lin.cost[:] = np.inf
            elif self.sign == "slopes":
                lin.gram[:] = np.inf
            else:
                lin.gram[:] *= -1.0
        return lin


@pytest.mark.parametrize("sign", ["cost", "slopes", "digits"])
def test_a_simulation_that_runs_away_is_stepped_back_from(optimum: Polished, sign: str) -> None:
    index = LAYOUT.entry("J_xx").index
    plain = Shooting.cut([flown(3).window], PELICAN, 1.0)
    shooting = Cliff(**vars(plain), edge=0.97 * optimum.theta[index], sign=sign)
    free = shooting.free(NOMINAL_NAMES)
    start = optimum.theta.copy()
    start[index] *= 0.7
    result = polish(shooting, start, free, iterations=40)
    assert np.isfinite(result.cost)
    assert start[index] < result.theta[index] <= shooting.edge
    before = Shooting.cut([flown(3).window], PELICAN, 1.0).linearise(start, free).cost.sum()
    assert result.cost < 0.5 * before


def test_no_step_is_longer_than_the_longest(monkeypatch: pytest.MonkeyPatch, optimum: Polished) -> None:
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    free = shooting.free((*NOMINAL_NAMES, "cg_offset.x", "gyro_bias.x"))
    start = optimum.theta.copy()
    start[shooting.layout.entry("cg_offset.x").index] = 0.08
    steps: list[FloatArray] = []
    real = Free.move

    def spy(self: Free, theta: FloatArray, z: FloatArray) -> FloatArray:
        steps.append(z.copy())
        return real(self, theta, z)

    monkeypatch.setattr(Free, "move", spy)
    result = polish(shooting, start, free, iterations=25)
    assert max(np.abs(z).max() for z in steps) <= LONGEST_STEP + 1e-12
    assert abs(result.theta[shooting.layout.entry("cg_offset.x").index]) < 2e-4


def test_a_known_sigma_of_the_vehicle_file_pulls_like_a_measurement() -> None:
    """A guess known to one in ten thousand holds its parameter where the file says."""
    flight = flown(3)
    truth = flight.truth.parameters.as_dict()
    parameters = {n: ParameterPrior(initial=v) for n, v in truth.items()}
    parameters["J_xx"] = ParameterPrior(initial=1.1 * truth["J_xx"], sigma=1.1e-4 * truth["J_xx"])
    vehicle = PELICAN.model_copy(update={"parameters": parameters})
    shooting = Shooting.cut([flight.window], vehicle, 1.0)
    free = shooting.free(NOMINAL_NAMES)
    prior = default_prior(shooting, free)
    assert prior.sigma[2] == pytest.approx(1e-4)
    np.testing.assert_allclose(prior.sigma[[0, 1, 3]], np.log(4.0))
    result = polish(shooting, at_truth(shooting, flight.truth.parameters), free, iterations=20)
    assert result.theta[2] == pytest.approx(1.1 * truth["J_xx"], rel=2e-3)
    precision, pull, cost = prior_terms(free, prior, result.theta)
    z = np.log(result.theta[:6] / prior.mean)
    np.testing.assert_allclose(pull, z * precision)
    assert cost == pytest.approx(float(np.sum(z**2 * precision)))


def test_the_prior_of_an_effect_is_ten_typical_sizes_about_neutral() -> None:
    shooting = Shooting.cut([flown(3).window.slice(0, 200)], PELICAN, 1.0)
    free = shooting.free(["cg_offset.x", "motor_lag.tau"])
    prior = default_prior(shooting, free)
    np.testing.assert_array_equal(prior.mean, 0.0)
    np.testing.assert_array_equal(prior.sigma, PRIOR_SIGMA_LINEAR)


def test_a_direction_without_information_gets_no_step_of_its_own() -> None:
    """Two parameters that act alike share the step; one that does nothing stays."""
    free, theta, a, y = random_quadratic(1, 0.0, near=False)
    a[:, 1], a[:, 3] = a[:, 0], 0.0
    z = bounded_step(free, theta, a.T @ a, -0.01 * a.T @ y)
    assert np.isfinite(z).all()
    assert z[3] == pytest.approx(0.0, abs=1e-9)
    assert z[0] == pytest.approx(z[1], rel=1e-6)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_equations_that_are_not_finite_are_refused_in_words(bad: float) -> None:
    free, theta, a, y = random_quadratic(2, 0.0, near=False)
    h = a.T @ a
    h[2, 2] = bad
    with pytest.raises(NotIdentifiableError, match="not finite"):
        bounded_step(free, theta, h, -a.T @ y)


@pytest.mark.parametrize("hopeless", ["still", "huge", "tiny rotor speed"])
def test_hopeless_data_end_in_an_answer_or_an_error_of_ours(hopeless: str) -> None:
    window = flown(3).window.slice(0, 400)
    rotors, gyro = np.array(window.rotor_speed), np.array(window.gyro)
    if hopeless == "still":
        rotors[:], gyro[:] = 0.0, 0.0
    elif hopeless == "huge":
        gyro *= 1e12
    else:
        rotors *= 1e-12
    changed = replace(window, rotor_speed=rotors, gyro=gyro)
    try:
        found = fit([changed], PELICAN, FitOptions(iterations=0))
    except QuadidError:
        return
    assert np.isfinite(found.theta).all()
    assert np.isfinite(found.uncertainty.sigma).all()


def test_initial_states_gone_astray_are_left_for_measured_ones() -> None:
    """Ten radians a second off, no linear step keeps its promise, and each would be refused for ever."""
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    free = shooting.free([*NOMINAL_NAMES, "rotor_drag.k_x", "rotor_drag.k_y"])
    start = free.move(at_truth(shooting, flown(3).truth.parameters), np.full(len(free.entries), 0.2))
    wanted = polish(shooting, start, free, iterations=30)
    measured = shooting.starts(1)
    x0 = measured.x0[0].copy()
    x0[:, 4:7] += 10.0 * np.random.default_rng(1).standard_normal((len(x0), 3))
    states = MEASURED.replaced(1, measured._replace(x0=(x0,)))
    found = polish(shooting, start, free, states=states, iterations=30, settled=True)
    assert found.cost == pytest.approx(wanted.cost, rel=5e-3)
