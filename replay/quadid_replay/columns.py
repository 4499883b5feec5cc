"""Growing columns: what a reader keeps of a log while it streams through it, and nothing else."""

from __future__ import annotations

from array import array
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from quadid.window import CHANNELS, Channel
from quadid_replay.frames import continuous_sign, unit_quaternions

FloatArray = NDArray[np.float64]

_REASONS = {
    "duplicate": "with a repeated stamp",
    "backwards": "running backwards in time",
    "not_finite": "not finite",
    "bad_stamp": "with a wild stamp",
    "not_attitude": "that are no attitude (quaternion far from unit length)",
}


class Columns:
    """Times and values of one channel, appended sample by sample as packed doubles.

    Args:
        width: number of values a sample.
    """

    def __init__(self, width: int) -> None:
        self.width = width
        self.refused = 0
        self._t = array("d")
        self._values = array("d")

    def __len__(self) -> int:
        return len(self._t)

    def add(self, t: float | None, values: Sequence[float]) -> None:
        """Appends one sample; a time of None (refused by the clock) is counted and dropped."""
        if t is None:
            self.refused += 1
            return
        if len(values) != self.width:
            raise ValueError(f"{len(values)} values for {self.width} columns")
        self._t.append(t)
        self._values.extend(values)

    def extend(self, t: FloatArray, values: FloatArray) -> None:
        """Appends many samples: times (n,), values (n, width)."""
        self._t.frombytes(np.ascontiguousarray(t, dtype=np.float64).tobytes())
        self._values.frombytes(np.ascontiguousarray(values, dtype=np.float64).tobytes())

    def arrays(self) -> tuple[FloatArray, FloatArray]:
        """Returns times (n,) and values (n, width) [as added]."""
        t = np.frombuffer(self._t, dtype=np.float64) if self._t else np.empty(0)
        values = np.frombuffer(self._values, dtype=np.float64) if self._values else np.empty(0)
        return t, values.reshape(-1, self.width)


def clean_channel(name: str, t: FloatArray, values: FloatArray, source: str, refused: int = 0) -> Channel | None:
    """Makes a channel of raw samples in core units and frames: drops and counts what cannot be used.

    Dropped: values or times that are not finite, repeated stamps, samples running backwards, quaternions that are none.
    Returns None when nothing remains.
    """
    faults = {"bad_stamp": refused}
    finite = np.isfinite(t) & np.isfinite(values).all(axis=1)
    faults["not_finite"] = int(np.count_nonzero(~finite))
    if name == "attitude":
        values, good = unit_quaternions(values)
        faults["not_attitude"] = int(np.count_nonzero(finite & ~good))
        finite &= good
    t, values = t[finite], values[finite]
    if len(t) == 0:
        return None
    newest = np.maximum.accumulate(t)
    forward = np.concatenate([[True], t[1:] > newest[:-1]])
    faults["duplicate"] = int(np.count_nonzero(t[1:] == newest[:-1]))
    faults["backwards"] = int(np.count_nonzero(~forward)) - faults["duplicate"]
    t, values = t[forward], values[forward]
    if name == "attitude":
        values = continuous_sign(values)
    return Channel(name, t, values, source, {k: n for k, n in faults.items() if n})


def channel_width(name: str) -> int:
    """Returns the number of columns of a channel with a fixed number of them."""
    width = CHANNELS[name][0]
    assert width is not None
    return width


def fault_warnings(channels: Mapping[str, Channel]) -> list[str]:
    """Says in sentences which samples were dropped from which channel."""
    out = []
    for channel in channels.values():
        parts = [f"{count} {_REASONS[reason]}" for reason, count in channel.faults.items()]
        if parts:
            out.append(f"{channel.name}: dropped samples: {', '.join(parts)}")
    return out
