"""The effects a simulation may lack: one table with all properties of each (`quadid.effects.table`).

It is the vocabulary shared by the vehicle file, the model, the diagnosis, its reports and the flown truth.  It holds no
equations: those of the model under test are in `quadid.model`, those of the flown vehicle in `quadid.flight`.
"""

from __future__ import annotations

from collections.abc import Mapping

from quadid.effects.kinds import Effect as Effect
from quadid.effects.kinds import EffectParameter as EffectParameter
from quadid.effects.table import NEVER as NEVER
from quadid.effects.table import TABLE
from quadid.errors import ParameterError, nearest

EFFECTS: dict[str, Effect] = {e.name: e for e in TABLE}
"""Every effect by name; `docs/effects.md` explains each."""


def parameter_of(effect: str, key: str) -> EffectParameter:
    """The parameter called `key` of an effect.

    Raises:
        ParameterError: there is none.
    """
    known = [p.name for p in EFFECTS[effect].parameters]
    if key not in known:
        raise ParameterError(f"effect '{effect}' has no parameter '{key}'", ", ".join(known), nearest(key, known))
    return EFFECTS[effect].parameter(key)


def known_keys(name: str, rotors: int) -> list[str]:
    """Keys that effect `name` may have in a vehicle file; several weak rotors have ``loss_1``, ``drag_loss_1``, …."""
    keys = [p.name for p in EFFECTS[name].parameters]
    each = [f"{key}_{i + 1}" for i in range(rotors) for key in ("loss", "drag_loss")]
    return [*keys, *each] if name == "weak_rotor" else keys


def rotor_losses(numbers: Mapping[str, float], rotors: int) -> list[float]:
    """Loss of every rotor, from the numbers of `weak_rotor`: `rotor` and `loss`, or ``loss_1`` … for several.

    Raises:
        ParameterError: no such rotor, or both ways at once.
    """
    rotor, loss = numbers.get("rotor", 0.0), numbers.get("loss", 0.0)
    several = sorted(set(numbers) - {"rotor", "loss", "drag_loss"})
    if several and (rotor or loss):
        raise ParameterError(f"weak_rotor: rotor {rotor:g} beside {several[0]}", "rotor and loss, or loss_1, loss_2, …")
    absent = [key for key in several if key not in known_keys("weak_rotor", rotors)]
    if absent:
        raise ParameterError(f"weak_rotor: {absent[0]}", f"loss_1 to loss_{rotors}")
    if (loss or numbers.get("drag_loss")) and not rotor:
        raise ParameterError(f"weak_rotor: loss {loss:g} of no rotor", "rotor beside it", f"say which, 1 to {rotors}")
    if rotor not in range(rotors + 1):
        raise ParameterError(f"weak_rotor: rotor {rotor:g}", f"a whole number from 1 to {rotors}")
    return [numbers.get(f"loss_{i + 1}", loss if rotor == i + 1 else 0.0) for i in range(rotors)]


def rotor_drag_losses(numbers: Mapping[str, float], rotors: int) -> list[float]:
    """Share of its drag torque that every rotor lost: as its thrust, unless `drag_loss`, or ``drag_loss_1`` …, differ.

    Raises:
        ParameterError: as `rotor_losses`.
    """
    out = rotor_losses(numbers, rotors)
    for i in range(rotors):
        alone = "drag_loss" if numbers.get("rotor") == i + 1 else f"drag_loss_{i + 1}"
        out[i] = numbers.get(alone, out[i])
    return out
