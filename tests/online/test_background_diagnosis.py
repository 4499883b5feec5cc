"""The diagnosis beside the fits: when it is asked for, what of its answers is told."""

import itertools
from dataclasses import replace

import pytest

from quadid.online import Job, JobReply, Session, SessionSettings
from quadid.online.change_job import DiagnosisReply, DiagnosisRequest
from quadid.online.records import Action, OnlineFinding
from tests.online.driving import diagnosed, drive, flight, samples, unanswered
from tests.online.made_up import PELICAN, light_flight, tells
from tests.samples import Sample

QUICK = SessionSettings(refit=5.0)
DRAG = OnlineFinding("rotor_drag", {"k_x": 0.3}, {"k_x": 0.02}, {"k_x": "1/s"}, 1.4, 1.0, 1e-6, (), "seen")


def studies(actions: list[Action]) -> list[DiagnosisRequest]:
    return [a for a in actions if isinstance(a, DiagnosisRequest)]


DRAGGED = (("rotor_drag", "k_x", 0.35), ("rotor_drag", "k_y", 0.35))


def test_what_was_told_is_not_told_again_but_news_are() -> None:
    session = Session(PELICAN, QUICK.model_copy(update={"diagnose": 1.0}))
    moved = replace(DRAG, values={"k_x": 0.5})
    replies = iter([(DRAG,), (replace(DRAG, values={"k_x": 0.31}),), (moved,)])

    def made_up(job: Job) -> JobReply:
        return DiagnosisReply(job.number, "", next(replies, (moved,)), "explained")

    told = diagnosed(drive(session, light_flight(160.0), diagnose=made_up, work=tells()))
    assert [d.findings for d in told] == [(DRAG,), (moved,)]


def test_an_answer_from_before_a_change_is_not_told() -> None:
    session, stream = Session(PELICAN, QUICK), light_flight(70.0)
    (request,) = studies(drive(session, stream, diagnose=unanswered, work=tells()))
    session.deliver(DiagnosisReply(request.number, "", (DRAG,), "explained"))
    late = [Sample(s.t + 400.0, s.channel, s.values) for s in stream]  # a break in the stream: another flight perhaps
    assert not diagnosed(drive(session, late[:6400], diagnose=unanswered, work=tells()))


def test_a_flight_with_drag_is_diagnosed_as_such() -> None:
    made = flight(72.0, 11, effects=DRAGGED)
    session = Session(PELICAN, QUICK)
    (request,) = studies(drive(session, samples(made.recording), diagnose=unanswered, work=tells()))
    reply = request.run()
    assert isinstance(reply, DiagnosisReply)
    assert not reply.problem
    assert reply.findings[0].effect == "rotor_drag"
    assert reply.findings[0].values["k_x"] == pytest.approx(0.35, rel=0.3)


def test_a_lag_is_not_named_with_confidence_where_rotors_are_read_slowly() -> None:
    """As by the command (`quadid.app.diagnose`): the lag is over before the next reading."""
    made = flight(72.0, 11, effects=(("motor_lag", "tau", 0.06),))
    fast = samples(made.recording)
    kept = itertools.count()
    slow = [s for s in fast if s.channel != "rotor_speed" or next(kept) % 4 == 0]
    asked = [
        studies(drive(Session(PELICAN, QUICK), stream, diagnose=unanswered, work=tells()))[0] for stream in (fast, slow)
    ]
    assert [request.slow for request in asked] == [False, True]
    for request in (asked[0], replace(asked[0], slow=True)):
        reply = request.run()
        assert isinstance(reply, DiagnosisReply)
        (lag,) = (f for f in reply.findings if f.effect == "motor_lag")
        assert lag.confident is not request.slow
