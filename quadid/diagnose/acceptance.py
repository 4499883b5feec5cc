"""When a cause is accepted, and when it is dropped again."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from quadid.chi_square import survival
from quadid.diagnose.blocks import Gain, paired_gain
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.exchange import LEAST_GAIN, Trial, without
from quadid.diagnose.models import Model
from quadid.identify.shooting import Shooting

FALSE_ALARM = 1e-3
"""Chance that a model without any effect is extended at all, shared by all causes tried."""
ERRORS = 2.0
"""A gain on unseen blocks must exceed this many of its standard errors, or be spread over most of them, or …"""
BEYOND_DOUBT = 100.0
"""… exceed one, the evidence on the fitted data being this chi-square or more: an effect that shows in a few manoeuvres
only gains in few blocks, whose spread says little about chance …"""
LEAST_SHARE = 0.004
"""… and `LEAST_GAIN`, and this share of the noise that no model can remove: less is of no use to anybody, and within
what the time step of a simulation or of an autopilot's own filter can imitate."""
RELATIVE_GAIN = 1e-4
"""… and this share of all gains so far, so that the tail of a huge effect is not named as another."""
FAMILY_SHARE = 0.01
"""… and, where a look-alike is already in the model, this share of what that one gained: the rest of a fading thrust
that is not quite linear is no second cause."""

CLOSE = 0.8
"""Share of the gain of the best cause beyond which another, tried beside it, came close."""
FAR_SURER = 5.0
"""Times the evidence by which a cause that came close is preferred.  A gain whose parameter is hardly known is not the
parameter's: inflow lets every segment find a vertical velocity that makes up for any thrust that is off in it."""


@dataclass(frozen=True)
class Context:
    """What a gain is measured against: all gains so far, independent rows, and how much each family has gained."""

    earned: float
    rows: float
    families: dict[str, float]


def significant(gain: Gain, evidence: float, cause: Candidate, tests: int, context: Context) -> bool:
    """Whether a gain on unseen blocks is real, worth having, and beyond what so many trials bring by luck."""
    least = max(
        LEAST_GAIN,
        LEAST_SHARE * context.rows,
        RELATIVE_GAIN * context.earned,
        FAMILY_SHARE * context.families.get(cause.family, 0.0),
    )
    errors = 1.0 if evidence > BEYOND_DOUBT else ERRORS
    return (
        (gain.total > errors * gain.error or gain.spread)
        and gain.total > least
        and survival(evidence, len(cause.names)) * tests < FALSE_ALARM
    )


def context_of(model: Model, nominal: Model) -> Context:
    """What a cause added to `model` is measured against, gains counted from `nominal`."""
    earned = float(nominal.held_out.sum() - model.held_out.sum())
    families: dict[str, float] = {}
    for cause in model.causes:
        families[cause.family] = families.get(cause.family, 0.0) + model.worth.get(cause.label, 0.0)
    return Context(earned, model.rows, families)


def choose(trials: list[Trial], model: Model, nominal: Model) -> Trial | None:
    """The best trial, a close one far surer, or a simpler one as good but for luck; None when none is significant."""
    context = context_of(model, nominal)
    good = [t for t in trials if significant(t.gain, t.evidence, t.candidate, t.tests, context)]
    if not good:
        return None
    best = max(good, key=lambda t: t.gain.total)
    surer = [t for t in good if t.gain.total > CLOSE * best.gain.total and t.evidence > FAR_SURER * best.evidence]
    if surer:
        return max(surer, key=lambda t: t.evidence)
    for t in sorted(good, key=lambda t: (len(t.candidate.names), -t.gain.total)):
        if len(t.candidate.names) >= len(best.candidate.names):
            break
        lost = paired_gain(t.model.held_out, best.model.held_out)
        if lost.total < lost.error:
            return t
    return best


def doubtful(model: Model, tests: int) -> list[Candidate]:
    """Causes of `model` whose numbers chance alone would bring."""
    return [c for c in model.causes if survival(model.wald(c), len(c.names)) * tests > FALSE_ALARM]


def others(model: Model, newest: Candidate) -> list[Candidate]:
    """Causes of `model` but the newest."""
    return [c for c in model.causes if c.label != newest.label]


def prune(shooting: Shooting, model: Model, suspects: Sequence[Candidate], nominal: Model, tests: int) -> Model:
    """Drops those of the suspects that are superfluous; what another cause requires stays."""
    for cause in suspects:
        if cause.label not in {c.label for c in model.causes} or any(c.requires == cause.effect for c in model.causes):
            continue
        rest = without(shooting, model, cause)
        gain = paired_gain(rest.held_out, model.held_out)
        evidence = min(rest.deviance - model.deviance, model.wald(cause))
        if not significant(gain, evidence, cause, tests, context_of(rest, nominal)):
            model = rest
    return model
