"""One flight each, as worker processes run them."""

from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.effects import EFFECTS
from quadid.estimate.fit import Estimate, estimate
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.flight import draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.campaign import GUSTS
from quadid_evaluation.studies.filter_error import loop
from quadid_evaluation.studies.truth import poor_guess

SECONDS = 60.0


def identified(window: Window, vehicle: Vehicle, truth: Sequence[float], seed: int) -> FloatArray:
    """Log errors of the six by `identify` and their stated standard deviations, shape (2, 6)."""
    found = fit([window], vehicle, FitOptions(iterations=0, seed=seed))
    return np.array([np.log(found.theta[:6] / truth), found.uncertainty.sigma])


def errors(found: Estimate, truth: Sequence[float]) -> FloatArray:
    """Log errors of the six and their stated standard deviations, shape (2, 6)."""
    pairs = [found.value(name) for name in NOMINAL_NAMES]
    return np.array([[np.log(v / t) for (v, _), t in zip(pairs, truth, strict=True)], [s for _, s in pairs]])


def exact(job: tuple[int, bool]) -> FloatArray:
    """One flight of a drawn Pelican, see `identified`."""
    seed, gusty = job
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, seed)
    numbers = truth.as_dict()
    window = fly(craft, truth, SECONDS, seed, outside=GUSTS if gusty else {}).window
    return identified(window, poor_guess(craft, numbers, seed), list(numbers.values()), seed)


def fast_loop(job: tuple[int, int, float, float]) -> FloatArray:
    """One flight of the fast loop, see `identified`."""
    seed, every, share, speed = job
    vehicle = Vehicle.shipped("pelican")
    window = loop.fly(vehicle, SECONDS, seed, every=every, share=share, speed=speed)
    return identified(window, vehicle, vehicle.initial.tolist(), seed)


LATE = tuple(
    name for e in EFFECTS.values() if e.family == "late" and not e.needs for name in (*e.entries, *e.refinements)
)
"""Lag, lag down, delay of commands, filter of the IMU, delay of the attitude: one family of nested models."""


def lagging(job: tuple[int, float]) -> FloatArray:
    """One flight with a hidden motor lag [s]: errors without and with the late family free, shape (2, 2, 6)."""
    seed, lag = job
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, seed)
    numbers = truth.as_dict()
    window = fly(craft, truth, SECONDS, seed, effects={"motor_lag": {"tau": lag}} if lag else {}).window
    vehicle = poor_guess(craft, numbers, seed)
    track = from_window(window, vehicle)
    found = [estimate(Problem.of([track], vehicle, names, [window])) for names in ((), LATE)]
    return np.array([errors(one, list(numbers.values())) for one in found])
