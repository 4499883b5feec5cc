"""Any order of samples, fits, commands, restarts: every published set was approved, bounded and journalled.

Session, gate, ledger, service and SQLite are real.  The fit process is the adversary: it answers with any estimate.
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)
from quadid_node.history import Store, read_history
from quadid_node.messages import Output
from quadid_node.service import Service
from quadid_node.worker import InlineWorker, Trouble

from quadid.online import FitReply, FitRequest, GateSettings, Publish, SessionSettings, SetState
from quadid.online.records import Job, JobReply, OnlineSet
from quadid.parameters import NOMINAL_NAMES, impossible_inertia
from quadid.vehicle import Vehicle
from tests.faults.evidence import Happened
from tests.online.driving import flight, samples
from tests.online.made_up import NOISE, told
from tests.online.test_gate import TRUE
from tests.samples import Sample

PELICAN = Vehicle.shipped("pelican")
GATE = GateSettings(windows=2, width=0.15, yaw_width=0.6)
SETTINGS = SessionSettings(window=4.0, refit=2.0, diagnose=0.0, gate=GATE)
NEEDED = ("gyro", "accel", "attitude", "rotor_speed")
CONTROLLER = ("b", "J_xx", "J_yy")
MEMORY = "/dev/shm" if Path("/dev/shm").is_dir() else None
"""Every step waits for the history, which a crowded disk would make minutes of."""


@lru_cache(maxsize=1)
def stream() -> list[Sample]:
    return [s for s in samples(flight(40.0, 6).recording) if s.channel in NEEDED]


class Adversary(InlineWorker):
    """In place of the fit process: keeps requests until the test lets it answer."""

    def __init__(self) -> None:
        self.asked: list[Job] = []
        self.answers: list[JobReply | Trouble] = []

    def submit(self, request: Job) -> None:
        self.asked.append(request)

    def poll(self) -> list[JobReply | Trouble]:
        answers, self.answers = self.answers, []
        return answers

    def sibling(self) -> Adversary:
        return Adversary()


def estimate(request: FitRequest, factors: dict[str, float], sigma: float) -> FitReply:
    values = np.array([TRUE[n] * factors.get(n, 1.0) for n in NOMINAL_NAMES])
    with np.errstate(invalid="ignore"):
        z = np.log(values)
    window = told(request, z, sigma)
    theta = request.theta.copy()
    theta[:6] = values
    return FitReply(request.number, "", np.full(6, sigma), True, window, theta, NOISE)


class Machine(RuleBasedStateMachine):
    """Any order of events around one vehicle."""

    tally: dict[str, int] = {}

    @initialize(approval=st.sampled_from(["auto", "auto", "manual"]))
    def start(self, approval: str) -> None:
        self.folder = tempfile.TemporaryDirectory(dir=MEMORY)
        self.path = Path(self.folder.name) / "history.sqlite"
        self.settings = SETTINGS.model_copy(update={"gate": GATE.model_copy(update={"approval": approval})})
        self.factors = dict.fromkeys(NOMINAL_NAMES, 1.0)
        self.published: list[OnlineSet] = []
        self.t, self.place = 1000.0, 0
        self.begin()
        self.fly(12.0)

    def begin(self) -> None:
        self.worker = Adversary()
        self.store = Store(self.path, "pelican")
        self.service = Service(PELICAN, self.settings, self.worker, self.store)
        self.ledger = self.service.session.active_set
        self.previous = self.ledger.in_force
        self.step()

    # --- what arrives

    def push(self, seconds: float, spoil: Callable[[Sample], Sample]) -> None:
        every = stream()
        begin, end = every[self.place].t, every[self.place].t + seconds
        while self.place < len(every) and every[self.place].t < end:
            sample = every[self.place]
            self.place += 1
            self.service.push(spoil(sample._replace(t=sample.t - begin + self.t)).block)
        self.t += seconds
        if self.place >= len(every) - 2500:
            self.place = 0
        self.step()

    @rule(seconds=st.sampled_from([4.0, 8.0, 12.0]))
    def fly(self, seconds: float) -> None:
        for _ in range(round(seconds / 2.0)):
            self.push(2.0, lambda s: s)
            if self.service.session.running is not None:
                self.fit("as it is", 0.005)

    @rule(channel=st.sampled_from(NEEDED), value=st.sampled_from([math.nan, math.inf, 0.0, -1.0, 57.3, 1e9]))
    def fly_with_a_broken_sensor(self, channel: str, value: float) -> None:
        def spoil(sample: Sample) -> Sample:
            if sample.channel != channel:
                return sample
            return sample._replace(values=tuple(v * value for v in sample.values))

        self.push(1.0, spoil)

    @rule(step=st.sampled_from([-5000.0, -2.0, 3.0, 40.0, 1e12, math.nan]))
    def clock_steps(self, step: float) -> None:
        self.push(0.5, lambda s: s._replace(t=s.t + step))
        if abs(step) < 100.0:
            self.t += max(step, 0.0)

    @rule(name=st.sampled_from(NOMINAL_NAMES), factor=st.sampled_from([0.97, 1.03, 1.08, 1.3, 2.0, 4.0, 0.25, -1.0]))
    def vehicle_as_the_fits_tell_it(self, name: str, factor: float) -> None:
        self.factors[name] = 1.0 if abs(self.factors[name]) > 50.0 else self.factors[name] * factor

    @rule()
    def fits_tell_the_truth_again(self) -> None:
        self.factors = dict.fromkeys(NOMINAL_NAMES, 1.0)

    def waiting(self) -> bool:
        return hasattr(self, "service") and self.service.session.running is not None

    @precondition(waiting)
    @rule(
        kind=st.sampled_from(["as it is", "failed", "not a number", "another number"]),
        sigma=st.sampled_from([0.003, 0.02, 0.3]),
    )
    def fit(self, kind: str, sigma: float) -> None:
        request = self.worker.asked[-1]
        if kind == "failed" or not isinstance(request, FitRequest):
            reply: JobReply = request.failed("the fit process died")
        else:
            reply = estimate(request, self.factors, sigma)
            if kind == "not a number":
                reply = estimate(request, {"b": math.nan, "J_xx": math.inf}, sigma)
            elif kind == "another number":
                reply = replace(reply, number=request.number - 1)
        self.worker.answers.append(reply)
        self.step()

    # --- what people do

    @rule(number=st.sampled_from([None, None, 0, 1, 5]), old=st.booleans())
    def approve(self, number: int | None, old: bool) -> None:
        pending, waiting = self.ledger.pending, set(self.ledger._held)
        if old and pending is not None and number is not None:
            number = pending.sequence - 1
        answer = self.service.approve("ann", number)
        assert answer.done == (pending is not None and (number is None or number in waiting))
        assert not self.service.approve("ann", number).done, "approving twice does nothing"
        self.step()

    @rule()
    def roll_back(self) -> None:
        before = self.ledger.predecessor
        answer = self.service.roll_back("bob")
        assert answer.done == (before is not None)
        if before is not None and self.ledger.in_force is not None:
            assert self.ledger.in_force.parameters.values.tobytes() == before.parameters.values.tobytes()
            assert self.ledger.approval == "manual"
        self.step()

    @rule(approval=st.sampled_from(["auto", "auto", "manual"]))
    def set_approval(self, approval: str) -> None:
        self.ledger.approval = approval

    @rule()
    def fit_now(self) -> None:
        self.service.session.fit_now()

    @rule()
    def restart(self) -> None:
        last = self.ledger.in_force
        self.close()
        self.check_journal()
        self.begin()
        again = self.ledger.in_force
        assert (again is None) == (last is None)
        if last is not None and again is not None:
            assert again.state is SetState.STALE
            assert again.sequence > last.sequence
            assert again.parameters.values.tobytes() == last.parameters.values.tobytes()

    def close(self) -> None:
        self.store.close(60.0)  # in service 1.5 s, which a crowded disk may exceed
        self.service.close()

    # --- what must hold

    def step(self) -> None:
        outputs = self.service.step()
        assert self.store.flush(60.0)
        for output in outputs + self.service.idle():
            self.judge(output)

    def judge(self, output: Output) -> None:
        if not isinstance(output, Publish) or output.topic != "parameters":
            return
        item, gate = output.item, self.settings.gate
        values = {p.name: p.value for p in item.parameters}
        assert item.approved_by, "published without approval"
        assert item.approved_by in ("auto", "ann", "bob")
        for p in item.parameters:
            assert math.isfinite(p.value)
            assert p.bounds[0] <= p.value <= p.bounds[1]
            assert p.value > 0.0
        assert impossible_inertia([values[n] for n in ("J_xx", "J_yy", "J_zz")], gate.inertia_slack) is None
        if item.state is SetState.ACCEPTED:
            self.judge_accepted(item)
        else:
            assert item.state in (SetState.ROLLED_BACK, SetState.STALE)
        if self.published and item.state is not SetState.STALE:
            assert item.sequence > self.published[-1].sequence, "numbers rise"
        self.published.append(item)
        self.previous = item
        self.tally[item.state.value] = self.tally.get(item.state.value, 0) + 1

    def judge_accepted(self, item: OnlineSet) -> None:
        if item.outdated and self.previous is not None:  # the set in force again, whoever is to approve the next one
            assert item.parameters.values.tobytes() == self.previous.parameters.values.tobytes()
            return
        by_person = item.approved_by != "auto"
        assert by_person or self.ledger.approval == "auto", "published unasked while a person is to approve"
        if self.previous is None:
            return
        room = (2.0 if by_person else 1.0) * self.settings.gate.step
        for name in CONTROLLER:
            new, old = item.parameters[name], self.previous.parameters[name]
            allowed = math.log1p(room + 2.0 * self.previous.told_by_flight(name) / old.value) + 1e-9
            assert abs(math.log(new.value / old.value)) <= allowed, f"{name} jumps"

    @invariant()
    def what_is_in_force_was_published(self) -> None:
        if hasattr(self, "ledger") and self.ledger.in_force is not None:
            assert self.published
            assert self.ledger.in_force.sequence == self.published[-1].sequence

    def check_journal(self) -> None:
        rows = {(s["sequence"], s["state"]): s for s in read_history(self.path, "pelican")["sets"]}
        for item in self.published:
            if item.state is SetState.STALE:
                continue
            row = rows[item.sequence, item.state.value]
            assert row["approved_by"] == item.approved_by
            assert [p["value"] for p in row["parameters"]] == list(item.parameters.values)

    def teardown(self) -> None:
        if hasattr(self, "service"):
            self.close()
            self.check_journal()
            self.folder.cleanup()


def test_a_fit_that_gives_no_numbers_spoils_nothing(happened: Happened) -> None:
    machine = Machine()
    machine.start("auto")
    machine.push(4.0, lambda s: s)
    machine.fit("not a number", 0.005)
    assert "no numbers" in machine.service.session.status().reason
    machine.fly(12.0)
    assert machine.published
    assert math.isfinite(machine.published[-1].parameters["b"].value)
    happened(11, "a fit process that answers NaN and infinity is told as failed; the next windows give a set as ever")
    machine.teardown()


def check(examples: int, happened: Happened) -> None:
    Machine.tally = {}
    run_state_machine_as_test(
        Machine,
        settings=settings(
            max_examples=examples, stateful_step_count=30, deadline=None, suppress_health_check=list(HealthCheck)
        ),
    )
    told = ", ".join(f"{n} {state}" for state, n in sorted(Machine.tally.items()))
    happened(
        19,
        f"{examples} random histories of 30 events (broken sensors, hostile fits, commands, restarts): sets published "
        f"{told}; each approved, in bounds, journalled; second approvals and old numbers did nothing",
    )
    assert Machine.tally.get("accepted", 0) > examples // 4, "the machine must get sets through at all"


def test_no_published_set_was_unapproved_out_of_bounds_or_without_a_journal_row(happened: Happened) -> None:
    check(6, happened)


@pytest.mark.slow
@pytest.mark.timeout(1800)
def test_the_same_with_many_more_histories(happened: Happened) -> None:
    check(150, happened)
