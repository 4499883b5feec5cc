"""Rounds are done in steps that end in time, whole, and one begins when it is due."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from quadid_node.service import STEPS, WORK_SECONDS, Scheduler


class Work:
    """Rounds of so many pieces, each of which takes so long [s]."""

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


@pytest.mark.parametrize(
    ("pieces", "lasting", "steps", "done"),
    [
        (3, 0.1, 2 * STEPS, (2, 6)),  # at once where there is time; the next round waits until it is due
        (2, 10.0, 1, (1, 1)),  # one piece a step, however long it takes
        (40, 0.4, 14 * 3, (3, 120)),  # no piece begins after the time of a step, and none is left out
    ],
)
def test_pieces_are_done_in_steps(pieces: int, lasting: float, steps: int, done: tuple[int, int]) -> None:
    work = Work(pieces, lasting * WORK_SECONDS)
    for _ in range(steps):
        begin, before, rests = work.now, work.done, work.rounds.resting
        work.rounds.step()
        assert work.now - begin <= max(1.4, lasting) * WORK_SECONDS
        assert rests == (work.done == before), "steps without work are known before"
    assert (work.begun, work.done) == done


def test_a_round_that_takes_twice_its_time_is_overdue_and_a_dropped_one_is_not_gone_on_with() -> None:
    work = Work(3 * STEPS, 2.0 * WORK_SECONDS)
    for step in range(3 * STEPS):
        work.rounds.step()
        assert work.rounds.overdue == (step >= 2 * STEPS)
    assert work.begun == 1
    work.rounds.drop()
    work.rounds.step()
    assert work.begun == 2
