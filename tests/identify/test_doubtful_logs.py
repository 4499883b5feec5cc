"""Values beside a named doubt: the check says how far estimates are off if it is right, and intervals hold that."""

import math
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from quadid_replay import open_log

import quadid
from quadid.checks import inspect
from quadid.checks.findings import estimates_off, rotors_off
from quadid.errors import LogError
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


def gyro_tilted(place: Place) -> tuple[Path, str]:
    """By 6 degrees about x: J_zz was -2.7 [-5.0, -0.3] %, `identified`."""
    names, rows = place.table()
    gyro = [names.index(n) for n in "pqr"]
    (cos, sin) = (math.cos(math.radians(6.0)), math.sin(math.radians(6.0)))
    rows[:, gyro] = rows[:, gyro] @ np.array([[1.0, 0.0, 0.0], [0.0, cos, sin], [0.0, -sin, cos]])
    return place.write(names, rows), "pelican"


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


def test_a_tilted_gyro_moves_the_yaw_axis_by_what_it_reads_of_the_others(place: Place) -> None:
    log, vehicle = gyro_tilted(place)
    result = quadid.identify(log, vehicle=vehicle).result
    rows = {p["name"]: p for p in result["parameters"]}
    assert [n for n, p in rows.items() if not p["ci95"][0] <= TABLE_2[n] <= p["ci95"][1]] == []
    assert any("gyro is turned against the attitude: roll -5.9" in text for text in result["warnings"])


def test_axes_of_velocity_that_are_exchanged_are_named_also_with_the_vertical_one(place: Place) -> None:
    """Forward and down exchanged: b was 10 % low, unreliable, and no word of why."""
    log = place.moved("vx vz", "vz vx")
    assert any(
        "velocity differ from those of position: x = z, y = y, z = x" in w for w in quadid.load(log, "pelican").doubts
    )


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


@pytest.mark.parametrize(("columns", "scale"), [("p q r", 0.95), ("p q r", 1.06), ("q", 0.9)])
def test_a_scale_of_the_gyro_is_named_from_five_percent_on(columns: str, scale: float, place: Place) -> None:
    """All from 0.85 to 1.15 was "ok"; beside an attitude of its own a minute tells it to 1 %."""
    sizes = 1.0 / np.array([scale if axis in columns else 1.0 for axis in "pqr"])
    found = {c.name: c for c in inspect(open_log(place.scaled(columns, scale)), PELICAN).checks}
    check = found["gyro_attitude"]
    assert check.verdict.value == "warning"
    told = [float(text) for text in re.findall(r"= ([0-9.]+) \+-", check.message)]
    assert told == pytest.approx(sizes.tolist(), abs=0.02)
    assert check.off["J_yy"] == pytest.approx(math.log(sizes[1]), abs=0.02)


def filled(place: Place, columns: str, last: float = math.inf) -> Path:
    """The flight with zeros in some columns up to a time [s]."""
    names, rows = place.table()
    for name in columns.split():
        rows[rows[:, 0] <= last, names.index(name)] = float(name == "qw")
    return place.write(names, rows)


@pytest.mark.parametrize(
    ("columns", "last"), [("vx vy vz", math.inf), ("vz", math.inf), ("vx vy vz", 30.0), ("qw qx qy qz", math.inf)]
)
def test_a_state_that_a_logger_filled_is_no_measurement(columns: str, last: float, place: Place) -> None:
    """With a velocity of zeros b was 57 % low, with vz alone 4 % and `identified`."""
    result = quadid.identify(filled(place, columns, last), vehicle="pelican").result
    found = {p["name"]: p for p in result["parameters"]}
    assert [n for n, p in found.items() if not p["ci95"][0] <= TABLE_2[n] <= p["ci95"][1]] == []
    assert found["b"]["value"] == pytest.approx(TABLE_2["b"], rel=0.01)
    assert any("stay the same for seconds while the gyro turns" in text for text in result["warnings"])


def test_speeds_in_steps_make_inertias_as_much_too_large_as_their_noise(place: Place) -> None:
    """In steps of 10 rad/s J_xx was 15 % high [1.5, 31], `identified`, and nothing was said."""
    log = place.of_rotors(lambda w: 10.0 * np.round(w / 10.0))
    result = quadid.identify(f"{log}@0:20", vehicle="pelican").result
    found = {p["name"]: p for p in result["parameters"]}
    assert [n for n, p in found.items() if not p["ci95"][0] <= TABLE_2[n] <= p["ci95"][1]] == []
    assert any("come in steps of 10 rad/s" in text for text in result["warnings"])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda w: w * [1, 1, 0, 1] + [0, 0, 450, 0], "rotor 3 holds 450 rad/s"),
        (lambda w: w * [1, 0, 1, 1] + [0, 300, 0, 0], "rotor 2 holds 300 rad/s"),
        (lambda w: 20.0 * np.round(w[:, [0, 0, 2, 3]] / 20.0), "rotor columns 1 and 2 are the same"),
    ],
)
def test_a_rotor_that_holds_a_value_no_other_reaches_is_stuck(
    change: Callable[[np.ndarray], np.ndarray], said: str, place: Place
) -> None:
    """The largest and smallest speed of all passed for limits, also where it was of the rotor that is stuck.

    Columns that are one are no less so in coarse steps, of which alone a warning spoke.
    """
    with pytest.raises(LogError, match=said):
        quadid.load(place.of_rotors(change), "pelican")


def test_a_channel_of_which_nothing_is_left_is_named(place: Place) -> None:
    """Quaternions of zeros went without a word."""
    log = place.scaled("qw qx qy qz", 0.0)
    (text,) = [w for w in quadid.load(log, "pelican").warnings if "attitude:" in w]
    assert "that are no attitude (quaternion far from unit length), none is left" in text


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
