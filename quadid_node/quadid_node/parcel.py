"""Requests and answers of fits as bytes between machines: pickles of which only our own records are let in.

A pickle may name any function of any module and have it called.  What comes over a network is therefore read by an
unpickler that knows the records a fit consists of and numpy's arrays, and refuses every other name.
"""

from __future__ import annotations

import io
import pickle
import pickletools
from typing import Any

from quadid.errors import QuadidError

LARGEST = 1 << 26
"""Parcels beyond this are refused [bytes]; a minute of flight at 50 Hz has less than one mebibyte."""
ROOMS = ("quadid.vehicle", "quadid.effects", "quadid.window", "quadid.parameters", "quadid.identify.", "quadid.online.")
"""Modules whose classes may be in a parcel."""
_NUMPY = {
    ("numpy", "ndarray"), ("numpy", "dtype"), ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"), ("numpy._core.numeric", "_frombuffer"),
    ("numpy.core.multiarray", "_reconstruct"), ("numpy.core.multiarray", "scalar"),
    ("numpy.core.numeric", "_frombuffer"),
}  # fmt: skip
_PLAIN = {("builtins", n) for n in ("complex", "frozenset", "set", "slice", "range", "bytearray")}


class ParcelError(QuadidError):
    """Bytes that are no parcel of ours."""


class _Reader(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        """Our own classes and numpy's arrays; anything else ends the reading."""
        if (module, name) in _NUMPY | _PLAIN:
            return super().find_class(module, name)
        ours = any(module == room or (room.endswith(".") and module.startswith(room)) for room in ROOMS)
        found = super().find_class(module, name) if ours and "." not in name else None
        if not isinstance(found, type) or found.__module__ != module:
            raise ParcelError(f"a parcel that wants {module[:60]}.{name[:60]}", "records of fits and arrays only")
        return found


def pack(item: object) -> bytes:
    """A request or an answer as bytes."""
    return pickle.dumps(item, protocol=5)  # keeps arrays read-only: the kernels that are warm are those for such


def unpack(data: bytes) -> Any:
    """The request or answer in bytes.

    Raises:
        ParcelError: too large, damaged, or naming something that no parcel needs.
    """
    if len(data) > LARGEST:
        raise ParcelError(f"a parcel of {len(data)} bytes", f"at most {LARGEST}")
    try:
        for _ in pickletools.genops(data):
            pass
        return _Reader(io.BytesIO(data)).load()
    except ParcelError:
        raise
    except Exception as error:
        raise ParcelError(f"damaged parcel ({type(error).__name__})", "a whole one, of the same version") from error
