"""One simulation of a window for all problems that look at it."""

from __future__ import annotations

from weakref import WeakValueDictionary

from quadid.model.rollout import Rollout
from quadid.vehicle import Vehicle
from quadid.window import Window

_SHARED: WeakValueDictionary[tuple[int, int], Rollout] = WeakValueDictionary()


def shared_rollout(window: Window, vehicle: Vehicle) -> Rollout:
    """The `Rollout` of this very window and vehicle that somebody still uses, or a new one.

    Problems with segments of several lengths look at the same data; of a long log each copy would be a large part of
    all memory.
    """
    key = (id(window), id(vehicle))  # of objects that the one found keeps alive
    found = _SHARED.get(key)
    if found is None:
        found = _SHARED[key] = Rollout(window, vehicle)
    return found
