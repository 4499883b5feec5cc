"""Work that a session asks for and does not do itself: a fit, a question about a change, a diagnosis.

Whoever drives the session runs it, in its own process or another, and delivers the reply.
"""

from __future__ import annotations

import traceback
from abc import ABC, abstractmethod
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, TypeGuard

import numpy as np

from quadid.errors import QuadidError
from quadid.vehicle import Vehicle
from quadid.window import Window

UNEXPECTED = "unexpected error, please report it: "
"""Begins the problem of a job that failed by an error of this program, not by what its data are."""

MOST_ERRORS = 5
"""After so many of them in a row no more such jobs are begun by themselves."""


def unexpected(error: BaseException) -> str:
    """The problem that an error is which nobody foresaw: what, and where it arose."""
    *_, last = traceback.extract_tb(error.__traceback__)
    return f"{UNEXPECTED}{type(error).__name__}: {str(error)[:200]} ({Path(last.filename).name}, line {last.lineno})"


@dataclass(frozen=True)
class JobReply:
    """Answer to a job.

    Attributes:
        number: of the job.
        problem: why there is no result, or empty.
    """

    number: int
    problem: str = ""

    @property
    def is_unexpected(self) -> bool:
        """Whether the job failed by an error of this program."""
        return self.problem.startswith(UNEXPECTED)


@dataclass(frozen=True)
class Job(ABC):
    """A pure function of its own fields.

    Attributes:
        background: whether the session goes on meanwhile; it stands still for all others.
        reply: what it is answered with.
        number: counts the jobs of a session.
        vehicle: the vehicle.
        windows: stretches of data on one grid.
        start, stop: the time they stand for [s].
    """

    background: ClassVar[bool] = False
    reply: ClassVar[type[JobReply]]

    number: int
    vehicle: Vehicle
    windows: tuple[Window, ...]
    start: float
    stop: float

    def run(self) -> JobReply:
        """Does it; an error is the reply's `problem`, never raised."""
        try:
            return self.answer()
        except (QuadidError, np.linalg.LinAlgError) as error:
            return self.failed(str(error))
        except MemoryError:
            raise
        except Exception as error:  # noqa: BLE001 - whatever it is, the flight goes on, and it is told with its input
            return self.failed(unexpected(error))

    @abstractmethod
    def answer(self) -> JobReply:
        """Does it; raises QuadidError or LinAlgError for data that allow no answer."""

    def failed(self, problem: str) -> JobReply:
        """The reply of a job that could not be run."""
        return self.reply(self.number, problem)

    def is_answered_by(self, reply: object) -> TypeGuard[JobReply]:
        """Whether a reply is to this job, and of its kind."""
        return isinstance(reply, self.reply) and reply.number == self.number
