"""Parameters fitted to predict: least error of runs from measured states."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from quadid.errors import NotIdentifiableError
from quadid.flight import Flight, fly
from quadid.identify.ahead import STAGES, fit_ahead
from quadid.identify.free import Free
from quadid.identify.horizon import horizon_scores
from quadid.identify.open_loop import OpenLoop, no_change
from quadid.identify.polish import scaled_difference
from quadid.model.layout import Layout
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid.window import Window

PELICAN = Vehicle.shipped("pelican")
LAYOUT = Layout(PELICAN)
KNOWN = ("b", "d", "J_xx", "J_yy", "J_zz")


@pytest.fixture(scope="module")
def flight() -> Flight:
    """Half a minute with velocity and position, of a vehicle whose rotors drag."""
    effects = {"rotor_drag": {"k_x": 0.3, "k_y": 0.25}}
    return fly(PELICAN, seconds=30.0, seed=12, extras=("velocity", "position"), effects=effects)


def truth(flight: Flight) -> np.ndarray:
    theta = LAYOUT.initial(PELICAN)
    theta[:6] = [flight.truth.parameters.as_dict()[n] for n in NOMINAL_NAMES]
    LAYOUT.write_effects(theta, {"rotor_drag": {"k_x": 0.3, "k_y": 0.25}})
    return theta


def free(*names: str) -> Free:
    return Free(tuple(LAYOUT.entry(n) for n in (*NOMINAL_NAMES, *names)))


def test_what_flew_is_found_within_its_deviations(flight: Flight) -> None:
    used = free("rotor_drag.k_x", "rotor_drag.k_y")
    found = fit_ahead([flight.window], PELICAN, used, [LAYOUT.initial(PELICAN)])
    deviation = scaled_difference(used, truth(flight), found.theta) / found.sigma
    place = [used.names.index(n) for n in (*KNOWN, "rotor_drag.k_x", "rotor_drag.k_y")]
    assert np.abs(deviation[place]).max() < 4.0
    assert np.exp(found.sigma[used.names.index("J_xx")]) < 1.02


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
    """A second flight with hardly any motion neither rules the fit nor is ruled out."""
    calm = fly(PELICAN, flight.truth.parameters, 30.0, 13, "hover", extras=("velocity", "position")).window
    used = free("rotor_drag.k_x", "rotor_drag.k_y")
    alone = fit_ahead([flight.window], PELICAN, used, [truth(flight)])
    beside = fit_ahead([flight.window, replace(calm, name="calm")], PELICAN, used, [truth(flight)])
    apart = scaled_difference(used, alone.theta, beside.theta)
    assert apart[used.names.index("J_xx")] == pytest.approx(0.0, abs=0.05)
    assert beside.share > alone.share


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
    away[LAYOUT.entry("J_xx").index] *= 100.0  # no rigid body
    with pytest.raises(NotIdentifiableError, match="runs away"):
        fit_ahead([flight.window], PELICAN, Free((LAYOUT.entry("d"),)), [away])


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
