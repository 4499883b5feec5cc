"""Answers from another machine that are none: refused at the door, and a session that hears them goes on."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from quadid.identification.noise import NoiseModel
from quadid.online import FitReply, FitRequest, Session
from quadid.online.background_diagnosis import _is_wrong_scale
from quadid.online.records import Job, JobReply, OnlineFinding
from tests.faults.evidence import Happened
from tests.online.driving import published
from tests.online.made_up import PELICAN, QUICK, light_flight, tells, works
from tests.online.test_gate import TRUE

FLIGHT = light_flight(20.0)
Spoil = Callable[[FitReply], FitReply]


def estimate(**fields: Any) -> Spoil:
    def spoil(reply: FitReply) -> FitReply:
        assert reply.estimate is not None
        return replace(reply, estimate=replace(reply.estimate, **fields))

    return spoil


def fields(**changed: Any) -> Spoil:
    return lambda reply: replace(reply, **changed)


def noise(white: int, slow: int | None = None, memory: float = 0.66) -> NoiseModel:
    return NoiseModel(np.full(white, 0.1), np.zeros(white if slow is None else slow), memory)


SPOILT: dict[str, Spoil] = {
    "z of three": estimate(z=np.zeros(3)), "z of none": estimate(z=np.zeros(0)),
    "z of two axes": estimate(z=np.zeros((6, 6))), "z beyond every bound": estimate(z=np.full(6, -1e5)),
    "information of three": estimate(information=np.eye(3)),
    "information of one axis": estimate(information=np.ones(6)),
    "information below zero": estimate(information=-1e6 * np.eye(6)), "score of two": estimate(score=np.zeros(2)),
    "no time": estimate(start=4.0, stop=4.0), "time without end": estimate(stop=1e300),
    "theta of three": fields(theta=np.ones(3)), "theta of two axes": fields(theta=np.ones((4, 4))),
    "theta that is no number": fields(theta=np.full(200, math.nan)),
    "excitation of two": fields(excitation=np.zeros(2)), "misfit of none": fields(misfit=np.zeros(0)),
    "noise of three": fields(noise=noise(3)), "noise of two lengths": fields(noise=noise(9, 3)),
    "noise without memory": fields(noise=noise(9, memory=0.0)), "measured of three": fields(measured=noise(3)),
    "spectrum of one": fields(noise=replace(noise(9), shape=np.ones((1, 1)))),
}  # fmt: skip


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
