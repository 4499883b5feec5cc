"""Work that a session asks for and does not do itself: a fit, a question about a change, a diagnosis.

Whoever drives the session runs it, in its own process or another, and delivers the reply.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import ClassVar, TypeGuard


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
        number: counts the jobs of a session.
        background: whether the session goes on meanwhile; it stands still for all others.
    """

    background: ClassVar[bool] = False

    number: int

    @abstractmethod
    def run(self) -> JobReply:
        """Does it; trouble is the reply's `problem`, never raised."""

    @abstractmethod
    def failed(self, problem: str) -> JobReply:
        """The reply of a job that could not be run."""

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """Whether a reply is to this job, and of its kind."""
        return isinstance(reply, type(self.failed(""))) and reply.number == self.number
