"""`quadid.identify`, `diagnose` and `health` are packages and functions at once: Python shows them as the functions."""

from __future__ import annotations

import importlib
import inspect
import pickle

import pytest

import quadid


@pytest.mark.parametrize("name", ["identify", "diagnose", "health"])
def test_a_room_has_the_signature_and_the_documentation_of_its_function_and_pickles(name: str) -> None:
    room = getattr(quadid, name)
    function = getattr(importlib.import_module(f"quadid_workflow.{name}"), name)
    assert inspect.signature(room) == inspect.signature(function)
    assert inspect.getdoc(room) == inspect.getdoc(function)
    assert pickle.loads(pickle.dumps(room)) is room
