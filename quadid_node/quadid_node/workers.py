"""Who fits for a service: the child process on board, or a ground machine where one is asked for."""

from __future__ import annotations

from quadid.errors import QuadidError
from quadid_node.worker import ProcessWorker, Worker


def with_ground(worker: ProcessWorker, where: str, vehicle: str) -> Worker:
    """The worker itself, or, with a place on Zenoh, one that lets ground machines there fit for `vehicle`.

    Raises:
        ZenohError: a configuration that is none.
    """
    if not where:
        return worker
    from quadid_node.remote_worker import Ground, RemoteWorker  # Zenoh is loaded by those who use it

    try:
        return RemoteWorker(worker, Ground(where, vehicle))
    except QuadidError:
        worker.close()
        raise
