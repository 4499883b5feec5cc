"""The same flight on a grid twice as coarse: how much a parameter depends on what the inputs do within a row.

A log holds one value of each input a row; what it does within the row is not known.  What that changes grows with the
square of the row's length: feedback that runs on within held commands, behind a lag or a delay, looks like another
inertia by that much, and so does a straight line between readings that turn.  Every second row of the same data
therefore shows three times what the rows at hand may be off by (Richardson, Phil. Trans. R. Soc. A 210 (1911) 307).
"""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from quadid.data.window import Window
from quadid.identification.gauss_newton import Polished, polish
from quadid.identification.parameterization import Free
from quadid.identification.priors import Prior
from quadid.identification.shooting import Shooting
from quadid.types import FloatArray

SHARE = 1.0 / 3.0
"""Of the difference between two grids, of which one is twice as coarse, that the finer one is off by."""
_ITERATIONS = 4


def on_coarse_grid(problem: Shooting, found: Polished, free: Free, prior: Prior) -> Polished | None:
    """The fit to every second row, from the optimum of all; None where no segment fits.

    Args:
        problem: of the fit to all rows.
        found: its optimum.
        free: its parameters.
        prior: of those.
    """
    windows = [coarse(rollout.window) for rollout in problem.rollouts]
    noise = replace(problem.noise, shape=None)
    cut = Shooting.cut(windows, problem.vehicle, problem.seconds, noise, problem.layout).leaving_out(problem.left_out)
    if not cut.count or cut.channels != problem.channels:
        return None
    return polish(cut, found.theta, free, prior, iterations=_ITERATIONS, robust=problem.robust is not None)


def coarse(window: Window) -> Window:
    """Every second row of `window`; forces and held speeds are means over the longer rows."""
    n = len(window) // 2 * 2
    even: dict[str, Any] = {name: None if (x := getattr(window, name)) is None else x[:n:2] for name in _INSTANTS}
    accel = None if window.accel is None else _smoothed(window.accel)[:n:2]
    speed, slope = window.rotor_speed[:n:2], None
    if window.sampling == "held":
        first, second = window.rotor_speed[:n:2], window.rotor_speed[1:n:2]
        speed = np.sqrt(0.5 * (first**2 + second**2))  # what thrust and drag torque are means of
        if window.rotor_slope is not None:
            own = window.rotor_slope[:n:2] + window.rotor_slope[1:n:2]
            slope = 0.75 * (second - first) / window.dt + 0.125 * own  # of the straight line with the same moment
    return replace(window, dt=2.0 * window.dt, rotor_speed=speed, rotor_slope=slope, accel=accel, **even)


_INSTANTS = ("gyro", "attitude", "velocity", "position", "battery", "attitude_reference")


def _smoothed(accel: FloatArray) -> FloatArray:
    """Means over two rows around each row, where both neighbours are known."""
    wide = np.pad(accel, ((1, 1), (0, 0)), constant_values=np.nan)
    mean = 0.25 * wide[:-2] + 0.5 * accel + 0.25 * wide[2:]
    return np.asarray(np.where(np.isnan(mean), accel, mean))
