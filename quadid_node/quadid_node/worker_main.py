"""The background process: reads requests from its input, writes replies to its output, in length-prefixed pickles.

Started by `worker.ProcessWorker`; it lowers its priority, leaves a core to others, bounds its memory, warms the
kernels, says that it is ready, and ends when its input ends.
"""

from __future__ import annotations

import os
import pickle
import resource
import signal
import struct
import sys
from typing import Any, BinaryIO

NICE = 15
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
READY = b"ready"
_PR_SET_PDEATHSIG = 1
_LENGTH = struct.Struct("<Q")


def main() -> None:
    """Serves requests until the input ends."""
    channel = os.fdopen(os.dup(1), "wb")
    os.dup2(2, 1)  # whatever prints must not end up between replies
    requests = os.fdopen(os.dup(0), "rb")
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    _behave(int(sys.argv[1]))
    from quadid.online.window_fit import warm_up

    try:
        vehicle = _read(requests)
        if vehicle is None:
            return
        warm_up(vehicle)
        _write(channel, READY)
        while (job := _read(requests)) is not None:
            _write(channel, job.run())
    except MemoryError:
        sys.exit("the fit process needs more memory than it may have")  # one line; the parent says what follows


def _behave(megabytes: int) -> None:
    """Lowers priority, leaves the first core to others, bounds memory."""
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


def _end_with_parent() -> None:
    """Dies with its parent even while kernels compile and nobody reads the input (Linux only)."""
    if not sys.platform.startswith("linux"):
        return
    import ctypes

    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGKILL)


def _read(stream: BinaryIO) -> Any:
    head = stream.read(_LENGTH.size)
    if len(head) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack(head)
    body = stream.read(length)
    return pickle.loads(body) if len(body) == length else None


def _write(stream: BinaryIO, item: object) -> None:
    stream.write(frame(item))
    stream.flush()


def frame(item: object) -> bytes:
    """A pickle with its length before it."""
    body = pickle.dumps(item, protocol=pickle.HIGHEST_PROTOCOL)
    return _LENGTH.pack(len(body)) + body


def unframe(buffer: bytearray) -> object | None:
    """Takes one complete item off the front of a buffer; None when it is not complete yet."""
    if len(buffer) < _LENGTH.size:
        return None
    (length,) = _LENGTH.unpack_from(buffer)
    end = _LENGTH.size + length
    if len(buffer) < end:
        return None
    item: object = pickle.loads(bytes(buffer[_LENGTH.size : end]))
    del buffer[:end]
    return item


if __name__ == "__main__":
    main()
