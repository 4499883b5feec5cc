"""The short campaign can go red: with the catalogue or the decision spoilt, its requirements are not met."""

from collections.abc import Callable
from typing import Any

import pytest

from quadid.diagnosis import pipeline, search
from quadid.diagnosis.evidence import better
from quadid.diagnosis.hypotheses import Candidate, candidates
from tests.diagnose.hidden import answer, of_class, require_named, require_nothing, single


def without_entry(name: str) -> Callable[..., list[Candidate]]:
    """The catalogue less one effect."""

    def fewer(*given: Any) -> list[Candidate]:
        return [c for c in candidates(*given) if c.effect != name]

    return fewer


def test_an_effect_missing_from_the_catalogue_is_not_found(monkeypatch: pytest.MonkeyPatch) -> None:
    name = "imu_lever_arm"
    monkeypatch.setattr(pipeline, "candidates", without_entry(name))
    case = single(name)
    found, _ = answer(case)
    assert name not in [f.effect for f in found.findings]
    with pytest.raises(AssertionError):
        require_named(case, found)


def few(*given: Any) -> list[Candidate]:
    """Two causes, so that a spoilt search ends."""
    return [c for c in candidates(*given) if c.effect in ("motor_lag", "gyro_bias")]


def inverted(*arguments: Any) -> bool:
    """The one comparison the wrong way round."""
    return not better(*arguments)


def test_with_the_decision_inverted_a_hidden_effect_is_not_accepted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(search, "better", inverted)
    monkeypatch.setattr(pipeline, "candidates", few)
    case = single("motor_lag")
    found, _ = answer(case)
    with pytest.raises(AssertionError):
        require_named(case, found)


def test_with_the_decision_inverted_a_null_is_given_causes(monkeypatch: pytest.MonkeyPatch) -> None:
    """Only causes that promise something are refitted; on a null none does, so that check is taken out as well."""
    monkeypatch.setattr(search, "better", inverted)
    monkeypatch.setattr(pipeline, "candidates", few)
    monkeypatch.setattr(search, "worth_a_refit", lambda *_: -1e9)
    monkeypatch.setattr(pipeline, "pruned", lambda shooting, model: model)
    found, _ = answer(of_class("null", 0))
    assert found.findings
    with pytest.raises(AssertionError):
        require_nothing(found)
