"""Drives a session from a flight, fits inline, as a replay does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator

from quadid.data.window import Recording, Sample
from quadid.online import Job, JobReply, Session
from quadid.online.records import Action

Work = Callable[[Job], JobReply]


def samples(recording: Recording, shift: float = 0.0) -> Iterator[Sample]:
    """All samples of a recording in time order, `shift` [s] later."""
    every = [
        (t, name, row)
        for name, channel in recording.channels.items()
        for t, row in zip(channel.t.tolist(), channel.values.tolist(), strict=True)
    ]
    every.sort(key=lambda entry: entry[0])
    for t, name, row in every:
        yield Sample(shift + t, name, tuple(row))


def drive(session: Session, stream: Iterable[Sample], work: Work = Job.run) -> Iterator[Action]:
    """Pushes samples one by one, does every job at once, and yields what the session says."""
    for sample in stream:
        session.push(sample)
        yield from session.poll()
        while session.running is not None:
            session.deliver(work(session.running))
            yield from session.poll()
