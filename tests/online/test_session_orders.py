"""The session without simulator and fit: what people order, what breaks."""

from dataclasses import replace

import pytest

from quadid.online import FitRequest, Phase, Session, SessionSettings, SetState
from quadid.online.change_job import ChangeRequest
from quadid.online.gate import Decision
from quadid.online.records import Event, Job
from tests.faults.evidence import Happened
from tests.online.driving import EPOCH, diagnosed, events, published
from tests.online.made_up import (
    DROPPED,
    GATE,
    PELICAN,
    QUICK,
    between,
    first_fit,
    light_flight,
    numbers,
    on_the_ground,
    tells,
    works,
)
from tests.samples import Sample

MANUAL = QUICK.model_copy(update={"gate": GATE.model_copy(update={"approval": "manual"})})
FLIGHT = light_flight(30.0)


def never(job: Job) -> None:
    """A worker that does not answer."""


def test_after_a_set_waits_nobody_is_told_to_keep_flying(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(PELICAN, MANUAL)
    works(session, between(FLIGHT, 0.0, 10.7, EPOCH), tells())
    waiting = session.status().pending
    refusal = Decision(SetState.REJECTED, "agreement", "2 of 3 windows agree so far: keep flying")
    monkeypatch.setattr("quadid.online.session.decide", lambda case, settings: refusal)
    works(session, between(FLIGHT, 10.7, 14.7, EPOCH), tells())
    status = session.status()
    assert (status.phase, status.pending) == (Phase.PENDING, waiting)
    assert "keep flying" not in status.reason
    assert f"set {waiting} waits for approval" in status.reason


def test_rotor_speeds_that_came_and_pause_are_no_matter_of_an_autopilots_log_profile() -> None:
    """The publisher of the rotor speeds was restarted; the status named PX4's SDLOG_PROFILE."""
    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, 8.7, EPOCH), tells())
    paused = [s for s in between(FLIGHT, 8.7, 24.0, EPOCH) if s.channel != "rotor_speed"]
    works(session, paused, tells())
    assert session.status().phase is Phase.BLOCKED
    assert "pause" in session.status().reason
    assert "SDLOG" not in session.status().reason


def with_two_sets(shift: float = 0.0) -> Session:
    """A session after 13.7 s with a blunt and a sharper set; samples are shifted by so much [s]."""
    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, 8.7, shift), tells(sigma=0.02))
    works(session, between(FLIGHT, 8.7, 13.7, shift), tells(sigma=0.002))
    assert session.active_set.predecessor is not None
    return session


# --- orders


def test_a_set_waits_for_a_person_and_is_approved_once() -> None:
    session = Session(PELICAN, MANUAL)
    assert not session.approve("ann").done, "nothing waits yet"
    actions = works(session, between(FLIGHT, 0.0, 10.7, EPOCH), tells())
    assert not published(actions)
    candidate = published(actions, "candidate")[-1]
    status = session.status()
    assert (candidate.state, status.phase, status.pending) == (SetState.PENDING, Phase.PENDING, candidate.sequence)
    assert not session.approve("ann", candidate.sequence + 1).done
    assert session.poll() == []
    assert session.approve("ann", candidate.sequence).done
    assert not session.approve("bob", candidate.sequence).done
    said = session.poll()
    (accepted,) = published(said)
    assert (accepted.state, accepted.approved_by) == (SetState.ACCEPTED, "ann")
    assert accepted.parameters.values.tobytes() == candidate.parameters.values.tobytes()
    (event,) = events(said, "accepted")
    assert event.t == pytest.approx(EPOCH + 10.7 - session.backlog, abs=0.03), "what the data have been read to"
    assert (session.status().pending, session.status().in_force) == (0, accepted.sequence)


def test_a_rollback_without_an_earlier_set_changes_nothing() -> None:
    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, 8.7), tells())
    before = session.status()
    answer = session.roll_back("bob")
    assert not answer.done
    assert "no earlier set" in answer.text
    assert session.poll() == []
    after = session.status()
    assert (after.phase, after.approval, after.in_force) == (before.phase, "auto", 1)
    assert numbers(works(session, between(FLIGHT, 8.7, 9.7), tells())) == [3], "the fits go on"


def test_a_rollback_returns_to_the_set_before_and_learns_anew_from_there() -> None:
    session = with_two_sets(EPOCH)
    good, before = session.active_set.predecessor, session.active_set.in_force
    assert good is not None
    assert before is not None
    assert session.roll_back("bob").done
    said = session.poll()
    (back,) = published(said)
    assert (back.state, back.approved_by, back.sequence) == (SetState.ROLLED_BACK, "bob", before.sequence + 1)
    assert back.parameters.values.tobytes() == good.parameters.values.tobytes()
    (event,) = events(said, "rollback")
    read_to = EPOCH + 13.7 - session.backlog
    assert event.t == pytest.approx(read_to, abs=0.03)
    status = session.status()
    assert (status.phase, status.approval) == (Phase.COLLECTING, "manual")
    assert "rolled back by bob" in status.reason
    later = works(session, between(FLIGHT, 13.7, 26.7, EPOCH), tells(sigma=0.0005))
    assert first_fit(later).noise is None, "nothing is taken for known"
    assert min(w.t0 for w in first_fit(later).windows) + session_start(session) >= read_to - 0.03
    assert not published(later), "from now on a person approves"
    assert session.status().phase is Phase.PENDING


def session_start(session: Session) -> float:
    """Offset from session time to stamps [s]."""
    return session.resampler.time.stamp(0.0)


def test_the_answer_to_a_fit_from_before_a_rollback_is_ignored_and_the_next_one_counts(happened: Happened) -> None:
    session = with_two_sets()
    works(session, between(FLIGHT, 13.7, 14.7), never)
    request = session.running
    assert isinstance(request, FitRequest)
    fits = session.status().fits
    assert session.roll_back("bob").done
    session.poll()
    reply = tells()(request)
    assert reply is not None
    session.deliver(reply)
    assert session.poll() == []
    assert (session.running, session.status().fits) == (None, fits)
    later = works(session, between(FLIGHT, 14.7, 22.7), tells())
    assert numbers(later) == [request.number + 1, request.number + 2]
    assert session.status().fits == fits + 2
    assert len(published(later, "candidate")) == 2
    happened(19, "rollback while a fit runs: the earlier set is in force again, the fit's answer is ignored")


def test_a_rollback_ends_the_search_for_what_a_change_was() -> None:
    session = Session(PELICAN, QUICK)
    works(session, between(DROPPED, 0.0, 8.7), tells(sigma=0.02))
    works(session, between(DROPPED, 8.7, 16.7), tells(sigma=0.002))
    assert "being looked into" in session.status().reason
    assert session.roll_back("bob").done
    later = works(session, between(DROPPED, 16.7, 24.7), tells(b=0.85))
    assert not diagnosed(later)
    assert isinstance(first_fit(later), FitRequest)
    assert not [a for a in later if isinstance(a, ChangeRequest)]


def test_fit_now_takes_what_there_is_at_the_next_tick_and_once() -> None:
    session = Session(PELICAN, SessionSettings(diagnose=0.0, refit=30.0))
    assert not numbers(works(session, between(FLIGHT, 0.0, 5.7), tells()))
    answer = session.fit_now()
    assert answer.done
    assert "next tick" in answer.text
    asked = works(session, between(FLIGHT, 5.7, 6.7), tells())
    assert numbers(asked) == [1]
    assert (first_fit(asked).start, first_fit(asked).stop) == (0.0, 6.0)
    assert not numbers(works(session, between(FLIGHT, 6.7, 9.7), tells())), "asked once, done once"


def test_fit_now_with_hardly_any_data_says_what_is_missing() -> None:
    session = Session(PELICAN, SessionSettings(diagnose=0.0))
    works(session, between(FLIGHT, 0.0, 2.2, EPOCH), tells())
    session.fit_now()
    assert not numbers(works(session, between(FLIGHT, 2.2, 3.7, EPOCH), tells()))
    assert session.status().phase is Phase.COLLECTING
    assert session.status().reason == "3 of 10 s of flight; no gaps"
    short = Session(PELICAN, SessionSettings(diagnose=0.0))
    works(short, between(FLIGHT, 0.0, 3.7, 0.4), tells())
    short.fit_now()
    assert numbers(works(short, between(FLIGHT, 3.7, 4.7, 0.4), tells())) == [1], "3.6 s are nearly four"


# --- what breaks


def test_a_set_that_predicts_worse_than_its_predecessor_is_taken_back_by_itself() -> None:
    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, 8.7), tells())
    good = session.active_set.in_force
    assert good is not None
    worse = tuple(replace(p, value=p.value * (1.06 if p.name == "b" else 1.0)) for p in good.parameters)
    session.active_set.accept(replace(good, parameters=replace(good.parameters, parameters=worse)), "test", 8.0, 8.0)
    actions = works(session, between(FLIGHT, 8.7, 13.7), tells())
    (back,) = published(actions)
    assert (back.state, back.approved_by) == (SetState.ROLLED_BACK, "auto")
    assert "predecessor" in back.reason
    assert back.parameters.values.tobytes() == good.parameters.values.tobytes()
    assert [e.level for e in events(actions, "rollback")] == ["warning"]
    assert session.status().approval == "auto"


def test_a_stuck_gyro_blocks_and_is_named_once() -> None:
    stuck = [s._replace(values=(0.1, 0.2, 0.3)) if s.channel == "gyro" and s.t > 9.0 else s for s in FLIGHT]
    session = Session(PELICAN, QUICK)
    actions = works(session, stuck[: 4 * 50 * 16], tells())
    assert session.status().phase is Phase.BLOCKED
    assert "gyro is stuck" in session.status().reason
    assert len(events(actions, "blocked")) == 1
    assert max(a.stop for a in actions if isinstance(a, FitRequest)) <= 10.0
    assert session.status().in_force == 1, "the last good set holds"


@pytest.mark.parametrize("delay", [1.0, 2.0, 6.0])
def test_what_comes_in_the_first_seconds_is_no_warning(delay: float) -> None:
    """A vehicle sends what it was asked for after a moment: warnings at every start are read by nobody."""
    session = Session(PELICAN, QUICK)
    stream = [s for s in between(FLIGHT, 0.0, 9.7) if s.channel != "rotor_speed" or s.t > delay]
    warned = [a for a in works(session, stream, tells()) if isinstance(a, Event) and a.level != "info"]
    assert len(warned) == (delay > 3.0)


@pytest.mark.parametrize(("missing", "word"), [("rotor_speed", "no rotor speeds"), ("gyro", "no gyro")])
def test_a_missing_channel_is_told(missing: str, word: str) -> None:
    session = Session(PELICAN, QUICK)
    actions = works(session, [s for s in between(FLIGHT, 0.0, 9.7) if s.channel != missing], tells())
    assert not numbers(actions)
    assert word in session.status().reason
    assert session.status().phase is Phase.BLOCKED
    (event,) = events(actions, "blocked")
    assert "fix" in event.text
    assert event.t == 3.0 or missing == "gyro"


def test_the_ground_is_not_learned_from(happened: Happened) -> None:
    session = Session(PELICAN, QUICK)
    actions = works(session, on_the_ground(8.0), tells())
    assert not numbers(actions)
    assert session.status().phase is Phase.NOT_FLYING
    assert "on the ground" in session.status().reason
    assert [e.t for e in events(actions, "not_flying")] == [4.0], "told once"
    (first,) = published(works(session, between(FLIGHT, 0.0, 15.0, 8.0), tells()))
    assert first.start >= 13.0 - 0.22 - 1e-6, "nor from the first seconds, in which the ground may still hold it"
    happened(18, f"8 s on the ground, then flight: learned only from data after {first.start:g} s")


def test_a_known_vehicle_that_its_rotors_carry_by_a_third_only_does_not_fly() -> None:
    factor = {"rotor_speed": 0.6}  # light on its legs: the ground carries the rest, and the accelerometer reads g

    def lightly(start: float, stop: float) -> list[Sample]:
        stretch = between(FLIGHT, start, stop)
        return [s._replace(values=tuple(v * factor.get(s.channel, 1.0) for v in s.values)) for s in stretch]

    session = Session(PELICAN, QUICK)
    works(session, between(FLIGHT, 0.0, 9.7) + lightly(9.7, 15.7), tells())
    assert session.status().phase is Phase.NOT_FLYING
    assert "of the weight" in session.status().reason
    guessed = Session(PELICAN, QUICK)
    assert numbers(works(guessed, lightly(0.0, 4.7), tells())), "while its thrust is a guess it may well fly"


def test_a_gap_is_counted_and_a_long_one_holds_the_fits_back() -> None:
    session = Session(PELICAN, SessionSettings(diagnose=0.0))
    brief = [s for s in FLIGHT if not (s.channel == "rotor_speed" and 11.0 <= s.t < 11.6)]
    works(session, [s for s in brief if s.t < 15.7], tells())
    status = session.status()
    assert status.gaps == 1
    assert 9.0 < status.window_seconds < 10.0
    assert status.samples == round(status.window_seconds * 50.0)
    assert status.fits == 3
    session = Session(PELICAN, SessionSettings(diagnose=0.0))
    long = [s for s in FLIGHT if not (s.channel == "rotor_speed" and 11.0 <= s.t < 14.0)]
    works(session, [s for s in long if s.t < 15.7], tells())
    assert session.status().phase is Phase.COLLECTING
    assert "s of usable data in the last" in session.status().reason
    assert session.status().fits < 3


def test_a_reboot_begins_anew_and_mixes_nothing(happened: Happened) -> None:
    session = Session(PELICAN, QUICK)
    actions = works(session, between(FLIGHT, 0.0, 6.7, 500.0), tells())
    actions += works(session, between(FLIGHT, 10.0, 20.7, -9.0), tells())
    begun = events(actions, "stream")
    assert [(e.level, e.text) for e in begun] == [("info", "a stream of data begins")] * 2
    assert [e.t for e in begun] == [500.0, pytest.approx(1.0, abs=0.1)]
    asked = [a for a in actions if isinstance(a, FitRequest)]
    assert all(a.windows[-1].t.max() - a.windows[0].t0 < 4.3 for a in asked)
    fit_of_the_new = [s.stop for s in published(actions, "candidate") if s.stop < 100.0]
    assert fit_of_the_new[0] == pytest.approx(5.0, abs=1.0), "no sooner than a window after it began"
    happened(7, "reboot in flight online: two streams, no set mixes them")
