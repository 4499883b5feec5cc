"""The right to publish: simulated services that look once a second, see each other late, come and go."""

from __future__ import annotations

import random

import pytest
from quadid_node.publish import BESIDE, FOUND_WITHIN, OBSERVES, STRANGER, YOUNG, TopicOwnership

SETTLED = FOUND_WITHIN + 2.0
"""By then [s] a service that sees no other one speaks."""


class Topic:
    """Who publishes, as services see it; `apart`: they do not see each other."""

    def __init__(self) -> None:
        self.now, self.apart = 0.0, False
        self.publishers: dict[int, str] = {}
        self._next = 0

    def service(self) -> TopicOwnership:
        """A service that looks at this topic; its own publisher it always sees."""
        mine: set[int] = set()

        def count() -> int:
            return len(mine) if self.apart else len(self.publishers)

        def kin() -> int:
            return len(mine) if self.apart else sum(name == "quadid" for name in self.publishers.values())

        def create() -> int:
            number = self.stranger("quadid")
            mine.add(number)
            return number

        def destroy(number: int) -> None:
            mine.discard(number)
            del self.publishers[number]

        return TopicOwnership(count, kin, create, destroy, lambda: self.now)

    def stranger(self, name: str = "someone") -> int:
        self._next += 1
        self.publishers[self._next] = name
        return self._next

    def run(self, seconds: float, *services: TopicOwnership) -> None:
        for _ in range(round(seconds)):
            self.now += 1.0
            for service in services:
                service.step()


def speaking(*services: TopicOwnership) -> int:
    return sum(s.publisher is not None for s in services)


def test_the_second_observes_and_takes_over_when_the_first_is_gone() -> None:
    topic = Topic()
    first, second = topic.service(), topic.service()
    topic.run(SETTLED, first)
    topic.run(30.0, first, second)
    assert (first.publisher is not None, second.publisher) == (True, None)
    assert (first.problem, second.problem) == ("", OBSERVES)
    first.let_go()
    topic.run(6.0, second)
    assert second.publisher is not None
    assert second.problem == ""


def test_one_that_is_found_by_its_next_announcement_is_not_talked_over() -> None:
    topic = Topic()
    first = topic.service()
    topic.run(SETTLED, first)
    second = topic.service()
    topic.apart = True
    topic.run(3.0, second)  # Fast DDS announces a participant every 3 s
    assert second.publisher is None
    topic.apart = False
    topic.run(30.0, first, second)
    assert (first.publisher is not None, second.publisher) == (True, None)


def test_one_that_is_not_active_yet_tells_and_claims_nothing() -> None:
    topic = Topic()
    first, second = topic.service(), topic.service()
    topic.run(SETTLED, first)
    assert not second.step(wanted=False)
    assert second.problem == OBSERVES
    first.let_go()
    topic.now += 60.0
    assert not second.step(wanted=False)
    assert (second.publisher, second.problem) == (None, "")


@pytest.mark.parametrize("seed", range(20))
def test_two_that_claimed_at_once_or_apart_end_with_one(seed: int) -> None:
    random.seed(seed)
    topic = Topic()
    services = topic.service(), topic.service(), topic.service()
    topic.apart = True
    topic.run(SETTLED if seed % 2 else SETTLED + 2.0 * YOUNG, *services)
    assert speaking(*services) == 3, "they do not see each other"
    topic.apart = False
    topic.run(60.0, *services)
    assert speaking(*services) == 1
    assert sorted(s.problem for s in services) == ["", OBSERVES, OBSERVES]


def test_to_a_stranger_a_settled_service_does_not_give_way_and_says_so() -> None:
    topic = Topic()
    service = topic.service()
    topic.run(SETTLED + YOUNG, service)
    forger = topic.stranger()
    topic.run(30.0, service)
    assert service.publisher is not None
    assert service.problem == STRANGER
    del topic.publishers[forger]
    topic.run(1.0, service)
    assert service.problem == ""


def test_one_that_gives_way_says_so_first() -> None:
    topic = Topic()
    service = topic.service()
    topic.run(SETTLED + YOUNG, service)
    topic.stranger("quadid")
    topic.run(1.0, service)
    assert (service.publisher is not None, service.problem) == (True, BESIDE)
    topic.run(5.0, service)
    assert (service.publisher, service.problem) == (None, OBSERVES)
