"""Pieces of kernels: written once, made machine code in the kernels that call them."""

from __future__ import annotations

import numba as nb
import numpy as np
import pytest

from quadid.model.simd import inlined, jit, whole
from quadid.types import FloatArray


@nb.njit(**inlined)
def square(x: float) -> float:
    return x * x


@nb.njit(**jit)
def add_squares(place: int, a: FloatArray) -> float:
    out = 0.0
    for i in range(place, len(a)):
        out += square(a[i])
    return out


@nb.njit(**whole)
def both(a: FloatArray, first: int) -> float:
    return float(add_squares(first, a) + square(a[first]))


def test_a_kernel_calls_its_pieces() -> None:
    assert both(np.array([1.0, 2.0, 3.0]), 1) == 4.0 + 9.0 + 4.0


def test_a_piece_that_is_merged_leaves_no_machine_code() -> None:
    both(np.ones(3), 0)
    (compiled,) = square.overloads.values()
    assert not compiled.library.codegen._engine.is_symbol_defined(compiled.fndesc.mangled_name)


def test_python_cannot_call_a_piece() -> None:
    both(np.ones(3), 0)
    with pytest.raises(KeyError, match="add_squares is called by kernels only"):
        add_squares(0, np.ones(3))
