"""Whether a set of an earlier run is one that this run could have estimated: nothing that a file says is believed."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from quadid.online.flexible_fit import ROOM, with_room
from quadid.online.gate import GateSettings, implausible
from quadid.online.records import OnlineSet
from quadid.parameters import NOMINAL_NAMES, ParameterSet
from quadid.vehicle import Vehicle


def why_none(found: OnlineSet, number: int, gate: GateSettings, vehicle: Vehicle | None) -> str:
    """Why a stored set is none that a fresh estimate could be; empty where it may be one.

    Args:
        found: the set.
        number: of the row that holds it.
        gate: of this run.
        vehicle: of this run, whose bounds hold for it; None: those of the set itself.
    """
    if found.sequence != number:
        return f"it says that it is set {str(found.sequence)[:40]} in the row of set {str(number)[:40]}"
    if found.parameters.names != NOMINAL_NAMES:
        missing = [n for n in NOMINAL_NAMES if n not in found.parameters.names]
        return (
            f"it lacks {', '.join(missing)}" if missing else f"it has other parameters than {', '.join(NOMINAL_NAMES)}"
        )
    if not np.isfinite(found.parameters.covariance).all():
        return "its covariance is not a number"
    if vehicle is None:
        return implausible(found.parameters, gate) or ""
    if not math.isnan(found.mass) and not vehicle.mass / ROOM <= found.mass <= vehicle.mass * ROOM:
        return f"it rests on a mass of {found.mass:g} kg, the vehicle has {vehicle.mass:g} kg"
    widest = with_room(vehicle).parameters
    bounded = tuple(replace(p, bounds=widest[p.name].limits) for p in found.parameters)
    vague = next((p for p in bounded if p.sigma > ROOM * p.bounds[1]), None)
    if vague is not None:
        return f"{vague.name} has a standard deviation of {vague.sigma:g} {vague.unit}"
    return implausible(ParameterSet(bounded, found.parameters.covariance), gate) or ""
