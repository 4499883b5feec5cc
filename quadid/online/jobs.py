"""Work that a session asks for and does not do itself: a fit, a question about a change, a diagnosis.

Whoever drives the session runs it, in its own process or another, and delivers the reply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeGuard

import numpy as np

from quadid.errors import QuadidError
from quadid.vehicle import Vehicle
from quadid.window import Window


@dataclass(frozen=True)
class JobReply:
    """Answer to a job.

    Attributes:
        number: of the job.
        problem: why there is no result, or empty.
    """

    number: int
    problem: str = ""


@dataclass(frozen=True)
class Job(ABC):
    """A pure function of its own fields.

    Attributes:
        background: whether the session goes on meanwhile; it stands still for all others.
        trouble: what may go wrong with data that nobody foresaw.
        reply: what it is answered with.
        number: counts the jobs of a session.
        vehicle: the vehicle.
        windows: stretches of data on one grid.
        start, stop: the time they stand for [s].
    """

    background: ClassVar[bool] = False
    trouble: ClassVar[tuple[type[Exception], ...]] = (QuadidError, np.linalg.LinAlgError)
    reply: ClassVar[type[JobReply]]

    number: int
    vehicle: Vehicle
    windows: tuple[Window, ...]
    start: float
    stop: float

    def run(self) -> JobReply:
        """Does it; trouble is the reply's `problem`, never raised."""
        try:
            return self.answer()
        except self.trouble as error:
            return self.failed(str(error))

    @abstractmethod
    def answer(self) -> JobReply:
        """Does it; raises what is `trouble`."""

    def failed(self, problem: str) -> JobReply:
        """The reply of a job that could not be run."""
        return self.reply(self.number, problem)

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """Whether a reply is to this job, and of its kind."""
        return isinstance(reply, self.reply) and reply.number == self.number
