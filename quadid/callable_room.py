"""Rooms that are called like functions: ``quadid.identify(log)`` beside ``from quadid.identify.fit import fit``."""

from __future__ import annotations

import importlib
import sys
from types import ModuleType
from typing import Any


def make_callable(room: str) -> None:
    """Makes a call of the package `room` a call of the function of that name in `quadid_workflow`.

    The function is looked up when it is called: a room does not import what stands above it.
    """
    name = room.rpartition(".")[2]

    class Room(ModuleType):
        def __call__(self, *arguments: Any, **options: Any) -> Any:
            return getattr(importlib.import_module(f"quadid_workflow.{name}"), name)(*arguments, **options)

    sys.modules[room].__class__ = Room
