"""Requests and answers of fits as bytes between machines: MessagePack of plain data, read by the types of our records.

What comes over a network names no function and no class: it is one of the kinds below, and every field has the type
that its record declares.  Sizes are checked before memory is taken, so that a few bytes never make gigabytes.
"""

from __future__ import annotations

import math
import types
import typing
from collections.abc import Callable, Mapping
from dataclasses import fields, is_dataclass
from functools import lru_cache
from typing import Any, Literal

import msgpack
import numpy as np

from quadid.errors import QuadidError
from quadid.online.background_diagnosis import DiagnosisReply, DiagnosisRequest
from quadid.online.fault_isolation import ChangeReply, ChangeRequest
from quadid.online.window_fit import FitReply, FitRequest
from quadid.vehicle import Vehicle

LARGEST = 1 << 24
"""Parcels beyond this are refused [bytes]; a minute of flight at 50 Hz has less than one mebibyte."""
MOST_ITEMS, LONGEST_TEXT, MOST_AXES = 4096, 1 << 16, 3
"""Entries of one list or map, characters of one text, axes of one array: declared sizes beyond are refused unread."""
MOST_IN_ALL = 1 << 16
"""Lists, maps and their entries in one parcel: an empty map is one byte that takes 64 of memory."""
KINDS: Mapping[str, type] = types.MappingProxyType({
    kind.__name__: kind
    for kind in (FitRequest, FitReply, ChangeRequest, ChangeReply, DiagnosisRequest, DiagnosisReply)
})  # fmt: skip


class ParcelError(QuadidError):
    """Bytes that are no parcel of ours."""


def pack(item: object) -> bytes:
    """A request or an answer as bytes; raises ParcelError for anything else."""
    kind = type(item).__name__
    if KINDS.get(kind) is not type(item):
        raise ParcelError(f"a parcel with a {kind}", ", ".join(KINDS))
    return bytes(msgpack.packb([kind, _encoded(item, type(item))], use_bin_type=True))


def content(payload: Any) -> bytes:
    """Bytes of a Zenoh payload, None for none; raises ParcelError for more than a parcel may have."""
    if payload is not None and len(payload) > LARGEST:
        raise ParcelError(f"a parcel of {len(payload)} bytes", f"at most {LARGEST}")
    return bytes(payload.to_bytes()) if payload is not None else b""


def unpack(data: bytes) -> Any:
    """The request or answer in bytes.

    Raises:
        ParcelError: too large, damaged, of another kind, or with a field of another type.
    """
    if len(data) > LARGEST:
        raise ParcelError(f"a parcel of {len(data)} bytes", f"at most {LARGEST}")
    left = MOST_IN_ALL

    def counted(found: Any) -> Any:
        nonlocal left
        left -= 1 + len(found)
        if left < 0:
            raise ParcelError(f"a parcel of more than {MOST_IN_ALL} entries", "what the record declares")
        return found

    try:
        kind, content = msgpack.unpackb(
            data, raw=False, strict_map_key=True, max_array_len=MOST_ITEMS, max_map_len=MOST_ITEMS,
            max_str_len=LONGEST_TEXT, max_bin_len=LARGEST, max_ext_len=0, list_hook=counted, object_hook=counted,
        )  # fmt: skip
        if not isinstance(kind, str) or kind not in KINDS:
            raise ParcelError(f"a parcel of kind {str(kind)[:60]!r}", ", ".join(KINDS))
        return _decoded(content, KINDS[kind], kind)
    except ParcelError:
        raise
    except Exception as error:
        raise ParcelError(f"damaged parcel ({type(error).__name__})", "a whole one, of the same version") from error


@lru_cache(maxsize=64)
def _hints(kind: type) -> dict[str, Any]:
    hints = typing.get_type_hints(kind)
    return {f.name: hints[f.name] for f in fields(kind) if f.init}


def _encoded(value: Any, kind: Any) -> Any:
    """Plain data of a value of a declared type."""
    kind = _of_union(kind, value)
    if value is None:
        return None
    if kind is Vehicle:
        return value.model_dump_json(exclude_unset=True)  # a default that is given is more than a default
    if _is_array(kind):
        array = np.ascontiguousarray(value, dtype="<f8")
        return [list(array.shape), array.tobytes(), bool(value.flags.writeable)]
    if is_dataclass(kind):
        return {name: _encoded(getattr(value, name), hint) for name, hint in _hints(typing.cast("type", kind)).items()}
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if origin is tuple:
        return [_encoded(v, inner[0] if inner[-1] is Ellipsis else inner[k]) for k, v in enumerate(value)]
    if origin is not None and origin is not Literal:
        return {str(name): _encoded(v, inner[1]) for name, v in value.items()}
    return value if origin is Literal else _PLAIN[kind](value)


_PLAIN: dict[Any, Callable[[Any], Any]] = {int: int, float: float, str: str, bool: bool}


def _decoded(data: Any, kind: Any, where: str) -> Any:
    """A value of a declared type; raises ParcelError where the data are of another."""
    if data is None and type(None) in typing.get_args(kind):
        return None
    kind = _of_union(kind, data)
    origin, inner = typing.get_origin(kind), typing.get_args(kind)
    if kind is Vehicle and isinstance(data, str):
        return Vehicle.model_validate_json(data)
    if _is_array(kind):
        return _array(data, where)
    if is_dataclass(kind) and isinstance(data, dict):
        hints = _hints(typing.cast("type", kind))
        if data.keys() != hints.keys():
            raise ParcelError(f"{where} with other fields", "a parcel of the same version")
        made = {name: _decoded(data[name], hint, f"{where}.{name}") for name, hint in hints.items()}
        return typing.cast("type", kind)(**made)
    if origin is tuple and isinstance(data, list):
        if inner[-1] is not Ellipsis and len(data) != len(inner):
            raise ParcelError(f"{where} of {len(data)} entries", f"{len(inner)}")
        return tuple(
            _decoded(v, inner[0] if inner[-1] is Ellipsis else inner[k], f"{where}[{k}]") for k, v in enumerate(data)
        )
    if origin is Literal and data in inner:
        return data
    if origin not in (None, tuple, Literal) and isinstance(data, dict):
        return {name: _decoded(v, inner[1], f"{where}.{name}"[:80]) for name, v in data.items()}
    if kind in _PLAIN and (type(data) is kind or (kind is float and type(data) is int)):
        return _PLAIN[kind](data)
    raise ParcelError(f"{where} that is a {type(data).__name__}", "what the record declares")


def _array(data: Any, where: str) -> np.ndarray[Any, Any]:
    """An array from shape, bytes and whether it may be written; its size is that of the bytes, whatever it claims."""
    if not (isinstance(data, list) and len(data) == 3 and isinstance(data[0], list) and isinstance(data[1], bytes)):
        raise ParcelError(f"{where} that is no array", "shape, bytes and whether it may be written")
    shape, content, writable = data
    if len(shape) > MOST_AXES or not all(type(n) is int and 0 <= n <= LARGEST for n in shape):
        raise ParcelError(f"{where} of a shape that is none", f"up to {MOST_AXES} axes")
    if math.prod(shape) * 8 != len(content):
        raise ParcelError(f"{where} of shape {shape} in {len(content)} bytes", "8 bytes a number")
    found = np.frombuffer(content, "<f8").reshape(shape)
    return found.copy() if writable is True else found


def _is_array(kind: Any) -> bool:
    return kind is np.ndarray or typing.get_origin(kind) is np.ndarray


def _of_union(kind: Any, value: Any) -> Any:
    """The type beside None of an optional one."""
    if typing.get_origin(kind) not in (typing.Union, types.UnionType):
        return kind
    (only,) = (part for part in typing.get_args(kind) if part is not type(None))
    return only
