"""The session: learns in flight, publishes what passed, sees a change, survives faults, and is the same every time."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from quadid.data.window import Sample
from quadid.identification.fit import FitOptions, fit
from quadid.online import FitReply, FitRequest, Phase, Session, SessionSettings, SetState
from quadid.online.change_job import ChangeReply
from quadid.online.gate import GateSettings
from quadid.online.records import Action, OnlineSet, Publish
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import EPOCH, answer, diagnosed, drive, events, flight, published, samples

PELICAN = Vehicle.shipped("pelican")
QUICK = SessionSettings(window=5.0, gate=GateSettings(windows=2, width=0.08, yaw_width=0.6))
"""Shorter windows: a first set after 10 s."""


def outcome(actions: list[Action]) -> list[object]:
    """Everything published, as bytes."""
    return [
        (a.topic, a.item.sequence, a.item.state, a.item.reason, a.item.input_hash, a.item.stop,
         a.item.parameters.values.tobytes(), a.item.parameters.covariance.tobytes(), a.item.mse)
        if isinstance(a, Publish) else repr(a)
        for a in actions if not isinstance(a, FitRequest)
    ]  # fmt: skip


def test_sixty_seconds_of_flight_give_what_the_batch_gives() -> None:
    made = flight(61.0, 5)
    session = Session(PELICAN)
    sets = published(drive(session, samples(made.recording, EPOCH)))
    assert sets[0].stop == EPOCH + 30.0, "three windows of 10 s"
    assert all(s.state is SetState.ACCEPTED and s.approved_by == "auto" for s in sets)
    batch = fit([made.window.slice(0, 3000)], PELICAN, FitOptions(iterations=10)).parameters
    for name in NOMINAL_NAMES:
        online, offline = sets[-1].parameters[name], batch[name]
        assert online.value == pytest.approx(offline.value, rel=max(0.01, 2.0 * offline.sigma / offline.value))
        truth = getattr(made.truth.parameters, name)
        assert abs(online.value - truth) < 3.5 * online.sigma
    assert session.status().phase is Phase.ACCEPTED


def test_how_samples_are_pushed_and_polled_changes_nothing() -> None:
    stream = samples(flight(16.0, 6).recording, EPOCH)
    one, other, third = (Session(PELICAN, QUICK) for _ in range(3))
    plain = drive(one, stream, chunk=len(stream))
    rng = np.random.default_rng(0)
    shuffled = sorted(stream, key=lambda s: s.t + {"gyro": 0.1, "rotor_speed": 0.3}.get(s.channel, 0.0))
    jumpy: list[Action] = []
    place = 0
    while place < len(shuffled):
        size = int(rng.integers(1, 400))
        for sample in shuffled[place : place + size]:
            other.push(sample)
        place += size
        jumpy += other.poll(most=int(rng.integers(0, 3)))
        if other.running is not None and rng.random() < 0.5:  # some replies come late
            assert isinstance(other.running, FitRequest)
            other.deliver(other.running.run())
    jumpy += answer(other)
    assert outcome(plain) == outcome(jumpy)
    assert outcome(plain) == outcome(drive(third, stream, chunk=7))
    assert published(plain)


def test_hover_publishes_nothing() -> None:
    session = Session(PELICAN)
    actions = drive(session, samples(flight(60.0, 7, "hover").recording))
    assert not [a for a in actions if isinstance(a, Publish)]
    assert not diagnosed(actions)
    assert session.status().phase is Phase.NOT_EXCITED
    assert "J_r" in session.status().reason


@pytest.mark.parametrize("fraction", [0.15, -0.12])
def test_a_change_of_mass_is_found_within_five_seconds_and_what_is_learned_waits_for_a_person(
    fraction: float, happened: Happened
) -> None:
    at = 22.3
    made = flight(46.0, 8, "excited", (("mass_change", "time", at), ("mass_change", "fraction", fraction)))
    session = Session(PELICAN, SessionSettings(gate=GateSettings(windows=2)))
    stream = samples(made.recording)
    actions = drive(session, [s for s in stream if s.t <= at + 5.0])
    (diagnosis,) = diagnosed(actions)
    (finding,) = diagnosis.findings
    assert finding.effect == "mass_change"
    assert finding.values["fraction"] == pytest.approx(fraction, rel=0.1)
    assert finding.values["time"] == pytest.approx(at, abs=0.1)
    actions = drive(session, [s for s in stream if s.t > at + 5.0])
    assert not [s for s in published(actions) if not s.outdated], "b and inertias would rest on the old mass"
    waits = session.active_set.pending
    assert waits is not None, "the changed vehicle was learned"
    assert (waits.state, waits.check) == (SetState.PENDING, "mass")
    told = re.search(r"changed by about ([+-]\d+)%", waits.reason)
    assert told is not None, waits.reason
    assert int(told[1]) / 100.0 == pytest.approx(fraction, abs=0.02)
    assert waits.start >= at, "nothing from before the change"
    assert waits.parameters["b"].value == pytest.approx(made.truth.parameters.b / (1.0 + fraction), rel=0.01)
    happened(38, f"mass {fraction:+.0%} in flight: named as {finding.values['fraction']:+.1%}; '{waits.reason[:90]}'")
    assert session.approve("ann").done
    assert session.active_set.load == 1.0, "who approved it has judged the mass"


def test_manual_approval_waits_and_rollback_stays_manual() -> None:
    settings = QUICK.model_copy(update={"gate": QUICK.gate.model_copy(update={"approval": "manual"})})
    session = Session(PELICAN, settings)
    stream = samples(flight(24.0, 9).recording)
    first = drive(session, [s for s in stream if s.t < 14.0])
    assert not published(first)
    assert session.status().phase is Phase.PENDING
    assert not session.approve("ann", sequence=99).done
    assert session.approve("ann").done
    assert not session.approve("ann").done
    (accepted,) = published(session.poll())
    assert accepted.approved_by == "ann"
    assert not session.roll_back("ann").done, "there is no earlier set"
    drive(session, [s for s in stream if 14.0 <= s.t < 22.0])
    if session.active_set.pending is not None:
        session.approve("bob")
        assert session.roll_back("bob").done
        assert published(session.poll())[-1].parameters.values.tobytes() == accepted.parameters.values.tobytes()


def test_a_restored_set_is_published_stale_and_confirmed_by_flight() -> None:
    stream = samples(flight(16.0, 6).recording)
    (first, *_) = published(drive(Session(PELICAN, QUICK), stream))
    session = Session(PELICAN, QUICK, restored=first, next_sequence=first.sequence + 1)
    (stale,) = published(session.poll())
    assert (stale.state, stale.sequence) == (SetState.STALE, first.sequence + 1)
    assert session.status().stale
    sets = published(drive(session, stream))
    assert (sets[0].state, sets[0].sequence) == (SetState.ACCEPTED, first.sequence + 2)
    assert not session.status().stale


def _learned(seconds: float, seed: int, until: float) -> tuple[Session, OnlineSet, list[Sample]]:
    """A session that has a set in force after `until` seconds of a flight, that set, and the samples still to come."""
    stream = samples(flight(seconds, seed).recording)
    session = Session(PELICAN, QUICK)
    drive(session, [s for s in stream if s.t < until])
    force = session.active_set.in_force
    assert force is not None
    return session, force, [s for s in stream if s.t >= until]


def test_a_rollback_while_a_fit_runs_ignores_that_fit(happened: Happened) -> None:
    session, force, later = _learned(24.0, 9, 20.0)
    session.active_set.accept(replace(force, reason="a second one"), "test", 20.0, 20.0)
    for sample in later:
        session.push(sample)
    session.poll()
    request = session.running
    assert isinstance(request, FitRequest)
    assert session.roll_back("bob").done
    session.deliver(request.run())
    actions = session.poll()
    assert published(actions)[0].state is SetState.ROLLED_BACK
    assert session.status().approval == "manual"
    assert not published(actions, "candidate")
    happened(19, "rollback while a fit runs: the earlier set is in force again, the fit's answer is ignored")


def test_a_rollback_drops_the_work_that_was_begun() -> None:
    session, force, later = _learned(24.0, 9, 20.0)
    session.active_set.accept(replace(force, reason="a second one"), "test", 20.0, 20.0)
    for sample in later:
        session.push(sample)
    pieces = 0
    while session.running is None:  # stop at every piece of a tick in turn
        session.poll(1)
        pieces += 1
    request = session.running
    assert isinstance(request, FitRequest)
    assert pieces > 10
    session.deliver(request.run())
    session.poll(1)  # the estimate is fused, the gate is not asked yet
    assert session.roll_back("bob").done
    afterwards = answer(session)
    assert not published(afterwards, "candidate"), "what was begun before the rollback is not published after it"
    assert session.status().phase is Phase.COLLECTING


def test_a_set_that_turns_out_worse_is_taken_back() -> None:
    session, good, later = _learned(40.0, 10, 15.0)
    worse = tuple(replace(p, value=p.value * (1.04 if p.name == "b" else 1.0)) for p in good.parameters)
    bad = replace(good, parameters=replace(good.parameters, parameters=worse))
    session.active_set.accept(bad, "test", 15.0, 15.0)
    actions = drive(session, later)
    back = published(actions)[0]
    assert back.state is SetState.ROLLED_BACK
    assert back.approved_by == "auto"
    assert back.parameters.values.tobytes() == good.parameters.values.tobytes()
    assert "predecessor" in back.reason
    assert events(actions, "rollback")


def test_a_failed_fit_is_told_and_the_session_goes_on() -> None:
    stream = samples(flight(16.0, 6).recording)
    session = Session(PELICAN, QUICK)
    failed = 0
    for sample in stream:
        session.push(sample)
        session.poll()
        request = session.running
        if isinstance(request, FitRequest):
            session.deliver(FitReply(request.number - 1, problem="an answer to something else"))
            assert session.running is request
            if failed < 3:
                failed += 1
                session.deliver(FitReply(request.number, problem="the worker died"))
                session.poll()
                assert session.status().phase is Phase.FAILED
            else:
                session.deliver(request.run())
    assert session.status().fits > 3


def test_the_ground_before_and_after_a_flight_is_not_learned_from(happened: Happened) -> None:
    made = flight(16.0, 6)
    rng = np.random.default_rng(0)
    idle = [
        Sample(0.02 * k, name, values)
        for k in range(600)
        for name, values in (
            ("gyro", tuple(0.02 * rng.normal(size=3))),
            ("accel", (0.1 * rng.normal(), 0.1 * rng.normal(), -9.8 + 0.1 * rng.normal())),
            ("rotor_speed", tuple(80.0 + rng.normal(size=4))),
        )
    ]
    flying = samples(made.recording, 12.0)
    session = Session(PELICAN, QUICK)
    actions = drive(session, idle)
    assert session.status().phase is Phase.NOT_FLYING
    assert not published(actions, "candidate")
    actions = drive(session, flying)
    sets = published(actions)
    assert sets
    assert min(s.start for s in sets) >= 12.0
    happened(
        18,
        f"12 s on the ground, then flight: learned only from data after {min(s.start for s in sets):g} s",
    )


def test_a_missing_motor_signal_is_told_with_the_fix() -> None:
    session = Session(PELICAN, QUICK)
    drive(session, [s for s in samples(flight(16.0, 6).recording) if s.channel != "rotor_speed"])
    status = session.status()
    assert status.phase is Phase.BLOCKED
    assert "no rotor speeds and no motor commands" in status.reason
    assert "fix" in status.reason


def test_a_reboot_in_flight_begins_anew_and_mixes_nothing(happened: Happened) -> None:
    stream = samples(flight(16.0, 6).recording, 100.0)
    again = samples(flight(16.0, 6).recording, 1.0)
    session = Session(PELICAN, QUICK)
    actions = drive(session, [s for s in stream if s.t < 109.0]) + drive(session, again)
    assert len(events(actions, "stream")) == 2
    sets = published(actions)
    assert sets
    assert sets[0].stop < 100.0, "stamps of the new time base"
    happened(7, "reboot in flight online: two streams, no set mixes them")


def test_an_explained_change_needs_no_fit_when_nothing_was_known() -> None:
    drop = (("mass_change", "time", 20.3), ("mass_change", "fraction", 0.2))
    session = Session(PELICAN)
    actions = drive(session, samples(flight(27.0, 11, "hover", drop).recording))
    (diagnosis,) = diagnosed(actions)
    assert diagnosis.verdict == "unknown"
    assert not diagnosis.findings[0].confident
    assert diagnosis.findings[0].values["fraction"] == pytest.approx(0.2, abs=0.03)


def test_a_stray_answer_is_ignored() -> None:
    session = Session(PELICAN, QUICK)
    session.deliver(ChangeReply(5))
    session.deliver(FitReply(7))
    assert session.poll() == []


def test_fit_now_does_not_wait_for_a_full_window() -> None:
    session = Session(PELICAN)
    stream = samples(flight(16.0, 6).recording)
    drive(session, [s for s in stream if s.t < 6.0])
    assert session.status().fits == 0
    session.fit_now()
    drive(session, [s for s in stream if 6.0 <= s.t < 7.5])
    assert session.status().fits == 1
