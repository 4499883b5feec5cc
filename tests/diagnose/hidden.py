"""Hides effects in flown data, asks for a diagnosis, and requires the right answer: the campaign in small."""

from dataclasses import replace
from functools import lru_cache

from quadid_evaluation.studies.campaign import SINGLES, Case, cases, flown

from quadid.data.window import Window
from quadid.diagnosis import Diagnosis, Search, diagnose
from quadid.vehicle import Vehicle

SECONDS = 60.0


def single(name: str, seconds: float = SECONDS, turn: int = 0) -> Case:
    """One effect of realistic size; `turn` counts other draws of it."""
    (case,) = cases("short", 1, SINGLES.index(name) + len(SINGLES) * turn)
    return replace(case, seconds=seconds)


def of_class(group: str, number: int, seconds: float = SECONDS) -> Case:
    """A case of any class of the campaign."""
    (case,) = cases(group, 1, number)
    return replace(case, seconds=seconds)


@lru_cache(maxsize=12)
def data(case_key: tuple[str, int, float]) -> tuple[Case, Window, Window, Vehicle]:
    """Case, training and validation flight, and the vehicle file with its poor guess."""
    group, number, seconds = case_key
    case = of_class(group, number, seconds)
    return case, *flown(case)


def answer(case: Case) -> tuple[Diagnosis, Search]:
    """Answer of the diagnosis to the case; it gets the flights and the vehicle file alone."""
    _, train, validate, vehicle = data((case.group, case.number, case.seconds))
    return diagnose([train], vehicle, [validate], seed=case.seed)


def confident(found: Diagnosis) -> list[str]:
    """Names given with confidence, most valuable first."""
    return [f.effect for f in found.findings if f.confident]


def require_named(case: Case, found: Diagnosis) -> None:
    """All that was hidden is named, nothing else, and the extended model is much better on the unseen flight."""
    assert sorted(confident(found)) == sorted(case.expected), found.to_dict()
    assert found.verdict.value in ("explained", "partly_explained")
    nominal, extended = found.validation.deciding
    assert extended < nominal


def require_nothing(found: Diagnosis) -> None:
    """Nothing is named, nothing is suspected."""
    assert found.verdict.value == "nothing_found", found.to_dict()
    assert not found.findings


def number(found: Diagnosis, effect: str, name: str) -> float:
    """One number of a finding."""
    (finding,) = [f for f in found.findings if f.effect == effect]
    (value,) = [p.value for p in finding.parameters if p.name == name]
    return value
