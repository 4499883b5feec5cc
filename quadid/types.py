"""Types that every room shares. Shape and unit stand where they are used."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import numpy as np
from numpy.typing import NDArray

FloatArray: TypeAlias = NDArray[np.float64]
ComplexArray: TypeAlias = NDArray[np.complex128]
BoolArray: TypeAlias = NDArray[np.bool_]
SingleArray: TypeAlias = NDArray[np.float32]
"""Where half the digits do, and the room counts."""
IntArray: TypeAlias = NDArray[np.int64]
"""Numbers kept as such, as in a log or a file."""
IndexArray: TypeAlias = NDArray[np.intp]
"""Places in another array."""
JsonDict: TypeAlias = dict[str, Any]
"""A result, or a part of one, as JSON holds it …"""
Json: TypeAlias = Mapping[str, Any]
"""… and one that is only read."""
