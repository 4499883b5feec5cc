"""Jobs on Dask: an embedded cluster of processes, or one that is already there."""

from __future__ import annotations

import contextlib
import logging
import multiprocessing
import os
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.process import BaseProcess
from queue import Empty, SimpleQueue
from typing import Any

from quadid_workflow.fleet import Job, Row, blank, identify_one

from quadid.errors import QuadidError

AHEAD = 4
"""Jobs handed out for each worker, so that the scheduler's memory does not grow with the number of logs."""
ATTEMPTS = 4
"""Workers that may die with a log before it is given up; workers also die for reasons that are not the log's."""
_ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}

_QUIET = {
    "distributed.worker.profile.enabled": False, "distributed.admin.tick.interval": "500ms",
    "distributed.admin.system-monitor.interval": "5s", "distributed.worker.memory.monitor-interval": "500ms",
}  # fmt: skip
"""Dask otherwise looks at every worker's stack each 10 ms, at itself each 20 ms and at memory each 100 ms."""
_WARM = (
    "distributed", "distributed.nanny", "quadid_workflow.fleet", "quadid_workflow.identify", "quadid.health.stored",
    "quadid.health.trim_estimation", "quadid_replay.mcap_reader",
)  # fmt: skip
"""What a process has imported from which all workers are forked, those that replace dead ones too."""

STARTING = 180.0
"""Time that a worker may take to start [s]: when none lives for so long, there is no cluster."""
ANSWER = 10.0
"""Time that a scheduler may take to answer [s]."""
_LOOK = 2.0
"""A worker lives when it is there at two looks, so far apart [s]."""


class ClusterError(QuadidError):
    """No cluster to work on."""


@contextmanager
def cluster(address: str | None, workers: int | None, memory: str) -> Iterator[Any]:
    """A client of the cluster at `address`, or of an embedded one that ends with the block.

    Args:
        address: of a Dask scheduler, for example ``tcp://10.0.0.1:8786``; its workers must see the logs at the same
            paths and have quadid of the same version.
        workers: processes of the embedded cluster; None for one a core.
        memory: that one worker may take before it is restarted and its log given up, for example ``2GiB``.

    Raises:
        ClusterError: nothing answers at the address, or no worker can start.
    """
    import dask
    from distributed import Client, LocalCluster
    from distributed.utils import get_mp_context

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    settings = {
        "distributed.scheduler.allowed-failures": 0, "distributed.nanny.pre-spawn-environ": _ONE_THREAD,
        "distributed.scheduler.worker-ttl": None,  # a worker that compiles kernels is silent for minutes
        "distributed.worker.multiprocessing-method": "forkserver",
    }  # fmt: skip
    with dask.config.set({**settings, **_QUIET}):
        if address is not None:
            try:
                client = Client(address, timeout=ANSWER, set_as_default=False)
            except (OSError, TimeoutError, ValueError) as error:
                raise ClusterError(
                    f"no Dask scheduler answers at {address}", "an address such as tcp://10.0.0.1:8786",
                    "start one with `dask scheduler`, or leave --scheduler out",
                ) from error  # fmt: skip
            with client:
                yield client
            return
        get_mp_context().set_forkserver_preload(list(_WARM))
        count, others = workers or os.cpu_count() or 1, set(multiprocessing.active_children())
        try:
            own = LocalCluster(
                n_workers=count, threads_per_worker=1, processes=True, memory_limit=memory, dashboard_address=None,
                host="127.0.0.1", silence_logs=logging.CRITICAL, death_timeout=STARTING,
            )  # fmt: skip
        except (RuntimeError, OSError, TimeoutError) as error:
            raise _no_worker(f"their processes end at once or not within {STARTING:g} s") from error
        try:
            with Client(own, set_as_default=False) as client:
                yield client
        finally:
            _close(own, others)


def _close(own: Any, others: set[BaseProcess]) -> None:
    """Ends an embedded cluster and its processes; `others` are children of this process that it did not start.

    Dask cannot close a cluster while the worker that replaces a dead one starts, and fails; its process is then killed,
    and it can.
    """
    from distributed.core import Status

    try:
        own.close(timeout=STARTING)
    except (AssertionError, TimeoutError):
        for child in set(multiprocessing.active_children()) - others:
            child.kill()
        own.status = Status.failed  # is closed once more
        own.close(timeout=STARTING)


def results(client: Any, jobs: Sequence[Job], work: Callable[[Job], Row] = identify_one) -> Iterator[Row]:
    """Runs `work` on all jobs and yields one row of each as it is ready, whichever workers die on the way.

    A log whose workers die `ATTEMPTS` times, the last time with nothing else in them, costs that log only.

    Raises:
        ClusterError: no worker lives for `STARTING` seconds.
    """
    threads = sum(client.nthreads().values())
    if threads == 0:
        raise ClusterError("the cluster has no workers", "at least one", "start one with `dask worker ADDRESS`")
    # A dying worker takes along jobs that waited in it.  So these come again, as many as there are workers, and at last
    # one by one, where only a log that kills its worker is lost.
    ahead = [AHEAD * threads, *[threads] * (ATTEMPTS - 2), 1]
    for most in ahead:
        jobs = yield from _answered(_stream(client, jobs, work, most))
    yield from map(_lost, jobs)


def _answered(ended: Iterator[tuple[Any, Job]]) -> Generator[Row, None, list[Job]]:
    """Yields the rows of ended futures; returns the jobs whose worker died."""
    died = []
    for future, job in ended:
        row = _row(future)
        if row is None:
            died.append(job)
        else:
            yield row
    return died


def _row(future: Any) -> Row | None:
    """What an ended future holds; None where its worker died with the job, or with the result before it was fetched."""
    from distributed import KilledWorker
    from distributed.client import FutureCancelledError

    if future.status != "finished":
        return None
    try:
        return dict(future.result())
    except (KilledWorker, FutureCancelledError):
        return None


def _stream(
    client: Any, jobs: Sequence[Job], work: Callable[[Job], Row], ahead: int
) -> Iterator[tuple[Any, Job]]:  # fmt: skip
    """Ended futures with their jobs, in the order in which they end; at most `ahead` are handed out."""
    waiting = iter(jobs)
    ended: SimpleQueue[Any] = SimpleQueue()
    running: dict[str, Job] = {}

    def hand_out(job: Job) -> None:
        future = client.submit(work, job, pure=False, retries=0)
        running[future.key] = job
        future.add_done_callback(ended.put)

    for _, job in zip(range(ahead), waiting, strict=False):
        hand_out(job)
    while running:
        future = _next_of(ended, client)
        yield future, running.pop(future.key)
        following = next(waiting, None)
        if following is not None:
            hand_out(following)


def _next_of(ended: SimpleQueue[Any], client: Any) -> Any:
    """The next future that ends."""
    lived, before = time.monotonic(), set[str]()
    while True:
        with contextlib.suppress(Empty):
            return ended.get(timeout=_LOOK)
        there = set(client.sync(client.scheduler.ncores_running))
        if there & before:
            lived = time.monotonic()
        elif time.monotonic() - lived > STARTING:
            raise _no_worker(f"none lived for {_LOOK:g} s in the last {STARTING:g} s")
        before = there


def _no_worker(how: str) -> ClusterError:
    return ClusterError(
        f"no worker can start: {how}", "at least one worker with memory for one log",
        "use more --memory, or fewer --workers; finished logs are kept",
    )  # fmt: skip


def _lost(job: Job) -> Row:
    reason = f"{ATTEMPTS} workers died with this log: too much memory (see --memory), or a crash in a library"
    return {**blank(job), "status": "failed", "reason": reason, "took": None}
