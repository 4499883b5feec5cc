"""The fit process, killed, stopped and starved; the service lives and says so."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator

import pytest
from quadid_node.worker import FIT_LIMIT, STILL, WORK, InlineWorker, ProcessWorker, Trouble, WarmUp, processor_seconds

from quadid.online import FitReply, FitRequest, Session, SessionSettings
from quadid.vehicle import Vehicle
from quadid_node import worker as working
from tests.faults.evidence import Happened
from tests.node.peers import until
from tests.online.driving import flight, samples

PELICAN = Vehicle.shipped("pelican")
QUICK = SessionSettings(window=5.0)


@pytest.fixture(scope="module")
def requests() -> list[FitRequest]:
    """Two fit requests of a real session."""
    session, out = Session(PELICAN, QUICK), []
    for sample in samples(flight(12.0, 6).recording):
        session.push(sample.block)
    for _ in range(2):
        session.poll()
        request = session.running
        assert isinstance(request, FitRequest)
        out.append(request)
        (reply,) = answers(InlineWorker(), request)
        session.deliver(reply)
    return out


def answers(worker: InlineWorker | ProcessWorker, request: FitRequest) -> list[FitReply]:
    """Submits a request and waits for its answer."""
    worker.submit(request)
    return wait(worker)[0]


def wait(
    worker: InlineWorker | ProcessWorker, say: Callable[[], object] = lambda: None
) -> tuple[list[FitReply], list[Trouble]]:
    """Polls until there is an answer; returns it and what was told meanwhile."""
    out: list[object] = []

    def replies() -> list[FitReply]:
        out.extend(worker.poll())
        return [o for o in out if isinstance(o, FitReply)]

    assert until(replies, say), out
    return replies(), [o for o in out if isinstance(o, Trouble)]


@pytest.fixture
def worker() -> Iterator[ProcessWorker]:
    """A warm worker."""
    made = warm(ProcessWorker(PELICAN))
    yield made
    made.close()
    assert made.pid == 0


def warm(worker: ProcessWorker) -> ProcessWorker:
    """The worker, once its kernels are warm."""
    assert until(lambda: worker.poll() != [] or worker.ready)
    assert worker.ready
    return worker


def same(a: FitReply, b: FitReply) -> bool:
    (one,), (other,) = a.estimates, b.estimates
    return one.z.tobytes() == other.z.tobytes() and one.cost == other.cost


def test_a_child_gives_what_inline_gives_bit_for_bit(worker: ProcessWorker, requests: list[FitRequest]) -> None:
    for request in requests:
        (there,) = answers(worker, request)
        (here,) = answers(InlineWorker(), request)
        assert same(there, here)


def test_a_warm_process_holds_every_kernel_of_a_fit() -> None:
    """Two seconds of made-up flight call them all; a fit of a real one loads none."""
    script = (
        "from quadid.app.kernels import PARTS\n"
        "from quadid.online.fit_job import warm_up\n"
        "from tests.online.driving import drive, flight, samples, Session, Vehicle\n"
        "kernels = [kernel for name in ('simulation', 'estimate') for kernel in PARTS[name].kernels()]\n"
        "count = lambda: [len(kernel.signatures) for kernel in kernels]\n"
        "warm_up(Vehicle.shipped('pelican'))\n"
        "warm = count()\n"
        "assert any(drive(Session(Vehicle.shipped('pelican')), samples(flight(11.0, 6).recording)))\n"
        "assert count() == warm, (count(), warm)\n"
        "assert sum(warm) >= len(kernels) - 1, 'all but the closed loop'\n"
    )
    subprocess.run([sys.executable, "-c", script], check=True, timeout=900)


def test_a_child_is_polite(worker: ProcessWorker) -> None:
    assert os.getpriority(os.PRIO_PROCESS, worker.pid) >= 10
    cores = os.sched_getaffinity(worker.pid)
    assert len(cores) < max(os.cpu_count() or 1, 2)
    with open(f"/proc/{worker.pid}/limits") as limits:
        data = next(line for line in limits if line.startswith("Max data size"))
    assert str(working.MEMORY_MB << 20) in data


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGSEGV])
def test_a_killed_child_is_replaced_and_the_fit_done(
    worker: ProcessWorker, requests: list[FitRequest], number: signal.Signals, happened: Happened
) -> None:
    worker.submit(requests[0])
    os.kill(worker.pid, number)
    (reply,), told = wait(worker)
    assert reply.estimates
    assert worker.restarts == 1
    assert any(f"signal {number.value}" in t.text for t in told)
    happened(11, f"fit process ended by {number.name}: replaced, the same window fitted, said")


def test_a_stopped_child_is_replaced(requests: list[FitRequest], happened: Happened) -> None:
    ahead = [0.0]
    worker = warm(ProcessWorker(PELICAN, clock=lambda: ahead[0] + time.monotonic()))
    old = worker.pid
    os.kill(old, signal.SIGSTOP)
    worker.submit(requests[0])
    assert (worker.poll(), worker.pid) == ([], old), "a child that does not read must not hold up its parent"
    ahead[0] = FIT_LIMIT
    (reply,), told = wait(worker)
    assert reply.estimates
    assert worker.pid not in (0, old)
    assert any("hung for 30 s" in t.text for t in told)
    worker.close()
    happened(11, "fit process stopped (SIGSTOP): the parent was not held up; replaced, the window fitted, said")


def test_after_three_deaths_the_session_is_told(
    worker: ProcessWorker, requests: list[FitRequest], happened: Happened
) -> None:
    worker.submit(requests[0])
    killed: set[int] = set()

    def kill() -> None:
        if worker.state == "busy" and worker.pid:
            os.kill(worker.pid, signal.SIGKILL)
            killed.add(worker.pid)

    replies, told = wait(worker, kill)
    assert len(killed) == 3
    assert "3 fit processes failed" in replies[0].problem
    pauses = [float(t.text.rsplit(" in ", 1)[1].split()[0]) for t in told if "starts in" in t.text]
    assert pauses == sorted(pauses)
    assert pauses[-1] > pauses[0], "the pause grows"
    (reply,) = answers(worker, requests[1])
    assert reply.estimates, "the next window is fitted again"
    happened(11, f"killed on every try: given up after 3, said; pauses {pauses} s; the next window was fitted")


def test_a_window_that_waits_behind_children_hung_in_their_warm_up_is_given_up(
    requests: list[FitRequest], happened: Happened
) -> None:
    """No child ever took it: it once waited for good, and the session with it."""
    now, begin = 0.0, time.monotonic()
    worker = ProcessWorker(PELICAN, clock=lambda: now + time.monotonic() - begin)
    worker.submit(requests[0])
    replies: list[FitReply] = []
    hung: set[int] = set()
    while not replies and now < 20 * STILL:
        if worker.pid not in hung and worker.pid:
            os.kill(worker.pid, signal.SIGSTOP)
            hung.add(worker.pid)
        replies = [o for o in worker.poll() if isinstance(o, FitReply)]
        now += 1.0
    assert len(hung) == 3
    assert "3 fit processes failed" in replies[0].problem
    (reply,) = answers(worker, requests[1])
    assert reply.estimates, "the next window is fitted by the next child"
    worker.close()
    happened(30, f"3 children hung in their warm-up: the window that waited is given up after {now:.0f} s, said")


def test_a_child_that_eats_its_memory_ends_and_is_told(requests: list[FitRequest], happened: Happened) -> None:
    worker, told = ProcessWorker(PELICAN, memory_mb=40), list[Trouble]()
    assert until(lambda: told, lambda: told.extend(o for o in worker.poll() if isinstance(o, Trouble)))
    worker.close()
    assert "fit process ended" in told[0].text
    happened(11, "40 MiB of memory for the fit process: it ended, the service lived and said so")


def test_a_child_ends_with_its_parent() -> None:
    code = (
        "from quadid_node.worker import ProcessWorker; from quadid.vehicle import Vehicle; import os\n"
        "w = ProcessWorker(Vehicle.shipped('pelican')); print(w.pid, flush=True); os._exit(1)"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    child = int(done.stdout)
    assert until(lambda: _state(child) == "Z")


def _state(pid: int) -> str:
    try:
        with open(f"/proc/{pid}/stat") as stat:
            return stat.read().rsplit(")", 1)[1].split()[0]
    except OSError:
        return "Z"


def test_a_child_takes_no_module_of_the_folder_we_stand_in(monkeypatch: pytest.MonkeyPatch) -> None:
    commands: list[list[str]] = []

    def note(command: list[str], **_: object) -> None:
        commands.append(command)
        raise OSError

    monkeypatch.setattr(subprocess, "Popen", note)
    with pytest.raises(OSError):  # noqa: PT011
        ProcessWorker(Vehicle.shipped("pelican"))
    assert commands[0][1] == "-P"


# --- A child that starts is given up when it stands still, not when a slow machine makes it compile for long


@pytest.fixture
def work(monkeypatch: pytest.MonkeyPatch) -> dict[str, float | None]:
    """Time on the clock, and processor time that the watched child has used so far."""
    told: dict[str, float | None] = {"now": 0.0, "used": 0.0}
    monkeypatch.setattr(working, "processor_seconds", lambda pid: told["used"])
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
    before, own, after = time.process_time(), processor_seconds(os.getpid()), time.process_time()
    assert own is not None
    assert before - 0.02 < own < after + 0.02, "in ticks of 10 ms"
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    try:
        assert processor_seconds(child.pid) is not None
    finally:
        child.kill()
        child.wait()
    assert processor_seconds(child.pid) is None
