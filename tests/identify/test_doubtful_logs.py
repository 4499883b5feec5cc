"""Values beside a named doubt: the check says how far estimates are off if it is right, and intervals hold that."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

import quadid
from quadid.checks.doubts import estimates_off, rotors_off
from quadid.flight.setup import TABLE_2
from quadid.vehicle import Vehicle
from tests.cli.mistakes import Place

PELICAN = Vehicle.shipped("pelican")


@pytest.fixture(scope="module")
def place(tmp_path_factory: pytest.TempPathFactory) -> Place:
    """A minute of flight."""
    made = Place(tmp_path_factory.mktemp("doubts"))
    quadid.simulate(seconds=60.0, seed=12, extras=("velocity", "position")).save(made.log)
    return made


def read_too_fast(place: Place) -> tuple[Path, str]:
    return place.of_rotors(lambda w: w * [1.0, 1.3, 1.0, 1.0]), "pelican"


def gyro_too_small(place: Place) -> tuple[Path, str]:
    return place.scaled("p q r", 0.8), "pelican"


def mass_in_pounds(place: Place) -> tuple[Path, str]:
    return place.log, str(place.vehicle(mass=1.3 * 2.2046))


def one_arm_too_long(place: Place) -> tuple[Path, str]:
    rotors = [{"position": list(r.position), "spin": r.spin} for r in PELICAN.rotors]
    rotors[0]["position"] = [1.4 * x for x in PELICAN.rotors[0].position]
    return place.log, str(place.vehicle(rotors=rotors))


@pytest.mark.parametrize("mistake", [read_too_fast, gyro_too_small, mass_in_pounds, one_arm_too_long])
def test_no_value_is_called_identified_whose_interval_lacks_the_truth(
    mistake: Callable[[Place], tuple[Path, str]], place: Place
) -> None:
    log, vehicle = mistake(place)
    result = quadid.identify(log, vehicle=vehicle).result
    rows = {p["name"]: p for p in result["parameters"]}
    assert [n for n, p in rows.items() if not p["ci95"][0] <= TABLE_2[n] <= p["ci95"][1]] == []
    assert "unreliable" in {p["status"] for p in rows.values()}
    assert any("these estimates are off" in text for text in result["warnings"])


def test_a_log_that_lost_a_third_of_its_rows_has_the_same_parameters(place: Place) -> None:
    """Rows between lost ones passed for measurements: J_xx was 16 % low and J_r 28 % high, `identified`."""
    names, rows = place.table()
    kept = np.random.default_rng(0).random(len(rows)) > 0.3
    found = {
        p["name"]: p for p in quadid.identify(place.write(names, rows[kept]), vehicle="pelican").result["parameters"]
    }
    assert [n for n, p in found.items() if not p["ci95"][0] <= TABLE_2[n] <= p["ci95"][1]] == []
    assert [found[n]["value"] for n in ("J_xx", "J_yy")] == pytest.approx(
        [TABLE_2[n] for n in ("J_xx", "J_yy")], rel=0.03
    )


def test_a_diagnosis_holds_the_doubt_as_an_identification_does(place: Place) -> None:
    log = gyro_too_small(place)[0]
    rows = {p["name"]: p for p in quadid.diagnose(f"{log}@0:20", vehicle="pelican").result["parameters"]}
    assert [n for n, p in rows.items() if not p["ci95"][0] <= TABLE_2[n] <= p["ci95"][1]] == []
    assert rows["J_xx"]["status"] == "unreliable"


def test_the_arm_of_one_rotor_is_named_where_no_reading_explains_the_balance(place: Place) -> None:
    """The reading was "1.00 times its speed"."""
    log, vehicle = one_arm_too_long(place)
    (text,) = [t for t in quadid.load(log, vehicle).doubts if "balance" in t]
    assert "rotor 1 stood 0.71 or 3 stood 1.40 times as far" in text
    assert "1.00 times" not in text


def test_a_gyro_that_reads_too_much_makes_inertias_small() -> None:
    """J_xx' s dp = tau, (J_zz' - J_yy') s^2 = J_zz - J_yy, d' / J_zz' = s d / J_zz."""
    off = {n: math.exp(x) for n, x in estimates_off(turning=(1.25, 1.25, 1.25)).items()}
    assert off["b"] == 1.0
    assert off["J_xx"] == off["J_yy"] == pytest.approx(0.8)
    assert 2.0 * off["J_zz"] - off["J_yy"] == pytest.approx(0.64)
    assert off["d"] == pytest.approx(1.25 * off["J_zz"])


def test_mass_moves_all_six_and_the_arm_all_but_b() -> None:
    assert list(estimates_off(mass=1.3).values()) == pytest.approx([math.log(1.3)] * 6)
    off = estimates_off(torque=(0.8, 0.8, 1.0))
    assert off["b"] == 0.0
    assert [x for n, x in off.items() if n != "b"] == pytest.approx([-math.log(0.8)] * 5)


def test_a_rotor_read_too_fast_moves_b_and_the_inertias() -> None:
    rng = np.random.default_rng(1)
    true = rng.normal(450.0, 5.0, (1000, 4))
    off = rotors_off(PELICAN, true * [1.0, 1.3, 1.0, 1.0], true)
    b = -math.log(1.0 + 0.69 / 4.0)
    assert off["b"] == pytest.approx(b, abs=1e-3)
    assert off["J_yy"] == pytest.approx(b, abs=1e-3)
    assert off["J_xx"] == pytest.approx(b + math.log(1.0 + 0.69 / 2.0), abs=1e-3)
