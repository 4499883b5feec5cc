"""Whatever a vehicle file holds, it is a vehicle or one error that says what is wrong."""

from __future__ import annotations

import re
from typing import Any

import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from quadid.errors import QuadidError
from quadid.model.layout import Layout
from quadid.report.programs import FORMATS, export
from quadid.vehicle import Vehicle

SCALARS = st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=8)
VALUES = st.recursive(
    SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4)
)
PELICAN: dict[str, Any] = yaml.safe_load(Vehicle.shipped("pelican_x").to_yaml())


def places(part: Any, path: tuple[Any, ...] = ()) -> list[tuple[Any, ...]]:
    """Paths to everything in a document."""
    inside = part.items() if isinstance(part, dict) else enumerate(part) if isinstance(part, list) else ()
    return [path, *(p for key, value in inside for p in places(value, (*path, key)))]


def replaced(part: Any, path: tuple[Any, ...], value: Any) -> Any:
    """The document with another value at `path`."""
    if not path:
        return value
    out = dict(part) if isinstance(part, dict) else list(part)
    out[path[0]] = replaced(part[path[0]], path[1:], value)
    return out


def read(text: str) -> Vehicle | str:
    """The vehicle, or the error's text."""
    try:
        return Vehicle.from_yaml(text)
    except QuadidError as error:
        return str(error)


@settings(max_examples=150)
@given(path=st.sampled_from(places(PELICAN)), value=VALUES)
def test_a_file_with_anything_anywhere_is_a_vehicle_or_one_error(path: tuple[Any, ...], value: Any) -> None:
    got = read(yaml.safe_dump(replaced(PELICAN, path, value), allow_unicode=True))
    if isinstance(got, str):
        assert got.isprintable()
    else:
        Layout(got).initial(got)


def test_an_unknown_key_of_several_lines_is_one_line_of_the_error() -> None:
    assert "unknown key 'x ?[31m y'" in read(yaml.safe_dump(PELICAN | {"x\n\x1b[31m\u2028y": 1}))


@settings(max_examples=150)
@given(text=st.text(max_size=60))
def test_any_text_is_a_vehicle_or_one_error(text: str) -> None:
    assert isinstance(read(text), str)  # six parameters do not fit into so little


WITH_EFFECTS = PELICAN | {
    "effects": {
        "motor_lag": {"tau": 0.03}, "rotor_drag": {"k_x": 0.2, "k_y": 0.2}, "weak_rotor": {"rotor": 3.0, "loss": 0.1},
        "cg_offset": {"x": 0.001, "y": 0.0},
    },
    "reference_voltage": 12.0,
}  # fmt: skip


@pytest.mark.parametrize("extreme", [1e308, -1e308, 5e-324, 1e-300, float("inf"), 10**400, 1e154, 1e30, 1e29, 1e-29])
def test_no_number_of_a_file_makes_one_in_an_export_that_is_none(extreme: float) -> None:
    """`.inf` as an effect was written into scripts as `inf`, 1e308 as what it is multiplied to."""
    for path in places(WITH_EFFECTS):
        got = read(yaml.safe_dump(replaced(WITH_EFFECTS, path, extreme)))
        if isinstance(got, str) or not isinstance(extreme, float):
            assert isinstance(got, str), path
            continue
        for form in FORMATS:
            try:
                texts = export(got, form, "test")
            except QuadidError:
                continue
            for text in texts.values():
                assert not re.search(r"(?i)(?<![a-z_])(nan|inf)(?![a-z_])", text), (path, form)
