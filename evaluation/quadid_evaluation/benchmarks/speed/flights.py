"""Flights to be timed on: a simulated Pelican without hidden effects, cached for the process."""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

from quadid.data.window import Window
from quadid.flight import draw_truth, fly
from quadid.vehicle import Vehicle

SEED = 2026


@lru_cache(maxsize=8)
def flight(seconds: float) -> Window:
    """Window of a flight of this length at 50 Hz."""
    vehicle = Vehicle.shipped("pelican")
    return fly(vehicle, draw_truth(vehicle, SEED), seconds, SEED).window


def logged(folder: Path, seconds: float, suffix: str) -> Path:
    """Log of a flight of this length, written by `quadid simulate`."""
    from quadid_evaluation.benchmarks.speed.timing import command

    path = folder / f"flight{seconds:g}{suffix}"
    if not path.exists():
        command("simulate", str(path), "--vehicle", "pelican", "--seconds", f"{seconds:g}", "--seed", "3")
    return path
