"""ESC_INFO (290) and ESC_STATUS (291) of MAVLink's common dialect, which pymavlink lacks, added at run time.

The definitions are those of `dialects/quadid.xml`; a test generates that file with mavgen and compares.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from types import ModuleType
from typing import Any, NamedTuple

ESC_INFO, ESC_STATUS = 290, 291


class _Field(NamedTuple):
    """A field in the order of the XML: name, C type, struct code, array length (0: none), place in the payload."""

    name: str
    kind: str
    code: str
    length: int
    order: int


_INFO = (
    _Field("index", "uint8_t", "B", 0, 5),
    _Field("time_usec", "uint64_t", "Q", 0, 0),
    _Field("counter", "uint16_t", "H", 0, 2),
    _Field("count", "uint8_t", "B", 0, 6),
    _Field("connection_type", "uint8_t", "B", 0, 7),
    _Field("info", "uint8_t", "B", 0, 8),
    _Field("failure_flags", "uint16_t", "H", 4, 3),
    _Field("error_count", "uint32_t", "I", 4, 1),
    _Field("temperature", "int16_t", "h", 4, 4),
)
_STATUS = (
    _Field("index", "uint8_t", "B", 0, 4),
    _Field("time_usec", "uint64_t", "Q", 0, 0),
    _Field("rpm", "int32_t", "i", 4, 1),
    _Field("voltage", "float", "f", 4, 2),
    _Field("current", "float", "f", 4, 3),
)


def extend_dialect(dialect: ModuleType) -> ModuleType:
    """Adds both messages to a MAVLink 2 dialect module of pymavlink, unless it has them; returns the module.

    The module gains ``MAVLink_esc_info_message`` and ``MAVLink_esc_status_message``, whose arguments are the fields in
    the order of the XML, and decodes both.
    """
    for number, name, crc_extra, fields in (
        (ESC_INFO, "ESC_INFO", 251, _INFO),
        (ESC_STATUS, "ESC_STATUS", 10, _STATUS),
    ):
        if number not in dialect.mavlink_map:
            message = _message_class(dialect, number, name, crc_extra, fields)
            dialect.mavlink_map[number] = message
            setattr(dialect, message.__name__, message)
            setattr(dialect, f"MAVLINK_MSG_ID_{name}", number)
    return dialect


def _message_class(dialect: ModuleType, number: int, name: str, crc_extra: int, fields: Sequence[_Field]) -> type[Any]:
    """Builds the class that mavgen would have written."""
    packed = sorted(fields, key=lambda f: f.order)
    base = dialect.MAVLink_message
    unpacker = struct.Struct("<" + "".join(f"{f.length or ''}{f.code}" for f in packed))

    def initialise(self: Any, *values: Any) -> None:
        if len(values) != len(fields):
            raise TypeError(f"{name} takes {len(fields)} values: {', '.join(f.name for f in fields)}")
        base.__init__(self, number, name)
        self._fieldnames = [f.name for f in fields]
        self._instance_field, self._instance_offset = "index", unpacker.size
        for field, value in zip(fields, values, strict=True):
            setattr(self, field.name, value)

    def pack(self: Any, mav: Any, force_mavlink1: bool = False) -> bytes:
        flat: list[Any] = []
        for field in packed:
            value = getattr(self, field.name)
            flat.extend(value if field.length else [value])
        return bytes(self._pack(mav, crc_extra, unpacker.pack(*flat), force_mavlink1=force_mavlink1))

    attributes = {
        "id": number,
        "msgname": name,
        "fieldnames": [f.name for f in fields],
        "ordered_fieldnames": [f.name for f in packed],
        "fieldtypes": [f.kind for f in fields],
        "fielddisplays_by_name": {},
        "fieldenums_by_name": {},
        "fieldunits_by_name": {},
        "native_format": bytearray(("<" + "".join(f.code for f in packed)).encode()),
        "orders": [f.order for f in fields],
        "lengths": [f.length or 1 for f in packed],
        "array_lengths": [f.length for f in packed],
        "crc_extra": crc_extra,
        "unpacker": unpacker,
        "instance_field": "index",
        "instance_offset": struct.calcsize(
            "<" + "".join(f"{f.length or ''}{f.code}" for f in packed[: fields[0].order])
        ),
        "__init__": initialise,
        "pack": pack,
    }
    return type(f"MAVLink_{name.lower()}_message", (base,), attributes)
