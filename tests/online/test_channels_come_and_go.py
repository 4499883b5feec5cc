"""Channels that begin and end in flight: fits go on with what there is; no array reaches a kernel that it overruns."""

from dataclasses import replace

import pytest

from quadid.data.window import Recording
from quadid.flight import fly
from quadid.identification.noise import NoiseModel
from quadid.identification.problem import Shooting
from quadid.model.layout import Layout
from quadid.model.rollout import Rollout
from quadid.online import FitReply, FitRequest, GateSettings, Session, SessionSettings
from quadid.online.records import MOST_ERRORS, UNEXPECTED, Job, JobReply
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import drive, events, flight, published, samples
from tests.online.made_up import QUICK, light_flight, tells, works

PELICAN = Vehicle.shipped("pelican")
SETTINGS = SessionSettings(window=5.0, refit=2.0, diagnose=0.0, gate=GateSettings(windows=2, width=0.08, yaw_width=0.6))


def within(recording: Recording, name: str, start: float, stop: float) -> Recording:
    """The recording with one channel there from `start` to `stop` [s] only."""
    channel = recording.channels[name]
    there = (channel.t >= start) & (channel.t < stop)
    part = replace(channel, t=channel.t[there], values=channel.values[there])
    return replace(recording, channels={**recording.channels, name: part})


@pytest.mark.parametrize(
    ("name", "start", "stop"),
    [
        ("velocity", 11.0, 99.0),
        ("velocity", 0.0, 11.0),
        ("velocity", 11.0, 14.0),
        ("position", 11.0, 99.0),
        ("attitude", 0.0, 11.0),
        ("attitude", 11.0, 99.0),
        ("accel", 11.0, 99.0),
    ],
)
def test_a_channel_that_begins_or_ends_in_flight_ends_no_fit(
    name: str, start: float, stop: float, happened: Happened
) -> None:
    extras = (name,) if name in ("velocity", "position") else ()
    flown = fly(PELICAN, seconds=28.0, seed=3, extras=extras)
    session = Session(PELICAN, SETTINGS)
    actions = drive(session, samples(within(flown.recording, name, start, stop)))
    assert not events(actions, "unexpected")
    late = [item for item in published(actions, "candidate") if item.stop > 19.0]
    assert late, session.status()
    error = late[-1].parameters["J_xx"].value / flown.truth.parameters.J_xx - 1.0
    assert abs(error) < 0.08
    happened(41, f"{name} there from {start:g} to {min(stop, 28.0):g} s of 28 s: fits go on, J_xx {error:+.1%}")


def test_noise_of_fewer_channels_than_the_data_have_leaves_the_others_out() -> None:
    window = fly(PELICAN, seconds=6.0, seed=3, extras=("velocity",)).window
    for channels in (9, 12, 15):
        problem = Shooting.cut([window], PELICAN, 0.5, NoiseModel.guess(channels))
        assert problem.channels == len(problem.noise.white) == min(channels, 12)
        lin = problem.linearise(Layout(PELICAN).initial(PELICAN), problem.free(["b"]))
        assert lin.residuals.shape[2] == problem.channels


def test_kernels_refuse_arrays_that_they_would_overrun() -> None:
    window = flight(4.0).window
    rollout = Rollout(window, PELICAN)
    problem = Shooting.cut([window], PELICAN, 0.5)
    theta, segments = Layout(PELICAN).initial(PELICAN)[None], problem.segments[0]
    x0 = rollout.initial_states(segments)
    late = replace(segments, starts=segments.starts + len(window))
    for cut, vector, state in ((late, theta, x0), (segments, theta[:, :-1], x0), (segments, theta, x0[1:])):
        with pytest.raises(ValueError, match="allowed"):
            rollout.roll(cut, vector, state)


def test_an_unexpected_error_of_a_fit_is_told_and_does_not_repeat_for_ever(happened: Happened) -> None:
    broken = 0

    class Broken(FitRequest):
        def answer(self) -> FitReply:
            raise IndexError("index 12 is out of bounds")

    def work(request: Job) -> JobReply:
        nonlocal broken
        if isinstance(request, FitRequest):
            broken += 1
            return Broken(**vars(request)).run()
        return request.run()

    session = Session(PELICAN, QUICK)
    actions = works(session, light_flight(60.0), work)
    told = events(actions, "unexpected")
    assert broken == len(told) == MOST_ERRORS
    assert all(UNEXPECTED in e.text and "IndexError" in e.text and e.level == "error" for e in told)
    assert "no more fits" in session.status().reason
    session.fit_now()
    later = works(session, [s._replace(t=s.t + 60.0) for s in light_flight(30.0)], tells())
    assert published(later)
    happened(11, f"a fit that fails by an error of the program: told {len(told)} times, then only on request")


def test_an_unexpected_error_of_the_session_itself_does_not_end_it(monkeypatch: pytest.MonkeyPatch) -> None:
    session = Session(PELICAN, QUICK)

    def breaks(*_: object) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(session._health, "look", breaks)
    told = events(works(session, light_flight(15.0), tells()), "unexpected")
    assert "ZeroDivisionError" in told[0].text
    assert len(told) == MOST_ERRORS
    monkeypatch.undo()
    session.fit_now()
    later = works(session, [s._replace(t=s.t + 15.0) for s in light_flight(45.0)], tells())
    assert published(later)
