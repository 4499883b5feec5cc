"""Sixty seconds of flight against the offline batch; a sudden change of mass; ten minutes of hover."""

from __future__ import annotations

from typing import Any

import numpy as np

from quadid.flight import Flight, fly
from quadid.identification.fit import FIT_SECONDS, FitOptions, fit
from quadid.online import OnlineDiagnosis, Publish, Session
from quadid.parameters import NOMINAL_NAMES
from quadid.vehicle import Vehicle
from quadid_evaluation.benchmarks.online.driving import drive, samples

PELICAN = Vehicle.shipped("pelican")
SECONDS = 60.0
CHANGE = 0.15
CHANGE_AT = 33.3
FOUND_WITHIN, SIZE_WITHIN = 5.0, 0.10


def flown(seconds: float, seed: int, profile: str = "excited", **effects: dict[str, float]) -> Flight:
    """A Pelican flight."""
    return fly(PELICAN, seconds=seconds, seed=seed, profile=profile, effects=effects)


def against_batch(seeds: range) -> dict[str, Any]:
    """The last estimate of 60 s against `quadid.identify` on the same 60 s, and both against the truth.

    How far the batch moves when its flight begins a quarter of a segment later tells what it leaves open itself.
    """
    rows = []
    for seed in seeds:
        flight = flown(SECONDS + 1.0, seed)
        actions = list(drive(Session(PELICAN), samples(flight.recording)))
        sets = [a.item for a in actions if isinstance(a, Publish) and a.topic == "parameters"]
        every = [a.item for a in actions if isinstance(a, Publish) and a.topic == "candidate"]
        batch, later = (
            fit([flight.window.slice(first, round(SECONDS * 50))], PELICAN, FitOptions()).parameters
            for first in (0, round(0.24 * FIT_SECONDS * 50))
        )
        truth = flight.truth.parameters.as_dict()
        last = every[-1].parameters
        rows.append({
            "seed": seed,
            "first_set_at": sets[0].stop if sets else None,
            "sets": len(sets),
            "to_batch": {n: last[n].value / batch[n].value - 1.0 for n in NOMINAL_NAMES},
            "to_truth": {n: last[n].value / truth[n] - 1.0 for n in NOMINAL_NAMES},
            "batch_cut_later": {n: later[n].value / batch[n].value - 1.0 for n in NOMINAL_NAMES},
            "batch_to_truth": {n: batch[n].value / truth[n] - 1.0 for n in NOMINAL_NAMES},
            "sigma": {n: last[n].sigma / last[n].value for n in NOMINAL_NAMES},
        })  # fmt: skip
    return {"seconds": SECONDS, "flights": rows}


def mass_changes(seeds: range) -> dict[str, Any]:
    """Mass up or down by 15 % in flight: when it is known, and what it is said to be."""
    rows = []
    for seed in seeds:
        fraction = CHANGE if seed % 2 == 0 else -CHANGE
        flight = flown(CHANGE_AT + 8.0, seed, mass_change={"time": CHANGE_AT, "fraction": fraction})
        actions = list(drive(Session(PELICAN), samples(flight.recording)))
        found = [a for a in actions if isinstance(a, OnlineDiagnosis)]
        finding = found[0].findings[0] if found and found[0].findings else None
        rows.append({
            "seed": seed,
            "fraction": fraction,
            "said": [f.effect for d in found for f in d.findings],
            "after": found[0].t - CHANGE_AT if found else None,
            "size": finding.values.get("fraction") if finding is not None else None,
            "confident": finding.confident if finding is not None else None,
        })  # fmt: skip
    good = [r for r in rows if _hit(r)]
    return {"at": CHANGE_AT, "flights": rows, "hits": len(good)}


def _hit(row: dict[str, Any]) -> bool:
    """Named mass_change within 5 s with its size within 10 %."""
    if row["said"][:1] != ["mass_change"] or row["size"] is None:
        return False
    return bool(row["after"] <= FOUND_WITHIN and abs(row["size"] / row["fraction"] - 1.0) <= SIZE_WITHIN)


def hover(seconds: float, seeds: range) -> dict[str, Any]:
    """Ten minutes of hover: what is published, and how far any number in the session moved."""
    rows = []
    for seed in seeds:
        flight = flown(seconds, seed, "hover")
        session = Session(PELICAN)
        actions = list(drive(session, samples(flight.recording)))
        sets = [a for a in actions if isinstance(a, Publish)]
        rows.append({
            "seed": seed,
            "seconds": seconds,
            "published": sum(a.topic == "parameters" for a in sets),
            "candidates": sum(a.topic == "candidate" for a in sets),
            "diagnoses": sum(isinstance(a, OnlineDiagnosis) for a in actions),
            "phase": session.status().phase.value,
        })  # fmt: skip
    return {"flights": rows}


def hover_after_flight(seconds: float, seed: int) -> dict[str, Any]:
    """Excited flight first, hover after it: the set in force must stay as it is, to the bit."""
    first, quiet = flown(SECONDS, seed), flown(seconds, seed, "hover")
    session = Session(PELICAN)
    list(drive(session, samples(first.recording)))
    before = session.active_set.in_force
    later = list(drive(session, samples(quiet.recording, SECONDS + 3.0)))
    after = session.active_set.in_force
    same = (
        before is not None and after is not None and np.array_equal(before.parameters.values, after.parameters.values)
    )
    published = sum(isinstance(a, Publish) and a.topic == "parameters" for a in later)
    return {"seconds": seconds, "same_bits": bool(same), "published": published}
