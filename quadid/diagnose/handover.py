"""Errors of sensors too large to be likely, part of which another cause would take over.

Two causes may act on the same residual so alike that the one found first leaves the other next to nothing: an offset of
the accelerometer down the thrust axis is almost a thrust that is not quadratic.  Which is right a data sheet tells: the
errors of a sensor have a size, those of an airframe hardly a bound.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from quadid.chi_square import exceeded, survival
from quadid.diagnose.blocks import paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.exchange import LEAST_GAIN, Round, Trial, split_causes
from quadid.diagnose.models import Model, extend
from quadid.diagnose.screen import screen
from quadid.effects import EFFECTS
from quadid.identify.shooting import Shooting
from quadid.model.layout import Entry

LIKELY = 2.0
"""Typical sizes beyond which an error of a sensor is set beside other causes once more."""
TAKEN_OVER = 0.5
"""Share of such an error that must be gone once the other cause is there."""
FALSE_ALARM = 1e-3
ERRORS = 2.0
"""A gain on unseen blocks must exceed this many of its standard errors and `LEAST_GAIN`; the shares that an added
cause must gain do not bind it, for what it stands in for is large."""
MOST_REFITS = 4


def hand_over(shooting: Shooting, model: Model, listed: Sequence[Candidate], tests: int) -> Round | None:
    """Tries which cause takes over most of an unlikely error of a sensor and fits better beside what is left of it.

    Args:
        shooting: the problem that decides.
        model: the selected model.
        listed: the catalogue.
        tests: number of alternatives looked at, for the correction.

    Returns:
        The causes tried and the one accepted; None where no error is unlikely.
    """
    unlikely = sensor_errors(shooting, model, LIKELY)
    if not unlikely:
        return None
    trials = []
    others = [c for c in listed if c.timed is None and not EFFECTS[c.effect].sized]
    scores = screen(shooting, model, others)
    least = exceeded(FALSE_ALARM / tests, 1)
    for candidate in [s.candidate for s in scores if s.drop > 0.5 * least][:MOST_REFITS]:
        extended = extend(shooting, model, candidate)
        gain = paired_gain(model.held_out, extended.held_out)
        extended = split_causes(replace(extended, worth={**model.worth, candidate.label: gain.total}))
        trials.append(Trial(candidate, extended, gain, model.deviance - extended.deviance, tests))
    good = [t for t in trials if _is_better(t) and _is_taken_over(t.model, model, unlikely)]
    return Round(tuple(trials), max(good, key=lambda t: t.gain.total, default=None), ())


def sensor_errors(shooting: Shooting, model: Model, sizes: float) -> list[Entry]:
    """Errors of sensors in `model` that are larger than so many typical sizes."""
    names = [n for c in model.causes if EFFECTS[c.effect].sized for n in c.names]
    return [e for e in shooting.free(names).entries if _size(model, e) > sizes]


def _size(model: Model, entry: Entry) -> float:
    return abs(float(model.theta[entry.index]) - entry.neutral) / entry.typical


def _is_taken_over(extended: Model, model: Model, unlikely: Sequence[Entry]) -> bool:
    return any(_size(extended, e) < TAKEN_OVER * _size(model, e) for e in unlikely)


def _is_better(trial: Trial) -> bool:
    real = trial.gain.total > max(LEAST_GAIN, ERRORS * trial.gain.error)
    return real and survival(trial.evidence, len(trial.candidate.names)) * trial.tests < FALSE_ALARM
