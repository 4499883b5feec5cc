"""What to fly next: sharp, hidden, coupled and merely short flights get different advice."""

from __future__ import annotations

import numpy as np

from quadid.identification.excitation import Excitation
from quadid.report.fit_pages import SHARP, excitation_part


def part(bound: list[float], alone: list[float]) -> list[str]:
    """Advice for b, d, J_zz with these bounds."""
    names = ("b", "d", "J_zz")
    found = Excitation(names, np.array(bound), np.array(alone), np.eye(3))
    return [row[3] for row in excitation_part(found, 60.0)["tables"][0]["rows"]]


def test_each_reason_has_its_advice() -> None:
    sharp, hidden, coupled = part([0.001, np.inf, 0.3], [0.001, np.inf, 0.01])
    assert sharp == "nothing more"
    assert hidden.endswith("this flight does not show it")
    assert "apart from the others" in coupled


def test_a_flight_too_short_says_how_long() -> None:
    short = part([2 * SHARP, 0.001, 0.001], [2 * SHARP, 0.001, 0.001])[0]
    assert "240 s" in short


def test_nothing_more_when_all_are_sharp() -> None:
    found = Excitation(("b",), np.array([0.001]), np.array([0.001]), np.eye(1))
    assert excitation_part(found, 60.0)["after"]
