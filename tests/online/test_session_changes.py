"""The session without simulator and fit: sudden changes, and studies beside the fits."""

import re
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest

from quadid.checks.rotors import Lagged, lagged_of
from quadid.data.window import Window
from quadid.online import FitReply, FitRequest, Phase, Session, checks
from quadid.online.change_job import ChangeReply, ChangeRequest, DiagnosisReply, DiagnosisRequest
from quadid.online.records import Action, Job, JobReply, OnlineFinding
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import EPOCH, diagnosed, events, published
from tests.online.made_up import (
    DROPPED,
    PELICAN,
    QUICK,
    Worker,
    between,
    first_fit,
    light_flight,
    numbers,
    on_the_ground,
    tells,
    works,
)
from tests.samples import Sample

MASS = OnlineFinding(
    "mass_change", {"fraction": 0.17}, {"fraction": 0.01}, {"fraction": ""}, 9.0, 1.0, 1e-9, (), "seen"
)


def stop_of(job: Job) -> float:
    assert isinstance(job, FitRequest)
    return job.stop


def test_a_change_is_announced_explained_and_nothing_older_is_learned_from() -> None:
    session = Session(PELICAN, QUICK)

    def work(request: Job) -> JobReply | None:
        if isinstance(request, ChangeRequest):
            return ChangeReply(request.number, finding=MASS)
        return tells(b=0.85 if stop_of(request) > 18.0 else 1.0)(request)

    actions = works(session, between(DROPPED, 0.0, 17.5, EPOCH), work)
    (seen,) = events(actions, "change")
    assert (seen.level, seen.t) == ("warning", EPOCH + 16.0)
    told_as = rf"thrust stepped by (-\d+\.\d)% at {EPOCH + 14.3:.2f} s \((\d+) standard errors\)"
    told = re.fullmatch(told_as, seen.text)
    assert told is not None, seen.text
    size, errors = float(told[1]) / 100.0, float(told[2])
    assert size == pytest.approx(np.log(0.85), abs=2.0 * abs(size) / errors)
    assert errors > 7.0, "after fourteen seconds of flight few values tell the spread"
    status = session.status()
    assert status.phase is Phase.CANDIDATE
    assert "a change of thrust is being looked into" in status.reason
    assert max(a.stop for a in actions if isinstance(a, FitRequest)) == first_fit(actions).stop + 11.0, "no fit since"
    assert not [a for a in actions if isinstance(a, ChangeRequest)], "3 s of data must follow first"
    actions += works(session, between(DROPPED, 17.5, 29.7, EPOCH), work)
    (question,) = [a for a in actions if isinstance(a, ChangeRequest)]
    assert question.time == pytest.approx(EPOCH + 14.3, abs=0.03)
    assert numbers(actions) == list(range(1, len(numbers(actions)) + 1)), "one count for all requests"
    (answer,) = diagnosed(actions)
    assert (answer.findings, answer.verdict) == ((MASS,), "explained")
    assert answer.start == pytest.approx(EPOCH + 14.3, abs=0.03)
    assert answer.stop == EPOCH + 18.0
    after = [s for s in published(actions, "candidate") if s.stop > EPOCH + 18.0]
    assert after
    assert min(s.start for s in after) >= EPOCH + 14.3
    assert len(events(actions, "change")) == 1


def test_a_set_that_a_person_approved_is_said_to_be_out_of_date_too(happened: Happened) -> None:
    """With `approval: manual` as with `auto`, also for who subscribes later: the topic keeps the newest."""
    manual = QUICK.model_copy(update={"gate": QUICK.gate.model_copy(update={"approval": "manual"})})
    session = Session(PELICAN, manual)

    def work(request: Job) -> JobReply | None:
        return ChangeReply(request.number, finding=MASS) if isinstance(request, ChangeRequest) else tells()(request)

    assert not published(works(session, between(DROPPED, 0.0, 12.0), work))
    assert session.approve("ann").done
    (approved,) = published(session.poll())
    (said,) = published(works(session, between(DROPPED, 12.0, 19.0), work))
    assert (said.outdated, said.approved_by) == (MASS.evidence, "ann")
    assert said.sequence > approved.sequence
    assert said.parameters.values.tobytes() == approved.parameters.values.tobytes()
    assert session.active_set.in_force == said
    told = f"set {approved.sequence} again as {said.sequence}, out of date: {said.outdated}"
    happened(29, f"approval manual, thrust −15 %: {told}")


def test_while_a_change_is_explained_the_session_waits() -> None:
    session = Session(PELICAN, QUICK)

    def work(request: Job) -> JobReply | None:
        return None if isinstance(request, ChangeRequest) else tells()(request)

    works(session, between(DROPPED, 0.0, 20.7), work)
    question = session.running
    assert isinstance(question, ChangeRequest)
    assert session.status().phase is Phase.FITTING
    session.deliver(ChangeReply(question.number - 1, finding=MASS))
    assert session.poll() == []
    session.deliver(ChangeReply(question.number, problem="no known cause explains it"))
    said = session.poll()
    (told,) = diagnosed(said)
    assert (told.findings, told.verdict) == ((), "unknown")
    assert "no known cause" in events(said, "finding")[0].text
    assert isinstance(session.running, FitRequest), "the fits go on"


def test_an_answer_of_the_wrong_kind_is_ignored_and_the_question_asked_again() -> None:
    def confused(request: Job) -> JobReply:
        if isinstance(request, FitRequest):
            return ChangeReply(request.number, finding=MASS)
        return FitReply(request.number, problem="an answer to a fit")

    session = Session(PELICAN, QUICK)
    actions = works(session, between(DROPPED, 0.0, 4.7), confused)
    assert numbers(actions) == [1]
    assert not diagnosed(actions)
    assert numbers(works(session, between(DROPPED, 4.7, 8.7), tells())) == [2]
    works(session, between(DROPPED, 8.7, 16.7), tells())
    actions = works(session, between(DROPPED, 16.7, 18.7), confused)
    assert [a.stop for a in actions if isinstance(a, ChangeRequest)] == [18.0]
    assert not diagnosed(actions)
    assert session.status().phase is not Phase.FAILED
    actions = works(session, between(DROPPED, 18.7, 19.7), tells())
    assert [a.stop for a in actions if isinstance(a, ChangeRequest)] == [19.0]
    assert len(diagnosed(actions)) == 1


def test_a_change_of_a_vehicle_that_is_not_known_yet_is_explained_by_guesses() -> None:
    """Thrust is told from the motion before the change; what it does to the motion is as unsure as the file."""

    def work(request: Job) -> JobReply:
        if isinstance(request, ChangeRequest):
            return request.answer()
        return FitReply(request.number, problem="no luck")

    (told,) = diagnosed(works(Session(PELICAN, QUICK), between(DROPPED, 0.0, 20.7), work))
    (finding,) = told.findings
    assert (finding.effect, told.verdict) == ("thrust_drop", "unknown")
    assert "mass_change" in {one.effect for one in finding.alternatives}
    assert finding.values["fraction"] == pytest.approx(0.15, abs=0.02)


def test_the_order_of_rotors_is_asked_until_a_fit_is_taken_in_and_not_after_a_change(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    asked: list[float] = []

    def question(windows: Sequence[Window], vehicle: Vehicle, rate: float) -> Lagged | str:
        asked.append(float(windows[-1].t[-1]))
        return lagged_of(windows, vehicle, rate)

    monkeypatch.setattr(checks, "lagged_of", question)

    def work(request: Job) -> JobReply | None:
        if isinstance(request, ChangeRequest):
            return ChangeReply(request.number, finding=MASS)
        return tells(b=0.85 if stop_of(request) > 18.0 else 1.0)(request)

    actions = works(Session(PELICAN, QUICK), between(DROPPED, 0.0, 29.7), work)
    assert len(diagnosed(actions)) == 1
    assert asked
    assert max(asked) < 14.0


def studies(actions: list[Action]) -> list[DiagnosisRequest]:
    return [a for a in actions if isinstance(a, DiagnosisRequest)]


LONG = light_flight(96.0)
STUDYING = QUICK.model_copy(update={"diagnose": 60.0, "refit": 2.0, "seed": 3})


def test_a_minute_is_studied_beside_the_fits_and_told_half_a_minute_later() -> None:
    session = Session(PELICAN, STUDYING)
    actions = works(session, between(LONG, 0.0, 63.7, EPOCH), tells())
    (study,) = studies(actions)
    assert study.stop - study.start == 60.0
    assert (study.vehicle, study.seed) == (PELICAN, 3)
    assert sum(len(w) for w in study.windows) >= 2995
    assert study.stop <= 62.0 + study.start, "asked for as soon as there is a minute"
    session.deliver(DiagnosisReply(study.number + 1, "", (), "unknown"))
    session.deliver(DiagnosisReply(study.number, "", (MASS,), "explained"))
    assert session.running is None, "nothing waits for a study"
    rest = works(session, between(LONG, 63.7, 95.7, EPOCH), tells())
    (told,) = diagnosed(rest)
    assert (told.findings, told.verdict) == ((MASS,), "explained")
    assert (told.stop - told.start, told.t) == (60.0, told.stop)
    assert told.stop == session.resampler.time.stamp(study.stop)
    jobs = [a.number for a in actions + rest if isinstance(a, Job)]
    assert jobs == list(range(1, session.status().fits + 2)), "one count for all jobs"


@pytest.mark.parametrize(("scale", "check"), [(0.04, "model"), (0.01, "held_out_gain")])
def test_while_a_diagnosis_calls_a_sensor_wrong_nothing_is_published(scale: float, check: str) -> None:
    gyro = replace(MASS, effect="gyro_scale", values={"x": scale}, evidence="gyro x reads too much")
    session = Session(PELICAN, STUDYING)
    (study,) = studies(works(session, between(LONG, 0.0, 63.7), tells()))
    session.deliver(DiagnosisReply(study.number, "", (gyro,), "explained"))
    last = published(works(session, between(LONG, 63.7, 95.7), tells()), "candidate")[-1]
    assert last.check == check
    assert ("the diagnosis is in force: gyro x reads too much" in last.reason) == (check == "model")


@pytest.mark.parametrize("worker", ["failing", "blind", "off"])
def test_what_is_not_known_or_does_not_move_is_not_studied(worker: str) -> None:
    def blind(request: Job) -> JobReply | None:
        return tells()(request) if stop_of(request) < 20.0 else FitReply(request.number, excitation=np.full(6, 5.0))

    def failing(request: Job) -> FitReply:
        return FitReply(request.number, problem="no luck")

    settings = STUDYING.model_copy(update={"diagnose": 0.0}) if worker == "off" else STUDYING
    workers: dict[str, Worker] = {"failing": failing, "blind": blind, "off": tells()}
    assert not studies(works(Session(PELICAN, settings), between(LONG, 0.0, 63.7), workers[worker]))


def test_while_the_data_are_bad_nothing_is_studied() -> None:
    ground: list[Sample] = [s._replace(t=s.t + 50.0) for s in on_the_ground(20.0)]
    session = Session(PELICAN, STUDYING)
    actions = works(session, between(LONG, 0.0, 50.0) + ground, tells())
    assert session.status().phase is Phase.NOT_FLYING
    assert not studies(actions)
