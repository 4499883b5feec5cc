"""Two cuts of one flight: more is known than from one, as much more as the information says, and never less."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from quadid.data.window import Window
from quadid.identification import fit as fitting
from quadid.identification import uncertainty
from quadid.identification.fit import FitOptions, fit
from quadid.identification.gauss_newton import polish
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting, default_prior
from quadid.identification.uncertainty import BothCuts, with_second_cut
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray, IntArray
from tests.identify.flights import PELICAN, at_truth, flown, values_of, with_noise

WHITE = np.repeat([0.01, 0.003, 0.1], 3)
DRAWS = 60


def both(window: Window, start: FloatArray | None = None) -> tuple[BothCuts | None, FloatArray, FloatArray]:
    """Information of both cuts of a window with the noise `WHITE`, and value and information of one, nominal."""
    noise = NoiseModel(WHITE, np.zeros(9))
    shooting = Shooting.cut([window], PELICAN, 1.0, noise)
    free = shooting.free(NOMINAL_NAMES)
    prior = default_prior(shooting, free)
    one = polish(shooting, shooting.layout.initial(PELICAN) if start is None else start, free)
    return with_second_cut(shooting, one, free, prior), one.theta[:6], one.lin.gram.sum(axis=0)


def test_two_cuts_are_nearer_to_the_truth_by_what_their_information_says() -> None:
    flight = flown(3, noise_scale=0.0)
    start = at_truth(Shooting.cut([flight.window], PELICAN, 1.0), flight.truth.parameters)
    errors, single, promised = [], [], []
    for seed in range(DRAWS):
        found, one, _ = both(with_noise(flight.window, seed), start)
        assert found is not None
        errors.append(np.log(found.theta[:6] / values_of(flight.truth.parameters)))
        single.append(np.log(one / values_of(flight.truth.parameters)))
        promised.append(np.diag(np.linalg.inv(found.information)))
    variance, before = np.var(errors, axis=0), np.var(single, axis=0)
    # A variance of 60 draws is known to 18 %; the differences between two of the same draws much better.
    assert np.all(np.abs(np.log(variance / np.mean(promised, axis=0))) < 0.6)
    at = {n: i for i, n in enumerate(NOMINAL_NAMES)}
    for name in ("d", "J_zz", "J_r"):
        assert variance[at[name]] < 0.85 * before[at[name]], f"{name} hardly crosses a border of segments"
    assert np.all(variance < 1.1 * before)


def test_the_gain_is_between_nothing_and_that_of_twice_the_data() -> None:
    found, _, information = both(with_noise(flown(3, noise_scale=0.0).window, 1))
    assert found is not None
    gained = np.linalg.eigvals(np.linalg.solve(information, found.information)).real
    assert gained.min() > 0.8, "the other cut may tell less"
    assert gained.max() < 2.5


def test_the_segments_of_the_second_cut_begin_in_the_middle_of_those_of_the_first() -> None:
    shooting = Shooting.cut([flown(3).window, flown(3).window.slice(0, 62)], PELICAN, 1.0)
    second = shooting.between()
    assert second.segments[0].starts[0] == shooting.segments[0].starts[0] + 25
    assert np.all(second.segments[0].starts + 50 < len(flown(3).window))
    assert len(shooting.segments[1].starts) == 1
    assert len(second.segments) == 1, "no room for it in the short one"
    free = second.free(NOMINAL_NAMES)
    lin = second.linearise(second.layout.initial(PELICAN), free)
    assert len(lin.cost) == second.count
    found = with_second_cut(
        shooting, polish(shooting, second.layout.initial(PELICAN), free), free, default_prior(shooting, free)
    )
    assert found is not None
    assert np.isfinite(found.information).all()


def test_too_few_segments_or_a_poor_fit_leave_the_result_as_it_is() -> None:
    assert both(with_noise(flown(3, noise_scale=0.0).window.slice(0, 500), 1))[0] is None
    shooting = Shooting.cut([flown(3).window], PELICAN, 1.0)
    free = shooting.free(NOMINAL_NAMES)
    prior = default_prior(shooting, free)
    found = polish(shooting, shooting.layout.initial(PELICAN), free)
    assert with_second_cut(shooting, replace(found, cost=np.inf), free, prior) is None


def test_a_fit_narrows_what_crosses_borders_and_leaves_the_rest(monkeypatch: pytest.MonkeyPatch) -> None:
    window = flown(3).window
    found = fit([window], PELICAN, FitOptions(iterations=0)).parameters
    monkeypatch.setattr(fitting, "with_second_cut", lambda *given: None)
    one = fit([window], PELICAN, FitOptions(iterations=0)).parameters
    assert found["J_r"].sigma < 0.9 * one["J_r"].sigma
    assert found["b"].sigma == pytest.approx(one["b"].sigma, rel=0.05)


@pytest.mark.parametrize("spike", [6.0, 30.0])
@pytest.mark.parametrize("cut", ["first", "second"])
def test_a_spike_where_a_segment_begins_does_no_harm(cut: str, spike: float) -> None:
    """The initial state of that segment is the spoilt sample."""
    window = flown(3).window
    shooting = Shooting.cut([window], PELICAN, 1.0)
    start = (shooting if cut == "first" else shooting.between()).segments[0].starts[30]
    clean, spoilt = (fit([w], PELICAN, FitOptions(iterations=0)) for w in (window, spiked(window, [start - 1], spike)))
    moved = np.log(spoilt.theta[:6] / clean.theta[:6]) / clean.uncertainty.sigma
    assert np.abs(moved).max() < 1.0


def test_a_spike_in_every_hundredth_sample_costs_precision_and_no_more() -> None:
    window = flown(3).window
    rows = np.random.default_rng(1).choice(len(window), len(window) // 100, replace=False)
    clean, spoilt = (fit([w], PELICAN, FitOptions(iterations=0)) for w in (window, spiked(window, rows, 10.0)))
    error = np.log(spoilt.theta[:6] / clean.theta[:6])
    assert np.all(np.abs(error) < 2.0 * spoilt.uncertainty.sigma)
    assert np.all(np.abs(error) < 0.02)


def spiked(window: Window, rows: Sequence[int] | IntArray, size: float) -> Window:
    """The window with `size` [rad/s] added to r at some rows."""
    assert window.gyro is not None
    gyro = window.gyro.copy()
    gyro[np.asarray(rows), 2] += size
    return replace(window, gyro=gyro)


def test_a_second_cut_that_goes_astray_is_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(uncertainty, "WORSE", 0.5)
    assert both(with_noise(flown(3, noise_scale=0.0).window, 1))[0] is None


def test_many_short_windows_are_cut_once() -> None:
    window = flown(3).window
    pieces = [window.slice(i, i + 113) for i in range(0, 2600, 113)]
    shooting = Shooting.cut(pieces, PELICAN, 1.0)
    free = shooting.free(NOMINAL_NAMES)
    found = polish(shooting, shooting.layout.initial(PELICAN), free)
    assert (shooting.count, shooting.between().count) == (48, 24)
    assert with_second_cut(shooting, found, free, default_prior(shooting, free)) is None


def test_what_both_cuts_share_is_taken_where_the_flight_tells_most() -> None:
    """Nine tenths hover: segments spread evenly would hardly meet the manoeuvres that all the information is in."""
    calm, lively = flown(3, "hover", 240.0).window, flown(3, seconds=20.0).window
    shooting = Shooting.cut([calm, lively], PELICAN, 1.0, NoiseModel(WHITE, np.zeros(9)))
    free = shooting.free(NOMINAL_NAMES)
    prior = default_prior(shooting, free)
    one = polish(shooting, shooting.layout.initial(PELICAN), free)
    gains = []
    for most in (60, 10_000):
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr(uncertainty, "MOST_COMPARED", most)
            found = with_second_cut(shooting, one, free, prior)
        assert found is not None
        gains.append(np.diag(np.linalg.inv(found.information + np.diag(prior.sigma**-2.0))))
    assert np.all(np.abs(np.log(gains[0] / gains[1])) < 0.1)


def test_what_both_cuts_share_needs_only_some_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    window = with_noise(flown(3, noise_scale=0.0).window, 1)
    whole, _, _ = both(window)
    monkeypatch.setattr(uncertainty, "MOST_COMPARED", 30)
    some, _, _ = both(window)
    assert whole is not None
    assert some is not None
    assert np.array_equal(whole.theta, some.theta)
    ratio = np.diag(np.linalg.inv(some.information)) / np.diag(np.linalg.inv(whole.information))
    assert np.all(np.abs(np.log(ratio)) < 0.15)
