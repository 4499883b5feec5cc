"""Simulated campaign: damage hidden in the flown vehicle, healthy flights that differ as real ones do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from quadid.flight import fly
from quadid.health import FlightTrim, assess, flight_trim
from quadid.vehicle import Vehicle

SECONDS, BASELINES = 30.0, 6
ROTOR_SPREAD, SHIFT, EFFORT = 0.01, 0.0007, 0.01
"""From flight to flight: each rotor's thrust (relative), the battery's place [m a axis], thrust of all; 1 sigma."""
LOSSES = (0.02, 0.03, 0.05, 0.1, 0.2, 0.3)


@dataclass(frozen=True)
class Case:
    """What is hidden: losses by rotor (from 1), a shift of the CG [m], added mass (fraction)."""

    group: str
    number: int
    losses: dict[int, float] = field(default_factory=dict)
    shift: tuple[float, float] = (0.0, 0.0)
    mass: float = 0.0


def cases(each: int) -> Iterator[Case]:
    """All cases: `each` of every kind, twice as many healthy ones."""
    rng = np.random.default_rng(7)
    for n in range(4 * each):
        yield Case("healthy", n)
    for loss in LOSSES:
        for n in range(each):
            yield Case(f"one rotor, {100 * loss:.0f} %", n, {n % 4 + 1: loss})
    for count in (2, 3):
        for n in range(each):
            chosen = rng.choice(4, count, replace=False) + 1
            yield Case(f"{count} rotors, 10 to 30 %", n, {int(j): float(rng.uniform(0.1, 0.3)) for j in chosen})
    for n in range(each):
        mass, angle = float(rng.uniform(0.05, 0.2)), float(rng.uniform(0.0, 2.0 * np.pi))
        reach = float(rng.uniform(0.4, 1.0)) * 0.21 * mass / (1.0 + mass)
        yield Case("weight, 5 to 20 %", n, {}, (reach * np.cos(angle), reach * np.sin(angle)), mass)
    for n in range(each):
        angle, size = float(rng.uniform(0.0, 2.0 * np.pi)), float(rng.uniform(0.005, 0.012))
        yield Case("battery moved 5 to 12 mm", n, {}, (size * np.cos(angle), size * np.sin(angle)))


def trim(vehicle: Vehicle, case: Case, seed: int, profile: str) -> FlightTrim:
    """Flies the case once, with what differs from flight to flight."""
    rng = np.random.default_rng(seed)
    losses = {f"loss_{j}": float(rng.normal(0.0, ROTOR_SPREAD)) for j in (1, 2, 3, 4)}
    for j, loss in case.losses.items():
        losses[f"loss_{j}"] = 1.0 - (1.0 - losses[f"loss_{j}"]) * (1.0 - loss)
    x, y = (s + float(rng.normal(0.0, SHIFT)) for s in case.shift)
    flown = vehicle.model_copy(update={"mass": vehicle.mass * (1.0 + case.mass + float(rng.normal(0.0, EFFORT)))})
    effects = {"weak_rotor": losses, "cg_offset": {"x": x, "y": y}}
    return flight_trim(fly(flown, seconds=SECONDS, seed=seed, profile=profile, effects=effects).recording, vehicle)


def right(case: Case, effects: list[tuple[str, int]]) -> bool:
    """Whether the answer names what is hidden, and no other rotor or cause."""
    if case.losses:
        return {rotor for effect, rotor in effects if effect == "weak_rotor"} == set(case.losses)
    names = {effect for effect, _ in effects}
    if case.mass:
        return names == {"mass_change", "cg_offset"}
    return names == {"cg_offset"} if case.shift != (0.0, 0.0) else not names


def table(each: int = 12) -> str:
    """The campaign as Markdown."""
    done: dict[str, list[tuple[bool, bool, float]]] = {}
    for k, case in enumerate(cases(each)):
        vehicle = Vehicle.shipped(("pelican", "pelican_x")[k % 2])
        profile = ("hover", "gentle", "excited")[k % 3]
        baseline = [trim(vehicle, Case("", 0), 1000 * k + i, profile) for i in range(1, BASELINES + 1)]
        found = assess([trim(vehicle, case, 1000 * k, profile)], baseline, vehicle)
        changed = found.verdict != "unchanged"
        named = [(c.effect, int(c.parameters[0][2]) if c.effect == "weak_rotor" else 0) for c in found.changes]
        first = next((p[2] for c in found.changes for p in c.parameters if p[0] == "loss"), np.nan)
        error = abs(first - max(case.losses.values())) if len(case.losses) == 1 and right(case, named) else np.nan
        done.setdefault(case.group, []).append((changed, right(case, named) if changed else not _hidden(case), error))
    lines = ["| hidden | called changed | right answer | median error of the loss |", "|---|---|---|---|"]
    for group, rows in done.items():
        changed, correct, errors = np.array(rows).T
        error = f"{100.0 * np.nanmedian(errors):.1f} %" if np.isfinite(errors).any() else "–"
        counts = (f"{int(sum(v))} of {len(rows)}" for v in (changed, correct))
        lines.append(f"| {group} | " + " | ".join(counts) + f" | {error} |")
    return "\n".join(lines)


def _hidden(case: Case) -> bool:
    return bool(case.losses) or case.mass > 0.0 or case.shift != (0.0, 0.0)
