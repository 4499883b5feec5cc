"""Arrays kept for the next calls, the most recently used ones, up to a number of bytes together."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Hashable
from threading import Lock

from quadid.types import FloatArray


class ArrayCache:
    """Arrays by key; the least recently used go first.

    Args:
        most: bytes of all together; a single larger array is not kept.
    """

    def __init__(self, most: int) -> None:
        self._most, self._bytes = most, 0
        self._kept: OrderedDict[Hashable, FloatArray] = OrderedDict()
        self._lock = Lock()

    def get(self, key: Hashable) -> FloatArray | None:
        """The array kept under this key, if it still is."""
        with self._lock:
            found = self._kept.get(key)
            if found is not None:
                self._kept.move_to_end(key)
            return found

    def keep(self, key: Hashable, array: FloatArray) -> None:
        """Keeps an array under a key, and drops those used longest ago."""
        with self._lock:
            self._bytes += array.nbytes - (self._kept.pop(key).nbytes if key in self._kept else 0)
            self._kept[key] = array
            while self._bytes > self._most:
                self._bytes -= self._kept.popitem(last=False)[1].nbytes
