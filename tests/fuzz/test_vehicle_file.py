"""Whatever a vehicle file holds, it is a vehicle or one error that says what is wrong."""

from __future__ import annotations

from typing import Any

import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from quadid.errors import QuadidError
from quadid.model.layout import Layout
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
        assert "\n" not in got
    else:
        Layout(got).initial(got)


@settings(max_examples=150)
@given(text=st.text(max_size=60))
def test_any_text_is_a_vehicle_or_one_error(text: str) -> None:
    assert isinstance(read(text), str)  # six parameters do not fit into so little
