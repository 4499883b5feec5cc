"""Drives a session from a flight, fits inline, as a replay does."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from typing import Any

from quadid.online import FitRequest, Session, fit_window
from quadid.online.fault_isolation import ChangeRequest, isolate_fault
from quadid.online.outbox import Action
from quadid.window import Recording, Sample

Fit = Callable[[FitRequest], Any]


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


def drive(session: Session, stream: Iterable[Sample], fit: Fit = fit_window) -> Iterator[Action]:
    """Pushes samples one by one, does every fit at once, and yields what the session says."""
    for sample in stream:
        session.push(sample)
        while True:
            yield from session.poll()
            request = session.running
            if isinstance(request, ChangeRequest):
                session.deliver(isolate_fault(request))
            elif request is not None:
                session.deliver(fit(request))
            else:
                break
