"""Meaning of a result in plain words."""

from typing import Any

import pytest

from quadid.effects import EFFECTS
from quadid.report.fit_pages import HELD_OUT, diagnose_verdict
from quadid.report.verdict import MOTION, digits, identify_verdict, percent, reason, score_verdict


def _result(
    fitted: float | None = 1.0,
    status: str = "identified",
    role: str = "validate",
    force: float = 0.05,
    moment: float = 0.001,
) -> dict[str, Any]:
    """A result of ``quadid identify`` of a vehicle of 10 N whose rotors make 0.1 N m."""
    parameters = [
        {"name": n, "unit": "", "value": 1.1, "ci95": [1.09, 1.11], "initial": 1.0, "status": status} for n in MOTION
    ]
    entry = {
        "log": "a",
        "role": role,
        "seconds": 30.0,
        "mse": {"initial": 9.0, "fitted": fitted},
        "fit_percent": {"p": 95.0, "q": None},
    }
    sets = [{**entry, "role": part} for part in dict.fromkeys(("train", role))]
    missed = {
        "force": {"nominal": {"x": force, "y": 0.0, "z": 0.0}, "of": 10.0},
        "moment": {"nominal": {"x": 0.0, "y": 0.0, "z": moment}, "of": {"x": 0.1, "y": 0.1, "z": 0.1}},
    }
    missing = {**missed, "statement": "What is missing.", "sets": [{"role": s["role"], **missed} for s in sets]}
    return {"parameters": parameters, "sets": sets, "missing": missing, "warnings": []}


def test_good_fair_and_poor() -> None:
    good = identify_verdict(_result())
    assert (good.level, good.headline[:3]) == ("good", "All")
    assert "quadid export" in good.next_steps[0]
    fair = identify_verdict(_result(fitted=2.0))
    assert fair.level == "fair"
    assert "quadid diagnose" in " ".join(fair.next_steps)
    for bad in (50.0, None, float("inf")):
        poor = identify_verdict(_result(fitted=bad))
        assert poor.level == "poor"
        assert poor.headline.startswith("Not to be used yet")


@pytest.mark.parametrize(
    ("force", "moment", "share"), [(0.4, 0.0, "4 % of the weight"), (0.0, 0.03, "30 % of the rotors' moment")]
)
def test_what_is_missing_keeps_a_result_from_green_and_is_said_in_shares(
    force: float, moment: float, share: str
) -> None:
    verdict = identify_verdict(_result(force=force, moment=moment))
    assert verdict.level == "fair"
    assert share in verdict.headline
    assert "quadid diagnose" in " ".join(verdict.next_steps)


def test_without_gyro_or_accelerometer_nobody_knows_what_is_missing() -> None:
    verdict = identify_verdict({**_result(), "missing": None})
    assert verdict.level == "fair"
    assert "it is unknown what the simulation misses" in verdict.headline


def test_what_the_data_do_not_show_is_said_with_the_motion_it_needs() -> None:
    verdict = identify_verdict(_result(status="prior_dominated"))
    assert verdict.level == "poor"
    assert "None of 6 parameters" in verdict.headline
    assert any("yaw turns" in step for step in verdict.next_steps)


def test_what_the_channels_cannot_show_needs_another_log_and_no_motion() -> None:
    why = "rotor signal at 12 Hz is too slow, 30 Hz needed"
    result = _result(status="prior_dominated")
    result["warnings"] = [f"d, J_xx, J_yy, J_zz, J_r: the vehicle file's values are kept, because {why}"]
    steps = identify_verdict(result).next_steps
    assert f"Log it better: {why}. Then d, J_xx, J_yy, J_zz, J_r can be identified." in steps
    assert [step for step in steps if step.startswith("Fly ")] == [
        "Fly climbs and descents: b is not observable in these data."
    ]


def test_a_useless_fit_and_a_huge_lack_are_said_in_words() -> None:
    result = _result(moment=0.9)
    result["sets"][-1]["fit_percent"] = {"p": -864.0, "q": -53.0}
    verdict = identify_verdict(result)
    assert "and over 200 % of the rotors' moment" in verdict.headline
    assert any("roll below -100 %, pitch -53 %" in line for line in verdict.details)


def test_with_the_wrong_model_more_flying_is_no_cure() -> None:
    result = _result(fitted=320.0)
    result["parameters"][5]["status"] = "prior_dominated"
    steps = identify_verdict(result).next_steps
    assert "quadid diagnose" in steps[0]
    assert not [s for s in steps if "Fly" in s or "excite" in s]


def test_no_validation_asks_for_one() -> None:
    verdict = identify_verdict(_result(role="train"))
    assert "--validate" in verdict.next_steps[0]
    assert verdict.level == "fair"
    assert any("no unseen flight" in line for line in verdict.details)


def test_seconds_of_data_prove_nothing() -> None:
    result = _result()
    result["sets"][1]["seconds"] = 4.0
    verdict = identify_verdict(result)
    assert verdict.level == "fair"
    assert "only 4.0 s of unseen flight" in verdict.details[0]


@pytest.mark.parametrize(
    ("error", "level"), [(0.1, "good"), (0.5, "fair"), (1.0, "poor"), (float("inf"), "poor"), (None, "poor")]
)
def test_scores_are_judged_between_noise_and_no_change(error: float | None, level: str) -> None:
    rows = {"horizons": error, "noise_floor": 0.08, "no_change": 0.9}
    verdict = score_verdict({key: {"50": {"rate": value}} for key, value in rows.items()})
    assert verdict.level == level


def test_a_parameter_on_its_bound_is_not_called_identified() -> None:
    result = _result()
    result["warnings"] = ["J_xx = 1.1 kg m^2 rests on its bound [0.1, 1.1]"]
    verdict = identify_verdict(result)
    assert verdict.headline.startswith("5 of 6")
    assert verdict.level == "fair"
    assert any("J_xx rests on a bound" in step for step in verdict.next_steps)
    assert "bound" in reason(result["parameters"][2], ["J_xx"])


def test_with_the_wrong_model_the_diagnosis_comes_first_and_no_motion_is_asked_for_what_hit_a_bound() -> None:
    result = _result(fitted=50.0)
    result["parameters"][2]["status"] = "prior_dominated"
    result["warnings"] = ["J_xx = 1.1 kg m^2 rests on its bound [0.1, 1.1]"]
    steps = identify_verdict(result).next_steps
    assert "quadid diagnose" in steps[0]
    assert not any(step.startswith("Fly ") for step in steps)


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({}, "raised by 10 %"),
        ({"value": 0.9, "ci95": [0.89, 0.91]}, "lowered by 10 %"),
        ({"ci95": [0.9, 1.3]}, "the old value lies inside"),
        ({"status": "ratio_only", "relative_to": "b"}, "Only its ratio to b"),
        ({"status": "prior_dominated"}, "quick roll doublets"),
        ({"initial": None}, "Known to 0.91 %"),
        ({"ci95": [None, None]}, "unknown margin"),
    ],
)
def test_reasons(changes: dict[str, Any], expected: str) -> None:
    parameter = {"name": "J_xx", "value": 1.1, "ci95": [1.09, 1.11], "initial": 1.0, "status": "identified"}
    assert expected in reason({**parameter, **changes})


def test_percent_keeps_two_digits() -> None:
    assert [percent(x) for x in (0.0123, 0.5, 0.00012, 9.0)] == ["1.2 %", "50 %", "0.012 %", "over 200 %"]


def test_every_effect_has_advice() -> None:
    assert all(e.advice.endswith(".") and e.sentence for e in EFFECTS.values())


@pytest.mark.parametrize(
    ("low", "high", "expected"),
    [
        (0.009988, 0.010003, 5),  # +-0.000008
        (2.3294e-5, 2.3306e-5, 6),
        (0.5, 1.5, 4),
        (-0.01, 0.02, 4),
        (1.0, 1.0, 4),
        (None, 1.0, 4),
        (1.0, 1.0 + 1e-12, 9),
    ],
)
def test_digits_show_the_width_of_an_interval(low: float | None, high: float, expected: int) -> None:
    value = high if low is None else 0.5 * (low + high)
    assert digits({"value": value, "ci95": [low, high]}) == expected


def test_what_is_no_larger_than_on_most_vehicles_is_told_apart_and_needs_no_mending() -> None:
    findings = [
        {"effect": "parasitic_drag", "confident": True, "ordinary": False},
        {"effect": "cg_offset", "confident": True, "ordinary": True},
        {"effect": "weak_rotor", "confident": False, "ordinary": False},
    ]
    validation = {"mse_nominal": 9.0, "mse_extended": 1.0}
    result = {
        "verdict": "explained",
        "statement": "These causes explain the model error.",
        "findings": findings,
        "validation": validation,
        "unexplained": {},
    }
    verdict = diagnose_verdict(result)
    assert verdict.headline.startswith("Found: parasitic drag; no larger than on most vehicles: cg offset. ")
    assert [step.split(":")[0] for step in verdict.next_steps if ":" in step] == ["Parasitic drag"]
    alone = diagnose_verdict({**result, "findings": findings[1:2]})
    assert alone.headline.startswith("Found: no larger than on most vehicles: cg offset. ")


@pytest.mark.parametrize(
    ("validation", "level"),
    [
        ({"mse_extended": 1.1}, "good"),
        ({"mse_extended": 2.9}, "fair"),
        ({"mse_extended": None}, "fair"),
        ({"mse_extended": 2.9, "mse_extended_refitted": 1.1}, "good"),
        ({"mse_extended": 1.1, "on": HELD_OUT}, "fair"),
    ],
)
def test_a_diagnosis_is_green_where_an_unseen_flight_is_predicted_down_to_the_noise(
    validation: dict[str, Any], level: str
) -> None:
    result = {
        "verdict": "explained",
        "statement": "These causes explain the model error.",
        "findings": [],
        "validation": {"mse_nominal": 400.0, **validation},
        "unexplained": {},
    }
    assert diagnose_verdict(result).level == level
