"""Simulated campaign: damage hidden in two simulators, healthy flights that differ as real ones do.

One flies the vehicle in closed loop (`quadid.flight`), the other solves the balance of a hover
(`quadid_evaluation.studies.health.flights`); neither shares an equation with the other or with the comparison.
"""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from quadid.condition import FlightTrim, assess, flight_trim
from quadid.data.window import Recording
from quadid.flight import fly
from quadid.vehicle import Vehicle
from quadid_evaluation.harness import table
from quadid_evaluation.studies.health.flights import Wrong, hover

SECONDS, BASELINES, SEED = 30.0, 6, 7
ROTOR_SPREAD, SHIFT, EFFORT = 0.01, 0.0007, 0.01
"""From flight to flight: each rotor's thrust (relative), the battery's place [m an axis], the load; 1 sigma."""
LOSSES = (0.02, 0.03, 0.05, 0.1, 0.2, 0.3)


@dataclass(frozen=True)
class Case:
    """A hidden damage: losses of thrust and of drag torque by rotor (from 1), a shift of the CG [m], a mass (fraction)
    and where it sits [m]."""

    group: str
    losses: Mapping[int, float] = field(default_factory=dict)
    drag_losses: Mapping[int, float] = field(default_factory=dict)
    shift: tuple[float, float] = (0.0, 0.0)
    mass: float = 0.0
    place: tuple[float, float] = (0.0, 0.0)


def cases(each: int) -> Iterator[Case]:
    """All cases: `each` of every kind, four times as many healthy ones."""
    rng = np.random.default_rng(SEED)

    def polar(low: float, high: float) -> tuple[float, float]:
        angle, size = float(rng.uniform(0.0, 2.0 * np.pi)), float(rng.uniform(low, high))
        return size * float(np.cos(angle)), size * float(np.sin(angle))

    yield from (Case("healthy") for _ in range(4 * each))
    for loss in LOSSES:
        for n in range(each):
            lost = {n % 4 + 1: loss}
            yield Case(f"one rotor, {100 * loss:.0f} %", lost, lost)
    for n in range(each):
        size = float(rng.uniform(0.1, 0.3))
        yield Case("one rotor, thrust alone, 10 to 30 %", {n % 4 + 1: size}, {n % 4 + 1: 0.0})
    for n in range(each):
        size = float(rng.uniform(0.05, 0.15))
        yield Case("one rotor, 5 to 15 % less thrust, as much more drag", {n % 4 + 1: size}, {n % 4 + 1: -size})
    for count in (2, 3):
        for _ in range(each):
            chosen = rng.choice(4, count, replace=False) + 1
            lost = {int(j): float(rng.uniform(0.1, 0.3)) for j in chosen}
            yield Case(f"{count} rotors, 10 to 30 %", lost, lost)
    for _ in range(each):
        yield Case("weight, 5 to 20 %", mass=float(rng.uniform(0.05, 0.2)), place=polar(0.08, 0.21))
    for _ in range(each):
        yield Case("battery moved 5 to 12 mm", shift=polar(0.005, 0.012))
    for sign, what in ((1.0, "less"), (-1.0, "more")):
        for n in range(each):
            size = sign * float(rng.uniform(0.1, 0.3))
            yield Case(f"one rotor, thrust kept, 10 to 30 % {what} drag", {n % 4 + 1: 0.0}, {n % 4 + 1: size})


def flown(vehicle: Vehicle, case: Case, seed: int, profile: str) -> Recording:
    """Flies the case once in closed loop, with what differs from flight to flight."""
    rng = np.random.default_rng(seed)
    own = {j: float(rng.normal(0.0, ROTOR_SPREAD)) for j in (1, 2, 3, 4)}
    weak = {f"loss_{j}": 1.0 - (1.0 - own[j]) * (1.0 - case.losses.get(j, 0.0)) for j in own}
    weak |= {f"drag_loss_{j}": 1.0 - (1.0 - own[j]) * (1.0 - case.drag_losses.get(j, 0.0)) for j in own}
    hung = [case.mass / (1.0 + case.mass) * p for p in case.place]
    x, y = (s + h + float(rng.normal(0.0, SHIFT)) for s, h in zip(case.shift, hung, strict=True))
    loaded = vehicle.model_copy(update={"mass": vehicle.mass * (1.0 + case.mass + float(rng.normal(0.0, EFFORT)))})
    effects = {"weak_rotor": weak, "cg_offset": {"x": x, "y": y}}
    return fly(loaded, seconds=SECONDS, seed=seed, profile=profile, effects=effects).recording


def balanced(vehicle: Vehicle, case: Case, seed: int, profile: str) -> Recording:
    """The same by the balance of a hover."""
    rng = np.random.default_rng(seed)
    shift = case.shift[0] + float(rng.normal(0.0, SHIFT)), case.shift[1] + float(rng.normal(0.0, SHIFT))
    wrong = Wrong(case.losses, case.drag_losses, case.mass * vehicle.mass, case.place, shift)
    return hover(vehicle, wrong, seed, ROTOR_SPREAD, SECONDS)


Simulator = Callable[[Vehicle, Case, int, str], Recording]
SIMULATORS: Mapping[str, Simulator] = {"closed loop": flown, "balance": balanced}


def right(case: Case, effects: list[tuple[str, int]]) -> bool:
    """Checks whether the answer names what is hidden, and no other rotor or cause."""
    if case.losses:
        return {rotor for effect, rotor in effects if effect == "weak_rotor"} == set(case.losses)
    names = {effect for effect, _ in effects}
    if case.mass:
        return names == {"mass_change", "cg_offset"}
    return names == {"cg_offset"} if case.shift != (0.0, 0.0) else not names


class Outcome(NamedTuple):
    """Flags of a case: called changed, rightly answered, wrongly with confidence; errors of its losses of thrust
    and drag torque, NaN where none is named."""

    changed: bool
    right: bool
    misled: bool
    loss: float
    drag_loss: float


def judged(case: Case, k: int, simulate: Simulator) -> Outcome:
    """Answer to case `k`."""
    vehicle = Vehicle.shipped(("pelican", "pelican_x")[k % 2])
    profile = ("hover", "gentle", "excited")[k % 3]

    def trim(one: Case, i: int) -> FlightTrim:
        return flight_trim(simulate(vehicle, one, 1000 * k + i, profile), vehicle)

    baseline = [trim(Case(""), i) for i in range(1, BASELINES + 1)]
    found = assess([trim(case, 0)], baseline, vehicle)
    changed = found.verdict != "unchanged"
    named = [(c.effect, int(c.parameters[0][2]) if c.effect == "weak_rotor" else 0) for c in found.changes]
    errors = [np.nan, np.nan]
    if len(case.losses) == 1 and right(case, named):
        values = {name: value for name, _, value, _ in found.changes[0].parameters}
        (j,) = case.losses
        errors = [abs(values["loss"] - case.losses[j]), abs(values["drag_loss"] - case.drag_losses[j])]
    hidden = bool(case.losses) or case.mass > 0.0 or case.shift != (0.0, 0.0)
    good = right(case, named) if changed else not hidden
    return Outcome(changed, good, not good and any(c.confident for c in found.changes), *errors)


def text(each: int) -> list[str]:
    """The campaign as Markdown; `each` cases of every kind."""
    done: dict[str, dict[str, list[Outcome]]] = {}
    for k, case in enumerate(cases(each)):
        for name, simulate in SIMULATORS.items():
            done.setdefault(case.group, {}).setdefault(name, []).append(judged(case, k, simulate))
    rows = []
    for group, by in done.items():
        counts = "; ".join(
            ", ".join(str(sum(flags)) for flags in list(zip(*by[name], strict=True))[:3]) for name in SIMULATORS
        )
        errors = np.array([answer[3:] for answer in by["closed loop"]]).T
        sizes = [f"{100.0 * np.nanmedian(e):.1f}" for e in errors if np.isfinite(e).any()]
        rows.append((f"{group} ({len(errors.T)})", counts, ", ".join(sizes) or "–"))
    counted = f"changed, right, wrong with confidence: {'; '.join(SIMULATORS)}"
    return [
        f"## Simulated flights\n`make health`, seed {SEED}; Pelican (plus and X frame) of {SECONDS:.0f} s, "
        f"{BASELINES} baseline flights each, in closed loop (`quadid.flight`) and by the balance of a hover. "
        "Between flights, rotor thrust varies by 1 %, the battery by 0.7 mm, the load by 1 % (1 sigma).",
        "",
        *table(("hidden (flights)", counted, "error of loss, of drag loss [%]"), rows),
        "",
        "A rotor that lost only thrust and a weight at its hub have the same trims; the likelier weight is named. "
        "Drag torque alone moves the yaw trim alone, as much for every rotor: the change is found, the rotor is a "
        "guess (one right in four).",
    ]
