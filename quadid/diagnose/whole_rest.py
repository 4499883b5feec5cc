"""A look-alike of a named cause that explains all that is left.

What a huge effect leaves when its form is not quite that of the catalogue is taken over in part by whatever looks like
it; therefore a look-alike has to gain a share of what the first one did (`acceptance.FAMILY_SHARE`).  A lag beside a
delay may gain less than that and be real.  The difference: the true second cause leaves nothing but noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

from quadid.diagnose.acceptance import context_of, significant
from quadid.diagnose.candidates import Candidate
from quadid.diagnose.exchange import Round
from quadid.diagnose.models import Model
from quadid.diagnose.remainder import Remainder
from quadid.diagnose.screen import screen
from quadid.diagnose.search import Search
from quadid.diagnose.trials import drafts_of, tried

WHOLE = 0.8
"""Share of the structure left that a look-alike must gain on unseen blocks before what it leaves is looked at."""


def with_look_alike(search: Search, nominal: Model, left: Remainder, listed: Sequence[Candidate]) -> Search | None:
    """The search with a look-alike of a named cause added that may explain the whole rest.

    Args:
        search: the selection.
        nominal: model that gains are measured against.
        left: what the selection leaves.
        listed: the catalogue.

    Returns:
        None where no look-alike gains as much as there is left. Whether it leaves nothing is for the caller to see.
    """
    model, shooting = search.model, search.shooting
    families, present = {c.family for c in model.causes}, {c.label for c in model.causes}
    alike = [c for c in listed if c.family in families and c.label not in present and not c.split]
    alike = [c for c in alike if c.requires is None or c.requires in model.effects]
    if not alike:
        return None
    drafts = drafts_of(shooting, model, screen(shooting, model, alike), search.tests, ())
    trials = [tried(shooting, model, d, search.tests) for d in drafts]
    context = replace(context_of(model, nominal), families={})
    good = [t for t in trials if significant(t.gain, t.evidence, t.candidate, t.tests, context)]
    best = max(good, key=lambda t: t.gain.total, default=None)
    if best is None or best.gain.total < WHOLE * left.deviance:
        return None
    worth = {**best.model.worth, best.candidate.label: best.gain.total}
    rounds = (*search.rounds, Round(tuple(trials), best, ()))
    return replace(search, model=replace(best.model, worth=worth), rounds=rounds)
