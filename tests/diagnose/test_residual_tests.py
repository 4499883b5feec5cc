"""Remainder: noise has the spectrum of noise, a tone stands out at its frequency, verdicts follow from shares."""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np
import pytest

from quadid.diagnosis.hypotheses import Gain, Model
from quadid.diagnosis.pipeline import judge
from quadid.diagnosis.residual_tests import ALARM, SITES, Follows, Remainder, Structure, remainder
from quadid.diagnosis.result import Explanation
from quadid.identification.fit import mode_power
from quadid.types import FloatArray
from tests.diagnose.problems import Problem, clean, fitted, window_with

ROWS = 40_000.0


def test_noise_leaves_every_mode_the_power_that_elimination_leaves_it() -> None:
    problem = clean()
    found, null, counts = mode_power(
        problem.shooting, problem.nominal.theta, problem.nominal.free, np.random.default_rng(1), problem.nominal.states
    )
    assert np.all(counts[:9] > 50)
    ratio = found.sum(axis=1) / null.sum(axis=1)
    # 59 segments of 50 modes: standard error 2.6 %; the noise was estimated from the same data.
    np.testing.assert_allclose(ratio[[0, 1, 2, 6, 7, 8]], 1.0, atol=0.1)


def test_without_effects_nothing_remains() -> None:
    left = remainder(clean().shooting, clean().nominal)
    assert left.deviance == 0.0
    assert not left.shares
    assert {s.channel for s in left.channels} == {"p", "q", "r", "a_x", "a_y", "a_z"}
    assert max(s.errors for s in left.channels) < ALARM


def tone(channel: str, axis: int, hertz: float, size: float) -> Problem:
    t = clean().window.t
    # The phase wanders, so that no signal of the generic library follows it.
    wander = np.cumsum(np.random.default_rng(2).standard_normal(len(t))) * 0.15
    added = np.zeros((len(t), 3))
    added[:, axis] = size * np.sin(2.0 * np.pi * hertz * t + wander)
    return fitted(window_with(None, **{channel: added}), clean().shooting.noise)


@pytest.mark.parametrize(
    ("channel", "axis", "name", "hertz", "size"), [("gyro", 1, "q", 7.0, 0.02), ("accel", 2, "a_z", 4.0, 0.3)]
)
def test_a_tone_is_seen_in_its_channel_at_its_frequency(
    channel: str, axis: int, name: str, hertz: float, size: float
) -> None:
    problem = tone(channel, axis, hertz, size)
    left = remainder(problem.shooting, problem.nominal)
    first = left.significant[0]
    assert first.channel == name
    assert first.frequency == pytest.approx(hertz, abs=1.0)
    assert left.deviance > 0.0
    assert left.shares[name] == max(left.shares.values())


def test_structure_is_counted_once_though_two_looks_see_it() -> None:
    power = Structure("p", 0.1, 500.0, 7.0, ALARM + 1.0)
    quiet = Structure("q", 0.1, 9e9, 7.0, ALARM - 1.0)
    seen = Follows(SITES[0], Gain(300.0, 10.0, np.ones(12)), {"thrust input": 300.0})
    doubted = Follows(SITES[3], Gain(300.0, 200.0, np.ones(12)), {"p": 300.0})
    assert Remainder((power, quiet), (seen, doubted), ROWS).deviance == 500.0
    assert Remainder((quiet,), (seen, doubted), ROWS).deviance == 300.0
    assert Remainder((quiet,), (doubted,), ROWS).deviance == 0.0


@dataclass(frozen=True)
class Stub:
    """The parts of a model that `judge` reads."""

    causes: tuple[str, ...]
    held_out: FloatArray
    rows: float = ROWS

    @property
    def effects(self) -> set[str]:
        return {f"effect {i}" for i in range(len(self.causes))}


def verdict(explained: float, left: float, causes: int) -> Explanation:
    nominal, model = Stub((), np.full(10, ROWS / 10 + explained / 10)), Stub(("x",) * causes, np.full(10, ROWS / 10))
    rest = Remainder((Structure("p", 0.1, left, 7.0, ALARM + 1.0),), (), ROWS)
    return judge(cast(Model, cast(Any, nominal)), cast(Model, cast(Any, model)), rest)


@pytest.mark.parametrize(
    ("explained", "left", "causes", "expected"),
    [
        (0.0, 0.0, 0, Explanation.NOTHING_FOUND),
        (0.0, 0.005 * ROWS, 0, Explanation.NOTHING_FOUND),
        (0.0, 0.05 * ROWS, 0, Explanation.UNKNOWN),
        (1e4, 0.0, 1, Explanation.EXPLAINED),
        (1e8, 0.9e5, 1, Explanation.EXPLAINED),
        (1e4, 0.1e4, 1, Explanation.PARTLY_EXPLAINED),
        (1e4, 0.12e4, 1, Explanation.UNKNOWN),
        (1e4, 0.24e4, 2, Explanation.PARTLY_EXPLAINED),
        (1e4, 0.26e4, 2, Explanation.UNKNOWN),
        (1e4, 9e4, 2, Explanation.UNKNOWN),
    ],
)
def test_the_verdict_follows_from_what_is_explained_and_what_is_left(
    explained: float, left: float, causes: int, expected: Explanation
) -> None:
    assert verdict(explained, left, causes) is expected
