"""Figures of a campaign: shares with their binomial intervals, errors, coverage, gain against the oracle."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import stats

from quadid_evaluation.studies.campaign.grading import Graded, right

GAIN_TO_COMPARE = 0.05
"""Gains of the oracle below this are too small for a ratio."""


@dataclass(frozen=True)
class Share:
    """k of n, with its exact 95 % interval (Clopper and Pearson 1934)."""

    k: int
    n: int

    def __str__(self) -> str:
        if not self.n:
            return "–"
        low = stats.beta.ppf(0.025, self.k, self.n - self.k + 1) if self.k else 0.0
        high = stats.beta.ppf(0.975, self.k + 1, self.n - self.k) if self.k < self.n else 1.0
        return f"{self.k} of {self.n} ({100 * self.k / self.n:.1f} %, {100 * low:.0f}–{100 * high:.0f})"


def share(graded: Sequence[Graded], good: list[bool]) -> Share:
    """Share of true entries of `good`, one a case."""
    return Share(sum(good), len(graded))


def first_right(graded: Sequence[Graded]) -> Share:
    """First finding is (one of) what was hidden."""
    return share(graded, [g.first in g.case.expected for g in graded])


def nothing_else(graded: Sequence[Graded]) -> Share:
    """No effect named that was not hidden."""
    return share(graded, [all(n in g.case.hidden for n in g.named) for g in graded])


def all_found(graded: Sequence[Graded]) -> Share:
    """Everything hidden is named."""
    return share(graded, [set(g.case.expected) <= set(g.named) for g in graded])


def wholly_right(graded: Sequence[Graded]) -> Share:
    """`grading.right`."""
    return share(graded, [right(g) for g in graded])


def verdicts(graded: Sequence[Graded]) -> str:
    """Counts of verdicts."""
    return ", ".join(f"{name} {count}" for name, count in Counter(g.verdict for g in graded).most_common())


def parameter_errors(graded: Sequence[Graded]) -> dict[str, list[float]]:
    """Relative error of each hidden effect found, as a vector: |found - hidden| / |hidden|, by effect."""
    out: dict[str, list[float]] = {}
    for g in graded:
        for effect in g.case.expected:
            if effect not in g.values:
                continue
            names = [n for n in g.case.hidden[effect] if n not in ("rotor", "time")]
            found = np.array([g.values[effect].get(n, np.nan) for n in names])
            truth = np.array([g.case.hidden[effect][n] for n in names])
            out.setdefault(effect, []).append(float(np.linalg.norm(found - truth) / np.linalg.norm(truth)))
    return out


def coverage(graded: Sequence[Graded]) -> dict[str, Share]:
    """How often the 95 % interval of a found effect's own parameters holds the truth, by effect."""
    inside: dict[str, list[bool]] = {}
    for g in graded:
        for effect in g.case.expected:
            for name, (low, high) in g.intervals.get(effect, {}).items():
                if name in ("rotor", "time") or name not in g.case.hidden[effect]:
                    continue
                inside.setdefault(effect, []).append(bool(low <= g.case.hidden[effect][name] <= high))
    return {effect: Share(sum(v), len(v)) for effect, v in inside.items()}


def oracle_ratios(graded: Sequence[Graded]) -> list[float]:
    """Gain of the extended model over that of the oracle, on the flight not used, where there is a gain to speak of."""
    return [
        (g.mse_nominal - g.mse_extended) / (g.mse_nominal - g.mse_oracle)
        for g in graded
        if g.mse_oracle is not None and g.mse_nominal - g.mse_oracle > GAIN_TO_COMPARE
    ]
