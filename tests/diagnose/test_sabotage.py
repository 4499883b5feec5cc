"""The short campaign can go red: with the catalogue or the decision spoilt, its requirements are not met."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest

from quadid.diagnose import acceptance, pipeline, search, trials
from quadid.diagnose.candidates import Candidate, candidates
from quadid.model.layout import Layout
from tests.diagnose.hidden import answer, of_class, require_named, require_nothing, single


def without_entry(name: str) -> Callable[[Layout, bool, bool], list[Candidate]]:
    """The catalogue less one effect."""

    def fewer(layout: Layout, has_velocity: bool, has_position: bool) -> list[Candidate]:
        return [c for c in candidates(layout, has_velocity, has_position) if c.effect != name]

    return fewer


@pytest.mark.parametrize("name", ["motor_lag", "imu_lever_arm"])
def test_an_effect_missing_from_the_catalogue_is_not_found(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(pipeline, "candidates", without_entry(name))
    case = single(name)
    found, _ = answer(case)
    assert name not in [f.effect for f in found.findings]
    with pytest.raises(AssertionError):
        require_named(case, found)


def inverted(*arguments: Any) -> bool:
    """The acceptance decision the wrong way round."""
    return not RULE(*arguments)


RULE = acceptance.significant


def test_with_the_decision_inverted_a_hidden_effect_is_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(acceptance, "significant", inverted)
    case = single("motor_lag")
    found, _ = answer(case)
    with pytest.raises(AssertionError):
        require_named(case, found)


def test_with_the_decision_inverted_a_null_is_given_causes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only causes that promise something are refitted; on a null none does, so that check is taken out as well."""
    monkeypatch.setattr(acceptance, "significant", inverted)
    monkeypatch.setattr(trials, "LEAST_GAIN", 0.0)
    monkeypatch.setattr(trials, "LEAST_SHARE", 0.0)
    monkeypatch.setattr(trials, "FALSE_ALARM", 1.0)
    monkeypatch.setattr(search, "MOST_CAUSES", 2)
    found, _ = answer(of_class("null", 0))
    assert found.findings
    with pytest.raises(AssertionError):
        require_nothing(found)
