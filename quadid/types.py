"""Types that every room shares, and the check of shapes at the door of a kernel. Units stand where they are used."""

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]
IntArray: TypeAlias = NDArray[np.int64]
"""Numbers kept as such, as in a log or a file."""
IndexArray: TypeAlias = NDArray[np.intp]
"""Places in another array."""
JsonDict: TypeAlias = dict[str, Any]
"""A result, or a part of one, as JSON holds it …"""
Json: TypeAlias = Mapping[str, Any]
"""… and one that is only read."""


def check_shapes(kernel: str, *arrays: tuple[str, NDArray[Any], tuple[int, ...]]) -> None:
    """Checks arrays before a compiled kernel reads them: it looks at no bounds, and would end the process.

    Args:
        kernel: name, for the message.
        arrays: name, array, and the shape that the kernel takes it to have.

    Raises:
        ValueError: an array of another shape.
    """
    for name, array, shape in arrays:
        if array.shape != shape:
            raise ValueError(f"{kernel}: {name} of shape {array.shape}; allowed: {shape}")
