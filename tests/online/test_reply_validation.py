"""Answers from another machine that are none: refused at the door, and a session that hears them goes on."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadid.estimate.kalman import N_NOISE
from quadid.online import FitReply, FitRequest, Session
from quadid.online.change_job import _is_wrong_scale
from quadid.online.records import Job, JobReply, OnlineFinding
from tests.faults.evidence import Happened
from tests.online.driving import published
from tests.online.made_up import NOISE, PELICAN, QUICK, light_flight, tells, works
from tests.online.test_gate import TRUE

FLIGHT = light_flight(20.0)
Spoil = Callable[[FitReply], FitReply]


def estimate(**fields: Any) -> Spoil:
    def spoil(reply: FitReply) -> FitReply:
        *before, last = reply.estimates
        return replace(reply, estimates=(*before, replace(last, **fields)))

    return spoil


def fields(**changed: Any) -> Spoil:
    return lambda reply: replace(reply, **changed)


def noise(**changed: Any) -> Spoil:
    return fields(noise=replace(NOISE, **changed))


SPOILT: dict[str, Spoil] = {
    "z of three": estimate(z=np.zeros(3)),
    "z of none": estimate(z=np.zeros(0)),
    "z of two axes": estimate(z=np.zeros((6, 6))),
    "z beyond every bound": estimate(z=np.full(6, -1e5)),
    "information of three": estimate(information=np.eye(3)),
    "information of one axis": estimate(information=np.ones(6)),
    "information below zero": estimate(information=-1e6 * np.eye(6)),
    "score of two": estimate(score=np.zeros(2)),
    "no time": estimate(start=4.0, stop=4.0),
    "time without end": estimate(stop=1e300),
    "an estimate too many": lambda reply: replace(reply, estimates=2 * reply.estimates),
    "theta of three": fields(theta=np.ones(3)),
    "theta of two axes": fields(theta=np.ones((4, 4))),
    "theta that is no number": fields(theta=np.full(200, math.nan)),
    "excitation of two": fields(excitation=np.zeros(2)),
    "half of three": estimate(half_information=np.eye(3)),
    "loose of one": estimate(loose=np.zeros(1)),
    "rows of none": estimate(rows=0.0),
    "noise of three": noise(psi=np.ones(3)),
    "noise below zero": noise(psi=np.full(N_NOISE, -1.0)),
    "tails of two": noise(tail=np.zeros(2)),
    "a doubt without end": noise(doubt=math.inf),
    "a gyro too late": noise(late=0.2),
}


@pytest.mark.parametrize("what", SPOILT)
def test_a_session_that_hears_what_cannot_be_an_answer_goes_on(what: str, happened: Happened) -> None:
    honest, count = tells(), 0

    def work(job: Job) -> JobReply | None:
        nonlocal count
        reply = honest(job)
        if not isinstance(job, FitRequest):
            return reply
        assert job.is_answered_by(reply)
        assert isinstance(reply, FitReply)
        count += 1
        if count % 2:
            return reply
        spoilt = SPOILT[what](reply)
        assert not job.is_answered_by(spoilt)
        return spoilt

    session = Session(PELICAN, QUICK)
    sets = published(works(session, FLIGHT, work))
    assert count > 4
    assert sets
    assert all(abs(s.parameters["b"].value / TRUE["b"] - 1.0) < 0.01 for s in sets)
    happened(26, f"a ground machine that answers with {what}: refused, {len(sets)} sets from the answers between")


def test_a_finding_without_numbers_is_no_wrong_scale() -> None:
    assert not _is_wrong_scale(OnlineFinding("gyro_scale", {}, {}, {}, 3.0, 1.0, 1e-9, (), "seen"))
