"""The kernel in single precision: would it make the swarm faster?

There is no float32 kernel in quadid.  For this question the modules of the kernel are compiled once more with every
literal, constant and array in float32, twice the lanes in the same registers, and run beside the kernel in use.
"""

from __future__ import annotations

import ast
import importlib
import sys
import time
import types
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.kernel import every_effect
from benchmarks.speed.peers import NumpyObjective
from quadid.model.needs_kernel import needs_of
from quadid.model.simd import LANES
from quadid.types import FloatArray

SECONDS, TURNS = 100.0, 20
PACKAGE = "quadid.model"
MODULES = (
    "simd", "rows", "kernel", "body_kernel", "needs_kernel", "rotor_kernel", "sensor_kernel", "rollout_kernel",
)  # fmt: skip
PREPARE = ("body_constants", "rotor_constants", "sensor_constants", "_rotation")
"""Kernels that prepare constants once a block: they stay in double precision."""
NUMBERS_IN_LINE = 16
"""float32 numbers in one cache line and in one AVX-512 register."""


class _Single(ast.NodeTransformer):
    """Makes every literal of a kernel a float32; imports of other kernels become those of the copies."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.AST:
        return node if node.name in PREPARE else self.generic_visit(node)

    def visit_Constant(self, node: ast.Constant) -> ast.AST:
        return ast.copy_location(_cast(node, "float32"), node) if isinstance(node.value, float) else node

    def visit_Call(self, node: ast.Call) -> ast.AST:
        self.generic_visit(node)
        if isinstance(node.func, ast.Name) and node.func.id in PREPARE:
            node.args = [_cast(a, "float64") if isinstance(a, ast.Name) and a.id == "dt" else a for a in node.args]
        return node

    def visit_ImportFrom(self, node: ast.ImportFrom) -> ast.AST:
        home, _, name = (node.module or "").rpartition(".")
        if home == PACKAGE and name in MODULES:
            node.module = f"{_COPIES}.{name}"
        return node


_COPIES = "quadid_single"
_ROOM = """
@nb.njit(**allocating)
def cache_aligned(size):
    room = np.empty(size + 16, np.float32)
    skip = -(room.ctypes.data // 4) % 16
    return room[skip : skip + size]
"""


def _cast(node: ast.expr, kind: str) -> ast.Call:
    return ast.Call(ast.Attribute(ast.Name("np", ast.Load()), kind, ast.Load()), [node], [])


def single_kernels() -> dict[str, types.ModuleType]:
    """Copies of the kernel's modules in single precision, by name; nothing of them is kept on disk."""
    parent = types.ModuleType(_COPIES)
    parent.__path__ = []
    sys.modules[_COPIES] = parent
    copies: dict[str, types.ModuleType] = {}
    for name in MODULES:
        path = Path(str(importlib.import_module(f"{PACKAGE}.{name}").__file__))
        tree = ast.parse(path.read_text(encoding="utf-8"))
        if name != "simd":
            tree = _Single().visit(tree)
        copy = types.ModuleType(f"{_COPIES}.{name}")
        copy.__file__ = str(path)
        sys.modules[copy.__name__] = copies[name] = copy
        exec(compile(ast.fix_missing_locations(tree), str(path), "exec"), copy.__dict__)
        if name == "simd":
            vars(copy)["LANES"] = 2 * LANES
            vars(copy)["cached"]["cache"] = False
            exec(_ROOM, copy.__dict__)
    return copies


def _aligned(size: int) -> NDArray[np.float32]:
    room = np.empty(size + NUMBERS_IN_LINE, np.float32)
    skip = -(room.ctypes.data // room.itemsize) % NUMBERS_IN_LINE
    return room[skip : skip + size]


def single(rounds: int) -> dict[str, Any]:
    """The swarm's cost in both precisions: nanoseconds per particle and step on one core, and how far costs differ."""
    objective = NumpyObjective(SECONDS)
    points = np.random.default_rng(2).uniform(objective.lower, objective.upper, (2 * LANES, 6))
    nominal = np.repeat(objective.theta[None], len(points), axis=0)
    nominal[:, objective.free.index] = np.exp(points)
    near = np.repeat(objective.theta[None], len(points), axis=0)
    cases = {"nominal": nominal, "every effect": every_effect(objective.vehicle, near)}
    kernels = single_kernels()
    found = {name: _compared(objective, thetas, kernels, rounds) for name, thetas in cases.items()}
    return {"seconds": SECONDS, "cases": found}


def _compared(
    objective: NumpyObjective, thetas: FloatArray, kernels: dict[str, types.ModuleType], rounds: int
) -> dict[str, float]:
    shooting = objective.shooting
    rollout, segments = shooting.rollouts[0], shooting.segments[0]
    double = partial(rollout.costs, segments, thetas[:LANES], objective.x0, objective.weights, objective.basis)
    coarse = _single_cost(objective, thetas, kernels)
    expected = rollout.costs(segments, thetas, objective.x0, objective.weights, objective.basis)
    begin = time.perf_counter()
    error = float(np.max(np.abs(coarse() / expected - 1.0)))
    compiled = time.perf_counter() - begin
    steps = len(segments.starts) * (segments.length + 1)
    best = {"double": np.inf, "single": np.inf}
    for _ in range(rounds * TURNS):
        for name, run, lanes in (("double", double, LANES), ("single", coarse, 2 * LANES)):
            start = time.thread_time()
            run()
            best[name] = min(best[name], 1e9 * (time.thread_time() - start) / (steps * lanes))
    return {**best, "gain": best["double"] / best["single"], "error": error, "compile": compiled}


def _single_cost(
    objective: NumpyObjective, thetas: FloatArray, kernels: dict[str, types.ModuleType]
) -> Callable[[], NDArray[np.float32]]:
    """The cost of one block of twice as many lanes, by the copies."""
    f, kernel = np.float32, kernels["rollout_kernel"]
    rollout, segments = objective.shooting.rollouts[0], objective.shooting.segments[0]
    (lanes,) = rollout._prepared(segments, 1, thetas[:LANES], None, 9)
    need = kernels["needs_kernel"].Needs(*needs_of(thetas, 4, 9))
    window, length = rollout.window, segments.length
    room, ends = _aligned(9 * 2 * LANES).reshape(1, 1, -1), np.empty((0, 0, 0), f)
    arguments = (
        window.rotor_speed.astype(f), rollout._slope.astype(f), window.sampling == "held", rollout.geometry.astype(f),
        rollout._terms, kernel.Flight(*(f(x) for x in rollout._flight)), lanes.table.astype(f),
        rollout.measured.astype(f),
        np.ascontiguousarray(objective.weights).astype(f), lanes.memory, segments.starts, 1, objective.x0.astype(f),
        thetas, np.zeros((12, 2 * LANES), f), need, 9, length, True, np.ascontiguousarray(objective.basis).astype(f),
        room, ends,
    )  # fmt: skip

    def run() -> NDArray[np.float32]:
        cost = np.zeros(2 * LANES, f)
        kernel.roll_segments(*arguments, cost)
        return cost

    return run
