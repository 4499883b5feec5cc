"""The session without simulator and fit: when it asks, what it publishes, what waits for a fit.

The session and all it consists of are real; recording and fits are arithmetic (`tests.online.made_up`).
"""

import math
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from quadid.data.window import Block
from quadid.online import FitReply, FitRequest, GateSettings, Phase, Session, SessionSettings, SetState
from quadid.online.records import Action, Job, JobReply, Publish
from quadid.parameters import NOMINAL_NAMES
from tests.online.driving import EPOCH, events, published
from tests.online.made_up import PELICAN, answered, between, light_flight, on_the_ground, tells, works
from tests.online.test_gate import TRUE, online_set, scaled

QUICK = SessionSettings(window=4.0, diagnose=0.0, gate=GateSettings(windows=2, width=0.15))
"""A first set after 8 s."""
FLIGHT = light_flight(30.0)
EARLIER = replace(online_set(scaled(b=0.97)), sequence=7, reason="of yesterday")


def fits(actions: list[Action]) -> list[FitRequest]:
    return [a for a in actions if isinstance(a, FitRequest)]


def told(actions: list[Action]) -> list[object]:
    """Everything a session said and asked, comparable."""
    return [
        (a.topic, a.item.sequence, a.item.state, a.item.reason, a.item.input_hash, a.item.parameters.values.tobytes())
        if isinstance(a, Publish)
        else (a.number, a.start, a.stop, a.theta.tobytes(), [w.gyro.tobytes() for w in a.windows if w.gyro is not None])
        if isinstance(a, FitRequest)
        else a
        for a in actions
    ]


def test_before_the_first_sample_it_waits_and_says_so() -> None:
    session = Session(PELICAN)
    assert session.poll() == []
    status = session.status()
    assert (status.phase, status.backlog, status.samples, status.in_force, status.pending) == (
        Phase.WAITING,
        0,
        0,
        0,
        0,
    )
    assert (status.window_seconds, status.gaps, status.fits) == (0.0, 0, 0)
    assert math.isnan(status.t)
    assert math.isnan(status.mse)
    assert np.isnan(status.excitation).all()
    assert not status.stale
    assert session.running is None


def test_two_windows_that_agree_give_a_set_and_a_third_gives_no_news() -> None:
    session = Session(PELICAN, QUICK)
    actions = works(session, between(FLIGHT, 0.0, 12.7, EPOCH), tells())
    (first,) = published(actions)
    assert (first.sequence, first.state, first.approved_by, first.check) == (1, SetState.ACCEPTED, "auto", "approval")
    assert (first.start, first.stop, first.samples) == (EPOCH, EPOCH + 8.0, 400)
    for name in NOMINAL_NAMES:
        assert first.parameters[name].value == pytest.approx(TRUE[name], rel=0.005)
    candidates = published(actions, "candidate")
    assert [c.stop - EPOCH for c in candidates] == [4.0, 8.0, 9.0]
    assert candidates[0].state is SetState.REJECTED
    assert "keep flying" in candidates[0].reason
    assert "no improvement" in candidates[-1].reason


def test_the_status_tells_what_was_done() -> None:
    session = Session(PELICAN, QUICK)
    stream = between(FLIGHT, 0.0, 12.7, EPOCH)
    works(session, stream, tells(sigma=0.006))
    status = session.status()
    assert status.t == stream[-1].t
    assert status.phase is Phase.ACCEPTED
    assert (status.fits, status.rejected, status.in_force, status.pending) == (3, 2, 1, 0)
    assert (status.samples, status.gaps, status.approval, status.stale, status.faults) == (211, 0, "auto", False, {})
    assert status.window_seconds == pytest.approx(4.22)
    assert status.mse == 1.0
    assert np.all(status.excitation == 0.006)
    assert 0.0 < status.backlog < 0.7, "only what the filters still need"


def test_a_fit_is_asked_for_every_second_with_a_full_window_of_data_and_some_before() -> None:
    asked = fits(works(Session(PELICAN, QUICK.model_copy(update={"seed": 5})), between(FLIGHT, 0.0, 9.7), tells()))
    assert [a.number for a in asked] == [1, 2, 3]
    assert [(a.start, a.stop) for a in asked] == [(0.0, 4.0), (4.0, 8.0), (5.0, 9.0)], "the first takes long"
    assert {a.seed for a in asked} == {5}
    assert [a.noise is None for a in asked] == [True, False, False], "once known, no global search"
    first, last = asked[0].windows[0], asked[-1].windows[0]
    assert (len(first), first.t0) == (200, 0.0)
    assert (len(last), last.dt) == (211, 0.02)
    assert last.t0 == pytest.approx(4.78)


@pytest.mark.parametrize(("refit", "stops"), [(0.5, [3.5, 7.0, 7.5]), (2.0, [4.0, 8.0, 10.0])])
def test_the_time_between_fits_is_kept(refit: float, stops: list[float]) -> None:
    session = Session(PELICAN, QUICK.model_copy(update={"refit": refit}))
    asked = fits(works(session, between(FLIGHT, 0.0, stops[-1] + 0.7), tells()))
    assert [a.stop for a in asked] == stops


def test_the_first_tick_follows_the_first_sample() -> None:
    asked = fits(works(Session(PELICAN, QUICK), between(FLIGHT, 0.0, 9.3, 0.7), tells()))
    assert [a.stop for a in asked] == [5.0, 9.0], "4 s after 0.7 s, at whole seconds"
    assert asked[0].start == 1.0
    begun = Session(PELICAN, QUICK)
    works(begun, between(FLIGHT, 0.0, 1.0, 0.7), tells())
    assert begun.status().reason.startswith("0 of 4 s of flight"), "0.3 s at the tick of 1 s"
    half = Session(PELICAN, QUICK.model_copy(update={"refit": 0.5}))
    late = fits(works(half, between(FLIGHT, 0.0, 5.7, EPOCH + 0.7), tells()))
    assert half.resampler.time.stamp(late[0].stop) == EPOCH + 4.5, "half a second short is enough"


@pytest.mark.parametrize("shift", [0.56, 0.58, 0.6])
def test_a_window_holds_every_row_up_to_its_tick_wherever_blocks_of_rows_end(shift: float) -> None:
    asked = fits(works(Session(PELICAN, QUICK), between(FLIGHT, 0.0, 6.7, shift), tells()))
    assert [a.windows[-1].t[-1] for a in asked] == pytest.approx([a.stop - 0.02 for a in asked], abs=1e-6)


def test_the_grid_has_the_rate_of_the_settings() -> None:
    session = Session(PELICAN, QUICK.model_copy(update={"rate": 25.0}))
    asked = fits(works(session, between(FLIGHT, 0.0, 10.7), tells()))
    assert asked[2].windows[0].dt == 0.04
    assert len(asked[2].windows[0]) == pytest.approx(4.22 * 25.0, abs=0.6)
    assert [a.stop for a in asked] == [4.0, 8.0, 9.0]


def test_windows_the_gate_and_memory_follow_the_settings() -> None:
    three = QUICK.model_copy(update={"gate": GateSettings(windows=3, width=0.15)})
    (first,) = published(works(Session(PELICAN, three), between(FLIGHT, 0.0, 14.7), tells()))
    assert first.stop == 13.0
    sharp, blunt = (
        published(works(Session(PELICAN, QUICK.model_copy(update={"memory": m})), FLIGHT, tells()), "candidate")[-1]
        for m in (1e6, 20.0)
    )
    ratio = blunt.told_by_flight("b") / sharp.told_by_flight("b")
    assert 1.1 < ratio < 2.0, "who forgets claims to know less"


def test_blocks_of_messages_give_what_samples_give() -> None:
    stream = between(FLIGHT, 0.0, 9.7, EPOCH)
    plain = works(Session(PELICAN, QUICK), stream, tells())
    session = Session(PELICAN, QUICK)
    t = np.array([s.t for s in stream[::4]])
    names = [s.channel for s in stream[:4]]
    columns = tuple((name, np.array([s.values for s in stream[k::4]])) for k, name in enumerate(names))
    session.push(Block(t, columns))
    assert told(answered(session, tells())) == told(plain)


def test_while_a_fit_runs_data_are_read_on_until_the_next_tick_which_waits() -> None:
    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, 7.9), tells())
    works(session, between(FLIGHT, 7.9, 8.7), lambda request: None)
    request = session.running
    assert isinstance(request, FitRequest)
    assert works(session, between(FLIGHT, 8.7, 9.3), lambda request: None) == []
    assert session.backlog < 0.9, "what rows of the grid wait for"
    assert works(session, between(FLIGHT, 9.3, 11.7), lambda request: None) == []
    assert session.running is request
    assert session.status().phase is Phase.FITTING
    assert 2.3 < session.status().backlog < 2.7
    reply = tells()(request)
    assert reply is not None
    session.deliver(reply)
    asked = fits(answered(session, tells()))
    assert [a.stop for a in asked] == [9.0]
    assert session.backlog < 0.7


@pytest.mark.parametrize("answered_at", [5.0, 6.6])
def test_while_a_long_fit_runs_the_data_go_on_and_its_answer_counts_three_seconds_later(answered_at: float) -> None:
    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, answered_at), lambda request: None)
    request = session.running
    assert isinstance(request, FitRequest)
    assert session.status().phase is Phase.FITTING
    assert session.backlog < 0.7
    reply = tells()(request)
    assert reply is not None
    session.deliver(reply)
    assert not published(works(session, between(FLIGHT, answered_at, 6.7), tells()), "candidate")
    actions = works(session, between(FLIGHT, 6.7, 8.7), tells())
    assert [c.stop for c in published(actions, "candidate")] == [4.0, 8.0]
    (after,) = fits(actions)
    assert after.spans == ((4.0, 8.0),), "no row is left out"
    late = Session(PELICAN, QUICK)
    works(late, between(FLIGHT, 0.0, 9.7), lambda request: None)
    assert late.backlog == pytest.approx(1.7, abs=0.4), "then they wait"


def in_portions(session: Session, rng: np.random.Generator, longest: float, patience: float = math.inf) -> list[Action]:
    """The flight in portions of any size, each of its replies after up to `longest` [s] of data more.

    Nothing is waited for longer than `patience` [s].
    """
    out, left, due, asked = list[Action](), list(FLIGHT), math.nan, math.nan
    while left or session.running is not None:
        size = int(rng.integers(1, 60))
        for sample in left[:size]:
            session.push(sample.block)
        del left[:size]
        out += session.poll()
        if session.running is None:
            due = math.nan
            continue
        now = session.status().t
        if math.isnan(due):
            asked, due = now, now + rng.uniform(0.0, longest)
        if now - asked > patience:
            session.go_on()
        if now >= due or not left:
            session.deliver(tells()(session.running) or session.running.failed("made up"))
            due = math.nan
    return out + session.poll()


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_neither_portions_nor_the_time_that_fits_take_change_what_a_session_says(seed: int) -> None:
    plain = works(Session(PELICAN, QUICK), FLIGHT, tells())
    assert published(plain)
    assert told(in_portions(Session(PELICAN, QUICK), np.random.default_rng(seed), 5.0)) == told(plain)


@pytest.mark.parametrize(("seed", "longest"), [(0, 0.4), (1, 3.0), (2, 9.0)])
def test_a_slow_machine_gives_the_same_answers_or_fewer(seed: int, longest: float) -> None:
    plain = works(Session(PELICAN, QUICK), FLIGHT, tells())
    session = Session(PELICAN, QUICK, patience=1.0)
    actions = in_portions(session, np.random.default_rng(seed), longest, 1.0)
    assert not events(actions, "change")
    if longest < 0.5:
        assert (told(actions), session.skipped) == (told(plain), 0)
        return
    assert session.skipped > 3
    assert 0 < len(published(actions)) <= len(published(plain))
    assert len(fits(actions)) < len(fits(plain))
    for item in published(actions):
        for name in NOMINAL_NAMES:
            assert item.parameters[name].value == pytest.approx(TRUE[name], rel=0.005)


def test_of_data_that_come_all_at_once_only_the_newest_are_fitted_but_all_are_used() -> None:
    session = Session(PELICAN, QUICK, patience=1.0)
    known = works(session, between(FLIGHT, 0.0, 16.0), tells())
    for sample in between(FLIGHT, 16.0, 19.7):
        session.push(sample.block)
    (only,) = fits(answered(session, tells()))
    assert (only.stop, session.skipped) == (19.0, 3)
    assert only.spans[0][0] == fits(known)[-1].stop == 15.0, "no row is left out"


def test_answers_to_nothing_and_to_something_else_are_ignored() -> None:
    session = Session(PELICAN, QUICK)
    session.deliver(FitReply(1, problem="nobody asked"))
    works(session, between(FLIGHT, 0.0, 7.9), tells())
    works(session, between(FLIGHT, 7.9, 8.7), lambda request: None)
    request = session.running
    assert isinstance(request, FitRequest)
    for number in (request.number - 1, request.number + 1):
        session.deliver(FitReply(number, problem="another one's"))
        assert session.poll() == []
        assert session.running is request
    (candidate,) = published(answered(session, tells()), "candidate")
    assert candidate.stop == 8.0
    session.deliver(FitReply(request.number, problem="the same once more"))
    assert session.poll() == []
    assert session.status().phase is Phase.ACCEPTED


def test_a_failed_fit_is_told_once_and_the_next_windows_are_learned_from() -> None:
    session = Session(PELICAN, QUICK)
    actions = works(session, between(FLIGHT, 0.0, 15.7), lambda r: FitReply(r.number, problem="the worker died"))
    assert len(fits(actions)) == 3
    (event,) = events(actions, "failed")
    assert (event.t, event.level, event.text) == (4.0, "warning", "the worker died")
    assert (session.status().phase, session.status().reason) == (Phase.FAILED, "the worker died")
    assert session.status().fits == 0
    assert published(works(session, between(FLIGHT, 15.7, 28.0), tells()))
    assert session.status().phase is Phase.ACCEPTED


def test_units_that_a_fit_finds_wrong_block_until_a_window_is_right_again() -> None:
    """Units of a known vehicle are asked beside the session: every second they took it as long as all the rest."""
    session = Session(PELICAN, QUICK.model_copy(update={"refit": 3.0}))
    works(session, between(FLIGHT, 0.0, 15.7), tells())
    before = session.status().fits
    actions = works(session, between(FLIGHT, 15.7, 19.7), lambda r: FitReply(r.number, fault="gyro is in deg/s"))
    (event,) = events(actions, "blocked")
    assert (event.t, event.text) == (fits(actions)[0].stop, "gyro is in deg/s")
    assert [b.stop - a.stop for a, b in pairwise(fits(actions))] == [1.0] * (len(fits(actions)) - 1)
    assert len(fits(actions)) > 1
    assert (session.status().phase, session.status().fits) == (Phase.BLOCKED, before)
    works(session, between(FLIGHT, 19.7, 24.0), tells())
    assert session.status().fits > before


def test_a_window_that_reveals_nothing_is_named_and_nothing_is_published() -> None:
    bounds = np.array([0.01, 0.1, 0.02, 0.03, 0.4, 2.0])
    session = Session(PELICAN, QUICK)
    actions = works(session, between(FLIGHT, 0.0, 7.7), lambda r: FitReply(r.number, excitation=bounds))
    assert not published(actions, "candidate")
    assert session.status().phase is Phase.NOT_EXCITED
    assert "J_r only to 200%" in session.status().reason
    assert np.array_equal(session.status().excitation, bounds)


def test_a_restored_set_holds_as_stale_until_flight_confirms_it() -> None:
    session = Session(PELICAN, QUICK, restored=EARLIER, next_sequence=12)
    (stale,) = published(session.poll())
    assert (stale.sequence, stale.state) == (12, SetState.STALE)
    assert "of yesterday" in stale.reason
    status = session.status()
    assert (status.in_force, status.stale) == (12, True)
    actions = works(session, between(FLIGHT, 0.0, 9.7), tells())
    assert fits(actions)[0].theta[:6] == pytest.approx(EARLIER.parameters.values), "the search starts there"
    (confirmed,) = published(actions)
    assert (confirmed.sequence, confirmed.state, confirmed.stop) == (13, SetState.ACCEPTED, 8.0)
    assert (session.status().in_force, session.status().stale) == (13, False)


def test_creeping_is_measured_from_the_baseline_of_earlier_runs() -> None:
    def creeping(baseline: float) -> list[SetState]:
        known = online_set(scaled(b=baseline))
        session = Session(PELICAN, QUICK, restored=EARLIER, next_sequence=12, baseline=known)
        return [c.state for c in published(works(session, between(FLIGHT, 0.0, 9.7), tells()), "candidate")]

    assert creeping(0.97)[1] is SetState.ACCEPTED
    assert creeping(0.65)[1] is SetState.PENDING, "54 % above what a person last approved"


@pytest.mark.parametrize(("until", "alarms"), [(4.0, 0), (18.0, 1)])
def test_only_what_windows_had_agreed_on_makes_another_estimate_a_change(until: float, alarms: int) -> None:
    """The first window of a hexacopter held its climb: wrong by itself, it made an alarm of the flight after it."""
    session = Session(PELICAN, QUICK)

    def work(request: Job) -> JobReply | None:
        assert isinstance(request, FitRequest)
        return tells(J_xx=1.5 if request.stop <= until else 1.0)(request)

    actions = works(session, light_flight(30.0), work)
    assert len(events(actions, "change")) == alarms
    last = published(actions, "candidate")[-1]
    assert last.parameters["J_xx"].value == pytest.approx(TRUE["J_xx"], rel=0.01)


@pytest.mark.parametrize("phase", [0.0, 0.3, 0.6, 0.9])
def test_the_take_off_is_in_no_window(phase: float) -> None:
    """Half a second of it, still on the ground, made J_xx 0.12 instead of 0.011, and no set came for 100 s."""
    landed = on_the_ground(5.0 + phase)
    asked = fits(works(Session(PELICAN, QUICK), [*landed, *between(FLIGHT, 0.0, 20.0, 5.0 + phase)], tells()))
    assert asked
    assert asked[0].start >= 9.9 + phase


def test_an_estimate_that_no_vehicle_has_is_forgotten_with_what_it_was_learned_from() -> None:
    """The noise that came with it made every later window wrong, which the gate refused 70 times in a row."""
    session, impossible = Session(PELICAN, QUICK), tells(J_xx=0.1, J_yy=0.1)
    assert not published(works(session, between(FLIGHT, 0.0, 8.7), impossible))
    assert session.status().phase is Phase.COLLECTING
    assert "breaks the triangle inequality" in session.status().reason
    later = works(session, between(FLIGHT, 8.7, 25.0), tells())
    assert fits(later)[0].noise is None
    assert published(later)
