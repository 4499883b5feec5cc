"""The shipped controller example obeys each check that the documentation asks of a controller."""

import importlib.util
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from quadid_node.inputs import to_message

from quadid.online import SetState
from quadid.parameters import Status
from quadid_node import messages
from tests.online.test_gate import TRUE, online_set, parameter_set, scaled

EXAMPLE = Path(__file__).resolve().parents[2] / "examples" / "controller_subscriber.py"
GOOD = replace(online_set(TRUE), sequence=9, mass=1.3)


@pytest.fixture
def model(ros: None) -> Any:
    spec = importlib.util.spec_from_file_location("controller_subscriber", EXAMPLE)
    assert spec is not None
    assert spec.loader is not None
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    found = example.Model(dict(TRUE), mass=1.3)
    found.sequence = 8
    return found


def told(item: Any = GOOD, **fields: Any) -> Any:
    return to_message(messages.PARAMETER_SET, {**messages.parameter_set(item, "quad1"), **fields})


def test_a_good_set_is_applied(model: Any) -> None:
    assert model.objection(told(), "quad1") == ""
    assert model.objection(told(replace(GOOD, state=SetState.ROLLED_BACK)), "quad1") == ""


@pytest.mark.parametrize(
    ("item", "fields", "word"),
    [
        (GOOD, {"schema_version": 1}, "schema 1"),
        (GOOD, {"vehicle_id": "quad2"}, "belongs to quad2"),
        (replace(GOOD, sequence=8), {}, "not newer"),
        (replace(GOOD, state=SetState.STALE), {}, "before a restart"),
        (replace(GOOD, state=SetState.PENDING), {}, "its state is 2"),
        (replace(GOOD, outdated="mass +15 %"), {}, "out of date: mass +15 %"),
        (replace(GOOD, mass=1.5), {}, "rests on a mass of 1.5 kg"),
        (replace(GOOD, mass=float("nan")), {}, "rests on a mass of nan kg"),
        (GOOD, {"units": ["1"] * 6}, "wanted 'N s^2"),
        (GOOD, {"units": []}, "differ in length"),
        (replace(GOOD, parameters=parameter_set(scaled(J_xx=float("inf")))), {}, "J_xx = inf"),
        (replace(GOOD, parameters=parameter_set(scaled(b=2.2))), {}, "b would change"),
        (replace(GOOD, parameters=parameter_set(TRUE, J_yy=Status.RATIO_ONLY)), {}, "do not determine J_yy"),
        (GOOD, {"names": ["b"], "values": [2.33e-5], "units": ["N s^2/rad^2"], "status": [0]}, "determine J_xx"),
    ],
)
def test_each_check_refuses(model: Any, item: Any, fields: dict[str, Any], word: str) -> None:
    assert word in model.objection(told(item, **fields), "quad1")


def test_a_first_set_that_is_a_large_step_is_refused_too(model: Any) -> None:
    model.sequence = 0
    assert "would change" in model.objection(told(replace(GOOD, parameters=parameter_set(scaled(b=2.2)))), "quad1")


def test_a_value_that_the_data_do_not_determine_stays_as_it_is(model: Any) -> None:
    guess = replace(GOOD, parameters=parameter_set(scaled(J_zz=3.0, b=1.01), J_zz=Status.PRIOR_DOMINATED))
    assert model.objection(told(guess), "quad1") == ""
    model.apply(told(guess))
    assert (model.values["J_zz"], model.values["b"]) == (TRUE["J_zz"], 1.01 * TRUE["b"])
    assert model.sequence == 9
