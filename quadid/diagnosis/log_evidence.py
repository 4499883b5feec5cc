"""The one score: is model B better than model A?

Twice the logarithm of the marginal likelihood by Laplace's approximation, with the priors that exist: on parameters
those of the fit, on models that a cause is absent until proven (`FALSE_ALARM` shared by all that were tried).  Where
the model leaves more than noise, or noise with a memory, squared errors are worth less than their size: deviances are
divided by the ratio of the scores' true variance to that which the model counts on (Godambe, Ann. Math. Stat. 31 (1960)
1208; as magnitude adjustment of a composite likelihood in Ribatet, Cooley and Davison, Statistica Sinica 22 (2012)
813).  A cause must besides be of use: on blocks of data that its fit did not see it has to gain a share of the noise.
"""

from __future__ import annotations

import numpy as np

from quadid.chi_square import exceeded
from quadid.diagnosis.cross_validation import paired_gain
from quadid.diagnosis.model import Model
from quadid.types import BoolArray

FALSE_ALARM = 1e-3
"""Prior probability that a flight has any cause to be named, shared by all that are tried: that of a false alarm."""
RELEVANT = 0.002
"""Share of the noise that a cause must take away on unseen blocks.  Less is of no use to anybody, and within what the
time step of a simulation or of an autopilot's own filter can imitate: nulls reach 0.0008."""


def better(b: Model, a: Model) -> bool:
    """Whether `b` is better than `a`: more likely, and of models of which one contains the other also of use."""
    more, less = {c.label for c in b.causes}, {c.label for c in a.causes}
    if more < less:
        return not better(a, b)
    if less < more and not relevant(a, b):
        return False
    return advantage(b, a) > 0.0


def advantage(b: Model, a: Model) -> float:
    """Twice the log evidence of `b` less that of `a`, times the calibration, between models of the same data and noise.

    Each model pays for what only it has by the calibration of its own scores: where a parameter's scores vary much more
    than the deviance counts on, that is no reason to count less what the other model explains.
    """
    return a.deviance - b.deviance + _cost(a, b) - _cost(b, a)


def _cost(model: Model, other: Model) -> float:
    """Deviance that the causes and parameters which only `model` has must take away for it to be as likely."""
    own = np.array([n not in other.free.names for n in model.free.names])
    present = {c.label for c in other.causes}
    prior = sum(2.0 * np.log(model.tried[c.label] / FALSE_ALARM) for c in model.causes if c.label not in present)
    if not own.any():
        return float(prior)
    ratio = calibration(model, own)
    gram = model.lin.information / np.sqrt(np.outer(model.prior.precision, model.prior.precision))
    wide = np.eye(len(gram)) + gram / ratio
    occam = np.linalg.slogdet(wide)[1] - np.linalg.slogdet(wide[np.ix_(~own, ~own)])[1]
    return ratio * float(occam + prior)


def calibration(model: Model, own: BoolArray) -> float:
    """By how much scores of the parameters `own` of `model` vary more than its deviance counts on, or 1."""
    return max(float(np.mean(model.inflation[own])), 1.0)


def relevant(small: Model, large: Model) -> bool:
    """Whether what `large` has more gains enough on unseen blocks, and half of that where the best of them is missing.

    It is missing in the fit as well: what a single stretch determines, such as a step near the end, gains elsewhere by
    keeping that stretch apart.
    """
    gain = paired_gain(small.held_out, large.held_out)
    best = int(np.argmax(gain.blocks))
    least = min(gain.total, 2.0 * float(small.rest[best] - large.rest[best]))
    return least > RELEVANT * small.rows


def worth_a_refit(tests: int, rows: float) -> float:
    """Predicted fall of the deviance below which a cause cannot win: half of what it must gain."""
    return 0.5 * max(exceeded(FALSE_ALARM / tests, 1), RELEVANT * rows)
