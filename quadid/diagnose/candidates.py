"""The causes a diagnosis may name: which entries of the parameter vector each frees, and how its search starts."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from quadid.effects import EFFECTS
from quadid.model import layout as ix
from quadid.model.layout import NEVER, Layout

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Candidate:
    """One cause that may be added to the model.

    Attributes:
        effect: name of the effect.
        names: entries it frees.
        starts: non-neutral starting values of those entries, for causes that cannot be linearised at neutral.
        family: look-alikes; when one of a family is short-listed all of it is refitted.
        requires: effect that must be in the model first.
        timed: index of its time entry, when it begins at an unknown moment.
        label: tells candidates of one effect apart.
        split: for causes that show only together (drag in wind): what it stands for once accepted.
    """

    effect: str
    names: tuple[str, ...]
    starts: tuple[tuple[float, ...], ...] = ()
    family: str = ""
    requires: str | None = None
    timed: int | None = None
    label: str = field(default="")
    split: tuple[Candidate, ...] = ()

    def __post_init__(self) -> None:
        """Labels the candidate by its effect, and by its rotor for `weak_rotor`."""
        if not self.label:
            object.__setattr__(self, "label", self.effect)


_FAMILY = {
    "motor_lag": "late",
    "command_delay": "late",
    "imu_lag": "late",
    "attitude_delay": "late",
    "rotor_drag": "drag",
    "parasitic_drag": "drag",
    "mass_change": "step",
    "thrust_drop": "step",
    "battery_sag": "step",
    "thrust_curve": "thrust_curve",
    "weak_rotor": "corner",
    "cg_offset": "corner",
}
_STARTS: dict[str, tuple[tuple[float, ...], ...]] = {
    "motor_lag": ((0.02,),),
    "command_delay": ((0.015,),),
    "imu_lag": ((0.10,),),
    "attitude_delay": ((0.02,),),
    "rotor_drag": ((0.2, 0.2), (0.0, 0.0)),
    "parasitic_drag": ((0.03,), (0.0,)),
    "axial_inflow": ((0.2,), (0.0,)),
    "ground_effect": ((1.0,), (0.0,)),
}


def candidates(layout: Layout, has_velocity: bool, has_position: bool) -> list[Candidate]:
    """All causes that these data could show.

    Args:
        layout: parameter vector of the vehicle.
        has_velocity: velocity is measured.
        has_position: position is measured.
    """
    out = []
    for effect in EFFECTS:
        if (effect == "wind" and not has_velocity) or (effect == "ground_effect" and not has_position):
            continue
        if effect == "weak_rotor":
            for i in range(layout.rotors):
                name = f"weak_rotor.loss_{i + 1}"
                out.append(Candidate(effect, (name,), family="corner", label=f"weak_rotor {i + 1}"))
            continue
        names = tuple(n for n in layout.entries if n.split(".")[0] == effect and not n.endswith(".time"))
        timed = {"mass_change": ix.MASS_TIME, "thrust_drop": ix.DROP_TIME}.get(effect)
        requires = "rotor_drag" if effect in ("rotor_drag_moment", "wind") else None
        out.append(Candidate(effect, names, _STARTS.get(effect, ()), _FAMILY.get(effect, effect), requires, timed))
    if has_velocity:
        out.append(_in_wind(out))
    return out


def _in_wind(listed: list[Candidate]) -> Candidate:
    """Rotor drag with wind free beside it: drag alone explains nothing when the air moves faster than the vehicle."""
    drag = next(c for c in listed if c.effect == "rotor_drag")
    wind = next(c for c in listed if c.effect == "wind")
    start = (*drag.starts[0], 0.0, 0.0)
    return Candidate(
        "rotor_drag", (*drag.names, *wind.names), (start,), "drag", label="rotor_drag in wind", split=(drag, wind)
    )


def all_names(listed: list[Candidate]) -> list[str]:
    """Entries of all candidates, each once."""
    return list(dict.fromkeys(n for c in listed for n in c.names))


def unset_times(theta: FloatArray, active: set[str]) -> FloatArray:
    """Vector whose unused change times lie before the log, so that the derivative to a fraction covers all of it."""
    out = theta.copy()
    for effect, index in (("mass_change", ix.MASS_TIME), ("thrust_drop", ix.DROP_TIME)):
        if effect not in active:
            out[index] = -NEVER
    return out
