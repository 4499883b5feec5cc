"""Results as data that JSON holds."""

import math
from collections.abc import Mapping
from enum import Enum
from pathlib import PurePath
from typing import Any


def jsonable(value: Any) -> Any:
    """Returns `value` as dictionaries, lists, text, numbers and None, so that any program reads it.

    Args:
        value: mappings, sequences, numpy numbers and arrays, enumerations and paths, nested as they like.  NaN and
            infinities, for which JSON has no word, become None; keys become text.
    """
    if isinstance(value, Enum):
        return jsonable(value.value)
    if isinstance(value, Mapping):
        return {str(key): jsonable(inner) for key, inner in value.items()}
    if isinstance(value, PurePath):
        return str(value)
    if hasattr(value, "tolist"):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [jsonable(inner) for inner in value]
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    return value
