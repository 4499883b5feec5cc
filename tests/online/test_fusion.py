"""Fusion: exact for quadratic costs, counts every second once, forgets, widens when windows scatter, sees changes."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from quadid.estimate.kalman import N_NOISE
from quadid.flight import Flight, Segment, fly
from quadid.model.layout import B
from quadid.online import FitReply, FitRequest, Session, SessionSettings
from quadid.online.fit_job import LOOSE, ROLL_PITCH, SIX, WindowEstimate
from quadid.online.fusion import Estimator, Fusion
from quadid.online.grid_buffer import WindowCut
from quadid.online.records import Job, JobReply
from quadid.parameters import NOMINAL_NAMES, Status
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from tests.online.driving import flight
from tests.online.made_up import PELICAN, light_flight, tells, works

P = 7
"""The six, and one beside them."""
PRIOR = np.full(P, 0.7)
MOVES = {"roll": 0.15, "pitch": 0.15, "yaw": 0.2}
"""Sticks, rms [rad]."""
SMOOTHED, SLOW = {"imu_lag": {"cutoff": 20.0}}, {"imu_lag": {"cutoff": 6.5}}
AWAY = np.array([0.15, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0])


def window(
    start: float,
    z: FloatArray,
    information: FloatArray,
    seconds: float = 10.0,
    score: FloatArray | None = None,
    mse: float = 1.0,
) -> WindowEstimate:
    none = np.zeros((P, P))
    return WindowEstimate(
        start,
        start + seconds,
        z,
        information,
        np.zeros(P) if score is None else score,
        100.0 * mse,
        100.0,
        none,
        np.zeros((LOOSE, P)),
        information,
        np.zeros(P) if score is None else score,
    )


def fusion(memory: float = 1e12, sigma: FloatArray = PRIOR) -> Fusion:
    return Fusion(np.zeros(P), sigma, P, memory, 10.0)


def random_information(rng: np.random.Generator) -> FloatArray:
    a = rng.normal(size=(P, P))
    return np.asarray(1e4 * (a @ a.T + 0.1 * np.eye(P)))


@given(st.integers(0, 10_000), st.integers(1, 8))
def test_disjoint_windows_fuse_to_the_weighted_least_squares_solution(seed: int, n: int) -> None:
    rng = np.random.default_rng(seed)
    learner = fusion()
    h, hz = np.diag(1.0 / PRIOR**2), np.zeros(P)
    for k in range(n):
        z, information = 0.01 * rng.normal(size=P), random_information(rng)
        learner.add(window(10.0 * k, z, information))
        h, hz = h + information, hz + information @ z
    fused = learner.estimate()
    assert fused is not None
    assert np.allclose(fused.z, np.linalg.solve(h, hz), rtol=1e-8, atol=1e-10)
    assert np.all(np.diag(fused.covariance) >= np.diag(np.linalg.inv(h)) * (1 - 1e-9))


def test_a_score_that_is_not_zero_is_a_step_still_to_be_made() -> None:
    information = random_information(np.random.default_rng(1))
    best, away = np.linspace(-0.02, 0.03, P), np.full(P, 0.1)
    learner = fusion(sigma=np.full(P, 1e6))
    learner.add(window(0.0, away, information, score=information @ (away - best)))
    fused = learner.estimate()
    assert fused is not None
    assert np.allclose(fused.z, best, atol=1e-8)


def test_where_noise_explains_more_than_there_is_nothing_is_told() -> None:
    """Rotor speeds rounded to 20 rad/s drove J_xx to e^600 times the guess and b to a tenth: it was "on the ground"."""
    point, information, axis = np.full(P, 0.1), 1e4 * np.eye(P), np.full(P, 1.0 / np.sqrt(P))
    learner = fusion()
    learner.add(replace(window(0.0, point, information), noise=3e4 * np.outer(axis, axis)))
    fused = learner.estimate()
    assert fused is not None
    assert fused.z == pytest.approx(0.0, abs=1e-6)
    assert axis @ fused.covariance @ axis > PRIOR[0] ** 2
    aside = np.append([1.0, -1.0], np.zeros(P - 2)) / np.sqrt(2.0)
    assert aside @ fused.covariance @ aside == pytest.approx(1e-4, rel=1e-3)


def test_stretches_are_what_was_told_between_two_moments() -> None:
    rng = np.random.default_rng(2)
    learner, told = fusion(memory=50.0), []
    for k in range(40):
        told.append((0.01 * rng.normal(size=P), random_information(rng)))
        learner.add(window(float(k), *told[-1], seconds=1.0))
    newest, before, *_ = learner.disjoint()
    assert (before.start, before.stop, newest.start, newest.stop) == (20.0, 30.0, 30.0, 40.0)
    fade = [np.exp(-(39 - k) / 50.0) for k in range(30, 40)]
    h = np.diag(1.0 / PRIOR**2) + sum(f * i for f, (_, i) in zip(fade, told[30:], strict=True))
    hz = sum(f * i @ z for f, (z, i) in zip(fade, told[30:], strict=True))
    assert newest.z == pytest.approx(np.linalg.solve(h, hz)[:6], abs=1e-8)


def test_old_information_fades_with_the_time_constant_of_what_was_taken_in() -> None:
    information = random_information(np.random.default_rng(3))
    learner = fusion(memory=50.0)
    learner.add(window(0.0, np.full(P, 0.1), information))
    known = learner.estimate()
    learner.add(window(1000.0, np.full(P, 0.1), information))
    both = learner.estimate()
    assert known is not None
    assert both is not None
    assert (both.sigma / known.sigma) ** 2 == pytest.approx(1.0 / (1.0 + np.exp(-10.0 / 50.0)), rel=0.01), "a pause"
    for k in range(101, 140):
        learner.add(window(10.0 * k, np.zeros(P), information))
    fused = learner.estimate()
    assert fused is not None
    assert np.abs(fused.z).max() < 1e-3


def test_scattered_windows_widen_the_interval() -> None:
    rng = np.random.default_rng(4)
    information = np.eye(P) * 1e4  # claims 1 %
    calm, wild = fusion(), fusion()
    for k in range(12):
        calm.add(window(10.0 * k, 0.01 * rng.normal(size=P), information))
        wild.add(window(10.0 * k, 0.05 * rng.normal(size=P), information))
    a, b = calm.estimate(), wild.estimate()
    assert a is not None
    assert b is not None
    assert np.all(b.sigma > 2.0 * a.sigma)


def test_a_change_is_seen_and_noise_is_not() -> None:
    rng = np.random.default_rng(5)
    learner = fusion(memory=120.0)
    alarms = 0
    for k in range(200):
        item = window(float(k), 1e-3 * rng.normal(size=P), np.eye(P) * 1e5, seconds=1.0)
        alarms += not learner.agrees(item)
        learner.add(item)
    assert alarms == 0
    assert not learner.agrees(window(200.0, AWAY, np.eye(P) * 1e6))


def test_poor_residuals_make_a_window_count_less() -> None:
    learner = fusion()
    learner.add(window(0.0, np.zeros(P), np.eye(P) * 1e4))
    learner.add(window(10.0, np.full(P, 0.01), np.eye(P) * 1e4, mse=9.0))
    fused = learner.estimate()
    assert fused is not None
    assert np.allclose(fused.z, 0.001, rtol=0.01)  # weights 1 and 1/9


def test_what_every_second_row_says_otherwise_widens_by_a_third_of_the_difference() -> None:
    learner = fusion()
    one = window(0.0, np.zeros(P), np.eye(P) * 1e6)
    learner.add(WindowEstimate(**{**vars(one), "half_score": -1e6 * 0.6 * AWAY}))
    fused = learner.estimate()
    assert fused is not None
    assert fused.sigma[0] == pytest.approx(0.03, rel=0.01)
    assert fused.sigma[1] == pytest.approx(1e-3, rel=0.01)


@pytest.mark.parametrize("gusts", [0.0, 0.6])
def test_recursion_says_what_a_fit_of_all_says(gusts: float) -> None:
    """Rows are counted once: thirty seconds in overlapping windows are as sharp as in one, and near the same values."""
    made = flight(30.0, 2, gusts=gusts).window
    rolling, whole = (Estimator(PELICAN, 1e9, 10.0, 0) for _ in range(2))
    for stop in range(500, 1501, 50):
        cut = made.slice(max(stop - 511, 0), stop)
        asked = rolling.request(stop, WindowCut((cut,), 10.0, 0), cut.t0, cut.t0 + len(cut) * cut.dt)
        rolling.take(asked, asked.answer())
    asked = whole.request(1, WindowCut((made,), 30.0, 0), made.t0, made.t0 + 30.0)
    whole.take(asked, asked.answer())
    a, b = rolling.fusion.estimate(), whole.fusion.estimate()
    assert a is not None
    assert b is not None
    known = [NOMINAL_NAMES.index(name) for name in ("b", "J_xx", "J_yy")]
    assert np.all(np.abs(a.z - b.z)[known] < b.sigma[known])
    assert np.all(np.abs(np.log(a.sigma / b.sigma))[known] < 0.3)


def test_a_climb_does_not_pass_for_a_smaller_b() -> None:
    """Thrust falls by k_z for each m/s: ten seconds at 2 m/s made b 5.5 % smaller, give or take 0.4 %."""
    moves = [Segment(axis, "multisine", 0.0, 12.0, size, 0.3, 2.0) for axis, size in MOVES.items()]
    moves += [Segment("throttle", "step", 0.0, 12.0, 0.55)]
    inflow = {"axial_inflow": {"k_z": 0.25}}
    flown = fly(
        PELICAN, None, 12.0, 1, "scripted", segments=moves, effects=inflow, extras=("velocity",), noise_scale=0.1
    )
    sigma, off = estimated(flown, 600)
    assert np.all(np.abs(off) < 3.0 * sigma)
    assert np.all(np.abs(off)[[B, *ROLL_PITCH]] < 0.005)


@pytest.mark.parametrize("share", [0.0, 1.0])
def test_a_simulator_without_gyroscopic_coupling_is_seen(share: float) -> None:
    """J_xx or J_yy stood in for it: ArduPilot's simulator has none.  Without evidence it is there and shows J_zz."""
    flown = fly(PELICAN, None, 24.0, 1, effects={"no_gyroscopic_coupling": {"share": share}}, noise_scale=0.1)
    sigma, off = estimated(flown, 1150)
    assert np.all(np.abs(off) < 3.0 * sigma)
    assert np.all(np.abs(off)[[B, *ROLL_PITCH]] < 0.01)
    assert bool(sigma[NOMINAL_NAMES.index("J_zz")] < 0.05) is (share == 0.0)


@pytest.mark.parametrize(("effects", "stated"), [(SMOOTHED, True), (SMOOTHED, False), (SLOW, False), ({}, False)])
def test_a_low_pass_of_the_gyro_does_not_pass_for_a_smaller_inertia(
    effects: dict[str, dict[str, float]], stated: bool
) -> None:
    vehicle = PELICAN.model_copy(update={"effects": effects if stated else {}})
    sigma, off = estimated(fly(PELICAN, None, 24.0, 1, effects=effects, noise_scale=0.1), 1150, vehicle)
    assert np.all(np.abs(off) < 3.0 * sigma)
    assert np.all(np.abs(off)[[B, *ROLL_PITCH]] < 0.01)


def test_a_delay_that_shows_late_is_not_searched_from_what_was_found_with_it() -> None:
    """An attitude that began after 25 s left inertias a thousandth, and noise that explained all of the flight."""
    flown = fly(PELICAN, None, 24.0, 1, effects={"imu_lag": {"cutoff": 8.0}})
    cut, learner = flown.window.slice(50, 1150), Estimator(PELICAN, 1e9, 10.0, 0)
    first = replace(cut.slice(0, 500), attitude=None)
    asked = learner.request(1, WindowCut((first,), 10.0, 0), first.t0, first.t0 + 10.0)
    learner.take(asked, asked.answer())
    asked = learner.request(2, WindowCut((cut.slice(600, 1100),), 10.0, 0), cut.t0 + 12.0, cut.t0 + 22.0)
    assert asked.noise is not None
    psi = asked.noise.psi * np.where(np.arange(N_NOISE) < 3, 1e-4, np.where(np.arange(N_NOISE) < 18, 30.0, 1.0))
    spans = (cut.t0, cut.t0 + 10.0), (cut.t0 + 10.0, cut.t0 + 22.0)
    asked = replace(asked, noise=replace(asked.noise, psi=psi), z=asked.z + 0.3, learned=(cut,), spans=spans)
    learner.take(asked, asked.answer())
    assert learner.noise is not None
    assert learner.noise.late > 0.015
    for name in ("b", "J_xx", "J_yy"):
        assert learner.value(name) == pytest.approx(flown.truth.parameters.as_dict()[name], rel=0.02)


def estimated(flown: Flight, last: int, vehicle: Vehicle = PELICAN) -> tuple[FloatArray, FloatArray]:
    """Deviations and errors (log) of the six as learned from rows 50 to `last` of a flight, shapes (6,)."""
    cut = flown.window.slice(50, last)
    learner, seconds = Estimator(vehicle, 1e9, 10.0, 0), len(cut) * cut.dt
    asked = learner.request(1, WindowCut((cut,), seconds, 0), cut.t0, cut.t0 + seconds)
    learner.take(asked, asked.answer())
    found = learner.fusion.estimate()
    assert found is not None
    truth = np.log([flown.truth.parameters.as_dict()[name] for name in NOMINAL_NAMES])
    return found.sigma[:SIX], found.z[:SIX] - truth


@pytest.mark.parametrize("sigma", [0.1, 0.2])
def test_a_yaw_parameter_wider_than_allowed_stays_at_the_file_s_value(sigma: float) -> None:
    learner = Estimator(PELICAN, 120.0, 10.0, 0)
    asked = learner.request(1, WindowCut((flight(24.0, 2).window.slice(0, 500),), 10.0, 0), 0.0, 10.0)
    answer = tells(sigma)(asked)
    assert isinstance(answer, FitReply)
    learner.take(asked, answer)
    told = learner.parameters(0.3)
    assert told is not None
    for name in ("d", "J_zz", "J_r"):
        guess = PELICAN.parameters[name].initial
        assert (told[name].status is Status.PRIOR_DOMINATED) is (sigma == 0.2)
        assert (told[name].value == pytest.approx(guess)) is (sigma == 0.2)


def test_where_twice_as_much_was_flown_all_is_told_anew_at_one_point() -> None:
    """Nothing is counted twice or lost, and stretches stay apart."""
    worker, asked = tells(), list[FitRequest]()

    def watched(job: Job) -> JobReply | None:
        asked.extend([job] if isinstance(job, FitRequest) else [])
        return worker(job)

    session = Session(PELICAN, SessionSettings(diagnose=0.0, memory=1e9))
    works(session, light_flight(64.0), watched)
    first, *_ = asked
    (begin, end), *_ = first.spans
    anew = [job for job in asked if job.learned]
    assert [round(job.spans[-1][1] - end) for job in anew] == [11, 31]
    for job in anew:
        starts, stops = zip(*job.spans, strict=True)
        assert (starts[0], stops[-1]) == (pytest.approx(begin), job.stop)
        assert starts[1:] == pytest.approx(stops[:-1])
        assert max(np.subtract(stops, starts)[1:]) < 5.5
        assert sum(len(w) for w in job.learned) == pytest.approx((job.stop - begin) / 0.02, abs=1.0)
    fusion = session._estimator.fusion
    fused, flown = fusion.estimate(), asked[-1].stop - begin
    assert fused is not None
    assert fusion.flown == pytest.approx(flown)
    assert fused.sigma[2] == pytest.approx(0.005 / np.sqrt(flown / 10.0), rel=0.01)
    assert len(fusion.disjoint()) == int(flown / 10.0)
    assert max(s.stop - s.start for s in fusion.disjoint()[:-1]) < 14.0


def test_a_start_from_which_the_simulation_diverges_is_left() -> None:
    """Once every later window was called too quiet, and nothing was learned any more."""
    learner = Estimator(PELICAN, 60.0, 10.0, 0)
    learner.theta = learner.theta.copy()
    learner.theta[2] *= 1e-6
    asked = learner.request(1, WindowCut((flight(24.0, 5).window.slice(0, 600),), 12.0, 0), 0.0, 12.0)
    assert isinstance(asked, FitRequest)
    reply = asked.answer()
    assert reply.excited, reply
    learner.take(asked, reply)
    assert learner.value("J_xx") == pytest.approx(0.010, rel=0.05)
