"""The short campaign: what was hidden must be found, by its name, and nothing else."""

import pytest

from quadid.diagnosis import Diagnosis
from quadid.flight import OUTSIDE
from quadid.parameters import NOMINAL_NAMES
from tests.diagnose.hidden import SECONDS, answer, confident, number, of_class, require_named, require_nothing, single

QUICK = ("attitude_delay", "mass_change", "battery_sag", "accel_bias", "imu_lever_arm")
OTHERS = (
    "motor_lag", "rotor_drag", "weak_rotor",  # `test_later_effects` has them quickly
    "command_delay", "imu_lag", "rotor_drag_moment", "rate_damping", "axial_inflow", "wind", "cg_offset", "thrust_drop",
    "thrust_curve", "product_of_inertia", "rotor_spin_up", "gyro_bias", "gyro_scale", "imu_misalignment",
    "ahrs_acceleration_error",
)  # fmt: skip
WITHIN = {"battery_sag": 0.2, "gyro_scale": 0.4, "accel_bias": 0.1, "rotor_spin_up": 0.2, "axial_inflow": 0.2}
"""How far the numbers of an effect may be off, as a share of the largest of them; 0.15 where nothing is said."""


def found_and_measured(name: str, seconds: float) -> None:
    """Requires the effect to be named alone, with its numbers about right."""
    case = single(name, seconds)
    found, _ = answer(case)
    require_named(case, found)
    truth = case.hidden[name]
    largest = max(abs(v) for k, v in truth.items() if k not in ("rotor", "time"))
    for key, value in truth.items():
        room = {"rotor": 0.0, "time": 0.5}.get(key, WITHIN.get(name, 0.15) * largest)
        assert abs(number(found, name, key) - value) <= room, (key, value, found.to_dict())


@pytest.mark.parametrize("name", QUICK)
def test_a_single_hidden_effect_is_named_and_measured(name: str) -> None:
    found_and_measured(name, SECONDS)


@pytest.mark.slow
@pytest.mark.parametrize("name", OTHERS)
def test_every_other_effect_too(name: str) -> None:
    found_and_measured(name, 120.0)


@pytest.fixture(scope="module")
def pair() -> Diagnosis:
    """Of a flight with motor lag and rotor drag."""
    return answer(of_class("pair", 0))[0]


def test_both_effects_of_a_pair_are_named(pair: Diagnosis) -> None:
    case = of_class("pair", 0)
    assert set(case.expected) == {"motor_lag", "rotor_drag"}
    require_named(case, pair)


def test_two_effects_that_look_most_like_a_third_are_both_named() -> None:
    """Mass dropped in flight while the battery fades: together they look like inflow, or drag across the rotors."""
    case = of_class("look_alike", 15)
    assert set(case.expected) == {"mass_change", "battery_sag"}
    found, search = answer(case)
    require_named(case, found)
    first = search.rounds[0].accepted
    assert first is not None
    assert first.candidate is not None
    assert first.candidate.effect not in case.expected, "this case no longer asks for a swap"


def test_inflow_too_small_for_segments_of_a_second_is_found_on_longer_ones() -> None:
    case = of_class("single", 1083, 120.0)
    assert case.expected == ("axial_inflow",)
    found, search = answer(case)
    require_named(case, found)
    assert search.shooting.seconds > 1.0, "longer segments decide"
    assert abs(number(found, "axial_inflow", "k_z") - case.hidden["axial_inflow"]["k_z"]) < 0.03


@pytest.mark.parametrize("number", [1055, 8005])
def test_of_two_kinds_of_drag_that_fit_alike_the_one_with_fewer_numbers_is_named(number: int) -> None:
    """In the second flight rotor drag at the CG, a refinement, fits as well as the drag of the frame."""
    case = of_class("single", number, 120.0)
    assert case.expected == ("parasitic_drag",)
    require_named(case, answer(case)[0])


def test_a_flight_without_effects_is_left_alone() -> None:
    found, search = answer(of_class("null", 0))
    require_nothing(found)
    assert found.validation.extended == found.validation.nominal == pytest.approx(1.0, abs=0.1)
    assert [p["name"] for p in found.to_dict()["parameters"]] == list(NOMINAL_NAMES)
    assert not found.remainder.followed


def test_what_no_entry_explains_is_called_unknown() -> None:
    case = of_class("outside", sorted(OUTSIDE).index("gusts"))
    assert case.outside
    found, _ = answer(case)
    assert found.verdict.value == "unknown", found.to_dict()
    assert not confident(found)
    assert found.unexplained or found.unexplained_follows, "an unknown must say where it sits"


@pytest.mark.parametrize(("number", "large"), [(10, "weak_rotor"), (2005, "parasitic_drag")])
def test_amid_clutter_the_large_effect_comes_first_and_no_absent_one_is_named(number: int, large: str) -> None:
    """In the second flight a centre of gravity 0.6 mm off costs more than the drag."""
    case = of_class("clutter", number, 120.0)
    assert case.expected == (large,)
    found, _ = answer(case)
    assert found.findings[0].effect == large, found.to_dict()
    assert found.findings[0].confident
    assert not found.findings[0].ordinary
    assert set(confident(found)) <= set(case.hidden)


def test_findings_are_ordered_by_their_gain_and_say_what_they_are(pair: Diagnosis) -> None:
    gains = [f.gain.mse_before - f.gain.mse_after for f in pair.findings]
    assert gains == sorted(gains, reverse=True)
    for f in pair.findings:
        assert f.gain.ci95[0] < f.gain.mse_before - f.gain.mse_after < f.gain.ci95[1]
        assert f.p_value < 0.05
        assert all(p.ci95[0] <= p.value <= p.ci95[1] for p in f.parameters)
