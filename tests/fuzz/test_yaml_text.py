"""Vehicle files with slips and traps: one line that names the key, the cause and the mend, at once."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from quadid.errors import VehicleError
from quadid.vehicle import Vehicle
from quadid.yaml_text import LARGEST, read_mapping
from tests.faults.evidence import Happened

TEXT = Vehicle.shipped("pelican").to_yaml()


def with_mass(value: str) -> str:
    return TEXT.replace("mass: 1.3", f"mass: {value}")


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
}

SLIPS = {
    "grams": (with_mass("1300"), "mass in grams? 1.3 kg would fit"),
    "millimetres": (TEXT.replace("0.21", "210.0"), "rotor positions in millimetres? 0.21 m would fit"),
    "centimetres": (TEXT.replace("0.21", "21.0"), "rotor positions in "),
    "a wrong key": (TEXT.replace("mass:", "mas:"), "unknown key 'mas'; did you mean 'mass'"),
    "b of another unit": (
        TEXT.replace("2.0e-05", "2.0e-19").replace("1.0e-05, 5.0e-05", "1.0e-19, 5.0e-19"), "b within its bounds"
    ),
}  # fmt: skip


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
