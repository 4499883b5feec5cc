"""The session: learns in flight, publishes what passed, sees a change, survives faults, and is the same every time."""

import re

import numpy as np
import pytest

from quadid.identification.fit import FitOptions, fit
from quadid.online import FitRequest, Phase, Session, SessionSettings, SetState
from quadid.online.gate import GateSettings
from quadid.online.records import Action, Publish
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import EPOCH, answer, diagnosed, drive, flight, published, run, samples

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
    session = Session(PELICAN, SessionSettings(refit=2.0))
    sets = published(drive(session, samples(made.recording, EPOCH)))
    assert sets[0].stop == EPOCH + 30.0, "three windows of 10 s"
    assert all(s.state is SetState.ACCEPTED and s.approved_by == "auto" for s in sets)
    batch = fit([made.window.slice(0, 3000)], PELICAN, FitOptions(iterations=10)).parameters
    for name in NOMINAL_NAMES:
        online, offline = sets[-1].parameters[name], batch[name]
        assert online.value == pytest.approx(offline.value, rel=max(0.01, 2.0 * offline.sigma / offline.value))
        truth = getattr(made.truth.parameters, name)
        assert abs(online.value - truth) < 3.5 * sets[-1].told_by_flight(name)
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
            other.push(sample.block)
        place += size
        jumpy += other.poll() if rng.random() < 0.7 else []
        if other.running is not None and rng.random() < 0.5:  # some replies come late
            reply = run(other.running)
            assert reply is not None
            other.deliver(reply)
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
    session = Session(PELICAN, SessionSettings(refit=2.0, gate=GateSettings(windows=2)))
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
