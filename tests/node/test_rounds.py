"""Scheduler are done in steps that end in time, whole, and one begins when it is due."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from quadid_node.service import STEPS, WORK_SECONDS, Scheduler


class Work:
    """Scheduler of so many pieces, each of which takes so long [s]."""

    def __init__(self, pieces: int, lasting: float) -> None:
        self.now, self.begun, self.done = 0.0, 0, 0
        self._pieces, self._lasting = pieces, lasting
        self.rounds = Scheduler(self._round, lambda: self.now)

    def _round(self) -> Iterator[None]:
        self.begun += 1
        for _ in range(self._pieces):
            self.now += self._lasting
            self.done += 1
            yield

    def step(self) -> float:
        """Takes a step; returns how long it lasted [s]."""
        begin = self.now
        self.rounds.step()
        return self.now - begin


def test_a_round_is_done_at_once_when_there_is_time_and_the_next_waits_until_it_is_due() -> None:
    work = Work(3, WORK_SECONDS / 10.0)
    for _ in range(2 * STEPS):
        work.step()
    assert (work.begun, work.done) == (2, 6)


@pytest.mark.parametrize("pieces", [4, 40])
def test_no_piece_begins_after_the_time_and_none_is_left_out(pieces: int) -> None:
    work = Work(pieces, 0.4 * WORK_SECONDS)
    while work.done < 3 * pieces:
        assert work.step() <= 1.4 * WORK_SECONDS
    assert work.begun == 3


def test_one_piece_is_done_however_long_it_takes() -> None:
    work = Work(2, 10.0 * WORK_SECONDS)
    work.step()
    assert work.done == 1


def test_steps_without_work_are_known_before() -> None:
    work, resting = Work(1, WORK_SECONDS / 10.0), []
    for _ in range(3 * STEPS):
        resting.append(work.rounds.resting)
        before = work.done
        work.step()
        assert resting[-1] == (work.done == before)
    assert sum(resting) == 3 * (STEPS - 1)


def test_a_round_that_takes_twice_its_time_is_overdue() -> None:
    work, overdue = Work(3 * STEPS, 2.0 * WORK_SECONDS), []
    for _ in range(3 * STEPS):
        work.step()
        overdue.append(work.rounds.overdue)
    assert overdue == [False] * 2 * STEPS + [True] * STEPS


def test_a_dropped_round_is_not_gone_on_with() -> None:
    work = Work(3, 2.0 * WORK_SECONDS)
    work.step()
    work.rounds.drop()
    for _ in range(STEPS):
        work.step()
    assert (work.begun, work.done) == (2, 2)
