"""References through the stabiliser: the rotor commands that nobody told, and what is identified from them."""

from dataclasses import replace

import numpy as np
import pytest

from quadid.data.window import Recording
from quadid.flight import fly
from quadid.flight.pilot import default_gains
from quadid.online import GateSettings, Publish, Session, SessionSettings
from quadid.online.records import Phase, SetState
from quadid.online.stream import SOURCE, Resampler
from quadid.vehicle import Stabiliser, Vehicle
from tests.online.driving import drive, samples
from tests.samples import gathered

PELICAN = Vehicle.shipped("pelican")
HOVER = PELICAN.hover_speed(PELICAN.parameters["b"].initial)
STEERED = PELICAN.model_copy(update={"stabiliser": Stabiliser(gains=default_gains(PELICAN))})


def without_rotors(recording: Recording) -> Recording:
    kept = {n: c for n, c in recording.channels.items() if n not in ("rotor_speed", "motor_command")}
    return replace(recording, channels=kept)


@pytest.mark.parametrize("rate", [50.0, 200.0])
def test_the_commands_are_those_of_the_vehicle(rate: float) -> None:
    flight = fly(STEERED, seconds=16.0, seed=2, profile="excited", log_rate=rate, command_rate=rate)
    told, steered = Resampler(STEERED), Resampler(STEERED)
    for resampler, recording in ((told, flight.recording), (steered, without_rotors(flight.recording))):
        for block in gathered(sample.block for sample in samples(recording)):
            resampler.push(block)
    differences, count = [], 0
    while (a := told.next_rows()) is not None and (b := steered.next_rows()) is not None:
        both = np.isfinite(a.columns["rotor_speed"]).all(axis=1) & np.isfinite(b.columns["rotor_speed"]).all(axis=1)
        differences.append((a.columns["rotor_speed"][both] ** 2 - b.columns["rotor_speed"][both] ** 2) / HOVER**2)
        if both.all():
            assert (b.source, b.sampling) == (SOURCE, a.sampling)
        count += int(both.sum())
    assert count > 150
    # All that is not known is what the integrals held when the log began: a constant torque, nearly found.
    left = np.concatenate(differences)
    assert np.abs(left.mean(axis=0)).max() < 2e-3
    assert np.abs(left - left.mean(axis=0)).max() < 1e-3


def test_a_session_identifies_from_references_alone() -> None:
    flight = fly(STEERED, seconds=52.0, seed=5, profile="excited")
    session = Session(STEERED, SessionSettings(diagnose=0.0))
    actions = list(drive(session, samples(without_rotors(flight.recording))))
    sets = [a.item for a in actions if isinstance(a, Publish) and a.topic == "parameters"]
    assert sets
    assert sets[-1].state is SetState.ACCEPTED
    truth = flight.truth.parameters.as_dict()
    for name in ("b", "J_xx", "J_yy"):
        assert sets[-1].parameters[name].value == pytest.approx(truth[name], rel=0.02)


@pytest.mark.parametrize(("lost", "until"), [("gyro", 3.1), ("attitude_reference", 3.5), ("attitude", 3.5)])
def test_what_is_lost_on_the_way_costs_time_but_does_not_spoil_what_follows(lost: str, until: float) -> None:
    flight = fly(STEERED, seconds=30.0, seed=5, profile="excited")
    stream = [s for s in samples(without_rotors(flight.recording)) if s.channel != lost or not 3.0 <= s.t < until]
    gate = GateSettings(windows=2, width=0.08, yaw_width=0.6)
    session = Session(STEERED, SessionSettings(diagnose=0.0, window=5.0, gate=gate))
    actions = list(drive(session, stream))
    sets = [a.item for a in actions if isinstance(a, Publish) and a.topic == "parameters"]
    assert sets
    truth = flight.truth.parameters.as_dict()
    for name in ("b", "J_xx", "J_yy"):
        assert sets[-1].parameters[name].value == pytest.approx(truth[name], rel=0.03)


def test_without_the_gains_it_is_refused_with_the_fix() -> None:
    flight = fly(STEERED, seconds=14.0, seed=5, profile="excited")
    session = Session(PELICAN, SessionSettings(diagnose=0.0))
    actions = list(drive(session, samples(without_rotors(flight.recording))))
    assert not [a for a in actions if isinstance(a, Publish)]
    assert session.status().phase is Phase.BLOCKED
    assert "gains of the stabiliser" in session.status().reason
