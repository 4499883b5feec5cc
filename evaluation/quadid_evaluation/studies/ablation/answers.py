"""One flight diagnosed, as a record that can be kept and compared."""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from quadid.diagnosis import diagnose
from quadid.errors import QuadidError
from quadid_evaluation.studies.ablation.corpus import Flight, Given, load
from quadid_evaluation.studies.ablation.memory import Memory
from quadid_evaluation.studies.ablation.variants import Variant
from quadid_evaluation.studies.foreign.numbers import of_set

SAME = 0.01
"""Relative change of the error on unseen data below which two answers with equal names count as equal."""
WIDTH = 0.05
"""The same for the width of an interval."""


@dataclass(frozen=True)
class Answer:
    """What a diagnosis gave.

    Attributes:
        flight: its name; variant: what was changed in the method.
        verdict: of the diagnosis, or ``refused``.
        listed: all findings, in order; named: the confident ones.
        right: whether that is what was hidden, or, of recorded flights, no number called identified excludes what is
            known of the vehicle; None where nobody knows.
        nominal, extended: error on unseen data; fits: linearisations asked for.
        intervals: of the numbers found, 95 %.
        follows: what the rest follows most, and where.
    """

    flight: str
    variant: str
    verdict: str
    listed: tuple[str, ...]
    named: tuple[str, ...]
    right: bool | None
    nominal: float
    extended: float
    fits: int
    intervals: dict[str, tuple[float, float]]
    follows: str = ""

    def difference(self, other: Answer) -> str:
        """What an answer has that this one has not, in words; empty where nothing differs.

        Names come before the first of them and the verdict, these before the error on unseen data, and that before
        intervals and the rest.
        """
        gone, come = (sorted(set(a.listed) - set(b.listed)) for a, b in ((self, other), (other, self)))
        if gone or come:
            return ", ".join([*(f"−{n}" for n in gone), *(f"+{n}" for n in come)])
        if self.listed[:1] != other.listed[:1]:
            return f"first {self.listed[0]} → {other.listed[0]}"
        if (self.verdict, set(self.named)) != (other.verdict, set(other.named)):
            return f"{self.verdict}, {len(self.named)} confident → {other.verdict}, {len(other.named)}"
        if abs(self.extended - other.extended) > SAME * max(self.extended, other.extended):
            return f"error {self.extended:.3g} → {other.extended:.3g}"
        for name, (low, high) in self.intervals.items():
            width, new = high - low, other.intervals[name][1] - other.intervals[name][0]
            if abs(new - width) > WIDTH * max(width, new):
                return f"interval of {name} {width:.2g} → {new:.2g}"
        if self.right != other.right:
            return f"numbers {'wrong → right' if other.right else 'right → wrong'}"
        if self.follows != other.follows:
            return f"rest follows “{self.follows}” → “{other.follows}”"
        return ""


def ask(flight: Flight, given: Given, variant: str, memory: Memory) -> Answer:
    """Diagnoses one flight."""
    train, held, vehicle = given
    memory.asked = 0
    try:
        seed = 0 if flight.case is None else flight.case.seed
        found, _ = diagnose(train, vehicle, held, seed)
    except QuadidError as error:
        return Answer(flight.name, variant, f"refused: {error}", (), (), None, math.nan, math.nan, memory.asked, {})
    named = tuple(f.effect for f in found.findings if f.confident)
    listed = tuple(f.effect for f in found.findings)
    # Of one effect that is found twice, as weak rotors are, the second one counts.
    intervals = {f"{f.effect}.{p.name}": p.ci95 for f in found.findings for p in f.parameters}
    follows = next((f"{f.signal} at {f.site.name}" for f in found.remainder.followed), "")
    right = _right(flight, found.verdict.value, listed, named)
    if flight.known is not None:
        right = all(n.inside for n in of_set("", flight.known, {"": found.to_dict()}) if n.identified)
    return Answer(
        flight.name, variant, found.verdict.value, listed, named, right,
        found.validation.nominal, found.validation.extended, memory.asked, intervals, follows,
    )  # fmt: skip


def _right(flight: Flight, verdict: str, listed: Sequence[str], named: Sequence[str]) -> bool | None:
    """Whether the answer is what the class of the flight asks for (as
    `quadid_evaluation.studies.campaign.grading.right`)."""
    if flight.hidden is None:
        return None
    if flight.hidden == ("unknown",):
        return verdict == "unknown"
    if flight.clutter:
        return bool(listed) and listed[0] in flight.hidden and set(named) <= set(flight.clutter)
    if flight.case is not None and flight.case.outside:
        return not named
    return Counter(named) == Counter(flight.hidden) and (bool(named) or verdict == "nothing_found")


def run(
    flight: Flight, chosen: Sequence[Variant], cache: Path | None, records: Path, told: Callable[[Answer], None]
) -> list[Answer]:
    """Diagnoses one flight under each variant that `records` lacks, and keeps the answers there."""
    have = {a.variant: a for a in read(records) if a.flight == flight.name}
    if any(v.name not in have for v in chosen):
        given, memory = load(flight, cache), Memory()
        with memory.in_use():
            for variant in (v for v in chosen if v.name not in have):
                with variant.in_force():
                    answer = have[variant.name] = ask(flight, given, variant.name, memory)
                with records.open("a", encoding="utf-8") as file:
                    file.write(json.dumps(asdict(answer)) + "\n")
                told(answer)
    return [have[v.name] for v in chosen]


def read(records: Path) -> list[Answer]:
    """Answers kept so far."""
    if not records.exists():
        return []
    rows = [json.loads(line) for line in records.read_text(encoding="utf-8").splitlines()]
    return [Answer(**{**r, "listed": tuple(r["listed"]), "named": tuple(r["named"])}) for r in rows]
