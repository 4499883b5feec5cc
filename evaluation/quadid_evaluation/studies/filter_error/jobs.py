"""One flight each, as worker processes run them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from quadid.data.window import Window
from quadid.estimate import kalman as k
from quadid.estimate.fit import Estimate, estimate
from quadid.estimate.problem import Problem
from quadid.estimate.track import from_window
from quadid.flight import draw_truth, fly
from quadid.identification.fit import FitOptions, fit
from quadid.parameters import NOMINAL_NAMES
from quadid.types import FloatArray
from quadid.vehicle import Vehicle
from quadid_evaluation.studies.filter_error import loop
from quadid_evaluation.studies.truth import poor_guess

SECONDS = 60.0
GUSTS = {"gusts": {"push": 0.6, "turn": 1.0, "time": 0.5}}
"""Forces of 0.6 m/s^2, moments of 1 rad/s^2: a quarter of the control moment of these flights."""


def of_window(window: Window, vehicle: Vehicle, swarm: int = 0, seed: int = 0) -> Estimate:
    """The new estimate of one window."""
    return estimate(Problem.of([from_window(window, vehicle)], vehicle), seed, iterations=swarm)


def errors(found: Estimate, truth: Sequence[float]) -> FloatArray:
    """Log errors of the six and their stated standard deviations, shape (2, 6)."""
    pairs = [found.value(name) for name in NOMINAL_NAMES]
    return np.array([[np.log(v / t) for (v, _), t in zip(pairs, truth, strict=True)], [s for _, s in pairs]])


def exact(job: tuple[int, bool]) -> tuple[FloatArray, FloatArray, FloatArray]:
    """One flight of a drawn Pelican: ours, today's fit, and the random forces found, as shares of their prior."""
    seed, gusty = job
    craft = Vehicle.shipped("pelican")
    truth = draw_truth(craft, seed)
    numbers = truth.as_dict()
    window = fly(craft, truth, SECONDS, seed, outside=GUSTS if gusty else {}).window
    vehicle = poor_guess(craft, numbers, seed)
    found = of_window(window, vehicle)
    today = fit([window], vehicle, FitOptions(iterations=0, seed=seed))
    old = np.array([np.log(today.theta[:6] / list(numbers.values())), today.uncertainty.sigma])
    sizes = found.psi[k.SIGMA : k.SIGMA + 4]
    return errors(found, list(numbers.values())), old, sizes


def fast_loop(job: tuple[int, int, float, float]) -> FloatArray:
    """One flight of the fast loop: errors of ours and today's fit, shape (2, 2, 6)."""
    seed, every, share, speed = job
    vehicle = Vehicle.shipped("pelican")
    window = loop.fly(vehicle, SECONDS, seed, every=every, share=share, speed=speed)
    truth = vehicle.initial.tolist()
    today = fit([window], vehicle, FitOptions(iterations=0, seed=seed))
    old = np.array([np.log(today.theta[:6] / truth), today.uncertainty.sigma])
    return np.array([errors(of_window(window, vehicle), truth), old])
