"""Forward selection of causes with look-alikes refitted against each other, and backward elimination."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from quadid.diagnose.acceptance import choose, others, prune
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.climb import USUAL_SECONDS, Climb
from quadid.diagnose.exchange import Round, split_causes, swap_look_alikes
from quadid.diagnose.handover import hand_over
from quadid.diagnose.models import Model
from quadid.diagnose.screen import screen
from quadid.diagnose.second_thoughts import second_thought
from quadid.diagnose.trials import drafts_of, tried
from quadid.identify.shooting import Shooting

FloatArray = NDArray[np.float64]

MOST_CAUSES = 12
MOST_SECOND_THOUGHTS = 2
"""Times a cause may give way to one it was once preferred to."""


@dataclass(frozen=True)
class Search:
    """Outcome of the selection.

    Attributes:
        shooting: the problem that decided.
        nominal: model without causes; model: the selected one.
        rounds: what was tried, in order.
        tests: number of alternatives looked at in one round, for the correction.
    """

    shooting: Shooting
    nominal: Model
    model: Model
    rounds: tuple[Round, ...]
    tests: int


def select(
    ladder: Sequence[Shooting], theta: FloatArray, listed: Sequence[Candidate], report: Callable[[str, float], None],
    elsewhere: Sequence[FloatArray] = (), known: Model | None = None,
) -> Search:  # fmt: skip
    """Selects the causes that the data support, most gain first.

    The search begins on the longest segments that the model follows for their whole length.  While it follows only
    short ones, where even a large error stays nearly linear, causes are sought there; as soon as it follows longer
    ones, on which slow causes show too, they decide.

    Args:
        ladder: the data cut into segments of falling length.
        theta: nominal optimum.
        listed: causes to try.
        report: progress.
        elsewhere: nominal parameters, shape (6,), to start from too while the misfit is large.
        known: selection made with a poorer noise model, to go on from.
    """
    climb = Climb(ladder, theta, known)
    rounds: list[Round] = []
    if known is not None:
        climb.model = prune(climb.shooting, climb.model, climb.model.causes, climb.base, len(listed))
    tests = _forwards(climb, rounds, listed, elsewhere, report)
    for _ in range(MOST_SECOND_THOUGHTS):
        doubt = second_thought(climb, rounds, tests, elsewhere)
        if doubt is None or doubt.accepted is None:
            break
        rounds.append(doubt)
        climb = Climb(ladder, theta, doubt.accepted.model)
        suspects = others(climb.model, doubt.accepted.candidate)
        climb.model = prune(climb.shooting, climb.model, suspects, climb.base, tests)
        tests = _forwards(climb, rounds, listed, elsewhere, report)
    handed = hand_over(climb.shooting, climb.model, listed, tests)
    if handed is not None and handed.accepted is not None:
        suspects = others(handed.accepted.model, handed.accepted.candidate)
        climb.model = prune(climb.shooting, handed.accepted.model, suspects, climb.base, tests)
        rounds.append(handed)
    return Search(climb.shooting, climb.nominal, climb.model, tuple(rounds), tests)


def _forwards(
    climb: Climb, rounds: list[Round], listed: Sequence[Candidate], elsewhere: Sequence[FloatArray],
    report: Callable[[str, float], None],
) -> int:  # fmt: skip
    """Adds causes until none gains, look-alikes set beside each other; returns how many were looked at in one round."""
    compared: set[str] = set()
    usual: list[Round] = []
    tests = len(listed)
    while len(climb.model.causes) < MOST_CAUSES:
        report("search", len(rounds) / (len(rounds) + 2.0))
        shooting, model = climb.shooting, climb.model
        rounds.append(_round(shooting, model, listed, climb.base, elsewhere))
        tests = len(rounds[-1].screened)
        if rounds[-1].accepted is None:
            farther = _far_look(climb, listed, tests, elsewhere)
            if farther is not None:
                rounds.append(farther)
            shooting = climb.shooting
        accepted = rounds[-1].accepted
        if accepted is None:
            break
        worth = {**accepted.model.worth, accepted.candidate.label: accepted.gain.total}
        model = split_causes(replace(accepted.model, worth=worth))
        climb.model = prune(shooting, model, others(model, accepted.candidate), climb.base, tests)
        if climb.up():
            climb.model, swaps = swap_look_alikes(climb.shooting, climb.model, listed, usual)
            usual += swaps if climb.shooting.seconds >= USUAL_SECONDS else []
            rounds += swaps
            compared = {c.label for c in climb.model.causes}
    if compared != {c.label for c in climb.model.causes}:
        climb.model, swaps = swap_look_alikes(climb.shooting, climb.model, listed)
        rounds += swaps
    return tests


def _round(
    shooting: Shooting, model: Model, listed: Sequence[Candidate], base: Model, elsewhere: Sequence[FloatArray],
    tests: int | None = None,
) -> Round:  # fmt: skip
    """Screens causes, refits the promising and chooses one; `tests` alternatives count, by default all screened."""
    scores = screen(shooting, model, list(listed))
    count = len(scores) if tests is None else tests
    trials = [tried(shooting, model, d, count) for d in drafts_of(shooting, model, scores, count, elsewhere)]
    return Round(tuple(trials), choose(trials, model, base), tuple(scores))


def _far_look(
    climb: Climb, listed: Sequence[Candidate], tests: int, elsewhere: Sequence[FloatArray]
) -> Round | None:  # fmt: skip
    """Looks on the longest segments for causes to which an unmeasured airspeed matters; goes there if one is found.

    On usual ones each segment finds a velocity of its own, which makes up for most of what a small drag or inflow does.
    Only where nothing is named yet: a small cause does not decide on which segments larger ones are judged.
    """
    far = None if climb.model.causes else climb.farthest()
    if far is None:
        return None
    shooting, model = far
    airborne = [c for c in listed if shooting.finds_velocity(c.names)]
    looked = _round(shooting, model, airborne, climb.base, elsewhere, tests)
    if looked.accepted is not None:
        climb.go_far(looked.accepted.model)
    return looked
