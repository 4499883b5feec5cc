"""Names of compiled functions: kernels on disk come from several processes, and are linked by name."""

import gc
import importlib
import pkgutil
from collections import defaultdict
from typing import Any

from numba.core.dispatcher import Dispatcher

import quadid


def test_no_two_compiled_functions_share_a_name() -> None:
    for module in pkgutil.walk_packages(quadid.__path__, "quadid."):
        importlib.import_module(module.name)
    named: dict[tuple[str, str], list[Any]] = defaultdict(list)
    for found in gc.get_objects():
        if isinstance(found, Dispatcher) and found.py_func.__module__.startswith("quadid."):
            named[found.py_func.__module__, found.py_func.__qualname__].append(found)
    assert ("quadid.model.body_kernel", "_step_of.<locals>.step_1110") in named, "walked to the kernels"
    assert not {name: len(same) for name, same in named.items() if len(same) > 1}
