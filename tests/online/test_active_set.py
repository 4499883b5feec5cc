"""The ledger: numbers rise, approvals and rollbacks are idempotent, nothing unapproved is ever in force."""

import math
from dataclasses import replace

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from quadid.online.gate import MOST_HELD, ActiveSet, Answer
from quadid.online.records import WAITS, Event, Publish, SetState
from tests.online.test_gate import TRUE, online_set


def test_approving_twice_and_an_old_number_do_nothing() -> None:
    ledger = ActiveSet("manual")
    held = ledger.hold(online_set(TRUE), 30.0)
    assert not ledger.approve(1.0, "ann", sequence=held.sequence + 5).done
    assert ledger.approve(1.0, "ann", sequence=held.sequence).done
    in_force = ledger.in_force
    assert not ledger.approve(1.0, "ann").done
    assert ledger.in_force is in_force
    assert in_force is not None
    assert in_force.approved_by == "ann"


def test_rollback_returns_the_earlier_values_under_a_new_number() -> None:
    ledger = ActiveSet("auto")
    ledger.accept(online_set(TRUE), "auto", 30.0, 30.0)
    ledger.accept(online_set({**TRUE, "b": 2.4e-5}), "auto", 60.0, 60.0)
    answer = ledger.roll_back(61.0, "bob")
    assert answer.done
    assert ledger.in_force is not None
    assert ledger.in_force.parameters["b"].value == TRUE["b"]
    assert (ledger.in_force.state, ledger.in_force.sequence) == (SetState.ROLLED_BACK, 3)
    assert ledger.approval == "manual"
    assert not ledger.roll_back(62.0, "bob").done


@pytest.mark.parametrize("by", ["ann", "auto"])
def test_a_rollback_after_a_change_brings_no_set_from_before_it_back_as_good(by: str) -> None:
    sets = ActiveSet("auto")
    sets.accept(online_set(TRUE), "auto", 1.0, 1.0)
    sets.accept(online_set({**TRUE, "b": 2.34e-5}), "auto", 2.0, 2.0)
    sets.withdraw("mass +15 %", "mass_change")
    action = sets.roll_back(3.0, by).actions[0]
    assert isinstance(action, Publish)
    assert (action.item.parameters["b"].value, action.item.outdated) == (TRUE["b"], "mass +15 %")


def test_a_restored_set_is_stale_and_numbers_go_on() -> None:
    ledger = ActiveSet("auto", restored=online_set(TRUE), next_sequence=9)
    assert ledger.in_force is not None
    assert ledger.in_force.state is SetState.STALE
    assert ledger.in_force.sequence == 9, "a number of its own, so that who knows the set learns that it is stale"
    ledger.accept(online_set(TRUE), "auto", 30.0, 30.0)
    assert ledger.in_force.sequence == 10
    assert not ledger.roll_back(31.0, "bob").done, "a stale set is nothing to return to"


def test_losses_to_the_predecessor_add_up_and_gains_do_not() -> None:
    ledger = ActiveSet("auto")
    ledger.accept(online_set(TRUE), "auto", 30.0, 30.0)
    assert not ledger.watch(29.5, 39.5, 5.0), "a window that the set has seen"
    assert ledger.watched == 0.0
    assert ledger.watch(30.0, 40.0, 5.0)
    assert not ledger.watch(35.0, 45.0, 5.0), "half of it was counted"
    assert ledger.watch(40.0, 50.0, 7.0)
    assert ledger.watched == 12.0
    assert ledger.watch(50.0, 60.0, -100.0)
    assert ledger.watched == 0.0


def test_every_answer_says_what_was_done_and_every_change_is_an_event() -> None:
    """With words and stamps: they are what the history keeps."""
    ledger = ActiveSet("manual")
    assert ledger.approve(1.0, "ann") == Answer(False, "nothing waits for approval")
    assert ledger.roll_back(1.0, "ann") == Answer(False, "there is no earlier set to return to")
    waits = ledger.hold(replace(online_set(TRUE), reason=f"{WAITS}3 windows agree"), 30.0)
    assert ledger.approve(1.0, "ann", 7) == Answer(False, "set 7 does not wait for approval; the newest that does is 1")
    told = ledger.approve(31.0, "ann")
    first = ledger.in_force
    assert first is not None
    assert (first.reason, first.approved_by, ledger.seen) == ("approved by ann: 3 windows agree", "ann", 30.0)
    assert told.done is True
    assert told.text == f"set {waits.sequence} approved, in force as set 2"
    event = Event(31.0, "info", "accepted", f"set 2 in force (reference: none): {first.reason}")
    assert told.actions == (Publish("parameters", first), event)
    ledger.accept(online_set({**TRUE, "b": 2.4e-5}), "auto", 60.0, 60.0)
    back = ledger.roll_back(61.0, "bob")
    reason = "set 2 again, in place of set 3: asked for by bob"
    assert ledger.in_force is not None
    assert (ledger.in_force.reason, ledger.in_force.approved_by) == (reason, "bob")
    event = Event(61.0, "warning", "rollback", reason)
    assert back == Answer(True, reason, (Publish("parameters", ledger.in_force), event))


def test_a_rollback_by_itself_keeps_the_approval_and_the_baseline() -> None:
    ledger = ActiveSet("auto")
    ledger.accept(online_set(TRUE), "auto", 30.0, 30.0)
    ledger.accept(online_set({**TRUE, "b": 2.4e-5}), "auto", 60.0, 60.0)
    baseline = ledger.baseline
    assert ledger.roll_back(61.0, "auto", "it predicts worse").text.endswith("set 2: it predicts worse")
    assert ledger.approval == "auto"
    assert ledger.baseline is baseline


def test_a_restored_set_says_where_it_is_from_and_is_the_baseline() -> None:
    ledger = ActiveSet("auto", restored=replace(online_set(TRUE), reason="3 windows agree"))
    assert ledger.in_force is not None
    assert ledger.in_force.reason == "from an earlier run (3 windows agree): not yet confirmed by this flight"
    assert ledger.baseline is ledger.in_force
    assert (ledger.seen, ledger.watched) == (-math.inf, 0.0)
    ledger.accept(online_set(TRUE), "auto", 30.0, 30.0)
    assert ledger.in_force.sequence == 3, "the restored set's is 2: one more than it had"
    approved = replace(online_set(TRUE), sequence=5)
    assert ActiveSet("auto", restored=online_set(TRUE), baseline=approved).baseline is approved


def test_creeping_is_measured_from_the_first_set_or_the_last_one_a_person_approved() -> None:
    ledger = ActiveSet("auto")
    ledger.accept(online_set(TRUE), "auto", 30.0, 30.0)
    first = ledger.in_force
    assert ledger.baseline is first
    ledger.accept(online_set(TRUE), "auto", 60.0, 60.0)
    assert ledger.baseline is first
    ledger.accept(online_set(TRUE), "ann", 90.0, 90.0)
    assert ledger.baseline is ledger.in_force


def test_a_number_stands_for_one_waiting_set_for_ever() -> None:
    ledger = ActiveSet("manual")
    older, newer = (ledger.hold(online_set({**TRUE, "b": b}), 30.0) for b in (2.3e-5, 2.4e-5))
    assert (older.sequence, newer.sequence) == (1, 2)
    assert ledger.pending is newer
    assert newer.state is SetState.PENDING
    assert ledger.approve(31.0, "ann", 1).done, "the one that the person saw, though a newer one waits"
    assert ledger.in_force is not None
    assert ledger.in_force.parameters["b"].value == 2.3e-5
    assert ledger.in_force.sequence == 3
    assert ledger.pending is None
    assert not ledger.approve(31.0, "ann", 2).done, "it has not waited since"


def test_the_sets_of_the_last_minute_can_be_approved() -> None:
    ledger = ActiveSet("manual")
    for k in range(MOST_HELD + 1):
        ledger.hold(online_set(TRUE), float(k))
    assert not ledger.approve(99.0, "ann", 1).done
    assert ledger.approve(99.0, "ann", 2).done


def test_twenty_sets_can_be_taken_back() -> None:
    ledger = ActiveSet("auto")
    for k in range(25):
        ledger.accept(online_set(TRUE), "auto", float(k), float(k))
    assert [ledger.roll_back(30.0, "auto").done for _ in range(21)] == [True] * 20 + [False]


def test_a_set_that_waits_can_be_dropped() -> None:
    ledger = ActiveSet("manual")
    ledger.hold(online_set(TRUE), 30.0)
    ledger.drop_pending()
    assert ledger.pending is None
    assert not ledger.approve(31.0, "ann").done


class Machine(RuleBasedStateMachine):
    """Any order of commands."""

    @initialize(approval=st.sampled_from(["auto", "manual"]))
    def start(self, approval: str) -> None:
        self.ledger = ActiveSet(approval)
        self.numbers: list[int] = []
        self.held: set[int] = set()
        self.t = 0.0

    def publish(self, actions: tuple[object, ...] | list[object]) -> None:
        for action in actions:
            if isinstance(action, Publish):
                self.held.clear()
                assert action.item.approved_by
                assert action.item.state in (SetState.ACCEPTED, SetState.ROLLED_BACK)
                self.numbers.append(action.item.sequence)

    @rule()
    def estimate(self) -> None:
        self.t += 1.0
        if self.ledger.approval == "auto":
            self.publish(list(self.ledger.accept(online_set(TRUE), "auto", self.t, self.t)))
        else:
            self.held.add(self.ledger.hold(online_set(TRUE), self.t).sequence)

    @rule(number=st.none() | st.integers(0, 30))
    def approve(self, number: int | None) -> None:
        waiting = self.held and (number is None or number in self.held)
        answer = self.ledger.approve(self.t, "ann", number)
        assert answer.done == bool(waiting)
        self.publish(answer.actions)

    @rule(by=st.sampled_from(["auto", "bob"]))
    def roll_back(self, by: str) -> None:
        had = self.ledger.predecessor
        answer = self.ledger.roll_back(self.t, by)
        assert answer.done == (had is not None)
        self.publish(answer.actions)

    @rule(loss=st.floats(-100.0, 100.0))
    def watch(self, loss: float) -> None:
        self.ledger.watch(self.t, self.t + 10.0, loss)
        assert self.ledger.watched >= 0.0

    @invariant()
    def numbers_rise(self) -> None:
        if hasattr(self, "numbers"):
            assert self.numbers == sorted(set(self.numbers))
            force = self.ledger.in_force
            assert (force.sequence if force else 0) == (self.numbers[-1] if self.numbers else 0)


Machine.TestCase.settings = settings(max_examples=60, stateful_step_count=30)
TestMachine = Machine.TestCase


def test_a_set_known_to_be_out_of_date_says_so_once_under_a_number_of_its_own() -> None:
    sets = ActiveSet("manual")
    assert sets.withdraw("mass changed", "mass_change") == [], "there is nothing to withdraw"
    sets.accept(online_set(TRUE), "ann", 1.0, 1.0)
    before = sets.in_force
    assert before is not None
    (action,) = sets.withdraw("mass changed", "mass_change")
    assert isinstance(action, Publish)
    assert (action.item.outdated, action.item.state) == ("mass changed", SetState.ACCEPTED)
    assert action.item.outdated_code == "mass_change"
    assert action.item.sequence > before.sequence
    assert sets.withdraw("again", "mass_change") == []
    sets.accept(online_set(TRUE), "ann", 2.0, 2.0)
    assert sets.in_force is not None
    assert not sets.in_force.outdated
