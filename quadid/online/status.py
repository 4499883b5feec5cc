"""What a session is doing, for people and monitors."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from quadid.online.records import Phase
from quadid.types import FloatArray


@dataclass(frozen=True)
class SessionStatus:
    """What a session is doing.

    Attributes:
        t: newest sample [s, time of the stamps]; NaN before the first.
        phase: what; reason: why, and what would change it.
        excitation: relative standard deviation of each nominal parameter that the newest window allows; NaN: unknown.
        samples: grid rows in the newest window; window_seconds: usable time in it [s]; gaps: cuts in it.
        mse: of the newest window, 1 at the noise floor; NaN before.
        fits, rejected: fits done, and those the gate refused.
        in_force, pending: sequence numbers, 0 for none; stale: the set in force is from an earlier run.
        approval: auto or manual, now.
        faults: dropped samples by reason.
        backlog: time of data that waits for a running fit [s].
    """

    t: float
    phase: Phase
    reason: str
    excitation: FloatArray
    samples: int
    window_seconds: float
    gaps: int
    mse: float
    fits: int
    rejected: int
    in_force: int
    pending: int
    stale: bool
    approval: str
    faults: Mapping[str, int]
    backlog: float
