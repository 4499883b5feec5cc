"""What this machine could do at best: memory bandwidth, disk, hashing, the start of Python, memory of the libraries."""

from __future__ import annotations

import hashlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from quadid_evaluation.benchmarks.speed.timing import child

BYTES = 128 << 20
"""Size of the array that is copied and of the file that is written and read."""


def limits(rounds: int, folder: Path) -> dict[str, Any]:
    """Best of some rounds, in units of the page: bytes a second, seconds, MB."""
    source = np.random.default_rng(0).integers(0, 255, BYTES, dtype=np.uint8)
    target, data, path = np.empty_like(source), source.tobytes(), folder / "limit"
    starts = [child("print('{}')") for _ in range(rounds)]
    loaded = [child("import quadid.identification.fit\nprint('{}')") for _ in range(rounds)]
    return {
        "memory_bandwidth": 2 * BYTES / _best(rounds, lambda: np.copyto(target, source)),
        "disk_write": BYTES / _best(rounds, lambda: _written(path, data)),
        "disk_read": BYTES / _best(rounds, lambda: path.read_bytes(), lambda: _forgotten(path)),
        "sha256": BYTES / _best(rounds, lambda: hashlib.sha256(data).digest()),
        "python_start": min(s["wall"] for s in starts),
        "fit_import": min(s["wall"] for s in loaded),
        "fit_import_mb": min(s["peak_mb"] for s in loaded),
    }


def _best(rounds: int, run: Callable[[], object], before: Callable[[], None] = lambda: None) -> float:
    """Shortest time of a run [s]."""
    times = []
    for _ in range(rounds):
        before()
        begin = time.perf_counter()
        run()
        times.append(time.perf_counter() - begin)
    return min(times)


def _written(path: Path, data: bytes) -> None:
    with path.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())


def _forgotten(path: Path) -> None:
    """Has the system forget what it keeps of a file in memory, so that it comes from the disk."""
    with path.open("rb") as file:
        os.posix_fadvise(file.fileno(), 0, 0, os.POSIX_FADV_DONTNEED)
