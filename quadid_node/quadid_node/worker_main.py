"""The background process: reads requests from its input, writes replies to its output, as pickles.

Started by `worker.ProcessWorker`; it lowers its priority, leaves a core to others, bounds its memory, warms the
kernels, says that it is ready, and ends when its input ends.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import sys

NICE = 15
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
READY = "ready"
_PR_SET_PDEATHSIG = 1


def main() -> None:
    """Serves requests until the input ends."""
    answers = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints must not end up between replies
    requests = os.fdopen(os.dup(0), "rb")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    # Lowers priority, leaves the first core to others, bounds memory.
    megabytes = int(sys.argv[1])
    os.nice(NICE)
    if hasattr(os, "sched_getaffinity"):
        cores = sorted(os.sched_getaffinity(0))
        if len(cores) > 1:
            os.sched_setaffinity(0, cores[1:])
    _end_with_parent()
    if megabytes > 0:
        limit = megabytes << 20
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    from quadid.online.fit_job import warm_up

    def answer(item: object) -> None:
        pickle.dump(item, answers, pickle.HIGHEST_PROTOCOL)
        answers.flush()

    try:
        warm_up(pickle.load(requests))
        answer(READY)
        while True:
            answer(pickle.load(requests).run())
    except (EOFError, pickle.UnpicklingError):  # the parent has ended
        return
    except MemoryError:
        sys.exit("the fit process needs more memory than it may have")  # one line; the parent says what follows


def _end_with_parent() -> None:
    """Dies with its parent even while kernels compile and nobody reads the input (Linux only)."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


if __name__ == "__main__":
    main()
