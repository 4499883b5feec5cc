"""Does a finding have the form that its name claims?

A bias is constant.  Anything whose mean is not zero looks like one at first: a gyro that senses acceleration, warms up
or is shaken.  What tells them apart is small beside the mean: the rest at the same sensor follows acceleration, thrust
or time.  A test of all generic signals together is too blunt for that; each alone is not.
"""

from __future__ import annotations

from collections.abc import Iterator

from quadid.diagnose.candidates import Candidate
from quadid.diagnose.models import Model
from quadid.diagnose.probes import SITES, Alone
from quadid.diagnose.remainder import Remainder
from quadid.effects import EFFECTS

CHANGES = ("time", "thrust", "squared thrust", "cubed thrust", "a_x", "a_y", "a_z")
"""How the name of a signal begins that an offset may follow: warming up, vibration, acceleration."""
ALARM = 30.0
"""Chi-square of one signal alone that no luck brings among a few hundred …"""
SHARE = 0.008
"""… and the share of the finding's own worth that it must reach: an untidy vehicle has a little of everything."""


def inconstant(model: Model, left: Remainder) -> Iterator[tuple[Candidate, str]]:
    """Offsets in `model` that are not constant, each with a sentence that says what they follow."""
    group = {s.name: s.group for s in SITES}
    for cause in model.causes:
        kind = EFFECTS[cause.effect].constant_on
        if not kind:
            continue
        least = max(ALARM, SHARE * model.worth.get(cause.label, 0.0))
        here = [a for a in left.alone if a.site.startswith(kind) and a.signal.startswith(CHANGES)]
        here = [a for a in here if a.chi_square > least and a.chi_square >= _elsewhere(left, a, group)]
        if here:
            worst = max(here, key=lambda a: a.chi_square)
            yield (
                cause,
                (
                    f"{cause.effect} is not constant: what remains at {worst.site} follows {worst.signal}; "
                    "something else stands behind it, and it is not named with confidence"
                ),
            )


def _elsewhere(left: Remainder, found: Alone, group: dict[str, str]) -> float:
    """The most that the same signal explains at any site that looks alike from afar."""
    return max(a.chi_square for a in left.alone if a.signal == found.signal and group[a.site] == group[found.site])
