"""Where the memory of this process goes: own pages, mapped files, the C heap in use (Linux; the heap: glibc)."""

from __future__ import annotations

import ctypes
import sys
from pathlib import Path


class _Heap(ctypes.Structure):
    """`struct mallinfo2` of malloc.h."""

    _fields_ = [
        (name, ctypes.c_size_t)
        for name in ("arena", "ordblks", "smblks", "hblks", "hblkhd", "usmblks", "fsmblks", "uordblks", "fordblks",
                     "keepcost")
    ]  # fmt: skip


def parts() -> dict[str, float]:
    """Memory of this process now.

    Returns:
        MiB: ``own`` (anonymous pages, swapped ones included), ``mapped`` (files and shared memory), ``heap`` (the C
        heap's blocks in use), ``free`` (blocks it keeps for later); ``objects``: blocks that Python has allocated.
    """
    found = dict(_status_lines())
    out = {
        "own": (found["RssAnon"] + found["VmSwap"]) / 1024.0,
        "mapped": (found["RssFile"] + found["RssShmem"]) / 1024.0,
        "objects": float(sys.getallocatedblocks()),
    }
    heap = _heap()
    if heap is not None:
        out |= {"heap": (heap.uordblks + heap.hblkhd) / 2**20, "free": heap.fordblks / 2**20}
    return out


def _status_lines() -> list[tuple[str, int]]:
    lines = Path("/proc/self/status").read_text(encoding="ascii").splitlines()
    return [(line.split(":")[0], int(line.split()[1])) for line in lines if line.endswith(" kB")]


def _heap() -> _Heap | None:
    """What malloc says of itself; None where the C library is another or older."""
    try:
        ask = ctypes.CDLL(None).mallinfo2
    except AttributeError:
        return None
    ask.restype = _Heap
    answer: _Heap = ask()
    return answer
