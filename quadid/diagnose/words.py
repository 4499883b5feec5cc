"""One sentence a finding, for a pilot: what it is, how large, what it is worth."""

from __future__ import annotations

from collections.abc import Mapping

from quadid.effects import EFFECTS


def evidence(effect: str, values: Mapping[str, float], before: float, after: float) -> str:
    """Sentence of one finding.

    Args:
        effect: contract name.
        values: its numbers in contract units.
        before: mean squared error on unseen data without it (noise floor 1).
        after: the same with it.
    """
    body = EFFECTS[effect].told(values)
    return (
        f"{body[0].upper()}{body[1:]}; on unseen data the error falls from {before:.3g} to {after:.3g} times the noise."
    )
