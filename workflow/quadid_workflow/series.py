"""Simulated against measured outputs of scored logs as files, for PlotJuggler, Foxglove and programs of one's own."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from quadid.errors import ParameterError, nearest
from quadid_workflow.files import file_name

if TYPE_CHECKING:
    from quadid.identify.result import ScoredSet
    from quadid.types import FloatArray
    from quadid.window import Recording
    from quadid_workflow.loading import Log

KINDS = ("mcap", "csv")
_CHANNELS = {"gyro": 0, "attitude": 3, "accel": 6, "velocity": 9, "position": 12}
"""First of the three columns of each channel in a `quadid.identify.score.Series`."""


def check_kinds(kinds: Iterable[str]) -> None:
    """Raises ParameterError for a form that is not written."""
    for kind in kinds:
        if kind not in KINDS:
            raise ParameterError(f"--series {kind}", ", ".join(KINDS), nearest(kind, KINDS))


def save_series(sets: Sequence[ScoredSet], logs: Sequence[Log], folder: str | Path, kinds: Sequence[str]) -> list[Path]:
    """Writes ``LOG.simulated.KIND`` for every log: measured, and both simulations, which start anew every second.

    Args:
        sets: scored logs.
        logs: the same ones, as loaded.
        folder: where to.
        kinds: of `KINDS`.

    Returns:
        Absolute paths.

    Raises:
        ParameterError: another kind.
        LogError: a file that cannot be written.
    """
    from quadid_replay import write_compared

    check_kinds(kinds)
    out: list[Path] = []
    for scored, log in zip(sets, logs, strict=True):
        measured = scored.fitted.series.measured
        parts = {
            name: _recording(log.name, scored.fitted.series.t, values)
            for name, values in (
                ("measured", measured), ("simulated", scored.fitted.series.simulated),
                ("before", scored.initial.series.simulated),
            )
        }  # fmt: skip
        for kind in kinds:
            path = _unused(Path(folder).absolute(), file_name(log.name), kind, out)
            write_compared(path, parts, round(1e9 * (log.recording.epoch or 0.0)))
            out.append(path)
    return out


def _unused(folder: Path, name: str, kind: str, taken: Sequence[Path]) -> Path:
    """A name that no log of this run has; two logs of one name are told apart by number."""
    path, number = folder / f"{name}.simulated.{kind}", 2
    while path in taken:
        path, number = folder / f"{name}.{number}.simulated.{kind}", number + 1
    return path


def _recording(name: str, t: FloatArray, values: FloatArray) -> Recording:
    """Outputs (n, channels) as a recording; rows that were not measured, or ran away, are left out."""
    from quadid_replay.frames import from_euler

    from quadid.window import Channel, Recording

    channels = {}
    for channel, first in _CHANNELS.items():
        three = values[:, first : first + 3]
        known = np.isfinite(three).all(axis=1)
        if three.shape[1] and known.any():
            rows = three[known]
            channels[channel] = Channel(
                channel, t[known], from_euler(rows) if channel == "attitude" else rows, "simulation"
            )
    return Recording(name, "series", channels)
