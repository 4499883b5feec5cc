"""Vectors that share a block of lanes: a matter of time alone, never of the result."""

import numpy as np
import pytest

from quadid.model import layout as ix
from quadid.model.kernel import needs_of
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout, Segments, packed, packing
from quadid.model.simd import LANES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.model.flights import lively_input, values_of, vector
from tests.model.test_lanes import noisy_window

VEHICLE = Vehicle.shipped("pelican")
NOMINAL = vector(VEHICLE, values_of(VEHICLE))


def one_each() -> FloatArray:
    """The nominal vector and, for every entry, one with that entry moved."""
    entries = [e for e in Layout(VEHICLE).entries.values() if not e.name.endswith(".time")]
    out = np.repeat(NOMINAL[None], 1 + len(entries), axis=0)
    for row, e in enumerate(entries, start=1):
        out[row, e.index] += 1e-3 * e.typical
    return out


def test_vectors_that_need_little_are_not_beside_those_that_need_much() -> None:
    thetas = one_each()
    spread = packed(thetas, packing(thetas, 4))
    blocks = [needs_of(spread[i : i + LANES], 4, 9) for i in range(0, len(spread), LANES)]
    assert sum(b.shared for b in blocks) >= len(blocks) - 1
    assert sum(b.air for b in blocks) <= 2
    assert sum(b.imu_lag or b.att_delay or b.ahrs for b in blocks) <= 2


@pytest.mark.parametrize("channels", [9, 15])
def test_the_lane_does_not_change_the_result(channels: int) -> None:
    window, thetas = noisy_window(motion=channels > 9), one_each()
    rollout = Rollout(window, VEHICLE)
    segments = Segments.cut(len(window), 25, 8)
    x0 = rollout.initial_states(segments, 8)

    def rolled(vectors: FloatArray) -> FloatArray:
        out, _ = rollout.roll(segments, vectors, x0, n_pre=8)
        return np.moveaxis(out, -1, 1).reshape(-1, *out.shape[1:4])

    lane = packing(thetas, 4)
    difference = rolled(packed(thetas, lane))[lane] - rolled(thetas)[: len(thetas)]
    assert np.abs(difference).max() < 1e-11


@pytest.mark.parametrize("delay", [0.0, 0.013])
def test_rotors_that_begin_anew_before_a_late_segment_have_forgotten_the_same(delay: float) -> None:
    """Between segments far apart rotors need not be followed; the outcome is that of following them throughout."""
    given = lively_input(VEHICLE, 12.0, 0.02)
    window = noisy_window(12.0, motion=False)
    np.testing.assert_array_equal(window.rotor_speed, given.rows)
    theta = np.repeat(NOMINAL[None], LANES, axis=0)
    theta[:, ix.TAU], theta[:, ix.DELAY] = np.linspace(0.01, 0.03, LANES), delay
    rollout = Rollout(window, VEHICLE)
    every = Segments.cut(len(window), 25, 8)
    few = every.at(np.arange(0, len(every.starts), 8))
    all_of_them, _ = rollout.roll(every, theta, rollout.initial_states(every, 8), n_pre=8)
    thinned, _ = rollout.roll(few, theta, rollout.initial_states(few, 8), n_pre=8)
    assert np.abs(all_of_them[:, ::8] - thinned).max() < 1e-11
