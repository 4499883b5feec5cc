"""Jobs on Dask: an embedded cluster of processes, or one that is already there."""

from __future__ import annotations

import logging
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from typing import Any

from quadid.errors import QuadidError
from quadid.workflow.fleet import Job, Row, blank, identify_one

AHEAD = 4
"""Jobs handed out for each worker, so that the scheduler's memory does not grow with the number of logs."""
_ONE_THREAD = {f"{library}_NUM_THREADS": "1" for library in ("OMP", "OPENBLAS", "MKL", "NUMBA")}


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
        ClusterError: nothing answers at the address.
    """
    import dask
    from distributed import Client, LocalCluster

    logging.getLogger("distributed").setLevel(logging.CRITICAL)
    settings = {"distributed.scheduler.allowed-failures": 0, "distributed.nanny.pre-spawn-environ": _ONE_THREAD}
    with dask.config.set(settings):
        if address is not None:
            try:
                client = Client(address, timeout="10s", set_as_default=False)
            except (OSError, TimeoutError, ValueError) as error:
                raise ClusterError(
                    f"no Dask scheduler answers at {address}", "an address such as tcp://10.0.0.1:8786",
                    "start one with `dask scheduler`, or leave --scheduler out",
                ) from error  # fmt: skip
            with client:
                yield client
            return
        count = workers or os.cpu_count() or 1
        own = LocalCluster(
            n_workers=count, threads_per_worker=1, processes=True, memory_limit=memory, dashboard_address=None,
            host="127.0.0.1", silence_logs=logging.CRITICAL,
        )  # fmt: skip
        with own, Client(own, set_as_default=False) as client:
            yield client


def results(client: Any, jobs: Sequence[Job], work: Callable[[Job], Row] = identify_one) -> Iterator[Row]:
    """Runs `work` on all jobs and yields each row as it is ready; a log that kills its worker costs that log only."""
    threads = sum(client.nthreads().values())
    if threads == 0:
        raise ClusterError("the cluster has no workers", "at least one", "start one with `dask worker ADDRESS`")
    suspects: list[Job] = []
    for future, job in _stream(client, jobs, work, AHEAD * threads):
        if future.status == "finished":
            yield dict(future.result())
        else:
            suspects.append(job)
    # A dying worker takes along results that it held for others.  Alone, only the log that kills it is lost.
    for job in suspects:
        for future, _ in _stream(client, [job], work, 1):
            yield dict(future.result()) if future.status == "finished" else _lost(job)


def _stream(
    client: Any, jobs: Sequence[Job], work: Callable[[Job], Row], ahead: int
) -> Iterator[tuple[Any, Job]]:  # fmt: skip
    """Ended futures with their jobs, in the order in which they end; at most `ahead` are handed out."""
    from distributed import as_completed

    waiting = iter(jobs)
    running = as_completed(loop=client.loop)
    by_key: dict[str, Job] = {}

    def hand_out(job: Job) -> None:
        future = client.submit(work, job, pure=False, retries=0)
        by_key[future.key] = job
        running.add(future)

    for _, job in zip(range(ahead), waiting, strict=False):
        hand_out(job)
    for future in running:
        yield future, by_key.pop(future.key)
        following = next(waiting, None)
        if following is not None:
            hand_out(following)


def _lost(job: Job) -> Row:
    reason = "the worker died twice with this log: too much memory (see --memory), or a crash in a library"
    return {**blank(job), "status": "failed", "reason": reason, "took": None}
