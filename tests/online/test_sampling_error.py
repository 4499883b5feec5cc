"""What the rotors do between two rows widens the intervals of a window."""

from __future__ import annotations

import numpy as np
import pytest

from quadid.online.flexible_fit import halved, widened
from quadid.online.fusion import WindowEstimate
from quadid.types import FloatArray
from quadid.window import Sampling, Window

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
    own = WindowEstimate(0.0, 10.0, rng.normal(size=6), information, rng.normal(size=6), 900.0, 300.0)
    shift: FloatArray = np.array([0.0, 0.0, 0.08, 0.05, 0.0, 0.0])
    wide = widened(own, np.outer(shift, shift))

    def optimum(w: WindowEstimate) -> FloatArray:
        return np.asarray(w.z - np.linalg.solve(w.information, w.score))

    np.testing.assert_allclose(optimum(wide), optimum(own))
    added = np.linalg.inv(wide.scale * wide.information) - np.linalg.inv(own.scale * own.information)
    np.testing.assert_allclose(added, np.outer(shift, shift), atol=1e-12)
