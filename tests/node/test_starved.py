"""A service on a machine that is too slow says so, leaves fits out, looks for changes first, tells nothing false."""

import math
from collections.abc import Sequence

import pytest
from quadid_node.messages import BEHIND, Output, diagnostics, fit_status, set_to_dict
from quadid_node.service import PATIENCE, Service
from quadid_node.worker import InlineWorker, Trouble

from quadid.online import FitRequest
from quadid.online.change_job import AFTER_CHANGE
from quadid.online.records import Event, Job, JobReply, OnlineDiagnosis, Publish
from tests.faults.evidence import Happened
from tests.online.made_up import DROPPED, PELICAN, QUICK, light_flight, tells
from tests.samples import Sample

NOW = [0.0]


class Slow(InlineWorker):
    """Fits that take some seconds of the test's own clock; `math.inf`: for ever."""

    def __init__(self, seconds: float) -> None:
        super().__init__()
        self.seconds, self.begun, self.asked = seconds, 0.0, 0
        self._work = tells()

    def submit(self, request: Job) -> None:
        """Begins; what was asked before is forgotten."""
        self._waiting, self.begun, self.asked = [request], NOW[0], self.asked + 1

    def poll(self) -> list[JobReply | Trouble]:
        """The reply when its time has come."""
        if not self._waiting or NOW[0] - self.begun < self.seconds:
            return []
        (job,), self._waiting = self._waiting, []
        reply = self._work(job)
        return [reply] if reply is not None else []


def served(stream: Sequence[Sample], worker: InlineWorker, late: float = math.inf) -> tuple[Service, list[Output]]:
    """A service in step with its data, by the test's own clock; from `late` on [s] rounds take twice as long each."""
    NOW[0] = 0.0
    service, out, due, rounds = Service(PELICAN, QUICK, worker, clock=lambda: NOW[0]), list[Output](), 0.0, 0
    for sample in stream:
        NOW[0] = sample.t
        service.push(sample.block)
        if sample.t >= due:
            out += service.step()
            rounds += sample.t >= late
            due = sample.t + 0.02 * 2**rounds
    return service, out


def test_data_that_come_late_and_all_at_once_are_no_backlog() -> None:
    NOW[0] = 0.0
    service = Service(PELICAN, QUICK, Slow(0.1), clock=lambda: NOW[0])
    for k, sample in enumerate(light_flight(20.0)):
        service.push(sample.block)
        if k % 600 == 599:  # three seconds of the publisher's, while the service looked all the time
            for _ in range(30):
                NOW[0] += 0.1
                assert not said(service.step(), "behind")
            assert service.health().status.backlog < 1.0


def test_a_status_holds_the_longest_round_of_its_second() -> None:
    """A status is made after a round of every second, the same one each time: others went by unseen."""
    NOW[0] = 0.0
    service, seen = Service(PELICAN, QUICK, InlineTells(), clock=lambda: NOW[0]), list[float]()
    for wait in (0.1, 0.1, 0.7, *[0.1] * 11):
        NOW[0] += wait
        service.step()
        seen.append(round(service.health().status.backlog, 9))
    assert seen[2:12] == [0.7] * 10
    assert seen[-1] == 0.1, "and no longer"


def said(outputs: list[Output], kind: str) -> list[Event]:
    return [o for o in outputs if isinstance(o, Event) and o.kind == kind]


@pytest.mark.parametrize("seconds", [0.3, 3.5, 8.0, math.inf])
def test_a_session_never_waits_long_for_a_fit(seconds: float, happened: Happened) -> None:
    worker = Slow(seconds)
    service, outputs = served(light_flight(40.0), worker)
    status = service.session.status()
    assert status.backlog <= PATIENCE + 1.0
    sets = [o for o in outputs if isinstance(o, Publish) and o.topic == "parameters"]
    if seconds < PATIENCE:
        reference = served(light_flight(40.0), InlineTells())[1]
        assert sets
        assert [set_to_dict(o.item) for o in sets] == [
            set_to_dict(o.item) for o in reference if isinstance(o, Publish) and o.topic == "parameters"
        ]
        assert status.skipped == 0
    else:
        assert status.skipped > 5
        assert bool(status.fits) == math.isfinite(seconds), "late ones count when they come"
    assert not said(outputs, "change")
    happened(
        11, f"fits of {seconds:g} s every second: at most {status.backlog:.1f} s behind, {status.skipped} left out"
    )


def test_one_slow_fit_does_not_end_all_others() -> None:
    """A fit process that is killed answers seconds late, once; a service that hurried then once never fitted again."""
    worker = Slow(0.0)
    NOW[0] = 0.0
    service = Service(PELICAN, QUICK, worker, clock=lambda: NOW[0])
    sets = list[Output]()
    for k, sample in enumerate(light_flight(30.0)):
        NOW[0] = sample.t
        worker.seconds = 5.0 if worker.asked == 2 else 0.1
        service.push(sample.block)
        if k % 4 == 3:
            sets += [o for o in service.step() if isinstance(o, Publish) and o.topic == "parameters"]
    status = service.session.status()
    assert 3 <= status.skipped <= 8
    assert status.fits > 12
    assert sets


class InlineTells(InlineWorker):
    """Answers at once."""

    def poll(self) -> list[JobReply | Trouble]:
        """All that waits."""
        waiting, self._waiting = self._waiting, []
        return [reply for job in waiting if (reply := tells()(job)) is not None]


@pytest.mark.parametrize("seconds", [3.5, math.inf])
def test_a_change_is_seen_and_the_set_withdrawn_while_fits_take_for_ever(seconds: float, happened: Happened) -> None:
    quick = Slow(0.0)
    NOW[0] = 0.0
    service, out = Service(PELICAN, QUICK, quick, clock=lambda: NOW[0]), list[Output]()
    for k, sample in enumerate(DROPPED):
        NOW[0] = sample.t
        quick.seconds = seconds if sample.t > 13.0 else 0.0
        service.push(sample.block)
        if k % 4 == 3:
            new = service.step()
            out += new
            if any(isinstance(o, Publish) and o.item.outdated for o in new):
                break
    (change,) = said(out, "change")
    assert "thrust stepped" in change.text
    assert NOW[0] < 14.3 + AFTER_CHANGE + 1.5, "data after it, the next tick, and no wait for a fit"
    assert service.session.active_set.in_force is not None
    assert service.session.active_set.in_force.outdated
    named = [f.effect for o in out if isinstance(o, OnlineDiagnosis) for f in o.findings]
    assert named in (["thrust_drop"], ["mass_change"]), "what it was needs no fit"
    happened(11, f"thrust lost at 14.3 s while fits take {seconds:g} s: set marked out of date at {NOW[0]:.1f} s")


def test_an_estimate_of_before_a_change_that_comes_late_is_not_taken() -> None:
    """The fit begun before the change ends after it was seen."""
    worker = Slow(0.0)
    NOW[0] = 0.0
    service, late = Service(PELICAN, QUICK, worker, clock=lambda: NOW[0]), None
    for k, sample in enumerate(DROPPED):
        NOW[0] = sample.t
        worker.seconds = 0.0 if sample.t < 13.9 else math.inf
        service.push(sample.block)
        if k % 4 == 3:
            service.step()
            if late is None and service.session._overdue:
                late = service.session.running
            if service.session._changes.seen is not None:
                break
    assert isinstance(late, FitRequest)
    fits = service.session.status().fits
    reply = tells(b=3.0)(late)
    assert reply is not None
    service.session.deliver(reply)
    outputs = service.step()
    assert service.session.status().fits == fits
    assert not [o for o in outputs if isinstance(o, Publish)]


def test_a_service_that_falls_behind_says_so_everywhere(happened: Happened) -> None:
    service, outputs = served(light_flight(30.0), InlineTells(), late=10.0)
    told = said(outputs, "behind")
    assert told[0].level == "warning"
    assert "behind the data, the machine is too slow" in told[0].text
    assert len(told) <= 6, "at every doubling, not at every second"
    health = service.health()
    assert health.status.backlog > BEHIND
    assert "behind the data" in fit_status(health.status, "v")["reason"]
    entry = diagnostics(health, "n", "v", {"sec": 0, "nanosec": 0}, {}, {})["status"][0]
    assert entry["level"] == b"\x01"
    assert "behind the data" in entry["message"]
    late = service.step()
    late += service.step()
    assert said(late, "behind")[-1].text == "caught up with the data"
    assert not said([*outputs, *late], "change")
    happened(
        11, f"a session {health.status.backlog:.0f} s behind: '{told[0].text}', then '{said(late, 'behind')[-1].text}'"
    )
