"""A child that starts is given up when it stands still, not when a slow machine makes it compile for long."""

from __future__ import annotations

import os
import subprocess
import sys
import time

import pytest
from quadid_node.worker import STILL, WORK, WarmUp, processor_seconds

from quadid_node import worker as warm_up
from tests.faults.evidence import Happened


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> dict[str, float | None]:
    """Time on the clock, and processor time that the watched child has used so far."""
    told: dict[str, float | None] = {"now": 0.0, "used": 0.0}
    monkeypatch.setattr(warm_up, "processor_seconds", lambda pid: told["used"])
    return told


def watch(work: dict[str, float | None]) -> WarmUp:
    return WarmUp(1, lambda: work["now"] or 0.0)


def test_a_child_that_works_may_take_its_time(work: dict[str, float | None]) -> None:
    child = watch(work)
    for step in range(1, 30):  # a busy machine: two per cent of a core
        work.update(now=100.0 * step, used=2.0 * step)
        assert child.given_up() == ""


def test_a_child_that_stands_still_or_never_ends_is_given_up(work: dict[str, float | None]) -> None:
    child = watch(work)
    work.update(now=10.0, used=3.0)
    assert child.given_up() == ""
    work["now"] = 10.5 + STILL
    assert "idle" in child.given_up()
    work["used"] = WORK + 1.0
    assert "of work" in child.given_up()


def test_a_child_that_hangs_and_only_wakes_up_now_and_then_is_given_up(
    work: dict[str, float | None], happened: Happened
) -> None:
    """Threads that wait use a tick of the processor a minute: it once kept a child for hours."""
    child = watch(work)
    given_up_at = 0
    while not child.given_up():
        given_up_at += 10
        work.update(now=float(given_up_at), used=3e-4 * given_up_at)
    assert STILL < given_up_at <= STILL + 10
    happened(30, f"a child that only wakes up now and then is given up after {given_up_at} s, {STILL:g} s are promised")


def test_where_the_system_tells_nothing_the_clock_decides(work: dict[str, float | None]) -> None:
    work["used"] = None
    child = watch(work)
    work["now"] = STILL - 1.0
    assert child.given_up() == ""
    work["now"] = STILL + 1.0
    assert "not ready" in child.given_up()


def test_processor_time_is_that_of_the_process() -> None:
    if not sys.platform.startswith("linux"):
        pytest.skip("/proc is Linux's")
    own = processor_seconds(os.getpid())
    assert own == pytest.approx(time.process_time(), abs=0.5)
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        assert processor_seconds(child.pid) is not None
    finally:
        child.kill()
        child.wait()
    assert processor_seconds(child.pid) is None
