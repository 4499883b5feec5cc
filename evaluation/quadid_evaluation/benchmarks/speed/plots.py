"""Picture of how time and memory grow with the log."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib

matplotlib.use("Agg")
import matplotlib.pyplot as plt


def draw(results: Mapping[str, Any], folder: Path) -> None:
    """Writes speed-scaling.png, if that was measured."""
    if "scaling" in results:
        _scaling(results["scaling"], folder / "speed-scaling.png")


def _scaling(r: Mapping[str, Any], path: Path) -> None:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.5), layout="constrained")
    for axis, key, label in (
        (axes[0], "fit_processor", "processor time of a fit [s]"),
        (axes[1], "peak_mb", "peak memory [MB]"),
    ):
        axis.loglog(r["hours"], [run[key] for run in r["runs"]], "o-")
        axis.set(xlabel="hours of flight at 50 Hz", ylabel=label, title=f"exponent {r['exponents'][key]:.2f}")
        axis.grid(alpha=0.3, which="both")
    figure.savefig(path, dpi=110)
    plt.close(figure)
