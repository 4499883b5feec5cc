"""The causes a diagnosis may name: which entries of the parameter vector each frees, and how its search starts."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field

from quadid.effects import EFFECTS, NEVER, Effect
from quadid.model.layout import Layout, places
from quadid.types import FloatArray


@dataclass(frozen=True)
class Candidate:
    """One cause that may be added to the model.

    Attributes:
        effect: name of the effect.
        names: entries it frees.
        start: non-neutral starting values of those entries, for causes that cannot be linearised at neutral.
        requires: effect, or label of a cause, that must be in the model first.
        timed: index of its time entry, when it begins at an unknown moment.
        label: distinguishes candidates of one effect.
        refines: it frees optional numbers of an effect that is in the model, and shares its finding.
        split: what it stands for once accepted, where that shows only together.
    """

    effect: str
    names: tuple[str, ...]
    start: tuple[float, ...] = ()
    requires: str | None = None
    timed: int | None = None
    label: str = field(default="")
    refines: bool = False
    split: tuple[Candidate, ...] = ()

    @property
    def family(self) -> str:
        """Look-alikes; when one of a family is short-listed all of it is refitted."""
        return EFFECTS[self.effect].family

    def carries(self, other: Candidate) -> bool:
        """Whether `other` can only be in a model that has this one; a refinement carries nothing."""
        return not self.refines and other.requires in (self.effect, self.label)

    def __post_init__(self) -> None:
        """Labels the candidate by its effect, and by its rotor for `weak_rotor`."""
        if not self.label:
            object.__setattr__(self, "label", self.effect)


def candidates(
    layout: Layout, has_velocity: bool, has_position: bool, rotors: Collection[str] = ("commands",)
) -> list[Candidate]:
    """All causes that these data could show.

    Args:
        layout: parameter vector of the vehicle.
        has_velocity: velocity is measured.
        has_position: position is measured.
        rotors: what their columns are, commands or readings, and battery where the supply voltage is known.
    """
    out = []
    known = {*rotors, *(["velocity"] if has_velocity else []), *(["position"] if has_position else [])}
    for spec in EFFECTS.values():
        effect = spec.name
        if not known.issuperset(spec.needs):
            continue
        if effect == "weak_rotor":
            for i in range(layout.rotors):
                label = f"{effect} {i + 1}"
                out.append(Candidate(effect, (f"{effect}.loss_{i + 1}",), label=label))
                torque = f"{label} drag torque"
                out.append(Candidate(effect, (f"{effect}.extra_{i + 1}",), requires=label, label=torque, refines=True))
            continue
        timed = layout.entry(f"{effect}.time").index if spec.timed else None
        cause, optional = Candidate(effect, spec.entries, spec.start, spec.requires, timed), _refinements(spec)
        out += [cause, *optional]
        for at_cg in (c for c in optional if c.names == (f"{effect}.central",)):
            # Air that acts at the CG turns nothing; at the hubs, where it does, it may explain nothing.
            names, start, both = (*cause.names, *at_cg.names), (*spec.start, 1.0), (cause, at_cg)
            out.append(Candidate(effect, names, start, label=f"{effect} at the CG", split=both))
    if has_velocity:
        # Drag in air that moves faster than the vehicle explains nothing alone.
        drag, wind = (next(c for c in out if c.label == wanted) for wanted in ("rotor_drag", "wind"))
        names, start, both = (*drag.names, *wind.names), (*drag.start, 0.0, 0.0), (drag, wind)
        out.append(Candidate(drag.effect, names, start, label="rotor_drag in wind", split=both))
    return out


def _refinements(spec: Effect) -> list[Candidate]:
    """Optional numbers of an effect, once it is in the model: those of a payload together, others each alone."""
    together = [spec.refinements] if spec.timed else [(name,) for name in spec.refinements]
    return [
        Candidate(spec.name, names, requires=spec.name, label=f"{spec.name} {names[0].split('.')[1]}", refines=True)
        for names in together
        if names
    ]


def unset_times(theta: FloatArray, active: set[str]) -> FloatArray:
    """Vector whose unused change times lie before the log, so that the derivative to a fraction covers all of it."""
    out = theta.copy()
    for spec in EFFECTS.values():
        if spec.timed and spec.name not in active:
            out[list(places(f"{spec.name}.time"))] = -NEVER
    return out
