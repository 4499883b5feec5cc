"""Vehicle files of any content: a vehicle, or one error that says what is wrong, at once."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from hypothesis import given, settings
from hypothesis import strategies as st

from quadid.effects import EFFECTS
from quadid.errors import QuadidError, VehicleError
from quadid.model.layout import Layout
from quadid.parameters import VANISHED
from quadid.report.programs import FORMATS, export
from quadid.vehicle import ParameterPrior, Vehicle
from quadid.yaml_text import LARGEST, read_mapping
from tests.faults.evidence import Happened

# --- Whatever a vehicle file holds, it is a vehicle or one error that says what is wrong


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
        "motor_lag": {"tau": 0.03, "tau_down": 0.05},
        "rotor_drag": {"k_x": 0.2, "k_y": 0.2},
        "weak_rotor": {"rotor": 3.0, "loss": 0.1},
        "cg_offset": {"x": 0.001, "y": 0.0},
    },
    "reference_voltage": 12.0,
}


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


# --- Vehicle files with slips and traps: one line that names the key, the cause and the mend, at once


TEXT = Vehicle.shipped("pelican").to_yaml()


def with_mass(value: str) -> str:
    return TEXT.replace("mass: 1.3", f"mass: {value}")


def with_effects(value: str) -> str:
    return TEXT.replace("effects: {}", f"effects: {{{value}}}")


TRAPS = {
    "a key twice": (TEXT.replace("mass:", "mass: 1.0\nmass:"), "key 'mass' appears twice"),
    "a merge bomb": ("a: &a [x]\nb: &b [*a, *a]\n<<: *b\n" + TEXT, "anchors and aliases"),
    "deep nesting": (TEXT + "x: " + "[" * 20000, "nested deeper than"),
    "deep mappings": (TEXT + "x: " + "{a: " * 300 + "1" + "}" * 300, "nested deeper than"),
    "20,000 digits": (with_mass("9" * 20000), "mass: a number of 20000 characters"),
    "base sixty": (with_mass("1:30"), "mass: 1:30 is no decimal number"),
    "octal": (with_mass("010"), "mass: 010 is no decimal number"),
    "underscores": (with_mass("1_3"), "mass: 1_3 is no decimal number"),
    "a truth value": (with_mass("yes"), "mass: yes is a truth value"),
    "a tag": (with_mass("!!python/object/apply:os.system [ls]"), "tag"),
    "a mass of 1e308": (with_mass("1e308"), "mass 1e+308 kg"),
    "too much": (TEXT + "#" * LARGEST, "characters"),
    "a list of thousands": ("a: [" + "1," * 30_000 + "1]\n", "unknown key 'a'"),
    "nothing": ("", "holds nothing"),
    "no text": ("\x00", "not YAML"),
    "words": ("just text", "mapping"),
}

SLIPS = {
    "grams": (with_mass("1300"), "mass in grams? 1.3 kg would fit"),
    "millimetres": (TEXT.replace("0.21", "210.0"), "rotor positions in millimetres? 0.21 m would fit"),
    "centimetres": (TEXT.replace("0.21", "21.0"), "rotor positions in "),
    "a wrong key": (TEXT.replace("mass:", "mas:"), "unknown key 'mas'; did you mean 'mass'"),
    "a mass below nothing": (with_mass("-1.0"), "mass"),
    "a wrong effect": (with_effects("motor_lga: {tau: 0.1}"), "did you mean 'motor_lag'?"),
    "a list of effects": (TEXT.replace("effects: {}", "effects: [1]"), "effects must map names"),
    "a lag before its command": (with_effects("motor_lag: {tau: -0.05}"), "effects.motor_lag.tau = -0.05"),
    "a lag of a minute": (with_effects("motor_lag: {tau: 50}"), "allowed: 0 to 0.3 s on a vehicle of this"),
    "a slower lag in ms": (with_effects("motor_lag: {tau: 0.03, tau_down: 40}"), "motor_lag.tau_down = 40"),
    "a loss in percent": (with_effects("weak_rotor: {rotor: 3, loss: 20}"), "weak_rotor.loss = 20"),
    "losses in percent": (with_effects("weak_rotor: {loss_1: 0.1, loss_2: 20}"), "weak_rotor.loss_2 = 20"),
    "an IMU in mm": (TEXT + "mounting: {position: [40, 0, 0]}\n", "effects.imu_lever_arm.x = 40"),
    "a mass that may be none": (TEXT + "mass_sigma: 1.4\n", "mass_sigma 1.4 is no less than the mass"),
    "a correlation with itself": (TEXT + "correlation: {b: {b: 0.5}}\n", "b beside itself"),
    "b of another unit": (
        TEXT.replace("2.0e-05", "2.0e-19").replace("1.0e-05, 5.0e-05", "1.0e-19, 5.0e-19"),
        "b within its bounds",
    ),
}


@pytest.mark.parametrize("name", [*TRAPS, *SLIPS])
def test_it_is_answered_in_one_line(name: str, happened: Happened) -> None:
    text, answer = {**TRAPS, **SLIPS}[name]
    assert text != TEXT
    with pytest.raises(VehicleError) as error:
        Vehicle.from_yaml(text, "v.yaml")
    said = str(error.value)
    assert answer in said
    assert "\n" not in said
    assert len(said) < 600
    happened(32, f"{name}: '{said[:110]}'")


def test_what_people_write_is_read_as_they_mean_it() -> None:
    got = read_mapping("a: 1e-5\nb: [-.5, +2, 3.]\nc: 'yes'\nd: ~\ne: word\nf: {x: 1, y: 2}\n", "x")
    assert got == {"a": 1e-5, "b": [-0.5, 2, 3.0], "c": "yes", "d": None, "e": "word", "f": {"x": 1, "y": 2}}


def test_every_vehicle_file_at_hand_is_read(data_dir: Path) -> None:
    files = sorted(data_dir.glob("*/*.yaml")) + sorted(data_dir.glob("cases*/*/vehicle.yaml"))
    assert len(files) > 20
    for file in files:
        vehicle = Vehicle.from_yaml(file.read_text(encoding="utf-8"), file.name)
        np.testing.assert_array_equal(Vehicle.from_yaml(vehicle.to_yaml()).initial, vehicle.initial)


@pytest.mark.parametrize("corner", [0.251, 1.0, 3.99])
def test_what_a_fit_within_its_box_may_find_is_read_again(corner: float) -> None:
    """Every number of every effect at both of its bounds, wherever the six went, and J_r vanished."""
    pelican = Vehicle.shipped("pelican")
    layout = Layout(pelican)
    moved = {n: ParameterPrior(initial=p.initial * corner) for n, p in pelican.parameters.items()}
    moved["J_r"] = ParameterPrior(initial=pelican.parameters["J_r"].initial * VANISHED)
    for entry in layout.entries.values():
        effect = entry.name.split(".")[0]
        for value in (entry.lower, entry.upper) if effect in EFFECTS else ():
            theta = layout.neutral()
            theta[entry.index] = value
            numbers = {k: float(f"{v:.4g}") for k, v in layout.read_effect(theta, effect).items() if np.isfinite(v)}
            written = pelican.model_copy(update={"parameters": moved, "effects": {effect: numbers}}).to_yaml()
            assert Vehicle.from_yaml(written).effects == {effect: numbers}
