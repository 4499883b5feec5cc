"""Motion of the rotors between two readings widens the intervals of a window."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from quadid.data.window import Sampling, Window
from quadid.identification.gauss_newton import polish
from quadid.identification.problem import Shooting
from quadid.model.layout import Layout
from quadid.online import fit_job
from quadid.online.fit_job import (
    LASTING,
    ORDER,
    Flexible,
    WindowEstimate,
    alike,
    flexible_fit,
    halved,
    prior_of,
    reduced,
    sampling_error,
    widened,
)
from quadid.online.fusion import Fusion
from quadid.online.stream import Resampler
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.online.driving import flight, samples
from tests.online.made_up import nothing_left_out

PELICAN = Vehicle.shipped("pelican")

ROWS = 200
DT = 0.02


def window(frequency: float, sampling: Sampling) -> Window:
    t = DT * np.arange(ROWS)
    speed = 400.0 + 20.0 * np.sin(2.0 * np.pi * frequency * t)[:, None] * [1.0, -1.0, 1.0, -1.0]
    attitude = np.tile([1.0, 0.0, 0.0, 0.0], (ROWS, 1))
    return Window(0.0, DT, speed, np.zeros((ROWS, 3)), attitude, sampling=sampling)


@pytest.mark.parametrize("first", [0, 1])
def test_every_second_row_is_left_out(first: int) -> None:
    for sampling in ("held", "instant"):
        full = window(1.0, sampling)
        sparse = halved(full, first)
        kept, left_out = slice(first, None, 2), slice(first + 1, -1, 2)
        np.testing.assert_array_equal(sparse.rotor_speed[kept], full.rotor_speed[kept])
        before, after = full.rotor_speed[left_out.start - 1 : -2 : 2], full.rotor_speed[left_out.start + 1 :: 2]
        expected = before if sampling == "held" else 0.5 * (before + after)
        np.testing.assert_allclose(sparse.rotor_speed[left_out][: len(expected)], expected)


def test_lines_miss_four_times_as_much_at_twice_the_distance() -> None:
    """The error of a slow motion, by which the shift is divided; a fast one moves as much as it turns."""

    def missed(frequency: float) -> float:
        full = window(frequency, "instant").rotor_speed
        off = halved(window(frequency, "instant"), 0).rotor_speed - full
        return float(np.std(off[2:-2]) / np.std(full - 400.0))

    assert missed(1.0) / missed(0.5) == pytest.approx(4.0, rel=0.02)
    assert missed(1.0) < 0.01
    assert missed(20.0) > 1.0


def test_an_added_covariance_leaves_the_optimum_and_widens_by_itself() -> None:
    rng = np.random.default_rng(3)
    root = rng.normal(size=(6, 6))
    information = root @ root.T + 50.0 * np.eye(6)
    own = WindowEstimate(
        0.0, 10.0, rng.normal(size=6), information, rng.normal(size=6), 900.0, 300.0, nothing_left_out()
    )
    shift: FloatArray = np.array([0.0, 0.0, 0.08, 0.05, 0.0, 0.0])
    wide = widened(own, np.outer(shift, shift))

    def optimum(w: WindowEstimate) -> FloatArray:
        return np.asarray(w.z - np.linalg.solve(w.information, w.score))

    np.testing.assert_allclose(optimum(wide), optimum(own))
    added = np.linalg.inv(wide.scale * wide.information) - np.linalg.inv(own.scale * own.information)
    np.testing.assert_allclose(added, np.outer(shift, shift), atol=1e-12)


@dataclass(frozen=True)
class Moved:
    """Says that leaving rows out moves the estimate by `shifts`, whatever the data."""

    shifts: tuple[FloatArray, FloatArray]

    def __call__(self, monkeypatch: pytest.MonkeyPatch, sampling: Sampling, spacing: float) -> FloatArray:
        own = WindowEstimate(0.0, 10.0, np.zeros(6), np.eye(6), np.zeros(6), 900.0, 300.0, nothing_left_out())
        moved = iter([replace(own, score=-shift) for shift in self.shifts])
        monkeypatch.setattr(fit_job, "reduced", lambda *_: next(moved))
        windows = (window(1.0, sampling),)
        problem = Shooting.cut(windows, PELICAN, 0.5, None, Layout(PELICAN))
        free = problem.free(list(NOMINAL_NAMES))
        start = Layout(PELICAN).initial(PELICAN)
        best = polish(problem, start, free, prior_of(PELICAN), iterations=1)
        missed = sampling_error(own, Flexible(problem, free, prior_of(PELICAN), best), spacing)
        np.testing.assert_array_equal(missed, np.diag(np.diag(missed)))
        return np.sqrt(np.diag(missed))


@pytest.mark.parametrize(("sampling", "order"), ORDER.items())
def test_what_is_in_step_falls_with_the_distance_and_noise_with_its_square(
    sampling: Sampling, order: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trials that move apart tell of torque in step with the motion, trials that move alike of noise of the input."""
    shift = np.array([0.01, 0.0, 0.08, 0.08, 0.0, 0.0])
    for other, power in ((-shift, 1), (shift, 2)):
        said = [Moved((shift, other))(monkeypatch, sampling, spacing) for spacing in (2.0, 1.0, 0.5)]
        np.testing.assert_allclose(said[0], shift)
        np.testing.assert_allclose(said[1], shift / 2.0 ** (power * order))
        np.testing.assert_allclose(said[2], shift / 4.0 ** (power * order))


def test_roll_and_pitch_are_two_tries_at_one_error(monkeypatch: pytest.MonkeyPatch) -> None:
    shift = np.array([0.0, 0.0, 0.08, 0.0, 0.0, 0.0])
    said = Moved((shift, -shift))(monkeypatch, "held", 2.0)
    np.testing.assert_allclose(said[2:4], 0.08 / np.sqrt(2.0))


def test_windows_of_one_minute_say_an_error_that_lasts_once() -> None:
    """As many windows as err alike know together what one of them knows."""
    information = np.diag(np.full(6, 1e12))
    missed = np.diag(np.full(6, 0.04**2))
    fusion, length, count = Fusion(np.zeros(6), np.full(6, 1e3), 1e9), LASTING / 5.0, 5
    for k in range(count):
        own = WindowEstimate(
            k * length, (k + 1) * length, np.zeros(6), information, np.zeros(6), 900.0, 900.0, nothing_left_out()
        )
        assert alike(own) == pytest.approx(count)
        fusion.add(widened(own, alike(own) * missed))
    fused = fusion.estimate()
    assert fused is not None
    np.testing.assert_allclose(fused.sigma, 0.04, rtol=1e-3)
    assert alike(replace(own, stop=own.start + 2.0 * LASTING)) == 1.0


def test_every_window_has_an_error_of_readings_and_closer_ones_a_smaller_one() -> None:
    """A descent that refused every step once told of none, and that window outweighed all others."""
    full = flight(24.0, 5).window.slice(0, 300)
    for sampling, order in ORDER.items():
        windows = (replace(full, sampling=sampling),)
        start = Layout(PELICAN).initial(PELICAN)
        fitted = flexible_fit(windows, PELICAN, prior_of(PELICAN), start, None)
        estimate = reduced(0.0, 6.0, fitted)
        whole, half = (np.sqrt(np.diag(sampling_error(estimate, fitted, spacing))) for spacing in (1.0, 0.5))
        assert (whole > 0.0).all()
        assert (whole / half >= 2.0**order * (1.0 - 1e-9)).all()
        assert (whole / half <= 4.0**order * (1.0 + 1e-9)).all()


def test_windows_that_err_together_are_not_surer_for_it() -> None:
    """Each window errs by its own mix of roll and pitch; no pair of them tells either to more than it knows."""
    information = np.diag(np.full(6, 1e6))
    fusion = Fusion(np.zeros(6), np.ones(6), 1e9)
    for k, (roll, pitch) in enumerate([(0.06, 0.05), (0.05, 0.06), (0.04, 0.06)]):
        missed = np.diag(np.array([0.0, 0.0, roll, pitch, 0.0, 0.0]) ** 2)
        own = WindowEstimate(
            10.0 * k, 10.0 * k + 10.0, np.zeros(6), information, np.zeros(6), 900.0, 900.0, nothing_left_out()
        )
        fusion.add(widened(own, missed))
    fused = fusion.estimate()
    assert fused is not None
    assert (fused.sigma[2:4] > 0.04 / np.sqrt(3.0)).all()


@pytest.mark.parametrize("every", [1, 2])
def test_the_rows_tell_how_close_the_readings_are(every: int) -> None:
    channels = dict(flight(24.0, 5).recording.channels)
    rotors = channels["rotor_speed"]
    channels["rotor_speed"] = replace(rotors, t=rotors.t[::every], values=rotors.values[::every])
    resampler = Resampler(PELICAN, 50.0)
    for sample in samples(replace(flight(24.0, 5).recording, channels=channels)):
        resampler.push(sample.block)
    spacing = set[float]()
    while resampler.busy:
        rows = resampler.work()
        spacing |= {round(rows.spacing, 2)} if rows is not None else set()
    assert spacing == {float(every)}
