"""Generic causes: silent on noise, right about where something acts and what it follows."""

import numpy as np
import pytest

from quadid.diagnosis import residual_tests
from quadid.diagnosis.residual_tests import SITES, Follows, follows, signals, strongest
from quadid.flight import draw_truth, fly
from quadid.identification.problem import Columns
from quadid.types import FloatArray
from tests.diagnose.problems import SEED, Problem, clean, fitted, window_with
from tests.identify.flights import PELICAN


def columns(problem: Problem) -> Columns:
    """The one window's columns at the nominal optimum."""
    (part,) = problem.shooting.columns(problem.nominal.theta, problem.nominal.free, problem.nominal.states)
    return part


def thrust_before(problem: Problem) -> FloatArray:
    """Relative thrust of the step before each row, shape (n,)."""
    level = np.mean(problem.window.rotor_speed**2, axis=1)
    out = np.zeros(len(level))
    out[1:] = level[:-1] / level.mean() - 1.0
    return out


def found(problem: Problem) -> tuple[Follows, ...]:
    return strongest(follows(problem.shooting, problem.nominal))


def planted(channel: str, axis: int, values: FloatArray) -> Problem:
    """The clean flight with something added to one axis of one channel, judged with the clean noise."""
    added = np.zeros((len(values), 3))
    added[:, axis] = values
    return fitted(window_with(None, **{channel: added}), clean().shooting.noise)


def test_without_effects_no_site_is_structured() -> None:
    left = found(clean())
    assert len(left) == len({s.group for s in SITES}) == 6
    assert not [f for f in left if f.significant]
    # Some fifty signals fitted to noise lose on blocks that they were not fitted to.
    assert max(f.gain.total for f in left) < 0.0


@pytest.mark.parametrize("axis", [0, 2])
def test_a_gyro_error_that_follows_thrust_is_found_on_its_axis(axis: int) -> None:
    problem = planted("gyro", axis, 0.1 * thrust_before(clean()))
    first = found(problem)[0]
    assert first.significant
    assert first.site.group == f"rotation {'xyz'[axis]}"
    assert first.site.name == f"gyro {'xyz'[axis]}"
    assert "thrust" in first.signal or first.signal.startswith("a_z")
    assert [f.site.group for f in found(problem) if f.significant] == [first.site.group]


def test_a_force_that_follows_a_rate_is_found_at_its_site() -> None:
    part = columns(clean())
    p = np.zeros(len(clean().window))
    p[part.rows] = signals(part)["p"]
    first = found(planted("accel", 1, 0.15 * p))[0]
    assert first.significant
    assert (first.site.name, first.signal) == ("force y", "p")


def test_a_moment_that_follows_the_motion_is_found_as_one() -> None:
    """Damping of roll alone, which the nominal model lacks."""
    window = fly(
        PELICAN, draw_truth(PELICAN, SEED), 60.0, SEED, effects={"rate_damping": {"l_p": 2.0, "m_q": 0.0}}
    ).window
    first = found(fitted(window, clean().shooting.noise))[0]
    assert first.significant
    assert first.site.name == "moment x"


def test_what_happens_once_and_follows_nothing_is_not_said_to_follow() -> None:
    """A knock in one block: whatever fits it there gains nothing elsewhere."""
    knock = np.zeros(len(clean().window))
    knock[1500:1525] = 0.2
    problem = planted("gyro", 1, knock)
    assert not [f for f in found(problem) if f.significant]


def test_inputs_are_those_of_the_step_before() -> None:
    problem = clean()
    part = columns(problem)
    named = signals(part)
    expected = thrust_before(problem)
    np.testing.assert_allclose(named["thrust input"], expected[part.rows], atol=1e-12)
    np.testing.assert_allclose(named["squared thrust input"], expected[part.rows] ** 2, atol=1e-12)
    np.testing.assert_array_equal(named["constant"], 1.0)
    assert named["time, 1 half waves"][0, 0] == pytest.approx(1.0, abs=1e-3)
    assert named["time, 1 half waves"][-1, -1] == pytest.approx(-1.0, abs=0.01)


def test_no_motion_signal_holds_the_noise_of_the_sample_it_is_held_against() -> None:
    """Other noise in the measured rates and forces, the same initial states and parameters: the same signals."""
    problem = clean()
    before = signals(columns(problem))
    rng = np.random.default_rng(7)
    n = len(problem.window)
    noise = {"gyro": 0.05 * rng.standard_normal((n, 3)), "accel": 0.5 * rng.standard_normal((n, 3))}
    other = fitted(window_with(None, **noise), problem.shooting.noise)
    (part,) = other.shooting.columns(problem.nominal.theta, problem.nominal.free, problem.nominal.states)
    for name, values in signals(part).items():
        np.testing.assert_allclose(values, before[name], atol=1e-9, err_msg=name)


def test_sites_move_what_they_say() -> None:
    moments = [s for s in SITES if s.name.startswith("moment")]
    assert [s.channels for s in moments] == [((i, 1), (3 + i, 2)) for i in range(3)]
    assert len({s.name for s in SITES}) == len(SITES) == 12


def test_signals_that_double_one_another_change_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    """In a flight that holds its heading, for one, its cosine is constant: without `_RIDGE` no inverse is of use."""
    problem = clean()
    once = {f.site.name: f.gain.total for f in follows(problem.shooting, problem.nominal)}

    def doubled(part: Columns) -> dict[str, FloatArray]:
        return {f"{name}{again}": s for again in ("", ", again") for name, s in signals(part).items()}

    monkeypatch.setattr(residual_tests, "signals", doubled)
    twice = {f.site.name: f.gain.total for f in follows(problem.shooting, problem.nominal)}
    assert twice == pytest.approx(once, rel=0.01)
    monkeypatch.setattr(residual_tests, "RIDGE", 0.0)
    try:
        without = {f.site.name: f.gain.total for f in follows(problem.shooting, problem.nominal)}
    except np.linalg.LinAlgError:  # unless rounding leaves something to divide by
        return
    assert without != pytest.approx(once, rel=0.01)
