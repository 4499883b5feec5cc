"""One flight diagnosed, as a record that can be kept and compared."""

from __future__ import annotations

import json
import math
import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

from quadid.diagnose import diagnose
from quadid.errors import QuadidError
from studies.ablation.corpus import Flight, load

SAME = 0.01
"""Relative change of the error on unseen data below which two answers with equal names count as equal."""


@dataclass(frozen=True)
class Answer:
    """What a diagnosis gave.

    Attributes:
        flight: its name; variant: what was changed in the method.
        verdict: of the diagnosis, or ``refused``.
        listed: all findings, in order; named: the confident ones.
        right: whether that is what was hidden; None where nobody knows.
        nominal, extended: error on unseen data; seconds: of computing; numbers: found parameters.
    """

    flight: str
    variant: str
    verdict: str
    listed: tuple[str, ...]
    named: tuple[str, ...]
    right: bool | None
    nominal: float
    extended: float
    seconds: float
    numbers: dict[str, float]

    def differs(self, other: Answer) -> bool:
        """Whether verdict or names differ, or the error on unseen data by more than `SAME`."""
        names = (self.verdict, set(self.listed), set(self.named)) != (
            other.verdict, set(other.listed), set(other.named),
        )  # fmt: skip
        if math.isnan(self.extended) or math.isnan(other.extended):
            return names
        return names or abs(self.extended - other.extended) > SAME * max(self.extended, other.extended)


def ask(flight: Flight, variant: str, cache: Path | None) -> Answer:
    """Diagnoses one flight."""
    train, held, vehicle = load(flight, cache)
    began = time.process_time()
    try:
        found, _ = diagnose(train, vehicle, held, seed=0 if flight.case is None else flight.case.seed)
    except QuadidError as error:
        return Answer(flight.name, variant, f"refused: {error}", (), (), None, math.nan, math.nan, 0.0, {})
    seconds = time.process_time() - began
    named = tuple(f.effect for f in found.findings if f.confident)
    listed = tuple(f.effect for f in found.findings)
    numbers = {f"{f.effect}.{p.name}": p.value for f in found.findings for p in f.parameters}
    return Answer(
        flight.name, variant, found.verdict.value, listed, named, _right(flight, found.verdict.value, listed, named),
        found.validation.nominal, found.validation.extended, seconds, numbers,
    )  # fmt: skip


def _right(flight: Flight, verdict: str, listed: Sequence[str], named: Sequence[str]) -> bool | None:
    """Whether the answer is what the class of the flight asks for (as `studies.campaign.grading.right`)."""
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
    flights: Sequence[Flight], variant: str, cache: Path | None, records: Path, told: Callable[[Answer], None]
) -> list[Answer]:
    """Diagnoses all flights that `records` lacks under this variant, and keeps the answers there."""
    have = {a.flight: a for a in read(records) if a.variant == variant}
    out = []
    for flight in flights:
        answer = have.get(flight.name) or ask(flight, variant, cache)
        if flight.name not in have:
            with records.open("a", encoding="utf-8") as file:
                file.write(json.dumps(asdict(answer)) + "\n")
            told(answer)
        out.append(answer)
    return out


def read(records: Path) -> list[Answer]:
    """Answers kept so far."""
    if not records.exists():
        return []
    rows = [json.loads(line) for line in records.read_text(encoding="utf-8").splitlines()]
    return [Answer(**{**r, "listed": tuple(r["listed"]), "named": tuple(r["named"])}) for r in rows]
