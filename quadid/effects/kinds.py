"""What one entry of the table of effects holds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal

Acts = Literal["command", "rotor", "air", "body", "flight", "sensor"]
Scale = Literal["", "arm", "inertia", "rotor_inertia", "hover_speed", "rotor_weight"]


@dataclass(frozen=True)
class EffectParameter:
    """One number of an effect.

    Attributes:
        name: name inside the effect, as written in vehicle files and results.
        unit: SI unit.
        neutral: value at which the effect vanishes.
        lower, upper: physically sensible bounds.
        typical: size met on real vehicles: unit of the search, of finite differences and of the prior.
        start: where the search begins, in the vector's unit; 0: at neutral, where the model is linear in it.
        sign: +1 where physics keeps it from being negative.
        scale: what its size goes with on other airframes.
        factor: to the unit of the sentence.
        optional: stays at neutral until data ask for it beside the effect's other numbers.
        flexible: free in the model that is to leave only noise, where its effect is; not what doubles d and J_zz there.
        entry: its name in the parameter vector, where that holds another form of it.
        beside: parameter of the same effect which it replaces in part; it is that one's value plus its vector entry,
            and that one's value where a vehicle file leaves it out.
    """

    name: str
    unit: str
    neutral: float
    lower: float
    upper: float
    typical: float
    start: float = 0.0
    sign: int = 0
    scale: Scale = ""
    factor: float = 1.0
    optional: bool = False
    flexible: bool = True
    entry: str = ""
    beside: str = ""


@dataclass(frozen=True)
class Effect:
    """One entry of the catalogue.

    Attributes:
        name: name of `docs/effects.md`.
        acts: where: on the way from command to rotor speed, at the rotor, through the air (velocity matters), on the
            body, at some time of one flight, or in a sensor (the motion stays).
        parameters: its numbers.
        summary: one sentence for a pilot.
        sentence: one with numbers, of a finding.
        advice: what a pilot or builder can do about it, beside putting it into the model.
        shows: residuals that show it, ``channel: against``; ``channel'`` is the residual's rate of change.
        family: look-alikes, which are compared with each other; default none but itself.
        requires: effect without which it cannot be seen.
        needs: measured channels without which it cannot be seen; rotor columns that are commands, or readings.
        per_log: its values belong to a flight and not to the vehicle.
        memory: it needs a stretch before a segment in which it settles.
        flexible: whether it is free in the model that is to leave only noise; not what doubles another effect or needs
            a time.
        sized: a data sheet bounds it.
        constant_on: kind of channel on which it claims a constant offset.
        ties: two nominal parameters of which no more than the ratio shows where this acts.
    """

    name: str
    acts: Acts
    parameters: tuple[EffectParameter, ...]
    summary: str
    sentence: str
    advice: str
    shows: tuple[str, ...]
    family: str = ""
    requires: str | None = None
    needs: tuple[str, ...] = ()
    per_log: bool = False
    memory: bool = False
    flexible: Literal["always", "with_velocity", "never"] = "always"
    sized: bool = False
    constant_on: str = ""
    ties: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        """An effect without look-alikes is a family of its own."""
        if not self.family:
            object.__setattr__(self, "family", self.name)

    def parameter(self, name: str) -> EffectParameter:
        """Returns the parameter called `name`; raises KeyError when there is none."""
        for parameter in self.parameters:
            if parameter.name == name:
                return parameter
        raise KeyError(name)

    @property
    def timed(self) -> bool:
        """Whether it begins at an unknown moment."""
        return any(p.name == "time" for p in self.parameters)

    @property
    def turns(self) -> bool:
        """Whether angular acceleration shows it, from which a moment of inertia is estimated."""
        return any("':" in s or s.endswith("_dot") for s in self.shows)

    @property
    def needs_fast_rotors(self) -> bool:
        """Whether a rotor signal too slow for inertias hides it: a lag or delay is over before the next sample."""
        return self.family == "late"

    @property
    def refinements(self) -> tuple[str, ...]:
        """Names in the parameter vector of its optional numbers."""
        return tuple(f"{self.name}.{p.entry or p.name}" for p in self.parameters if p.optional)

    @property
    def entries(self) -> tuple[str, ...]:
        """Its names in the parameter vector, times and optional ones left out."""
        return tuple(f"{self.name}.{p.entry or p.name}" for p in self.parameters if p.name != "time" and not p.optional)

    @property
    def flexible_entries(self) -> tuple[str, ...]:
        """Those of `entries` that are free in the model that is to leave only noise."""
        rigid = {f"{self.name}.{p.entry or p.name}" for p in self.parameters if not p.flexible}
        return tuple(name for name in self.entries if name not in rigid)

    @property
    def start(self) -> tuple[float, ...]:
        """Where a search over `entries` begins; none: at neutral."""
        start = tuple(p.start for p in self.parameters if p.name != "time" and not p.optional)
        return start if any(start) else ()

    def describe(self, values: Mapping[str, float]) -> str:
        """The sentence with these values, in contract units."""
        factor = {p.name: p.factor for p in self.parameters}
        return self.sentence.format(**{k: v * factor.get(k, 1.0) for k, v in values.items()})
