"""Fits kept from one variant to the next: most changes of the method ask for the same fits of the same flight again."""

from __future__ import annotations

import hashlib
import io
import pickle
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

from quadid.data.window import Window
from quadid.identification.problem import Shooting
from quadid.model.rollout import Rollout
from quadid_evaluation.studies.ablation.variants import modules

FITS = (
    "polish", "settle_states", "flexible_fit", "residual_noise", "with_memory", "mode_power",
    "fast_motion", "fast_fit", "mse_score", "reliability", "follows",
)  # fmt: skip
"""Functions that the diagnosis calls, of `quadid.identify`, which no variant changes, but for the last one …"""
NUMBERS = ("quadid.diagnosis.residual_tests", "quadid.diagnosis.hypotheses")
"""… whose answer depends on numbers of these modules, and on nothing else that a variant changes."""


MOST = 600
"""Answers kept; the oldest go first."""


class Memory:
    """Answers of functions to arguments of equal content, and how many linearisations a diagnosis asked for.

    Attributes:
        asked: linearisations since `asked` was last set to 0, remembered ones included: a cost that no machine changes.
    """

    def __init__(self) -> None:
        """Knows nothing."""
        self.asked = 0
        self._known: dict[bytes, Any] = {}
        self._inside = False
        self._windows: dict[int, tuple[Window, bytes]] = {}

    @contextmanager
    def in_use(self) -> Iterator[None]:
        """Within it the diagnosis asks this memory before it fits."""
        places = [(m, n) for m in modules() for n in FITS if hasattr(m, n)]
        kept: list[tuple[Any, str, Any]] = [(m, n, getattr(m, n)) for m, n in [*places, (Shooting, "linearise")]]
        try:
            for where, name, function in kept:
                setattr(where, name, self._remembered(name, function))
            yield
        finally:
            for where, name, function in kept:
                setattr(where, name, function)

    def _remembered(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        def answer(*args: Any, **kwargs: Any) -> Any:
            if self._inside:  # of a fit that is remembered as a whole
                return function(*args, **kwargs)
            key = self._key((name, args, kwargs, _numbers() if name == "follows" else ()))
            if key not in self._known:
                self._inside = True
                try:
                    self._known[key] = function(*args, **kwargs)
                finally:
                    self._inside = False
                if len(self._known) > MOST:
                    self._known.pop(next(iter(self._known)))
            found = self._known[key]
            self.asked += getattr(found, "iterations", 1)
            return found

        return answer

    def _key(self, what: object) -> bytes:
        out = io.BytesIO()
        _Content(out, self).dump(what)
        return hashlib.sha256(out.getbuffer()).digest()

    def window(self, window: Window) -> bytes:
        """Digest of what a window holds."""
        if id(window) not in self._windows:
            self._windows[id(window)] = (window, hashlib.sha256(pickle.dumps(window)).digest())
        return self._windows[id(window)][1]


def _numbers() -> list[tuple[str, Any]]:
    """Numbers of the modules that the last function of `FITS` rests on, as they are now."""
    return [(n, v) for m in NUMBERS for n, v in vars(sys.modules[m]).items() if n.isupper()]


class _Content(pickle.Pickler):
    """Writes arguments, windows and their simulations by the digest of their content."""

    def __init__(self, file: io.BytesIO, memory: Memory) -> None:
        super().__init__(file, protocol=pickle.HIGHEST_PROTOCOL)
        self.memory = memory

    def persistent_id(self, obj: object) -> object:
        if isinstance(obj, Rollout):
            return self.memory.window(obj.window), obj.vehicle.to_yaml()
        return self.memory.window(obj) if isinstance(obj, Window) else None
