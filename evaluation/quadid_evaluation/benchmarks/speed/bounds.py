"""What bounds each row of the page on this machine: arithmetic, memory, disk, start of Python, both cores busy."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

Result = Mapping[str, Any]

NOTHING = "–"
SAMPLE_BYTES = 144
"""Of one row of a window: four rotors, rates, attitude, force, references, in doubles."""


def at_peak(results: Result, gains: list[float]) -> str:
    """What ratios to other programs would be with the kernel at the arithmetic peak."""
    if "kernel" not in results:
        return NOTHING
    share = results["kernel"]["share_of_peak"]
    most = [f"{gain / share:.0f}" for gain in (min(gains), max(gains))]
    return f"{' to '.join(dict.fromkeys(most))} times"


def busy(times: Result, cores: int) -> str:
    """Its own processor time spread over all cores."""
    return f"{times['processor'] / cores:.2g} s"


def started(results: Result, megabytes: float = 0.0) -> str:
    """The start of Python, and a log from the disk."""
    found = results.get("limits")
    if found is None:
        return NOTHING
    log = 1e6 * megabytes / found["disk_read"]
    return f"{found['python_start']:.2f} s" + (f" + {log:.2g} s (disk)" if megabytes else "")


def held(results: Result, rows: float) -> str:
    """Memory of the libraries and the windows alone."""
    found = results.get("limits")
    return NOTHING if found is None else f"{found['fit_import_mb'] + 1e-6 * rows * SAMPLE_BYTES:.0f} MB"


def machine_limits(r: Result) -> list[str]:
    """The page's lines about the machine."""
    rates = {name: f"{1e-6 * r[name]:.0f} MB/s, {1e9 / r[name]:.2g} ms/MB" for name in ("disk_read", "sha256")}
    return [
        f"Memory copy {1e-9 * r['memory_bandwidth']:.1f} GB/s; disk write {1e-6 * r['disk_write']:.0f} MB/s, read "
        f"{rates['disk_read']}; SHA-256 of every log {rates['sha256']}; start of Python {r['python_start']:.3f} s, "
        f"with import of the fit {r['fit_import']:.2f} s and {r['fit_import_mb']:.0f} MB."
    ]
