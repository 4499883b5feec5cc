"""Rooms that are called like functions: ``quadid.identify(log)`` beside ``from quadid.identify.fit import fit``."""

from __future__ import annotations

import importlib
import inspect
import sys
from collections.abc import Callable
from types import ModuleType
from typing import Any


def make_callable(room: str) -> None:
    """Makes a call of the package `room` a call of the function of that name in `quadid_workflow`.

    Signature and documentation are the function's; the package pickles by name.  The function is looked up when it is
    used: a room does not import what stands above it.
    """
    name = room.rpartition(".")[2]

    def function() -> Callable[..., Any]:
        return getattr(importlib.import_module(f"quadid_workflow.{name}"), name)  # type: ignore[no-any-return]

    class Room(ModuleType):
        __doc__ = property(lambda _: function().__doc__)
        __signature__ = property(lambda _: inspect.signature(function()))

        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return function()(*arguments, **options)

        def __reduce__(self) -> tuple[Any, ...]:
            return importlib.import_module, (room,)

    sys.modules[room].__class__ = Room
