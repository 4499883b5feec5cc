"""Drives a session from a flight, as the services and the replay do: samples in time order, fits inline."""

import pickle
from collections.abc import Callable, Iterable, Sequence
from functools import lru_cache

from quadid.data.window import Recording
from quadid.flight import Flight, fly
from quadid.online import FitRequest, Job, JobReply, Session
from quadid.online.records import Action, Event, OnlineDiagnosis, OnlineSet, Publish
from quadid.vehicle import Vehicle
from tests.samples import Sample, gathered

Background = Callable[[Job], JobReply | None]
EPOCH = 1_700_000_000.0


@lru_cache(maxsize=16)
def flight(
    seconds: float,
    seed: int = 1,
    profile: str = "excited",
    effects: tuple[tuple[str, str, float], ...] = (),
    gusts: float = 0.0,
) -> Flight:
    """A Pelican flight; effects as (effect, parameter, value), gusts in m/s^2 (rms)."""
    named: dict[str, dict[str, float]] = {}
    for effect, parameter, value in effects:
        named.setdefault(effect, {})[parameter] = value
    outside = {"gusts": {"push": gusts, "turn": 1.3 * gusts, "time": 0.6}} if gusts else None
    return fly(Vehicle.shipped("pelican"), seconds=seconds, seed=seed, profile=profile, effects=named, outside=outside)


def samples(recording: Recording, shift: float = 0.0) -> list[Sample]:
    """All samples of a recording in time order."""
    out = [
        Sample(shift + t, name, tuple(row))
        for name, channel in recording.channels.items()
        for t, row in zip(channel.t.tolist(), channel.values.tolist(), strict=True)
    ]
    return sorted(out, key=lambda s: s.t)


def run(job: Job) -> JobReply | None:
    """Runs a job at once; the same fit once only, as sessions of one flight ask for it."""
    return fitted(pickle.dumps(job)) if isinstance(job, FitRequest) else job.run()


@lru_cache(maxsize=64)
def fitted(request: bytes) -> JobReply:
    """The answer to a fit."""
    reply: JobReply = pickle.loads(request).run()
    return reply


def unanswered(job: Job) -> None:
    """Leaves a job to the caller."""


def answer(session: Session, diagnose: Background = run, work: Background = run) -> list[Action]:
    """Polls until the session needs more samples, doing every fit at once, fits and diagnoses as told."""
    out: list[Action] = []
    while True:
        for action in session.poll():
            out.append(action)
            if isinstance(action, Job) and action.background and (reply := diagnose(action)) is not None:
                session.deliver(reply)
        request = session.running
        if request is None:
            return out
        reply = work(request)
        assert reply is not None
        session.deliver(reply)


def drive(
    session: Session, stream: Sequence[Sample], chunk: int = 40, diagnose: Background = run, work: Background = run
) -> list[Action]:
    """Pushes all samples, polling after every `chunk` of them."""
    out: list[Action] = []
    for start in range(0, len(stream), chunk):
        for block in gathered(sample.block for sample in stream[start : start + chunk]):
            session.push(block)
        out.extend(answer(session, diagnose, work))
    return out


def published(actions: Iterable[Action], topic: str = "parameters") -> list[OnlineSet]:
    """The sets published on a topic."""
    return [a.item for a in actions if isinstance(a, Publish) and a.topic == topic]


def diagnosed(actions: Iterable[Action]) -> list[OnlineDiagnosis]:
    """The diagnoses."""
    return [a for a in actions if isinstance(a, OnlineDiagnosis)]


def events(actions: Iterable[Action], kind: str = "") -> list[Event]:
    """The events, of one kind."""
    return [a for a in actions if isinstance(a, Event) and kind in ("", a.kind)]
