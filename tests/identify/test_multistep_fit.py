"""Parameters fitted to predict: least error of runs from measured states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadid.errors import NotIdentifiableError
from quadid.flight import Flight, fly
from quadid.identify.multistep_fit import STAGES, fit_ahead
from quadid.identify.open_loop import OpenLoop, mean_errors, no_change
from quadid.identify.parameterization import Free
from quadid.identify.prediction import horizon_scores
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.window import Window
from tests.identify.flights import PELICAN, true_theta

LAYOUT = Layout(PELICAN)


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Half a minute with velocity and position, of a vehicle whose rotors drag."""
    effects = {"rotor_drag": {"k_x": 0.3, "k_y": 0.25}}
    return fly(PELICAN, seconds=30.0, seed=12, extras=("velocity", "position"), effects=effects)


def truth(flight: Flight) -> np.ndarray:
    theta = true_theta(flight)
    LAYOUT.write_effects(theta, flight.truth.effects)
    return theta


def free(*names: str) -> Free:
    return Free(tuple(LAYOUT.entry(n) for n in (*NOMINAL_NAMES, *names)))


def test_what_flew_is_found(flight: Flight) -> None:
    found = fit_ahead([flight.window], PELICAN, free("rotor_drag.k_x", "rotor_drag.k_y"), [LAYOUT.initial(PELICAN)])
    for name, error in {
        "b": 0.005,
        "d": 0.02,
        "J_xx": 0.03,
        "J_yy": 0.03,
        "J_zz": 0.03,
        "rotor_drag.k_x": 0.15,
    }.items():
        place = LAYOUT.entry(name).index
        assert found.theta[place] == pytest.approx(truth(flight)[place], rel=error), name


def test_nothing_predicts_the_flight_better(flight: Flight) -> None:
    found = fit_ahead([flight.window], PELICAN, free("rotor_drag.k_x", "rotor_drag.k_y"), [LAYOUT.initial(PELICAN)])
    samples = round(STAGES[-1][-1] / flight.window.dt)
    still = no_change([flight.window], PELICAN, samples)
    ours, true, guess = (
        horizon_scores([[flight.window]], PELICAN, theta, (samples,))[0].at(samples)
        for theta in (found.theta, truth(flight), LAYOUT.initial(PELICAN))
    )
    for quantity, error in ours.items():
        assert error < 1.03 * true[quantity], quantity
        assert error < 0.5 * still[quantity], quantity
    assert ours["rate"] < 0.8 * guess["rate"]


def test_the_best_end_of_several_starts_wins(flight: Flight) -> None:
    good = truth(flight)
    bad = good.copy()
    bad[LAYOUT.entry("J_xx").index] *= 3.9
    bad[LAYOUT.entry("J_yy").index] /= 3.9
    only_d = Free((LAYOUT.entry("d"),))
    one, other = (fit_ahead([flight.window], PELICAN, only_d, [theta]) for theta in (good, bad))
    both = fit_ahead([flight.window], PELICAN, only_d, [bad, good])
    assert both.share == one.share < other.share


def test_flights_count_in_shares_of_their_own_motion(flight: Flight) -> None:
    """A calm flight of twice the inertia says more as a flight of its own than as part of the lively one."""
    slower = replace(flight.truth.parameters, J_xx=2.0 * flight.truth.parameters.J_xx)
    calm = fly(PELICAN, slower, 30.0, 13, "gentle", extras=("velocity", "position")).window
    only = Free((LAYOUT.entry("J_xx"),))
    own, part = (
        fit_ahead([flight.window, other], PELICAN, only, [truth(flight)]).theta[LAYOUT.entry("J_xx").index]
        for other in (calm, replace(calm, name=flight.window.name))
    )
    assert part == pytest.approx(flight.truth.parameters.J_xx, rel=0.01)
    assert own > 1.02 * part


def test_attitude_and_rate_tell_the_agility(flight: Flight) -> None:
    bare = replace(flight.window, velocity=None, position=None)
    found = fit_ahead([bare], PELICAN, free(), [LAYOUT.initial(PELICAN)])
    b, j_xx = LAYOUT.entry("b").index, LAYOUT.entry("J_xx").index
    agility, true = (theta[b] / theta[j_xx] for theta in (found.theta, truth(flight)))
    assert agility == pytest.approx(true, rel=0.03)


def test_a_flight_that_never_runs_is_refused(flight: Flight) -> None:
    short = flight.window.slice(0, 20)
    with pytest.raises(NotIdentifiableError, match=r"no run of 0.5 s fits"):
        fit_ahead([short], PELICAN, free(), [LAYOUT.initial(PELICAN)])
    away = LAYOUT.initial(PELICAN)
    away[LAYOUT.entry("J_xx").index] *= 100.0
    with pytest.raises(NotIdentifiableError, match="no rigid body"):
        fit_ahead([flight.window], PELICAN, Free((LAYOUT.entry("d"),)), [away])


def test_attitude_between_the_times_that_count_is_no_obstacle(flight: Flight) -> None:
    """Gyro and attitude on every second row, and 0.1 s is five rows: nothing is measured then, later all is."""
    every_second = np.where(np.arange(len(flight.window)) % 2 == 0, 1.0, np.nan)[:, None]
    gyro, attitude = flight.window.gyro, flight.window.attitude
    assert gyro is not None
    assert attitude is not None
    window = replace(flight.window, gyro=gyro * every_second, attitude=attitude * every_second)
    start = truth(flight)
    start[LAYOUT.entry("J_xx").index] *= 1.5
    found = fit_ahead([window], PELICAN, Free((LAYOUT.entry("J_xx"),)), [start])
    place = LAYOUT.entry("J_xx").index
    assert found.theta[place] == pytest.approx(truth(flight)[place], rel=0.03)


def test_feedback_within_samples_is_left_out(flight: Flight) -> None:
    """The score drives its runs with held speeds; a window that knows their slopes is taken all the same."""
    window = replace(flight.window, rotor_slope=np.full_like(flight.window.rotor_speed, 3.0))
    errors = [mean_errors([w], PELICAN, truth(flight), 25) for w in (window, flight.window)]
    assert errors[0] == errors[1]
    assert horizon_scores([[window]], PELICAN, truth(flight), (25,))[0].samples > 0


def test_no_change_is_measured_where_both_ends_are(flight: Flight) -> None:
    window: Window = flight.window.slice(0, 100)
    assert window.gyro is not None
    assert window.velocity is not None
    gyro, velocity = window.gyro.copy(), window.velocity.copy()
    gyro[10] = np.nan
    velocity[:] = np.nan
    errors = OpenLoop(replace(window, gyro=gyro, velocity=velocity), PELICAN, 25).no_change(np.array([5, 25]))
    assert errors.shape == (74, 2, 4)
    assert np.isnan(errors[..., :2]).all()
    assert np.isnan(errors[5, 0, 3])  # lands on the missing row
    assert errors[20, 1, 3] == pytest.approx(np.linalg.norm(gyro[46] - gyro[21]))  # row 10 starts no run
