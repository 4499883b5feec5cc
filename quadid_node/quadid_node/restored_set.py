"""The set that a history says is in force: one rule for the service that takes it up and for all who read it.

Nothing that a file says is believed: a set of an earlier run must be one that this run could have estimated.
"""

from __future__ import annotations

import json
import math
import sqlite3
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from quadid.online.flexible_fit import ROOM, with_room
from quadid.online.gate import GateSettings, implausible
from quadid.online.records import OnlineSet, SetState
from quadid.parameters import NOMINAL_NAMES, ParameterSet
from quadid.vehicle import Vehicle
from quadid_node.codec import set_from_dict
from quadid_node.store_file import UNREADABLE, opened

_FORCE = "state IN ('accepted', 'rolled_back')"
_SAME_MASS = 1e-6
"""Relative difference of masses that were written and read back."""


class StoredSet(NamedTuple):
    """A set of a history.

    Attributes:
        item: the set; None where there is none, or none that can be read.
        why_none: why it cannot be taken up; empty where it can, or where there is none.
        confirmed: whether a flight of the last run confirmed it; after a restart a set is stale until one does.
    """

    item: OnlineSet | None
    why_none: str = ""
    confirmed: bool = True

    @property
    def doubt(self) -> str:
        """What the set is that speaks against its use, as "out of date: ..."; empty where nothing speaks against it."""
        if self.why_none:
            return f"no set that a fit makes: {self.why_none}"
        if self.item is not None and self.item.outdated:
            return f"out of date: {self.item.outdated}"
        return "" if self.confirmed else "stale: no flight has confirmed it since the service started again"


def in_force(db: sqlite3.Connection, name: str, gate: GateSettings, vehicle: Vehicle | None) -> StoredSet:
    """The set last in force, with why it is out of date: withdrawn since, or of another mass than the vehicle file's.

    Args:
        db: the history.
        name: of the vehicle in it.
        gate: of this run.
        vehicle: of this run; None: its mass is not compared.
    """
    last = stored(db, name, f"{_FORCE} ORDER BY rowid DESC", gate, vehicle)
    if last.item is None or last.why_none:
        return last
    told = stored(db, name, f"({_FORCE} OR state = 'stale') ORDER BY rowid DESC", gate, vehicle).item or last.item
    item = replace(last.item, outdated=told.outdated, outdated_code=told.outdated_code)
    if vehicle is not None and not item.outdated and abs(item.mass / vehicle.mass - 1.0) > _SAME_MASS:
        why = f"it rests on a mass of {item.mass:g} kg, the vehicle file has {vehicle.mass:g} kg"
        item = replace(item, outdated=why, outdated_code="mass_change")
    return StoredSet(item, "", told.state is not SetState.STALE)


def read_in_force(path: Path, name: str, vehicle: Vehicle | None) -> StoredSet:
    """`in_force` of a history file, which is not touched; raises StoreError."""
    with opened(path) as db:
        return in_force(db, name, GateSettings(), vehicle)


def stored(db: sqlite3.Connection, name: str, which: str, gate: GateSettings, vehicle: Vehicle | None) -> StoredSet:
    """The first set of a vehicle for which the SQL condition `which` holds."""
    row = db.execute(f"SELECT data, sequence FROM sets WHERE vehicle = ? AND {which} LIMIT 1", (name,)).fetchone()
    if row is None:
        return StoredSet(None)
    found = None
    try:
        found = set_from_dict(json.loads(row[0]))
        return StoredSet(found, why_none(found, row[1], gate, vehicle))
    except UNREADABLE as error:
        return StoredSet(found, f"{type(error).__name__}: {str(error)[:120]}")


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
