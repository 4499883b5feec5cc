"""The model that windows are fitted with: what it lacks is fitted along, and the truth is published."""

import math
from dataclasses import replace

import numpy as np
import pytest

from quadid.estimate import kalman as k
from quadid.model.layout import LOSS, Layout, ThrustModel
from quadid.online import Session, SessionSettings, fit_job
from quadid.online.fit_job import SUPPORT, Curve, Noise, names_of, own_names
from quadid.online.fusion import Estimator
from quadid.online.gate import with_room
from quadid.online.grid_buffer import WindowCut
from quadid.types import FloatArray
from quadid.vehicle import GRAVITY, ParameterPrior, Vehicle
from tests.online.driving import drive, flight, published, samples
from tests.online.test_gate import TRUE

PELICAN = Vehicle.shipped("pelican")
LAGGING = (("motor_lag", "tau", 0.05), ("rotor_drag", "k_x", 0.4), ("rotor_drag", "k_y", 0.4))


def test_what_the_model_lacks_is_fitted_along_and_the_truth_is_published() -> None:
    session = Session(PELICAN, SessionSettings(diagnose=0.0))
    actions = drive(session, samples(flight(60.0, 5, effects=LAGGING).recording))
    first, *_ = published(actions)
    assert first.stop - first.start <= 45.0
    for item in published(actions):
        for name in ("b", "J_xx", "J_yy"):
            assert item.parameters[name].value == pytest.approx(TRUE[name], rel=0.03), name


def test_the_secant_of_a_thrust_curve_carries_the_weight() -> None:
    model = PELICAN.model_copy(update={"effects": {"thrust_curve": {"dead_speed": -120.0}}})
    theta = Layout(model).initial(model)
    thrust, weight = ThrustModel(Layout(model), theta), PELICAN.mass * GRAVITY
    hover = math.sqrt(weight / 4.0 / float(theta[0])) - 120.0
    assert thrust.total(np.full((1, 4), hover))[0] == pytest.approx(weight)
    stated = ThrustModel.stated(PELICAN)
    secant = thrust.like(stated, weight)
    assert 4.0 * secant * hover**2 == pytest.approx(weight)
    assert stated.with_b(secant).like(thrust, weight) == pytest.approx(theta[0])
    step = 1e-3
    rise = (thrust.at_speed(hover + step) - thrust.at_speed(hover - step)) / (2.0 * step)
    assert thrust.slope(weight) == pytest.approx(rise)


def test_a_stated_slope_bends_the_law_where_it_carries_the_weight() -> None:
    weight, plain = PELICAN.mass * GRAVITY, ThrustModel.stated(PELICAN)
    bent = plain.with_tangent(0.75, weight)
    assert bent.hover_speed(weight) == pytest.approx(plain.hover_speed(weight))
    assert bent.slope(weight) == pytest.approx(0.75 * plain.slope(weight))


def test_the_b_of_a_vehicle_is_the_mean_of_its_rotors_whichever_is_weak() -> None:
    theta = Layout(PELICAN).initial(PELICAN)
    for rotor in range(4):
        weak = theta.copy()
        weak[LOSS + rotor] = 0.12
        b = ThrustModel(Layout(PELICAN), weak).like(ThrustModel.stated(PELICAN), PELICAN.mass * GRAVITY)
        assert b == pytest.approx(0.97 * theta[0])


def test_a_bare_guess_has_room_and_given_bounds_stay() -> None:
    bare = {name: p.model_copy(update={"bounds": None}) for name, p in PELICAN.parameters.items()}
    model = with_room(PELICAN.model_copy(update={"parameters": {**bare, "b": PELICAN.parameters["b"]}}))
    guess, given = model.parameters["J_xx"], model.parameters["b"]
    assert guess.initial == bare["J_xx"].initial
    assert guess.limits == pytest.approx((guess.initial / 16.0, guess.initial * 16.0))
    assert guess.log_sigma == pytest.approx(bare["J_xx"].log_sigma), "it is no less sure of its guess"
    assert given == PELICAN.parameters["b"]


@pytest.mark.parametrize("times", [3.9, 4.0, 4.4])
def test_a_guess_at_the_end_of_its_range_is_found_whatever_the_first_fit_made_of_it(times: float) -> None:
    """The nominal model of a first window may miss an inertia by as much as its bounds allow.

    ArduCopter's default frame by the recipe for new vehicles has guesses of exactly four times the truth.
    """
    window = flight(24.0, 5, effects=LAGGING).window.slice(0, 500)
    far = {
        "b": 2.0e-5,
        "d": 4.0e-7,
        "J_xx": times * TRUE["J_xx"],
        "J_yy": times * TRUE["J_yy"],
        "J_zz": 0.05,
        "J_r": 5e-5,
    }
    vehicle = PELICAN.model_copy(update={"parameters": {n: ParameterPrior(initial=v) for n, v in far.items()}})
    start = Layout(vehicle).initial(vehicle)
    start[2:4] *= 2.0
    learner = Estimator(vehicle, 60.0, 10.0, 0)
    asked = replace(learner.request(1, WindowCut((window,), 10.0, 0), 0.0, 10.0), theta=start)
    learner.take(asked, asked.answer())
    for name in ("J_xx", "J_yy"):
        assert learner.value(name) == pytest.approx(TRUE[name], rel=0.1)


@pytest.mark.parametrize("stated", [{}, {"dead_speed": -60.0, "offset": 0.3}, {"dead_speed": 30.0}], ids=str)
@pytest.mark.parametrize(("curve", "support"), [(-4.0, 0.0), (-0.5, 0.4), (0.5, -0.3)])
def test_a_curve_and_a_support_change_what_the_filter_has_and_not_what_is_fused(
    stated: dict[str, float], curve: float, support: float
) -> None:
    model = PELICAN.model_copy(update={"effects": {"thrust_curve": stated} if stated else {}})
    law, z, layout = Curve(model), np.zeros(len(names_of(model))), Layout(model)
    z[:6], at = np.log(model.initial), len(own_names(model)) - 1
    z[at : at + 2] = curve, support
    filtered, slopes = law.filtered(z)
    np.testing.assert_allclose(law.fused(filtered), z, atol=1e-12)
    steps = 1e-6 * np.eye(len(z))
    found = np.array([(law.filtered(z + s)[0] - law.filtered(z - s)[0]) / 2e-6 for s in steps]).T
    np.testing.assert_allclose(slopes, found, atol=1e-7)
    # The flown law carries the weight where the file's law with the fused b does.
    theta, weight = layout.initial(model), model.mass * GRAVITY
    theta[[layout.entry(n).index for n in ("b", "thrust_curve.dead_speed", "thrust_curve.offset")]] = law.law(z)
    assert ThrustModel(layout, theta).like(ThrustModel.stated(model), weight) == pytest.approx(model.initial[0])


@pytest.mark.parametrize("name", ["b", "J_xx", "thrust_curve.dead_speed", SUPPORT])
def test_slopes_of_innovations_are_those_of_the_filter(name: str) -> None:
    """By a support they were those of other rotor speeds, which drag, coupling and drag torque follow too.

    A hexacopter's thrust then seemed to change 3 % less with speed than it did, and each set waited for a person.
    """
    window = flight(24.0, 5, effects=LAGGING).window.slice(0, 500)
    names, z = names_of(PELICAN), np.zeros(len(names_of(PELICAN)))
    z[:6], z[names.index("rotor_drag.k_x")], z[names.index(SUPPORT)] = np.log(PELICAN.initial), 1.2, 0.3
    problem = fit_job.problem_of(window, PELICAN)
    noise = Noise(problem.first_noise(), np.zeros(4), problem.control, 0.0)
    *_, gains, near = fit_job._linearised(window, PELICAN, z, noise)

    def innovations(step: float) -> FloatArray:
        moved, out = z.copy(), np.zeros((len(window), k.M))
        moved[names.index(name)] += step
        problem, own, _ = fit_job._like(window, PELICAN, moved, noise)
        p, track = problem.physics(own, 0), problem.tracks[0]
        k.replay(track, p, noise.psi, gains[0], k.moments(track, *k.turning(p)), out)
        return out

    slope = (innovations(1e-3) - innovations(-1e-3)) / 2e-3
    for group in (k.GYRO, k.ATTITUDE, k.ACCEL, k.VELOCITY):
        axes = slice(group, group + 3)
        assert np.std(near.J[names.index(name)][:, axes] - slope[:, axes]) < 1e-3 * np.std(slope[:, axes])
